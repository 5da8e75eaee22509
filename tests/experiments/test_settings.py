"""Rows of refined settings: each shows the scene after its steps, or at the end of a refinement that ended before."""

import dataclasses
from types import SimpleNamespace

import jax.numpy as jnp
import pytest
from ssplat_experiments import settings as module
from ssplat_experiments.settings import Setting

SETTINGS = [Setting(refine_steps=steps) for steps in (2, 4, 8, 16)]


@dataclasses.dataclass
class Scene:
    """A streamed scene whose score is the sum of its opacities."""

    gaussians: object
    streamed: object = None
    frame: object = None
    exposures: object = None
    split: object = dataclasses.field(default_factory=lambda: SimpleNamespace(context=range(4)))

    def row(self, setting, gaussians):
        return {"setting": setting.name, "shown": float(gaussians.opacities.sum()), "ms_per_view": 7.0, "gaussians": 9}


@pytest.mark.parametrize(("ends_after", "shown"), [(16, [2, 4, 8, 16]), (5, [2, 4, 5, 5]), (1, [1, 1, 1, 1])])
def test_settings_of_more_steps_than_were_taken_get_the_scene_at_its_end(ends_after, shown, monkeypatch):
    progress = SimpleNamespace(num_steps=0)
    # A Gaussian more is drawn with each step, of opacity 1.
    progress.scene = lambda given: SimpleNamespace(opacities=jnp.repeat(1.0, progress.num_steps))

    def steps_until_the_end(given, views, most, config):
        assert most == 16
        for _ in range(ends_after):
            progress.num_steps += 1
            yield

    monkeypatch.setattr(module, "_stream", lambda *given: Scene(None))
    monkeypatch.setattr(module, "key_views_of", lambda *given: "given")
    monkeypatch.setattr(module, "start_refinement", lambda *given: (progress, "views"))
    monkeypatch.setattr(module, "continue_refinement", steps_until_the_end)
    rows = module.measure_refined(SETTINGS, None, None)
    assert [row["setting"] for row in rows] == ["2 steps", "4 steps", "8 steps", "16 steps"]
    assert [row["shown"] for row in rows] == [row["gaussians"] for row in rows] == shown
    seconds = [row["refine_s"] for row in rows]
    assert seconds == sorted(seconds) and all(row["ms_per_view"] >= 7.0 for row in rows)
