"""A run whose newest saved state is damaged continues from the one before it; without one the message says how."""

import jax.numpy as jnp
import numpy as np
import pytest

from ssplat_jax.config import preset
from ssplat_jax.core.atomic import previous_path
from ssplat_jax.core.console import Reporter
from ssplat_jax.core.errors import StorageError
from ssplat_jax.core.pytree import replace
from ssplat_jax.data.open_capture import open_capture
from ssplat_jax.model.streamsplat import StreamSplat
from ssplat_jax.runs.resume import RunState, resume_run, run_identity, save_run
from ssplat_jax.storage.run_folder import RunFolder
from ssplat_jax.storage.weights import load_params
from ssplat_jax.streaming.session import Session


def test_the_damaged_state_is_kept_aside_and_the_one_before_takes_its_place(tmp_path, capsys):
    capture, config = open_capture("procedural:room?frames=8&size=32x24"), preset("tiny").replace(capacity=256)
    model, params, folder = StreamSplat(config), load_params("tiny"), RunFolder(tmp_path)
    identity = run_identity(model, params, capture, range(8))
    run = RunState(Session(model, params, model.init_cache()), capture.stream_frame(config, [0]), {})
    for done in (4, 8):
        cache = model.init_cache()
        run.session.cache = replace(cache, num_voxels=jnp.int32(done), voxels=cache.voxels.at[:done].set(done))
        run.exposures = {i: np.full(3, 0.5, np.float32) for i in range(done)}
        save_run(run, identity, folder)
    good = previous_path(folder.state).read_bytes()
    damaged = folder.state.read_bytes()[:-7]
    folder.state.write_bytes(damaged)
    resumed = resume_run(model, params, capture, identity, folder, Reporter(quiet=False))
    assert "after 4 views" in " ".join(capsys.readouterr().err.split())
    assert resumed.num_views == 4 and int(resumed.session.cache.num_voxels) == 4
    aside = folder.state.with_name(folder.state.name + ".damaged")
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == {
        folder.state.name: good,
        aside.name: damaged,
    }


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
