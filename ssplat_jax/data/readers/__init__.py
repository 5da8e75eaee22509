"""Readers of capture formats, one module each with `FORMAT` (its name), `matches(path)` and `read(path) -> Listing`.

A module whose files are not of camera-to-world poses with OpenCV axes says so in a `CONVENTION`.

A reader checks everything that can be checked without decoding an image, and raises `InputError`.
"""

import dataclasses

from ssplat_jax.data.posed_image import Frame


@dataclasses.dataclass(frozen=True, eq=False)
class Listing:
    """Frames of a capture, as a reader found them."""

    name: str
    frames: tuple[Frame, ...]  # in the order of the file; of streaming after `in_stream_order`
    notes: tuple[str, ...] = ()  # messages for the user, one sentence each
    is_in_time: bool = False  # True if that is known to be the order of time
