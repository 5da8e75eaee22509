"""The preset `paper` against the paper: each equation by an oracle in float64, written from the formula alone.

The network itself is compared with the published one in tests/model/test_resplat_parity.py.
"""

import itertools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ssplat_jax.cache.project import ProjectedCache, project
from ssplat_jax.cache.state import Tokens
from ssplat_jax.config import preset
from ssplat_jax.core.cameras import Camera
from ssplat_jax.core.numerics import softplus_inverse
from ssplat_jax.core.pytree import replace
from ssplat_jax.core.rotations import quats_to_matrices
from ssplat_jax.model.cgfi import Aggregator, inject_features
from ssplat_jax.model.hpda import anchor_depth
from ssplat_jax.model.network import network_of
from ssplat_jax.model.streamsplat import ChunkOutput, Prediction, StreamSplat
from ssplat_jax.model.views import DepthDistribution, Views, prepare_views
from ssplat_jax.training import losses
from ssplat_jax.training.recipe import RECIPES
from tests.data.capture_fixture import smooth_capture
from tests.model.small import history
from tests.training.test_losses import sample_of

PAPER = preset("paper")
SLIM = PAPER.replace(token_width=8, num_depths=24, cgfi_width=8, capacity=256)
"""`paper` with fewer channels and candidates, and room for 256 voxels."""
MODEL = StreamSplat(SLIM)
GRID = (2, 4, 4)
SIGMA0, LAMBDA, DELTA, TAU, K = 0.1, 0.5, 0.04, 0.3, 4
FLOAT32 = 1e-5


def f32(x) -> jax.Array:
    return jnp.asarray(x, jnp.float32)


def f64(x) -> np.ndarray:
    return np.asarray(x, np.float64)


def views(num_depths: int = SLIM.network.num_depths) -> Views:
    """Two views of 16 x 16 pixels, candidates from 0.5 to 20."""
    return Views(
        images=jnp.full((2, 16, 16, 3), 0.5),
        viewmats=jnp.tile(jnp.eye(4), (2, 1, 1)),
        Ks=jnp.tile(f32([[16.0, 0, 8], [0, 16, 8], [0, 0, 1]]), (2, 1, 1)),
        valid=jnp.ones(2, bool),
        unusable=jnp.zeros(2, bool),
        inside=jnp.ones(GRID, bool),
        log_candidates=jnp.linspace(math.log(0.5), math.log(20.0), num_depths),
        height=16,
        width=16,
    )


def remembered(rng) -> ProjectedCache:
    """A projected cache with a hole in every third cell."""
    mask = (np.arange(math.prod(GRID)) % 3 != 0).reshape(GRID)
    return ProjectedCache(
        depths=f32(np.where(mask, rng.uniform(0.6, 15, GRID), 0)),
        confidences=f32(np.where(mask, rng.uniform(0.3, 1, GRID), 0)),
        feats=f32(np.where(mask[..., None], rng.normal(size=(*GRID, SLIM.network.token_width)), 0)),
        mask=jnp.asarray(mask),
        colors=None,
    )


def test_frames_stream_in_their_order_in_the_units_of_the_poses_between_their_near_and_far():
    capture = smooth_capture(6, 32, 48)
    frame, order = capture.stream_frame(PAPER), [5, 2, 3, 1, 4]
    assert frame.scale == 1.0 and capture.stream_order(PAPER, order, frame) == order
    first = next(iter(capture.chunks(PAPER, order, stream_frame=frame)))
    candidates = np.exp(f64(jax.jit(lambda chunk: prepare_views(chunk, PAPER).log_candidates)(first)))
    assert candidates[[0, -1]] == pytest.approx(frame.depth_range, rel=1e-5)


def test_anchor_fusion_mean_depth_and_both_confidences():
    """Eqs. cache_depth_prior, cache_prior_injection and base_depth_regression."""
    rng, view = np.random.default_rng(0), views()
    probs = jax.nn.softmax(f32(3 * rng.normal(size=(*GRID, len(view.log_candidates)))))
    history, gamma = remembered(rng), 0.7
    distribution = DepthDistribution(probs=probs, logits=jnp.log(probs), decoder=jnp.zeros((*GRID, 1)))
    read = jax.jit(lambda raw: anchor_depth({"raw_gamma": raw}, distribution, history, view, SLIM))
    got = read(f32(softplus_inverse(gamma)))

    d, P_i = np.exp(f64(view.log_candidates)), f64(probs)
    D_H, Omega = f64(history.depths)[..., None], f64(history.confidences)[..., None]
    sigma = SIGMA0 + LAMBDA * (1 - Omega)
    P_H = np.where(f64(history.mask)[..., None], Omega * np.exp(-((d - D_H) ** 2) / (2 * sigma**2)), 0)
    P_v = (P_i + gamma * P_H) / (P_i + gamma * P_H).sum(axis=-1, keepdims=True)
    assert np.abs(P_v - P_i).max() > 0.1
    np.testing.assert_allclose(got.probs, P_v, atol=FLOAT32)
    np.testing.assert_allclose(np.exp(f64(got.log_depths)), (P_v * d).sum(axis=-1), rtol=FLOAT32)
    np.testing.assert_allclose(got.matcher_confidences, P_i.max(axis=-1), atol=FLOAT32)  # what VACC stores
    np.testing.assert_allclose(got.anchored_confidences, P_v.max(axis=-1), atol=FLOAT32)  # what CGFI attenuates by
    # gamma_d is a learned scalar: depth has a gradient with respect to it.
    assert abs(float(jax.jit(jax.grad(lambda raw: read(raw).log_depths.sum()))(f32(0.0)))) > 1e-3


def test_attenuated_feature_is_concatenated_and_nothing_else():
    """Eqs. cache_feature_attenuation and token_regressor_input: the network sees f and (1 - omega) F_H alone."""
    rng, c = np.random.default_rng(1), SLIM.network.token_width
    feats, omega, history = f32(rng.normal(size=(*GRID, c))), f32(rng.uniform(size=GRID)), remembered(rng)
    zeros = jnp.zeros((*GRID, c))
    shapes = jax.eval_shape(Aggregator(SLIM).init, jax.random.key(0), zeros, zeros, jnp.ones(2, bool))["params"]
    params = jax.tree.map(lambda x: f32(rng.normal(size=x.shape)), shapes)
    assert params["leave"]["kernel"].shape[2] == 2 * c + SLIM.network.cgfi_width
    copies = jnp.zeros_like(params["leave"]["kernel"]).at[1, 1, jnp.arange(c), jnp.arange(c)].set(2.0)
    copies = copies.at[1, 1, c + jnp.arange(c), jnp.arange(c)].set(-3.0)
    params = params | {"leave": {name: jnp.zeros_like(x) for name, x in params["leave"].items()} | {"kernel": copies}}
    inject = jax.jit(lambda *given: inject_features(*given, views(), SLIM, network_of(SLIM).bound_history))
    got = inject(params, feats, history, omega)
    attenuated = (1 - f64(omega))[..., None] * f64(history.feats)
    np.testing.assert_allclose(got, 2 * f64(feats) - 3 * attenuated, atol=FLOAT32)


def draw_tokens(rng, means) -> Tokens:
    """Tokens at `means` with random features and confidences, of which some are below tau."""
    m = len(means)
    return Tokens(
        means=f32(means),
        feats=f32(rng.normal(size=(m, SLIM.network.token_width))),
        confidences=f32(rng.uniform(0.2, 1, m)),
        rgbs=f32(rng.uniform(size=(m, 3))),
        quats=f32(rng.normal(size=(m, 4))),
        footprints=f32(rng.uniform(0.01, 0.02, m)),
        valid=jnp.ones(m, bool),
    )


def remember(cache, tokens: Tokens):
    """The cache after tokens of views that contradict every pivot: all see far behind them, with full confidence."""
    maps = jnp.full(GRID, 19.0), jnp.ones(GRID), jnp.zeros(GRID), jnp.ones((2, 3))
    nothing = DepthDistribution(*jnp.zeros((3, *GRID, 1))), history(*jnp.zeros((2, *GRID)))
    return UPDATE(cache, Prediction(tokens, *nothing, jnp.log(maps[0]), views(), ChunkOutput(*maps)))


UPDATE = jax.jit(MODEL.update_cache)


def vacc(memory: dict, tokens: Tokens) -> None:
    """Eqs. vacc_capacity_update and vacc_pair_selection_and_merge, token by token; pivots are (p, f, omega, seed)."""
    for p, f, omega in zip(f64(tokens.means), f64(tokens.feats), f64(tokens.confidences), strict=True):
        if omega < TAU:
            continue
        pivots = memory.setdefault(tuple(np.floor(p / DELTA).astype(int)), [])
        pivots.append((p, f, omega, f))
        if len(pivots) > K:
            cosine = lambda ij: np.dot(ij[0][3], ij[1][3]) / np.linalg.norm(ij[0][3]) / np.linalg.norm(ij[1][3])  # noqa: E731
            m0, m1 = max(itertools.combinations(pivots, 2), key=cosine)
            w0, w1 = m0[2], m1[2]
            merged = [(w0 * m0[i] + w1 * m1[i]) / (w0 + w1) for i in range(2)]
            pivots[:] = [m for m in pivots if m is not m0 and m is not m1]
            pivots.append((*merged, max(w0, w1), m1[3] if w1 > w0 else m0[3]))


def test_insertion_and_merge_and_no_other_change_of_a_pivot():
    rng, cache, memory = np.random.default_rng(2), MODEL.init_cache(), {}
    for _ in range(3):
        tokens = draw_tokens(rng, rng.uniform([-0.1, -0.1, 2.0], [0.1, 0.1, 2.1], (200, 3)))
        cache = remember(cache, tokens)
        vacc(memory, tokens)
    assert int(cache.stats.num_merged) > 50 and int(cache.stats.num_low_confidence) > 20
    rows = {tuple(np.asarray(cache.voxels[r, :3])): r for r in range(int(cache.num_voxels))}
    assert rows.keys() == memory.keys()
    for voxel, pivots in memory.items():
        row = rows[voxel]
        assert int(cache.counts[row]) == len(pivots) <= K
        found = [
            np.concatenate([f64(x[row, k]).reshape(-1) for x in (cache.means, cache.feats, cache.seeds)])
            for k in range(len(pivots))
        ]
        wanted = [np.concatenate([p, f, seed]) for p, f, _, seed in pivots]
        order = [int(np.argmin([np.abs(x - w).sum() for x in found])) for w in wanted]
        assert sorted(order) == list(range(len(pivots)))
        np.testing.assert_allclose(np.stack(found)[order], np.stack(wanted), atol=FLOAT32)
        np.testing.assert_allclose(f64(cache.confidences[row])[order], [omega for _, _, omega, _ in pivots], rtol=1e-6)


def test_projection_is_weighted_by_confidence_over_all_pivots_of_a_pixel():
    """Eq. cache_projection, with depths of a pixel a factor of 5 apart."""
    rng, view = np.random.default_rng(4), views()
    z = np.exp(rng.uniform(np.log(1), np.log(5), 200))
    means = np.stack([*(rng.uniform(-0.45, 0.45, (2, 200)) * z), z], axis=1)
    tokens = replace(draw_tokens(rng, means), confidences=f32(rng.uniform(0.3, 1, 200)))
    cache = remember(MODEL.init_cache(), tokens)
    camera = Camera(viewmats=view.viewmats[:1], Ks=view.Ks[:1] * f32([[0.25], [0.25], [1]]), width=4, height=4)
    got = jax.jit(project, static_argnums=2)(cache, camera, SLIM)
    alive = np.asarray(cache.alive)
    p, f, w = f64(cache.means)[alive], f64(cache.feats)[alive], f64(cache.confidences)[alive]
    cells = np.floor(4 * p[:, :2] / p[:, 2:] + 2).astype(int)
    for x, y in itertools.product(range(4), repeat=2):
        on = (cells == (x, y)).all(axis=1)
        assert on.sum() > 1 and p[on, 2].max() / p[on, 2].min() > 1.5
        weight = w[on].sum()
        assert float(got.depths[0, y, x]) == pytest.approx(np.exp((w[on] * np.log(p[on, 2])).sum() / weight), rel=1e-5)
        assert float(got.confidences[0, y, x]) == pytest.approx((w[on] ** 2).sum() / weight, rel=1e-5)
        np.testing.assert_allclose(got.feats[0, y, x], (w[on, None] * f[on]).sum(axis=0) / weight, atol=FLOAT32)


def head() -> dict:
    """Random parameters of the Gaussian head, which has 58 outputs."""
    rng, c = np.random.default_rng(5), SLIM.network.token_width
    sizes = {"gaussian_head_0": (c, 58), "gaussian_head_2": (58, 58)}
    draw = lambda n, m: {"kernel": f32(rng.normal(size=(n, m)) / math.sqrt(n)), "bias": f32(0.3 * rng.normal(size=m))}  # noqa: E731
    return {name: draw(*size) for name, size in sizes.items()}


HEAD = head()


def test_inference_decodes_the_fused_token_by_the_head_alone():
    """Sec. Gaussian Decoder: center p*, all else a two-layer perceptron of f*, whatever was merged."""
    rng, c = np.random.default_rng(5), SLIM.network.token_width
    tokens = draw_tokens(rng, rng.uniform([-0.05, -0.05, 2.0], [0.05, 0.05, 2.1], (200, 3)))
    cache = remember(MODEL.init_cache(), tokens)
    assert int(cache.num_members.max()) > 5
    alive = np.asarray(cache.alive).reshape(-1)
    got = jax.tree.map(lambda x: np.asarray(x)[alive], jax.jit(MODEL.decode)({"decoder": HEAD}, cache))

    f = f64(cache.feats).reshape(-1, c)[alive]
    (k0, b0), (k2, b2) = ((f64(layer["kernel"]), f64(layer["bias"])) for layer in HEAD.values())
    hidden = f @ k0 + b0
    hidden = hidden * (1 + np.vectorize(math.erf)(hidden / math.sqrt(2))) / 2  # GELU
    raw = hidden @ k2 + b2
    np.testing.assert_array_equal(got.means, np.asarray(cache.means).reshape(-1, 3)[alive])
    np.testing.assert_allclose(got.opacities, 1 / (1 + np.exp(-raw[:, 7])), atol=FLOAT32)
    np.testing.assert_allclose(got.scales, np.clip(np.log1p(np.exp(raw[:, 4:7] - 4)), 1e-6, 1), rtol=1e-4)
    colors = raw[:, 10:].reshape(-1, 3, 16).swapaxes(1, 2)
    colors[:, 0] += (f64(cache.rgbs).reshape(-1, 3)[alive] - 0.5) / 0.28209479177387814
    np.testing.assert_allclose(got.sh, colors, atol=1e-4)
    quats = cache.quats.reshape(-1, 4)[alive], np.roll(raw[:, :4], 1, axis=1)
    cameras, heads = (quats_to_matrices(f32(q)) for q in quats)
    np.testing.assert_allclose(quats_to_matrices(f32(got.quats)), np.matmul(cameras, heads), atol=1e-4)


def test_training_follows_the_rendering_loss_of_all_tokens_over_black(monkeypatch):
    """The whole loss of a sample is Eq. training_loss; tokens below tau are rendered too."""
    (phase,) = RECIPES["paper"].phases
    assert {"encoder", "cost_volume", "hpda", "tokens", "cgfi", "mixer", "decoder"} <= set(phase.stages)
    rng = np.random.default_rng(7)
    tokens = replace(draw_tokens(rng, rng.uniform(-1, 1, (9, 3))), confidences=jnp.full(9, 0.01))
    streamed = (MODEL.init_cache(), tokens, f32(17.0), {})
    monkeypatch.setattr(losses.DepthLoss, "of_stream", lambda *args: streamed)
    rendered = lambda self, scene, *rest: (f32(3.0), {"least": scene.opacities.min(), "most": scene.opacities.max()})  # noqa: E731
    monkeypatch.setattr(losses.RenderingLoss, "of_scene", rendered)
    camera = Camera(jnp.zeros((2, 4, 4)), jnp.zeros((2, 3, 3)), 8, 8)
    sample = sample_of(jnp.zeros((1, 2, 2, 2)), jnp.zeros((2, 8, 8, 3)), camera)
    batch, params = jax.tree.map(lambda x: x[None], sample), {"decoder": HEAD}
    loss_of = lambda loss: jax.jit(lambda params: loss(MODEL, params, batch))(params)  # noqa: E731
    value, scene = loss_of(phase.loss)
    assert value == 4 * 3.0 and phase.loss.black_weight == 1.0 and scene["least"] > 0
    assert loss_of(losses.RenderingLoss())[1]["most"] == 0
