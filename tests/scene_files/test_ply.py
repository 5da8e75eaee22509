"""PLY files: layout, every valid form of other writers, real scenes, and one clear message for what is none."""

import random

import jax.numpy as jnp
import numpy as np
import pytest
from numpy.lib.recfunctions import repack_fields
from plyfile import PlyData, PlyElement

from ssplat_jax.core.gaussians import SH_C0, Gaussians
from ssplat_jax.scene_files.formats import load_ply, load_scene, save_ply
from ssplat_jax.scene_files.ply import property_names
from tests.badinputs.cases import assert_refused
from tests.scene_files.scene_fixture import FIELDS, compressed_ply, scene

BASE = [name for name in property_names(0) if not name.startswith("n")]


def test_rows_hold_the_raw_values_of_the_format(tmp_path):
    sh = np.arange(12, dtype=np.float32).reshape(1, 4, 3) / 10  # [term, channel]
    gaussians = Gaussians(
        means=jnp.array([[1.0, -2.0, 3.0]]),
        quats=jnp.array([[0.0, 3.0, 0.0, 4.0]]),
        scales=jnp.array([[0.5, 1.0, 2.0]]),
        opacities=jnp.array([0.8]),
        sh=jnp.asarray(sh),
    )
    save_ply(tmp_path / "a.ply", gaussians)
    ply = PlyData.read(str(tmp_path / "a.ply"))
    row = ply["vertex"].data[0]
    assert ply.byte_order == "<" and not ply.text
    assert ply.comments == ["SplatRenderMode: mip", "SH degree: 1"]
    rest = sh[0, 1:].T.reshape(-1)  # R R R G G G B B B
    values = [1, -2, 3, 0, 0, 0, *sh[0, 0], *rest, np.log(4), -np.log(2), 0, np.log(2), 0, 0.6, 0, 0.8]
    assert list(map(float, row)) == pytest.approx(values)
    assert list(row.dtype.names) == property_names(9)


@pytest.fixture
def good(tmp_path):
    """Valid file of SH degree 1, with the line ends of Windows in its header."""
    path = tmp_path / "good.ply"
    save_ply(path, scene(1, n=12))
    head, body = path.read_bytes().split(b"end_header\n", 1)
    path.write_bytes(head.replace(b"\n", b"\r\n") + b"end_header\r\n" + body)
    return path


def rewritten(good, change, **form):
    """The good file with a changed table, written by plyfile in another form, between other elements."""
    table = change(PlyData.read(str(good))["vertex"].data.copy())
    camera, faces = np.zeros(3, [("id", "i4"), ("focal", "f8")]), np.array([([0, 1, 2],)], [("vertex_indices", "O")])
    parts = [(camera, "camera"), (table, "vertex"), (faces, "face")]
    path = good.with_name("other.ply")
    PlyData([PlyElement.describe(x, name) for x, name in parts], **form).write(str(path))
    return path


@pytest.mark.parametrize("form", [{"byte_order": ">"}, {"byte_order": "<"}, {"text": True}], ids=str)
@pytest.mark.parametrize("dtype", ["f4", "f8"])
def test_every_encoding_is_the_same_scene(good, form, dtype):
    def shuffled(table):
        """In any order, without normals, among unknown properties."""
        names = [name for name in table.dtype.names if name not in ("nx", "ny", "nz")]
        random.Random(0).shuffle(names)
        out = np.full(len(table), 7, [("label", "u1"), *((name, dtype) for name in names), ("extra", "i2")])
        for name in names:
            out[name] = table[name]
        return out

    found, wanted = load_ply(rewritten(good, shuffled, **form)), load_ply(good)
    for name in FIELDS:
        np.testing.assert_allclose(getattr(found, name), getattr(wanted, name), rtol=3e-6, atol=1e-6)
    assert load_ply(rewritten(good, lambda t: shuffled(t)[:0], **form)).num_gaussians == 0


def test_discs_of_2dgs_have_no_third_scale(good):
    names = [name for name in PlyData.read(str(good))["vertex"].data.dtype.names if name != "scale_2"]
    disc, whole = load_ply(rewritten(good, lambda table: repack_fields(table[names]), byte_order="<")), load_ply(good)
    np.testing.assert_allclose(disc.scales[:, :2], whole.scales[:, :2], rtol=1e-6)
    assert np.max(disc.scales[:, 2]) < 1e-8


def test_infinite_logits_huge_scales_and_zero_quaternions_have_a_meaning(good):
    def spoil(table):
        table["opacity"][:3] = np.inf, -np.inf, 500.0
        table["scale_0"][:2] = 300.0, -300.0
        table["scale_2"][:2] = -np.inf  # discs without thickness, as splat-transform writes 2D Gaussians
        for i in range(4):
            table[f"rot_{i}"][2] = 0
            table[f"rot_{i}"][3] *= 1e25
        return table

    read, untouched = load_ply(rewritten(good, spoil, byte_order="<")), load_ply(good)
    np.testing.assert_array_equal(read.opacities[:3], [1.0, 0.0, 1.0])
    np.testing.assert_allclose(read.scales[:2, 0], [np.exp(20), np.exp(-20)], rtol=1e-6)
    np.testing.assert_allclose(read.scales[:2, 2], np.exp(-20), rtol=1e-6)
    np.testing.assert_array_equal(read.quats[2], [1, 0, 0, 0])
    np.testing.assert_allclose(read.quats[3], untouched.quats[3], atol=1e-6)


def test_a_trained_scene_holds_what_the_formulas_of_the_format_say(scenes):
    ours = load_ply(scenes / "kacytran_iter7000.ply")
    v = PlyData.read(str(scenes / "kacytran_iter7000.ply"))["vertex"].data
    stack = lambda *names: np.stack([v[name].astype(np.float64) for name in names], -1)  # noqa: E731
    assert ours.num_gaussians == 9080 and ours.sh_degree == 3
    np.testing.assert_array_equal(ours.means, stack(*"xyz").astype(np.float32))
    quats = stack("rot_0", "rot_1", "rot_2", "rot_3")
    np.testing.assert_allclose(ours.quats, quats / np.linalg.norm(quats, axis=1, keepdims=True), atol=1e-6)
    np.testing.assert_allclose(ours.scales, np.exp(stack("scale_0", "scale_1", "scale_2")), rtol=3e-6)
    np.testing.assert_allclose(ours.opacities, 1 / (1 + np.exp(-stack("opacity")[:, 0])), atol=1e-6)
    for c in range(3):  # the 15 coefficients of red, then of green, then of blue
        wanted = stack(f"f_dc_{c}", *(f"f_rest_{c * 15 + i}" for i in range(15)))
        np.testing.assert_array_equal(ours.sh[:, :, c], wanted.astype(np.float32))


def test_another_writers_compressed_file_is_decoded_as_it_was_meant(scenes):
    found, wanted = load_scene(scenes / "guitar.compressed.ply"), np.load(scenes / "guitar_decoded.npz")
    np.testing.assert_allclose(found.means, wanted["means"], atol=1e-6)
    np.testing.assert_allclose(np.log(found.scales), wanted["log_scales"], atol=1e-5)
    np.testing.assert_allclose(found.opacities, wanted["opacity"], atol=1e-6)
    np.testing.assert_allclose(0.5 + SH_C0 * found.sh[:, 0], wanted["rgb"], atol=1e-6)
    unit = wanted["quats_wxyz"] / np.linalg.norm(wanted["quats_wxyz"], axis=1, keepdims=True)
    np.testing.assert_allclose(np.abs(np.sum(found.quats * unit, axis=1)), 1.0, atol=1e-6)


def test_compressed_files_without_ranges_of_colors_are_read(tmp_path):
    ranges = b"".join(f"property float {end}_{c}\n".encode() for end in ("min", "max") for c in "rgb")
    header, body = compressed_ply(0, 3).replace(ranges, b"").split(b"end_header\n")
    (tmp_path / "a.ply").write_bytes(header + b"end_header\n" + body[:48] + body[72:])
    levels = np.frombuffer(body[72:], "<u4").reshape(3, 4)[:, 3] >> np.array([[24], [16], [8]]) & 255
    colors = 0.5 + SH_C0 * np.asarray(load_ply(tmp_path / "a.ply").sh[:, 0])
    np.testing.assert_allclose(colors, levels.T / 255, atol=1e-6)


def header(count=1, names=BASE, form="binary_little_endian 1.0", kind="float"):
    lines = ["ply", f"format {form}", f"element vertex {count}", *(f"property {kind} {n}" for n in names)]
    return "\n".join([*lines, "end_header\n"]).encode()


ROW = np.zeros(len(BASE), "<f4")
rest = lambda n: [*BASE, *(f"f_rest_{i}" for i in range(n))]  # noqa: E731
spoiled = lambda name, value: np.where(np.array(BASE) == name, value, ROW).astype("<f4").tobytes()  # noqa: E731

BAD_FILES = {
    "empty": (b"", "'ply'"),
    "endless header": (b"ply\n" + b"comment x\n" * 10000, "end_header"),
    "no format": (b"ply\nelement vertex 0\nproperty float x\nend_header\n", "format"),
    "cut off": (header(count=2) + ROW.tobytes() + ROW.tobytes()[:-1], "cut off"),
    "lying count": (header(count=4_000_000_000) + ROW.tobytes(), "4000000000 rows"),
    "f_rest of no degree": (header(names=rest(10)) + bytes(400), "got 10"),
    "NaN": (header() + spoiled("scale_1", np.nan), "log_scales, row 0: wanted finite numbers, got nan"),
    "beyond float32": (header(form="ascii 1.0") + b"1e60 " + b"0 " * 13, "got 1e+60"),
    "an offset of words": (header().replace(b"element", b"comment offset a b c\nelement") + ROW.tobytes(), "'a'"),
    "compressed, without a limit": (compressed_ply().replace(b"max_z", b"max_a"), "'max_z'"),
    "compressed, a chunk too few": (compressed_ply().replace(b"chunk 2", b"chunk 1"), "a chunk for every 256"),
}


@pytest.mark.parametrize("name", BAD_FILES)
def test_bad_file_is_refused_in_one_line(tmp_path, name):
    content, words = BAD_FILES[name]
    (tmp_path / "bad.ply").write_bytes(content)
    assert_refused(load_ply, tmp_path / "bad.ply", words, "bad.ply")
