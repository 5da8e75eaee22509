"""Procedural scenes as captures: `procedural:room?frames=73&size=128x96&seed=0`."""

from urllib.parse import parse_qsl

import numpy as np

from ssplat_jax.core.errors import echo, refusal
from ssplat_jax.data.capture import MAX_SIDE, Capture, capture_of_listing
from ssplat_jax.data.images import ArrayPixels
from ssplat_jax.data.posed_image import Frame, check_camtoworld, check_intrinsics
from ssplat_jax.data.readers import Listing

PROCEDURAL = "procedural"  # scheme of the paths of procedural captures
PROCEDURAL_FRAMES = 73  # 64 context views and the 9 interleaved targets between them
PROCEDURAL_SIZE = (128, 96)  # (width, height); the demo takes less than two minutes on two cores at this size


def open_procedural(spec: str, size: tuple[int, int] | None) -> Capture:
    """The procedural capture of a path, rendered immediately.

    Args:
        spec: the path, such as `procedural:room?frames=73&size=128x96&seed=0`.
        size: (width, height) of the images where `spec` has none.

    Raises:
        InputError: the scene or an option is unknown.
    """
    name, _, query = spec.removeprefix(f"{PROCEDURAL}:").partition("?")
    given = parse_qsl(query, keep_blank_values=True)
    options = dict(given)
    if len(options) < len(given):
        raise refusal(spec, wanted="every option once", got="one twice", fix="drop one of the two")
    if unknown := sorted(set(options) - {"frames", "size", "seed"}):
        fix = f"write {PROCEDURAL}:{name}?frames={PROCEDURAL_FRAMES}&size=128x96&seed=0"
        raise refusal(spec, wanted="the options frames, size, seed", got=echo(unknown[0]), fix=fix)
    num_frames = _whole(spec, "frames", options.get("frames", str(PROCEDURAL_FRAMES)), 1, 100_000)
    seed = _whole(spec, "seed", options.get("seed", "0"), 0, 2**31 - 1)
    width, height = size or PROCEDURAL_SIZE
    if "size" in options:
        sides = options["size"].lower().split("x")
        if len(sides) != 2:
            raise refusal(f"{spec}: size", wanted="WIDTHxHEIGHT", got=echo(options["size"]), fix="write 128x96")
        width, height = (_whole(spec, "size", side, 8, MAX_SIDE) for side in sides)
    # Imported here because the scenes load their textures, which no other capture needs.
    from ssplat_jax.data.procedural import procedural_capture_arrays

    images, depths, camtoworlds, Ks = procedural_capture_arrays(name, num_frames, height, width, seed=seed)
    intrinsics = np.stack([Ks[:, 0, 0], Ks[:, 1, 1], Ks[:, 0, 2], Ks[:, 1, 2]], axis=1).astype(np.float64).tolist()
    frames = tuple(
        Frame(
            name=f"{name}/{i:05d}",
            camtoworld=check_camtoworld(camtoworlds[i], f"{spec}: pose {i}")[0],
            K=check_intrinsics(fx=fx, fy=fy, cx=cx, cy=cy, width=width, height=height, where=spec),
            width=width,
            height=height,
        )
        for i, (fx, fy, cx, cy) in enumerate(intrinsics)
    )
    pixels = ArrayPixels(images=np.asarray(images, np.float32), depths=np.asarray(depths, np.float32))
    title = f"{PROCEDURAL}-{name}" + (f"-seed{seed}" if seed else "")
    return capture_of_listing(Listing(name=title, frames=frames), PROCEDURAL, pixels, size)


def _whole(spec: str, option: str, text: str, low: int, high: int) -> int:
    """Parses an option of a procedural path as a whole number in [low, high]."""
    if text.isascii() and text.isdigit() and len(text) < 12 and low <= int(text) <= high:
        return int(text)
    raise refusal(
        f"{spec}: {option}", wanted=f"a whole number in [{low}, {high}]", got=echo(text), fix="change the option"
    )
