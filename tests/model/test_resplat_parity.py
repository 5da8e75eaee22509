"""ReSplat's network against the outputs of the authors' PyTorch code with the same weights.

Stage by stage, and through `StreamSplat` with the preset `paper` and an empty cache.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ssplat_jax.config import preset
from ssplat_jax.core.chunk import Chunk
from ssplat_jax.core.gaussians import Gaussians
from ssplat_jax.core.rotations import matrices_to_quats, quats_to_matrices
from ssplat_jax.model import resplat
from ssplat_jax.model.decoder import decode_tokens
from ssplat_jax.model.hpda import expected_log_depth
from ssplat_jax.model.layers import pixel_unshuffle
from ssplat_jax.model.network import init_params
from ssplat_jax.model.resplat.resplat_tokens import ReSplatGaussianHead, Upsampler, token_context
from ssplat_jax.model.resplat.torch_layers import resize
from ssplat_jax.model.streamsplat import StreamSplat
from ssplat_jax.model.views import AnchoredDepth, back_project, patch_colors, prepare_views, to_candidate_space
from ssplat_jax.storage.weights import as_published
from tests.model.resplat_fixture import load_golden, named_params, tap_error

TOLERANCE = 2e-4
"""Largest error in standard deviations of a tap; float32 against float64 gives 3.4e-5."""


@pytest.fixture(autouse=True)
def _exact_products():
    """Computes matrix products in full float32, which GPUs by default do not."""
    with jax.default_matmul_precision("highest"):
        yield


def read_inputs(golden: dict) -> Chunk:
    images = jnp.asarray(golden["in.image_u8"].transpose(0, 2, 3, 1) / 255.0, jnp.float32)
    v, height, width, _ = images.shape
    near, far = golden["in.near_far"]
    return Chunk(
        images=images,
        viewmats=jnp.asarray(np.linalg.inv(golden["in.extrinsics"].astype(np.float64)), jnp.float32),
        Ks=jnp.tile(jnp.asarray(golden["in.intrinsics"] * [[width], [height], [1]], jnp.float32), (v, 1, 1)),
        valid=jnp.ones(v, bool),
        near=jnp.float32(near),
        far=jnp.float32(far),
    )


def nchw(x) -> np.ndarray:
    return np.asarray(x).transpose(0, 3, 1, 2)


@functools.cache
def resplat_values() -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Wanted and computed values of every tap, from the images through all stages; `paper.*` through `StreamSplat`."""
    golden = load_golden("resplat_small")
    near, far = golden["in.near_far"].tolist()
    # As `import-weights` writes it.
    config = as_published(preset("paper")).replace(depth_range=(near, far), capacity=128)
    model = StreamSplat(config)
    params = init_params(jax.random.key(0), config, {"hpda", "cgfi"}) | named_params(config)

    def run(params, chunk: Chunk):
        views = prepare_views(chunk, config)
        height, width = views.images.shape[1:3]
        features = resplat.encode(params["encoder"], views, config)
        distribution = resplat.match(params["cost_volume"], features, views, config)
        confidences = distribution.probs.max(axis=-1)
        log_depths = expected_log_depth(distribution.probs, views.log_candidates, config)
        depth = AnchoredDepth(distribution.probs, log_depths, confidences, confidences)
        residual = Upsampler(config).apply({"params": params["upsampler"]}, features, log_depths, height, width)
        depth = resplat.refine_depth(params["upsampler"], features, depth, views, config)
        context = token_context(features, height // 4, width // 4)
        match = depth.matcher_confidences[..., None]
        regressed = [pixel_unshuffle(views.images, 4), jnp.exp(depth.log_depths)[..., None], match, context]
        feats = resplat.regress_tokens(params["tokens"], features, distribution, depth, views, config)
        positions, footprints = back_project(depth.log_depths, views)
        mixed = resplat.mix_tokens(params["mixer"], feats, positions, views.inside, views.valid, config)
        flat = mixed.reshape(-1, config.network.token_width)
        shapes = resplat.read_shapes(params["decoder"], flat, config)
        quats = matrices_to_quats(jnp.swapaxes(views.viewmats[:, :3, :3], -1, -2))
        gaussians = decode_tokens(
            shapes,
            means=positions.reshape(-1, 3),
            rgbs=patch_colors(views.images, config).reshape(-1, 3),
            quats=jnp.repeat(quats, height * width // 16, axis=0),
            footprints=footprints.reshape(-1),
            config=config,
        )
        prediction = model.predict(params, model.init_cache(), chunk)
        unit = shapes.quats / jnp.linalg.norm(shapes.quats, axis=1, keepdims=True)
        return {
            "tap.depth_predictor.depth_head.0.in0": distribution.decoder.transpose(0, 3, 1, 2),
            "tap.depth_predictor.depth_head.0": distribution.logits.transpose(0, 3, 1, 2),
            "tap.depth_predictor.upsampler": residual,
            "tap.gaussian_regressor.in0": jnp.concatenate(regressed, axis=-1).transpose(0, 3, 1, 2),
            "tap.proj": feats,
            "tap.pt": mixed - feats,
            "tap.gaussian_head.in0": mixed,
            "tap.gaussian_head": ReSplatGaussianHead(config).apply({"params": params["decoder"]}, flat),
            "out.rotations": jnp.roll(unit, -1, axis=1),  # xyzw
            **{f"out.{name}": x for name, x in outputs(gaussians).items()},
            "paper.tap.depth_predictor.depth_head.0": prediction.logits[:, ::2, ::2].transpose(0, 3, 1, 2),
            "paper.tap.gaussian_head.in0": prediction.tokens.feats,
            **{f"paper.out.{name}": x for name, x in outputs(model.decode_tokens(params, prediction.tokens)).items()},
        }

    came = jax.jit(run)(params, read_inputs(golden))
    return {name: (golden[name.removeprefix("paper.")], np.asarray(x)) for name, x in came.items()}  # pyright: ignore


def outputs(gaussians: Gaussians) -> dict:
    """Gaussians as the authors' code returns them."""
    axes = quats_to_matrices(gaussians.quats)
    return {
        "opacities": gaussians.opacities,
        "scales": gaussians.scales,
        "harmonics": gaussians.sh.swapaxes(1, 2),
        "covariances": jnp.einsum("nij,nj,nkj->nik", axes, gaussians.scales**2, axes, precision="highest"),
    }


RESPLAT_TAPS = (
    *("tap.depth_predictor.depth_head.0.in0", "tap.depth_predictor.depth_head.0", "tap.depth_predictor.upsampler"),
    *("tap.gaussian_regressor.in0", "tap.proj", "tap.pt", "tap.gaussian_head.in0", "tap.gaussian_head"),
    *("out.opacities", "out.scales", "out.rotations", "out.harmonics", "out.covariances"),
    *("paper.tap.depth_predictor.depth_head.0", "paper.tap.gaussian_head.in0", "paper.out.opacities"),
    *("paper.out.scales", "paper.out.harmonics", "paper.out.covariances"),
)


@pytest.mark.slow
@pytest.mark.parametrize("name", RESPLAT_TAPS)
def test_resplat_computes_what_the_authors_code_computes(name):
    wanted, came = resplat_values()[name]
    error = tap_error(wanted, came)
    print(f"{name}: {error:.1e} of its standard deviation")  # `pytest -rP` shows it
    assert error < TOLERANCE


@pytest.mark.slow
def test_depthsplat_depth_network_agrees_on_the_finer_grid():
    """Another layout of the same layers: two views, matching at 1/4, candidates in inverse depth."""
    golden = load_golden("depthsplat_small")
    near, far = golden["in.near_far"].tolist()
    layout = {"match_stride": 4, "num_sources": 1, "depth_space": "inverse", "depth_range": (near, far)}
    config = preset("small").replace(**layout, upstream_compat=True)
    params = named_params(config)
    views = prepare_views(read_inputs(golden), config)

    def run(params, views):
        features = resplat.encode(params["encoder"], views, config)
        distribution = resplat.match(params["cost_volume"], features, views, config)
        inverse = to_candidate_space(expected_log_depth(distribution.probs, views.log_candidates, config), config)
        height, width = views.images.shape[1:3]
        residual = Upsampler(config).apply({"params": params["upsampler"]}, features, inverse, height, width)
        return features, distribution, residual, 1 / (resize(inverse[..., None], height, width)[..., 0] + residual)

    features, distribution, residual, depths = jax.jit(run)(params, views)
    wanted = lambda name: golden[f"tap.depth_predictor.{name}"]  # noqa: E731
    for i, x in enumerate(features.cnn):
        assert tap_error(wanted(f"backbone.{i}"), nchw(x)) < TOLERANCE
    for i in range(2):
        assert tap_error(wanted(f"transformer.{i}"), nchw(features.multiview[i : i + 1])) < TOLERANCE
    assert tap_error(wanted("depth_head.0"), nchw(distribution.logits)) < TOLERANCE
    assert tap_error(wanted("upsampler"), residual) < TOLERANCE
    assert tap_error(golden["out.depth"], depths) < TOLERANCE
