"""One file per capture format. Each offers `FORMAT` (its name), `matches(path)` and `read(path) -> Listing`.

A reader checks everything that can be checked without decoding an image, through `posed_frame` and `pixels`, and
raises `InputError`.
"""

import dataclasses

from ssplat_jax.data.posed_image import Frame


@dataclasses.dataclass(frozen=True, eq=False)
class Listing:
    """What a reader found."""

    name: str
    frames: tuple[Frame, ...]  # in the order in which they are streamed
    notes: tuple[str, ...] = ()  # what the user should know, one sentence each
