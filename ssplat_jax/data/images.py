"""Image files: cheap checks of their headers, full decoding, and the change of size with the intrinsics that follow.

Stored pixels are taken as they lie in the file: an EXIF orientation is not applied, because the intrinsics of every
capture format belong to the stored pixels. Gray becomes RGB; transparency is composited over black; 16-bit gray is
scaled, not clipped.
"""

import dataclasses
import warnings
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float32, Float64
from PIL import Image

from ssplat_jax.data.lens import undistorted
from ssplat_jax.data.posed_image import Frame
from ssplat_jax.errors import refusal

IMAGE_FORMATS = ("JPEG", "PNG", "WEBP", "TIFF", "BMP", "PPM")
MAX_PIXELS = 64_000_000  # larger headers are refused before anything is decoded
DEPTH_MODES = ("I;16", "I;16B", "I")
ORIENTATION, UPRIGHT = 274, 1  # EXIF


@runtime_checkable
class Pixels(Protocol):
    """Where a capture's images and depth maps come from; index = position of the frame."""

    def image(self, i: int) -> Float32[np.ndarray, "h w 3"]:
        """RGB in [0, 1], at the stored size."""
        ...

    def depth(self, i: int) -> Float32[np.ndarray, "h w"] | None:
        """Camera z in capture units, 0 where unknown; None where the frame has no depth map."""
        ...

    def has_depth(self, i: int) -> bool:
        """Whether `depth` gives a map, without decoding it."""
        ...


@dataclasses.dataclass(frozen=True, eq=False)
class FilePixels:
    """Images and depth maps decoded from the files of `frames` at each call, lens distortion undone."""

    frames: Sequence[Frame]

    def image(self, i: int) -> Float32[np.ndarray, "h w 3"]:
        frame = self.frames[i]
        assert frame.path is not None  # readers of files always set it
        image = decode_image(frame.path, (frame.width, frame.height))
        return image if frame.lens is None else undistorted(image, frame.lens, frame.K)

    def depth(self, i: int) -> Float32[np.ndarray, "h w"] | None:
        frame = self.frames[i]
        if frame.depth_path is None:
            return None
        depth = decode_depth(frame.depth_path, frame.depth_unit)
        if frame.lens is None:
            return depth
        sizes = np.array([depth.shape[1] / frame.width, depth.shape[0] / frame.height, 1.0])
        return undistorted(depth, frame.lens, np.diag(sizes) @ frame.K, order=0)

    def has_depth(self, i: int) -> bool:
        return self.frames[i].depth_path is not None


@dataclasses.dataclass(frozen=True, eq=False)
class ArrayPixels:
    """Images and depth maps held in memory."""

    images: Float32[np.ndarray, "v h w 3"]
    depths: Float32[np.ndarray, "v h w"]

    def image(self, i: int) -> Float32[np.ndarray, "h w 3"]:
        return self.images[i]

    def depth(self, i: int) -> Float32[np.ndarray, "h w"] | None:
        return self.depths[i]

    def has_depth(self, i: int) -> bool:
        return True


def _open(path: Path, what: str) -> Image.Image:
    """The opened, not yet decoded image, of a sane size."""
    if not path.is_file():
        got = "a folder" if path.is_dir() else "no such file"
        raise refusal(str(path), wanted=what, got=got, fix="add the file or drop its frame from the capture")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            image = Image.open(path, formats=IMAGE_FORMATS)
    except (Image.DecompressionBombError, Image.DecompressionBombWarning):
        fix = "scale the images down"
        raise refusal(str(path), wanted=f"at most {MAX_PIXELS:,} pixels", got="far more", fix=fix) from None
    except Exception as error:  # Pillow's parsers raise nearly anything on damaged headers
        got = f"{path.stat().st_size} bytes that are no readable image ({type(error).__name__})"
        fix = f"replace the file (formats read: {', '.join(IMAGE_FORMATS)})"
        raise refusal(str(path), wanted=what, got=got, fix=fix) from None
    if image.width * image.height > MAX_PIXELS:
        size = f"{image.width}x{image.height}"
        image.close()
        raise refusal(str(path), wanted=f"at most {MAX_PIXELS:,} pixels", got=size, fix="scale the images down")
    is_tiff = image.format == "TIFF"
    if image.mode == "F" or (is_tiff and image.mode == "I"):
        image.close()
        got, fix = "floats or 32-bit integers, of which nothing says what is white", "store 8 or 16 bits a channel"
        raise refusal(str(path), wanted=what, got=got, fix=fix)
    if is_tiff and image.getexif().get(ORIENTATION, UPRIGHT) != UPRIGHT:  # which Pillow applies, and to TIFFs alone
        image.close()
        fix = "rotate the pixels and drop the tag, and see that the intrinsics are those of the rotated image"
        raise refusal(str(path), wanted=what, got="a TIFF with an orientation tag", fix=fix)
    return image


def _load(image: Image.Image, path: Path) -> None:
    """Decodes all of the file's pixels."""
    try:
        image.load()
    except Exception as error:  # as above
        got = f"damaged data ({' '.join(str(error).split()) or type(error).__name__})"
        fix = "replace the file: it is truncated or corrupt"
        raise refusal(str(path), wanted="a complete image", got=got, fix=fix) from None


def image_size(path: Path) -> tuple[int, int]:
    """(width, height) from the header.

    Raises:
        InputError: missing, unreadable, or too large.
    """
    with _open(path, "an image") as image:
        return image.size


def check_depth_header(path: Path) -> None:
    """Refuses what is not a 16-bit depth image."""
    with _open(path, "a depth image") as image:
        if image.mode not in DEPTH_MODES:
            fix = "store depth as 16-bit PNG"
            raise refusal(str(path), wanted="one channel of 16 bits", got=f"mode {image.mode}", fix=fix)


def decode_image(path: Path, size: tuple[int, int]) -> Float32[np.ndarray, "h w 3"]:
    """RGB in [0, 1] of the whole file, whose (width, height) must be `size`.

    Raises:
        InputError: truncated or damaged, or no longer of the size seen when the capture was opened.
    """
    with _open(path, "an image") as image:
        if image.size != size:
            got = f"{image.width}x{image.height}"
            fix = "leave the files alone while a run reads them"
            raise refusal(str(path), wanted=f"{size[0]}x{size[1]} as when opened", got=got, fix=fix)
        _load(image, path)
        if image.mode in DEPTH_MODES:
            gray = np.asarray(image, dtype=np.float32) / np.float32(65535)
            return np.repeat(np.clip(gray, 0, 1)[..., None], 3, axis=-1)
        if image.has_transparency_data:
            rgba = np.asarray(image.convert("RGBA"), dtype=np.float32) / np.float32(255)
            return rgba[..., :3] * rgba[..., 3:]
        return np.asarray(image.convert("RGB"), dtype=np.float32) / np.float32(255)


def decode_depth(path: Path, unit: float) -> Float32[np.ndarray, "h w"]:
    """Depth from a 16-bit image of steps of `unit`; 0 stays 0, "unknown"."""
    with _open(path, "a depth image") as image:
        _load(image, path)
        return np.asarray(image, dtype=np.float32) * np.float32(unit)


def decode_all(pixels: Pixels, indices: Sequence[int]) -> None:
    """Decodes the frames `indices` and throws the pixels away: what is damaged is found before anything is written."""

    def decode(i: int) -> None:
        pixels.image(i)
        pixels.depth(i)

    with ThreadPoolExecutor() as pool:  # Pillow decodes outside the interpreter lock
        for _ in pool.map(decode, indices):
            pass


@dataclasses.dataclass(frozen=True)
class Crop:
    """Scale to cover, then center-crop: the part of a stored image that a delivered one shows, without rounding.

    A stored pixel coordinate u becomes (u - left) * scale; centers at +0.5 make this exact.
    """

    scale: float
    left: float  # stored pixels
    top: float
    width: int  # delivered pixels
    height: int

    @staticmethod
    def cover(stored: tuple[int, int], wanted: tuple[int, int]) -> "Crop":
        """The crop that takes (width, height) `stored` to `wanted`, keeping the aspect of a pixel."""
        scale = max(wanted[0] / stored[0], wanted[1] / stored[1])
        left, top = ((s - w / scale) / 2 for s, w in zip(stored, wanted, strict=True))
        return Crop(scale=scale, left=left, top=top, width=wanted[0], height=wanted[1])

    @property
    def is_identity(self) -> bool:
        """Whether the stored image is delivered as it is."""
        return (self.scale, self.left, self.top) == (1.0, 0.0, 0.0)

    def intrinsics(self, K: Float64[np.ndarray, "3 3"]) -> Float64[np.ndarray, "3 3"]:
        """Intrinsics of the delivered image."""
        return np.diag([self.scale, self.scale, 1.0]) @ (K - np.array([[0, 0, self.left], [0, 0, self.top], [0, 0, 0]]))

    def apply(
        self, channel: Float32[np.ndarray, "h w"], stored: tuple[int, int], resample: Image.Resampling
    ) -> Float32[np.ndarray, "hc wc"]:
        """One channel of the delivered image; `channel` may have another resolution than the `stored` image."""
        sx, sy = channel.shape[1] / stored[0], channel.shape[0] / stored[1]
        right, bottom = self.left + self.width / self.scale, self.top + self.height / self.scale
        # Rounding may put the box an ulp outside, which Pillow refuses.
        box = (max(self.left, 0) * sx, max(self.top, 0) * sy, min(right, stored[0]) * sx, min(bottom, stored[1]) * sy)
        return np.asarray(Image.fromarray(channel).resize((self.width, self.height), resample, box=box))


def resize_image(image: Float32[np.ndarray, "h w 3"], crop: Crop) -> Float32[np.ndarray, "hc wc 3"]:
    """The delivered image, Lanczos-filtered in float (no rounding to 8 bits), clipped to [0, 1]."""
    stored = (image.shape[1], image.shape[0])
    channels = [crop.apply(np.ascontiguousarray(image[..., c]), stored, Image.Resampling.LANCZOS) for c in range(3)]
    return np.clip(np.stack(channels, axis=-1), 0, 1)


def resize_depth(
    depth: Float32[np.ndarray, "h w"], crop: Crop, stored: tuple[int, int]
) -> Float32[np.ndarray, "hc wc"]:
    """The delivered depth map, nearest neighbor: a mean of two surfaces, or of one and a hole, is neither."""
    return crop.apply(depth, stored, Image.Resampling.NEAREST)
