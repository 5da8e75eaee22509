"""Cost and value of each effect: the table of docs/effects.md, which gives the command.

dB is the PSNR of the image without the effect against the image with it: low where the scene calls for it, high (or
infinite) where it does not. FLOPs and bytes are XLA's count for the program before optimization, in which the body of
the compositing loop counts once. `ms` is the median difference between the two programs, run alternately.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ssplat_jax.benchmarks import rasterizer_benchmark
from ssplat_jax.core.cameras import Camera
from ssplat_jax.core.gaussians import Gaussians
from ssplat_jax.core.pytree import replace
from ssplat_jax.rasterizer.effects import Effects
from ssplat_jax.rasterizer.render import render, round_up

NUM, SIZE = 16_384, 128
Scene = tuple[Gaussians, Camera, dict[str, Any]]


def _plain(pixels: float = 1.5, **arrays: Any) -> Scene:
    return (*rasterizer_benchmark.scene(NUM, SIZE, pixels=pixels), arrays)


def _bands(scale: float) -> Scene:
    gaussians, camera, _ = _plain()
    bands = scale * np.random.default_rng(1).normal(size=(NUM, 15, 3))
    return replace(gaussians, sh=jnp.concatenate([gaussians.sh, jnp.asarray(bands, jnp.float32)], axis=1)), camera, {}


def _zoomed(factor: float) -> Scene:
    """A scene captured by a camera with `1 / factor` of the focal length."""
    gaussians, camera, _ = _plain(0.7)
    captured = replace(camera, Ks=camera.Ks / jnp.array([[factor], [factor], [1.0]]))
    return gaussians, camera, {"captured": captured}


def _sparse(opacity: float) -> Scene:
    gaussians, camera, _ = _plain(4.0)
    return replace(gaussians, opacities=jnp.full_like(gaussians.opacities, opacity)), camera, {}


LENS = jnp.array([-0.2, 0.05, 0.002, -0.003, 0.01])
GAINS = jnp.array([[1.2, 0.0, 0.0, 0.01], [0.0, 0.9, 0.0, 0.0], [0.0, 0.0, 1.1, -0.02]])
BASE = Effects(sh_degree=0, antialias="none", outputs=("color",))


@dataclasses.dataclass(frozen=True)
class Row:
    """One effect: when a scene calls for it, the effects with and without it, and a scene of either kind."""

    name: str
    when: str
    on: Effects
    calls: Callable[[], Scene]
    spares: Callable[[], Scene]
    off: Effects = BASE
    """Rendered without the scene's arrays."""


ROWS = (
    Row(
        "SH degree 3", "any band above 0 is not 0", BASE.replace(sh_degree=3), lambda: _bands(0.3), lambda: _bands(0.0)
    ),
    Row(
        "2D Mip filter",
        "Gaussians smaller than a pixel",
        BASE.replace(antialias="mip"),
        lambda: _plain(0.2),
        lambda: _plain(6.0),
    ),
    Row(
        "classic dilation",
        "the scene was trained with it",
        BASE.replace(antialias="classic"),
        lambda: _plain(0.2),
        lambda: _plain(6.0),
    ),
    Row(
        "3D filter",
        "a camera samples the scene more finely than the captured ones",
        BASE.replace(filter_3d=True),
        lambda: _zoomed(4.0),
        lambda: _zoomed(0.5),
    ),
    Row(
        "lens distortion",
        "a coefficient is not 0",
        BASE.replace(distortion=True),
        lambda: _plain(distortion=LENS),
        lambda: _plain(distortion=0 * LENS),
    ),
    Row(
        "exposure",
        "frames differ in exposure or white balance",
        BASE.replace(exposure=True),
        lambda: _plain(exposures=GAINS),
        lambda: _plain(exposures=jnp.eye(3, 4)),
    ),
    Row(
        "background",
        "it is not black and the scene does not cover the image",
        BASE.replace(background=(1.0, 1.0, 1.0)),
        lambda: _sparse(0.01),
        lambda: _sparse(0.9),
    ),
    Row("alpha", "asked for", BASE.replace(outputs=("color", "alpha")), _plain, _plain),
    Row("depth (with alpha)", "asked for", BASE.replace(outputs=("color", "alpha", "depth")), _plain, _plain),
    Row(
        "8 feature channels",
        "passed",
        BASE,
        lambda: _plain(features=jnp.ones((NUM, 8))),
        lambda: _plain(features=jnp.ones((NUM, 8))),
    ),
    Row("median depth", "asked for", BASE.replace(outputs=("color", "median_depth")), _plain, _plain),
)


def _program(scene: Scene, effects: Effects, max_pairs: int):
    gaussians, camera, arrays = scene
    lowered = jax.jit(lambda g: render(g, camera, effects=effects, max_pairs=max_pairs, **arrays)).lower(gaussians)
    compiled = lowered.compile()
    return lowered.cost_analysis() or {}, lambda: compiled(gaussians)


def _decibels(image, truth) -> float:
    """PSNR of `image` against `truth`, peak 1; infinite where they are equal."""
    error = float(np.mean((np.asarray(image, np.float64) - np.asarray(truth, np.float64)) ** 2))
    return float("inf") if error == 0 else -10 * float(np.log10(error))


def _measure(row: Row) -> dict[str, Any]:
    """The figures of one effect: costs where a scene calls for it, and dB of both kinds of scene."""
    figures: dict[str, Any] = {"name": row.name, "when": row.when}
    for kind, scene in (("calls", row.calls()), ("spares", row.spares())):
        gaussians, camera, _ = scene
        pairs = ((scene, row.on), ((gaussians, camera, {}), row.off))
        drawn_on, drawn_off = (render(g, c, effects=effects, **given) for (g, c, given), effects in pairs)
        figures[f"dB_{kind}"] = _decibels(drawn_off.color, drawn_on.color)
        if kind == "calls":
            max_pairs = round_up(max(int(drawn_on.num_pairs), int(drawn_off.num_pairs)))
            (cost_on, on), (cost_off, off) = (_program(*pair, max_pairs) for pair in pairs)
            times = rasterizer_benchmark.alternate({"on": on, "off": off}, repetitions=7)
            figures["ms"] = float(np.median(times["on"] - times["off"]))
            for key, name in (("flops", "flops"), ("bytes accessed", "bytes")):
                figures[name] = cost_on.get(key, 0.0) - cost_off.get(key, 0.0)
    return figures


def table() -> str:
    """The table as Markdown."""
    lines = [
        "| effect | a scene calls for it when | FLOPs | bytes | ms | dB, called for | dB, not called for |",
        "|---|---|---|---|---|---|---|",
    ]
    for row in ROWS:
        f = _measure(row)
        lines.append(
            f"| {f['name']} | {f['when']} | {f['flops']:.3g} | {f['bytes']:.3g} | {f['ms']:.1f} "
            f"| {f['dB_calls']:.1f} | {f['dB_spares']:.1f} |"
        )
    return "\n".join(lines)
