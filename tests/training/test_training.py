"""Training with the smallest recipe: it is reproducible and resumable."""

import dataclasses
import json
import time
from importlib import resources
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ssplat_jax.cache import Tokens
from ssplat_jax.commands.train_command import Train, _rendering_loss
from ssplat_jax.config import MEDIAN_DEPTH, preset
from ssplat_jax.core.errors import InputError
from ssplat_jax.core.pytree import replace
from ssplat_jax.data.depth_range import FAR_FACTOR
from ssplat_jax.data.procedural.procedural_views import training_sample
from ssplat_jax.model import init_params
from ssplat_jax.model.streamsplat import StreamSplat
from ssplat_jax.storage.saved_states import TrainingCheckpoints
from ssplat_jax.storage.weights import describe_weights, load_params, params_digest, save_weights, stage_turns
from ssplat_jax.training import loop
from ssplat_jax.training import step as train_step
from ssplat_jax.training.losses import depth_loss, image_gradient_l1, soft_targets
from ssplat_jax.training.recipe import (
    ALL_BUT_HEAD,
    DEFAULT_FORM,
    MATCHER_STAGES,
    RECIPES,
    Phase,
    PhaseForm,
    smoke_recipe,
    training_config,
)
from ssplat_jax.training.samples import log_depths_at_cells, make_sample, prefetched
from ssplat_jax.training.step import (
    Trainer,
    decode_accepted,
    init_state,
    learning_rate,
    loss_fn,
    pad_like,
    scale_parts,
    stream_chunks,
)
from ssplat_jax.training.step_samples import batch_for_step, sample_for_step
from tests.model.small import random_params
from tests.streaming.narrow_model import NARROW

RECIPE = smoke_recipe(4)
SHIPPED = Path(str(resources.files("ssplat_jax") / "weights" / "tiny.npz"))
WIDTH = RECIPE.depth_target_width


@pytest.fixture(autouse=True)
def standard_promotion():
    """Allows type promotion: optax raises a float to an int32 power in Adam's bias correction."""
    with jax.numpy_dtype_promotion("standard"):
        yield


def flat(tree):
    return [np.asarray(x) for x in jax.tree.leaves(tree)]


def test_sample_is_a_function_of_its_seed():
    arguments = {"num_chunks": 2, "num_targets": 1, "size": (64, 64), "config": NARROW}
    for a, b in zip(flat(make_sample(3, **arguments)), flat(make_sample(3, **arguments)), strict=True):
        np.testing.assert_array_equal(a, b)
    other = make_sample(4, **arguments)
    assert not np.array_equal(np.asarray(other.target_images), np.asarray(make_sample(3, **arguments).target_images))


def test_sample_starts_at_the_origin_with_depths_in_range():
    sample = make_sample(5, num_chunks=2, num_targets=2, size=(64, 64), config=NARROW)
    np.testing.assert_allclose(np.asarray(sample.chunks.viewmats[0, 0]), np.eye(4), atol=1e-6)
    inside = (sample.log_depths > jnp.log(sample.chunks.near[0])) & (sample.log_depths < jnp.log(sample.chunks.far[0]))
    assert float(inside.mean()) > 0.97  # the margins exclude at most the tails beyond the 1 % quantiles


def test_true_depth_of_a_cell_is_that_at_its_center():
    # A plane in log depth: a cell's center is the common corner of its pixels 1 and 2, at (2, 2).
    y, x = np.mgrid[0:8, 0:12] + 0.5
    logs = 0.01 * y - 0.005 * x
    centers_y, centers_x = np.mgrid[0:2, 0:3] * 4.0 + 2.0
    found = log_depths_at_cells(np.exp(logs))
    np.testing.assert_allclose(found, 0.01 * centers_y - 0.005 * centers_x, atol=1e-6)
    # A depth edge through the center: one of the two surfaces, never a depth between them.
    logs[:, 6:] += 1.0
    assert np.abs(log_depths_at_cells(np.exp(logs))[:, 1] - found[:, 1] - 1.0).max() < 0.02


def test_other_recipe_is_refused_by_its_first_difference(tmp_path):
    description = {"config": {"width": 8}, "recipe": {"phases": [{"steps": 5}], "seed": 0}}
    TrainingCheckpoints(tmp_path, description)
    other = {"config": {"width": 8}, "recipe": {"phases": [{"steps": 6}], "seed": 0}}
    with pytest.raises(InputError, match=r"recipe\.phases\[0\]\.steps = 5, wanted 6"):
        TrainingCheckpoints(tmp_path, other)


def test_a_run_that_began_with_other_weights_is_refused(tmp_path):
    config = training_config(NARROW, RECIPE)
    first, other = ({"encoder": {"kernel": jnp.full((2, 2), x)}} for x in (1.0, 2.0))
    held = loop.describe_run(config, RECIPE, params_digest(first))
    TrainingCheckpoints(tmp_path, held)
    for params in (other, None):
        with pytest.raises(InputError, match="holds a run with init_weights = "):
            loop.train(NARROW, RECIPE, tmp_path, params=params)
    with pytest.raises(InputError, match=f"{params_digest(first)}', wanted 'mine'"):
        loop.train(NARROW, RECIPE, tmp_path, params=first, init_weights="mine")
    TrainingCheckpoints(tmp_path / "2", loop.describe_run(config, RECIPE, loop.RANDOM))
    with pytest.raises(InputError, match=f"init_weights = 'random', wanted '{params_digest(first)}'"):
        loop.train(NARROW, RECIPE, tmp_path / "2", params=first)


def test_prefetch_keeps_order_and_raises_errors():
    def slow_at_first(i):
        time.sleep(0.05 * (i == 0))
        return i * i

    for workers in (1, 3):
        assert list(prefetched(slow_at_first, range(9), workers)) == [(i, i * i) for i in range(9)]

    def fail(i):
        if i == 2:
            raise ValueError("third")
        return i

    with pytest.raises(ValueError, match="third"):
        list(prefetched(fail, range(5)))


def test_prefetch_makes_no_more_than_two_steps_a_worker_ahead():
    made = []
    steps = prefetched(made.append, range(100), workers=2)
    next(steps)
    time.sleep(0.2)  # time for the threads to go further than they may
    assert len(made) <= 5
    steps.close()


def test_soft_targets_and_loss_agree_on_the_truth():
    candidates = jnp.linspace(0.0, 2.0, 21)
    truth = jnp.full((1, 2, 2), 0.7)
    target = soft_targets(truth, candidates, WIDTH)
    np.testing.assert_allclose(np.asarray(target.sum(-1)), 1.0, atol=1e-6)
    assert int(jnp.argmax(target[0, 0, 0])) == 7
    usable = jnp.ones((1, 2, 2), bool)

    def at(k):
        logits = 20.0 * jax.nn.one_hot(jnp.full((1, 2, 2), k), 21)
        return float(depth_loss(logits, truth, truth, candidates, usable, target_width=WIDTH)[0])

    assert at(7) < at(6) < at(5)


def test_cells_out_of_range_do_not_count_in_the_depth_loss():
    candidates = jnp.linspace(0.0, 1.0, 5)
    truth = jnp.array([[[0.5, 3.0]]])
    logits = jnp.zeros((1, 1, 2, 5))
    usable = jnp.ones((1, 1, 2), bool)
    loss = lambda x: sum(depth_loss(x, truth, truth, candidates, usable, target_width=WIDTH))  # noqa: E731
    gradient = jax.grad(loss)(logits)
    assert float(jnp.abs(gradient[0, 0, 0]).max()) > 0
    assert float(jnp.abs(gradient[0, 0, 1]).max()) == 0


def test_unusable_cells_have_neither_value_nor_gradient_in_the_depth_loss():
    rng = np.random.default_rng(0)
    candidates, truth = jnp.linspace(0.0, 1.0, 5), jnp.asarray(rng.uniform(0.1, 0.9, (1, 2, 3)), jnp.float32)
    logits = jnp.asarray(rng.normal(size=(1, 2, 3, 5)), jnp.float32)
    predicted, usable = truth + 0.2, jnp.array([[[True, False, True], [False, True, True]]])

    def loss(logits, predicted, truth, usable):
        return sum(depth_loss(logits, predicted, truth, candidates, usable, target_width=WIDTH))

    value, gradients = jax.value_and_grad(loss, argnums=(0, 1))(logits, predicted, truth, usable)
    # As if those cells did not exist: the mean is over the others.
    kept = np.asarray(usable)
    alone = loss(*(x[kept][None, None] for x in (logits, predicted, truth, usable)))
    np.testing.assert_allclose(value, alone, rtol=1e-6)
    for gradient in gradients:
        assert not np.asarray(gradient)[~kept].any() and np.asarray(gradient)[kept].all()


@pytest.mark.parametrize("unknown", [-np.inf, np.inf, np.nan, 3.0])
@pytest.mark.parametrize("candidates", [np.linspace(0.0, 1.0, 5), np.zeros(1)], ids=["five", "one"])
def test_cells_of_unknown_depth_leave_the_loss_finite(candidates, unknown):
    candidates = jnp.asarray(candidates, jnp.float32)
    truth, usable = jnp.array([[[0.5, unknown]]]), jnp.ones((1, 1, 2), bool)
    logits = jnp.zeros((1, 1, 2, len(candidates)))
    loss = lambda x, y: sum(depth_loss(x, y, truth, candidates, usable, target_width=WIDTH))  # noqa: E731
    value, gradients = jax.value_and_grad(loss, argnums=(0, 1))(logits, jnp.full((1, 1, 2), 0.2))
    assert np.isfinite(value) and all(np.isfinite(g).all() for g in gradients)
    assert not any(np.asarray(g)[0, 0, 1].any() for g in gradients)


@pytest.mark.parametrize("rows", range(5, 13))
def test_only_cells_with_centers_in_the_image_have_depth(rows):
    log_depths = np.linspace(0.0, 0.01 * rows, rows)[:, None] * np.ones((1, 8))
    found = log_depths_at_cells(np.exp(log_depths))
    centers = 4 * np.arange((rows + 1) // 4) + 2  # of cells, in pixels; between pixels 1 and 2 of each
    assert centers[-1] < rows <= centers[-1] + 4
    np.testing.assert_allclose(found[:, 0], (log_depths[centers - 1, 0] + log_depths[centers, 0]) / 2, atol=1e-6)


def test_targets_need_context_views_around_them():
    with pytest.raises(InputError, match="a context of one view"):
        make_sample(0, num_chunks=1, num_targets=1, size=(16, 16), config=NARROW.replace(chunk_size=1))


@pytest.mark.slow  # a program of its own
def test_padding_does_not_count_in_the_loss(monkeypatch):
    """72 rows are padded to 96: the truth is padded like the images, and padding does not count in the loss."""
    sample = make_sample(0, num_chunks=1, num_targets=0, size=(72, 64), config=NARROW)
    model = StreamSplat(training_config(NARROW, RECIPE))
    params = model.init(jax.random.key(0))

    def losses(shown, hidden):
        """Losses with the truth of the image moved by `shown` and that of the padding by `hidden`."""
        moved = lambda truth, like: pad_like(truth + shown, like).at[:, 18:].add(hidden - shown)  # noqa: E731
        with monkeypatch.context() as patched:
            patched.setattr("ssplat_jax.training.step.pad_like", moved)
            return np.asarray(stream_chunks(model, params, sample, RECIPE)[2])

    as_it_is = losses(0.0, 0.0)
    np.testing.assert_array_equal(losses(0.0, 0.2), as_it_is)
    assert np.abs(losses(0.2, 0.0) - as_it_is).min() > 0.01
    truth = np.asarray(sample.log_depths[0])
    padded = np.asarray(pad_like(jnp.asarray(truth), jnp.zeros((4, 24, 16))))
    assert truth.shape == (4, 18, 16)
    np.testing.assert_array_equal(padded[:, :18], truth)
    np.testing.assert_array_equal(padded[:, 18:], np.repeat(truth[:, -1:], 6, axis=1))


def test_image_gradient_l1_ignores_a_constant_offset():
    image = jax.random.uniform(jax.random.key(0), (1, 6, 6, 3))
    assert float(image_gradient_l1(image, image + 0.25)) < 1e-6
    assert float(image_gradient_l1(image, image.at[:, :, 3:].add(0.5))) > 0.05


def test_learning_rate_warms_up_and_decays_in_every_phase():
    recipe = smoke_recipe(40)
    rates = [learning_rate(recipe, i) for i in range(recipe.num_steps)]
    first = recipe.phases[0].steps
    assert rates[0] < rates[1] and rates[first - 1] < 0.2 * recipe.phases[0].learning_rate
    assert rates[first] < recipe.phases[1].learning_rate and rates[first + 2] > 0.8 * recipe.phases[1].learning_rate
    quiet = dataclasses.replace(recipe, phases=(dataclasses.replace(recipe.phases[0], steps=200, final_share=0.02),))
    assert learning_rate(quiet, 199) == pytest.approx(0.02 * quiet.phases[0].learning_rate, rel=0.01)


def test_tokens_that_a_stored_view_looked_through_are_not_rendered():
    model = StreamSplat(NARROW)
    params, cache = random_params(NARROW), model.init_cache()
    side = cache.stored_depths.weights.shape[-1]
    # One view at the origin saw a wall at depth 2.
    stored = replace(
        cache.stored_depths,
        viewmats=cache.stored_depths.viewmats.at[0].set(jnp.eye(4)),
        Ks=cache.stored_depths.Ks.at[0].set(jnp.array([[side, 0, side / 2], [0, side, side / 2], [0, 0, 1.0]])),
        log_depths=cache.stored_depths.log_depths.at[0].set(np.log(2.0)),
        weights=cache.stored_depths.weights.at[0].set(1.0),
    )
    depths = jnp.array([1.0, 2.0, 3.0, 2.0])  # a floater, the wall, a hidden token, one of low confidence
    tokens = Tokens(
        means=jnp.array([[0.01, 0.01, 1.0]]) * depths[:, None],
        feats=jnp.ones((4, NARROW.network.token_width)),
        confidences=jnp.array([0.6, 0.6, 0.6, 0.2]),
        rgbs=jnp.full((4, 12), 0.5),
        quats=jnp.tile(jnp.array([1.0, 0, 0, 0]), (4, 1)),
        footprints=jnp.full(4, 0.02),
        valid=jnp.ones(4, bool),
    )
    config = NARROW.replace(min_confidence=0.5)
    shown = decode_accepted(StreamSplat(config), params, replace(cache, stored_depths=stored), tokens).opacities > 0
    np.testing.assert_array_equal(shown.reshape(4, -1).T, [[False, True, True, False]] * 4)


def test_parts_of_the_parameters_have_rates_of_their_own():
    updates = {"encoder": {"pretrained": {"a": 2.0, "b": {"c": 4.0}}, "cnn": 8.0}, "decoder": 16.0}
    scaled = scale_parts(updates, (("encoder/pretrained", 0.5), ("decoder", 0.25), ("cnn", 0.0), ("encoder/none", 0.0)))
    assert scaled == {"encoder": {"pretrained": {"a": 1.0, "b": {"c": 2.0}}, "cnn": 8.0}, "decoder": 4.0}
    assert updates["decoder"] == 16.0 and scale_parts(updates, ()) is updates
    vit = RECIPES["paper"].part_rates[0][0].split("/")
    shapes = jax.eval_shape(lambda key: init_params(key, preset("small"), ["encoder"]), jax.random.key(0))
    assert vit[1] in shapes[vit[0]]


def test_views_step_as_far_as_the_phase_says():
    rng = np.random.default_rng(0)
    for low, high in ((0.01, 0.02), (0.2, 0.3)):
        for seed in rng.integers(0, 1000, 3):
            _, depths, poses, _ = training_sample(int(seed), 8, 24, 32, steps=(low, high))
            step = np.median(np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=-1)) / np.median(depths)
            assert low / 2 < step < 2 * high


def test_the_sky_stands_at_the_last_candidate_and_changes_no_scale():
    """Depths of the sky are those of the farthest candidate; median and range are those of the surfaces."""
    size, shares = (32, 48), []
    for seed in range(4):
        _, depths, _, _ = training_sample(seed, 4, *size, kinds=("yard",))
        sample = make_sample(
            seed, num_chunks=1, num_targets=0, size=size, config=NARROW, kinds=("yard",), range_jitter=0.0
        )
        far = float(sample.chunks.far[0])
        cells = np.exp(np.asarray(sample.log_depths))
        is_sky = np.isclose(cells, far, rtol=1e-3)
        assert cells[is_sky].max(initial=0.0) < far
        surfaces = depths[np.isfinite(depths)]
        scale = MEDIAN_DEPTH / np.median(surfaces)
        assert far == pytest.approx(FAR_FACTOR * scale * np.quantile(surfaces, 0.99), rel=1e-5)
        assert is_sky.mean() == pytest.approx(np.isinf(depths).mean(), abs=0.05)
        shares.append(is_sky.mean())
    assert max(shares) > 0.1


def test_a_phase_says_what_its_worlds_are():
    phase = dataclasses.replace(DEPTH_RECIPE.phases[0], kinds=("yard",))
    drawn = sample_for_step(0, dataclasses.replace(DEPTH_RECIPE, phases=(phase,)), NARROW)
    yard = make_sample(
        DEPTH_RECIPE.seed * 1_000_003, num_chunks=1, num_targets=0, size=(64, 64), config=NARROW, kinds=("yard",)
    )
    np.testing.assert_array_equal(drawn.chunks.images, yard.chunks.images)
    assert not np.array_equal(drawn.chunks.images, sample_for_step(0, DEPTH_RECIPE, NARROW).chunks.images)


FROZEN_ENCODER = PhaseForm(frozen=("encoder",))
# Depth alone: steps that render take a minute to compile and are tested as slow tests.
DEPTH_RECIPE = dataclasses.replace(RECIPE, phases=(Phase("depth", 1, 1, 0, ((64, 64),), 1e-3, FROZEN_ENCODER),))


@pytest.fixture(scope="module")
def trainer():
    """One compiled step, shared by the tests that need one."""
    return Trainer(StreamSplat(training_config(NARROW, DEPTH_RECIPE)), DEPTH_RECIPE)


def start(trainer):
    return init_state(trainer.model, DEPTH_RECIPE, random_params(trainer.model.config))


def alone(sample):
    """A batch of one sample."""
    return jax.tree.map(lambda x: x[None], sample)


def test_step_with_a_non_finite_gradient_is_only_counted(trainer):
    sample = sample_for_step(0, DEPTH_RECIPE, trainer.model.config)
    broken = dataclasses.replace(sample, log_depths=sample.log_depths.at[0, 0, 8, 8].set(jnp.nan))
    broken = dataclasses.replace(
        broken, chunks=dataclasses.replace(sample.chunks, images=sample.chunks.images * jnp.inf)
    )
    # After a good step momentum is not zero and the average differs from the parameters.
    state, _ = trainer.step(start(trainer), alone(sample), jnp.float32(1e-3), form=FROZEN_ENCODER)
    before = {name: flat(getattr(state, name)) for name in ("params", "ema", "opt_state")}
    assert any(np.any(a != b) for a, b in zip(before["params"], before["ema"], strict=True))
    after, metrics = trainer.step(state, alone(broken), jnp.float32(1e-3), form=FROZEN_ENCODER)
    assert not np.isfinite(float(metrics["grad_norm"]))
    assert int(after.num_skipped) == 1 and int(after.step) == 2
    for name, held in before.items():
        for a, b in zip(flat(getattr(after, name)), held, strict=True):
            assert a.tobytes() == b.tobytes(), name


def test_frozen_stages_stay_and_the_others_move(trainer):
    state = start(trainer)
    before = jax.tree.map(np.asarray, state.params)
    sample = sample_for_step(0, DEPTH_RECIPE, trainer.model.config)
    after, metrics = trainer.step(state, alone(sample), jnp.float32(1e-3), form=FROZEN_ENCODER)
    assert np.isfinite(float(metrics["loss"])) and int(after.num_skipped) == 0
    for a, b in zip(flat(after.params["encoder"]), flat(before["encoder"]), strict=True):
        np.testing.assert_array_equal(a, b)
    moved = zip(flat(after.params["cost_volume"]), flat(before["cost_volume"]), strict=True)
    assert any(not np.array_equal(a, b) for a, b in moved)


def test_stages_that_the_loss_does_not_reach_stay_whatever_moved_them_before(trainer):
    """A sample without targets and with one chunk teaches depth alone: nothing else decays or follows old momentum."""
    state = start(trainer)
    moments = jax.tree.map(lambda x: x + 0.1 if jnp.issubdtype(x.dtype, jnp.floating) else x, state.opt_state)
    later = [name for name in state.params if name not in MATCHER_STAGES]
    before = {name: [np.asarray(x) for x in flat(state.params[name])] for name in later}
    assert sum(map(len, before.values())) > 8
    sample = sample_for_step(0, DEPTH_RECIPE, trainer.model.config)
    state = dataclasses.replace(state, opt_state=moments)
    after, _ = trainer.step(state, alone(sample), jnp.float32(1e-3), form=FROZEN_ENCODER)
    for name, held in before.items():
        for tree in (after.params, after.ema):
            for a, b in zip(flat(tree[name]), held, strict=True):
                np.testing.assert_array_equal(a, b, err_msg=name)


def test_members_of_a_batch_are_samples_of_their_own():
    phase = dataclasses.replace(DEPTH_RECIPE.phases[0], steps=2, batch=2)
    recipe = dataclasses.replace(DEPTH_RECIPE, phases=(phase,))
    batch = batch_for_step(1, recipe, NARROW)
    for member in range(2):
        sample = sample_for_step(1, recipe, NARROW, member=member)
        jax.tree.map(lambda a, b: np.testing.assert_array_equal(a[member], b), batch, sample)  # noqa: B023
    seen = [
        sample_for_step(step, recipe, NARROW, member=member).log_depths.tobytes()
        for step in range(recipe.num_steps)
        for member in range(2)
    ]
    assert len(set(seen)) == len(seen)


@pytest.mark.parametrize("targets", [0, 1])
def test_loss_and_gradient_of_a_batch_are_means_over_its_samples(monkeypatch, targets):
    samples = [make_sample(seed, num_chunks=1, num_targets=targets, size=(64, 64), config=NARROW) for seed in (1, 2, 3)]
    batch = jax.tree.map(lambda *parts: jnp.stack(parts), *samples)

    def loss(params, model, sample, *rest):
        value = jnp.sum(params["a"] * jnp.nanmean(sample.log_depths)) ** 2
        return value, {"loss": value, "views": jnp.float32(len(sample.target_images))}

    monkeypatch.setattr(train_step, "loss_fn", loss)
    of = jax.value_and_grad(train_step.mean_loss, has_aux=True)
    params = {"a": jnp.array([1.5, -0.5])}
    (value, metrics), gradient = of(params, StreamSplat(NARROW), batch, DEPTH_RECIPE, DEFAULT_FORM)
    singles = [of(params, StreamSplat(NARROW), alone(sample), DEPTH_RECIPE, DEFAULT_FORM) for sample in samples]
    np.testing.assert_allclose(value, np.mean([single[0][0] for single in singles]), rtol=1e-6)
    np.testing.assert_allclose(gradient["a"], np.mean([single[1]["a"] for single in singles], axis=0), rtol=1e-6)
    assert float(metrics["loss"]) == float(value) and float(metrics["views"]) == targets


@pytest.mark.slow  # programs of whole training steps
@pytest.mark.parametrize("targets", [0, 1])
def test_the_gradient_of_a_batch_is_the_mean_of_its_samples_gradients(targets):
    samples = [make_sample(seed, num_chunks=1, num_targets=targets, size=(64, 64), config=NARROW) for seed in (1, 2)]
    model = StreamSplat(training_config(NARROW, RECIPE))
    gradient = jax.jit(lambda p, b: jax.grad(train_step.mean_loss, has_aux=True)(p, model, b, RECIPE, DEFAULT_FORM)[0])
    params = random_params(NARROW)
    found = gradient(params, jax.tree.map(lambda *parts: jnp.stack(parts), *samples))
    singles = [gradient(params, alone(sample)) for sample in samples]
    wanted = jax.tree.map(lambda a, b: (a + b) / 2, *singles)
    largest = max(float(jnp.abs(x).max()) for x in jax.tree.leaves(wanted))
    for a, b in zip(flat(found), flat(wanted), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-4 * largest, rtol=1e-3)


@pytest.mark.slow  # two programs of a whole training step
def test_rendering_the_cache_trains_the_head_alone():
    sample = sample_for_step(RECIPE.num_steps - 1, RECIPE, NARROW)
    model = StreamSplat(training_config(NARROW, RECIPE))
    params = random_params(NARROW)
    recipe = dataclasses.replace(RECIPE, depth_weight=0.0)

    def gradient(frozen):
        form = PhaseForm(frozen=frozen, decode="cache")
        return jax.jit(lambda p: jax.grad(loss_fn, has_aux=True)(p, model, sample, recipe, form)[0])(params)

    gradients = {frozen: gradient(frozen) for frozen in ((), ALL_BUT_HEAD)}
    for name in params:
        norm = float(sum(jnp.abs(g).sum() for g in jax.tree.leaves(gradients[()][name])))
        assert (norm > 0) == (name == "decoder"), name
    for a, b in zip(flat(gradients[()]["decoder"]), flat(gradients[ALL_BUT_HEAD]["decoder"]), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-7)


@pytest.mark.slow  # two runs, each compiling both phases
def test_interrupted_run_ends_as_an_uninterrupted_one(tmp_path):
    whole = loop.train(NARROW, RECIPE, tmp_path / "whole", save_every=2)
    assert whole.step == RECIPE.num_steps

    class Stop(Exception):
        pass

    def stop_after(record):
        if record["step"] == 3:
            raise Stop

    with pytest.raises(Stop):
        loop.train(NARROW, RECIPE, tmp_path / "parts", save_every=1, log_every=1, report=stop_after)
    parts = loop.train(NARROW, RECIPE, tmp_path / "parts", save_every=1, log_every=1)
    for a, b in zip(flat(parts.state), flat(whole.state), strict=True):
        np.testing.assert_array_equal(a, b)
    records = [json.loads(line) for line in (tmp_path / "parts" / "log.jsonl").read_text().splitlines()]
    assert [record["step"] for record in records] == list(range(1, RECIPE.num_steps + 1))
    assert records[-1]["skipped"] == 0

    with pytest.raises(InputError, match="another --out"):
        loop.train(NARROW, dataclasses.replace(RECIPE, seed=1), tmp_path / "whole")


def test_records_of_steps_that_are_taken_again_are_removed(tmp_path):
    log = tmp_path / "log.jsonl"
    log.write_text('{"step": 10}\n{"step": 20, "psnr": 1}\n{"step": 20}\n{"step": 30}\n{"ste')
    loop._Log(log, RECIPE, lambda record: None, start=20)
    assert log.read_text() == '{"step": 10}\n{"step": 20, "psnr": 1}\n{"step": 20}\n'


@pytest.fixture
def started(monkeypatch):
    """Arguments that the command gives to a training, which stops at once."""
    seen = {}

    def stopped_at_once(config, recipe, out, *, params, **others):
        seen.update(config=config, params=params)
        raise KeyboardInterrupt

    monkeypatch.setattr(loop, "train", stopped_at_once)
    return seen


def test_the_command_goes_on_with_the_configuration_of_the_weights(tmp_path, started, capsys):
    """Unless --preset asks for another one; what is lost by that is said."""
    held = preset("tiny").replace(cgfi=True, voxel_size=0.02)
    save_weights(tmp_path / "w.npz", init_params(jax.random.key(0), held), held, {"steps": 7})
    asked = {"out": tmp_path / "out", "recipe": "stream", "init_weights": tmp_path / "w.npz"}
    with pytest.raises(KeyboardInterrupt):
        Train(**asked, set=("min_confidence=0.25",)).run()
    assert started["config"] == held.replace(min_confidence=0.25) and started["params"]["cgfi"]
    assert "leaves out" not in capsys.readouterr().err
    with pytest.raises(KeyboardInterrupt):
        Train(**asked, preset="tiny").run()
    said = capsys.readouterr().err
    assert "leaves out cgfi" in said and "memory.voxel_size 0.02 -> 0.03" in said and "cgfi" not in started["params"]


def test_a_training_keeps_the_history_of_the_weights_that_it_started_from(tmp_path, monkeypatch):
    save_weights(tmp_path / "w.npz", init_params(jax.random.key(5), NARROW), NARROW, {"recipe": {"seed": 5}})

    def done(config, recipe, out, *, params, **others):
        out.mkdir()
        return SimpleNamespace(state=SimpleNamespace(ema=params), step=1, interrupted=None)

    monkeypatch.setattr(loop, "train", done)
    asked = {"recipe": "stream", "init_weights": tmp_path / "w.npz", "seed": 6, "quiet": True}
    assert Train(out=tmp_path / "out", **asked).run() == 0
    facts = describe_weights(str(tmp_path / "out" / "weights.npz"))
    assert facts.provenance["before"] == {"recipe": {"seed": 5}} and facts.provenance["fresh"] == []
    assert max(stage_turns(load_params(str(tmp_path / "w.npz")), facts).values()) < 1e-3  # since seed 5


def test_the_command_starts_stages_that_the_weights_lack_at_random(tmp_path, started, capsys):
    with pytest.raises(KeyboardInterrupt):
        Train(out=tmp_path, recipe="stream", init_weights=SHIPPED, seed=3, set=("cgfi=true",)).run()
    assert "tiny.npz has no cgfi: random at the start" in capsys.readouterr().err  # the mixer has no blocks here
    untrained, shipped = init_params(jax.random.key(3), started["config"]), load_params("tiny")
    for name, stage in started["params"].items():
        jax.tree.map(np.testing.assert_array_equal, stage, (untrained if name == "cgfi" else shipped)[name])


@pytest.mark.parametrize(
    ("recipe", "has_lpips", "wanted"),
    [
        ("tiny", False, None),
        ("depth", False, None),
        ("stream", False, "MSE + image gradients"),
        ("paper", False, "MSE"),
        ("paper", True, "MSE + 0.05 LPIPS"),
    ],
)
def test_weights_tell_the_loss_of_their_training(recipe, has_lpips, wanted):
    assert _rendering_loss(RECIPES[recipe], has_lpips) == wanted
