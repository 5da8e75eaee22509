"""The scene does not depend on the position, orientation and unit of a capture's world frame.

A capture on disk and copies of it with all poses moved, turned or scaled are streamed from `open_capture` to Gaussians
in the capture's frame. The stream frame stands at the first camera, so all copies are the same stream to float64
rounding, voxels included.
"""

import dataclasses
import functools
import json

import jax
import numpy as np
import pytest
from PIL import Image
from scipy.spatial import cKDTree

from ssplat_jax.cache import init_cache
from ssplat_jax.config import StreamConfig
from ssplat_jax.core.gaussians import Gaussians
from ssplat_jax.core.rotations import quats_to_matrices, sh_rotation
from ssplat_jax.data.capture import Capture
from ssplat_jax.data.open_capture import open_capture
from ssplat_jax.data.stream_frame import StreamFrame
from ssplat_jax.model.streamsplat import StreamSplat
from ssplat_jax.scene_files.ply import load_ply, save_ply
from tests.core.test_rotations import rodrigues
from tests.model import small
from tests.model.small import random_params
from tests.model.test_plane_sweep import WALL, texture

UNSHIFTED = 1e-3  # tolerance of positions, in units of a room of some meters
SHARE = 0.99  # share of the Gaussians that must agree
FRAMES, SIDE = 8, 64
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
def scene():
    """Images, poses and intrinsics of a walk past a textured wall, the camera turning on the way."""
    K = np.array([[55.0, 0, 30.0], [0, 56.0, 33.0], [0, 0, 1]])
    pixel = np.arange(SIDE) + 0.5
    u, v = np.meshgrid(pixel, pixel)
    rays = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones_like(u)], axis=-1)
    poses = np.tile(np.eye(4), (FRAMES, 1, 1))
    images = []
    for i, pose in enumerate(poses):
        pose[:3, :3] = rodrigues([0.1, 1.0, 0.3], 0.06 * (i - 3))
        pose[:3, 3] = [0.2 * i - 0.7, 0.1 * np.sin(i), -0.05 * i]
        directions = rays @ pose[:3, :3].T
        on_wall = pose[:3, 3] + directions * ((WALL - pose[2, 3]) / directions[..., 2])[..., None]
        images.append(texture(on_wall[..., 0], on_wall[..., 1]))
    return np.stack(images), poses, K


@pytest.fixture(scope="module")
def open_moved(tmp_path_factory):
    """The capture of `scene()` in a moved world, written to disk and opened."""

    @functools.cache
    def opened(name: str | None) -> Capture:
        images, poses, K = scene()
        if name is not None:
            scale, rotation, translation = MOTIONS[name]
            poses = poses.copy()
            poses[:, :3, :3] = rotation @ poses[:, :3, :3]
            poses[:, :3, 3] = scale * poses[:, :3, 3] @ rotation.T + translation
        folder = tmp_path_factory.mktemp("capture")
        frames = []
        for i, (image, pose) in enumerate(zip(images, poses, strict=True)):
            Image.fromarray(np.round(255 * image).astype(np.uint8)).save(folder / f"{i}.png")
            opengl = pose @ np.diag([1.0, -1.0, -1.0, 1.0])
            frames.append({"file_path": f"{i}.png", "transform_matrix": opengl.tolist()})
        meta = {"fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2], "cy": K[1, 2], "w": SIDE, "h": SIDE, "frames": frames}
        (folder / "transforms.json").write_text(json.dumps(meta))
        return open_capture(folder)

    return opened


@functools.cache
def programs():
    """`step` and `decode`, jitted."""
    model = StreamSplat(CONFIG)
    return jax.jit(model.step), jax.jit(model.decode)


@dataclasses.dataclass(frozen=True, eq=False)
class Streamed:
    """A finished scene in the capture's frame, in NumPy, without absent Gaussians."""

    frame: StreamFrame
    in_stream: Gaussians  # as decoded, absent rows included
    means: np.ndarray  # float64: float32 has a spacing of 0.5 at 6.4e6
    axes: np.ndarray
    scales: np.ndarray
    opacities: np.ndarray
    sh: np.ndarray


@functools.cache
def stream(capture: Capture) -> Streamed:
    """Streams the capture from images to Gaussians in its own frame."""
    (step, decode), frame = programs(), capture.stream_frame(CONFIG)
    params, cache = random_params(CONFIG, seed=1), init_cache(CONFIG)
    for chunk in capture.chunks(CONFIG, range(FRAMES), frame=frame):
        cache, _ = step(params, cache, chunk)
    assert int(cache.stats.num_merged) > 0 and int(cache.stats.num_dropped) == 0
    in_stream = decode(params, cache)
    gaussians = frame.gaussians_to_capture(in_stream)
    rows = np.asarray(in_stream.opacities) > 0
    return Streamed(
        frame=frame,
        in_stream=in_stream,
        means=frame.points_to_capture(np.asarray(in_stream.means, np.float64))[rows],
        axes=np.asarray(quats_to_matrices(gaussians.quats), np.float64)[rows],
        scales=np.asarray(gaussians.scales, np.float64)[rows],
        opacities=np.asarray(gaussians.opacities)[rows],
        sh=np.asarray(gaussians.sh, np.float64)[rows],
    )


@pytest.mark.parametrize("name", MOTIONS)
def test_moving_the_world_moves_the_gaussians(open_moved, name):
    scale, rotation, translation = MOTIONS[name]
    a, b = stream(open_moved(None)), stream(open_moved(name))
    distances, nearest = cKDTree((b.means - translation) @ rotation / scale).query(a.means)
    is_same = distances < UNSHIFTED
    # A turned pose rounds differently to float32, which can move a token across a voxel face. A shifted pose does not.
    share = 1.0 if np.array_equal(rotation, np.eye(3)) else SHARE
    assert is_same.mean() >= share
    assert abs(len(b.means) / len(a.means) - 1) <= 1 - share
    assert len(set(nearest)) >= SHARE * len(b.means) > 500
    nearest = nearest[is_same]
    deviations = (
        b.axes[nearest] - rotation @ a.axes[is_same],
        b.scales[nearest] / (scale * a.scales[is_same]) - 1,
        b.opacities[nearest] - a.opacities[is_same],
        b.sh[nearest] - np.einsum("kl,nlc->nkc", sh_rotation(rotation, CONFIG.head.sh_degree), a.sh[is_same]),
    )
    for deviation in deviations:
        assert np.quantile(np.abs(deviation).reshape(len(nearest), -1).max(axis=1), share) < UNSHIFTED


def test_the_ply_of_a_far_capture_is_relative_to_an_offset(open_moved, tmp_path):
    """At 6.4e6 float32 has a spacing of 0.5; relative to the file's offset the scene is as fine as at the origin."""
    far = stream(open_moved("shifted by 6.4e6"))
    offset = far.frame.offset
    assert np.abs(np.asarray(offset) - far.frame.origin).max() <= 0.5
    assert stream(open_moved(None)).frame.offset == (0, 0, 0)
    save_ply(tmp_path / "scene.ply", far.frame.gaussians_to_capture(far.in_stream, offset=offset), offset=offset)
    header = (tmp_path / "scene.ply").read_bytes().split(b"end_header")[0].decode()
    (comment,) = [line for line in header.splitlines() if line.startswith("comment offset")]
    written = np.asarray(load_ply(tmp_path / "scene.ply").means, np.float64) + [float(x) for x in comment.split()[2:]]
    np.testing.assert_allclose(written, far.means, rtol=0, atol=UNSHIFTED / 100)


def test_depth_range_and_scale_of_matched_captures_move_along():
    """These images are large enough for keypoints; in the other tests the scale is estimated from the steps."""
    capture = open_capture("procedural:room?frames=4&size=160x120")
    frame, (scale, rotation, translation) = capture.stream_frame(CONFIG), MOTIONS["in another unit, turned and shifted"]
    frames = []
    for posed in capture.frames:
        pose = posed.camtoworld.copy()
        pose[:3, :3], pose[:3, 3] = rotation @ pose[:3, :3], scale * rotation @ pose[:3, 3] + translation
        frames.append(dataclasses.replace(posed, camtoworld=pose))
    moved = dataclasses.replace(capture, frames=tuple(frames)).stream_frame(CONFIG)
    got, wanted = (scale * moved.scale, moved.near, moved.far), (frame.scale, frame.near, frame.far)
    np.testing.assert_allclose(got, wanted, rtol=1e-5)  # triangulation at small parallax amplifies float64's rounding
