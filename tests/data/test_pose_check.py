"""Poses in another convention are recognised from the images, and read with the options that are named."""

import dataclasses

import numpy as np
import pytest

from ssplat_jax.config import StreamConfig
from ssplat_jax.data.capture import Capture
from ssplat_jax.data.capture_summary import summarize
from ssplat_jax.data.open_capture import open_capture
from ssplat_jax.data.posed_image import CONVENTIONS, USUAL, Convention, with_options
from ssplat_jax.data.sparse_matches import fit_poses, keypoints_of, pose_warning
from tests.badinputs.cases import make_capture
from tests.data.capture_fixture import with_poses
from tests.data.planes_fixture import two_planes

NAMES = [f"{c.axes}-{c.poses}" for c in CONVENTIONS]


@pytest.fixture(scope="module")
def room() -> Capture:
    return two_planes(12, 0.1, spin=-3.0, forward=0.1, start=-0.6)


@pytest.fixture(scope="module")
def keypoints(room):
    return keypoints_of(room)


def written_as(capture: Capture, convention: Convention) -> Capture:
    """The capture that a reader of OpenCV camera-to-world poses makes of files in `convention`."""
    return with_poses(capture, map(convention.from_opencv, capture.camtoworlds))


@pytest.mark.parametrize("written", CONVENTIONS, ids=NAMES)
def test_the_convention_of_the_files_is_found(written, room, keypoints):
    fit = fit_poses(written_as(room, written), USUAL, keypoints)
    assert max(fit.shares, key=lambda c: fit.shares[c]) == written
    assert fit.shares[written] > 0.7 and sorted(fit.shares.values())[-2] < 0.35
    warning = pose_warning(fit, USUAL)
    assert (warning is None) == (written == USUAL)
    for value, flag in (("opengl", "--axes opengl"), ("world-to-camera", "--poses world-to-camera")):
        assert (flag in (warning or "")) == (value in (written.axes, written.poses))


def test_poses_of_other_images_are_found(room, keypoints):
    moved = np.random.default_rng(0).permutation(len(room))
    mixed = dataclasses.replace(room, frames=tuple(room.frames[i] for i in moved))
    assert "do not fit" in pose_warning(fit_poses(mixed, USUAL, keypoints), USUAL)


@pytest.mark.parametrize("written", CONVENTIONS, ids=NAMES)
def test_options_of_the_path_read_files_in_any_convention(written, room, tmp_path):
    """As transforms.json, whose poses are camera-to-world with OpenGL axes."""

    def change(root, meta):
        for frame, pose in zip(meta["frames"], room.camtoworlds, strict=False):
            frame["transform_matrix"] = written.from_opencv(pose).tolist()

    root = make_capture(tmp_path / "c", change)
    capture = open_capture(with_options(str(root), **written.options(Convention(axes="opengl"))))
    np.testing.assert_allclose(capture.camtoworlds, room.camtoworlds[: len(capture)], atol=1e-9)
    assert capture.convention == written and capture.name == root.name


def test_inspect_names_the_flag_and_says_nothing_of_depths_from_wrong_poses(room):
    warnings = summarize(written_as(room, Convention(axes="opengl")), StreamConfig())["warnings"]
    assert sum("--axes opengl" in warning for warning in warnings) == 1
    assert not any("parallax" in warning or "matches between frames" in warning for warning in warnings)


@pytest.fixture(scope="module")
def corridor():
    capture = open_capture("procedural:corridor?frames=16")
    return capture, keypoints_of(capture)


@pytest.mark.parametrize(
    ("factors", "named"),
    [
        ((1.0, 1.0), None),
        ((1.2, 1.0), "0.83 times fx;"),
        ((1.2, 1.2), "0.83 times fx and 0.83 times fy;"),
        ((1 / 1.2, 1 / 1.2), "1.2 times fx and 1.2 times fy;"),
    ],
)
def test_focal_lengths_of_another_crop_or_size_are_named(factors, named, corridor):
    """As after a crop or a resize of which the intrinsics know nothing; right ones are not warned of."""
    capture, keypoints = corridor
    wrong = np.array([[factors[0], 1.0, 1.0], [1.0, factors[1], 1.0], [1.0, 1.0, 1.0]])
    frames = tuple(dataclasses.replace(f, K=f.K * wrong) for f in capture.frames)
    warning = pose_warning(fit_poses(dataclasses.replace(capture, frames=frames), USUAL, keypoints), USUAL)
    assert warning is None if named is None else named in warning
