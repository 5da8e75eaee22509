"""`Capture`: posed images whose poses, intrinsics and headers are checked, and whose pixels are decoded on request.

    Frame (checked) + Pixels -> depth range -> StreamFrame -> chunks

A damaged image is found when it is decoded: the `InputError` comes from the iterator of chunks, at its chunk.
"""

import dataclasses
import functools
import hashlib
import math
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Protocol, runtime_checkable

import jax
import numpy as np
from jaxtyping import Bool, Float32, Float64

from ssplat_jax.config import StreamConfig
from ssplat_jax.core.cameras import Camera
from ssplat_jax.core.chunk import Chunk
from ssplat_jax.core.errors import echo, refusal
from ssplat_jax.core.kept_programs import kept_result
from ssplat_jax.core.numerics import evenly_spread
from ssplat_jax.data.depth_range import DepthStatistics, estimate_depths, stream_scale
from ssplat_jax.data.images import Crop, decode_depth, decode_image, decode_mask, undistort
from ssplat_jax.data.posed_image import USUAL, Convention, Frame
from ssplat_jax.data.readers.frame_list import Listing
from ssplat_jax.data.split import interleave
from ssplat_jax.data.stream_frame import StreamFrame

MAX_SIDE = 16384  # pixels of a delivered image
NUM_DECODERS = 3  # images decoded at a time: one of 12 megapixels takes 0.3 GB
MAX_DEPTH_RATIO = 1.5  # median of the depth maps over that of the matches, or its inverse; above it there is a warning
NUM_DEPTH_MAPS_READ = 8  # evenly spread; a median needs no more
KEPT_IMAGES, KEPT_BYTES = 160, 256 << 20  # most decoded images that wait for their second use


@runtime_checkable
class Pixels(Protocol):
    """Source of a capture's images, masks and depth maps, by the index of the frame.

    `image` delivers RGB in [0, 1] at the size of `crop`; `seen` the pixels of it that are not masked out, or None if
    all count; `depth` the stored map (camera z in capture units, 0 where unknown), or None if there is none, which
    `has_depth` tells without decoding it. `version` is another text once the stored image or mask is another.
    """

    def image(self, i: int, crop: Crop) -> Float32[np.ndarray, "h w 3"]: ...
    def seen(self, i: int, crop: Crop) -> Bool[np.ndarray, "h w"] | None: ...
    def depth(self, i: int) -> Float32[np.ndarray, "h w"] | None: ...
    def has_depth(self, i: int) -> bool: ...
    def version(self, i: int) -> str: ...


@dataclasses.dataclass(frozen=True, eq=False)
class FilePixels:
    """Images and depth maps that are decoded from files and undistorted.

    While there is room, a decoded image is kept for its next use: to stream after the depth range, or to be pictured.
    A use after that decodes it again. Masks and depth maps are never kept.
    """

    frames: Sequence[Frame]
    kept: dict[tuple[int, Crop], Float32[np.ndarray, "h w 3"]] = dataclasses.field(default_factory=dict)

    def image(self, i: int, crop: Crop) -> Float32[np.ndarray, "h w 3"]:
        kept = self.kept.pop((i, crop), None)
        if kept is not None:
            return kept
        frame = self.frames[i]
        assert frame.path is not None  # readers of files always set it
        image = decode_image(frame.path, (frame.width, frame.height))
        image = crop.image(image if frame.lens is None else undistort(image, frame.lens, frame.K))
        if len(self.kept) < min(KEPT_IMAGES, KEPT_BYTES // image.nbytes):
            image.flags.writeable = False
            self.kept[i, crop] = image
        return image

    def seen(self, i: int, crop: Crop) -> Bool[np.ndarray, "h w"] | None:
        frame = self.frames[i]
        if not frame.is_masked:
            return None
        assert frame.path is not None
        mask = decode_mask(frame.path, frame.mask_path, (frame.width, frame.height))
        return crop.mask(mask if frame.lens is None else undistort(mask, frame.lens, frame.K, outside=0.0))

    def depth(self, i: int) -> Float32[np.ndarray, "h w"] | None:
        frame = self.frames[i]
        if frame.depth_path is None:
            return None
        depth = decode_depth(frame.depth_path, frame.depth_unit)
        if frame.lens is None:
            return depth
        sizes = np.array([depth.shape[1] / frame.width, depth.shape[0] / frame.height, 1.0])
        return undistort(depth, frame.lens, np.diag(sizes) @ frame.K, order=0, outside=0.0)

    def has_depth(self, i: int) -> bool:
        return self.frames[i].depth_path is not None

    def version(self, i: int) -> str:
        paths = [path for path in (self.frames[i].path, self.frames[i].mask_path) if path is not None]
        try:
            return " ".join(f"{path.resolve()} {(x := path.stat()).st_size} {x.st_mtime_ns}" for path in paths)
        except OSError:  # whoever decodes it says so
            return "unreadable"


@dataclasses.dataclass(frozen=True, eq=False)
class ArrayPixels:
    """Images, depth maps and masks held in memory."""

    images: Float32[np.ndarray, "v h w 3"]
    depths: Float32[np.ndarray, "v h w"]
    masks: Bool[np.ndarray, "v h w"] | None = None  # False: pixels that do not count; their frames are `is_masked`

    def image(self, i: int, crop: Crop) -> Float32[np.ndarray, "h w 3"]:
        return crop.image(self.images[i])

    def seen(self, i: int, crop: Crop) -> Bool[np.ndarray, "h w"] | None:
        return None if self.masks is None else crop.mask(self.masks[i].astype(np.float32))

    def depth(self, i: int) -> Float32[np.ndarray, "h w"] | None:
        return self.depths[i]

    def has_depth(self, i: int) -> bool:
        return True

    def version(self, i: int) -> str:
        parts = (self.images[i], np.zeros(0) if self.masks is None else self.masks[i])
        return hashlib.sha256(b"".join(part.tobytes() for part in parts)).hexdigest()


@dataclasses.dataclass(frozen=True, eq=False)
class Capture:
    """Posed images of one size, in the order of streaming. Poses and intrinsics are float64, with OpenCV axes."""

    name: str
    format: str
    frames: tuple[Frame, ...]  # the stored images, before they are resized
    pixels: Pixels
    width: int  # of the delivered images
    height: int
    notes: tuple[str, ...] = ()  # messages of the reader for the user
    convention: Convention = USUAL  # of the poses in the files
    streams_depth: bool = False  # chunks bring the depth maps that frames have

    def __repr__(self) -> str:  # poses and pixels are too long to print
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
            digest.update(f"{frame.name}\n".encode(errors="surrogateescape"))  # names are bytes on Linux
            digest.update(frame.camtoworld.tobytes() + frame.K.tobytes())
            for part in (frame.lens, frame.mask_path and frame.mask_path.name):
                if part is not None:
                    digest.update(repr(part).encode())
        return digest.hexdigest()[:12]

    def files_digest(self, i: int) -> str:
        """Digest (12 hex digits) of the bytes of the files that frame `i` streams: image, mask and depth map.

        Images without a file are ignored: procedural images follow from the name of the capture.
        """
        frame = self.frames[i]
        paths = (frame.path, frame.mask_path, frame.depth_path if self.streams_depth else None)
        digests = [hashlib.sha256(path.read_bytes()).digest() for path in paths if path is not None]
        return hashlib.sha256(b"".join(digests)).hexdigest()[:12]

    def scaled(self, factor: float) -> "Capture":
        """The same capture with images `factor` times as large, at least one pixel."""
        width, height = (max(1, round(side * factor)) for side in (self.width, self.height))
        return dataclasses.replace(self, width=width, height=height)

    def crop(self, i: int) -> Crop:
        """The part of stored image `i` that the delivered image shows."""
        return Crop.cover((self.frames[i].width, self.frames[i].height), (self.width, self.height))

    def K(self, i: int) -> Float64[np.ndarray, "3 3"]:
        """Intrinsics of delivered image `i`, in pixels."""
        return self.crop(i).intrinsics(self.frames[i].K)

    def image(self, i: int) -> Float32[np.ndarray, "h w 3"]:
        """Image `i` as RGB in [0, 1], at the size of the capture."""
        return self.pixels.image(i, self.crop(i))

    @functools.cached_property
    def is_masked(self) -> bool:
        """True if some frame has pixels that may not count."""
        return any(frame.is_masked for frame in self.frames)

    def seen(self, i: int) -> Bool[np.ndarray, "h w"] | None:
        """The pixels of image `i` that are neither masked out nor outside of what the camera saw.

        None if no frame of the capture has others.
        """
        if not self.is_masked:
            return None
        seen = self.pixels.seen(i, self.crop(i))
        return np.ones((self.height, self.width), bool) if seen is None else seen

    def depth(self, i: int) -> Float32[np.ndarray, "h w"] | None:
        """Depth map `i` (camera z in capture units, 0 where unknown), or None if the frame has none."""
        depth, frame = self.pixels.depth(i), self.frames[i]
        return None if depth is None else self.crop(i).depth(depth, (frame.width, frame.height))

    @functools.cached_property
    def brings_depth(self) -> bool:
        """True if chunks have depth maps: they are wanted, and some frame has one."""
        return self.streams_depth and any(map(self.pixels.has_depth, range(len(self))))

    def depth_maps_median(self) -> float | None:
        """Median of the known depths in some depth maps, in capture units; None without depth maps."""
        owners = list(filter(self.pixels.has_depth, range(len(self))))
        chosen = [owners[place] for place in evenly_spread(len(owners), NUM_DEPTH_MAPS_READ)]
        known = [depth[depth > 0] for i in chosen if (depth := self.depth(i)) is not None]
        return float(np.median(np.concatenate(known))) if any(depths.size for depths in known) else None

    def depth_map_warnings(self, depths: DepthStatistics) -> list[str]:
        """A warning where depth maps contradict the depths that follow from images and poses."""
        measured = self.depth_maps_median()
        if measured is None or depths.source != "matches":
            return []
        ratio = measured / depths.median
        if 1 / MAX_DEPTH_RATIO <= ratio <= MAX_DEPTH_RATIO:
            return []
        times = f"{ratio:.2g} times that of the matches"
        fix = "check the unit of the depth maps and of the poses, or stream without them (--depth off)"
        return [f"The depth maps' median is {times}: {fix}."]

    def check_output_folder(self, out: Path) -> None:
        """Refuses `out` where results would mix with the capture's files: a run overwrites and clears its folder."""
        folder = out.resolve()
        paths = [path for f in self.frames for path in (f.path, f.depth_path, f.mask_path)]
        files = [path.resolve() for path in paths if path is not None]
        if any(file.is_relative_to(folder) or folder.is_relative_to(file.parent) for file in files):
            got, fix = "the folder of the capture's own images", "choose another --out"
            raise refusal(str(out), wanted="a folder for results alone", got=got, fix=fix)

    def verify(self, indices: Sequence[int] | None = None) -> None:
        """Decodes what the frames `indices` (default: all) stream, to find damaged files; uses some cores."""
        used = range(len(self)) if indices is None else indices
        with ThreadPoolExecutor(NUM_DECODERS) as pool:  # Pillow decodes outside the interpreter lock
            read_depth = self.depth if self.brings_depth else lambda i: None
            for _ in pool.map(lambda i: (self.image(i), self.seen(i), read_depth(i)), used):
                pass

    def stream_frame(self, config: StreamConfig, indices: Sequence[int] | None = None) -> StreamFrame:
        """The stream frame of a run over the frames `indices` (default: all).

        Near, far and the automatic scale are estimated from these frames only (`data.depth_range`); the other frames,
        which include the targets of an evaluation, have no influence. With `causal`, only the first chunk has any.
        """
        used = _indices(self, indices)
        if config.stream.causal:
            used = used[: config.stream.chunk_size]
        # A second run finds them while poses, cameras, the size, images and masks are the same.
        facts = (self.digest(used), self.width, self.height, list(map(self.pixels.version, used)))
        depths = kept_result(lambda: estimate_depths(self, used), "depths", *facts)
        scale, near, far = stream_scale(depths, config)
        first = self.frames[used[0]].camtoworld
        warnings = self.depth_map_warnings(depths) if self.brings_depth else []
        warning = " ".join(filter(None, (depths.warning, *warnings))) or None
        return StreamFrame.at_camera(first, scale=scale, near=near, far=far, warning=warning)

    def camera(
        self, i: int, stream_frame: StreamFrame | None = None, *, offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    ) -> Camera:
        """The camera of frame `i`: in a stream frame, or else in the capture frame, in which scene files are.

        In the capture frame, `offset` is the point of it to which the scene's positions are relative.
        """
        _indices(self, [i])
        stream_frame = stream_frame or StreamFrame.at_point(offset)
        viewmat = stream_frame.viewmats(self.frames[i].camtoworld)
        K = self.K(i).astype(np.float32)
        viewmats, Ks = jax.device_put((viewmat, K))  # jnp.asarray would compile a program for each shape
        return Camera(viewmats=viewmats, Ks=Ks, width=self.width, height=self.height)

    def stream_order(self, config: StreamConfig, indices: Sequence[int] | None, stream_frame: StreamFrame) -> list[int]:
        """`indices` (default: all) in the order of streaming, with slow video interleaved (`interleave`).

        The typical depth is taken to be the geometric mean of near and far. A causal stream keeps the order of frames,
        since it would have to wait for seconds of video.
        """
        used = _indices(self, indices)
        if config.stream.causal:
            return used
        centers = np.stack([self.frames[i].center for i in used])
        step = config.stream.chunk_step * math.sqrt(stream_frame.near * stream_frame.far) / stream_frame.scale
        return interleave(centers, used, config.stream.chunk_size, step)

    def chunks(
        self, config: StreamConfig, order: Sequence[int] | None = None, *, stream_frame: StreamFrame | None = None
    ) -> Iterator[Chunk]:
        """Yields chunks of `config.stream.chunk_size` views; a thread reads one chunk ahead.

        The last chunk is padded with invalid views: black images with the identity pose and the intrinsics of the
        chunk's first view.

        Args:
            config: the configuration of the model.
            order: frames in the order of streaming, which stays as it is; by default `stream_order` of all frames.
            stream_frame: by default that of `config` and the frames used.

        Raises:
            InputError: an image is damaged; it comes when that image's chunk is asked for.
        """
        used = _indices(self, order)
        stream_frame = stream_frame or self.stream_frame(config, used)
        if order is None:
            used = self.stream_order(config, None, stream_frame)
        groups = [used[k : k + config.stream.chunk_size] for k in range(0, len(used), config.stream.chunk_size)]
        with ThreadPoolExecutor(1) as reader:
            ahead = reader.submit(self._views, groups[0], config.stream.chunk_size, stream_frame)
            for following in (*groups[1:], None):
                arrays = ahead.result()
                if following is not None:
                    ahead = reader.submit(self._views, following, config.stream.chunk_size, stream_frame)
                yield Chunk(**jax.device_put(arrays))

    def _views(self, group: Sequence[int], chunk_size: int, stream_frame: StreamFrame) -> dict[str, np.ndarray]:
        """Arrays of one padded chunk."""
        images = np.zeros((chunk_size, self.height, self.width, 3), np.float32)
        viewmats = np.tile(np.eye(4, dtype=np.float32), (chunk_size, 1, 1))
        Ks = np.tile(self.K(group[0]).astype(np.float32), (chunk_size, 1, 1))
        for row, i in enumerate(group):
            images[row], Ks[row] = self.image(i), self.K(i)
        viewmats[: len(group)] = stream_frame.viewmats(np.stack([self.frames[i].camtoworld for i in group]))
        arrays = {"images": images, "viewmats": viewmats, "Ks": Ks, "valid": np.arange(chunk_size) < len(group)}
        arrays |= {"near": np.float32(stream_frame.near), "far": np.float32(stream_frame.far)}
        if self.is_masked:
            arrays["seen"] = np.ones(images.shape[:3], bool)
            arrays["seen"][: len(group)] = [self.seen(i) for i in group]
        if self.brings_depth:
            arrays["depths"] = np.zeros(images.shape[:3], np.float32)
            for row, i in enumerate(group):
                if (depth := self.depth(i)) is not None:
                    arrays["depths"][row] = stream_frame.scale * depth
        return arrays


def capture_of_listing(
    listing: Listing, format: str, pixels: Pixels, size: tuple[int, int] | None, convention: Convention = USUAL
) -> Capture:
    """The capture of a listing whose images all have one size; `size` is that of the delivered ones."""
    if size is None:
        first = listing.frames[0]
        size = (first.width, first.height)
        for frame in listing.frames:
            if (frame.width, frame.height) != size:
                got = f"{size[0]}x{size[1]} ({echo(first.name)}) and {frame.width}x{frame.height} ({echo(frame.name)})"
                raise refusal(listing.name, wanted="images of one size", got=got, fix="ask for one with --size WxH")
    return Capture(listing.name, format, listing.frames, pixels, *size, notes=listing.notes, convention=convention)


def _indices(capture: Capture, indices: Sequence[int] | None) -> list[int]:
    """`indices`, checked, or those of all frames."""
    used = list(range(len(capture)) if indices is None else indices)
    if not used or not all(0 <= i < len(capture) for i in used):
        wanted = f"frame numbers in [0, {len(capture) - 1}], at least one"
        raise refusal(f"{capture.name}: frames", wanted=wanted, got=echo(used), fix="choose other frames")
    return used
