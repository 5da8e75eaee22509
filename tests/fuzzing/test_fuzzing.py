"""Damaged files of every kind are read or refused: no other exception, no hang, no gigabyte.

`FUZZ_FILES=5000 pytest tests/fuzzing` damages 5,000 files for each parser (eight minutes on two cores). CI takes
500 each, the default run a few, since the tests of readers and scene files damage a hundred or more.
"""

import contextlib
import io
import os
import pickle
import random
import resource
import signal
import time
import warnings

import numpy as np
import pytest

from ssplat_jax.core.errors import InputError, StorageError
from ssplat_jax.data.posed_image import pose_from_quat
from ssplat_jax.data.readers import tum
from ssplat_jax.storage.npz import load_arrays, save_arrays
from ssplat_jax.storage.torch_pickle import parse_pickle
from tests.badinputs.cases import mutant
from tests.fuzzing.parsers import PARSERS, sealed

NUM_FILES = int(os.environ.get("FUZZ_FILES", "20"))  # for each parser; seeded, so that failures can be repeated
MAX_SECONDS = 5
MAX_BYTES = 1 << 30


class TooSlow(BaseException):
    """Not an Exception, which a parser might take for damage."""


@contextlib.contextmanager
def bounded():
    """Ends what takes longer than `MAX_SECONDS`, and refuses more than `MAX_BYTES` of further memory."""

    def stop(number, frame):
        raise TooSlow

    with open("/proc/self/statm") as file:
        used = int(file.read().split()[0]) * resource.getpagesize()
    limit = resource.getrlimit(resource.RLIMIT_AS)
    handler = signal.signal(signal.SIGALRM, stop)
    resource.setrlimit(resource.RLIMIT_AS, (used + MAX_BYTES, limit[1]))
    signal.setitimer(signal.ITIMER_REAL, MAX_SECONDS)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        resource.setrlimit(resource.RLIMIT_AS, limit)
        signal.signal(signal.SIGALRM, handler)


def damaged(good: bytes, rng: random.Random) -> bytes:
    """Good bytes after some edits, or cut off."""
    return good[: rng.randrange(len(good))] if rng.random() < 0.15 else mutant(good, rng)


@pytest.mark.parametrize("name", PARSERS)
def test_damaged_files_are_read_or_refused(name, tmp_path):
    parser, rng = PARSERS[name], random.Random(name)
    path = parser.write(tmp_path)
    good, num_refused = path.read_bytes(), 0
    parser.read(path)
    for i in range(NUM_FILES):
        path.write_bytes(parser.finish(damaged(good, rng)))
        try:
            with bounded(), warnings.catch_warnings():
                warnings.simplefilter("error")
                parser.read(path)
        except (InputError, StorageError) as error:
            assert "\n" not in str(error) and len(str(error)) < 1000
            num_refused += 1
        except BaseException as error:
            kept = path.with_name(f"{path.name}.{i}")
            kept.write_bytes(path.read_bytes())
            raise AssertionError(f"{kept} (file {i}): {type(error).__name__}: {error}") from error
    assert num_refused > 0


def test_the_bounds_hold():
    with pytest.raises(TooSlow), bounded():
        signal.setitimer(signal.ITIMER_REAL, 0.05)
        while True:
            time.sleep(0.01)
    with pytest.raises(MemoryError), bounded():
        bytearray(2 * MAX_BYTES)


def test_a_quaternion_of_huge_numbers_is_its_direction():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        pose = pose_from_quat([1e300, 0, 0, 1e300], [1, 2, 3], "here")
    np.testing.assert_allclose(pose[:3, :3], [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-12)


@pytest.mark.parametrize("bad", [np.inf, np.nan])
@pytest.mark.parametrize("column", [1, 5])
def test_poses_are_not_mixed_with_what_is_none(bad, column):
    rows = np.array([[0.0, 0, 0, 0, 0, 0, 0, 1], [0.05, 0, 0, 0, 0, 0, 0, 1]])
    rows[1, column] = bad
    with warnings.catch_warnings(), pytest.raises(InputError, match="here: wanted finite numbers"):
        warnings.simplefilter("error")
        tum._pose_at(0.01, rows, "here")


def test_an_archive_of_an_unknown_zip_version_is_damaged(tmp_path):
    path = tmp_path / "a.npz"
    save_arrays(path, {"x": np.zeros(3)}, "test 1", {})
    contents = bytearray(path.read_bytes())
    entry = contents.index(b"PK\x01\x02")
    contents[entry + 6] = 211  # version needed to read the entry: 21.1
    path.write_bytes(sealed(bytes(contents)))
    with pytest.raises(StorageError, match=r"corrupt.*zip file version"):
        load_arrays(path, "test 1")


def test_a_message_does_not_repeat_a_damaged_name(tmp_path):
    path = tmp_path / "a.npz"
    save_arrays(path, {"x": np.zeros(3)}, "test 1", {})
    contents = bytearray(path.read_bytes())
    contents[26:28] = (200).to_bytes(2, "little")  # length of the first file's name, which then has lines in it
    path.write_bytes(sealed(bytes(contents)))
    with pytest.raises(StorageError, match="corrupt") as refused:
        load_arrays(path, "test 1")
    assert "\n" not in str(refused.value) and len(str(refused.value)) < 400


def test_a_pickle_that_says_it_is_huge_takes_no_memory(tmp_path):
    path = tmp_path / "a.pkl"
    path.write_bytes(b"\x80\x02X" + (2**32 - 16).to_bytes(4, "little") + b"short")
    with path.open("rb") as file, bounded(), pytest.raises(ValueError, match="remain"):
        parse_pickle(file)


def test_a_pickle_calls_names_alone():
    number = b"K\x07"
    with pytest.raises(ValueError, match="no function"):
        parse_pickle(io.BytesIO(b"\x80\x02" + number + b")R."))


def test_pickles_follow_each_other_in_a_file(tmp_path):
    path = tmp_path / "a.pkl"
    path.write_bytes(pickle.dumps(7, protocol=2) + pickle.dumps({"a": 8}, protocol=2) + b"rest")
    with path.open("rb") as file:
        assert [parse_pickle(file)[0] for _ in range(2)] == [7, {"a": 8}]
        assert file.read() == b"rest"
