"""Image files: cheap checks of headers, decoding, resizing with matching intrinsics, and undistortion.

An EXIF orientation is not applied, because the intrinsics of every capture format refer to the stored pixels. Gray
becomes RGB, transparent pixels are composited over black, and 16-bit gray is scaled instead of clipped.
"""

import contextlib
import dataclasses
import warnings
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float32, Float64
from PIL import Image
from PIL.TiffImagePlugin import TiffImageFile
from skimage import transform

from ssplat_jax.core.errors import reading, refusal
from ssplat_jax.data.parsing import UNDISTORT

IMAGE_FORMATS = ("JPEG", "PNG", "WEBP", "TIFF", "BMP", "PPM")
MAX_PIXELS = 64_000_000  # larger images are refused before anything is decoded
DEPTH_MODES = ("I;16", "I;16B", "I")  # Pillow's modes of 16-bit images
BITS, PHOTOMETRIC = 258, 262  # TIFF tags: bits of a channel; 0 if zero is white
ORIENTATION, UPRIGHT = 274, 1  # EXIF tag, and its value for images that need no rotation
MAX_LABEL = 100  # largest value of a mask that numbers objects from 1, and 0 for what is masked out
Matrix = Float64[np.ndarray, "3 3"]
REPLACE = f"replace the file (formats read: {', '.join(IMAGE_FORMATS)})"


def image_size(path: Path) -> tuple[int, int]:
    """(width, height) from the header of an image file, which is refused if that cannot be read."""
    with _open(path) as image:
        return image.size


def check_depth_header(path: Path) -> None:
    """Refuses a file that is no 16-bit depth image."""
    with _open(path) as image:
        if image.mode not in DEPTH_MODES:
            wanted, fix = "one channel of 16 bits, from 0 for unknown", "store depth as 16-bit PNG"
            raise refusal(str(path), wanted=wanted, got=f"mode {image.mode}", fix=fix)


def decode_image(path: Path, size: tuple[int, int]) -> Float32[np.ndarray, "h w 3"]:
    """Decodes an image file, which must still have the (width, height) `size`, to RGB in [0, 1]."""
    with _open(path) as image:
        if image.size != size:
            wanted, got = (f"{width}x{height}" for width, height in (size, image.size))
            fix = "do not change the files while a run reads them"
            raise refusal(str(path), wanted=f"{wanted} as when opened", got=got, fix=fix)
        with reading(path, REPLACE):
            image.load()
        if image.mode in DEPTH_MODES:
            white = (1 << image.tag_v2.get(BITS, (16,))[0]) - 1 if isinstance(image, TiffImageFile) else 65535
            gray = np.asarray(image, dtype=np.float32) / np.float32(white)
            return np.repeat(np.clip(gray, 0, 1)[..., None], 3, axis=-1)
        if image.has_transparency_data:
            rgba = np.asarray(image.convert("RGBA"), dtype=np.float32) / np.float32(255)
            return rgba[..., :3] * rgba[..., 3:]
        pixels = np.array(image.convert("RGB"), dtype=np.float32)
        pixels /= np.float32(255)  # in place: photographs have hundreds of megabytes as floats
        return pixels


def image_flags(path: Path) -> tuple[bool, bool]:
    """Two facts of an image file: it may have transparent pixels; EXIF says that it is not upright."""
    with _open(path) as image:
        orientation = UPRIGHT
        with contextlib.suppress(Exception), warnings.catch_warnings():  # malformed data say nothing
            warnings.simplefilter("ignore")
            # Not `image.getexif()`, which decodes a whole PNG to find what may follow its pixels.
            orientation = Image.Image.getexif(image).get(ORIENTATION, UPRIGHT)
        return image.has_transparency_data, orientation in range(2, 9)


def check_mask(path: Path, image: Path) -> None:
    """Refuses a mask whose shape is not that of its image; it may be smaller or larger."""
    (width, height), wanted = image_size(path), image_size(image)
    if abs(width * wanted[1] - height * wanted[0]) > max(width + height, *wanted):
        got, fix = f"{width}x{height}", "make the mask from this image"
        raise refusal(str(path), wanted=f"the shape of {image.name}, {wanted[0]}x{wanted[1]}", got=got, fix=fix)


def decode_mask(path: Path, mask_path: Path | None, size: tuple[int, int]) -> Float32[np.ndarray, "h w"]:
    """1 for the pixels of an image of (width, height) `size` that count, and 0 for those that do not.

    Pixels count that are more than half opaque in the image `path`, and bright in the mask `mask_path`, which may have
    another size: brighter than half its brightest, or above 0 where that is the number of a label. The alpha channel
    of a mask counts in place of its brightness, unless it is the same everywhere.
    """
    counts = np.ones(size[::-1], np.float32)
    for source in (path, mask_path):
        if source is None:
            continue
        with _open(source) as image:
            if source is path and not image.has_transparency_data:
                continue
            with reading(source, REPLACE):
                values = np.asarray(image.convert("F"))
                if image.has_transparency_data:
                    alpha = np.asarray(image.convert("RGBA").getchannel("A"))
                    values = alpha if source is path or np.ptp(alpha) else values
            shown = values > (127 if source is path else values.max() / 2 if values.max() > MAX_LABEL else 0)
            counts *= np.asarray(Image.fromarray(shown.astype(np.uint8)).resize(size, Image.Resampling.NEAREST))
    return counts


def decode_depth(path: Path, unit: float) -> Float32[np.ndarray, "h w"]:
    """Decodes a 16-bit depth image whose values count steps of `unit`; 0 means unknown."""
    with _open(path) as image:
        with reading(path, REPLACE):
            image.load()
        return np.asarray(image, dtype=np.float32) * np.float32(unit)


def _open(path: Path) -> Image.Image:
    """Opens an image file without decoding it, and checks its size and kind."""
    with reading(path, REPLACE), warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # of damaged EXIF data
        warnings.simplefilter("error", Image.DecompressionBombWarning)
        image = Image.open(path, formats=IMAGE_FORMATS)
    wanted = got = fix = ""
    is_tiff = image.format == "TIFF"
    if image.width * image.height > MAX_PIXELS:
        wanted, got, fix = f"{MAX_PIXELS:,} pixels at most", f"{image.width}x{image.height}", "scale the images down"
    elif image.mode == "F" or (is_tiff and image.mode == "I"):  # the value of white is unknown
        wanted, got, fix = "8 or 16 bits per channel", "floats or 32-bit integers", "convert the images"
    elif is_tiff and image.mode in DEPTH_MODES and image.getexif().get(PHOTOMETRIC) == 0:  # Pillow does not invert it
        wanted, got, fix = "gray from black to white", "a TIFF whose zero is white", "convert the images"
    elif is_tiff and image.getexif().get(ORIENTATION, UPRIGHT) != UPRIGHT:  # Pillow applies it to TIFFs only
        wanted, got = "an upright image", "a TIFF with an orientation tag"
        fix = "rotate the pixels, drop the tag, and see that the intrinsics are those of the rotated image"
    if wanted:
        image.close()
        raise refusal(str(path), wanted=wanted, got=got, fix=fix)
    return image


# -- size -------------------------------------------------------------------------------------------------------------


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
        """The crop from (width, height) `stored` to `wanted` that keeps the aspect ratio of pixels."""
        scale = max(wanted[0] / stored[0], wanted[1] / stored[1])
        left, top = ((s - w / scale) / 2 for s, w in zip(stored, wanted, strict=True))
        return Crop(scale=scale, left=left, top=top, width=wanted[0], height=wanted[1])

    @property
    def is_identity(self) -> bool:
        """True if the delivered image equals the stored one."""
        return (self.scale, self.left, self.top) == (1.0, 0.0, 0.0)

    def intrinsics(self, K: Matrix) -> Matrix:
        """Converts intrinsics of the stored image to those of the delivered one."""
        return np.diag([self.scale, self.scale, 1.0]) @ (K - np.array([[0, 0, self.left], [0, 0, self.top], [0, 0, 0]]))

    def image(self, image: Float32[np.ndarray, "h w 3"]) -> Float32[np.ndarray, "hc wc 3"]:
        """Crops and resizes an image with a Lanczos filter in float32, and clips it to [0, 1]."""
        if self.is_identity:
            return image
        stored = (image.shape[1], image.shape[0])
        channels = [self._resized(image[..., c], stored, Image.Resampling.LANCZOS) for c in range(3)]
        return np.clip(np.stack(channels, axis=-1), 0, 1)

    def depth(self, depth: Float32[np.ndarray, "h w"], stored: tuple[int, int]) -> Float32[np.ndarray, "hc wc"]:
        """Crops and resizes a depth map of any resolution of the (width, height) `stored` image.

        Sampling is that of the nearest neighbor, since a mean of two depths lies on no surface.
        """
        if self.is_identity and depth.shape == stored[::-1]:
            return depth
        return self._resized(depth, stored, Image.Resampling.NEAREST)

    def mask(self, counts: Float32[np.ndarray, "h w"]) -> Bool[np.ndarray, "hc wc"]:
        """Crops and resizes a map of pixels that count (1); those count of which hardly any part does not."""
        if self.is_identity:
            return counts > 0.5
        return self._resized(counts, counts.shape[::-1], Image.Resampling.BILINEAR) > 0.95

    def _resized(self, channel: np.ndarray, stored: tuple[int, int], resample: Image.Resampling) -> np.ndarray:
        sx, sy = channel.shape[1] / stored[0], channel.shape[0] / stored[1]
        right, bottom = self.left + self.width / self.scale, self.top + self.height / self.scale
        # Rounding may place the box one ulp outside the image, which Pillow refuses.
        box = (max(self.left, 0) * sx, max(self.top, 0) * sy, min(right, stored[0]) * sx, min(bottom, stored[1]) * sy)
        image = Image.fromarray(np.ascontiguousarray(channel))
        return np.asarray(image.resize((self.width, self.height), resample, box=box))


# -- lens -------------------------------------------------------------------------------------------------------------
# The lens model exists twice: here in float64 on the host, to sample stored images, and in the rasterizer, traced and
# differentiable, to draw.

IGNORED_PX = 0.5  # images with a smaller displacement by distortion are not undistorted


@dataclasses.dataclass(frozen=True)
class Lens:
    """Distortion coefficients: x_d = x (1 + k1 r^2 + k2 r^4 + k3 r^6 + k4 r^8) / q + 2 p1 x y + p2 (r^2 + 2 x^2).

    The denominator is q = 1 + d1 r^2 + d2 r^4 + d3 r^6; OpenCV and COLMAP call its coefficients k4, k5 and k6.
    """

    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    d1: float = 0.0
    d2: float = 0.0
    d3: float = 0.0

    def distorted(self, points: Float64[np.ndarray, "*n 2"]) -> Float64[np.ndarray, "*n 2"]:
        """Maps points on the plane z = 1 of the pinhole camera to their distorted positions."""
        x, y = points[..., 0], points[..., 1]
        with np.errstate(over="ignore", invalid="ignore"):
            r2 = x * x + y * y
            radial = 1 + r2 * (self.k1 + r2 * (self.k2 + r2 * (self.k3 + r2 * self.k4)))
            radial = radial / (1 + r2 * (self.d1 + r2 * (self.d2 + r2 * self.d3)))
            across = x * radial + 2 * self.p1 * x * y + self.p2 * (r2 + 2 * x * x)
            along = y * radial + self.p1 * (r2 + 2 * y * y) + 2 * self.p2 * x * y
            return np.stack([across, along], axis=-1)

    def pixels(self, K: Matrix, points: Float64[np.ndarray, "*n 2"]) -> Float64[np.ndarray, "*n 2"]:
        """Maps pixels of the pinhole image to pixels of the distorted one; both have the intrinsics `K`."""
        center, focal = K[:2, 2], np.diag(K)[:2]
        with np.errstate(over="ignore", invalid="ignore"):
            return self.distorted((points - center) / focal) * focal + center


@dataclasses.dataclass(frozen=True)
class FisheyeLens(Lens):
    """Fish-eye lens: a ray at the angle a to the axis is seen at r = a (1 + k1 a^2 + k2 a^4 + k3 a^6 + k4 a^8).

    This is COLMAP's OPENCV_FISHEYE, and without coefficients an equidistant lens. `p1` and `p2` have no meaning here.

    Limits:
        Rays at 90 degrees and more to the axis have no place in a pinhole image and are not delivered.
        On the axis the lens is the identity.
    """

    def distorted(self, points: Float64[np.ndarray, "*n 2"]) -> Float64[np.ndarray, "*n 2"]:
        """Maps points on the plane z = 1 of the pinhole camera to their distorted positions."""
        with np.errstate(over="ignore", invalid="ignore"):
            radius = np.linalg.norm(points, axis=-1, keepdims=True)
            a2 = np.square(np.arctan(radius))
            series = 1 + a2 * (self.k1 + a2 * (self.k2 + a2 * (self.k3 + a2 * self.k4)))
            shrink = np.where(radius > 1e-9, np.arctan(radius) / np.maximum(radius, 1e-9), 1.0)
            return points * shrink * series


PINHOLE = Lens()  # no distortion


def check_lens(lens: Lens, K: Matrix, width: int, height: int, where: str) -> float:
    """The largest displacement by distortion on the border of the image, in pixels; exactly 0 without any.

    Distortion that folds the image is refused: its coefficients probably belong to another model.
    """
    if isinstance(lens, FisheyeLens) and (lens.p1 or lens.p2):
        raise refusal(where, wanted="a fish-eye lens of k1 to k4 alone", got="p1 or p2 beside them", fix=UNDISTORT)
    border = _border(width, height)
    # Lines from the principal point to the border.
    spokes = K[:2, 2] + np.linspace(0.0, 1.0, 33)[:, None, None] * (border - K[:2, 2])
    moved = lens.pixels(K, spokes)
    with np.errstate(over="ignore", invalid="ignore"):
        rays = (border - K[:2, 2]) / np.diag(K)[:2]
        shift = np.linalg.norm((lens.distorted(rays) - rays) * np.diag(K)[:2], axis=-1)  # exactly 0 without distortion
        shift = float(np.nan_to_num(shift.max(), nan=np.inf))
        outwards = np.einsum("ksi,ksi->ks", np.diff(moved, axis=0), np.diff(spokes, axis=0))
    if shift > max(width, height) or not (outwards[:, np.linalg.norm(spokes[-1] - spokes[0], axis=-1) > 0] > 0).all():
        shown = ", ".join(f"{name}={value:.3g}" for name, value in dataclasses.asdict(lens).items() if value != 0)
        fix = f"check the coefficients, or {UNDISTORT}"
        raise refusal(where, wanted="a lens that does not fold the image", got=shown, fix=fix)
    return shift


def _border(width: int, height: int) -> Float64[np.ndarray, "36 2"]:
    """Points on the border of an image, in pixels."""
    t = np.linspace(0.0, 1.0, 9)
    edge = np.concatenate([np.stack(np.broadcast_arrays(t, s), -1) for s in (0.0, 1.0)])
    return np.concatenate([edge, edge[:, ::-1]]) * (width, height)


def shows_too_little(lens: Lens, K: Matrix, width: int, height: int) -> bool:
    """True if the undistorted image has pixels that the stored one does not show, by more than half a pixel."""
    shown = lens.pixels(K, _border(width, height))
    return bool(((shown < -0.5) | (shown > np.array([width, height]) + 0.5)).any())


def undistort(
    image: Float32[np.ndarray, "h w *c"], lens: Lens, K: Matrix, *, order: int = 1, outside: float | None = None
) -> Float32[np.ndarray, "h w *c"]:
    """The image (or depth map) that a pinhole camera of the same intrinsics would have taken.

    Args:
        image: the distorted image.
        lens: its distortion.
        K: intrinsics, pixels.
        order: 1 samples linearly, 0 takes the nearest pixel (for depth maps).
        outside: value of pixels that the stored image does not show; by default they repeat its border.
    """
    mode, fill = ("edge", 0.0) if outside is None else ("constant", outside)
    rows, columns = np.mgrid[: image.shape[0], : image.shape[1]]
    pixels = lens.pixels(K, np.stack([columns, rows], axis=-1) + 0.5) - 0.5
    at = np.moveaxis(pixels[..., ::-1], -1, 0)
    planes = [
        transform.warp(plane, at, order=order, mode=mode, cval=fill, preserve_range=True).astype(np.float32)
        for plane in np.moveaxis(image.reshape(*image.shape[:2], -1), -1, 0)
    ]
    return np.stack(planes, axis=-1).reshape(image.shape)
