"""Depth statistics from matches: right on known scenes, steady in what is hard, blind to other frames."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from skimage.filters import gaussian
from skimage.transform import resize

from ssplat_jax.config import StreamConfig
from ssplat_jax.data import depth_range as scale_module
from ssplat_jax.data.capture import Capture, open_capture
from ssplat_jax.data.capture_summary import summarize
from ssplat_jax.data.depth_range import (
    DepthStatistics,
    epipolar_distances,
    estimate_depths,
    match,
    stream_scale,
    triangulate,
)
from ssplat_jax.data.images import ArrayPixels
from ssplat_jax.data.posed_image import Frame
from ssplat_jax.data.split import interleaved

CAPTURES = Path(__file__).resolve().parents[3] / "shared" / "captures"
HEIGHT, WIDTH, FOCAL = 120, 160, 140.0
NEAR_PLANE, FAR_PLANE = 2.0, 4.0
MEDIAN_TOLERANCE = 1.3  # ratio: keypoints are not spread like pixels
RANGE_SLACK = 0.001  # of the pixels may lie outside [near, far]


def texture(rng):
    """A 512x512 color texture with corners at several scales."""
    noise = [resize(rng.random((n, n, 3)), (512, 512), order=0) for n in (32, 64, 128)]
    return gaussian(sum(noise) / 3, 1.0, channel_axis=-1).astype(np.float32)


def two_planes(
    num_frames, step, *, forward=0.0, units=1.0, spin=0.0, seed=0, start=0.0, wall_at=FAR_PLANE, board_half=0.4
):
    """Frames that slide past a textured wall at depth 4 with a board at depth 2 before it; lengths times `units`.

    `step`: sideways motion per frame, `forward`: along the axis, `spin`: degrees per frame about the camera's y axis,
    `start`: where the motion starts sideways, `wall_at`: the wall's depth, `board_half`: half the board's side.
    """
    rng = np.random.default_rng(seed)
    wall, board = texture(rng), texture(rng)
    columns, rows = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    rays = np.stack([(columns - WIDTH / 2) / FOCAL, (rows - HEIGHT / 2) / FOCAL, np.ones_like(rows)], -1)
    images, depths, frames = [], [], []
    for i in range(num_frames):
        c, s = np.cos(np.radians(spin * i)), np.sin(np.radians(spin * i))
        pose = np.array([[c, 0, s, start + step * i], [0, 1, 0, 0], [-s, 0, c, forward * i], [0, 0, 0, 1.0]])
        world = rays @ pose[:3, :3].T
        image, depth = None, None
        for plane, colors in ((wall_at, wall), (NEAR_PLANE, board)):
            extent = 4 * plane  # about a texel a pixel
            along = (plane - pose[2, 3]) / world[..., 2]
            hit = pose[:3, 3] + along[..., None] * world
            texel = np.floor((hit[..., :2] / extent + 0.5) * 512).astype(int) % 512
            shade = colors[texel[..., 1], texel[..., 0]]
            if image is None:
                image, depth = shade, along
            else:
                on_board = (np.abs(hit[..., :2]) < board_half).all(-1)
                image, depth = np.where(on_board[..., None], shade, image), np.where(on_board, along, depth)
        images.append(image)
        depths.append(depth * units)
        pose[:3, 3] *= units
        K = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
        frames.append(Frame(name=str(i), camtoworld=pose, K=K, width=WIDTH, height=HEIGHT))
    pixels = ArrayPixels(images=np.stack(images).astype(np.float32), depths=np.stack(depths).astype(np.float32))
    return Capture(name="planes", format="memory", frames=tuple(frames), pixels=pixels, width=WIDTH, height=HEIGHT)


def true_depths(capture, indices):
    maps = [capture.depth(i) for i in indices]
    depths = np.concatenate([m.ravel() for m in maps if m is not None])
    return depths[depths > 0]


def assert_right(capture, indices, tolerance=MEDIAN_TOLERANCE):
    depths = estimate_depths(capture, indices)
    truth = true_depths(capture, indices)
    assert depths.source == "matches"
    assert 1 / tolerance < depths.median / np.median(truth) < tolerance
    _, near, far = stream_scale(depths, StreamConfig().replace(scene_scale=1.0))
    assert np.mean((truth < near) | (truth > far)) <= RANGE_SLACK
    assert far / near < 30  # it does say something


@pytest.mark.parametrize(
    "motion",
    [
        {"step": 0.03},
        {"step": 0.1},
        {"step": 0.002},  # 0.05 % of the depth a frame
        {"step": 0.03, "spin": 1.0},
        {"step": 0.02, "forward": 0.04},
    ],
    ids=str,
)
def test_depths_of_a_known_scene(motion):
    capture = two_planes(16, **motion)
    assert_right(capture, range(16), tolerance=2.0 if motion["step"] < 0.01 else MEDIAN_TOLERANCE)


def share_outside(capture):
    """Shares of the pixels nearer than near and farther than far."""
    indices = range(len(capture))
    _, near, far = stream_scale(estimate_depths(capture, indices), StreamConfig().replace(scene_scale=1.0))
    truth = true_depths(capture, indices)
    return np.mean(truth < near), np.mean(truth > far)


def test_a_background_far_behind_is_within_reach():
    """It has hardly any parallax, but its points are surely beyond what has, and a sweep that ends before it puts
    floaters there."""
    nearer, beyond = share_outside(two_planes(12, 0.06, wall_at=30.0, board_half=0.9))
    assert nearer < 0.01 and beyond < 0.01


def test_what_is_near_counts_where_only_the_background_matches_over_wide_baselines():
    nearer, beyond = share_outside(two_planes(16, 0.3, start=-2.4, wall_at=30.0, board_half=0.56))
    assert nearer < 0.01 and beyond < 0.01


def test_dark_images_are_seen():
    capture = two_planes(12, 0.05)
    assert isinstance(capture.pixels, ArrayPixels)
    capture.pixels.images[:] *= 0.08
    assert_right(capture, range(12))


def test_units_of_the_capture_do_not_matter():
    small, large = (estimate_depths(two_planes(6, 0.05, units=2.0**u), range(6)) for u in (-13, 13))
    quantiles = [(d.q01, d.median, d.q99) for d in (small, large)]
    np.testing.assert_array_equal(np.multiply(quantiles[0], 2.0**26), quantiles[1])  # powers of two: exact


def test_only_the_given_frames_are_looked_at():
    """Else an evaluation's targets would leak into near, far and scale."""
    capture = two_planes(12, 0.05)
    used = [0, 1, 2, 3, 5, 6, 7]
    before = estimate_depths(capture, used)
    assert isinstance(capture.pixels, ArrayPixels)
    capture.pixels.images[4] = capture.pixels.images[8:] = np.nan
    assert estimate_depths(capture, used) == before


def test_order_of_the_frames_does_not_bring_false_pairs():
    capture = two_planes(12, 0.05)
    assert_right(capture, np.random.default_rng(0).permutation(12).tolist())


@pytest.mark.parametrize("num_frames", [1, 3])
def test_no_motion_is_a_guess_of_one(num_frames):
    depths = estimate_depths(two_planes(num_frames, 0.0), range(num_frames))
    assert (depths.source, depths.median, depths.num_points) == ("baselines", 1.0, 0)


@pytest.mark.parametrize("center", [[1.0, 2.0, 0.5], [0.0, 0.0, 0.0], [4.2e6, 6.1e5, 4.7e6]])
def test_a_tripods_rounding_is_no_motion(center):
    """Inverted matrices put one place at slightly different ones: no baseline to measure depth by."""
    capture, rng = two_planes(6, 0.0, spin=3.0), np.random.default_rng(0)
    for frame in capture.frames:
        frame.camtoworld[:3, 3] = np.array(center) * (1 + rng.uniform(-1e-15, 1e-15, 3)) + rng.uniform(-1e-16, 1e-16, 3)
    depths = estimate_depths(capture, range(6))
    assert (depths.source, depths.median) == ("baselines", 1.0)
    assert "one place" in summarize(capture, StreamConfig()).warnings[-1]


def test_a_median_behind_the_camera_is_no_depth(monkeypatch):
    """False matches of some cells of the image may outvote the true ones of a crowded cell."""
    n = 40
    points = scale_module._Points(
        inverse_depths=np.where(np.arange(n) < n // 4, -0.5, 0.5),
        parallax=np.where(np.arange(n) < n // 4, -3.0, 3.0),
        weights=np.where(np.arange(n) < n // 4, 1.0, 0.1),
        close=np.zeros(0),
    )
    monkeypatch.setattr(scale_module, "_best_pair", lambda *_: points)
    depths = estimate_depths(two_planes(3, 0.2), range(3))
    assert depths.source == "baselines" and depths.median == pytest.approx(5 * 0.2)
    assert min(stream_scale(depths, StreamConfig())) > 0


def test_bare_walls_are_a_guess_from_the_steps():
    capture = two_planes(6, 0.2)
    assert isinstance(capture.pixels, ArrayPixels)
    capture.pixels.images[:] = 0.5
    depths = estimate_depths(capture, range(6))
    assert depths.source == "baselines"
    np.testing.assert_allclose(depths.median, 5 * 0.2, rtol=1e-12)


def test_images_too_narrow_for_keypoints_are_a_guess():
    capture = two_planes(6, 0.2)
    tiny = Capture(name="", format="", frames=capture.frames, pixels=capture.pixels, width=160, height=12)
    assert estimate_depths(tiny, range(6)).source == "baselines"


@settings(max_examples=100, deadline=None)
@given(st.floats(1e-6, 1e6), st.floats(1, 100), st.floats(1, 100))
def test_range_is_bounded_and_scales(median, spread_near, spread_far):
    depths = DepthStatistics(
        q01=median / spread_near,
        median=median,
        q99=median * spread_far,
        num_points=100,
        num_pairs=10,
        parallax_degrees=4.0,
        source="matches",
    )
    scale, near, far = stream_scale(depths, StreamConfig().replace(median_depth=2.0))
    np.testing.assert_allclose(scale * median, 2.0, rtol=1e-12)
    assert scale_module.MIN_RANGE * (1 - 1e-9) <= far / near <= scale_module.MAX_RANGE * (1 + 1e-9)
    assert near <= max(scale * depths.q01, 2.0 / 8) * (1 + 1e-9)
    assert near < 2.0 < far
    unit, unit_near, unit_far = stream_scale(depths, StreamConfig().replace(scene_scale=1.0))
    assert unit == 1.0
    np.testing.assert_allclose([unit_near * scale, unit_far * scale], [near, far], rtol=1e-9)


# -- its parts --------------------------------------------------------------------------------------------------------


def two_cameras(rng, num_points=50):
    angle = np.radians(5.0)
    R = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    t = np.array([0.3, -0.1, 0.05])
    points = np.concatenate([rng.uniform(-1, 1, (num_points, 2)), rng.uniform(2, 5, (num_points, 1))], -1)
    seen = points @ R.T + t
    return points, points / points[:, 2:], seen / seen[:, 2:], R, t


def test_triangulation_inverts_projection():
    points, rays_a, rays_b, R, t = two_cameras(np.random.default_rng(0))
    inverse_depths, parallax = triangulate(rays_a, rays_b, R, t)
    np.testing.assert_allclose(1 / inverse_depths, points[:, 2], rtol=1e-10)
    to_a, to_b = points, points + R.T @ t
    cosine = (to_a * to_b).sum(-1) / np.linalg.norm(to_a, axis=-1) / np.linalg.norm(to_b, axis=-1)
    np.testing.assert_allclose(parallax, np.degrees(np.arccos(cosine)), rtol=1e-6)


def test_parallel_rays_are_infinitely_far_and_diverging_ones_behind():
    R, t, ray = np.eye(3), np.array([1.0, 0, 0]), np.array([[0.0, 0, 1]])
    inverse_depths, parallax = triangulate(ray, ray, R, t)
    assert inverse_depths[0] == 0 and parallax[0] == 0
    inverse_depths, parallax = triangulate(ray, np.array([[-0.1, 0, 1]]), R, t)
    np.testing.assert_allclose(inverse_depths, -0.1, rtol=1e-12)
    assert parallax[0] < 0


def test_true_matches_lie_on_their_epipolar_lines_and_others_do_not():
    _, rays_a, rays_b, R, t = two_cameras(np.random.default_rng(1))
    distances = epipolar_distances(rays_a, rays_b, R, t)
    assert np.diag(distances).max() < 1e-12
    assert np.median(distances) > 0.05


def test_matching_is_mutual_unambiguous_and_keeps_to_what_is_allowed():
    rng = np.random.default_rng(2)
    a = rng.random((40, 256)) < 0.5
    order = rng.permutation(40)
    b = a[order] ^ (rng.random((40, 256)) < 0.1)
    everywhere = np.ones((40, 40), bool)
    idx_a, idx_b = match(a, b, everywhere)
    assert len(idx_a) == 40 and (order[idx_b] == idx_a).all()
    forbidden = everywhere.copy()
    forbidden[:, :10] = False
    assert match(a, b, forbidden)[1].min() >= 10
    doubled = np.concatenate([b, b[:1]])
    assert 0 not in match(a, doubled, np.ones((40, 41), bool))[1]  # two equal candidates: none is taken


# -- real captures ----------------------------------------------------------------------------------------------------


@pytest.mark.skipif(not CAPTURES.is_dir(), reason="no ../shared/captures beside the repository")
@pytest.mark.parametrize(("stride", "context"), [(1, 24), (5, 8)])
def test_kinect_depths_of_a_hand_held_video(stride, context):
    """Median within 35 % of the Kinect's over the same stretch, and its depths inside [near, far]."""
    capture = open_capture(CAPTURES / "redkitchen", size=(320, 240))
    used = interleaved(len(capture), stride, context).context
    depths = estimate_depths(capture, used)
    truth = true_depths(capture, range(used[0], used[-1] + 1))
    assert depths.source == "matches"
    assert 1 / 1.35 < depths.median / np.median(truth) < 1.35
    _, near, far = stream_scale(depths, StreamConfig().replace(scene_scale=1.0))
    assert np.mean((truth < near) | (truth > far)) <= RANGE_SLACK
    assert far / near < 20
