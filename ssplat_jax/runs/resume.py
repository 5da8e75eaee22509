"""The saved progress of a run: what identifies the run, how it is continued, how it is saved."""

import dataclasses
from collections.abc import Sequence

from ssplat_jax.cache import grow
from ssplat_jax.config import StreamConfig
from ssplat_jax.core.console import Reporter
from ssplat_jax.core.errors import InputError, StorageError
from ssplat_jax.data.capture import Capture
from ssplat_jax.data.stream_frame import StreamFrame
from ssplat_jax.evaluation.scoring import exposures_from_json, exposures_to_json
from ssplat_jax.model.streamsplat import StreamSplat
from ssplat_jax.refinement import online_refinement
from ssplat_jax.storage.run_folder import RunFolder
from ssplat_jax.storage.saved_states import load_newest_state, restore_previous, save_state
from ssplat_jax.storage.weights import params_digest
from ssplat_jax.streaming.feed import Exposures
from ssplat_jax.streaming.session import Session


@dataclasses.dataclass
class RunState:
    """A stream in progress."""

    session: Session
    frame: StreamFrame
    exposures: Exposures  # of the views streamed so far

    @property
    def num_views(self) -> int:
        """Views streamed so far."""
        return len(self.exposures)


def run_identity(model: StreamSplat, params: dict, capture: Capture, indices: Sequence[int]) -> dict:
    """The facts that must be equal for a run to be continued."""
    return {
        "config": model.config.to_dict(),
        "capture": capture.name,
        "size": [capture.width, capture.height],
        "frames": list(indices),
        "poses": capture.digest(indices),
        "images": capture.images_digest(indices),
        "weights": params_digest(params),
    }


def resume_run(
    model: StreamSplat, params: dict, capture: Capture, identity: dict, folder: RunFolder, reporter: Reporter
) -> RunState:
    """The run that `folder` holds, or a new one.

    If the newest saved state is damaged, the one before it is used, with a warning.

    Args:
        model: the model to run.
        params: the model's parameters.
        capture: the capture to stream.
        identity: `run_identity` of these; a saved run must have the same.
        folder: where the run is saved.
        reporter: prints the warning.

    Raises:
        InputError: the folder holds a run of another identity.
        StorageError: the saved state and the one before it are corrupt.
    """
    revise = online_refinement(model)
    if not folder.has_state():
        return RunState(
            Session(model, params, revise=revise), capture.stream_frame(model.config, identity["frames"]), {}
        )
    try:
        cache, header, damage = load_newest_state(folder.state)
    except StorageError as error:
        raise StorageError(f"{error} No earlier state can be read either; --overwrite starts the run anew.") from error
    _check_identity(header, identity, folder)
    if damage is not None:
        reporter.warn(f"{damage} Continuing from the state saved before it, after {header['done']} views.")
        restore_previous(folder.state)
    if cache.capacity < model.config.memory.capacity:
        cache = grow(cache, model.config.memory.capacity)
    return RunState(
        Session(model, params, cache, revise=revise),
        StreamFrame.from_dict(header["frame"]),
        exposures_from_json(header["exposures"]),
    )


def save_run(run: RunState, identity: dict, folder: RunFolder) -> None:
    """Saves the stream, so that `resume_run` can continue it.

    Raises:
        StorageError: the folder cannot be created or written.
    """
    assert run.session.cache is not None
    header = identity | {
        "frame": run.frame.to_dict(),
        "done": run.num_views,
        "exposures": exposures_to_json(run.exposures),
    }
    save_state(folder.state, run.session.cache, header)


def _check_identity(header: dict, identity: dict, folder: RunFolder) -> None:
    """Refuses a saved run that is not the one asked for."""
    for name, wanted in identity.items():
        held = header.get(name)
        if name == "config":
            held, wanted = (_relevant_fields(StreamConfig.from_dict(fields or {})) for fields in (held, wanted))
        if held != wanted:
            raise InputError(
                f"{folder.path}: holds a run that differs in its {name} ({_difference(held, wanted)}); choose another"
                " --out, repeat the old options, or start anew with --overwrite."
            )


def _relevant_fields(config: StreamConfig) -> dict:
    """Config fields that affect the result.

    Capacity is excluded where no token is dropped for lack of it (`grow`).
    """
    fields = config.to_dict()
    if config.memory.overflow == "grow":
        fields["memory"] = {k: v for k, v in fields["memory"].items() if k not in ("overflow", "capacity")}
    return fields


def _difference(held, wanted) -> str:
    """The first difference of two JSON values as text."""
    if isinstance(held, dict) and isinstance(wanted, dict):
        for name in sorted(held.keys() | wanted.keys()):
            there, now = held.get(name), wanted.get(name)
            if there != now:
                nested = isinstance(there, dict) and isinstance(now, dict)
                return _difference(there, now) if nested else f"{name}: {there!r} there, {now!r} now"
    if isinstance(held, list) and isinstance(wanted, list) and len(held) > 4:
        return f"{len(held)} there, {len(wanted)} now, from {held[:2]} and {wanted[:2]} on"
    return f"{held!r} there, {wanted!r} now"
