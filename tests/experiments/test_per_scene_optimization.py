"""Laws of per-scene optimization: what densification keeps, adds and removes, and that a made scene improves."""

import dataclasses
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from ssplat_experiments.densification import densified, maintained, with_opacities_reset
from ssplat_experiments.per_scene_optimization import EFFECTS, camera_extent, optimize, view_space_lengths
from ssplat_experiments.scene_state import Parameters, SceneState, scene_of, start_state
from ssplat_experiments.sparse_points import gaussians_of_points, random_points, triangulated_points
from ssplat_experiments.splatting_config import SplattingConfig

from ssplat_jax.cache.key_views import KeyViews
from ssplat_jax.config import preset
from ssplat_jax.core.cameras import Camera
from ssplat_jax.core.gaussians import SH_C0, Gaussians
from ssplat_jax.core.pytree import replace
from ssplat_jax.data.open_capture import open_capture
from ssplat_jax.evaluation.psnr_ssim import psnr
from ssplat_jax.rasterizer import render

CONFIG = SplattingConfig(capacity=64, first_rows=16)
EXTENT = 2.0
SMALL, LARGE = 0.5 * CONFIG.small_scale * EXTENT, 3 * CONFIG.small_scale * EXTENT


def made_state(
    count: int = 10, *, steep: tuple[int, ...] = (), large: tuple[int, ...] = (), faint: tuple[int, ...] = ()
):
    """Gaussians in a row, of which some have a gradient above the threshold, are large, or nearly transparent."""
    number = np.arange(count)
    gaussians = Gaussians.from_rgb(
        means=jnp.stack([jnp.arange(count, dtype=jnp.float32), *[jnp.zeros(count)] * 2], axis=1),
        quats=jnp.tile(jnp.array([1.0, 0, 0, 0]), (count, 1)),
        scales=jnp.where(np.isin(number, large), LARGE, SMALL)[:, None] * jnp.array([1.0, 0.5, 0.1]),
        opacities=jnp.where(np.isin(number, faint), 0.5 * CONFIG.min_opacity, 0.5),
        colors=jnp.full((count, 3), 0.3),
    )
    state = start_state(gaussians, CONFIG)
    # Ten views saw each; the mean is above the threshold by a factor that grows with the row.
    sums = 10 * CONFIG.gradient_threshold * np.where(np.isin(number, steep), 1.1 + 0.1 * number, 0.9)
    ones = jax.tree.map(jnp.ones_like, state.first_moment)
    return replace(
        state,
        gradient_sums=jnp.asarray(sums, jnp.float32),
        num_seen=jnp.full(count, 10, jnp.int32),
        first_moment=ones,
        second_moment=ones,
    )


def dense(state, config=CONFIG, *, remove_large: bool = False) -> SceneState:
    return densified(state, EXTENT, config, np.random.default_rng(0), remove_large=remove_large)


def present(state) -> Parameters:
    count = int(np.sum(np.asarray(state.is_present)))
    assert np.asarray(state.is_present)[:count].all()
    return jax.tree.map(lambda x: np.asarray(x)[:count], state.parameters)


def test_without_a_steep_or_faint_row_nothing_changes():
    state = made_state()
    before, after = present(state), present(dense(state))
    for a, b in zip(jax.tree.leaves(before), jax.tree.leaves(after), strict=True):
        np.testing.assert_array_equal(a, b)


def test_a_small_steep_row_is_cloned():
    after = dense(made_state(steep=(4,)))
    rows = present(after)
    assert len(rows.means) == 11 and after.is_present.shape == (16,)
    for part in jax.tree.leaves(rows):
        np.testing.assert_array_equal(part[10], part[4])
    for moments in (after.first_moment, after.second_moment):
        assert not any(np.any(x[10]) for x in jax.tree.leaves(moments))
        assert all(np.all(np.asarray(x[:10]) == 1) for x in jax.tree.leaves(moments))
    assert not np.any(after.gradient_sums) and not np.any(after.num_seen)


def test_a_large_steep_row_becomes_two_smaller_ones_inside_it():
    draws = []
    for seed in range(60):
        after = densified(
            made_state(steep=(4,), large=(4,)), EXTENT, CONFIG, np.random.default_rng(seed), remove_large=False
        )
        rows = present(after)
        assert len(rows.means) == 11 and not np.any(np.all(rows.means == [4, 0, 0], axis=1))
        np.testing.assert_allclose(
            np.exp(rows.log_scales[-2:]), LARGE * np.array([[1.0, 0.5, 0.1]] * 2) / CONFIG.split_factor, rtol=1e-5
        )
        np.testing.assert_array_equal(rows.sh[-2:], np.asarray(made_state().parameters.sh)[[4, 4]])
        draws.append(rows.means[-2:] - [4, 0, 0])
    spread = np.concatenate(draws).std(axis=0)
    np.testing.assert_allclose(spread, LARGE * np.array([1.0, 0.5, 0.1]), rtol=0.25)


def test_the_spread_of_a_split_turns_with_the_gaussian():
    quat = np.array([np.cos(np.pi / 4), 0, 0, np.sin(np.pi / 4)], np.float32)  # x -> y
    state = made_state(steep=(4,), large=(4,))
    state = replace(state, parameters=replace(state.parameters, quats=state.parameters.quats.at[4].set(3 * quat)))
    draws = [
        present(densified(state, EXTENT, CONFIG, np.random.default_rng(seed), remove_large=False)).means[-2:]
        for seed in range(60)
    ]
    spread = np.concatenate(draws).std(axis=0)
    np.testing.assert_allclose(spread, LARGE * np.array([0.5, 1.0, 0.1]), rtol=0.25)


def test_faint_rows_are_removed_and_large_ones_after_the_reset():
    enormous = made_state(faint=(2, 3))
    scales = enormous.parameters.log_scales.at[7, 1].set(np.log(1.1 * CONFIG.max_scale * EXTENT))
    enormous = replace(enormous, parameters=replace(enormous.parameters, log_scales=scales))
    assert present(dense(enormous)).means[:, 0].tolist() == [0, 1, 4, 5, 6, 7, 8, 9]
    assert present(dense(enormous, remove_large=True)).means[:, 0].tolist() == [0, 1, 4, 5, 6, 8, 9]


def test_rows_stay_within_the_capacity_and_the_steepest_are_densified():
    config = dataclasses.replace(CONFIG, capacity=13, first_rows=4)
    steep, large = tuple(range(10)), (1, 3, 5, 7, 8)
    after = dense(made_state(steep=steep, large=large), config)
    rows = present(after).means[:, 0]
    # There is space for three more: row 9 is cloned, rows 8 and 7 are split.
    assert len(rows) == 13 and np.sum(rows == 9) == 2
    assert not np.isin([7, 8], rows).any() and np.isin(np.arange(7), rows).all()
    full = replace(after, gradient_sums=jnp.where(after.is_present, 1.0, 0.0), num_seen=after.num_seen + 1)
    np.testing.assert_array_equal(present(dense(full, config)).means[:, 0], rows)


def test_opacities_are_reset_from_above_only():
    state = made_state(faint=(2,))
    after = with_opacities_reset(state, CONFIG)
    opacities = np.asarray(scene_of(after.parameters, after.is_present).opacities)
    np.testing.assert_allclose(opacities, np.where(np.arange(10) == 2, 0.5 * CONFIG.min_opacity, 0.01), rtol=1e-4)
    assert not np.any(after.first_moment.logit_opacities) and np.all(after.first_moment.means == 1)


def test_the_schedule_is_the_published_one():
    state, rng = made_state(steep=(4,)), np.random.default_rng(0)
    num_rows = lambda steps: len(present(maintained(state, steps, EXTENT, CONFIG, rng)).means)  # noqa: E731
    assert [num_rows(steps) for steps in (500, 599, 600, 650, 15_000, 15_100)] == [10, 10, 11, 10, 11, 10]
    reset = lambda steps: present(maintained(state, steps, EXTENT, CONFIG, rng)).logit_opacities.max() < -4  # noqa: E731
    assert [reset(steps) for steps in (2900, 3000, 3100, 6000, 18_000)] == [False, True, False, True, False]


def test_view_space_lengths_are_those_of_the_gradient_by_the_place_on_the_screen():
    """The gradient of weights * (fx x / z, fy y / z) by the place on the screen is the weights, in pixels."""
    rng = np.random.default_rng(1)
    focal, weights = np.array([50.0, 60.0]), rng.normal(size=(20, 2))
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn * np.sign(np.linalg.det(turn)), (0.2, -0.1, 0.4)
    seen = rng.normal(size=(20, 3)) * [0.5, 0.5, 0.3] + [0, 0, 3]
    along = -np.sum(weights * focal * seen[:, :2], axis=1, keepdims=True) / seen[:, 2:] ** 2
    gradient = np.concatenate([weights * focal / seen[:, 2:], along], axis=1) @ pose[:3, :3]
    means = (seen - pose[:3, 3]) @ pose[:3, :3]
    K = np.array([[focal[0], 0, 20], [0, focal[1], 12], [0, 0, 1]])
    camera = Camera(jnp.asarray(pose[None], jnp.float32), jnp.asarray(K[None], jnp.float32), 40, 24)
    views = KeyViews.of(camera, jnp.zeros((1, 24, 40, 3)))
    found = view_space_lengths(jnp.asarray(means, jnp.float32), jnp.asarray(gradient, jnp.float32), views, jnp.int32(0))
    np.testing.assert_allclose(found, np.linalg.norm(weights * [20, 12], axis=1), rtol=1e-4)


def test_the_extent_is_that_of_the_cameras():
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, :3, 3] = -np.array([[0, 0, 0], [3.0, 0, 0], [0, 3.0, 0]])
    centers = np.array([[0, 0], [3.0, 0], [0, 3.0]])
    wanted = 1.1 * np.linalg.norm(centers - centers.mean(axis=0), axis=1).max()
    assert camera_extent(jnp.asarray(poses, jnp.float32)) == pytest.approx(wanted)


NUM_ROWS = 128
"""Rows of the made scene, so that one program renders it and every state of its optimization."""


def made_views() -> tuple[np.ndarray, KeyViews]:
    """Places on a painted wall of 8 x 6 Gaussians, and three views of it."""
    x, y = (part.reshape(-1) for part in np.meshgrid(np.linspace(-1, 1, 8), np.linspace(-0.75, 0.75, 6)))
    places = np.stack([x, y, np.full_like(x, 2.0)], axis=1)
    colors = np.stack([0.5 + 0.4 * np.sin(4 * x), 0.5 + 0.4 * np.cos(5 * y), 0.5 + 0.4 * np.sin(3 * (x + y))], axis=1)
    pad = lambda rows: jnp.asarray(np.pad(rows, [(0, NUM_ROWS - len(x)), (0, 0)]), jnp.float32)  # noqa: E731
    sh = jnp.zeros((NUM_ROWS, 4, 3)).at[:, :1].set(((pad(colors) - 0.5) / SH_C0)[:, None])
    wall = Gaussians(
        means=pad(places),
        quats=jnp.tile(jnp.array([1.0, 0, 0, 0]), (NUM_ROWS, 1)),
        scales=jnp.full((NUM_ROWS, 3), 0.15),
        opacities=jnp.where(jnp.arange(NUM_ROWS) < len(x), 0.95, 0.0),
        sh=sh,
    )
    viewmats = np.tile(np.eye(4, dtype=np.float32), (3, 1, 1))
    viewmats[:, 0, 3] = (-0.3, 0.0, 0.3)
    K = np.array([[24.0, 0, 16], [0, 24.0, 12], [0, 0, 1]], np.float32)
    cameras = Camera(jnp.asarray(viewmats), jnp.asarray(np.tile(K, (3, 1, 1))), 32, 24)
    return places, KeyViews.of(cameras, jnp.stack([render(wall, cameras[i], effects=EFFECTS).color for i in range(3)]))


@pytest.mark.slow
@pytest.mark.usefixtures("compiled_plainly")
def test_a_made_scene_improves_while_it_is_densified():
    places, views = made_views()
    points = places + np.random.default_rng(0).normal(size=places.shape) * 0.05
    start = gaussians_of_points((points, np.full(places.shape, 0.5)))
    config = SplattingConfig(
        densify_every=20, densify_from=20, sh_degree=1, steps_per_band=40, first_rows=NUM_ROWS, capacity=90
    )

    def score(scene):
        color = render(scene, views.camera(1), effects=EFFECTS).color
        return psnr(np.clip(np.asarray(color), 0, 1), np.asarray(views.images[1]) / np.float32(255))

    scores, counts, bands = {}, [], []
    for steps, state in enumerate(itertools.islice(optimize(start, views, config), 120), start=1):
        counts.append(int(np.sum(np.asarray(state.is_present))))
        bands.append(bool(np.any(np.asarray(state.parameters.sh[:, 1:]))))
        if steps in (1, 60, 120):
            scores[steps] = score(scene_of(state.parameters, state.is_present))
    assert scores[60] > scores[1] + 3 and scores[120] > scores[60] + 1
    assert max(counts) <= 90 and counts[-1] > 48
    assert not any(bands[:40]) and bands[-1]  # the next band is learned after 40 steps


def test_random_points_lie_between_near_and_far_of_their_views():
    capture, views = open_capture("procedural:room?frames=24", size=(64, 48)), range(0, 24, 4)
    frame = capture.stream_frame(preset("tiny"), views)
    places, colors = random_points(capture, views, frame, 500)
    pose = np.asarray(capture.camera(0, frame).viewmats, np.float64)
    depths = (places[:84] @ pose[:3, :3].T + pose[:3, 3])[:, 2]  # the share of the first view
    assert len(places) == 500 and frame.near * 0.99 < depths.min() < depths.max() < frame.far * 1.01
    assert colors.min() >= 0 and colors.max() <= 1


@pytest.mark.slow
def test_triangulated_points_lie_on_the_surfaces():
    capture, views = open_capture("procedural:room?frames=73", size=(160, 120)), range(6)
    frame = capture.stream_frame(preset("tiny"), views)
    places, colors = triangulated_points(capture, views, frame)
    assert len(places) > 100 and colors.min() >= 0 and colors.max() <= 1
    errors = []
    for i in views:
        camera, depth = capture.camera(i, frame), capture.depth(i)
        assert depth is not None
        pose, K = np.asarray(camera.viewmats, np.float64), np.asarray(camera.Ks, np.float64)
        points = places @ pose[:3, :3].T + pose[:3, 3]
        pixels = (points @ K.T)[:, :2] / points[:, 2:]
        inside = (points[:, 2] > 0) & np.all((pixels >= 0) & (pixels < [160, 120]), axis=1)
        columns, rows = pixels[inside].astype(int).T
        errors.append(points[inside, 2] / (frame.scale * depth[rows, columns]) - 1)
    assert np.median(np.abs(np.concatenate(errors))) < 0.05
