"""`ssplat refine`: the scene of a finished run, revised on the frames that it was made from."""

import dataclasses
from pathlib import Path

import numpy as np

from ssplat_jax.config import StreamConfig
from ssplat_jax.core.console import WAITING, Reporter
from ssplat_jax.core.errors import InputError, require_positive
from ssplat_jax.core.gaussians import Gaussians
from ssplat_jax.data.capture import Capture
from ssplat_jax.data.open_capture import open_capture
from ssplat_jax.data.stream_frame import StreamFrame
from ssplat_jax.evaluation.scoring import exposures_from_json, score_targets
from ssplat_jax.model.streamsplat import StreamSplat
from ssplat_jax.refinement import KeyViews, RefineConfig
from ssplat_jax.refinement.refine import Progress, continue_refinement, key_views_of, report_of, start_refinement
from ssplat_jax.refinement.refine_config import FOR_CAPTURES
from ssplat_jax.runs.finish_run import NUM_PICTURES, save_scene
from ssplat_jax.runs.refinement_state import load_refinement, save_refinement
from ssplat_jax.runs.run_poses import with_poses_of_run
from ssplat_jax.storage.files import write_json
from ssplat_jax.storage.interrupts import Interrupts
from ssplat_jax.storage.run_folder import RunFolder, lock_folder
from ssplat_jax.storage.saved_states import load_newest_state
from ssplat_jax.storage.weights import params_digest
from ssplat_jax.streaming.feed import Exposures
from ssplat_jax.streaming.session import Session


@dataclasses.dataclass(frozen=True)
class RefineResult:
    """State of a refinement when `refine_run` returns."""

    num_steps: int
    before: dict  # scores of some streamed views, see `mean_scores`; empty if it was interrupted
    after: dict
    interrupted: int | None  # the signal that stopped it, if one did


@dataclasses.dataclass(frozen=True)
class _Run:
    """A finished run, opened with its capture."""

    gaussians: Gaussians  # in the stream frame
    capture: Capture
    indices: list[int]
    frame: StreamFrame
    exposures: Exposures
    identity: dict  # facts that must be equal for a refinement to be continued


def refine_run(
    run_dir: Path,
    path: str,
    params: dict,
    *,
    steps: int,
    save_every: int,
    overwrite: bool,
    reporter: Reporter,
) -> RefineResult:
    """Writes `refined.ply` beside the scene of a run, continuing a refinement that stopped. `scene.ply` stays.

    Args:
        run_dir: folder of a finished `ssplat run`.
        path: the capture of that run, as `open_capture` takes it.
        params: parameters of the run's model.
        steps: most refinement steps, those of an earlier call included.
        save_every: steps between saved states.
        overwrite: remove the refinement that the folder holds and start anew.
        reporter: shows progress and warnings.

    Raises:
        InputError: there is no finished run of this capture and these weights, or a refinement with other steps.
        StorageError: the folder cannot be written or a state is corrupt.
    """
    require_positive(steps=steps, save_every=save_every)
    folder = RunFolder(run_dir)
    run = _open_run(folder, path, params, reporter)
    with lock_folder(run_dir):
        if overwrite:
            folder.clear_refinement()
        given = key_views_of(run.capture, run.indices, run.frame, run.exposures)
        config = FOR_CAPTURES
        identity = run.identity | {"steps": steps, "refine_config": dataclasses.asdict(config)}
        progress, key_views = start_refinement(run.gaussians, given, config)
        if folder.refinement_state.exists():
            load_refinement(folder.refinement_state, progress, identity)
        stopped = _take_steps(progress, key_views, steps, config, save_every, identity, folder, reporter)
        if stopped:
            return RefineResult(progress.num_steps, {}, {}, stopped)
        refined, done = progress.scene(run.gaussians), report_of(progress, key_views, config)
        save_scene(folder.refined_scene, refined, run.frame, run.exposures)  # at the exposure of scene.ply
        shown = tuple(sorted({run.indices[round(i)] for i in np.linspace(0, len(run.indices) - 1, NUM_PICTURES)}))
        before, after = (
            score_targets(scene, run.capture, shown, run.frame, run.exposures) for scene in (run.gaussians, refined)
        )
        write_json(folder.refinement, vars(done) | {"seen_views_before": before, "seen_views_after": after})
    return RefineResult(progress.num_steps, before, after, None)


def _open_run(folder: RunFolder, path: str, params: dict, reporter: Reporter) -> _Run:
    """The run in a folder with its capture, checked to belong together."""
    if not folder.has_state():
        raise InputError(f"{folder.path}: wanted the folder of an `ssplat run`, found no {folder.state.name} in it.")
    cache, header, damage = load_newest_state(folder.state)
    if damage is not None:
        reporter.warn(f"{damage} Refining the state saved before it, after {header['done']} views.")
    if header["weights"] != params_digest(params):
        raise InputError(
            f"{folder.path}: was streamed with other weights than these; give the run's own with --weights."
        )
    frames = header["frames"]
    if header["done"] < len(frames):
        raise InputError(
            f"{folder.path}: wanted a finished run, got one after {header['done']} of {len(frames)} views; finish it"
            " with `ssplat run`."
        )
    capture = with_poses_of_run(open_capture(path, size=tuple(header["size"])), folder)
    is_same = max(frames) < len(capture) and (capture.digest(frames), capture.images_digest(frames)) == (
        header["poses"],
        header["images"],
    )
    if not is_same:
        raise InputError(f"{path}: wanted the capture of the run in {folder.path}, got another; give that capture.")
    session = Session(StreamSplat(StreamConfig.from_dict(header["config"])), params, cache)
    return _Run(
        gaussians=session.gaussians(),
        capture=capture,
        indices=frames,
        frame=StreamFrame.from_dict(header["frame"]),
        exposures=exposures_from_json(header["exposures"]),
        identity={name: header[name] for name in ("config", "size", "frames", "poses", "images", "weights")},
    )


def _take_steps(
    progress: Progress,
    key_views: KeyViews,
    steps: int,
    config: RefineConfig,
    save_every: int,
    identity: dict,
    folder: RunFolder,
    reporter: Reporter,
) -> int | None:
    """Takes the steps that are left, saving on the way; returns the signal that stopped them, if one did."""
    with Interrupts() as interrupts, reporter.progress("refining", steps) as advance:
        advance(progress.num_steps, WAITING)
        num_saves = progress.num_steps // save_every
        for _ in continue_refinement(progress, key_views, steps, config):
            advance(progress.num_steps, f"loss {progress.losses[-1]:.4f}")
            stopped = interrupts.received  # read once: a signal may come at any time
            if stopped:
                break
            if progress.num_steps // save_every > num_saves:  # a learned pass may step over a multiple
                num_saves = progress.num_steps // save_every
                save_refinement(folder.refinement_state, progress, identity)
        save_refinement(folder.refinement_state, progress, identity)
        return interrupts.received
