"""Verdicts in plain words."""

import pytest

from ssplat_jax.core.errors import InputError
from ssplat_jax.poses.verdict import Findings, check_registered, ranges, verdict

NAMES = tuple(f"{i}.jpg" for i in range(120))


def found(*parts, error=0.62, names=NAMES):
    return Findings(names, tuple(tuple(names[i] for i in part) for part in parts), error, 12345)


def test_a_good_result_is_one_line():
    assert verdict(found(range(120))) == [
        "registered 120 of 120 images, median reprojection error 0.6 px, 12,345 points"
    ]


def test_what_is_missing_is_named():
    lines = verdict(found([*range(50), *range(52, 119)]))
    assert lines[0].startswith("registered 117 of 120 images")
    assert lines[1:] == ["without a pose: 50.jpg to 51.jpg, 119.jpg"]


def test_parts_that_are_not_connected_are_named_once():
    """Images that two parts share belong to the larger one; parts of two images are chance."""
    lines = verdict(found(range(70), range(65, 100), range(100, 110), (118, 119)))
    assert lines[1].startswith(
        "two parts not connected to the rest: 30 images (70.jpg to 99.jpg); 10 images (100.jpg to 109.jpg)."
    )
    assert lines[2] == "without a pose: 110.jpg to 119.jpg"
    assert "overlap" in lines[3]


def test_a_large_error_is_explained():
    assert "fish-eye" in verdict(found(range(120), error=2.5))[-1]
    assert len(verdict(found(range(120), error=1.4))) == 1


def test_many_ranges_are_counted():
    assert ranges(NAMES, [NAMES[i] for i in range(0, 20, 2)]).endswith("10.jpg and 4 more")


@pytest.mark.parametrize(("parts", "names"), [((), NAMES), ([range(29)], NAMES), ([range(3)], NAMES[:6])])
def test_too_few_registered_images_are_refused(parts, names):
    with pytest.raises(InputError, match=f"got {len(parts[0]) if parts else 0} of {len(names)}; take pictures"):
        check_registered(found(*parts, names=names), "clip.mp4")


def test_a_quarter_of_the_images_is_a_result():
    check_registered(found(range(30)), "clip.mp4")
    check_registered(found(range(4), names=NAMES[:6]), "clip.mp4")
