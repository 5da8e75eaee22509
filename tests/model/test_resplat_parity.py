"""ReSplat's network against the outputs of the authors' PyTorch code with the same weights.

Through `StreamSplat` with the preset `paper` and an empty cache; the depth network of DepthSplat stage by stage.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ssplat_jax.config import preset
from ssplat_jax.core.chunk import Chunk
from ssplat_jax.core.rotations import quats_to_matrices
from ssplat_jax.model import resplat
from ssplat_jax.model.hpda import expected_log_depth
from ssplat_jax.model.network import init_params
from ssplat_jax.model.resplat.resplat_tokens import Upsampler
from ssplat_jax.model.resplat.torch_layers import resize
from ssplat_jax.model.streamsplat import StreamSplat
from ssplat_jax.model.views import prepare_views, to_candidate_space
from ssplat_jax.storage.weights import as_published
from tests.model.resplat_fixture import load_golden, named_params, tap_error
from tests.model.small import chunk_of

TOLERANCE = 2e-4
"""Largest error in standard deviations of a tap; float32 against float64 gives 3.4e-5."""


@pytest.fixture(autouse=True)
def _exact_products():
    """Computes matrix products in full float32, which GPUs by default do not."""
    with jax.default_matmul_precision("highest"):
        yield


def read_inputs(golden: dict) -> Chunk:
    images = golden["in.image_u8"].transpose(0, 2, 3, 1) / 255.0
    height, width = images.shape[1:3]
    K = golden["in.intrinsics"] * [[width], [height], [1]]
    return chunk_of(images, np.linalg.inv(golden["in.extrinsics"].astype(np.float64)), K, *golden["in.near_far"])


def nchw(x) -> np.ndarray:
    return np.asarray(x).transpose(0, 3, 1, 2)


@pytest.mark.slow
def test_resplat_computes_what_the_authors_code_computes():
    """Depths, tokens and Gaussians."""
    golden = load_golden("resplat_small")
    near, far = golden["in.near_far"].tolist()
    # As `import-weights` writes it.
    config = as_published(preset("paper")).replace(depth_range=(near, far), capacity=128)
    model = StreamSplat(config)
    params = init_params(jax.random.key(0), config, {"hpda", "cgfi"}) | named_params(config)

    def run(params, chunk: Chunk):
        prediction = model.predict(params, model.init_cache(), chunk)
        gaussians = model.decode_tokens(params, prediction.tokens)
        axes = quats_to_matrices(gaussians.quats)
        return {
            "tap.depth_predictor.depth_head.0": prediction.distribution.logits.transpose(0, 3, 1, 2),
            "tap.gaussian_head.in0": prediction.tokens.feats,
            "out.opacities": gaussians.opacities,
            "out.scales": gaussians.scales,
            "out.harmonics": gaussians.sh.swapaxes(1, 2),
            "out.covariances": jnp.einsum("nij,nj,nkj->nik", axes, gaussians.scales**2, axes, precision="highest"),
        }

    came = jax.jit(run)(params, read_inputs(golden))
    errors = {name: tap_error(golden[name], np.asarray(x)) for name, x in came.items()}
    print(errors)  # `pytest -rP` shows them
    assert max(errors.values()) < TOLERANCE


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
