"""JSON is strict, arrays are read back bit for bit or refused, and tensors of other programs are read as float32."""

import json
import math

import ml_dtypes
import numpy as np
import pytest

from ssplat_jax.core.errors import InputError, StorageError
from ssplat_jax.storage.files import json_text, load_arrays, read_tensors, save_arrays

TENSORS = {
    "a": np.arange(6, dtype=np.float32).reshape(2, 3),
    "half": np.full(3, 0.1, np.float16),
    "wide": np.full(2, 0.1),
}


def test_numbers_that_are_not_finite_are_null_at_any_depth():
    value = {"psnr": math.nan, "rows": [{"x": math.inf}, (1.5, -math.inf)], "name": "NaN", "n": 3}
    wanted = {"psnr": None, "rows": [{"x": None}, [1.5, None]], "name": "NaN", "n": 3}
    assert json.loads(json_text(value), parse_constant=pytest.fail) == wanted


def test_arrays_of_every_type_are_read_back_by_us_and_by_numpy(tmp_path):
    arrays = TENSORS | {"scalar": np.array(3, np.int32), "none": np.zeros((0, 4), bool)}
    arrays["brain"] = np.arange(4).astype(ml_dtypes.bfloat16)
    save_arrays(tmp_path / "a.npz", arrays, "test 1", {"note": "ω"})
    held, header = load_arrays(tmp_path / "a.npz", "test 1")
    assert header == {"note": "ω"} and held.keys() == arrays.keys()
    for name, x in arrays.items():
        assert held[name].dtype == x.dtype
        np.testing.assert_array_equal(held[name], x)
    np.testing.assert_array_equal(np.load(tmp_path / "a.npz")["a"], arrays["a"])
    with pytest.raises(StorageError, match="wanted a file of test 2, got one of test 1"):
        load_arrays(tmp_path / "a.npz", "test 2")


def write_safetensors(path, arrays):
    """As the format's description says: the length of a header, the header, the bytes."""
    facts, body, names = {"__metadata__": {"format": "pt"}}, b"", {"f4": "F32", "f2": "F16", "f8": "F64", "i8": "I64"}
    for name, x in arrays.items():
        dtype = names.get(x.dtype.str[1:], "BF16")
        facts[name] = {"dtype": dtype, "shape": x.shape, "data_offsets": [len(body), len(body) + x.nbytes]}
        body += x.tobytes()
    header = json.dumps(facts).encode()
    path.write_bytes(len(header).to_bytes(8, "little") + header + body)


@pytest.mark.parametrize("form", ["npz", "safetensors"])
def test_tensors_are_read_as_float32_and_integers_left_out(form, tmp_path):
    path, arrays = tmp_path / f"a.{form}", TENSORS | {"count": np.array([7])}
    if form == "npz":
        np.savez(path, **arrays)
    else:
        arrays["brain"] = np.arange(4).astype(ml_dtypes.bfloat16)
        write_safetensors(path, arrays)
    held = read_tensors(path)
    assert held.keys() == arrays.keys() - {"count"}
    for name, x in held.items():
        np.testing.assert_array_equal(x, arrays[name].astype(np.float32))
        assert x.dtype == np.float32
    for length in range(0, path.stat().st_size, 5):
        path.with_name("cut").write_bytes(path.read_bytes()[:length])
        with pytest.raises(InputError):
            read_tensors(path.with_name("cut"))
