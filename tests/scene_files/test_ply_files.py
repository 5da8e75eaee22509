"""PLY files of other writers: every valid form is read, and invalid ones are refused with one clear message."""

import random

import numpy as np
import pytest
from plyfile import PlyData, PlyElement

from ssplat_jax.core.errors import InputError
from ssplat_jax.scene_files.ply import BASE_PROPERTIES, load_ply, save_ply
from tests.scene_files.scene_fixture import ROUND_TRIP, scene

FIELDS = ("means", "quats", "scales", "opacities", "sh")
NUM_MUTANTS = 400  # seeded, so that failures can be repeated


@pytest.fixture
def good(tmp_path):
    """Valid file of SH degree 1."""
    save_ply(tmp_path / "good.ply", scene(1, n=12))
    return tmp_path / "good.ply"


def assert_same_scene(a, b):
    for name in FIELDS:
        np.testing.assert_allclose(getattr(a, name), getattr(b, name), rtol=ROUND_TRIP, atol=1e-6)


def rewritten(good, change, **form):
    """The good file with a changed table, written by plyfile in another form."""
    table = change(PlyData.read(str(good))["vertex"].data)
    path = good.with_name("other.ply")
    PlyData([PlyElement.describe(table, "vertex")], **form).write(str(path))
    return path


def with_columns(table, names, dtype="f4"):
    out = np.zeros(len(table), [(name, dtype) for name in names])
    for name in names:
        out[name] = table[name]
    return out


@pytest.mark.parametrize("form", [{"byte_order": ">"}, {"byte_order": "<"}, {"text": True}], ids=str)
@pytest.mark.parametrize("dtype", ["f4", "f8"])
def test_every_encoding_is_the_same_scene(good, form, dtype):
    other = rewritten(good, lambda t: with_columns(t, t.dtype.names, dtype), **form)
    assert_same_scene(load_ply(other), load_ply(good))
    empty = rewritten(good, lambda t: with_columns(t, t.dtype.names, dtype)[:0], **form)
    assert load_ply(empty).num_gaussians == 0


def test_properties_are_found_by_name_among_unknown_ones(good):
    def shuffle(table):
        names = [name for name in table.dtype.names if name not in ("nx", "ny", "nz")]
        random.Random(0).shuffle(names)
        out = np.zeros(len(table), [("label", "u1"), *((name, "f4") for name in names), ("extra", "i2")])
        for name in names:
            out[name] = table[name]
        out["label"], out["extra"] = 7, -3
        return out

    assert_same_scene(load_ply(rewritten(good, shuffle)), load_ply(good))


def test_elements_around_the_vertices_are_skipped(good):
    table = PlyData.read(str(good))["vertex"].data
    camera = np.zeros(3, [("id", "i4"), ("focal", "f8")])
    faces = np.array([([0, 1, 2],)], dtype=[("vertex_indices", "O")])
    for text in (False, True):
        elements = [
            PlyElement.describe(x, name) for x, name in ((camera, "camera"), (table, "vertex"), (faces, "face"))
        ]
        PlyData(elements, text=text, byte_order="<").write(str(good.with_name("three.ply")))
        assert_same_scene(load_ply(good.with_name("three.ply")), load_ply(good))


def test_windows_line_ends_in_the_header(good):
    head, body = good.read_bytes().split(b"end_header\n", 1)
    good.with_name("crlf.ply").write_bytes(head.replace(b"\n", b"\r\n") + b"end_header\r\n" + body)
    assert_same_scene(load_ply(good.with_name("crlf.ply")), load_ply(good))


def test_infinite_logits_are_opacities_of_zero_and_one(good):
    def spoil(table):
        table = table.copy()
        table["opacity"][:3] = np.inf, -np.inf, 500.0
        return table

    np.testing.assert_array_equal(load_ply(rewritten(good, spoil)).opacities[:3], [1.0, 0.0, 1.0])


def test_scales_are_clamped_and_quaternions_normalized(good):
    def spoil(table):
        table = table.copy()
        table["scale_0"][:2] = 300.0, -300.0
        for i in range(4):
            table[f"rot_{i}"][2] = 0
            table[f"rot_{i}"][3] *= 1e25
        return table

    read, untouched = load_ply(rewritten(good, spoil)), load_ply(good)
    np.testing.assert_allclose(read.scales[:2, 0], [np.exp(20), np.exp(-20)], rtol=1e-6)
    np.testing.assert_array_equal(read.quats[2], [1, 0, 0, 0])
    np.testing.assert_allclose(read.quats[3], untouched.quats[3], atol=1e-6)


def header(count=1, names=BASE_PROPERTIES, form="binary_little_endian 1.0", kind="float"):
    lines = [
        "ply",
        f"format {form}",
        f"element vertex {count}",
        *(f"property {kind} {n}" for n in names),
        "end_header\n",
    ]
    return "\n".join(lines).encode()


ROW = np.zeros(len(BASE_PROPERTIES), "<f4")
without = lambda name: tuple(n for n in BASE_PROPERTIES if n != name)  # noqa: E731
rest = lambda n: (*BASE_PROPERTIES, *(f"f_rest_{i}" for i in range(n)))  # noqa: E731
spoiled = lambda name, value: np.where(np.array(BASE_PROPERTIES) == name, value, ROW).astype("<f4").tobytes()  # noqa: E731

BAD_FILES = {
    "empty": (b"", "does not start with 'ply'"),
    "an image": (b"\x89PNG\r\n\x1a\n" + bytes(100), "does not start with 'ply'"),
    "no end of header": (header()[:-12], "end_header"),
    "endless header": (b"ply\n" + b"comment x\n" * 10000, "end_header"),
    "no format": (b"ply\nelement vertex 0\nproperty float x\nend_header\n", "wanted a format"),
    "unknown format": (header(form="binary_middle_endian 1.0") + ROW.tobytes(), "binary_middle_endian"),
    "unknown version": (header(form="ascii 2.0") + ROW.tobytes(), "ascii 2.0"),
    "unknown type": (header(kind="half") + ROW.tobytes(), "half"),
    "negative count": (header(count=-1) + ROW.tobytes(), "element vertex -1"),
    "count of words": (header(count="many") + ROW.tobytes(), "many"),
    "property twice": (header(names=(*BASE_PROPERTIES, "x")) + bytes(60), "property float x"),
    "property before any element": (b"ply\nformat ascii 1.0\nproperty float x\nend_header\n", "property float x"),
    "no vertices": (b"ply\nformat ascii 1.0\nelement face 1\nproperty float x\nend_header\n1\n", "there is face"),
    "vertices of lists": (
        b"ply\nformat ascii 1.0\nelement vertex 1\nproperty list uchar int x\nend_header\n1 1\n",
        "a list",
    ),
    "cut off": (header(count=2) + ROW.tobytes() + ROW.tobytes()[:-1], "cut off"),
    "lying count": (header(count=4_000_000_000) + ROW.tobytes(), "4000000000 rows"),
    "absurd count": (header(count="9" * 400) + ROW.tobytes(), "rows"),
    "lying count in ascii": (header(count=10**12, form="ascii 1.0") + b"0 " * 14, "1000000000000 rows"),
    "words in ascii": (header(form="ascii 1.0") + b"zero " * 14, "wanted numbers"),
    "no position": (header(names=without("y")) + ROW.tobytes(), "'y'"),
    "no opacity": (header(names=without("opacity")) + ROW.tobytes(), "'opacity'"),
    "no rotation": (header(names=without("rot_3")) + ROW.tobytes(), "'rot_3'"),
    "a mesh": (header(names=("x", "y", "z", "red", "green", "blue")) + ROW.tobytes(), "'f_dc_0'"),
    "f_rest of no degree": (header(names=rest(10)) + bytes(400), "got 10"),
    "f_rest with a gap": (header(names=(*rest(8), "f_rest_9")) + bytes(400), "got 9"),
    "NaN": (header() + spoiled("scale_1", np.nan), "vertex 0: wanted a finite scale_1, got nan"),
    "NaN opacity": (header() + spoiled("opacity", np.nan), "finite opacity"),
    "infinite position": (header() + spoiled("z", -np.inf), "finite z, got -inf"),
    "beyond float32": (header(form="ascii 1.0") + b"1e60 " + b"0 " * 13, "finite x, got 1e+60"),
}


@pytest.mark.parametrize("name", BAD_FILES)
def test_bad_file_is_refused_in_one_line(tmp_path, name):
    content, words = BAD_FILES[name]
    (tmp_path / "bad.ply").write_bytes(content)
    with pytest.raises(InputError) as caught:
        load_ply(tmp_path / "bad.ply")
    message = str(caught.value)
    assert words in message and "bad.ply" in message and "\n" not in message and len(message) < 600


def test_the_unchanged_file_of_the_cases_is_good(tmp_path):
    (tmp_path / "good.ply").write_bytes(header() + ROW.tobytes())
    assert load_ply(tmp_path / "good.ply").num_gaussians == 1


def test_folders_and_missing_files_are_refused(tmp_path):
    for path in (tmp_path, tmp_path / "nothing.ply"):
        with pytest.raises(InputError, match="cannot be read"):
            load_ply(path)


def test_mutated_files_are_read_or_refused(good):
    data = good.read_bytes()
    rng = random.Random(1)
    num_read = 0
    for _ in range(NUM_MUTANTS):
        mutant = bytearray(data[: rng.randrange(len(data))] if rng.random() < 0.3 else data)
        for _ in range(rng.randrange(4)):
            # Half of the changes are in the header, a third of the file.
            reach = len(mutant) if rng.random() < 0.5 else min(600, len(mutant))
            if reach:
                mutant[rng.randrange(reach)] = rng.randrange(256)
        good.with_name("mutant.ply").write_bytes(mutant)
        try:
            read = load_ply(good.with_name("mutant.ply"))
        except InputError:
            continue
        num_read += 1
        assert all(np.isfinite(np.asarray(getattr(read, name))).all() for name in FIELDS)
    assert 0 < num_read < NUM_MUTANTS
