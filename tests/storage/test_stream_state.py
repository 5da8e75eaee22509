"""Stream states on disk are read back exactly, or refused by name."""

import contextlib
import errno
import itertools
import os
import resource

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ssplat_jax.cache.state import init_cache
from ssplat_jax.core.atomic import write_atomic
from ssplat_jax.core.errors import InputError, StorageError
from ssplat_jax.storage.saved_states import load_state, save_state
from tests.cache.streams import CAPACITY, CONFIG, Recipe, fuse, to_jax

HEADER = {"config": CONFIG.to_dict(), "chunks": 3, "note": "ω"}
CHUNKS = [to_jax(Recipe(seed, "few", "normal", "random").tokens()) for seed in range(4)]


def stream(chunks):
    cache = init_cache(CONFIG, CAPACITY)
    for tokens in chunks:
        cache = fuse(cache, tokens, CONFIG)
    return cache


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    path = tmp_path_factory.mktemp("state") / "state.npz"
    save_state(path, stream(CHUNKS[:3]), HEADER)
    return path


def assert_identical(a, b):
    jax.tree.map(np.testing.assert_array_equal, a, b)
    assert jax.tree.map(lambda x: x.dtype, a) == jax.tree.map(lambda x: x.dtype, b)


def test_state_is_read_back_to_the_last_bit_and_written_to_the_same_bytes(saved, tmp_path):
    cache, header = load_state(saved)
    assert header == HEADER
    assert_identical(cache, stream(CHUNKS[:3]))
    save_state(tmp_path / "again.npz", cache, header)
    assert (tmp_path / "again.npz").read_bytes() == saved.read_bytes()


def test_batches_of_caches_are_refused_and_not_written(saved, tmp_path):
    caches = jax.tree.map(lambda x: jnp.stack([x, x])[None], load_state(saved)[0])
    with pytest.raises(InputError, match=r"\[1, 2\].*one at a time"):
        save_state(tmp_path / "state.npz", caches, HEADER)
    assert not list(tmp_path.iterdir())


def test_no_damaged_foreign_or_missing_file_is_loaded(saved, tmp_path):
    contents, rng, damaged = bytearray(saved.read_bytes()), np.random.default_rng(0), tmp_path / "damaged.npz"
    ends = [*range(64), *range(len(contents) - 100, len(contents))]  # records of the zip format, and the checksum
    lengths = [*np.linspace(0, len(contents) - 1, 10).astype(int), len(contents) - 64, len(contents) - 65]
    spoiled = [contents[:length] for length in lengths]
    for byte in [*rng.integers(0, len(contents), 100), *ends]:
        spoiled.append(contents.copy())
        spoiled[-1][byte] ^= 1 << rng.integers(8)
    for held in spoiled:
        damaged.write_bytes(held)
        with pytest.raises(StorageError, match=r"damaged\.npz: the file is corrupt"):
            load_state(damaged)
    np.savez(tmp_path / "foreign.npz", x=np.zeros(3))
    for name in ("foreign.npz", "absent.npz"):
        with pytest.raises(StorageError, match=name):
            load_state(tmp_path / name)


@contextlib.contextmanager
def full_disk(size):
    """Limits the size of files; use it only around the call, since it affects the log of the tests too."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_a_full_disk_leaves_the_previous_state(tmp_path):
    path, old = tmp_path / "state.npz", stream(CHUNKS[:3])
    save_state(path, old, {})
    new, size = stream(CHUNKS), int(0.6 * path.stat().st_size)
    with pytest.raises(StorageError, match=r"state\.npz"), full_disk(size):
        save_state(path, new, {})
    assert [p.name for p in tmp_path.iterdir()] == ["state.npz"]
    assert_identical(load_state(path)[0], old)


@pytest.mark.parametrize("failing", [1, 2])  # keep the old file, rename the new one
def test_a_failed_rename_leaves_the_file_in_place(failing, tmp_path, monkeypatch):
    path, replaced, asked = tmp_path / "file", os.replace, itertools.count(1)
    write_atomic(path, b"old", keep_previous=True)

    def refuse(*given):
        if next(asked) == failing:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        replaced(*given)

    monkeypatch.setattr(os, "replace", refuse)
    with pytest.raises(StorageError, match="file: cannot be written"):
        write_atomic(path, b"new", keep_previous=True)
    assert [(p.name, p.read_bytes()) for p in tmp_path.iterdir()] == [("file", b"old")]
