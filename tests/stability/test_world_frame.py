"""The scene does not depend on the position, orientation and unit of a capture's world frame.

A capture and copies of it with all poses moved, turned or scaled are streamed to Gaussians in the capture's frame. The
stream frame stands at the first camera, so all copies are the same stream to float64 rounding, voxels included.
"""

import dataclasses
import functools

import jax
import numpy as np
import pytest
from scipy.spatial import cKDTree

from ssplat_jax.cache import init_cache
from ssplat_jax.config import StreamConfig
from ssplat_jax.core.gaussians import Gaussians
from ssplat_jax.core.rotations import quats_to_matrices, sh_rotation
from ssplat_jax.data.capture import Capture
from ssplat_jax.data.open_capture import open_capture
from ssplat_jax.data.stream_frame import StreamFrame
from ssplat_jax.model.streamsplat import StreamSplat
from ssplat_jax.scene_files.formats import load_ply, save_ply
from tests.core.test_rotations import rodrigues
from tests.model import small
from tests.model.small import random_params

UNSHIFTED = 1e-3  # tolerance of positions, in units of a room of some meters
SHARE = 0.99  # share of the Gaussians that must agree
VOXEL = 0.25  # stream units: large enough that tokens of an untrained network merge

CONFIG = small.CONFIG.replace(
    chunk_size=4,
    attention_blocks=1,
    attention_window=StreamConfig().network.attention_window,
    fine_matching=False,
    sh_degree=1,
    voxel_size=VOXEL,
    capacity=4096,
)

EARTH = np.array([4.2e6, -2.7e6, 4.0e6]) + 0.123  # 6.4e6 from the origin, and no number that float32 could hold
TURN = rodrigues([0.3, -0.8, 0.52], 2.0)

MOTIONS = {  # scale, rotation, translation of the world
    "shifted by 6.4e6": (1.0, np.eye(3), EARTH),
    "turned and shifted by 6.4e6": (1.0, TURN, EARTH),
    "in another unit, turned and shifted": (0.013, TURN, np.array([3.0, -7.0, 2.0])),
}

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("compiled_plainly")]


@functools.cache
def moved(name: str | None, source: str = "procedural:room?frames=8&size=64x64") -> Capture:
    """A capture in a moved world."""
    capture = open_capture(source)
    if name is None:
        return capture
    scale, rotation, translation = MOTIONS[name]
    frames = []
    for posed in capture.frames:
        pose = posed.camtoworld.copy()
        pose[:3, :3], pose[:3, 3] = rotation @ pose[:3, :3], scale * rotation @ pose[:3, 3] + translation
        frames.append(dataclasses.replace(posed, camtoworld=pose))
    return dataclasses.replace(capture, frames=tuple(frames))


@functools.cache
def programs():
    """`step` and `decode`, jitted."""
    model = StreamSplat(CONFIG)
    return jax.jit(model.step), jax.jit(model.decode)


@functools.cache
def stream(capture: Capture) -> tuple[StreamFrame, Gaussians, dict[str, np.ndarray]]:
    """The stream frame, the Gaussians as decoded, and those present in the capture's frame, in NumPy."""
    (step, decode), frame = programs(), capture.stream_frame(CONFIG)
    params, cache = random_params(CONFIG, seed=1), init_cache(CONFIG)
    for chunk in capture.chunks(CONFIG, range(len(capture)), frame=frame):
        cache, _ = step(params, cache, chunk)
    assert int(cache.stats.num_merged) > 0 and int(cache.stats.num_dropped) == 0
    in_stream = decode(params, cache)
    gaussians = frame.gaussians_to_capture(in_stream)
    fields = {
        "means": frame.points_to_capture(np.asarray(in_stream.means, np.float64)),  # float32 has a spacing of 0.5 there
        "axes": quats_to_matrices(gaussians.quats),
        "scales": gaussians.scales,
        "opacities": gaussians.opacities,
        "sh": gaussians.sh,
    }
    rows = np.asarray(in_stream.opacities) > 0
    return frame, in_stream, {name: np.asarray(x, np.float64)[rows] for name, x in fields.items()}


@pytest.mark.parametrize("name", MOTIONS)
def test_moving_the_world_moves_the_gaussians(name):
    scale, rotation, translation = MOTIONS[name]
    a, b = stream(moved(None))[2], stream(moved(name))[2]
    distances, nearest = cKDTree((b["means"] - translation) @ rotation / scale).query(a["means"])
    is_same = distances < UNSHIFTED
    # A turned pose rounds differently to float32, which can move a token across a voxel face. A shifted pose does not.
    share = 1.0 if np.array_equal(rotation, np.eye(3)) else SHARE
    assert is_same.mean() >= share
    assert abs(len(distances) / len(b["means"]) - 1) <= 1 - share
    assert len(set(nearest)) >= SHARE * len(b["means"]) > 500
    a, b = {k: x[is_same] for k, x in a.items()}, {k: x[nearest[is_same]] for k, x in b.items()}
    deviations = (
        b["axes"] - rotation @ a["axes"],
        b["scales"] / (scale * a["scales"]) - 1,
        b["opacities"] - a["opacities"],
        b["sh"] - np.einsum("kl,nlc->nkc", sh_rotation(rotation, CONFIG.head.sh_degree), a["sh"]),
    )
    for deviation in deviations:
        assert np.quantile(np.abs(deviation).reshape(len(deviation), -1).max(axis=1), share) < UNSHIFTED


def test_the_ply_of_a_far_capture_is_relative_to_an_offset(tmp_path):
    """At 6.4e6 float32 has a spacing of 0.5; relative to the file's offset the scene is as fine as at the origin."""
    frame, in_stream, far = stream(moved("shifted by 6.4e6"))
    assert np.abs(np.asarray(frame.offset) - frame.origin).max() <= 0.5
    gaussians = frame.gaussians_to_capture(in_stream, offset=frame.offset)
    save_ply(tmp_path / "scene.ply", gaussians, offset=frame.offset)
    header = (tmp_path / "scene.ply").read_bytes().split(b"end_header")[0].decode()
    (comment,) = [line for line in header.splitlines() if line.startswith("comment offset")]
    written = np.asarray(load_ply(tmp_path / "scene.ply").means, np.float64) + [float(x) for x in comment.split()[2:]]
    np.testing.assert_allclose(written, far["means"], rtol=0, atol=UNSHIFTED / 100)


def test_depth_range_and_scale_of_matched_captures_move_along():
    """These images are large enough for keypoints; in the other tests the scale is estimated from the steps."""
    name, source = "in another unit, turned and shifted", "procedural:room?frames=4&size=160x120"
    frame, other = (moved(motion, source).stream_frame(CONFIG) for motion in (None, name))
    scale = MOTIONS[name][0]
    got, wanted = (scale * other.scale, other.near, other.far), (frame.scale, frame.near, frame.far)
    np.testing.assert_allclose(got, wanted, rtol=1e-5)  # triangulation at small parallax amplifies float64's rounding
