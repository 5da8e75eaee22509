"""Times of the rasterizer, against its arithmetic floor and, in the same run, against another rasterizer.

Scenes are `num` Gaussians of about one pixel over an image, at depths from 1 to 5. Every repetition times all
candidates one after the other, so that a busy machine slows all alike: read the ratios.

Units: ms are medians over the repetitions, `bytes` are XLA's own temporary memory, `ratio` rows are medians of the
repetitions' ratios.
"""

import functools
import importlib.util
import time
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
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

EFFECTS = Effects(antialias="classic")  # as in the prototype that it was first compared with
SIZES = ((65_536, 256), (262_144, 512))  # Gaussians, side of the image
SCALING = ((4_096, 128), (16_384, 128), (524_288, 724), (1_048_576, 1024))  # added by --scaling
GROWTH = (65_536, 256), (524_288, 724)  # of the same density
FULL_HD = 1_048_576, 1920, 1080


def scene(
    num: int, width: int, height: int | None = None, *, pixels: float = 1.0, seed: int = 0
) -> tuple[Gaussians, Camera]:
    """Random Gaussians all over an image.

    Args:
        num: number of Gaussians.
        width, height: the image, square by default.
        pixels: standard deviation on the screen, about.
        seed: of the random numbers.

    Returns:
        The scene and its camera.
    """
    height = width if height is None else height
    random = np.random.default_rng(seed)
    focal = 0.9 * width
    z = random.uniform(1.0, 5.0, num)
    x = (random.uniform(0, width, num) - width / 2) / focal * z
    y = (random.uniform(0, height, num) - height / 2) / focal * z
    scales = (pixels * z / focal)[:, None] * np.exp(random.normal(0, 0.4, (num, 3)))
    single = functools.partial(jnp.asarray, dtype=jnp.float32)
    gaussians = Gaussians.from_rgb(
        means=single(np.stack([x, y, z], axis=1)),
        quats=single(random.normal(size=(num, 4))),
        scales=single(scales),
        opacities=single(random.uniform(0.2, 0.95, num)),
        colors=single(random.uniform(0, 1, (num, 3))),
    )
    intrinsics = single([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    return gaussians, Camera(viewmats=jnp.eye(4), Ks=intrinsics, width=width, height=height)


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
    return jnp.sum(out.color**2) + sum(jnp.sum(x) for x in jax.tree.leaves((out.alpha, out.depth)))


def candidates(
    gaussians: Gaussians, camera: Camera, *, stages: bool
) -> tuple[dict[str, Callable[[], Any]], dict[str, float]]:
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


def load_rasterizer(path: Path) -> ModuleType:
    """Another rasterizer, as a Python module of one of two kinds.

    Either it has `candidates(means, quats, scales, opacities, colors, viewmat, K, width, height)`, which takes our
    scene as NumPy arrays and returns functions that render it and wait, `forward` and optionally `forward_backward`.
    Or it has `scene(num, size)` and `render`: a forward pass in JAX on its own scene of the same statistics, in square
    images.

    Raises:
        InputError: `path` is not a file, or imports a package that is not installed.
    """
    spec = importlib.util.spec_from_file_location("against", path)
    if spec is None or spec.loader is None or not path.is_file():
        raise InputError(
            f"bench render: --against wants a Python file, got {path}; give the path of a rasterizer script."
        )
    module = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except ImportError as error:
        raise InputError(f"bench render: {path} needs a package that is not installed: {error}; install it.") from error
    return module


def _against(module: ModuleType, gaussians: Gaussians, camera: Camera, pairs: int) -> dict[str, Callable[[], Any]]:
    """The functions of another rasterizer to time."""
    if hasattr(module, "candidates"):
        arrays = (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities)
        colors = gaussians.sh[:, 0] * SH_C0 + 0.5
        given = map(np.asarray, (*arrays, colors, camera.viewmats, camera.Ks))
        return {f"against_{name}": run for name, run in module.candidates(*given, camera.width, camera.height).items()}
    arrays = module.scene(gaussians.num_gaussians, camera.width)
    focal = arrays.pop("f")
    arrays = [jnp.asarray(arrays[name]) for name in ("means", "scales", "quats", "opacities", "colors")]
    draw = functools.partial(module.render, *arrays, focal, H=camera.height, W=camera.width)
    own_pairs = int(draw(max_pairs=2 * round_up(pairs))[1])
    return {"against_forward": lambda: draw(max_pairs=round_up(own_pairs))}  # capacity by our rule


def rows_of(
    num: int, width: int, height: int | None = None, *, against: ModuleType | None = None, stages: bool = True
) -> list[dict[str, Any]]:
    """The rows of one scene.

    Args:
        num: number of Gaussians.
        width, height: the image, square by default.
        against: another rasterizer, from `load_rasterizer`.
        stages: whether each stage is timed too.

    Returns:
        Rows of name, value and unit.
    """
    gaussians, camera = scene(num, width, height)
    runs, facts = candidates(gaussians, camera, stages=stages)
    others = {} if against is None else _against(against, gaussians, camera, int(facts["pairs"]))
    times = alternate(others | runs)
    ratios = {
        "forward_over_floor": times["forward"] / times["floor"],
        "forward_backward_over_forward": times["forward_backward"] / times["forward"],
    }
    for name in others:
        own = name.removeprefix("against_")
        ratios[f"{own}_over_against"] = times[own] / times[name]
    label = f"{num}_{width}" + ("" if height is None else f"x{height}")
    units = {"_s": "s", "_bytes": "bytes"}
    medians = {name: float(np.median(t)) for name, t in times.items()}
    rows = [{"name": f"{label}/{name}", "value": value, "unit": "ms"} for name, value in medians.items()]
    for name, value in facts.items():
        unit = next((u for suffix, u in units.items() if name.endswith(suffix)), "count")
        rows.append({"name": f"{label}/{name}", "value": value, "unit": unit})
    medians = {name: float(np.median(t)) for name, t in ratios.items()}
    return rows + [{"name": f"{label}/{name}", "value": value, "unit": "ratio"} for name, value in medians.items()]


def growth_row() -> dict[str, Any]:
    """Time of a forward pass at the larger size of `GROWTH` over that of as many Gaussians at the smaller size."""
    (few, side), (many, large_side) = GROWTH
    small, large = (candidates(*scene(*size), stages=False)[0]["forward"] for size in GROWTH)
    passes = many // few
    times = alternate({"small": lambda: [small() for _ in range(passes)], "large": large}, repetitions=21)
    ratio = float(np.median(times["large"] / times["small"]))
    return {"name": f"{many}_{large_side}/forward_over_{passes}_of_{few}_{side}", "value": ratio, "unit": "ratio"}


def bench_render(against: Path | None = None, *, scaling: bool = False, full_hd: bool = False) -> list[dict[str, Any]]:
    """All rows, each `{name, value, unit}`.

    Args:
        against: a file for `load_rasterizer`, timed in the same run.
        scaling: whether to add 4k to 1M Gaussians, without stages, and the growth from 64k to 512k.
        full_hd: whether to add 1M Gaussians at 1920 x 1080.

    Returns:
        The rows.

    Raises:
        InputError: `against` is not a file, misses a package, or cannot render these sizes.
    """
    other = None if against is None else load_rasterizer(against)
    if full_hd and other is not None and not hasattr(other, "candidates"):
        raise InputError(
            f"bench render: --full-hd wants `candidates`, {against} draws square images only; leave it out."
        )
    rows = [row for size in SIZES for row in rows_of(*size, against=other)]
    if scaling:
        rows += [row for size in SCALING for row in rows_of(*size, stages=False)]
        rows.append(growth_row())
    if full_hd:
        rows += rows_of(*FULL_HD, against=other)
    return rows
