"""Every line of the `Limits:` blocks of numerics and layers; tests/core has those of cameras and rotations."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ssplat_jax.core.cpu_backend import in_own_kernel, lane_sum
from ssplat_jax.core.numerics import clip_value, safe_log, safe_normalize, safe_sqrt
from ssplat_jax.model.layers import WindowAttention, attend, instance_norm
from ssplat_jax.model.mixer import attend_per_query

ULP = float(np.finfo(np.float32).eps)


@pytest.mark.parametrize("size", [0.0, 1e-30, 1e-13, 1e-12])
def test_safe_normalize_of_zero_is_zero_with_a_zero_gradient(size):
    x = jnp.full((2, 3), size, jnp.float32)
    np.testing.assert_array_equal(safe_normalize(x), 0)
    np.testing.assert_array_equal(jax.grad(lambda v: jnp.sum(safe_normalize(v) * jnp.arange(3.0)))(x), 0)


@pytest.mark.parametrize("size", [1.1e-10, 1e-5, 1.0, 1e10, 0.9e30])
@pytest.mark.parametrize("width", [2, 3, 4, 32])
def test_safe_normalize_length_is_one_within_four_ulp(size, width):
    x = np.random.default_rng(width).uniform(-1, 1, (500, width))
    x = x / np.abs(x).max(-1, keepdims=True) * size
    unit = np.asarray(safe_normalize(jnp.asarray(x, jnp.float32)), np.float64)
    assert np.abs(np.linalg.norm(unit, axis=-1) - 1).max() < 4 * ULP
    np.testing.assert_allclose(unit, x / np.linalg.norm(x, axis=-1, keepdims=True), atol=4 * ULP)


def test_safe_log_below_its_floor_has_a_zero_gradient():
    x = jnp.array([1e-12, 1e-20, 0.0, -1.0, -jnp.inf])
    np.testing.assert_allclose(safe_log(x), np.log(1e-12), rtol=1e-6)
    np.testing.assert_array_equal(jax.grad(lambda v: safe_log(v).sum())(x), 0)
    np.testing.assert_allclose(safe_log(x, eps=0.1), np.log(0.1), rtol=1e-6)
    above = np.array([1.01e-12, 1e-6, 0.5, 1.0, 1e30])
    np.testing.assert_allclose(safe_log(jnp.asarray(above, jnp.float32)), np.log(above), rtol=1e-5, atol=1e-7)


def test_safe_sqrt_is_the_root_and_flat_at_and_below_zero():
    x = np.array([1e-30, 1e-6, 0.25, 1e30])
    np.testing.assert_allclose(safe_sqrt(jnp.asarray(x, jnp.float32)), np.sqrt(x), rtol=1e-6)
    slopes = jax.grad(lambda v: safe_sqrt(v).sum())(jnp.asarray(x, jnp.float32))
    np.testing.assert_allclose(slopes, 0.5 / np.sqrt(x), rtol=1e-5)
    small = jnp.array([0.0, -0.0, -1e-3, -jnp.inf])
    np.testing.assert_array_equal(safe_sqrt(small), 0)
    np.testing.assert_array_equal(jax.grad(lambda v: safe_sqrt(v).sum())(small), 0)


@pytest.mark.parametrize("wanted", [True, False])
def test_in_own_kernel_is_zero_in_value_and_gradient_if_unwanted(wanted):
    x = jnp.array([2.0, 0.0, -3.0])
    rows = jnp.array([2, 0])

    @jax.jit
    def gathered(x, wanted):
        return in_own_kernel(wanted, lambda: 1.0 / x[rows])

    value, pull = jax.vjp(lambda x: gathered(x, jnp.array(wanted)), x)
    np.testing.assert_allclose(value, [-1 / 3, 0.5] if wanted else [0, 0], rtol=1e-6)
    np.testing.assert_allclose(pull(jnp.ones(2))[0], [-0.25, 0, -1 / 9] if wanted else [0, 0, 0], rtol=1e-6)


def test_clip_value_clips_and_lets_the_gradient_pass():
    x = jnp.array([-1e6, -13.0, -12.0, -0.1, 11.9, 13.0, 1e6])
    np.testing.assert_array_equal(clip_value(x, -12.0, 12.0), np.clip(x, -12, 12))
    np.testing.assert_array_equal(jax.grad(lambda v: clip_value(v, -12.0, 12.0).sum())(x), 1)


def test_instance_norm_of_a_constant_channel_is_zero():
    x = jnp.ones((2, 4, 4, 3)).at[..., 1].set(7e3)
    np.testing.assert_array_equal(instance_norm(x), 0)
    assert np.isfinite(jax.grad(lambda v: jnp.sum(instance_norm(v) ** 2 + instance_norm(v)))(x)).all()


def attention_arrays(seed=0):
    rng = np.random.default_rng(seed)
    shape = lambda n: jnp.asarray(rng.normal(size=(2, n, 2, 4)), jnp.float32)  # noqa: E731
    return shape(5), shape(7), shape(7)


def test_attention_is_the_softmax_average_of_valid_keys():
    arrays, valid = attention_arrays(), np.array([True, False, True, True, False, True, False])
    q, k, v = (np.asarray(x, np.float64) for x in arrays)
    weights = np.exp(np.einsum("bqhc,bkhc->bhqk", q, k) / np.sqrt(4)) * valid
    wanted = np.einsum("bhqk,bkhc->bqhc", weights / weights.sum(-1, keepdims=True), v)
    q, k, v = (arrays[0], *(jnp.where(valid[:, None, None], x, 1e6) for x in arrays[1:]))
    np.testing.assert_allclose(attend(q, k, v, jnp.asarray(valid)[None, None]), wanted, atol=1e-6)
    np.testing.assert_allclose(attend(*arrays), attend(*arrays, jnp.ones((1, 1, 7), bool)), atol=1e-6)


def test_attention_to_no_valid_key_is_zero_with_a_zero_gradient():
    q, k, v = attention_arrays()
    none = jnp.zeros((2, 1, 7), bool)
    np.testing.assert_array_equal(attend(q, k, v, none), 0)
    loss = lambda *x: jnp.sum(attend(*x, none) ** 2 + attend(*x, none))  # noqa: E731
    for gradient in jax.jit(jax.grad(loss, (0, 1, 2)))(q, k, v):
        np.testing.assert_array_equal(gradient, 0)


def test_attend_per_query_equals_attend_with_one_head():
    rng = np.random.default_rng(0)
    q, k, v = (jnp.asarray(rng.normal(size=shape), jnp.float32) for shape in ((6, 20), (6, 5, 20), (6, 5, 20)))
    allowed = jnp.asarray(rng.uniform(size=(6, 5)) < 0.6).at[2].set(False)
    one_head = jax.jit(
        lambda q, k, v: attend(q[:, None, None], k[:, :, None], v[:, :, None], allowed[:, None])[:, 0, 0]
    )
    own = jax.jit(lambda q, k, v: attend_per_query(q, k, v, allowed))
    np.testing.assert_allclose(own(q, k, v), one_head(q, k, v), atol=1e-6)
    np.testing.assert_array_equal(own(q, k, v)[2], 0)
    np.testing.assert_array_equal(own(q, k, v), own(q, *(jnp.where(allowed[..., None], x, 1e6) for x in (k, v))))
    gradients = (jax.jit(jax.grad(lambda *x, f=f: jnp.sum(f(*x) ** 2), (0, 1, 2)))(q, k, v) for f in (own, one_head))
    for got, wanted in zip(*gradients, strict=True):
        np.testing.assert_allclose(got, wanted, atol=1e-5)
        np.testing.assert_array_equal(got[2], 0)


@pytest.mark.parametrize("n", [0, 1, 7, 16, 48, 100])
def test_a_sum_in_lanes_is_the_sum(n):
    x = jnp.asarray(np.random.default_rng(n).integers(-9, 9, (3, 2, n)), jnp.float32)
    np.testing.assert_array_equal(lane_sum(x), np.asarray(x).sum(-1))
    np.testing.assert_array_equal(jax.grad(lambda x: lane_sum(x).sum())(x), np.ones((3, 2, n)))


@pytest.mark.parametrize("ffn_ratio", [0, 2])
def test_attention_in_windows_equals_its_formula(ffn_ratio):
    rng, layer = np.random.default_rng(ffn_ratio), WindowAttention(ffn_ratio)
    x, context = rng.normal(size=(2, 5, 6)), rng.normal(size=(2, 7, 6))
    inputs = (jnp.asarray(x, jnp.float32), jnp.asarray(context, jnp.float32), jnp.ones((1, 1, 7), bool))
    shapes = jax.eval_shape(layer.init, jax.random.key(0), *inputs)
    tree = jax.tree.map(lambda leaf: rng.normal(size=leaf.shape).astype(np.float32), shapes)
    linear = lambda name, y: y @ tree["params"][name]["kernel"].astype(np.float64)  # noqa: E731

    def norm(name, y):
        y = (y - y.mean(-1, keepdims=True)) / np.sqrt(y.var(-1, keepdims=True) + 1e-6)
        return y * tree["params"][name]["scale"] + tree["params"][name]["bias"]

    weights = np.exp(linear("q", x) @ linear("k", context).swapaxes(1, 2) / math.sqrt(6))
    mixed = weights / weights.sum(axis=-1, keepdims=True) @ linear("v", context)
    message = norm("norm1", linear("merge", mixed))
    if ffn_ratio:
        hidden = linear("ffn1", np.concatenate([x, message], axis=-1))
        message = norm("norm2", linear("ffn2", hidden * 0.5 * (1 + np.vectorize(math.erf)(hidden / math.sqrt(2)))))
    np.testing.assert_allclose(jax.jit(layer.apply)(tree, *inputs), x + message, rtol=1e-3, atol=1e-4)
