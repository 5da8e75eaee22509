"""Refinement of a finished run: it continues after a stop, and never loses the scene that it started from."""

import json
import signal

import pytest

from ssplat_jax.core.console import Reporter
from ssplat_jax.core.errors import InputError
from ssplat_jax.model.streamsplat import StreamSplat
from ssplat_jax.runs import refine_run as module
from ssplat_jax.runs.capture_run import run_capture
from ssplat_jax.runs.refine_run import refine_run
from ssplat_jax.runs.stream_commands import Refine, Run
from ssplat_jax.scene_files.formats import load_scene
from ssplat_jax.storage.run_folder import RunFolder
from tests.model.small import random_params
from tests.streaming.narrow_model import FEW_GAUSSIANS

CAPTURE, QUIET = "procedural:room?frames=4&size=64x48", Reporter(quiet=True)


def refine(path, steps=4, overwrite=False):
    options = Refine(path, CAPTURE, steps=steps, save_every=2, overwrite=overwrite)
    return refine_run(random_params(FEW_GAUSSIANS), options, QUIET)


def stream(out, overwrite=False):
    """Streams small frames into `out`."""
    options = Run(CAPTURE, out, save_every=1, overwrite=overwrite)
    return run_capture(StreamSplat(FEW_GAUSSIANS), random_params(FEW_GAUSSIANS), options, QUIET)


@pytest.fixture(scope="module")
def finished(tmp_path_factory, programs_shared):
    """Folder of a finished run of four small frames."""
    out = tmp_path_factory.mktemp("run")
    stream(out)
    return out


def test_a_stopped_refinement_continues_to_the_same_bytes(finished, monkeypatch, capsys):
    folder = RunFolder(finished)
    streamed = folder.scene.read_bytes()
    assert refine(finished, overwrite=True) == 0
    whole, report = folder.refined_scene.read_bytes(), json.loads(folder.refinement.read_text())
    assert report["num_steps"] == 4
    assert report["seen_views_after"]["shown"]["psnr"] > report["seen_views_before"]["shown"]["psnr"]

    folder.clear_refinement()
    steps, so_far = module.Progress.steps, [streamed]

    def stopped_after_one(progress, planned):
        for _ in steps(progress, planned):
            signal.raise_signal(signal.SIGINT)
            yield

    monkeypatch.setattr(module.Progress, "steps", stopped_after_one)
    for taken in (1, 2):
        assert refine(finished) == 128 + signal.SIGINT and f"after {taken} steps" in capsys.readouterr().err
        so_far.append(folder.refined_scene.read_bytes())
    monkeypatch.undo()
    refine(finished)
    assert folder.refined_scene.read_bytes() == whole
    assert len({*so_far, whole}) == 4  # every stop wrote what its steps had reached
    assert folder.scene.read_bytes() == streamed != whole
    continued = json.loads(folder.refinement.read_text())
    assert continued["num_steps"] == len(continued["losses"]) == 4
    assert continued["num_left_out"] == report["num_left_out"]
    assert [load_scene(path).sh_degree for path in (folder.scene, folder.refined_scene)] == [0, 2]


def test_report_and_pictures_become_those_of_the_refined_scene(finished):
    folder = RunFolder(finished)
    stream(finished, overwrite=True)
    pictures = [path.read_bytes() for path in sorted(folder.views.iterdir())]
    refine(finished)
    page, report = folder.report.read_text(), json.loads(folder.refinement.read_text())
    for scores in (report["seen_views_before"], report["seen_views_after"]):
        assert f"{scores['shown']['psnr']:.2f} dB" in page
    refined = [path.read_bytes() for path in sorted(folder.views.iterdir())]
    assert len(refined) == len(pictures) and not set(refined) & set(pictures)
    with pytest.raises(InputError, match="differs in its steps"):
        refine(finished, steps=3)
