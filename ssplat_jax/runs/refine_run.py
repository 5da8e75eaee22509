"""`ssplat refine`: the scene of a finished run, refined on the frames that it was made from; a stop loses no step."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import jax
import numpy as np

from ssplat_jax.core.console import WAITING, Reporter
from ssplat_jax.core.errors import refusal, require_positive
from ssplat_jax.evaluation.scoring import mean_scores, score_views
from ssplat_jax.refinement.compared_views import FOR_CAPTURES
from ssplat_jax.refinement.refine import Progress, key_views_of
from ssplat_jax.runs.open_run import load_run
from ssplat_jax.runs.run_results import report_run, save_scene, shown_frames
from ssplat_jax.runs.stream_commands import Refine, stopped
from ssplat_jax.storage.files import load_arrays, save_arrays, write_json
from ssplat_jax.storage.run_folder import Interrupts, RunFolder, lock_folder
from ssplat_jax.storage.saved_states import check_same

KIND = "refinement state 1"

MEASURED = ("max_pairs", "max_rows", "losses", "held_back", "seconds")  # fields of `Progress` that JSON holds


def refine_run(params: dict, options: Refine, reporter: Reporter) -> int:
    """Writes `refined.ply` beside the scene of a run, and says so; returns the exit code. `scene.ply` stays.

    A refinement that stopped is continued; an interrupted one writes the scene so far. The pictures and the report of
    the run become those of the refined scene.

    Args:
        params: parameters of the run's model.
        options: the run, its capture, and the most steps, those of an earlier call included.
        reporter: shows progress and warnings.

    Raises:
        InputError: there is no finished run of this capture and these weights, or a refinement with other steps.
        StorageError: the folder cannot be written or a state is corrupt.
    """
    steps, save_every = options.steps, options.save_every
    require_positive(steps=steps, save_every=save_every)
    run, folder, config = load_run(options.folder, reporter), RunFolder(options.folder), FOR_CAPTURES
    gaussians, indices = run.session(params).gaussians(), run.header["frames"]
    stream_frame, exposures = run.stream_frame, run.exposures
    if len(exposures) < len(indices):
        got, fix = f"one after {len(exposures)} of {len(indices)} views", "finish it with `ssplat run`"
        raise refusal(str(options.folder), wanted="a finished run", got=got, fix=fix)
    capture = run.open_capture(options.path)
    identity = {name: run.header[name] for name in ("config", "size", "frames", "poses", "images", "weights")}
    identity |= {"steps": steps, "refine_config": dataclasses.asdict(config)}
    with lock_folder(options.folder):
        if options.overwrite:
            folder.clear_refinement()
        progress = Progress.start(gaussians, key_views_of(capture, indices, stream_frame, exposures), config)
        if folder.refinement_state.exists():
            load_refinement(folder.refinement_state, progress, identity)
        with Interrupts() as interrupts, reporter.progress("refining", steps) as advance:
            advance(progress.num_steps, WAITING)
            for _ in progress.steps(steps):
                advance(progress.num_steps, f"loss {progress.losses[-1]:.4f}")
                if interrupts.received:
                    break
                if progress.num_steps % save_every == 0:
                    save_refinement(folder.refinement_state, progress, identity)
            save_refinement(folder.refinement_state, progress, identity)
            refined = progress.scene(gaussians)
            save_scene(folder.refined_scene, refined, stream_frame, exposures)  # at the exposure of scene.ply
            if interrupts.received:  # read last: a signal may have come during the save, too
                return stopped(interrupts.received, f"after {progress.num_steps} steps", overwrites=options.overwrite)
        frames = shown_frames(indices)
        before = mean_scores(score_views(gaussians, capture, frames, stream_frame, exposures))
        scores = score_views(refined, capture, frames, stream_frame, exposures, picture=folder.view)
        after = mean_scores(scores)
        seen = {"seen_views_before": before, "seen_views_after": after}
        write_json(folder.refinement, vars(progress.report()) | seen)
        if folder.metrics.is_file():  # else there is no report to bring up to date
            metrics = json.loads(folder.metrics.read_text())
            report_run(folder, metrics, options.path, run.header["weights"], refined=scores)
    shown = f"shown at {after['shown']['psnr']:.2f} dB instead of {before['shown']['psnr']:.2f}"
    print(f"wrote {folder.refined_scene}: {progress.num_steps} steps, streamed views {shown}")
    return 0


def save_refinement(path: Path, progress: Progress, identity: dict[str, Any]) -> None:
    """Saves a refinement between two steps, with the facts that must be equal for it to be continued.

    The scene that it started from is left out: `Progress.start` finds it again from the run and its capture.
    """
    arrays = {name: np.asarray(leaf) for name, leaf in _leaves(progress).items() if not name.startswith(".start")}
    measured = {name: getattr(progress, name) for name in MEASURED}
    save_arrays(path, arrays, KIND, {"identity": identity, "measured": measured})


def load_refinement(path: Path, progress: Progress, identity: dict[str, Any]) -> None:
    """Puts the refinement that a file holds into `progress`, the same refinement before its first step.

    Raises:
        InputError: the file holds the refinement of another run, or one with other options.
        StorageError: the file is damaged.
    """
    arrays, header = load_arrays(path, KIND)
    check_same(path, "a refinement", header["identity"], identity)
    leaves = [jax.device_put(arrays.get(name, leaf)) for name, leaf in _leaves(progress).items()]
    progress.state = jax.tree.unflatten(jax.tree.structure(progress.state), leaves)
    for name in MEASURED:
        setattr(progress, name, header["measured"][name])


def _leaves(progress: Progress) -> dict[str, jax.Array]:
    """The arrays of the state by name; those of the scene that it started from begin with `.start`."""
    return {jax.tree_util.keystr(place): leaf for place, leaf in jax.tree.leaves_with_path(progress.state)}
