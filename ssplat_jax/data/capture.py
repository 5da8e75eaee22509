"""`open_capture`: a folder of posed images, or a procedural scene, as frames that are checked before anything runs.

Opening reads poses, intrinsics and image headers; images are decoded when asked for. `verify` decodes those a run will
use, so that damage is found before anything is written.
"""

import dataclasses
import hashlib
import math
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from urllib.parse import parse_qsl

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float32, Float64

from ssplat_jax.chunk import Chunk
from ssplat_jax.config import StreamConfig
from ssplat_jax.data.depth_range import estimate_depths, stream_scale
from ssplat_jax.data.images import ArrayPixels, Crop, FilePixels, Pixels, decode_all, resize_depth, resize_image
from ssplat_jax.data.interleave import deal
from ssplat_jax.data.posed_image import Frame, check_camtoworld, check_intrinsics
from ssplat_jax.data.readers import Listing, colmap, realestate10k, scannet, transforms_json, tum
from ssplat_jax.data.stream_frame import StreamFrame
from ssplat_jax.errors import echo, refusal
from ssplat_jax.geometry.cameras import Camera

READERS = (transforms_json, colmap, scannet, tum, realestate10k)  # the first that matches reads
PROCEDURAL = "procedural"
PROCEDURAL_FRAMES = 73  # 64 context views and the 9 interleaved targets between them
PROCEDURAL_SIZE = (128, 96)  # (width, height): a demo on two cores ends within two minutes
MAX_SIDE = 16384  # of a delivered image


@dataclasses.dataclass(frozen=True, eq=False)
class Capture:
    """Posed images in the order in which they are streamed. Poses and intrinsics float64, OpenCV axes."""

    name: str
    format: str
    frames: tuple[Frame, ...]  # as stored
    pixels: Pixels
    width: int  # of the delivered images
    height: int
    notes: tuple[str, ...] = ()  # what reading found worth telling

    def __len__(self) -> int:
        return len(self.frames)

    @property
    def camtoworlds(self) -> Float64[np.ndarray, "v 4 4"]:
        """All poses, capture frame."""
        return np.stack([frame.camtoworld for frame in self.frames])

    def digest(self, indices: Sequence[int]) -> str:
        """Twelve hex digits that name the poses, intrinsics, lenses and file names of the frames `indices`."""
        digest = hashlib.sha256()
        for frame in (self.frames[i] for i in indices):
            digest.update(f"{frame.name}\n".encode())
            digest.update(frame.camtoworld.tobytes() + frame.K.tobytes())
            if frame.lens is not None:
                digest.update(repr(frame.lens).encode())
        return digest.hexdigest()[:12]

    def images_digest(self, indices: Sequence[int]) -> str:
        """Twelve hex digits that name the image files of the frames `indices` by their bytes, on all cores.

        Images in memory are made from the capture's name.
        """

        def digest_file(path: Path) -> bytes:
            with path.open("rb") as file:
                return hashlib.file_digest(file, "sha256").digest()

        paths = [path for path in (self.frames[i].path for i in indices) if path is not None]
        with ThreadPoolExecutor() as pool:
            return hashlib.sha256(b"".join(pool.map(digest_file, paths))).hexdigest()[:12]

    def scaled(self, factor: float) -> "Capture":
        """The same capture with images of `factor` times the size, at least one pixel."""
        width, height = (max(1, round(side * factor)) for side in (self.width, self.height))
        return dataclasses.replace(self, width=width, height=height)

    def crop(self, i: int) -> Crop:
        """What the delivered image shows of the stored one."""
        return Crop.cover((self.frames[i].width, self.frames[i].height), (self.width, self.height))

    def K(self, i: int) -> Float64[np.ndarray, "3 3"]:
        """Intrinsics of the delivered image, pixels."""
        return self.crop(i).intrinsics(self.frames[i].K)

    def image(self, i: int) -> Float32[np.ndarray, "h w 3"]:
        """RGB in [0, 1], at the capture's size.

        Raises:
            InputError: the file is damaged.
        """
        image, crop = self.pixels.image(i), self.crop(i)
        return image if crop.is_identity else resize_image(image, crop)

    def depth(self, i: int) -> Float32[np.ndarray, "h w"] | None:
        """Camera z in capture units at the capture's size, 0 where unknown; None without a depth map."""
        depth, frame, crop = self.pixels.depth(i), self.frames[i], self.crop(i)
        if depth is None or (crop.is_identity and depth.shape == (self.height, self.width)):
            return depth
        return resize_depth(depth, crop, (frame.width, frame.height))

    def check_apart(self, out: Path) -> None:
        """Refuses results among the capture's own files: what stands in `out` is cleared and written over.

        Raises:
            InputError: an image or depth map lies in `out` or below.
        """
        folder = out.resolve()
        for frame in self.frames:
            for path in (frame.path, frame.depth_path):
                if path is not None and path.resolve().is_relative_to(folder):
                    got, fix = "the folder of the capture's own images", "choose another --out"
                    raise refusal(str(out), wanted="a folder for results alone", got=got, fix=fix)

    def verify(self, indices: Sequence[int] | None = None) -> None:
        """Decodes the images and depth maps of `indices` (default all) once, on all cores: about 1 ms for 480x360.

        Raises:
            InputError: naming the first damaged file.
        """
        decode_all(self.pixels, range(len(self)) if indices is None else indices)

    def stream_frame(self, config: StreamConfig, indices: Sequence[int] | None = None) -> StreamFrame:
        """The stream frame of a run over the frames `indices` (default all): its first camera, scale and depth range.

        Near, far and the automatic scale come from matches among these frames only (`data.scale`), so a capture's other
        frames, the targets of an evaluation among them, have no say.
        """
        used = _indices(self, indices)
        depths = estimate_depths(self, used)
        scale, near, far = stream_scale(depths, config)
        first = self.frames[used[0]].camtoworld
        return StreamFrame.at_camera(first, scale=scale, near=near, far=far, warning=depths.warning)

    def camera(self, i: int, frame: StreamFrame) -> Camera:
        """The camera of frame `i` in the stream frame."""
        viewmat = frame.viewmats(self.frames[i].camtoworld)
        K = self.K(i).astype(np.float32)
        return Camera(viewmats=jnp.asarray(viewmat), Ks=jnp.asarray(K), width=self.width, height=self.height)

    def stream_order(self, config: StreamConfig, indices: Sequence[int] | None, frame: StreamFrame) -> list[int]:
        """`indices` (default all) as `run`, `eval` and `demo` stream them: video dealt out (`data.order`).

        The typical depth is taken to be the geometric mean of the sweep's ends.
        """
        used = _indices(self, indices)
        centers = np.stack([self.frames[i].center for i in used])
        return deal(
            centers,
            used,
            config.stream.chunk_size,
            config.stream.chunk_step * math.sqrt(frame.near * frame.far) / frame.scale,
        )

    def chunks(
        self, config: StreamConfig, indices: Sequence[int] | None = None, *, frame: StreamFrame | None = None
    ) -> Iterator[Chunk]:
        """The frames `indices`, as they stand, in chunks of `config.stream.chunk_size`; a thread reads one chunk ahead.

        Without `indices`: all frames, in `stream_order`.

        The last chunk is padded to full size with views that are not valid: black images, the identity pose, the
        intrinsics of the chunk's first view. `frame` defaults to `stream_frame(config, indices)`.
        """
        used = _indices(self, indices)
        frame = frame or self.stream_frame(config, used)
        if indices is None:
            used = self.stream_order(config, None, frame)
        groups = [used[k : k + config.stream.chunk_size] for k in range(0, len(used), config.stream.chunk_size)]
        with ThreadPoolExecutor(1) as reader:
            ahead = reader.submit(self._views, groups[0], config.stream.chunk_size, frame)
            for following in (*groups[1:], None):
                images, viewmats, Ks, valid = ahead.result()
                if following is not None:
                    ahead = reader.submit(self._views, following, config.stream.chunk_size, frame)
                yield Chunk(
                    images=jnp.asarray(images),
                    viewmats=jnp.asarray(viewmats),
                    Ks=jnp.asarray(Ks),
                    valid=jnp.asarray(valid),
                    near=jnp.float32(frame.near),
                    far=jnp.float32(frame.far),
                )

    def _views(self, group: Sequence[int], chunk_size: int, frame: StreamFrame) -> tuple[np.ndarray, ...]:
        """Images, viewmats, Ks and valid of one chunk, padded."""
        images = np.zeros((chunk_size, self.height, self.width, 3), np.float32)
        viewmats = np.tile(np.eye(4, dtype=np.float32), (chunk_size, 1, 1))
        Ks = np.tile(self.K(group[0]).astype(np.float32), (chunk_size, 1, 1))
        for row, i in enumerate(group):
            images[row], Ks[row] = self.image(i), self.K(i)
        viewmats[: len(group)] = frame.viewmats(np.stack([self.frames[i].camtoworld for i in group]))
        return images, viewmats, Ks, np.arange(chunk_size) < len(group)


def open_capture(path: str | Path, *, size: tuple[int, int] | None = None) -> Capture:
    """The capture at `path`: a folder in one of the formats of `readers`, its file, or `procedural:NAME`.

    `procedural:room?frames=73&size=128x96&seed=0`; scenes are room, orbit, corridor. `size` is the (width, height) of
    delivered images: stored ones are scaled to cover it and cropped at the center, `K` following exactly.

    Raises:
        InputError: nothing readable there, or anything in it is unusable; names the file and field.
    """
    if size is not None and not all(1 <= side <= MAX_SIDE for side in size):
        raise refusal("size", wanted=f"sides of 1 to {MAX_SIDE}", got=echo(size), fix="give WIDTHxHEIGHT in pixels")
    if str(path).startswith(f"{PROCEDURAL}:"):
        return _procedural(str(path), size)
    try:
        folder = Path(path).expanduser()
        found = next((reader for reader in READERS if reader.matches(folder)), None)
        exists = folder.exists()
    except (OSError, RuntimeError, ValueError) as error:  # no such user, too long a name, no permission
        raise refusal(str(path)[:80], wanted="a path", got=str(error)[:200], fix="check the path") from None
    if found is not None:
        listing = found.read(folder)
        return _capture(listing, found.FORMAT, FilePixels(listing.frames), size)
    if not exists:
        got, fix = "nothing of that name", "check the path"
    elif folder.is_dir() and not any(folder.iterdir()):
        got, fix = "an empty folder", "check the path"
    else:
        got, fix = "none of these", f"see --help of `ssplat inspect` for their files, or try {PROCEDURAL}:room"
    formats = ", ".join(reader.FORMAT for reader in READERS)
    raise refusal(str(path), wanted=f"a posed capture ({formats})", got=got, fix=fix)


def _capture(listing: Listing, format: str, pixels: Pixels, size: tuple[int, int] | None) -> Capture:
    """A capture whose images all have one size."""
    if size is None:
        first = listing.frames[0]
        size = (first.width, first.height)
        for frame in listing.frames:
            if (frame.width, frame.height) != size:
                got = f"{size[0]}x{size[1]} ({echo(first.name)}) and {frame.width}x{frame.height} ({echo(frame.name)})"
                raise refusal(listing.name, wanted="images of one size", got=got, fix="ask for one with --size WxH")
    return Capture(
        name=listing.name,
        format=format,
        frames=listing.frames,
        pixels=pixels,
        width=size[0],
        height=size[1],
        notes=listing.notes,
    )


def _indices(capture: Capture, indices: Sequence[int] | None) -> list[int]:
    """The frames to use, checked."""
    used = list(range(len(capture)) if indices is None else indices)
    if not used or not all(0 <= i < len(capture) for i in used):
        wanted = f"frame numbers in [0, {len(capture) - 1}], at least one"
        raise refusal(f"{capture.name}: frames", wanted=wanted, got=echo(used), fix="choose other frames")
    return used


def _procedural(spec: str, size: tuple[int, int] | None) -> Capture:
    """The scene that `spec` names, ray-cast at once (at `size` unless the spec has its own)."""
    name, _, query = spec.removeprefix(f"{PROCEDURAL}:").partition("?")
    options = dict(parse_qsl(query, keep_blank_values=True))
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
    # Imported here: the scenes bring their textures along, which no other capture needs.
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
    return _capture(Listing(name=title, frames=frames), PROCEDURAL, pixels, size)


def _whole(spec: str, option: str, text: str, low: int, high: int) -> int:
    """A whole number of the spec."""
    if text.isascii() and text.isdigit() and len(text) < 12 and low <= int(text) <= high:
        return int(text)
    raise refusal(f"{spec}: {option}", wanted=f"a whole number in [{low}, {high}]", got=echo(text), fix="change it")
