"""`--budget-ms`: the front is one, the choice is the best that fits, and a run keeps its choice."""

import itertools
import json

import numpy as np
import pytest
from PIL import Image

from ssplat_jax.config import preset
from ssplat_jax.core.console import Reporter
from ssplat_jax.core.errors import InputError
from ssplat_jax.runs import time_budget
from ssplat_jax.runs.time_budget import Front, FrontPoint, choose, front_of, load_front, setting_for_run
from ssplat_jax.storage.weights import check_params, load_params
from tests.commands.test_cli import make_capture

QUIET = Reporter(quiet=True)


def point(steps, shown):
    return FrontPoint(f"{steps} steps", 1.0, {}, steps, shown)


def test_a_front_holds_the_points_that_no_other_beats():
    rng = np.random.default_rng(0)
    points = [point(float(steps), float(shown)) for steps, shown in rng.integers(1, 12, (40, 2))]
    front = front_of((160, 120), points).points
    for kept, next_kept in itertools.pairwise(front):
        assert kept.steps_per_view < next_kept.steps_per_view and kept.shown < next_kept.shown
    for p in points:
        assert any(k.steps_per_view <= p.steps_per_view and k.shown >= p.shown for k in front)


def test_the_choice_is_the_best_that_fits_this_machine_and_size():
    front = Front((100, 100), (point(1.0, 20.0), point(2.0, 22.0), point(4.0, 24.0)))
    assert choose(front, 40.0, (100, 100), 10.0) == (front.points[2], 40.0)
    assert choose(front, 39.0, (100, 100), 10.0) == (front.points[1], 20.0)
    assert choose(front, 40.0, (100, 100), 20.0) == (front.points[1], 40.0)  # a machine half as fast
    assert choose(front, 40.0, (200, 200), 10.0) == (front.points[0], 40.0)  # four times the pixels


@pytest.mark.parametrize(
    "size, chosen",
    [("128x96", "plain"), ("96x72", "plain"), ("64x48", "large"), ("64x96", "plain"), ("160x120", "plain")],
)
def test_no_image_is_streamed_larger_than_the_capture_has_it(tmp_path, monkeypatch, size, chosen):
    front = Front((64, 48), (FrontPoint("plain", 1.0, {}, 1.0, 20.0), FrontPoint("large", 1.5, {}, 2.0, 22.0)))
    monkeypatch.setattr(time_budget, "reference_step_ms", lambda: 1.0)
    monkeypatch.setattr(time_budget, "load_front", lambda: front)
    width, height = map(int, size.split("x"))
    path = "procedural:room?frames=8"  # 128 x 96 by itself
    choice = setting_for_run(1e6, path, (width, height), tmp_path, overwrite=False, reporter=QUIET)
    assert choice.point.setting == chosen


def test_the_choice_for_another_capture_is_not_taken(tmp_path, monkeypatch):
    """A run that was stopped before its first save leaves its choice; it does not fit a smaller or larger capture."""
    front = Front((64, 48), (FrontPoint("plain", 1.0, {}, 1.0, 20.0), FrontPoint("large", 1.5, {}, 2.0, 22.0)))
    monkeypatch.setattr(time_budget, "reference_step_ms", lambda: 1.0)
    monkeypatch.setattr(time_budget, "load_front", lambda: front)
    large, small = "procedural:room?frames=8", str(make_capture(tmp_path / "small", num_frames=4, size=(64, 48)))
    out = tmp_path / "out"
    out.mkdir()
    for path, setting in ((large, "large"), (small, "plain"), (large, "large")):
        choice = setting_for_run(1e6, path, (64, 48), out, overwrite=False, reporter=QUIET)
        assert choice.point.setting == setting
        choice.save()


def test_images_of_several_sizes_need_a_size_alone(tmp_path, monkeypatch):
    capture = make_capture(tmp_path / "c", num_frames=4, size=(64, 48))
    facts = json.loads((capture / "transforms.json").read_text())
    Image.new("RGB", (128, 96)).save(capture / facts["frames"][1]["file_path"])
    facts["frames"][1] |= {"w": 128, "h": 96, "fl_x": 128.0, "fl_y": 128.0, "cx": 64.0, "cy": 48.0}
    (capture / "transforms.json").write_text(json.dumps(facts))
    front = Front((32, 24), (FrontPoint("plain", 1.0, {}, 1.0, 20.0), FrontPoint("large", 1.5, {}, 2.0, 22.0)))
    monkeypatch.setattr(time_budget, "reference_step_ms", lambda: 1.0)
    monkeypatch.setattr(time_budget, "load_front", lambda: front)
    for size, chosen in (((32, 24), "large"), ((64, 48), "plain")):
        out = tmp_path / chosen
        choice = setting_for_run(1e6, str(capture), size, out, overwrite=False, reporter=QUIET)
        assert not out.exists() and choice.point.setting == chosen
        out.mkdir()
        choice.save()
        assert json.loads((out / "budget.json").read_text())["point"]["setting"] == chosen
    with pytest.raises(InputError, match="images"):
        setting_for_run(1e6, str(capture), (32, 24), capture / "images", overwrite=False, reporter=QUIET)
    assert not (capture / "images" / "budget.json").exists()


def test_a_budget_that_nothing_fits_names_the_least():
    front = Front((100, 100), (point(1.0, 20.0), point(2.0, 22.0)))
    with pytest.raises(InputError, match=r"at least 10 ms a view.*100x100, got 9"):
        choose(front, 9.0, (100, 100), 10.0)
    for budget in (0.0, -1.0, float("nan"), float("inf")):
        with pytest.raises(InputError, match="positive number of milliseconds"):
            choose(front, budget, (100, 100), 10.0)


def test_every_shipped_point_runs_with_the_shipped_weights():
    front, params = load_front(), load_params("tiny")
    assert len(front.points) >= 5 and front_of(front.size, front.points) == front
    for config in {preset("tiny").replace(**p.changes) for p in front.points} - {preset("tiny")}:
        check_params(params, config, "tiny")
    for p in front.points:
        assert 0.2 <= p.factor <= 2.0 and p.steps_per_view > 0


def test_a_run_that_continues_keeps_its_setting(tmp_path, monkeypatch):
    speeds = iter([1.0, 100.0, 1.0, 1.0, 1.0])
    monkeypatch.setattr(time_budget, "reference_step_ms", lambda: next(speeds))
    monkeypatch.setattr(
        time_budget,
        "load_front",
        lambda: Front((64, 48), (point(1.0, 20.0), FrontPoint("two", 0.5, {"hpda": False}, 5.0, 22.0))),
    )

    def chosen(budget, overwrite=False, accept=True):
        choice = setting_for_run(
            budget, "procedural:room?frames=8", (64, 48), tmp_path, overwrite=overwrite, reporter=QUIET
        )
        if accept:
            choice.save()
        return choice.point.setting

    assert chosen(6.0) == "two"
    assert chosen(6.0) == "two"  # not timed again
    with pytest.raises(InputError, match="at least 100 ms"):
        chosen(7.0)
    assert json.loads((tmp_path / "budget.json").read_text())["expected_ms"] == 5.0
    assert chosen(4.0, overwrite=True) == "1.0 steps"
    (tmp_path / "state.npz").write_bytes(b"of a run that has begun")
    with pytest.raises(InputError, match=r"--budget-ms: wanted what the run in .* began with, got 6 at 64x48"):
        chosen(6.0)
    assert chosen(6.0, overwrite=True, accept=False) == "two"  # and then the run is refused for another reason
    assert chosen(4.0) == "1.0 steps"  # so that it can go on
    assert chosen(6.0, overwrite=True) == "two"


@pytest.mark.slow
def test_the_reference_step_takes_time():
    assert 0.1 < time_budget.reference_step_ms() < 60_000
