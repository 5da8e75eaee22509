"""`ssplat export` of a run: its saved state as a scene file."""

from pathlib import Path

import jax
import numpy as np

from ssplat_jax.config import StreamConfig
from ssplat_jax.core.console import Reporter
from ssplat_jax.core.errors import InputError
from ssplat_jax.data.stream_frame import StreamFrame
from ssplat_jax.evaluation.scoring import exposures_from_json
from ssplat_jax.model.streamsplat import StreamSplat, shown_pivots
from ssplat_jax.runs.finish_run import scene_to_show
from ssplat_jax.scene_files.formats import ExportReport, check_format, save_gaussians
from ssplat_jax.storage.run_folder import RunFolder
from ssplat_jax.storage.saved_states import load_newest_state
from ssplat_jax.storage.weights import params_digest
from ssplat_jax.streaming.session import Session


def export_run(
    run_dir: Path, to: Path, params: dict, reporter: Reporter, max_splats: int | None = None
) -> ExportReport:
    """Decodes the saved state of a run and writes its scene, in the capture's frame, at the middle exposure.

    If the newest state is damaged, the one before it is exported, with a warning.

    Args:
        run_dir: folder of the run.
        to: file to write; its suffix names the format.
        params: parameters of the run's model.
        reporter: prints warnings.
        max_splats: most Gaussians to write.

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
    # The rows after those of the shown pivots are padding, of which a person need not be told.
    config = session.model.config
    num_rows = int(np.sum(shown_pivots(cache, config))) * config.head.gaussians_per_token
    gaussians = jax.tree.map(lambda x: x[:num_rows], session.gaussians())
    frame = StreamFrame.from_dict(header["frame"])
    scene = scene_to_show(gaussians, frame, exposures_from_json(header["exposures"]))
    return save_gaussians(to, scene, offset=frame.offset, max_splats=max_splats)
