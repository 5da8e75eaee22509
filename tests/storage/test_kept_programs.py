"""Executables on disk: a second process neither traces nor compiles, and nothing in the store can spoil a result."""

import dataclasses
import functools
import hashlib
import importlib.metadata
import os
import shutil
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor

import jax
import numpy as np
import pytest

from ssplat_jax.cache.fuse import fuse
from ssplat_jax.cache.state import init_cache
from ssplat_jax.core import kept_programs
from ssplat_jax.core.kept_programs import SWITCH, Kept, kept_result
from ssplat_jax.core.numerics import safe_sqrt
from ssplat_jax.data import capture as capture_module
from ssplat_jax.data.depth_range import estimate_depths
from ssplat_jax.data.open_capture import open_capture
from ssplat_jax.data.procedural import procedural_views
from ssplat_jax.model.streamsplat import StreamSplat
from ssplat_jax.streaming.session import Session, feed_capture
from tests.badinputs.cases import make_capture
from tests.cache.streams import CONFIG, Recipe, to_jax
from tests.data.capture_fixture import smooth_capture, with_poses
from tests.data.capture_writers import write_image
from tests.data.test_masks import write_mask
from tests.model.small import random_params
from tests.streaming.narrow_model import NARROW, assert_same_bits

PROCESS = "from tests.storage.test_kept_programs import fused_twice; print(*fused_twice())"


def fused_twice() -> tuple[str, int]:
    """Digest of a cache after a chunk that came twice, its buffers donated, and the number of programs compiled."""
    tokens = to_jax(Recipe(0, "few", "normal", "random").tokens())
    compiled, anew = [], kept_programs._compiled_anew
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(kept_programs, "_compiled_anew", lambda lowered: compiled.append(0) or anew(lowered))
        kept_programs.drop_loaded()
        step, cache = Kept(functools.partial(fuse, config=CONFIG), donate_argnums=(0,)), init_cache(CONFIG)
        for _ in range(2):
            given = cache
            cache = jax.block_until_ready(step(cache, tokens))
            assert given.means.is_deleted(), "not donated"
    data = b"".join(np.asarray(x).tobytes() for x in jax.tree.leaves(cache))
    return hashlib.sha256(data).hexdigest(), len(compiled)


@pytest.fixture(scope="module")
def plain() -> str:
    """The digest without a store."""
    return fused_twice()[0]


@pytest.fixture
def store(tmp_path, monkeypatch):
    """An empty store, which this process uses."""
    monkeypatch.setenv(SWITCH, str(tmp_path / "store"))
    yield tmp_path / "store"
    kept_programs.drop_loaded()


@pytest.fixture(scope="module")
def kept(plain, tmp_path_factory):
    """A store with the entry of `fused_twice`."""
    folder = tmp_path_factory.mktemp("kept") / "store"
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(SWITCH, str(folder))
        assert fused_twice() == (plain, 1)
        kept_programs.drop_loaded()
    return folder


@pytest.fixture
def entry(store, kept):
    """The entry of `fused_twice`, in the store."""
    shutil.copytree(kept, store)
    (entry,) = store.iterdir()
    return entry


@pytest.mark.usefixtures("compiled_plainly")
def test_a_second_stream_neither_traces_nor_compiles(store, monkeypatch):
    def streamed():
        model = StreamSplat(NARROW.replace(capacity=1024, hpda=False, cgfi=False, mixer_blocks=0, detail=False))
        session = Session(model, random_params(model.config))
        capture = open_capture("procedural:room?frames=8&size=32x32")
        feed_capture(session, capture, range(8), capture.stream_frame(model.config, range(8)))
        return session.cache, session.gaussians(), session.step_memory_bytes

    def refused(lowered):
        raise AssertionError("compiled again")

    first = streamed()
    kept_programs.drop_loaded()
    monkeypatch.setattr(kept_programs, "_compiled_anew", refused)
    monkeypatch.setattr(StreamSplat, "predict", refused)  # of which a trace of `step` would begin
    second = streamed()
    assert_same_bits(second[:2], first[:2])
    assert second[2] == first[2] > 0


def test_processes_that_fill_a_store_at_once_agree_and_the_next_compiles_nothing(store, plain):
    start = [sys.executable, "-c", PROCESS]
    variables = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    for number, num_compiled in ((2, {"0", "1"}), (1, {"0"})):  # the second may find what the first has written
        started = [subprocess.Popen(start, env=variables, stdout=subprocess.PIPE, text=True) for _ in range(number)]
        for process in started:
            digest, compiled = process.communicate()[0].split()
            assert digest == plain and compiled in num_compiled
        assert len(list(store.iterdir())) == 1


@pytest.mark.parametrize("harm", ["cut short", "empty", "damaged", "of another program", "writable by others"])
def test_an_entry_that_cannot_be_trusted_is_replaced(harm, store, entry, plain):
    data = entry.read_bytes()
    if harm == "of another program":
        Kept(init_cache, static_argnums=(0,))(CONFIG)
        (foreign,) = set(store.iterdir()) - {entry}
        os.replace(foreign, entry)
    elif harm == "writable by others":
        entry.chmod(0o666)
    else:
        middle = len(data) // 2
        damaged = data[:middle] + bytes([data[middle] ^ 1]) + data[middle + 1 :]
        entry.write_bytes({"cut short": data[:middle], "empty": b"", "damaged": damaged}[harm])
    assert fused_twice() == (plain, 1)
    assert fused_twice() == (plain, 0)
    assert entry.stat().st_mode & 0o777 == 0o600


@pytest.mark.parametrize("what", ["jax", "XLA_FLAGS", "precision"])
def test_another_version_flag_or_setting_has_its_own_program(what, store, entry, plain, monkeypatch):
    assert fused_twice() == (plain, 0)
    version = importlib.metadata.version
    with monkeypatch.context() as patch, jax.default_matmul_precision("highest" if what == "precision" else None):
        if what == "jax":
            patch.setattr(importlib.metadata, "version", lambda name: "9.9" if name == "jax" else version(name))
        if what == "XLA_FLAGS":
            patch.setenv("XLA_FLAGS", "--another")  # XLA has read the variable already
        kept_programs._place.cache_clear()
        assert fused_twice() == (plain, 1)
    kept_programs._place.cache_clear()
    assert len(list(store.iterdir())) == 2


def test_without_a_place_to_write_programs_are_compiled(tmp_path, plain, monkeypatch):
    (tmp_path / "file").write_bytes(b"")
    monkeypatch.setenv(SWITCH, str(tmp_path / "file" / "store"))
    assert fused_twice() == (plain, 1)


def test_the_least_recently_used_go_first(store, monkeypatch):
    program = Kept(init_cache, static_argnums=(0,))
    for capacity in (128, 256):
        program(CONFIG.replace(capacity=capacity))
    for age, entry in enumerate(sorted(store.iterdir())):
        os.utime(entry, (1000 - age, 1000 - age))
    used, unused = sorted(store.iterdir())
    kept_programs.drop_loaded()
    for capacity in (128, 256):  # one of them is the older entry: used again, it is the newer
        program(CONFIG.replace(capacity=capacity))
    os.utime(unused, (1, 1))
    # Room for two and a half: an entry's size varies with what XLA makes of the program, by less than half of one.
    both = sum(entry.stat().st_size for entry in store.iterdir())
    monkeypatch.setattr(kept_programs, "MOST_BYTES", both * 5 // 4)
    program(CONFIG.replace(capacity=512))
    assert used.exists() and not unused.exists() and used.stat().st_mtime > 1000


def test_programs_that_compile_side_by_side_leave_jaxs_cache_as_it_was():
    """The second begins before the first is done, and ends after it: JAX's cache is off for both."""
    is_on = lambda: jax.config.jax_enable_compilation_cache  # noqa: E731
    first_runs, second_runs, first_is_done = (threading.Event() for _ in range(3))
    was_off = []

    class Lowered(jax.stages.Lowered):
        def __init__(self, says, hears):
            self.says, self.hears = says, hears

        def compile(self):
            self.says.set()
            was_off.append(self.hears.wait(9) and not is_on())
            return jax.jit(lambda: 0).lower().compile()

    before = is_on()
    jax.config.update("jax_enable_compilation_cache", True)
    try:
        with ThreadPoolExecutor(2) as pool:
            first = pool.submit(kept_programs._compiled_anew, Lowered(first_runs, second_runs))
            first_runs.wait(9)
            second = pool.submit(kept_programs._compiled_anew, Lowered(second_runs, first_is_done))
            first.result()
            first_is_done.set()
            second.result()
        assert is_on() and was_off == [True, True]
    finally:
        jax.config.update("jax_enable_compilation_cache", before)


def test_what_cannot_be_told_apart_is_not_kept(store):
    scale = np.float32(2)
    assert Kept(lambda x: x * scale)(jax.numpy.ones(3)).tolist() == [2, 2, 2]  # a closure, and not of the package
    assert jax.grad(Kept(safe_sqrt))(4.0) == 0.25  # ours, but traced
    assert not store.exists()


def test_an_embedded_scene_is_made_once_and_again_where_its_entry_is_damaged(store, monkeypatch):
    made, wanted = [], ("room", 2, 16, 24, 0)
    cast = procedural_views.raycast
    monkeypatch.setattr(procedural_views, "raycast", lambda *given: made.append(0) or cast(*given))

    def views(*wanted):
        return kept_result(lambda: procedural_views.procedural_capture_arrays(*wanted), "views", *wanted)

    first, again = views(*wanted), views(*wanted)
    assert len(made) == 1
    assert_same_bits(first, again)
    for entry in store.iterdir():
        entry.write_bytes(entry.read_bytes()[:-9])
    views(*wanted)
    views("room", 2, 16, 24, 1)
    assert len(made) >= 3


def test_depths_of_a_capture_are_estimated_once_until_a_frame_is_another(store, tmp_path, monkeypatch):
    estimated, found = [], {}
    counted = lambda *given: estimated.append(0) or estimate_depths(*given)  # noqa: E731
    monkeypatch.setattr(capture_module, "estimate_depths", counted)

    def num_estimated(opened):
        frame = opened.stream_frame(CONFIG)
        range_and_scale = (frame.near, frame.far, frame.scale)
        assert found.setdefault(len(estimated), range_and_scale) == range_and_scale
        return len(estimated)

    def in_files(**options):
        return num_estimated(open_capture(root, **options))

    root = make_capture(tmp_path / "files")
    assert [in_files(), in_files()] == [1, 1]
    write_image(root / "images" / "1.jpg", 9)
    assert [in_files(), in_files()] == [2, 2]
    write_mask(root / "masks" / "1.png")
    assert [in_files(), in_files()] == [3, 3]
    write_mask(root / "masks" / "1.png", white=200)
    assert [in_files(), in_files(size=(32, 24)), in_files()] == [4, 5, 5]
    moved = open_capture(root)
    poses = moved.camtoworlds
    poses[:, :3, 3] *= 2
    assert num_estimated(with_poses(moved, poses)) == 6
    arrays = smooth_capture()
    assert [num_estimated(arrays), num_estimated(arrays)] == [7, 7]
    others = {"images": arrays.pixels.images + np.float32(0.01), "masks": np.ones(arrays.pixels.depths.shape, bool)}
    for number, (name, values) in enumerate(others.items(), start=8):
        pixels = dataclasses.replace(arrays.pixels, **{name: values})
        assert num_estimated(dataclasses.replace(arrays, pixels=pixels)) == number
