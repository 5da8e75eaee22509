"""Streams a capture through the jitted step, with a cache that grows outside jit, and writes the scene."""

import sys
from pathlib import Path

import jax

import ssplat_jax as ss
from ssplat_jax.streaming.session import tokens_per_chunk


def main(capture_path: str, out: Path) -> None:
    config = ss.preset("tiny")
    model, params = ss.StreamSplat(config), ss.load_params("tiny")
    step, cache = jax.jit(model.step, donate_argnums=1), model.init_cache()
    capture = ss.open_capture(capture_path)
    for chunk in capture.chunks(config):
        # Outside jit: doubles a cache that might fill up, which compiles the step once more.
        cache = ss.ensure_capacity(cache, config, tokens_per_chunk(chunk, config.network.size_multiple))
        cache, out_chunk = step(params, cache, chunk)
        ss.check_cache(cache, config)  # raises if tokens were lost
        print(f"{int(cache.num_voxels)} voxels, mean confidence {float(out_chunk.confidences.mean()):.2f}")
    frame = capture.stream_frame(config)
    ss.save_ply(out, frame.gaussians_to_capture(jax.jit(model.decode)(params, cache)))


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else "procedural:room", Path("scene.ply"))
