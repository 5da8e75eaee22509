"""Image files: cheap checks of headers, full decoding, and resizing with matching intrinsics.

An EXIF orientation is not applied, because the intrinsics of every capture format refer to the stored pixels. Gray
becomes RGB, transparent pixels are composited over black, and 16-bit gray is scaled instead of clipped.
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

from ssplat_jax.core.errors import refusal
from ssplat_jax.data.lens import undistort
from ssplat_jax.data.posed_image import Frame

IMAGE_FORMATS = ("JPEG", "PNG", "WEBP", "TIFF", "BMP", "PPM")
MAX_PIXELS = 64_000_000  # larger images are refused before anything is decoded
DEPTH_MODES = ("I;16", "I;16B", "I")  # Pillow's modes of 16-bit images
ORIENTATION, UPRIGHT = 274, 1  # EXIF tag, and its value for images that need no rotation


@runtime_checkable
class Pixels(Protocol):
    """Source of a capture's images and depth maps, by the index of the frame."""

    def image(self, i: int) -> Float32[np.ndarray, "h w 3"]:
        """Returns image `i` as RGB in [0, 1], at the stored size."""
        ...

    def depth(self, i: int) -> Float32[np.ndarray, "h w"] | None:
        """Returns depth map `i` (camera z in capture units, 0 where unknown), or None if there is none."""
        ...

    def has_depth(self, i: int) -> bool:
        """True if frame `i` has a depth map; does not decode it."""
        ...


@dataclasses.dataclass(frozen=True, eq=False)
class FilePixels:
    """Images and depth maps that are decoded from files at each call and undistorted."""

    frames: Sequence[Frame]

    def image(self, i: int) -> Float32[np.ndarray, "h w 3"]:
        frame = self.frames[i]
        assert frame.path is not None  # readers of files always set it
        image = decode_image(frame.path, (frame.width, frame.height))
        return image if frame.lens is None else undistort(image, frame.lens, frame.K)

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
    """Opens an image file without decoding it, and checks its size and kind.

    Args:
        path: the file.
        what: description of the wanted file for error messages.
    """
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
        got, fix = "floats or 32-bit integers, whose value for white is unknown", "store 8 or 16 bits per channel"
        raise refusal(str(path), wanted=what, got=got, fix=fix)
    if is_tiff and image.getexif().get(ORIENTATION, UPRIGHT) != UPRIGHT:  # Pillow applies it to TIFFs only
        image.close()
        fix = "rotate the pixels and drop the tag, and see that the intrinsics are those of the rotated image"
        raise refusal(str(path), wanted=what, got="a TIFF with an orientation tag", fix=fix)
    return image


def _load(image: Image.Image, path: Path) -> None:
    """Decodes all pixels of the file."""
    try:
        image.load()
    except Exception as error:  # as above
        got = f"damaged data ({' '.join(str(error).split()) or type(error).__name__})"
        fix = "replace the file: it is truncated or corrupt"
        raise refusal(str(path), wanted="a complete image", got=got, fix=fix) from None


def image_size(path: Path) -> tuple[int, int]:
    """Returns (width, height) from the header of an image file.

    Raises:
        InputError: the file is missing, is not a readable image, or is too large.
    """
    with _open(path, "an image") as image:
        return image.size


def check_depth_header(path: Path) -> None:
    """Checks that a file is a 16-bit depth image.

    Raises:
        InputError: it is not.
    """
    with _open(path, "a depth image") as image:
        if image.mode not in DEPTH_MODES:
            fix = "store depth as 16-bit PNG"
            raise refusal(str(path), wanted="one channel of 16 bits", got=f"mode {image.mode}", fix=fix)


def decode_image(path: Path, size: tuple[int, int]) -> Float32[np.ndarray, "h w 3"]:
    """Decodes an image file of (width, height) `size` to RGB in [0, 1].

    Raises:
        InputError: the file is truncated or damaged, or its size has changed since the capture was opened.
    """
    with _open(path, "an image") as image:
        if image.size != size:
            got = f"{image.width}x{image.height}"
            fix = "do not change the files while a run reads them"
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
    """Decodes a 16-bit depth image whose values count steps of `unit`; 0 means unknown."""
    with _open(path, "a depth image") as image:
        _load(image, path)
        return np.asarray(image, dtype=np.float32) * np.float32(unit)


def decode_all(pixels: Pixels, indices: Sequence[int]) -> None:
    """Decodes the frames `indices` and discards the result, to find damaged files before anything is written.

    Raises:
        InputError: a file is damaged.
    """

    def decode(i: int) -> None:
        pixels.image(i)
        pixels.depth(i)

    with ThreadPoolExecutor() as pool:  # Pillow decodes outside the interpreter lock
        for _ in pool.map(decode, indices):
            pass


@dataclasses.dataclass(frozen=True)
class Crop:
    """Scale-to-cover and center crop: maps a stored image to the delivered one.

    A stored pixel coordinate u becomes (u - left) * scale, without rounding, because pixel centers are at +0.5.
    """

    scale: float
    left: float  # stored pixels
    top: float
    width: int  # delivered pixels
    height: int

    @staticmethod
    def cover(stored: tuple[int, int], wanted: tuple[int, int]) -> "Crop":
        """Returns the crop from (width, height) `stored` to `wanted` that keeps the aspect ratio of pixels."""
        scale = max(wanted[0] / stored[0], wanted[1] / stored[1])
        left, top = ((s - w / scale) / 2 for s, w in zip(stored, wanted, strict=True))
        return Crop(scale=scale, left=left, top=top, width=wanted[0], height=wanted[1])

    @property
    def is_identity(self) -> bool:
        """True if the delivered image equals the stored one."""
        return (self.scale, self.left, self.top) == (1.0, 0.0, 0.0)

    def intrinsics(self, K: Float64[np.ndarray, "3 3"]) -> Float64[np.ndarray, "3 3"]:
        """Converts intrinsics of the stored image to those of the delivered one."""
        return np.diag([self.scale, self.scale, 1.0]) @ (K - np.array([[0, 0, self.left], [0, 0, self.top], [0, 0, 0]]))

    def apply(
        self, channel: Float32[np.ndarray, "h w"], stored: tuple[int, int], resample: Image.Resampling
    ) -> Float32[np.ndarray, "hc wc"]:
        """Crops and resizes one channel, which may have another resolution than the (width, height) `stored`."""
        sx, sy = channel.shape[1] / stored[0], channel.shape[0] / stored[1]
        right, bottom = self.left + self.width / self.scale, self.top + self.height / self.scale
        # Rounding may place the box one ulp outside the image, which Pillow refuses.
        box = (max(self.left, 0) * sx, max(self.top, 0) * sy, min(right, stored[0]) * sx, min(bottom, stored[1]) * sy)
        return np.asarray(Image.fromarray(channel).resize((self.width, self.height), resample, box=box))


def resize_image(image: Float32[np.ndarray, "h w 3"], crop: Crop) -> Float32[np.ndarray, "hc wc 3"]:
    """Crops and resizes an image with a Lanczos filter in float32, and clips it to [0, 1]."""
    stored = (image.shape[1], image.shape[0])
    channels = [crop.apply(np.ascontiguousarray(image[..., c]), stored, Image.Resampling.LANCZOS) for c in range(3)]
    return np.clip(np.stack(channels, axis=-1), 0, 1)


def resize_depth(
    depth: Float32[np.ndarray, "h w"], crop: Crop, stored: tuple[int, int]
) -> Float32[np.ndarray, "hc wc"]:
    """Crops and resizes a depth map with nearest-neighbor sampling, since a mean of two depths lies on no surface."""
    return crop.apply(depth, stored, Image.Resampling.NEAREST)
