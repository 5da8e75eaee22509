"""`ssplat export` of a run: its saved state as a scene file."""

from pathlib import Path

import jax
import numpy as np
from jaxtyping import Int

from ssplat_jax.config import StreamConfig
from ssplat_jax.core.console import Reporter
from ssplat_jax.core.errors import InputError
from ssplat_jax.data.stream_frame import StreamFrame
from ssplat_jax.evaluation.scoring import exposures_from_json
from ssplat_jax.model.streamsplat import StreamSplat, shown_pivots
from ssplat_jax.runs.finish_run import scene_to_show
from ssplat_jax.scene_files.export_rows import ExportReport
from ssplat_jax.scene_files.formats import check_format, save_selected
from ssplat_jax.scene_files.select_gaussians import EVERYTHING, Selection
from ssplat_jax.storage.run_folder import RunFolder
from ssplat_jax.storage.saved_states import load_newest_state
from ssplat_jax.storage.weights import params_digest
from ssplat_jax.streaming.session import Session


def export_run(
    run_dir: Path, to: Path, params: dict, reporter: Reporter, selection: Selection = EVERYTHING
) -> ExportReport:
    """Decodes the saved state of a run and writes its scene, in the capture's frame, at the middle exposure.

    If the newest state is damaged, the one before it is exported, with a warning.

    Args:
        run_dir: folder of the run.
        to: file to write; its suffix names the format.
        params: parameters of the run's model.
        reporter: prints warnings.
        selection: the Gaussians to leave out.

    Returns:
        What was written.

    Raises:
        InputError: no run there, a run with other weights, or a suffix of no known format.
        StorageError: the state is corrupt, or `to` cannot be written.
    """
    check_format(to)
    folder = RunFolder(run_dir)
    if not folder.has_state():
        raise InputError(f"{run_dir}: wanted the folder of an `ssplat run`, found no {folder.state.name} in it.")
    cache, header, damage = load_newest_state(folder.state)
    if damage is not None:
        reporter.warn(f"{damage} Exporting the state saved before it, after {header['done']} views.")
    if header.get("weights") != params_digest(params):
        raise InputError(f"{run_dir}: was streamed with other weights than these; give the run's own with --weights.")
    session = Session(StreamSplat(StreamConfig.from_dict(header["config"])), params, cache)
    members = members_of_gaussians(session)
    # The rows after these are padding, of which a person need not be told.
    gaussians = jax.tree.map(lambda x: x[: len(members)], session.gaussians())
    frame = StreamFrame.from_dict(header["frame"])
    scene = scene_to_show(gaussians, frame, exposures_from_json(header["exposures"]))
    return save_selected(to, scene, selection, members, offset=frame.offset)


def members_of_gaussians(session: Session) -> Int[np.ndarray, " n"]:
    """Number of tokens that each Gaussian of `Session.gaussians` was merged from, without the rows of padding."""
    assert session.cache is not None
    is_shown = np.asarray(shown_pivots(session.cache, session.model.config)).reshape(-1)
    members = np.asarray(session.cache.num_members).reshape(-1)[is_shown]
    return np.repeat(members, session.model.config.head.gaussians_per_token)
