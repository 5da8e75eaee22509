"""A capture that is still being written: a transforms.json that grows, and images that may not be complete."""

from pathlib import Path

from ssplat_jax.core.errors import InputError
from ssplat_jax.data.capture import Capture, capture_of_listing
from ssplat_jax.data.images import FilePixels
from ssplat_jax.data.readers import transforms_json
from ssplat_jax.data.readers.frame_list import in_stream_order

DONE = "done"
"""A file of this name in the capture's folder says that nothing more will come."""


def open_growing(path: Path, *, size: tuple[int, int] | None) -> tuple[Capture | None, str | None]:
    """Opens what is there of a capture.

    Args:
        path: folder that holds, or will hold, a transforms.json.
        size: (width, height) of delivered images; by default that of the stored ones.

    Returns:
        The capture of the frames before the first whose image or fields cannot be read, None if there is no such frame;
        and why no more of them can be read, None if all can. Images are complete when `Capture.verify` takes them.
    """
    try:
        listing, problem = transforms_json.read_complete(path)
        listing = in_stream_order(listing)
        pixels, convention = FilePixels(listing.frames), transforms_json.CONVENTION
        capture = capture_of_listing(listing, transforms_json.FORMAT, pixels, size, convention)
    except InputError as error:  # missing, or being written
        return None, str(error)
    return capture, problem


def is_done(path: Path) -> bool:
    """True if a file `done` lies in the folder `path`, or beside the file `path`."""
    return ((path.parent if path.is_file() else path) / DONE).exists()
