"""Laws of a learned pass, with the shipped network and with one that is drawn at random."""

import dataclasses
import functools
import importlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ssplat_jax.cache.changes import apply_change, no_change
from ssplat_jax.core.gaussians import SH_C0, Gaussians
from ssplat_jax.core.pytree import replace
from ssplat_jax.core.rotations import quats_to_matrices
from ssplat_jax.rasterizer import render
from ssplat_jax.refinement import RefineConfig, init_refinement
from ssplat_jax.refinement.compared_views import EFFECTS
from ssplat_jax.refinement.learned_pass import (
    LARGEST,
    MIN_PIXELS,
    STEPS,
    add_view,
    init_refiner,
    is_learned,
    learned_change,
    learned_pass,
    load_refiner,
    no_errors,
    refiner_features,
    save_refiner,
)
from ssplat_jax.refinement.refine import continue_refinement, report_of, start_refinement
from ssplat_jax.refinement.refine_step import sizes
from tests.refinement.test_refine import (
    CONFIG,
    FIELDS,
    MAX_PAIRS,
    NUM,
    NUM_VIEWS,
    assert_same_bits,
    cameras,
    current,
    doubtful,
    key_views,
    photographs,
)

module = importlib.import_module("ssplat_jax.refinement.refine")
PASSES = dataclasses.replace(CONFIG, learned_passes=3)
PASS = jax.jit(learned_pass, static_argnames=("config", "max_pairs"))
ADD = jax.jit(add_view, static_argnames=("config", "max_pairs"))


@functools.cache
def drawn() -> dict:
    """A network whose last layers are random too, so that every output depends on every input."""
    leaves, tree = jax.tree.flatten(init_refiner(3))
    keys = jax.random.split(jax.random.key(4), len(leaves))
    noisy = [x + 0.3 * jax.random.normal(key, x.shape) for x, key in zip(leaves, keys, strict=True)]
    return jax.tree.unflatten(tree, noisy)


def one_pass(gaussians, views=None, refiner=None, config=CONFIG):
    state = init_refinement(gaussians, config)
    views = key_views() if views is None else views
    return PASS(state, views, load_refiner() if refiner is None else refiner, config=config, max_pairs=MAX_PAIRS)


def seen_by(gaussians: Gaussians, views, order=range(NUM_VIEWS), config=CONFIG):
    seen = no_errors(gaussians)
    for view in order:
        seen, _ = ADD(seen, gaussians, no_change(gaussians), views, jnp.int32(view), config=config, max_pairs=MAX_PAIRS)
    return seen


def test_a_pass_that_does_not_help_is_taken_back():
    """Blobs before black are unlike the scenes that the network has learned from."""
    state, report = one_pass(doubtful())
    assert_same_bits(current(state), doubtful())
    assert report.loss.shape == (STEPS,) and int(state.num_steps) == int(state.num_skipped) == STEPS
    tried = learned_change(load_refiner(), doubtful(), seen_by(doubtful(), key_views()))
    error = lambda g: float(jnp.abs(render(g, cameras(), max_pairs=MAX_PAIRS).color - photographs()).mean())  # noqa: E731
    assert error(apply_change(doubtful(), tried)) > error(doubtful())


def small_steps() -> dict:
    """A network that changes colors alone, by small steps against the gradient."""
    idle = jax.tree.map(jnp.zeros_like, init_refiner())
    return {**idle, "gains": {**idle["gains"], "bias": idle["gains"]["bias"].at[8:11].set(0.02)}}


def test_no_pass_follows_on_one_that_was_taken_back():
    progress, views = start_refinement(doubtful(), key_views(), PASSES)
    counts = [progress.num_steps for _ in continue_refinement(progress, views, 2 * STEPS, PASSES)]
    assert counts == list(range(STEPS, 2 * STEPS + 1)) and int(progress.state.num_skipped) == STEPS


def test_sums_over_all_gaussians_are_sums_over_pixels():
    """A pixel is divided among its Gaussians by their weights, which add up to alpha."""
    gaussians = doubtful()
    seen = seen_by(gaussians, key_views())
    out = render(gaussians, cameras(), effects=EFFECTS, max_pairs=MAX_PAIRS)
    alpha = np.asarray(out.alpha, np.float64)
    target = np.asarray(key_views().images, np.float64) / 255  # as stored: rounded to bytes
    black = np.asarray(out.color, np.float64) - target
    assert float(seen.pixels.sum()) == pytest.approx(alpha.sum(), rel=1e-4)
    assert float(seen.errors.sum()) == pytest.approx((alpha * np.abs(black).mean(-1)).sum(), rel=1e-4)
    assert float(seen.signed.sum()) == pytest.approx(
        (alpha * np.clip(black / 0.1, -1, 1).mean(-1)).sum(), rel=1e-3, abs=1e-2
    )


def test_gradients_are_those_of_a_huber_error():
    """Finite differences of the error in float64, by the place of one Gaussian and by its color."""
    gaussians, views = doubtful(), key_views()
    seen = seen_by(gaussians, views)
    target = np.asarray(views.images, np.float64) / 255

    def error(g: Gaussians) -> float:
        color = np.asarray(render(g, cameras(), effects=EFFECTS, max_pairs=MAX_PAIRS).color, np.float64) - target
        size = np.abs(color)
        return float(np.where(size < 0.1, size**2 / 0.2, size - 0.05).sum())

    row = int(np.argmax(np.asarray(seen.pixels)))
    axes, size = np.asarray(quats_to_matrices(gaussians.quats[row])), float(sizes(gaussians)[row])
    for axis in range(3):
        move = jnp.asarray(axes[:, axis]) * size * 0.02
        ahead, behind = (replace(gaussians, means=gaussians.means.at[row].add(s * move)) for s in (1, -1))
        wanted = (error(ahead) - error(behind)) / 0.04
        assert float(seen.gradients["means"][row, axis]) == pytest.approx(wanted, rel=0.1, abs=0.1)
    ahead, behind = (replace(gaussians, sh=gaussians.sh.at[row, 0, 1].add(s * 0.01 / SH_C0)) for s in (1, -1))
    wanted = (error(ahead) - error(behind)) / 0.02
    assert float(seen.gradients["colors"][row, 1]) == pytest.approx(wanted, rel=0.02, abs=0.02)


def test_a_turned_world_gets_the_same_change_turned():
    """The network sees places in each Gaussian's own axes: it has no notion of up."""
    turn = np.asarray(quats_to_matrices(jnp.array([0.8, 0.3, -0.4, 0.2])), np.float64)
    quat = jnp.array([0.8, 0.3, -0.4, 0.2]) / np.linalg.norm([0.8, 0.3, -0.4, 0.2])
    given = doubtful()
    w, x, y, z = quat
    left = jnp.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])
    turned = replace(given, means=given.means @ jnp.asarray(turn.T, jnp.float32), quats=given.quats @ left.T)
    views = key_views()
    inverse = np.eye(4)
    inverse[:3, :3] = turn.T
    turned_views = replace(views, viewmats=views.viewmats @ jnp.asarray(inverse, jnp.float32))
    plain = learned_change(drawn(), given, seen_by(given, views))
    other = learned_change(drawn(), turned, seen_by(turned, turned_views))
    assert float(jnp.abs(plain.means).max()) > 0.01
    np.testing.assert_allclose(np.asarray(other.means), np.asarray(plain.means) @ turn.T, atol=5e-3)
    for name in ("log_scales", "logit_opacities", "sh"):
        np.testing.assert_allclose(getattr(other, name), getattr(plain, name), atol=2e-2, err_msg=name)


def test_changes_are_bounded_and_hidden_gaussians_do_not_change():
    hidden = replace(doubtful(), means=doubtful().means.at[:12, 2].multiply(-1))  # behind the cameras
    change = learned_change(jax.tree.map(lambda x: 30 * x, drawn()), hidden, seen_by(hidden, key_views()))
    stays = (np.arange(NUM) < 12) | (np.asarray(hidden.opacities) == 0)
    assert all(not np.asarray(leaf)[stays].any() for leaf in jax.tree.leaves(change))
    tops = {
        "means": np.nanmax(np.linalg.norm(np.asarray(change.means), axis=1) / np.sqrt(3) / np.asarray(sizes(hidden))),
        "quats": np.abs(np.asarray(change.quats)).max(),
        "log_scales": np.abs(np.asarray(change.log_scales)).max(),
        "logit_opacities": np.abs(np.asarray(change.logit_opacities)).max(),
        "colors": SH_C0 * np.abs(np.asarray(change.sh[:, 0])).max(),
    }
    for name, top in tops.items():
        assert 0.1 * LARGEST[name] < top <= LARGEST[name] * (1 + 1e-5), name


def test_a_pass_that_is_not_finite_changes_only_its_counts():
    state, report = one_pass(doubtful(), key_views(exposures=jnp.full((NUM_VIEWS, 3), jnp.nan)))
    assert_same_bits(current(state), doubtful())
    assert int(state.num_skipped) == int(state.num_steps) == STEPS
    assert not np.isfinite(report.loss).any()


def test_ten_thousand_extreme_gaussians_make_no_update_that_is_not_finite():
    random, n = np.random.default_rng(0), 10_000
    wide = lambda low, high, *shape: jnp.asarray(10 ** random.uniform(low, high, (n, *shape)), jnp.float32)  # noqa: E731
    given = Gaussians(
        means=jnp.asarray(random.normal(size=(n, 3)) * (1, 1, 0) + (0, 0, 1), jnp.float32) * wide(-3, 3, 1),
        quats=jnp.asarray(random.normal(size=(n, 4)), jnp.float32) * wide(-6, 6, 1),
        scales=wide(-8, -1, 3) * wide(0, 1, 1),
        opacities=jnp.asarray(random.choice([0.0, 1e-6, 0.5, 1 - 1e-7, 1.0], n), jnp.float32),
        sh=jnp.asarray(random.normal(size=(n, 4, 3)) * 10 ** random.uniform(-3, 3, (n, 1, 1)), jnp.float32),
    )
    config = dataclasses.replace(CONFIG, sh_degree=1)
    seen = no_errors(given)
    add = jax.jit(add_view, static_argnames=("config", "max_pairs"))
    for view in range(2):
        none = no_change(given)
        seen, _ = add(seen, given, none, key_views(), jnp.int32(view), config=config, max_pairs=1 << 20)
    for refiner in (load_refiner(), drawn()):
        change = learned_change(refiner, given, seen)
        assert all(np.isfinite(np.asarray(leaf)).all() for leaf in jax.tree.leaves(change))
    assert (np.asarray(seen.pixels) >= MIN_PIXELS).sum() > 20
    features = refiner_features(given, seen, seen.gradients)
    assert np.isfinite(np.asarray(features)).all()


def test_passes_come_first_and_count_as_their_steps(monkeypatch):
    monkeypatch.setattr(module, "load_refiner", small_steps)
    progress, views = start_refinement(doubtful(), key_views(), PASSES)
    steps = continue_refinement(progress, views, 2 * STEPS + 2, PASSES)
    counts = [progress.num_steps for _ in steps]
    assert counts == [STEPS, 2 * STEPS, 2 * STEPS + 1, 2 * STEPS + 2]
    assert len(progress.losses) == len(progress.held_back) == len(progress.seconds) == 2 * STEPS + 2
    assert not is_learned(0, STEPS - 1, PASSES) and not is_learned(3 * STEPS, 100, PASSES)
    assert is_learned(2 * STEPS, 100, PASSES) and not is_learned(0, 100, RefineConfig())


@pytest.mark.parametrize(
    ("learned", "taken", "expected"),
    [([9.0], [], 0.0), ([9.0, 1.0], [7.0, 3.0, 4.0], 1.0), ([], [7.0, 3.0, 4.0], 3.5), ([], [7.0], 0.0)],
    ids=str,
)
def test_the_time_of_a_step_leaves_out_the_first_of_each_kind(learned, taken, expected):
    """The first pass and the first gradient step compile; a pass counts as its steps."""
    progress, views = start_refinement(doubtful(), key_views(), PASSES)
    progress.num_learned = STEPS * len(learned)
    progress.seconds = [second for second in learned for _ in range(STEPS)] + taken
    progress.losses = progress.held_back = [0.1] * len(progress.seconds)
    assert report_of(progress, views).seconds_per_step == expected


def test_a_file_returns_what_was_saved(tmp_path):
    save_refiner(tmp_path / "refiner.npz", drawn(), {"steps": 1})
    jax.tree.map(np.testing.assert_array_equal, load_refiner(tmp_path / "refiner.npz"), drawn())


def test_a_pass_on_float32_is_the_same_under_enable_x64():
    given = doubtful(), key_views(), small_steps()
    wanted, _ = one_pass(*given)
    with jax.enable_x64(True):
        got, _ = one_pass(*given)
    for name in FIELDS:
        found = getattr(current(got), name)
        assert found.dtype == jnp.float32
        np.testing.assert_allclose(found, getattr(current(wanted), name), rtol=1e-6, atol=1e-6)
