"""Times the rasterizer against its arithmetic floor and, in the same run, against another rasterizer.

Scenes are `num` Gaussians of about one pixel over a square image, between depth 1 and 5. Every repetition times all
candidates one after the other, so that a busy machine slows them alike: the ratios are what to read.

Units: ms are medians over the repetitions, `bytes` are XLA's own temporary memory, `ratio` rows are medians of the
repetitions' ratios.
"""

import functools
import importlib.util
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ssplat_jax.errors import InputError
from ssplat_jax.gaussians import Gaussians
from ssplat_jax.geometry.cameras import Camera
from ssplat_jax.render import api, tiled
from ssplat_jax.render.binning import Grid, bin_rows
from ssplat_jax.render.effects import Effects
from ssplat_jax.render.output import splat_channels
from ssplat_jax.render.table import depth_order, sort_rows, splat_table

EFFECTS = Effects(antialias="classic")  # what the prototype does
SIZES = ((65_536, 256), (262_144, 512))
SCALING = ((4_096, 128), (16_384, 128), (65_536, 256), (262_144, 512), (524_288, 724), (1_048_576, 1024))


def scene(num: int, size: int, pixels: float = 1.0, seed: int = 0) -> tuple[Gaussians, Camera]:
    """`num` Gaussians with standard deviations of about `pixels`, all over a `size` x `size` image."""
    random = np.random.default_rng(seed)
    focal = 0.9 * size
    z = random.uniform(1.0, 5.0, num)
    x = (random.uniform(0, size, num) - size / 2) / focal * z
    y = (random.uniform(0, size, num) - size / 2) / focal * z
    scales = (pixels * z / focal)[:, None] * np.exp(random.normal(0, 0.4, (num, 3)))
    single = functools.partial(jnp.asarray, dtype=jnp.float32)
    gaussians = Gaussians.from_rgb(
        means=single(np.stack([x, y, z], axis=1)),
        quats=single(random.normal(size=(num, 4))),
        scales=single(scales),
        opacities=single(random.uniform(0.2, 0.95, num)),
        colors=single(random.uniform(0, 1, (num, 3))),
    )
    intrinsics = single([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1]])
    return gaussians, Camera(viewmats=jnp.eye(4), Ks=intrinsics, width=size, height=size)


@jax.jit
def floor(table: Float[Array, "p 6"], x: Float[Array, " q"], y: Float[Array, " q"]):
    """The unavoidable arithmetic: one opacity per pixel and pair. Written in half precision, to time no memory."""
    dx, dy = x - table[:, 0:1], y - table[:, 1:2]
    power = 0.5 * (table[:, 2:3] * dx * dx + table[:, 4:5] * dy * dy) + table[:, 3:4] * dx * dy
    return jnp.minimum(0.99, table[:, 5:6] * jnp.exp(-power)).astype(jnp.bfloat16)


def alternate(candidates: dict[str, Callable[[], Any]], repetitions: int = 11) -> dict[str, Float[np.ndarray, " r"]]:
    """Milliseconds of each candidate, run in turn; the first run of each (its compilation) is not counted."""
    times: dict[str, list[float]] = {name: [] for name in candidates}
    for turn in range(repetitions + 1):
        for name, candidate in candidates.items():
            start = time.perf_counter()
            jax.block_until_ready(candidate())
            if turn:
                times[name].append(1e3 * (time.perf_counter() - start))
    return {name: np.array(t) for name, t in times.items()}


def _loss(gaussians: Gaussians, camera: Camera, max_pairs: int):
    out = api.render(gaussians, camera, effects=EFFECTS, max_pairs=max_pairs)
    return jnp.sum(out.color**2) + sum(jnp.sum(x) for x in jax.tree.leaves((out.alpha, out.depth)))


def candidates(num: int, size: int, *, stages: bool) -> tuple[dict[str, Callable[[], Any]], dict[str, float]]:
    """What is timed on one scene, and facts about it (pairs, compile seconds, temporary bytes)."""
    gaussians, camera = scene(num, size)
    pairs = int(api.render(gaussians, camera, effects=EFFECTS).num_pairs)
    max_pairs = api.round_up(pairs)
    start = time.perf_counter()
    forward = jax.jit(lambda g: api.render(g, camera, effects=EFFECTS, max_pairs=max_pairs)).lower(gaussians).compile()
    middle = time.perf_counter()
    both = jax.jit(jax.value_and_grad(lambda g: _loss(g, camera, max_pairs))).lower(gaussians).compile()
    facts = {
        "pairs": float(pairs),
        "compile_forward_s": middle - start,
        "compile_forward_backward_s": time.perf_counter() - middle,
        "temporary_forward_bytes": _temporary_bytes(forward),
        "temporary_forward_backward_bytes": _temporary_bytes(both),
    }
    offsets = jnp.arange(api.TILE, dtype=jnp.float32)
    x, y = jnp.tile(offsets, api.TILE), jnp.repeat(offsets, api.TILE)
    table = jnp.asarray(np.random.default_rng(0).uniform(0, 1, (pairs, 6)), jnp.float32)
    runs: dict[str, Callable[[], Any]] = {
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
        usable, flat, splats, _ = api.prepare(api.Inputs(gaussians, camera), EFFECTS)
        return splats, splat_channels(usable, splats, flat, EFFECTS, None)

    @jax.jit
    def binned(splats, channels):
        order = depth_order(splats)
        table = sort_rows(splat_table(splats, channels), order)
        return table, bin_rows(table, jnp.zeros_like(order), grid, max_pairs)

    grid = Grid(num_images=1, height=camera.height, width=camera.width, tile=api.TILE)
    composited = jax.jit(lambda table, pairs: tiled.composite(grid, True, table, pairs))
    splats, channels = projected(gaussians)
    table, pairs = binned(splats, channels)
    return {
        "stage_project": lambda: projected(gaussians),
        "stage_bin": lambda: binned(splats, channels),
        "stage_composite": lambda: composited(table, pairs),
    }


def _prototype(path: Path, num: int, size: int, pairs: int) -> Callable[[], Any]:
    """Another rasterizer's forward pass on its own scene of the same statistics (`scene` and `render` of a module)."""
    spec = importlib.util.spec_from_file_location("against", path)
    if spec is None or spec.loader is None or not path.is_file():
        raise InputError(
            f"bench render: --against wants a Python file, got {path}; give the path of a rasterizer script."
        )
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    arrays = module.scene(num, size)
    focal = arrays.pop("f")
    arrays = [jnp.asarray(arrays[name]) for name in ("means", "scales", "quats", "opacities", "colors")]
    draw = functools.partial(module.render, *arrays, focal, H=size, W=size)
    own_pairs = int(draw(max_pairs=2 * api.round_up(pairs))[1])
    return lambda: draw(max_pairs=api.round_up(own_pairs))  # room by the same rule as ours


def rows_of(num: int, size: int, *, against: Path | None = None, stages: bool = True) -> list[dict[str, Any]]:
    """The rows of one scene."""
    runs, facts = candidates(num, size, stages=stages)
    if against is not None:
        runs = {"against": _prototype(against, num, size, int(facts["pairs"]))} | runs  # right before "forward"
    times = alternate(runs)
    ratios = {
        "forward_over_floor": times["forward"] / times["floor"],
        "forward_backward_over_forward": times["forward_backward"] / times["forward"],
    }
    if against is not None:
        ratios["forward_over_against"] = times["forward"] / times["against"]
    label = f"{num}_{size}"
    units = {"_s": "s", "_bytes": "bytes"}
    medians = {name: float(np.median(t)) for name, t in times.items()}
    rows = [{"name": f"{label}/{name}", "value": value, "unit": "ms"} for name, value in medians.items()]
    for name, value in facts.items():
        unit = next((u for suffix, u in units.items() if name.endswith(suffix)), "count")
        rows.append({"name": f"{label}/{name}", "value": value, "unit": unit})
    medians = {name: float(np.median(t)) for name, t in ratios.items()}
    return rows + [{"name": f"{label}/{name}", "value": value, "unit": "ratio"} for name, value in medians.items()]


def bench_render(against: Path | None = None, *, scaling: bool = False) -> list[dict[str, Any]]:
    """All rows, each `{name, value, unit}`.

    Args:
        against: a Python file with `scene` and `render` as the prototype has them, timed in the same run.
        scaling: also 4k to 1M Gaussians, without stages.

    Raises:
        InputError: `against` is not a file.
    """
    rows = [row for num, size in SIZES for row in rows_of(num, size, against=against)]
    if scaling:
        rest = [s for s in SCALING if s not in SIZES]
        rows += [row for num, size in rest for row in rows_of(num, size, stages=False)]
    return rows
