"""Trains in a loop of one's own: `predict` gives tokens with gradients, `decode_tokens` renders them without the cache.

A loop through `step` trains nothing but the decoder, because no gradient flows through the cache.
"""

import sys

import jax
import jax.numpy as jnp
import optax

import ssplat_jax as ss
from ssplat_jax.training.samples import ViewSamples, procedural_sample

SIZE = (64, 64)  # height and width


def main(steps: int) -> list[float]:
    """Takes training steps on procedural scenes and returns the losses."""
    model = ss.StreamSplat(ss.preset("tiny").replace(capacity=1 << 14, overflow="drop_new", match_exposure=False))
    params = ss.load_params("tiny")
    optimizer = optax.chain(optax.clip_by_global_norm(1.0), optax.adamw(1e-4))
    state, views, losses = optimizer.init(params), ViewSamples(num_chunks=2, sizes=(SIZE,), num_targets=1), []

    def loss(params, sample):
        def body(cache, chunk):
            prediction = model.predict(params, cache, chunk)  # gradients flow to its tokens ...
            return model.update_cache(cache, prediction), prediction.tokens  # ... and none to the cache

        _, tokens = jax.lax.scan(body, model.init_cache(), sample.chunks)
        tokens = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), tokens)
        out = ss.render(model.decode_tokens(params, tokens), sample.target_camera, max_pairs=1 << 18)
        return jnp.mean((out.color - sample.target_images) ** 2)

    @jax.jit
    def update(params, state, sample):
        value, gradients = jax.value_and_grad(loss)(params, sample)
        updates, state = optimizer.update(gradients, state, params)
        return optax.apply_updates(params, updates), state, value

    for step in range(steps):
        sample = procedural_sample(views, step, SIZE, model.config)
        params, state, value = update(params, state, sample)
        losses.append(float(value))
        print(f"step {step}: loss {value:.4f}")
    return losses


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 10)
