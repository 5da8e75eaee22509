"""`--quality` and `--refine`: the steps after the stream."""

from ssplat_jax.commands.eval_command import Eval
from ssplat_jax.commands.options import refinement_steps
from ssplat_jax.commands.run_command import Run
from ssplat_jax.config import QUALITIES


def test_steps_that_are_asked_for_go_before_those_of_the_quality():
    assert QUALITIES["best"].refine_steps == 100 and QUALITIES["best"].scale == 1.0
    assert [refinement_steps("best", steps) for steps in (None, 0, 30)] == [100, 0, 30]
    assert [refinement_steps("accurate", steps) for steps in (None, 0, 30)] == [0, 0, 30]


def test_best_refines_after_the_stream(monkeypatch, tmp_path):
    asked = {}
    monkeypatch.setattr(
        "ssplat_jax.runs.eval_run.eval_path",
        lambda *a: asked.update(steps=a[4].refine_steps) or {"scenes": {}, "over_scenes": SCORES},
    )
    Eval("procedural:room", tmp_path, quality="best", quiet=True).run()
    assert asked == {"steps": 100}

    class Result:
        interrupted, was_finished, num_gaussians, num_views = None, False, 1, 4

    def refined(command):
        asked["refine"] = command
        return 0

    monkeypatch.setattr("ssplat_jax.commands.run_command.Refine.run", refined)
    monkeypatch.setattr("ssplat_jax.runs.capture_run.run_capture", lambda *a, **k: Result())
    assert Run("procedural:room", tmp_path, quality="best", quiet=True).run() == 0
    assert (asked["refine"].steps, asked["refine"].folder) == (100, tmp_path)
    # A refinement that is stopped says how it continues: without the flag, which would start the run anew.
    assert Run("procedural:room", tmp_path, quality="best", overwrite=True, quiet=True).run() == 0
    assert asked["refine"].overwrite


SCORES = {name: {"psnr": 20.0, "ssim": 0.5} for name in ("shown", "literal")}
