"""Streams two scenes at once: `step` under vmap, over stacked caches and chunks."""

import sys

import jax
import jax.numpy as jnp

import ssplat_jax as ss


def main(paths: list[str], num_chunks: int) -> list[int]:
    """Streams the first chunks of each capture and returns how many voxels each cache holds."""
    # Inside vmap a cache cannot grow: its capacity is chosen for the stream.
    config = ss.preset("tiny").replace(capacity=1 << 14, overflow="drop_new")
    model, params = ss.StreamSplat(config), ss.load_params("tiny")
    streams = [list(ss.open_capture(path).chunks(config))[:num_chunks] for path in paths]
    caches = jax.tree.map(lambda *x: jnp.stack(x), *[model.init_cache() for _ in paths])
    step = jax.jit(jax.vmap(model.step, in_axes=(None, 0, 0)), donate_argnums=1)
    for chunks in zip(*streams, strict=True):
        caches, _ = step(params, caches, jax.tree.map(lambda *x: jnp.stack(x), *chunks))
    gaussians = jax.vmap(model.decode, in_axes=(None, 0))(params, caches)  # [stream, n, ...]
    print(f"{gaussians.means.shape[1]} rows a scene, voxels {caches.num_voxels.tolist()}")
    return caches.num_voxels.tolist()


if __name__ == "__main__":
    main(sys.argv[1:] or ["procedural:room?size=64x48", "procedural:orbit?size=64x48"], 4)
