"""State dicts of PyTorch are read exactly, and no pickle is executed."""

import io
import os
import pickle
import struct
import time
import zipfile
from pathlib import Path

import ml_dtypes
import numpy as np
import pytest

from ssplat_jax.core.errors import InputError
from ssplat_jax.storage.torch_files import read_arrays, read_shapes
from tests.evaluation.lpips_fixture import FOLDER, small_dict

FILES = {"zip": FOLDER / "zip.pth", "legacy": FOLDER / "legacy.pth"}
SHAPES = {name: x.shape for name, (x, _) in small_dict().items()}
MAGIC = 0x1950A86A20F9469CFC6C


def rounded(x: np.ndarray, dtype: str) -> np.ndarray:
    return x.astype(getattr(ml_dtypes, dtype, dtype)).astype(np.float32)


@pytest.mark.parametrize("form", FILES)
def test_files_of_pytorch_are_read_exactly(form):
    arrays = read_arrays(FILES[form], SHAPES)
    assert list(arrays) == list(SHAPES)
    for name, (x, dtype) in small_dict().items():
        np.testing.assert_array_equal(arrays[name], rounded(x, dtype), err_msg=name)


@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
def test_an_npz_with_the_same_names_is_equivalent(save, tmp_path):
    save(tmp_path / "a.npz", **{name: x for name, (x, _) in small_dict().items()})
    for name, array in read_arrays(tmp_path / "a.npz", SHAPES).items():
        np.testing.assert_array_equal(array, small_dict()[name][0])


# -- files written by hand, opcode by opcode --------------------------------------------------------------------------


def text(s: str) -> bytes:
    return b"X" + struct.pack("<I", len(s)) + s.encode()


def number(n: int) -> bytes:
    return b"I%d\n" % n


def numbers(*ns: int) -> bytes:
    return b"(" + b"".join(map(number, ns)) + b"t"


def storage(count: int, *, kind: str = "FloatStorage", view: bytes = b"") -> bytes:
    return (
        b"(" + text("storage") + f"ctorch\n{kind}\n".encode() + text("0") + text("cpu") + number(count) + view + b"tQ"
    )


def tensor(offset: int, shape: tuple, strides: tuple, count: int = 6, **changes) -> bytes:
    description = storage(count, **changes) + number(offset) + numbers(*shape) + numbers(*strides)
    return b"ctorch._utils\n_rebuild_tensor\n(" + description + b"tR"


def state_dict(**values: bytes) -> bytes:
    items = b"".join(text(name) + value for name, value in values.items())
    return b"\x80\x02ccollections\nOrderedDict\n)R(" + items + b"u."


def in_zip(path: Path, pickled: bytes, data: bytes = bytes(24), **members: bytes) -> Path:
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("a/data.pkl", pickled)
        archive.writestr("a/data/0", data)
        for name, contents in members.items():
            archive.writestr(f"a/{name}", contents)
    return path


def in_legacy(path: Path, pickled: bytes) -> Path:
    heads = b"".join(pickle.dumps(x, 2) for x in (MAGIC, 1001, {"little_endian": True}))
    path.write_bytes(heads + pickled + pickle.dumps(["0"], 2) + struct.pack("<q", 6) + bytes(24))
    return path


def test_offsets_and_strides_are_respected(tmp_path):
    data = np.arange(6, dtype="<f4").tobytes()
    path = in_zip(tmp_path / "a", state_dict(x=tensor(1, (2, 2), (1, 3)), y=tensor(5, (3,), (0,))), data)
    arrays = read_arrays(path, {"x": (2, 2), "y": (3,)})
    np.testing.assert_array_equal(arrays["x"], [[1, 4], [2, 5]])
    np.testing.assert_array_equal(arrays["y"], [5, 5, 5])


@pytest.mark.parametrize("name", ["state_dict", "model"])
def test_other_entries_of_training_checkpoints_are_ignored(name, tmp_path):
    inside = b"}(" + text("x") + tensor(0, (2, 3), (3, 1)) + b"u"
    path = in_zip(tmp_path / "a", state_dict(epoch=number(7), **{name: inside}), np.arange(6, dtype="<f4").tobytes())
    assert read_shapes(path) == {"x": (2, 3)}
    np.testing.assert_array_equal(read_arrays(path, {"x": (2, 3)})["x"], [[0, 1, 2], [3, 4, 5]])


@pytest.mark.parametrize(
    ("offset", "shape", "strides", "count"),
    [
        (1, (6,), (1,), 6),
        (0, (2, 4), (3, 1), 6),
        (-1, (2,), (1,), 6),
        (5, (2,), (-1,), 6),
        (0, (2,), (1 << 70,), 6),
        (0, (8,), (1,), 8),  # the file holds six values
        (0, (2,), (1,), -6),
        (0, (2, 2), (1,), 6),
    ],
)
def test_a_tensor_beyond_its_storage_is_refused(offset, shape, strides, count, tmp_path):
    path = in_zip(tmp_path / "a", state_dict(x=tensor(offset, shape, strides, count)))
    with pytest.raises(InputError, match="damaged"):
        read_arrays(path, {"x": shape})


def test_parameters_of_every_pytorch_version_are_read(tmp_path):
    plain = tensor(0, (6,), (1,))
    parameter = b"ctorch.nn.parameter\nParameter\n"
    path = in_zip(
        tmp_path / "a",
        state_dict(
            now=b"ctorch._utils\n_rebuild_parameter\n(" + plain + b"\x88ccollections\nOrderedDict\n)RtR",
            later_2017=parameter + b"(" + plain + b"tR(\x88\x89Ntb",
            early_2017=parameter + b")\x81(" + plain + b"NN\x88\x89tb",
        ),
        np.arange(6, dtype="<f4").tobytes(),
    )
    for array in read_arrays(path, {"now": (6,), "later_2017": (6,), "early_2017": (6,)}).values():
        np.testing.assert_array_equal(array, np.arange(6))


# -- refusals ---------------------------------------------------------------------------------------------------------


class Calls:
    """Object whose unpickling calls `function(argument)`."""

    def __init__(self, function, argument):
        self.call = (function, (argument,))

    def __reduce__(self):
        return self.call


@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
@pytest.mark.parametrize("form", [in_zip, in_legacy])
def test_a_pickle_with_a_call_is_refused_and_not_run(form, protocol, tmp_path):
    marker = tmp_path / "executed"
    hostile = pickle.dumps({"x": Calls(os.system, f"touch {marker}")}, protocol)
    path = form(tmp_path / "a.pth", hostile)
    with pytest.raises(InputError, match="nothing was run") as caught:
        read_arrays(path, {"x": (1,)})
    assert not marker.exists() and "\n" not in str(caught.value)
    if protocol:  # protocol 0 has opcodes of its own, which are refused before the name
        assert "system" in str(caught.value)
    pickle.loads(hostile)
    assert marker.exists()  # unpickling does execute it


@pytest.mark.parametrize(
    ("value", "said"),
    [
        (b"cbuiltins\neval\n", "builtins.eval"),
        (b"ctorch._utils\n_rebuild_qtensor\n", "_rebuild_qtensor"),
        (b"ctorch\nFloatStorage\n)R", "calls torch.FloatStorage"),
        (b"\x82\x01", "EXT1"),
        (tensor(0, (2,), (1,), view=b"(" + text("k") + number(0) + number(1) + b"t"), "plain storages"),
        (tensor(0, (2,), (1,), kind="LongStorage"), "torch.LongStorage"),
        (number(5), "wanted an array x"),
    ],
)
def test_errors_name_what_is_not_a_tensor(value, said, tmp_path):
    with pytest.raises(InputError, match=said):
        read_arrays(in_zip(tmp_path / "a", state_dict(x=value)), {"x": (2,)})


def test_a_key_that_takes_forever_to_hash_is_not_hashed(tmp_path):
    bomb = b"\x80\x02}()" + b"q\x00h\x00\x86" * 60 + text("v") + b"u."
    since = time.perf_counter()
    with pytest.raises(InputError):
        read_arrays(in_zip(tmp_path / "a", bomb), {"x": (2,)})
    assert time.perf_counter() - since < 5


def test_errors_name_missing_arrays_and_wrong_shapes():
    with pytest.raises(InputError, match=r"zip.pth: wanted an array features.0.weight"):
        read_arrays(FILES["zip"], {"features.0.weight": (64, 3, 3, 3)})
    with pytest.raises(InputError, match=r"wanted plain of shape \(3, 5\), got \(3, 4\)"):
        read_arrays(FILES["legacy"], {"plain": (3, 5)})


def test_values_that_are_not_finite_are_refused(tmp_path):
    np.savez(tmp_path / "a.npz", x=np.array([1.0, np.nan]))
    with pytest.raises(InputError, match="x holds values that are not finite"):
        read_arrays(tmp_path / "a.npz", {"x": (2,)})


@pytest.mark.parametrize("x", [np.zeros(2, np.int64), np.array([None, 1], object)])
def test_an_npz_of_other_types_is_refused(x, tmp_path):
    np.savez(tmp_path / "a.npz", x=x)
    with pytest.raises(InputError, match=r"floating point|allow_pickle"):
        read_arrays(tmp_path / "a.npz", {"x": (2,)})


def test_an_array_of_another_shape_is_refused_before_it_is_read(tmp_path):
    buffer = io.BytesIO()
    np.lib.format.write_array_header_1_0(buffer, {"descr": "<f4", "fortran_order": False, "shape": (1 << 50,)})
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.writestr("x.npy", buffer.getvalue())
    with pytest.raises(InputError, match="of shape"):
        read_arrays(tmp_path / "a.npz", {"x": (2,)})


def test_other_files_are_refused(tmp_path):
    for name, contents in (("empty", b""), ("text", b"<html>not found</html>"), ("pickle", pickle.dumps({}))):
        (tmp_path / name).write_bytes(contents)
        with pytest.raises(InputError, match="got neither"):
            read_arrays(tmp_path / name, SHAPES)
    for path in (tmp_path, tmp_path / "absent"):
        with pytest.raises(InputError, match="cannot be read"):
            read_arrays(path, SHAPES)
    with pytest.raises(InputError, match="big-endian"):
        read_arrays(in_zip(tmp_path / "big", state_dict(), byteorder=b"big"), SHAPES)


@pytest.mark.parametrize("form", FILES)
def test_damaged_files_are_read_or_refused(form, tmp_path):
    whole = FILES[form].read_bytes()
    path = tmp_path / "a.pth"
    rng = np.random.default_rng(0)
    for length in range(0, len(whole), 7):
        path.write_bytes(whole[:length])
        with pytest.raises(InputError):
            read_arrays(path, SHAPES)
    for _ in range(600):
        damaged = bytearray(whole)
        damaged[rng.integers(len(whole))] ^= 1 << rng.integers(8)
        path.write_bytes(damaged)
        try:
            arrays = read_arrays(path, SHAPES)
        except InputError:
            continue
        assert {name: x.shape for name, x in arrays.items()} == SHAPES
