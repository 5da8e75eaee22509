"""`open_capture`: posed images from a folder or a procedural scene, checked when they are opened.

Opening a capture reads poses, intrinsics and image headers; images are decoded on request. `verify` decodes the images
that a run will use, so that damaged files are found before anything is written.
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
from ssplat_jax.data.images import (
    MAX_PIXELS,
    ArrayPixels,
    Crop,
    FilePixels,
    Pixels,
    decode_all,
    resize_depth,
    resize_image,
)
from ssplat_jax.data.interleave import interleave
from ssplat_jax.data.pose_conventions import USUAL, Convention, reinterpreted, split_options
from ssplat_jax.data.posed_image import Frame, check_camtoworld, check_intrinsics
from ssplat_jax.data.readers import (
    Listing,
    colmap,
    kitti,
    llff,
    opensfm,
    polycam,
    realestate10k,
    record3d,
    scannet,
    splat_cameras,
    transforms_json,
    tum,
)
from ssplat_jax.data.stream_frame import StreamFrame
from ssplat_jax.errors import echo, refusal
from ssplat_jax.geometry.cameras import Camera

READERS = (  # the first one that matches reads the capture
    transforms_json,
    colmap,
    polycam,
    record3d,
    opensfm,
    llff,
    scannet,
    tum,
    kitti,
    realestate10k,
    splat_cameras,
)
PROCEDURAL = "procedural"  # scheme of the paths of procedural captures
PROCEDURAL_FRAMES = 73  # 64 context views and the 9 interleaved targets between them
PROCEDURAL_SIZE = (128, 96)  # (width, height); the demo takes less than two minutes on two cores at this size
IMAGE_SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".webp", ".heic"})  # a folder of these lacks only its poses
VIDEO_SUFFIXES = frozenset({".mp4", ".mov", ".mkv", ".webm"})
MAX_SIDE = 16384  # pixels of a delivered image


@dataclasses.dataclass(frozen=True, eq=False)
class Capture:
    """Posed images of one size, in the order of the reader. Poses and intrinsics are float64, with OpenCV axes."""

    name: str
    format: str
    frames: tuple[Frame, ...]  # the stored images, before they are resized
    pixels: Pixels
    width: int  # of the delivered images
    height: int
    notes: tuple[str, ...] = ()  # messages of the reader for the user
    convention: Convention = USUAL  # of the poses in the files

    def __repr__(self) -> str:
        """Name, format, and number and size of the images; poses and pixels are too long to print."""
        return f"Capture({self.name!r}, {self.format}, {len(self)} frames of {self.width}x{self.height})"

    def __len__(self) -> int:
        return len(self.frames)

    @property
    def camtoworlds(self) -> Float64[np.ndarray, "v 4 4"]:
        """Camera-to-world poses of all frames, in the capture frame."""
        return np.stack([frame.camtoworld for frame in self.frames])

    def digest(self, indices: Sequence[int]) -> str:
        """Digest (12 hex digits) of the poses, intrinsics, lenses and file names of the frames `indices`."""
        digest = hashlib.sha256()
        for frame in (self.frames[i] for i in indices):
            digest.update(f"{frame.name}\n".encode())
            digest.update(frame.camtoworld.tobytes() + frame.K.tobytes())
            if frame.lens is not None:
                digest.update(repr(frame.lens).encode())
        return digest.hexdigest()[:12]

    def images_digest(self, indices: Sequence[int]) -> str:
        """Digest (12 hex digits) of the bytes of the image files of the frames `indices`; uses all cores.

        Images without a file are ignored: procedural images follow from the name of the capture.
        """

        def digest_file(path: Path) -> bytes:
            with path.open("rb") as file:
                return hashlib.file_digest(file, "sha256").digest()

        paths = [path for path in (self.frames[i].path for i in indices) if path is not None]
        with ThreadPoolExecutor() as pool:
            return hashlib.sha256(b"".join(pool.map(digest_file, paths))).hexdigest()[:12]

    def scaled(self, factor: float) -> "Capture":
        """Returns the same capture with images `factor` times as large, at least one pixel."""
        width, height = (max(1, round(side * factor)) for side in (self.width, self.height))
        return dataclasses.replace(self, width=width, height=height)

    def crop(self, i: int) -> Crop:
        """The part of stored image `i` that the delivered image shows."""
        return Crop.cover((self.frames[i].width, self.frames[i].height), (self.width, self.height))

    def K(self, i: int) -> Float64[np.ndarray, "3 3"]:
        """Intrinsics of delivered image `i`, in pixels."""
        return self.crop(i).intrinsics(self.frames[i].K)

    def image(self, i: int) -> Float32[np.ndarray, "h w 3"]:
        """Returns image `i` as RGB in [0, 1], at the size of the capture.

        Raises:
            InputError: the file is damaged.
        """
        image, crop = self.pixels.image(i), self.crop(i)
        return image if crop.is_identity else resize_image(image, crop)

    def depth(self, i: int) -> Float32[np.ndarray, "h w"] | None:
        """Returns depth map `i` (camera z in capture units, 0 where unknown), or None if the frame has none."""
        depth, frame, crop = self.pixels.depth(i), self.frames[i], self.crop(i)
        if depth is None or (crop.is_identity and depth.shape == (self.height, self.width)):
            return depth
        return resize_depth(depth, crop, (frame.width, frame.height))

    def check_output_folder(self, out: Path) -> None:
        """Checks that results do not mix with the capture's files: a run overwrites and clears files of its folder.

        Raises:
            InputError: an image or depth map lies in `out` or below it, or `out` lies below a folder of such files.
        """
        folder = out.resolve()
        for frame in self.frames:
            for path in (frame.path, frame.depth_path):
                if path is None:
                    continue
                file = path.resolve()
                if file.is_relative_to(folder) or folder.is_relative_to(file.parent):
                    got, fix = "the folder of the capture's own images", "choose another --out"
                    raise refusal(str(out), wanted="a folder for results alone", got=got, fix=fix)

    def verify(self, indices: Sequence[int] | None = None) -> None:
        """Decodes the images and depth maps of the frames `indices` (default: all) to find damaged files.

        Decoding uses all cores and takes about 1 ms per image of 480x360 pixels.

        Raises:
            InputError: a file is damaged; the message names the first one.
        """
        decode_all(self.pixels, range(len(self)) if indices is None else indices)

    def stream_frame(self, config: StreamConfig, indices: Sequence[int] | None = None) -> StreamFrame:
        """Returns the stream frame of a run over the frames `indices` (default: all).

        Near, far and the automatic scale are estimated from these frames only (`data.depth_range`); the other frames,
        which include the targets of an evaluation, have no influence. With `causal`, only the first chunk has any.
        """
        used = _indices(self, indices)
        if config.stream.causal:
            used = used[: config.stream.chunk_size]
            # Other frames must not even bound the rounding of poses.
            alone = dataclasses.replace(
                self, frames=tuple(self.frames[i] for i in used), pixels=_Some(self.pixels, used)
            )
            depths = estimate_depths(alone, range(len(used)))
        else:
            depths = estimate_depths(self, used)
        scale, near, far = stream_scale(depths, config)
        first = self.frames[used[0]].camtoworld
        return StreamFrame.at_camera(first, scale=scale, near=near, far=far, warning=depths.warning)

    def camera(
        self, i: int, frame: StreamFrame | None = None, *, offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    ) -> Camera:
        """Returns the camera of frame `i`: in the capture frame, in which scene files are, or in a stream frame.

        Args:
            i: the number of the frame.
            frame: a stream frame (`stream_frame`); None gives the camera in the capture frame.
            offset: point of the capture frame to which a scene's positions are relative, if `frame` is None.

        Raises:
            InputError: there is no such frame.
        """
        _indices(self, [i])
        frame = frame or StreamFrame.at_point(offset)
        viewmat = frame.viewmats(self.frames[i].camtoworld)
        K = self.K(i).astype(np.float32)
        return Camera(viewmats=jnp.asarray(viewmat), Ks=jnp.asarray(K), width=self.width, height=self.height)

    def stream_order(self, config: StreamConfig, indices: Sequence[int] | None, frame: StreamFrame) -> list[int]:
        """Returns `indices` (default: all) in the order of streaming, with slow video interleaved (`data.interleave`).

        The typical depth is taken to be the geometric mean of `near` and `far`. With `causal`, frames keep their order.
        """
        used = _indices(self, indices)
        if config.stream.causal:
            return used
        centers = np.stack([self.frames[i].center for i in used])
        return interleave(
            centers,
            used,
            config.stream.chunk_size,
            config.stream.chunk_step * math.sqrt(frame.near * frame.far) / frame.scale,
        )

    def chunks(
        self, config: StreamConfig, indices: Sequence[int] | None = None, *, frame: StreamFrame | None = None
    ) -> Iterator[Chunk]:
        """Yields chunks of `config.stream.chunk_size` views; a thread reads one chunk ahead.

        The last chunk is padded with invalid views: black images with the identity pose and the intrinsics of the
        chunk's first view.

        Args:
            config: the configuration of the model.
            indices: frames in the order of streaming; by default all frames, in `stream_order`.
            frame: by default `stream_frame(config, indices)`.
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
        """Images, viewmats, Ks and validity of one padded chunk."""
        images = np.zeros((chunk_size, self.height, self.width, 3), np.float32)
        viewmats = np.tile(np.eye(4, dtype=np.float32), (chunk_size, 1, 1))
        Ks = np.tile(self.K(group[0]).astype(np.float32), (chunk_size, 1, 1))
        for row, i in enumerate(group):
            images[row], Ks[row] = self.image(i), self.K(i)
        viewmats[: len(group)] = frame.viewmats(np.stack([self.frames[i].camtoworld for i in group]))
        return images, viewmats, Ks, np.arange(chunk_size) < len(group)


@dataclasses.dataclass(frozen=True, eq=False)
class _Some:
    """The images of some frames, by their place in `indices`."""

    pixels: Pixels
    indices: Sequence[int]

    def image(self, i: int) -> Float32[np.ndarray, "h w 3"]:
        return self.pixels.image(self.indices[i])

    def depth(self, i: int) -> Float32[np.ndarray, "h w"] | None:
        return self.pixels.depth(self.indices[i])

    def has_depth(self, i: int) -> bool:
        return self.pixels.has_depth(self.indices[i])


def open_capture(path: str | Path, *, size: tuple[int, int] | None = None) -> Capture:
    """Opens the capture at `path`.

    Args:
        path: a folder or file in one of the formats of `data.readers`, or a procedural scene (room, orbit, corridor),
            such as `procedural:room?frames=73&size=128x96&seed=0`. Poses that do not follow the convention of their
            format are read with options behind it: `folder?axes=opengl&poses=world-to-camera`.
        size: (width, height) of delivered images. Stored images are scaled to cover it and cropped at the center, and
            the intrinsics follow exactly. By default the size of the stored images.

    Raises:
        InputError: there is no capture at `path`, or a file or field of it is unusable; the message names it.
    """
    if size is not None and not all(1 <= side <= MAX_SIDE for side in size):
        raise refusal("size", wanted=f"sides of 1 to {MAX_SIDE}", got=echo(size), fix="give WIDTHxHEIGHT in pixels")
    if size is not None and size[0] * size[1] > MAX_PIXELS:
        wanted = f"at most {MAX_PIXELS:,} pixels"
        raise refusal("size", wanted=wanted, got=f"{size[0]}x{size[1]}", fix="ask for a smaller one")
    if str(path).startswith(f"{PROCEDURAL}:"):
        return _procedural(str(path), size)
    path, options = split_options(str(path))
    try:
        folder = Path(path).expanduser()
        found = next((reader for reader in READERS if reader.matches(folder)), None)
        exists = folder.exists()
    except (OSError, RuntimeError, ValueError) as error:  # unknown user, name too long, no permission
        raise refusal(str(path)[:80], wanted="a path", got=str(error)[:200], fix="check the path") from None
    if found is not None:
        usual = getattr(found, "CONVENTION", USUAL)
        written = dataclasses.replace(usual, **options)
        listing = found.read(folder)
        frames = tuple(reinterpreted(frame, usual, written) for frame in listing.frames)
        listing = dataclasses.replace(listing, frames=frames if options else listing.frames)
        return capture_of_listing(listing, found.FORMAT, FilePixels(listing.frames), size, written)
    if not exists:
        got, fix = "nothing of that name", "check the path"
    elif folder.is_dir() and not any(folder.iterdir()):
        got, fix = "an empty folder", "check the path"
    elif unposed := _unposed(folder):
        kind, source = unposed
        got = f"none of these, but {kind} without camera poses"
        example = f"ssplat poses {source} --out {source.stem or 'my'}_capture"
        fix = f"estimate the poses first: {example} (COLMAP by pycolmap), and give the folder that it writes"
    else:
        got, fix = "none of these", f"see --help of `ssplat inspect` for their files, or try {PROCEDURAL}:room"
    formats = ", ".join(reader.FORMAT for reader in READERS)
    raise refusal(str(path), wanted=f"a posed capture ({formats})", got=got, fix=fix)


def is_capture(path: Path) -> bool:
    """Whether a reader reads `path`: it looks like a capture, which may still be damaged."""
    return any(reader.matches(path) for reader in READERS)


def _unposed(path: Path) -> tuple[str, Path] | None:
    """The kind of images that a path holds without poses, "images" or "a video", and where they are; or None."""
    if path.is_file():
        return ("a video", path) if path.suffix.lower() in VIDEO_SUFFIXES else None
    files = [file for folder in (path, path / "images") if folder.is_dir() for file in sorted(folder.iterdir())]
    if any(file.suffix.lower() in IMAGE_SUFFIXES for file in files):
        return "images", path
    return next((("a video", file) for file in files if file.suffix.lower() in VIDEO_SUFFIXES), None)


def capture_of_listing(
    listing: Listing, format: str, pixels: Pixels, size: tuple[int, int] | None, convention: Convention = USUAL
) -> Capture:
    """Capture of a listing whose images all have one size; `size` is that of the delivered ones (`open_capture`)."""
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
        convention=convention,
    )


def _indices(capture: Capture, indices: Sequence[int] | None) -> list[int]:
    """Returns `indices`, checked, or those of all frames."""
    used = list(range(len(capture)) if indices is None else indices)
    if not used or not all(0 <= i < len(capture) for i in used):
        wanted = f"frame numbers in [0, {len(capture) - 1}], at least one"
        raise refusal(f"{capture.name}: frames", wanted=wanted, got=echo(used), fix="choose other frames")
    return used


def _procedural(spec: str, size: tuple[int, int] | None) -> Capture:
    """Procedural capture `spec`, rendered immediately; a size in `spec` comes before `size`."""
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
