"""A narrow network and small views, shared by the tests of the network so that each program is compiled once."""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from ssplat_jax.cache.project import ProjectedCache
from ssplat_jax.config import StreamConfig
from ssplat_jax.core.chunk import Chunk
from ssplat_jax.core.pytree import replace
from ssplat_jax.model import network
from ssplat_jax.model.streamsplat import StreamSplat
from tests.core.test_rotations import rodrigues

CONFIG = StreamConfig().replace(
    chunk_size=3,
    encoder_widths=(8, 16),
    encoder_blocks=1,
    attention_blocks=1,
    attention_window=4,
    num_depths=12,
    match_width=8,
    unet_width=8,
    token_width=16,
    hpda=True,
    anchor="log",  # one strength; the narrow model of the streaming tests has the learned anchor
    cgfi=True,
    cgfi_width=8,
    mixer_blocks=1,
    mixer_neighbors=4,
    mixer_proj=8,
    min_confidence=0.0,
    capacity=1 << 10,
)
MODEL = StreamSplat(CONFIG)
HEIGHT, WIDTH = 24, 30  # padded to 32 x 32, so that every test has cells outside the image


@functools.cache
def random_params(config: StreamConfig, seed: int = 0) -> dict:
    """Random parameters, without the zero-initialized layers of untrained ones, which would hide errors.

    They are drawn with NumPy, so that nothing is compiled.
    """
    rng = np.random.default_rng(seed)

    def draw(path, leaf):
        values = rng.normal(size=leaf.shape)
        if leaf.ndim > 1:  # a kernel: unit gain
            values /= np.sqrt(np.prod(leaf.shape[:-1]))
        else:  # a norm's scale about 1, a bias or a scalar about 0
            values = 0.1 * values + path[-1].key.endswith("scale")
        return jnp.asarray(values, jnp.float32)

    shapes = jax.eval_shape(StreamSplat(config).init, jax.random.key(0))
    with jax.ensure_compile_time_eval():  # the first caller may be inside jit, and what it got is kept
        return jax.tree_util.tree_map_with_path(draw, shapes)


def draw_with_numpy(patch, compiled: tuple[str, ...] = ()) -> None:
    """Lets untrained stages be drawn with NumPy from their keys, so that no program of them is compiled.

    Stages named in `compiled` start as ever.
    """
    initial = network._init_stage

    def drawn(key, config, name, net):
        if name in compiled or isinstance(key, jax.core.Tracer):
            return initial(key, config, name, net)
        rng = np.random.default_rng(np.asarray(jax.random.key_data(key)))
        shapes = jax.eval_shape(lambda k: initial(k, config, name, net), key)
        return jax.tree.map(lambda x: rng.normal(size=x.shape).astype(x.dtype), shapes)

    patch.setattr(network, "_init_stage", drawn)


params = functools.partial(random_params, CONFIG)
"""Random parameters of `CONFIG`."""


def chunk(seed: int = 0, *, views: int = 3, baseline: float = 0.2, height: int = HEIGHT, width: int = WIDTH) -> Chunk:
    """Views in a row along x, all looking ahead, with random smooth images."""
    rng = np.random.default_rng(seed)
    coarse = rng.uniform(size=(views, height // 3 + 1, width // 3 + 1, 3))
    images = np.repeat(np.repeat(coarse, 3, axis=1), 3, axis=2)[:, :height, :width]
    K = [[28.0, 0, width / 2 + 1], [0, 27.0, height / 2 - 1], [0, 0, 1]]
    return chunk_of(images, side_by_side(baseline * np.arange(views)), K, near=1.0, far=6.0)


def side_by_side(places) -> np.ndarray:
    """View matrices of cameras at x = `places` that look along +z."""
    viewmats = np.tile(np.eye(4), (len(places), 1, 1))
    viewmats[:, 0, 3] = -np.asarray(places)
    return viewmats


def chunk_of(images, viewmats, K, near: float, far: float) -> Chunk:
    """Views of one camera, all valid."""
    single = lambda x: jnp.asarray(x, jnp.float32)  # noqa: E731
    Ks, valid = np.tile(K, (len(images), 1, 1)), jnp.ones(len(images), bool)
    return Chunk(single(images), single(viewmats), single(Ks), valid, single(near), single(far))


@jax.jit
@functools.partial(jax.value_and_grad, argnums=(0, 1, 2, 3, 4), has_aux=True)
def _differentiated(params, images, viewmats, Ks, remembered, cache, chunk):
    before = replace(cache, means=remembered[0], feats=remembered[1])
    prediction = MODEL.predict(params, before, replace(chunk, images=images, viewmats=viewmats, Ks=Ks))
    scene = MODEL.decode_tokens(params, prediction.tokens)
    leaves = (scene, prediction.tokens.confidences, prediction.log_depths)
    results = prediction, MODEL.update_cache(cache, prediction)
    return sum(jnp.mean(jnp.sin(x)) for x in jax.tree.leaves(leaves)), results


def program(params, cache, chunk):
    """The step with gradients in one program: `(value, (prediction, cache after it)), gradients`.

    The gradients of a sum over the outputs are with respect to parameters, images, poses, intrinsics, and the positions
    and features in the cache.
    """
    return _differentiated(params, chunk.images, chunk.viewmats, chunk.Ks, (cache.means, cache.feats), cache, chunk)


def step(params, cache, chunk):
    """The cache after a chunk, and the output."""
    (_, (prediction, after)), _ = program(params, cache, chunk)
    return after, prediction.output


@functools.cache
def warm_cache():
    """A cache after one chunk, so that there is a history to project."""
    return step(params(), MODEL.init_cache(), chunk(7))[0]


def turned(angle: float) -> jax.Array:
    """View matrices that rotate about the vertical through one center: there is no parallax."""
    viewmats = np.tile(np.eye(4), (3, 1, 1))
    for i, matrix in enumerate(viewmats):
        matrix[:3, :3] = rodrigues([0, 1, 0], angle * i)
    return jnp.asarray(viewmats, jnp.float32)


def history(depths, confidences, feats=None, mask=None, colors=None) -> ProjectedCache:
    """A projected cache with given values; `mask` defaults to cells with a depth."""
    depths = jnp.asarray(depths, jnp.float32)
    given = lambda x, channels: jnp.zeros((*depths.shape, channels)) if x is None else jnp.asarray(x, jnp.float32)  # noqa: E731
    return ProjectedCache(
        depths=depths,
        confidences=jnp.asarray(confidences, jnp.float32),
        feats=given(feats, CONFIG.network.token_width),
        mask=depths > 0 if mask is None else jnp.asarray(mask),
        colors=given(colors, 3),
    )


def finite(tree) -> bool:
    """True if every float of the tree is finite."""
    return all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(tree) if jnp.issubdtype(leaf.dtype, jnp.floating))
