"""Speed on a GPU by one command, in one JSON file: rasterizers side by side, streams stage by stage, refinement.

    pip install -e ".[cuda]" splax torch gsplat
    python experiments/on_a_gpu.py --out on_a_gpu.json

It is to take less than 12 minutes. In place of what fails, or is not installed, stands its error. `--scale smoke` tries
all of it on a CPU. `ssplat bench render --against experiments/on_a_gpu.py` times gsplat alone beside ours.
"""

import argparse
import functools
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from ssplat_experiments import bench_refine, bench_render
from ssplat_experiments.cost import stage_times
from ssplat_experiments.settings import Setting, Sizes, measure_refined
from ssplat_experiments.streams import open_room
from ssplat_experiments.study import compile_quickly

from ssplat_jax.config import preset
from ssplat_jax.core.cameras import Camera
from ssplat_jax.core.gaussians import Gaussians
from ssplat_jax.data.open_capture import open_capture
from ssplat_jax.evaluation.cost import commit, machine, measure_latency, peak_memory, today
from ssplat_jax.model.streamsplat import StreamSplat
from ssplat_jax.rasterizer.render import render, round_up
from ssplat_jax.refinement import RefineConfig, refine
from ssplat_jax.storage.files import write_json
from ssplat_jax.storage.weights import load_params
from ssplat_jax.streaming.session import Session, feed_capture

Runs = dict[str, Callable[[], Any]]
Row = dict[str, Any]

SCENES = {
    "smoke": ((256, 64, 32),),
    "gpu": ((65_536, 256, 256), (262_144, 512, 512), (1_048_576, 1920, 1080)),
}
"""Gaussians, width and height of the rendered scenes."""
STREAMS = {
    "smoke": (("tiny", (64, 48)),),
    "gpu": (("tiny", (320, 240)), ("small", (448, 256)), ("small", (640, 480)), ("paper", (448, 256))),
}
"""Presets, and width and height of the streamed images."""
REFINED = {"smoke": (2048, (32, 24), 3), "gpu": (524_288, (320, 240), 100)}
"""Rows of the scene, size of its views, and steps."""
QUALITY = {"smoke": (Sizes(8, (64, 48)), (2,)), "gpu": (Sizes(64, (320, 240)), (25, 50, 100, 200, 400))}
"""Stream that is refined, and the numbers of steps after which it is scored."""


def candidates(means, quats, scales, opacities, colors, viewmat, K, width: int, height: int) -> Runs:
    """gsplat's CUDA kernels on arrays of NumPy: `forward` and `forward_backward`, which wait for the device.

    Color, alpha and expected depth of Gaussians that are dilated by 0.3 square pixels; the gradient reaches all arrays.
    """
    import torch  # pyright: ignore[reportMissingImports]
    from gsplat import rasterization  # pyright: ignore[reportMissingImports]

    gaussians = [torch.tensor(x, device="cuda").requires_grad_() for x in (means, quats, scales, opacities, colors)]
    cameras = [torch.tensor(x, device="cuda")[None] for x in (viewmat, K)]

    def draw():
        return rasterization(*gaussians, *cameras, width, height, render_mode="RGB+ED")[:2]

    def forward():
        with torch.no_grad():
            draw()
        torch.cuda.synchronize()

    def forward_backward():
        out, alphas = draw()
        torch.autograd.grad((out[..., :3] ** 2).sum() + alphas.sum() + out[..., 3].sum(), gaussians)
        torch.cuda.synchronize()

    return {"forward": forward, "forward_backward": forward_backward}


def with_splax(gaussians: Gaussians, camera: Camera) -> tuple[Runs, Row]:
    """splax on our scene, and how far its images and gradients are from ours, relative to the largest of them."""
    import splax  # pyright: ignore[reportMissingImports]

    K, max_pairs = camera.Ks.tolist(), round_up(int(render(gaussians, camera, effects=bench_render.EFFECTS).num_pairs))
    options = {"img_shape": (camera.height, camera.width), "f": (K[0][0], K[1][1]), "c": (K[0][2], K[1][2])}

    def draw(g: Gaussians, viewmat):
        logits = jnp.log(g.opacities) - jnp.log1p(-g.opacities)
        splats = (g.means, jnp.log(g.scales), g.quats, g.sh, logits)
        out, alpha = splax.render(*splats, viewmat=viewmat, background=jnp.zeros(3), render_depth=True, **options)
        return out[..., :3], alpha, out[..., 3]

    def ours(g: Gaussians, viewmat):
        view = Camera(viewmat, camera.Ks, camera.width, camera.height)
        out = render(g, view, effects=bench_render.EFFECTS, max_pairs=max_pairs)
        return out.color, out.alpha, out.depth

    def loss(f, *arguments):
        color, alpha, depth = f(*arguments)
        return jnp.sum(color**2) + jnp.sum(alpha) + jnp.sum(depth)

    arguments = (gaussians, camera.viewmats)
    images = [jax.jit(f)(*arguments) for f in (draw, ours)]
    gradients = [jax.jit(jax.grad(functools.partial(loss, f), argnums=(0, 1)))(*arguments) for f in (draw, ours)]
    parts = [(*shown, *vars(scene).values(), pose) for shown, (scene, pose) in zip(images, gradients, strict=True)]
    names = ("color", "alpha", "depth", *(f"d_{name}" for name in vars(gaussians)), "d_viewmats")
    found = {n: float(jnp.abs(a - b).max() / jnp.abs(b).max()) for n, a, b in zip(names, *parts, strict=True)}
    forward = jax.jit(draw).lower(*arguments).compile()
    both = jax.jit(jax.value_and_grad(functools.partial(loss, draw))).lower(*arguments).compile()
    runs: Runs = {"forward": lambda: forward(*arguments), "forward_backward": lambda: both(*arguments)}
    return runs, {"error": found}


OTHERS = {"gsplat": lambda *scene: (bench_render.runs_of(candidates, *scene), {}), "splax": with_splax}


def rasterizers(scale: str) -> list[Row]:
    """Milliseconds of each rasterizer on each scene, by turns."""
    rows = []
    for num, width, height in SCENES[scale]:
        gaussians, camera = bench_render.scene(num, width, height)
        facts: Row = {"gaussians": num, "size": [width, height]}
        runs, facts["ours"] = bench_render.candidates(gaussians, camera, stages=True)
        for name, make in OTHERS.items():
            try:
                others, facts[name] = make(gaussians, camera)
                runs |= {f"{name}_{kind}": run for kind, run in others.items()}
            except Exception as error:  # it is not installed, or has no device, or fails in any other way
                facts[name] = repr(error)
        times = bench_render.alternate(runs, repetitions=3 if scale == "smoke" else 21)
        rows.append(facts | {"ms": {name: round(float(np.median(ms)), 3) for name, ms in times.items()}})
    return rows


def streams(scale: str) -> list[Row]:
    """Milliseconds of each stage from a chunk to a novel view, and of the whole. Untrained presets keep all tokens."""
    rows = []
    for name, size in STREAMS[scale]:
        config = preset(name).replace(**({} if name == "tiny" else {"min_confidence": 0.0}))
        model = StreamSplat(config)
        session = Session(model, load_params("tiny") if name == "tiny" else model.init(jax.random.key(0)))
        num_views = 2 * config.stream.chunk_size
        capture = open_capture(f"procedural:room?frames={num_views}", size=size)
        stream_frame = capture.stream_frame(config)
        _, recent = feed_capture(session, capture, range(num_views), stream_frame, num_recent=2)
        camera = capture.camera(num_views // 2, stream_frame)
        stages = stage_times(session, recent[-1], camera, repeats=1 if scale == "smoke" else 15)
        facts = {"whole_ms": measure_latency(session, recent, camera)["chunk_ms"], **session.cache_facts()}
        row = {"preset": name, "size": size, "stages_ms": {stage: round(ms, 3) for stage, ms in stages.items()}}
        rows.append(row | facts | {"peak_memory_bytes": peak_memory(session, camera)["peak_memory_bytes"]})
    return rows


def refinement(scale: str) -> Row:
    """Time of steps on a large scene, and the quality of a streamed room against seconds of refinement."""
    num_rows, (width, height), steps = REFINED[scale]
    gaussians, cameras = bench_refine.scene(num_rows, width, height)
    images = np.random.default_rng(1).uniform(0, 1, (bench_refine.NUM_VIEWS, height, width, 3)).astype(np.float32)
    _, report = refine(gaussians, cameras, images, steps=steps, config=RefineConfig(held_back=0.0))
    facts = {"rows": num_rows, "steps": steps, "seconds_per_step": report.seconds_per_step}
    sizes, counts = QUALITY[scale]
    settings = [Setting(refine_steps=count) for count in counts]
    return facts | {"room": measure_refined(settings, sizes, functools.partial(open_room, sizes.context))}


def main(scale: str, out: Path) -> None:
    """Runs all parts and writes the file after each."""
    if scale == "smoke":
        compile_quickly()
    found: Row = {"machine": machine(), "date": today(), "commit": commit()}
    found["device"] = jax.devices()[0].device_kind
    for part in (rasterizers, streams, refinement):
        since = time.perf_counter()
        try:
            found[part.__name__] = part(scale)
        except Exception as error:  # time on a GPU is short: the other parts still run
            if scale == "smoke":
                raise
            found[part.__name__] = {"error": repr(error)}
        found[f"{part.__name__}_s"] = round(time.perf_counter() - since, 1)
        write_json(out, found)
        print(f"{part.__name__}: {found[f'{part.__name__}_s']} s", flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Measures the speed of ssplat_jax on a GPU.")
    parser.add_argument("--out", type=Path, default=Path("on_a_gpu.json"))
    parser.add_argument("--scale", choices=("smoke", "gpu"), default="gpu")
    main(**vars(parser.parse_args()))
