"""`ssplat bench effects`: cost and value of each effect of the rasterizer, the table of docs/effects.md.

dB is the PSNR of the image without the effect against the image with it: low where the scene calls for it, high (or
infinite) where it does not. FLOPs are XLA's count for the program before optimization, in which the body of the
compositing loop counts once. `ms` is the median difference between the two programs, run alternately.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ssplat_experiments.bench_render import alternate, scene
from ssplat_jax.core.cameras import Camera
from ssplat_jax.core.gaussians import Gaussians
from ssplat_jax.core.pytree import replace
from ssplat_jax.rasterizer.effects import Effects
from ssplat_jax.rasterizer.render import render, round_up

NUM, SIZE = 16_384, 128
Scene = tuple[Gaussians, Camera, dict[str, Any]]


def _plain(pixels: float = 1.5, **arrays: Any) -> Scene:
    return (*scene(NUM, SIZE, SIZE, pixels=pixels), arrays)


def _bands(scale: float) -> Scene:
    gaussians, camera, _ = _plain()
    bands = scale * np.random.default_rng(1).normal(size=(NUM, 15, 3))
    return replace(gaussians, sh=jnp.concatenate([gaussians.sh, jnp.asarray(bands, jnp.float32)], axis=1)), camera, {}


def _zoomed(factor: float) -> Scene:
    """A scene captured by a camera with `1 / factor` of the focal length."""
    gaussians, camera, _ = _plain(0.7)
    return gaussians, camera, {"captured": replace(camera, Ks=camera.Ks / jnp.array([[factor], [factor], [1.0]]))}


def _sparse(opacity: float) -> Scene:
    gaussians, camera, _ = _plain(4.0)
    return replace(gaussians, opacities=jnp.full_like(gaussians.opacities, opacity)), camera, {}


LENS = jnp.array([-0.2, 0.05, 0.002, -0.003, 0.01])
GAINS = jnp.array([[1.2, 0.0, 0.0, 0.01], [0.0, 0.9, 0.0, 0.0], [0.0, 0.0, 1.1, -0.02]])
EQUAL = jnp.eye(3, 4)
BASE = Effects(sh_degree=0, antialias="none", outputs=("color",))


class Row(NamedTuple):
    """One effect: its name, the effects with it, a scene that calls for it, and one that does not."""

    name: str
    on: Effects
    calls: Callable[[], Scene]
    spares: Callable[[], Scene]


ROWS = (
    Row("SH degree 3", BASE.replace(sh_degree=3), lambda: _bands(0.3), lambda: _bands(0.0)),
    Row("2D Mip filter", BASE.replace(antialias="mip"), lambda: _plain(0.2), lambda: _plain(6.0)),
    Row("classic dilation", BASE.replace(antialias="classic"), lambda: _plain(0.2), lambda: _plain(6.0)),
    Row("3D filter", BASE.replace(filter_3d=True), lambda: _zoomed(4.0), lambda: _zoomed(0.5)),
    Row(
        "lens distortion",
        BASE.replace(distortion=True),
        lambda: _plain(distortion=LENS),
        lambda: _plain(distortion=0 * LENS),
    ),
    Row("exposure", BASE.replace(exposure=True), lambda: _plain(exposures=GAINS), lambda: _plain(exposures=EQUAL)),
    Row("background", BASE.replace(background=(1.0, 1.0, 1.0)), lambda: _sparse(0.01), lambda: _sparse(0.9)),
    Row("alpha", BASE.replace(outputs=("color", "alpha")), _plain, _plain),
    Row("depth (with alpha)", BASE.replace(outputs=("color", "alpha", "depth")), _plain, _plain),
    Row("8 feature channels", BASE, *[lambda: _plain(features=jnp.ones((NUM, 8)))] * 2),
    Row("median depth", BASE.replace(outputs=("color", "median_depth")), _plain, _plain),
)


def run() -> list[dict[str, Any]]:
    """Rows of name, value and unit: five figures an effect."""
    return [row for effect in ROWS for row in measure(effect)]


def _program(scene: Scene, effects: Effects, max_pairs: int):
    gaussians, camera, arrays = scene
    lowered = jax.jit(lambda g: render(g, camera, effects=effects, max_pairs=max_pairs, **arrays)).lower(gaussians)
    compiled = lowered.compile()
    return lowered.cost_analysis() or {}, lambda: compiled(gaussians)


def _decibels(image, truth) -> float:
    """PSNR of `image` against `truth`, peak 1; infinite where they are equal."""
    error = float(np.mean((np.asarray(image, np.float64) - np.asarray(truth, np.float64)) ** 2))
    return float("inf") if error == 0 else -10 * float(np.log10(error))


def measure(row: Row) -> list[dict[str, Any]]:
    """The figures of one effect: costs where a scene calls for it, and dB of both kinds of scene."""
    figures: list[tuple[str, float, str]] = []
    for kind, (gaussians, camera, arrays) in (("called for", row.calls()), ("not called for", row.spares())):
        pairs = (((gaussians, camera, arrays), row.on), ((gaussians, camera, {}), BASE))
        drawn_on, drawn_off = (render(g, c, effects=effects, **given) for (g, c, given), effects in pairs)
        figures.append((kind, _decibels(drawn_off.color, drawn_on.color), "dB"))
        if kind == "called for":
            max_pairs = round_up(max(int(drawn_on.num_pairs), int(drawn_off.num_pairs)))
            (cost_on, on), (cost_off, off) = (_program(*pair, max_pairs) for pair in pairs)
            times = alternate({"on": on, "off": off}, repetitions=7)
            figures.append(("time", float(np.median(times["on"] - times["off"])), "ms"))
            for key, unit in (("flops", "FLOP"), ("bytes accessed", "B")):
                figures.append((key, cost_on.get(key, 0.0) - cost_off.get(key, 0.0), unit))
    return [{"name": f"{row.name}/{name}", "value": value, "unit": unit} for name, value, unit in figures]
