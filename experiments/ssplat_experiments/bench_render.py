"""`ssplat bench render`: times of the rasterizer, against its arithmetic floor and against another rasterizer.

Scenes are Gaussians of about one pixel over an image, at depths from 1 to 5. Every repetition times all candidates one
after the other, so that a busy machine slows all alike: read the ratios. `bytes` are XLA's own temporary memory.
"""

import functools
import runpy
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ssplat_jax.core.cameras import Camera
from ssplat_jax.core.errors import InputError
from ssplat_jax.core.gaussians import SH_C0, Gaussians
from ssplat_jax.rasterizer import constants
from ssplat_jax.rasterizer.binning import Grid, intersect_tiles, sorted_table
from ssplat_jax.rasterizer.compositing import composite
from ssplat_jax.rasterizer.effects import Effects
from ssplat_jax.rasterizer.outputs import splat_channels
from ssplat_jax.rasterizer.render import TILE, RenderInputs, prepare, render, round_up

EFFECTS = Effects(antialias="classic")
SIZES = ((65_536, 256, 256), (262_144, 512, 512))  # Gaussians, width and height
LARGE = ((4_096, 128, 128), (16_384, 128, 128), (524_288, 724, 724), (1_048_576, 1024, 1024), (1_048_576, 1920, 1080))


def run(against: Path | None = None, large: bool = False) -> list[dict[str, Any]]:
    """All rows, each `{name, value, unit}`.

    Args:
        against: another rasterizer, a Python file with `candidates(means, quats, scales, opacities, colors, viewmat, K,
            width, height)`, which takes our scene as NumPy arrays and returns `{"forward": f, "forward_backward": f}`.
        large: whether to add 4k to 1M Gaussians, without stages.

    Raises:
        InputError: `against` is not such a file, or misses a package.
    """
    other = None if against is None else load_rasterizer(against)
    rows = [row for size in SIZES for row in rows_of(*size, against=other)]
    return rows + [row for size in LARGE if large for row in rows_of(*size, against=other, stages=False)]


def scene(num: int, width: int, height: int, *, pixels: float = 1.0, seed: int = 0) -> tuple[Gaussians, Camera]:
    """Random Gaussians of a standard deviation of about `pixels` all over an image, and its camera."""
    random, focal = np.random.default_rng(seed), 0.9 * width
    z = random.uniform(1.0, 5.0, num)
    x = (random.uniform(0, width, num) - width / 2) / focal * z
    y = (random.uniform(0, height, num) - height / 2) / focal * z
    single = functools.partial(jnp.asarray, dtype=jnp.float32)
    gaussians = Gaussians.from_rgb(
        means=single(np.stack([x, y, z], axis=1)),
        quats=single(random.normal(size=(num, 4))),
        scales=single((pixels * z / focal)[:, None] * np.exp(random.normal(0, 0.4, (num, 3)))),
        opacities=single(random.uniform(0.2, 0.95, num)),
        colors=single(random.uniform(0, 1, (num, 3))),
    )
    K = single([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    return gaussians, Camera(viewmats=jnp.eye(4), Ks=K, width=width, height=height)


@jax.jit
def floor(table: Float[Array, "p 6"], x: Float[Array, " q"], y: Float[Array, " q"]):
    """The unavoidable arithmetic: one alpha per pixel and pair, stored in half precision to spare memory traffic."""
    dx, dy = x - table[:, 0:1], y - table[:, 1:2]
    power = 0.5 * (table[:, 2:3] * dx * dx + table[:, 4:5] * dy * dy) + table[:, 3:4] * dx * dy
    return jnp.minimum(constants.ALPHA_MAX, table[:, 5:6] * jnp.exp(-power)).astype(jnp.bfloat16)


def alternate(candidates: dict[str, Callable[[], Any]], repetitions: int = 11) -> dict[str, Float[np.ndarray, " r"]]:
    """Milliseconds of each candidate, run alternately; the first run of each (its compilation) is not counted."""
    times: dict[str, list[float]] = {name: [] for name in candidates}
    for repetition in range(repetitions + 1):
        for name, candidate in candidates.items():
            start = time.perf_counter()
            jax.block_until_ready(candidate())
            if repetition:
                times[name].append(1e3 * (time.perf_counter() - start))
    return {name: np.array(t) for name, t in times.items()}


def _loss(gaussians: Gaussians, camera: Camera, max_pairs: int):
    out = render(gaussians, camera, effects=EFFECTS, max_pairs=max_pairs)
    return jnp.sum(out.color**2) + jnp.sum(out.alpha) + jnp.sum(out.depth)


def candidates(gaussians: Gaussians, camera: Camera, *, stages: bool) -> tuple[dict[str, Callable], dict[str, float]]:
    """The functions to time on one scene, and facts about it: pairs, compile seconds, temporary bytes."""
    pairs = int(render(gaussians, camera, effects=EFFECTS).num_pairs)
    max_pairs = round_up(pairs)
    start = time.perf_counter()
    forward = jax.jit(lambda g: render(g, camera, effects=EFFECTS, max_pairs=max_pairs)).lower(gaussians).compile()
    middle = time.perf_counter()
    both = jax.jit(jax.value_and_grad(lambda g: _loss(g, camera, max_pairs))).lower(gaussians).compile()
    facts = {
        "pairs": float(pairs),
        "compile_forward_s": middle - start,
        "compile_forward_backward_s": time.perf_counter() - middle,
        "temporary_forward_bytes": _temporary_bytes(forward),
        "temporary_forward_backward_bytes": _temporary_bytes(both),
    }
    offsets = jnp.arange(TILE, dtype=jnp.float32)
    x, y = jnp.tile(offsets, TILE), jnp.repeat(offsets, TILE)
    table = jnp.asarray(np.random.default_rng(0).uniform(0, 1, (pairs, 6)), jnp.float32)
    runs = {
        "forward": lambda: forward(gaussians),
        "forward_backward": lambda: both(gaussians),
        "floor": lambda: floor(table, x, y),
    }
    return (runs | _stages(gaussians, camera, max_pairs) if stages else runs), facts


def _temporary_bytes(compiled) -> float:
    analysis = compiled.memory_analysis()
    return float(analysis.temp_size_in_bytes) if analysis is not None else float("nan")


def _stages(gaussians: Gaussians, camera: Camera, max_pairs: int) -> dict[str, Callable[[], Any]]:
    """The three stages of the forward pass, each compiled alone."""

    @jax.jit
    def projected(gaussians):
        usable, flat, splats, _ = prepare(RenderInputs(gaussians, camera), EFFECTS)
        return splats, splat_channels(usable, splats, flat, EFFECTS, None)

    @jax.jit
    def binned(splats, channels):
        table, order = sorted_table(splats, channels, grid)
        return table, intersect_tiles(table, jnp.zeros_like(order), grid, max_pairs)

    grid = Grid(num_images=1, height=camera.height, width=camera.width, tile=TILE)
    composited = jax.jit(lambda table, pairs: composite(grid, True, table, pairs))
    splats, channels = projected(gaussians)
    table, pairs = binned(splats, channels)
    return {
        "stage_project": lambda: projected(gaussians),
        "stage_bin": lambda: binned(splats, channels),
        "stage_composite": lambda: composited(table, pairs),
    }


def load_rasterizer(path: Path) -> Callable[..., dict]:
    """The `candidates` of another rasterizer, a Python file; see `run`.

    Raises:
        InputError: there is no such file, it needs a package that is not installed, or it has no `candidates`.
    """
    try:
        return runpy.run_path(str(path))["candidates"]
    except (OSError, ImportError, LookupError) as error:
        raise InputError(
            f"bench render: --against wants a Python file with `candidates`, got {path} ({error!r}); see"
            " experiments/on_a_gpu.py."
        ) from error


def runs_of(candidates: Callable[..., dict], gaussians: Gaussians, camera: Camera) -> dict[str, Callable[[], Any]]:
    """The functions of another rasterizer to time, from its `candidates`."""
    arrays = (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities)
    given = map(np.asarray, (*arrays, gaussians.sh[:, 0] * SH_C0 + 0.5, camera.viewmats, camera.Ks))
    return candidates(*given, camera.width, camera.height)


def rows_of(
    num: int, width: int, height: int, *, against: Callable[..., dict] | None = None, stages: bool = True
) -> list[dict[str, Any]]:
    """The rows of one scene; `stages` says whether each stage is timed too."""
    gaussians, camera = scene(num, width, height)
    runs, facts = candidates(gaussians, camera, stages=stages)
    others = {} if against is None else runs_of(against, gaussians, camera)
    others = {f"against_{name}": run for name, run in others.items()}
    times = alternate(others | runs)
    ratios = {
        "forward_over_floor": times["forward"] / times["floor"],
        "forward_backward_over_forward": times["forward_backward"] / times["forward"],
    }
    for name in others:
        own = name.removeprefix("against_")
        ratios[f"{own}_over_against"] = times[own] / times[name]
    units = {"_s": "s", "_bytes": "bytes"}
    found = [(name, float(np.median(t)), "ms") for name, t in times.items()]
    found += [(n, x, next((u for end, u in units.items() if n.endswith(end)), "count")) for n, x in facts.items()]
    found += [(name, float(np.median(t)), "ratio") for name, t in ratios.items()]
    return [{"name": f"{num}_{width}x{height}/{name}", "value": x, "unit": unit} for name, x, unit in found]
