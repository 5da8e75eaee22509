"""Scores: holes are filled with the colors around; over black they cost what they are worth."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import ssplat_jax as ss
from ssplat_jax.config import StreamConfig
from ssplat_jax.core.gaussians import Gaussians, mean_color
from ssplat_jax.core.pytree import replace
from ssplat_jax.data.open_capture import open_capture
from ssplat_jax.data.split import Split
from ssplat_jax.evaluation.metrics import psnr, ssim
from ssplat_jax.evaluation.scoring import baselines, nearest_views, score_view
from tests.core.test_rotations import rodrigues
from tests.data.capture_fixture import with_poses
from tests.rasterizer.scenes import balls


def gaussians(colors, opacities, depth: float = -5.0) -> Gaussians:
    """On the axis of the stream's first view; by default behind it."""
    return balls([[0.0, 0.0, depth]] * len(opacities), 1e-3, opacities, colors)


def test_mean_color_weighs_by_opacity_and_leaves_absent_rows_out():
    scene = gaussians([[1, 0, 0], [0, 1, 0], [0, 0, 1]], [0.3, 0.9, 0.0])
    np.testing.assert_allclose(mean_color(scene), [0.25, 0.75, 0], atol=1e-6)
    np.testing.assert_array_equal(mean_color(gaussians([[0.2, 0.3, 0.4]], [0.0])), 0)


@pytest.mark.parametrize("bad", [jnp.nan, jnp.inf, -jnp.inf])
@pytest.mark.parametrize("opacity", [0.0, 0.9])
def test_rows_that_are_not_finite_give_no_color(bad, opacity):
    good = gaussians([[1, 0, 0], [0, 1, 0]], [0.3, 0.9])
    for scene in (
        gaussians([[1, 0, 0], [0, 1, 0], [0.5, bad, 0.5]], [0.3, 0.9, opacity]),
        gaussians([[1, 0, 0], [0, 1, 0], [0.5, 0.5, 0.5]], [0.3, 0.9, bad]),
    ):
        np.testing.assert_array_equal(mean_color(scene), mean_color(good))
        slope = jax.grad(lambda scene: mean_color(scene).sum())(scene)
        assert all(bool(jnp.isfinite(leaf).all()) for leaf in jax.tree.leaves(slope))


@pytest.fixture(scope="module")
def capture():
    return open_capture("procedural:room?frames=5&size=32x24")


def test_an_uncovered_view_is_scored_on_the_mean_color(capture):
    frame = capture.stream_frame(StreamConfig(), (0, 1, 3, 4))
    view = score_view(gaussians([[0.2, 0.4, 0.6]], [0.9]), capture, 0, frame, {})
    score, color, depth = view.score, view.color, view.depth
    np.testing.assert_allclose(color, np.broadcast_to([0.2, 0.4, 0.6], color.shape), atol=1e-6)
    target = capture.image(0)
    assert score.shown.psnr == pytest.approx(psnr(color, target)) and score.coverage == 0 and not depth.any()
    assert score.literal.psnr == pytest.approx(psnr(np.zeros_like(target), target))
    assert score.literal.ssim == pytest.approx(ssim(np.zeros_like(target), target))
    assert score.shown.lpips is None and score.literal.lpips is None


def test_a_novel_view_has_the_mean_exposure_of_its_neighbors(capture):
    frame, scene = capture.stream_frame(StreamConfig(), (0, 1, 3, 4)), gaussians([[0.2, 0.4, 0.6]], [0.9])
    told = {0: [9, 9, 9], 1: [0.5, 1, 2], 3: [0.5, 1, 1], 4: [1, 1, 4]}
    exposures = {i: np.array(e, np.float64) for i, e in told.items()}
    assert nearest_views(capture, 2, tuple(exposures))[-1] == 0  # three are averaged
    view = score_view(scene, capture, 2, frame, exposures)
    score, color = view.score, view.color
    wanted = [0.2 * 0.25 ** (1 / 3), 0.4, 1.0]  # 1.2 is clipped
    np.testing.assert_allclose(color, np.broadcast_to(wanted, color.shape), atol=1e-6)
    assert score.shown.psnr == pytest.approx(psnr(color, capture.image(2)))
    color = score_view(scene, capture, 4, frame, exposures).color  # a streamed view has its own
    np.testing.assert_allclose(color, np.broadcast_to([0.2, 0.4, 1.0], color.shape), atol=1e-6)


def test_literal_scores_are_at_the_middle_exposure_over_black(capture):
    """As in the files that are written of the scene."""
    frame, scene = capture.stream_frame(StreamConfig(), (0, 1, 3, 4)), gaussians([[0.2, 0.4, 0.6]], [0.9], 2.0)
    scene = replace(scene, scales=jnp.ones((1, 3)))
    exposures = {i: np.array(e, np.float64) for i, e in {0: [9, 9, 9], 1: [0.5, 1, 2], 3: [0.5, 1, 1]}.items()}
    color = np.asarray(ss.render(scene, capture.camera(0, frame)).color) * [0.5, 1.0, 2.0]
    score = score_view(scene, capture, 0, frame, exposures).score
    assert score.coverage > 0.1
    assert score.literal.psnr == pytest.approx(psnr(np.clip(color, 0, 1), capture.image(0)), abs=0.01)


def test_nearness_counts_centers_and_angles(capture):
    """By the extent, 2 here, of the candidates: half of it is as far as a turn by half a radian."""
    poses = np.tile(np.eye(4), (5, 1, 1))
    poses[1:3, 0, 3] = 2.0, 0.5
    poses[3:, :3, :3] = [rodrigues([0, 1, 0], angle) for angle in (0.4, 1.3)]
    assert nearest_views(with_poses(capture, poses), 0, (1, 2, 3, 4)) == [2, 3, 1, 4]  # 0.25, 0.4, 1.0, 1.3


def test_the_baselines_copy_the_nearest_view_and_show_the_mean_color(capture):
    found = baselines(capture, Split("given", context=(0, 4), targets=(1, 3)))
    copies = [psnr(capture.image(near), capture.image(i)) for near, i in ((0, 1), (4, 3))]
    assert found["nearest_view_psnr"] == pytest.approx(np.mean(copies), abs=1e-4)
    mean = np.mean([capture.image(0), capture.image(4)], axis=(0, 1, 2))
    flats = [psnr(np.broadcast_to(mean, capture.image(i).shape).astype(np.float32), capture.image(i)) for i in (1, 3)]
    assert found["mean_color_psnr"] == pytest.approx(np.mean(flats), abs=1e-4)
