"""Damaged files of every kind are read or refused: no other exception, no hang, no gigabyte.

`FUZZ_FILES=5000 pytest tests/fuzzing` damages 5,000 files for each parser (eight minutes on two cores). CI takes
500 each, the default run a few, since the tests of readers and scene files damage a hundred or more.
"""

import contextlib
import os
import random
import resource
import signal
import warnings

import numpy as np
import pytest

from ssplat_jax.core.errors import InputError, StorageError
from ssplat_jax.data.posed_image import pose_from_quat
from tests.fuzzing.parsers import PARSERS

NUM_FILES = int(os.environ.get("FUZZ_FILES", "40"))  # for each parser; seeded, so that failures can be repeated
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
    """Good bytes cut off, or after a few edits: bytes are changed, removed, repeated or replaced."""
    if rng.random() < 0.15:
        return good[: rng.randrange(len(good))]
    out = bytearray(good)
    for _ in range(rng.randint(1, 6)):
        at = rng.randrange(len(out))
        kind = rng.randrange(4)
        if kind == 0:
            out[at] = rng.randrange(256)
        elif kind == 1:
            del out[at : at + rng.randint(1, 30)]
        elif kind == 2:
            out[at:at] = out[at : at + rng.randint(1, 30)]
        else:
            out[at : at + 1] = rng.choice([b"-", b"1e999", b"null", b"{", b"]", b'"', b"0", b"NaN", b"\xff"])
        if not out:
            break
    return bytes(out)


@pytest.mark.parametrize("name", PARSERS)
def test_damaged_files_are_read_or_refused(name, tmp_path):
    parser, rng = PARSERS[name], random.Random(name)
    path = parser.write(tmp_path)
    good, num_refused = path.read_bytes(), 0
    parser.read(path)
    for i in range(NUM_FILES):
        path.write_bytes(damaged(good, rng))
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


def test_a_quaternion_of_huge_numbers_is_its_direction():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        pose = pose_from_quat([1e300, 0, 0, 1e300], [1, 2, 3], "here")
    np.testing.assert_allclose(pose[:3, :3], [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-12)
