"""Every format: what is read is what was written, within half a step, and plain decoders get the same."""

import dataclasses
import functools
import gzip
import io
import json
import math
import random
import shutil
import struct
import subprocess
import zipfile

import jax.numpy as jnp
import numpy as np
import pytest
import zstandard
from PIL import Image
from scipy.spatial import KDTree

import ssplat_jax as ss
from ssplat_jax.cache.changes import changed_gaussians, no_change
from ssplat_jax.core.errors import InputError
from ssplat_jax.core.gaussians import SH_C0, Gaussians
from ssplat_jax.core.pytree import replace
from ssplat_jax.scene_files.formats import SCENE_READERS, WRITERS, save_gaussians
from tests.commands.command_fixture import run
from tests.scene_files.scene_fixture import FIELDS, assert_turned, camera, compressed_ply, scene

BOTH_WAYS = [suffix for suffix in WRITERS if suffix in SCENE_READERS]


@dataclasses.dataclass
class Steps:
    """Largest error of each field. By default that of float32 after a logarithm and an exponential."""

    means: float = 0.0
    degrees: float = 0.05  # float32: the arc cosine of 1 - 1e-7 is 0.03 degrees
    log_scales: float = 3e-6
    opacities: float = 2e-6  # clamped to 1 - 1e-6
    constant: float = 0.0
    rest: float = 0.0


HALF = 0.501  # of a step
STEPS = {
    ".ply": Steps(),
    ".glb": Steps(),
    ".spz": Steps(HALF * 2.0**-21, 0.4, HALF / 16, HALF / 255, HALF / 255 / 0.15, HALF / 128),  # 4 = 2^23 / 2^21
    # Logarithmic positions: 2 ln 5 / 65,535, five times as much where |p| = 4. Codebooks: half of the codes are even.
    ".sog": Steps(
        HALF * 5 * 2 * math.log(5) / 65535, 0.8, HALF * 3 / 127, HALF / 255, HALF * 2.4 / 127, HALF * 3 / 127
    ),
}


def scene_for(degree: int = 3, n: int = 300) -> Gaussians:
    """Turned, stretched Gaussians, with SH that every format holds."""
    return replace(gaussians := scene(degree, n=n), sh=jnp.clip(gaussians.sh, -0.99, 0.99))


def assert_same(found: Gaussians, wanted: Gaussians, steps: Steps) -> None:
    """Each Gaussian of `wanted` is in `found`, in any order, within `steps`."""
    assert found.num_gaussians == wanted.num_gaussians and found.sh_degree == wanted.sh_degree
    if not wanted.num_gaussians:
        return
    found, wanted = ({name: np.asarray(getattr(x, name), np.float64) for name in FIELDS} for x in (found, wanted))
    order = KDTree(found["means"]).query(wanted["means"])[1]
    assert len(set(order)) == len(order)
    found = {name: x[order] for name, x in found.items()}
    off = {name: np.abs(found[name] - wanted[name]) for name in ("means", "opacities", "sh")}
    assert off["means"].max() <= steps.means and off["opacities"].max() <= steps.opacities
    assert off["sh"][:, 0].max() <= steps.constant + 1e-6 and off["sh"][:, 1:].max(initial=0) <= steps.rest + 1e-6
    assert np.abs(np.log(found["scales"] / wanted["scales"])).max() <= steps.log_scales
    lengths = [np.linalg.norm(x["quats"], axis=1) for x in (found, wanted)]
    cosines = np.abs(np.sum(found["quats"] * wanted["quats"], axis=1)) / lengths[0] / lengths[1]
    assert np.degrees(2 * np.arccos(np.minimum(cosines, 1))).max() <= steps.degrees


@pytest.mark.parametrize("suffix", BOTH_WAYS)
@pytest.mark.parametrize(("degree", "n"), [(0, 300), (1, 300), (2, 300), (3, 300), (3, 1), (0, 0)])
def test_what_is_written_is_read_within_half_a_step(tmp_path, suffix, degree, n):
    gaussians, path = scene_for(degree, n), tmp_path / f"a{suffix}"
    report = save_gaussians(path, gaussians)
    assert (report.num_written, report.num_dropped) == (n, 0)
    save_gaussians(tmp_path / f"again{suffix}", gaussians)
    assert path.read_bytes() == (tmp_path / f"again{suffix}").read_bytes()
    once = ss.load_scene(path)
    assert_same(once, gaussians, STEPS[suffix])
    save_gaussians(tmp_path / f"b{suffix}", once)
    assert_same(ss.load_scene(tmp_path / f"b{suffix}"), once, STEPS[suffix])


@pytest.mark.parametrize("suffix", BOTH_WAYS)
def test_values_at_the_ends_of_their_range_are_clipped(tmp_path, suffix):
    plain = scene_for()
    extreme = replace(
        plain,
        opacities=plain.opacities.at[:4].set(jnp.array([1.0, 2.0, 1.0 / 254.0, 1.0])),
        scales=plain.scales.at[:2].set(jnp.array([[0.0, 1e-30, 1.0], [1e30, 1.0, 1.0]])),
        quats=plain.quats.at[:4].set(jnp.array([[0.0, 0, 0, 0], [1e-30, 0, 0, 0], [1e30, 0, 0, 0], [0, 1e-10, 0, 0]])),
        means=plain.means.at[:4].set(jnp.array([[0.0, 0, 0], [11, 12, 13], [-15, 0, 0], [0, 0, 60]])),
        sh=plain.sh.at[2].set(50.0).at[3].set(-50.0),
    )
    save_gaussians(tmp_path / f"a{suffix}", extreme)
    found = ss.load_scene(tmp_path / f"a{suffix}")
    distances, places = KDTree(np.asarray(found.means)).query(np.asarray(extreme.means[:4]))
    np.testing.assert_allclose(distances, 0.0, atol=0.01)
    assert float(found.opacities.max()) >= 1 - 2e-6
    low, high = (-10, 255 / 16 - 10) if suffix == ".spz" else (-20, 20)
    logs = np.log(np.asarray(found.scales, np.float64))
    np.testing.assert_allclose([logs.min(), logs.max()], [low, high], rtol=1e-5)
    np.testing.assert_allclose(np.abs(np.asarray(found.quats))[places].max(axis=1), 1.0, atol=0.01)


@pytest.mark.parametrize("suffix", BOTH_WAYS)
def test_a_scene_carries_its_renderer_and_its_offset_where_the_format_can(tmp_path, suffix):
    offset = tuple(np.array([4.5e6, -0.1, 3.0]))  # numbers of NumPy, as a pose gives them
    for mode in ("mip", "default"):
        report = save_gaussians(tmp_path / f"a{suffix}", replace(scene_for(), render_mode=mode, offset=offset))
        found = ss.load_scene(tmp_path / f"a{suffix}")
        assert found.render_mode == mode
        assert found.offset == (offset if suffix in (".ply", ".glb") else (0.0, 0.0, 0.0))
        assert report.offset == offset and "[4500000.0, -0.1, 3.0]" in report.warning
        assert_same(found, scene_for(), STEPS[suffix])
        save_gaussians(tmp_path / f"b{suffix}", found)  # as it came, without a word about it
        again = ss.load_scene(tmp_path / f"b{suffix}")
        assert (again.render_mode, again.offset) == (found.render_mode, found.offset)


def test_a_loaded_scene_is_drawn_as_it_is_meant(tmp_path):
    """A scene of 3DGS with the dilation of 3DGS, at its offset; one of 2DGS only if a filter is chosen."""
    plain, offset = scene(1, n=20), (2000.0, -500.0, 30.0)
    view = camera()
    far = replace(view, viewmats=view.viewmats.at[:3, 3].add(-view.viewmats[:3, :3] @ jnp.array(offset)))
    draw = functools.partial(ss.render, max_pairs=1 << 12)
    classic, mip = (draw(plain, view, effects=ss.Effects(antialias=name)).color for name in ("classic", "mip"))
    assert np.abs(classic - mip).max() > 0.05
    for mode, wanted in (("default", classic), ("mip", mip)):
        for where, at in ((view, (0.0, 0.0, 0.0)), (far, offset)):
            ss.save_ply(tmp_path / "a.ply", replace(plain, render_mode=mode, offset=at))
            np.testing.assert_allclose(draw(ss.load_scene(tmp_path / "a.ply"), where).color, wanted, atol=2e-4)
    ss.save_ply(tmp_path / "a.ply", replace(plain, render_mode="2dgs"))
    discs = ss.load_scene(tmp_path / "a.ply")
    with pytest.raises(InputError, match="made for 2dgs"):
        ss.render(discs, view)
    same = changed_gaussians(discs, no_change(discs))  # as refinement changes it
    assert (same.render_mode, same.offset) == ("2dgs", (0.0, 0.0, 0.0))
    drawn = draw(same, view, effects=ss.Effects(antialias="classic")).color
    np.testing.assert_allclose(drawn, classic, atol=2e-4)


@pytest.mark.parametrize("suffix", SCENE_READERS)
def test_files_cut_off_or_damaged_are_refused(tmp_path, suffix):
    """Damage of all kinds, with its limits of time and memory, is in tests/fuzzing."""
    good, bad = tmp_path / f"a{suffix}", tmp_path / f"bad{suffix}"
    good.write_bytes(compressed_ply(n=12))
    if suffix in WRITERS:
        save_gaussians(good, scene_for(n=12))
    data, rng = good.read_bytes(), random.Random(1)
    damaged = [bytearray(data[:size]) for size in np.linspace(0, len(data) - 1, 20).astype(int)]
    for _ in range(10 if suffix in (".spz", ".sog") else 0):  # gzip and zip hold checksums
        damaged.append(bytearray(data))
        damaged[-1][rng.randrange(len(data) // 4, len(data) // 2)] ^= 1 << rng.randrange(8)
    for content in damaged:
        bad.write_bytes(content)
        with pytest.raises(InputError, match="bad"):
            ss.load_scene(bad)
    with pytest.raises(InputError, match="wanted a readable file"):
        ss.load_scene(tmp_path / f"missing{suffix}")


@pytest.mark.parametrize("terms", [0, 2, 3, 25])
def test_sh_of_no_degree_that_files_hold_is_refused(tmp_path, terms):
    spoiled = replace(scene(0, n=5), sh=jnp.zeros((5, terms, 3)))
    for suffix in WRITERS:
        with pytest.raises(InputError, match=f"1, 4, 9 or 16 terms for each Gaussian, got {terms}"):
            save_gaussians(tmp_path / f"a{suffix}", spoiled)
    with pytest.raises(InputError, match="render_mode"):
        ss.save_ply(tmp_path / "b.ply", replace(scene(0), render_mode="antialiased"))
    assert not any(tmp_path.iterdir())


# One Gaussian, byte by byte.

ONE = Gaussians.from_rgb(
    means=jnp.array([[1.0, -2.0, 3.0]]),
    quats=jnp.array([[0.5, 0.5, -0.5, 0.5]]),
    scales=jnp.array([[1.0, math.exp(-2.0), math.exp(1.0)]]),
    opacities=jnp.array([0.8]),
    colors=jnp.array([[1.0, 0.0, 0.2]]),
)


def test_bytes_of_a_spz(tmp_path):
    """Version 4, field by field, and version 3 with the same fields in one stream."""
    save_gaussians(str(tmp_path / "a.spz"), ONE)
    data = (tmp_path / "a.spz").read_bytes()
    assert data[:20] == b"NGSP" + struct.pack("<IIBBBBI", 4, 1, 0, 21, 1, 5, 32)  # 3 x 2^21 < 2^23 <= 3 x 2^22
    sizes, place, fields = struct.unpack_from("<10Q", data, 32), 32 + 80, []
    assert data[20:32] == bytes(12) and sizes[1::2] == (9, 1, 3, 3, 4)
    for size in sizes[::2]:
        fields.append(zstandard.ZstdDecompressor().decompress(data[place : place + size]))
        place += size
    assert place == len(data)
    assert fields[0] == b"".join(round(x * 2**21).to_bytes(3, "little", signed=True) for x in (1.0, 2.0, -3.0))
    dc = lambda color: round(255 * (0.5 + 0.15 * (color - 0.5) / SH_C0))  # noqa: E731
    assert list(b"".join(fields[1:4])) == [204, dc(1.0), dc(0.0), dc(0.2), 160, 128, 176]
    half = round(0.5 * 511 * math.sqrt(2))  # x = y = 0.5 and z = -0.5 in the file's axes; x is dropped
    assert int.from_bytes(fields[4], "little") == 0 << 30 | half << 20 | (1 << 9 | half) << 10 | half
    save_gaussians(tmp_path / "b.spz", ONE, spz_version=3)
    old = gzip.decompress((tmp_path / "b.spz").read_bytes())
    assert old == b"NGSP" + struct.pack("<IIBBBB", 3, 1, 0, 21, 1, 0) + b"".join(fields)
    with pytest.raises(InputError, match="version 3 or 4"):
        save_gaussians(tmp_path / "c.spz", ONE, spz_version=2)


@pytest.mark.skipif(shutil.which("splat-transform") is None, reason="npm install -g @playcanvas/splat-transform")
def test_spz_goes_to_and_from_playcanvas(tmp_path):
    gaussians, steps = scene_for(), STEPS[".spz"]
    convert = lambda *names: subprocess.run(["splat-transform", "-w", *names], check=True, cwd=tmp_path)  # noqa: E731
    ss.save_spz(tmp_path / "ours.spz", gaussians)
    convert("ours.spz", "back.ply")
    assert_same(ss.load_scene(tmp_path / "back.ply"), gaussians, steps)
    ss.save_ply(tmp_path / "ours.ply", gaussians)
    convert("ours.ply", "theirs.spz")  # with SH of 5 and 4 bits, and 12 bits after the point
    coarse = dataclasses.replace(steps, rest=1 / 16 + steps.rest, means=2.0**-12, constant=2 * steps.constant)
    assert_same(ss.load_scene(tmp_path / "theirs.spz"), gaussians, coarse)


@pytest.mark.parametrize("axes", ["RUB", "RDF", "LUF", "RUF", "LFD", "RBU"])
@pytest.mark.parametrize("version", [4, 3])
def test_the_axes_that_a_spz_names_are_honoured(tmp_path, axes, version):
    numbers = "LDB RDB LUB RUB LDF RDF LUF RUF LFD RFD LFU RFU LBD RBD LBU RBU".split()  # noqa: SIM905
    ss.save_spz(tmp_path / "a.spz", scene_for(), version=version)
    plain, data = ss.load_scene(tmp_path / "a.spz"), (tmp_path / "a.spz").read_bytes()
    records = struct.pack("<II3s", 0x12340001, 3, b"abc")  # of another maker: skipped
    records += struct.pack("<III", 0xADBE0003, 4, 1 + numbers.index(axes))
    if version == 4:
        header = data[:14] + struct.pack("<BBI", data[14] | 2, data[15], 32 + len(records)) + data[20:32]
        (tmp_path / "b.spz").write_bytes(header + records + data[32:])
    else:
        body = gzip.decompress(data)
        (tmp_path / "b.spz").write_bytes(gzip.compress(body[:14] + bytes([body[14] | 2]) + body[15:] + records))
    found = ss.load_scene(tmp_path / "b.spz")
    unit = {"R": [1, 0, 0], "L": [-1, 0, 0], "D": [0, 1, 0], "U": [0, -1, 0], "F": [0, 0, 1], "B": [0, 0, -1]}
    turn = np.array([unit[letter] for letter in axes]).T @ np.diag([1, -1, -1])  # from what was read as RUB
    np.testing.assert_allclose(found.means, np.asarray(plain.means) @ turn.T, atol=1e-6)
    assert_turned(found, plain, turn)


@pytest.mark.parametrize("size", [1e-6, 1e4])
def test_spz_refuses_sizes_that_it_cannot_hold(tmp_path, size):
    """A scene in another unit: its Gaussians would become up to hundreds of times as large."""
    small = replace(scene_for(), means=size * scene_for().means, scales=size * scene_for().scales)
    with pytest.raises(InputError, match=r"4.5e-05 to 3.8e\+02 units.*try a \.ply"):
        ss.save_spz(tmp_path / "a.spz", small)
    tiny = replace(small, scales=small.scales * size**4)  # beyond every format
    with pytest.raises(InputError, match=r"2.1e-09 to 4.9e\+08 units"):
        ss.save_ply(tmp_path / "a.ply", tiny)
    for suffix in (".ply", ".glb", ".sog"):
        save_gaussians(tmp_path / f"a{suffix}", small)
        found = ss.load_scene(tmp_path / f"a{suffix}")
        order = KDTree(np.asarray(found.means)).query(np.asarray(small.means))[1]
        np.testing.assert_allclose(np.asarray(found.scales)[order], small.scales, rtol=0.03)


def test_bytes_of_a_glb(tmp_path):
    save_gaussians(tmp_path / "a.glb", ONE)
    data = (tmp_path / "a.glb").read_bytes()
    magic, version, length, json_length, json_kind = struct.unpack("<4s3I4s", data[:20])
    assert (magic, version, length, json_kind) == (b"glTF", 2, len(data), b"JSON") and json_length % 4 == 0
    document, buffer = json.loads(data[20 : 20 + json_length]), data[28 + json_length :]
    assert data[20 + json_length : 28 + json_length] == struct.pack("<I4s", len(buffer), b"BIN\0")
    assert document["extensionsUsed"] == ["KHR_gaussian_splatting"]
    assert document["nodes"] == [{"mesh": 0, "rotation": [0, 0, 1, 0]}]  # upright: in glTF y points up
    (primitive,) = document["meshes"][0]["primitives"]
    extension = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
    assert primitive["mode"] == 0 and primitive["extensions"] == {"KHR_gaussian_splatting": extension}
    dc = [(color - 0.5) / SH_C0 for color in (1.0, 0.0, 0.2)]
    wanted = {"POSITION": [1, -2, 3], "ROTATION": [0.5, -0.5, 0.5, 0.5], "SCALE": [1, math.exp(-2), math.e]}
    wanted |= {"OPACITY": [0.8], "SH_DEGREE_0_COEF_0": dc, "COLOR_0": [1, 0, 0.2, 0.8]}
    assert [name.removeprefix("KHR_gaussian_splatting:") for name in primitive["attributes"]] == list(wanted)
    for place, numbers in zip(primitive["attributes"].values(), wanted.values(), strict=True):
        accessor = document["accessors"][place]
        kind = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}[len(numbers)]
        assert (accessor["componentType"], accessor["count"], accessor["type"]) == (5126, 1, kind)
        start = document["bufferViews"][accessor["bufferView"]]["byteOffset"]
        assert struct.unpack_from(f"<{len(numbers)}f", buffer, start) == pytest.approx(numbers, abs=1e-6)
    assert document["accessors"][0]["min"] == document["accessors"][0]["max"] == [1, -2, 3]


def test_images_of_a_sog(tmp_path):
    sh = np.arange(12, dtype=np.float32).reshape(1, 4, 3) / 10  # [term, channel]
    save_gaussians(tmp_path / "a.sog", replace(ONE, sh=jnp.asarray(sh), quats=jnp.array([[0.5, -0.5, -0.7, 0.1]])))
    with zipfile.ZipFile(tmp_path / "a.sog") as archive:
        meta = json.loads(archive.read("meta.json"))
        pixels = {
            name.removesuffix(".webp"): np.asarray(Image.open(io.BytesIO(archive.read(name))).convert("RGBA"))[0, :3]
            for name in archive.namelist()[1:]
        }
    assert (meta["version"], meta["count"], meta["antialias"], meta["shN"]["bands"]) == (2, 1, True, 1)
    assert meta["means"]["mins"] == pytest.approx([math.log(2), -math.log(3), math.log(4)])  # sign(p) ln(1 + |p|)
    assert [*pixels["means_u"][0][:3], *pixels["means_l"][0][:3]] == [0] * 6
    levels = [255 * (0.5 + q / math.sqrt(2)) for q in (-0.5, 0.5, -0.1)]  # without the largest, made positive
    assert pixels["quats"][0].tolist() == [*map(round, levels), 252 + 2]
    codes = lambda part, name: np.array(meta[part]["codebook"])[pixels[name][..., :3]]  # noqa: E731
    assert codes("scales", "scales")[0] == pytest.approx([0, -2, 1], abs=1e-6)
    assert codes("sh0", "sh0")[0] == pytest.approx(sh[0, 0]) and pixels["sh0"][0, 3] == 204
    assert pixels["shN_labels"][0].tolist() == [0, 0, 0, 255]  # low byte, high byte
    np.testing.assert_allclose(codes("shN", "shN_centroids"), sh[0, 1:], atol=1e-6)  # a pixel a term


def test_bytes_of_a_splat(tmp_path):
    save_gaussians(tmp_path / "a.splat", replace(ONE, quats=jnp.array([[2.0, 0.0, -2.0, 0.0]])))
    row = (tmp_path / "a.splat").read_bytes()
    assert struct.unpack("<6f", row[:24]) == pytest.approx((1, -2, 3, 1, math.exp(-2), math.exp(1)))
    assert list(row[24:]) == [255, 0, 51, 204, 219, 128, 37, 128]  # 128 +- 90.5, rounded to even


@pytest.mark.parametrize(("reach", "bits"), [(0.01, 23), (0.9999, 23), (1.0, 22), (2047.0, 12), (8e6, 0)])
def test_spz_positions_are_as_fine_as_24_bits_allow(tmp_path, reach, bits):
    ss.save_spz(tmp_path / "a.spz", replace(ONE, means=jnp.array([[0.0, -reach, reach / 3]], jnp.float32)))
    assert (tmp_path / "a.spz").read_bytes()[13] == bits
    held = np.asarray(ss.load_scene(tmp_path / "a.spz").means)[0]
    assert held == pytest.approx([0, -reach, reach / 3], abs=0.51 * 2.0**-bits)


def test_spz_of_version_2_holds_three_bytes_of_a_rotation(tmp_path):
    ss.save_spz(tmp_path / "a.spz", ONE, version=3)
    data = bytearray(gzip.decompress((tmp_path / "a.spz").read_bytes()))
    data[4:8], data[32:] = struct.pack("<I", 2), bytes([191, 64, 128])  # x y z of a quaternion with w >= 0
    (tmp_path / "b.spz").write_bytes(gzip.compress(bytes(data)))
    found = np.asarray(ss.load_scene(tmp_path / "b.spz").quats)[0]
    assert found == pytest.approx([math.sqrt(0.5), 0.5, 0.5, 0.0], abs=0.01)  # ours turned by 180 degrees about x


def test_a_palette_of_many_different_sh_is_fitted(tmp_path, monkeypatch):
    monkeypatch.setattr("ssplat_jax.scene_files.sog.MAX_PALETTE", 64)
    monkeypatch.setattr("ssplat_jax.scene_files.sog.FITTED_PALETTE", 16)
    centers = np.random.default_rng(0).normal(size=(16, 3, 3)) * 0.3
    noise = np.random.default_rng(1).normal(size=(300, 3, 3)) * 1e-3
    near = scene(1).sh[:1].repeat(300, 0).at[:, 1:].set(centers[np.arange(300) * 7 % 16] + noise)
    save_gaussians(tmp_path / "a.sog", replace(scene(1, n=300), sh=near))
    found, wanted = ss.load_scene(tmp_path / "a.sog"), scene(1, n=300)
    order = KDTree(np.asarray(found.means)).query(np.asarray(wanted.means))[1]
    errors = np.abs(np.asarray(found.sh)[order] - near).max(axis=(1, 2))
    assert np.median(errors) < 0.02 and len(np.unique(np.asarray(found.sh[:, 1:]), axis=0)) <= 16


def test_a_format_that_is_not_written_is_refused_before_a_scene_is_read(tmp_path, capsys):
    assert run("export", str(tmp_path / "missing"), "--to", str(tmp_path / "scene.gltf")) == 2
    assert "*.ply, *.spz" in capsys.readouterr().err
