"""Conventions of poses in files: the axes of cameras, and the direction of the transform.

Readers know what their format prescribes. Files that follow another convention are read with the options `axes` and
`poses` at the end of the capture's path, such as `scene?axes=opencv&poses=world-to-camera`.
"""

import dataclasses
import re
from typing import Literal, get_args

import numpy as np
from jaxtyping import Float64

from ssplat_jax.core.errors import refusal
from ssplat_jax.data.posed_image import OPENGL_TO_OPENCV, Frame, invert_pose

Axes = Literal["opencv", "opengl"]
"""Axes of a camera: +y down and +z forward (opencv), or +y up and +z backward (opengl)."""
Direction = Literal["camera-to-world", "world-to-camera"]
"""Direction of the matrices or vectors that a file gives."""


@dataclasses.dataclass(frozen=True)
class Convention:
    """Convention in which a file writes poses."""

    axes: Axes = "opencv"
    poses: Direction = "camera-to-world"

    def to_opencv(self, written: Float64[np.ndarray, "4 4"]) -> Float64[np.ndarray, "4 4"]:
        """Returns the camera-to-world pose with OpenCV axes of a matrix in this convention."""
        camtoworld = written if self.poses == "camera-to-world" else invert_pose(written)
        return camtoworld if self.axes == "opencv" else camtoworld @ OPENGL_TO_OPENCV

    def from_opencv(self, camtoworld: Float64[np.ndarray, "4 4"]) -> Float64[np.ndarray, "4 4"]:
        """Returns the matrix in this convention of a camera-to-world pose with OpenCV axes."""
        camtoworld = camtoworld if self.axes == "opencv" else camtoworld @ OPENGL_TO_OPENCV
        return camtoworld if self.poses == "camera-to-world" else invert_pose(camtoworld)

    def options(self, usual: "Convention") -> dict[str, str]:
        """Returns the options that ask for this convention in place of the usual one."""
        return {name: getattr(self, name) for name in ("axes", "poses") if getattr(self, name) != getattr(usual, name)}


USUAL = Convention()
"""The convention of captures in memory, and of formats that do not say otherwise."""

CONVENTIONS = tuple(Convention(axes, poses) for axes in get_args(Axes) for poses in get_args(Direction))

_OPTIONS = re.compile(r"\?((?:axes|poses)=[^&?/]*(?:&(?:axes|poses)=[^&?/]*)*)$")


def split_options(path: str) -> tuple[str, dict[str, str]]:
    """Splits `path?axes=...&poses=...` into the path and its options; there may be none.

    Raises:
        InputError: an option has an unknown value or is given twice.
    """
    found = _OPTIONS.search(path)
    if found is None:
        return path, {}
    options: dict[str, str] = {}
    allowed = {"axes": get_args(Axes), "poses": get_args(Direction)}
    for part in found[1].split("&"):
        name, _, value = part.partition("=")
        if value not in allowed[name] or name in options:
            got = "it twice" if name in options else value or "nothing"
            wanted = " or ".join(allowed[name])
            raise refusal(f"{path[: found.start()]}: {name}", wanted=wanted, got=got, fix="change the option")
        options[name] = value
    return path[: found.start()], options


def with_options(path: str, *, axes: str | None = None, poses: str | None = None) -> str:
    """Returns `path` with the options that are not None, which replace those that it has."""
    path, options = split_options(path)
    options |= {name: value for name, value in (("axes", axes), ("poses", poses)) if value is not None}
    return path + ("?" if options else "") + "&".join(f"{name}={value}" for name, value in options.items())


def reinterpreted(frame: Frame, usual: Convention, written: Convention) -> Frame:
    """Returns a frame that was read in the `usual` convention as if its file were `written` in another one."""
    return dataclasses.replace(frame, camtoworld=written.to_opencv(usual.from_opencv(frame.camtoworld)))
