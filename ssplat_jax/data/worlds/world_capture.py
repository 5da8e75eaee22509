"""Capture folders of made worlds: transforms.json, images and 16-bit z-depth in millimeters. Resumable by world."""

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
from PIL import Image

from ssplat_jax.core.errors import refusal
from ssplat_jax.data.worlds.gl_renderer import GlRenderer, open_context
from ssplat_jax.data.worlds.lighting import bake
from ssplat_jax.data.worlds.rooms import make_world
from ssplat_jax.data.worlds.textures import make_textures
from ssplat_jax.data.worlds.walks import num_blocked, sample_walk
from ssplat_jax.storage.folders import make_writable
from ssplat_jax.storage.json_files import write_json

MAX_WALKS = 24  # walks drawn before the best of them is taken


def write_worlds(
    out: Path,
    count: int,
    seed: int,
    size: tuple[int, int],
    frames: int,
    advance: Callable[..., None] = lambda done, note="": None,
) -> int:
    """Writes the folders world_00000 to world_{count - 1}; worlds that are complete are kept.

    Args:
        out: the folder of the worlds; a folder holds worlds of one seed, size and number of frames.
        count: number of worlds.
        seed: with the index of a world it determines the world.
        size: width and height in pixels.
        frames: images a world.
        advance: called with the number of finished worlds.

    Returns:
        The number of worlds rendered by this call.

    Raises:
        InputError: OpenGL is missing, or `out` holds worlds made with other options.
    """
    context, rendered = open_context(), 0  # first: without OpenGL nothing is written
    make_writable(out)
    _check_options(out / "worlds.json", {"seed": seed, "size": list(size), "frames": frames})
    try:
        for i in range(count):
            folder = out / f"world_{i:05d}"
            if not folder.exists():
                write_world(context, folder, [seed, i], size, frames)
                rendered += 1
            advance(i + 1)
    finally:
        context.release()
    return rendered


def _check_options(file: Path, options: dict) -> None:
    if not file.exists():
        write_json(file, options)
        return
    try:
        found = json.loads(file.read_text())
    except ValueError as error:
        raise refusal(str(file), wanted="JSON", got=str(error), fix="remove the file or choose another --out") from None
    if found != options:
        raise refusal(
            str(file), wanted=str(options), got=str(found), fix="repeat those options or choose another --out"
        )


def write_world(context, folder: Path, seed: list[int], size: tuple[int, int], frames: int) -> None:
    """Writes one world into `folder`, which appears when it is complete."""
    rng = np.random.default_rng(seed)
    world = make_world(rng, outdoor=bool(rng.random() < 0.25))
    textures, lights = make_textures(rng), bake(world, rng)
    focal = size[0] * float(rng.uniform(0.65, 0.95))
    renderer = GlRenderer(context, world.meshes, lights, textures, size)
    try:
        poses = _good_walk(renderer, world, rng, frames, focal)
        exposures = np.exp(np.cumsum(rng.normal(0, 0.01, frames))).tolist()
        views = [renderer.render(pose, focal, gain) for pose, gain in zip(poses, exposures, strict=True)]
    finally:
        renderer.release()
    partial = folder.with_name(folder.name + ".partial")
    shutil.rmtree(partial, ignore_errors=True)
    (partial / "images").mkdir(parents=True)
    (partial / "depth").mkdir()
    entries = []
    for i, (image, depth) in enumerate(views):
        Image.fromarray(image).save(partial / f"images/{i:05d}.png")
        millimeters = np.where(depth < 65.5, np.round(depth * 1000), 0).astype(np.uint16)
        Image.fromarray(millimeters).save(partial / f"depth/{i:05d}.png")
        paths = {"file_path": f"images/{i:05d}.png", "depth_file_path": f"depth/{i:05d}.png"}
        entries.append({**paths, "transform_matrix": poses[i].tolist(), "exposure": exposures[i]})
    lens = {"w": size[0], "h": size[1], "fl_x": focal, "fl_y": focal, "cx": size[0] / 2, "cy": size[1] / 2}
    write_json(partial / "transforms.json", {**lens, "frames": entries})
    os.replace(partial, folder)


def _good_walk(renderer, world, rng, frames, focal) -> np.ndarray:
    """The first walk without a bad view, or the walk with the fewest of `MAX_WALKS`."""
    best, fewest = None, np.inf
    for _ in range(MAX_WALKS):
        poses = sample_walk(world, rng, frames)
        bad = num_blocked(world, poses) * 10
        if bad == 0:
            bad = sum(is_bad(*renderer.render(pose, focal)) for pose in poses[:: max(1, frames // 6)])
        if bad < fewest:
            best, fewest = poses, bad
        if bad == 0:
            break
    assert best is not None
    return best


def is_bad(image: np.ndarray, depth: np.ndarray) -> bool:
    """True if a view is too close to a surface, too flat in depth, or almost without texture."""
    seen = depth[depth > 0]
    if seen.size < 0.4 * depth.size:
        return True
    near, low, high = np.percentile(seen, [1, 10, 90])
    return bool(near < 0.25 or high < 1.25 * low or image.std(axis=(0, 1)).max() < 14)
