"""A run whose saved states are all damaged: the message says how to start anew."""

import pytest

from ssplat_jax.checkpoint.weights import load_params
from ssplat_jax.config import preset
from ssplat_jax.console import Reporter
from ssplat_jax.data.capture import open_capture
from ssplat_jax.errors import StorageError
from ssplat_jax.runs.resume import resume_run, run_identity
from ssplat_jax.storage.atomic import previous_path
from ssplat_jax.storage.run_folder import RunFolder
from ssplat_jax.streaming.streamsplat import StreamSplat


@pytest.mark.parametrize("has_previous", [False, True])
def test_no_readable_state_suggests_overwrite(has_previous, tmp_path):
    folder = RunFolder(tmp_path)
    folder.state.write_bytes(b"PK damaged")
    if has_previous:
        previous_path(folder.state).write_bytes(b"damaged too")
    capture, model = open_capture("procedural:room?frames=2&size=32x24"), StreamSplat(preset("tiny"))
    params = load_params("tiny")
    identity = run_identity(model, params, capture, [0, 1])
    before = sorted(path.name for path in tmp_path.iterdir())
    with pytest.raises(StorageError, match=r"state\.npz.*--overwrite"):
        resume_run(model, params, capture, identity, folder, Reporter(quiet=True))
    assert sorted(path.name for path in tmp_path.iterdir()) == before
