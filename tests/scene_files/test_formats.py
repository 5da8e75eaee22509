"""Every format: written, read back and drawn; readers of other people's making get the same scene."""

import io
import itertools
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
from PIL import Image

import ssplat_jax as ss
from ssplat_jax.core.errors import InputError
from ssplat_jax.core.gaussians import SH_C0, Gaussians
from ssplat_jax.core.pytree import replace
from ssplat_jax.rasterizer import render
from ssplat_jax.scene_files.compressed_ply import is_compressed_ply
from ssplat_jax.scene_files.formats import FORMATS, read_scene, save_gaussians
from ssplat_jax.scene_files.ply import save_ply
from tests.commands.test_cli import run
from tests.scene_files.scene_fixture import camera, decibels, scene
from tests.scene_files.test_compressed_ply import independent_gaussians as of_compressed_ply
from tests.scene_files.test_ply import independent_gaussians as of_ply

FIELDS = ("means", "quats", "scales", "opacities", "sh")
EXACT = (".ply", ".glb", ".gltf")
EXACT_DB, QUANTIZED_DB = 60.0, 35.0
NUM_MUTANTS = 100  # for each format; seeded, so that failures can be repeated
VIEWS = (camera(), camera(0.4))


def least_db(suffix: str) -> float:
    return EXACT_DB if suffix in EXACT else QUANTIZED_DB


def scene_for(suffix: str, n: int = 300) -> Gaussians:
    """Turned, stretched Gaussians, with all SH bands that the format holds."""
    if suffix != ".splat":
        return scene(3, n=n)
    gaussians = scene(0, n=n)
    return replace(gaussians, sh=(jnp.clip(0.5 + SH_C0 * gaussians.sh, 0, 1) - 0.5) / SH_C0)


def assert_draws(found: Gaussians, wanted: Gaussians, least: float):
    for view in VIEWS:
        drawn = render(wanted, view).color
        assert float(drawn.std()) > 0.05  # the image shows the scene
        assert decibels(drawn, render(found, view).color) >= least


@pytest.mark.parametrize("suffix", FORMATS)
def test_what_is_written_is_read_and_drawn(tmp_path, suffix):
    gaussians, path = scene_for(suffix), tmp_path / f"a{suffix}"
    report = save_gaussians(path, gaussians)
    assert (report.num_written, report.num_dropped) == (300, 0)
    found = ss.load_scene(path)
    assert found.num_gaussians == 300 and found.sh_degree == gaussians.sh_degree
    assert_draws(found, gaussians, least_db(suffix))


@pytest.mark.parametrize("suffix", FORMATS)
def test_a_scene_read_and_written_again_stays_as_it_is(tmp_path, suffix):
    save_gaussians(tmp_path / f"a{suffix}", scene_for(suffix))
    once = ss.load_scene(tmp_path / f"a{suffix}")
    save_gaussians(tmp_path / f"b{suffix}", once)
    assert_draws(ss.load_scene(tmp_path / f"b{suffix}"), once, EXACT_DB if suffix in EXACT else 45.0)


@pytest.mark.parametrize("suffix", FORMATS)
@pytest.mark.parametrize("n", [0, 1])
def test_scenes_of_no_or_one_gaussian_are_held(tmp_path, suffix, n):
    path = tmp_path / f"a{suffix}"
    save_gaussians(path, scene_for(suffix, n=n))
    found = ss.load_scene(path)
    assert found.num_gaussians == n
    if n:
        np.testing.assert_allclose(found.means, scene_for(suffix, n=1).means, atol=1e-3)
        np.testing.assert_allclose(found.scales, scene_for(suffix, n=1).scales, rtol=0.04)


@pytest.mark.parametrize("suffix", FORMATS)
def test_hidden_rows_are_dropped_and_bytes_repeat(tmp_path, suffix):
    gaussians = scene_for(suffix, n=20)
    gaussians = replace(
        gaussians, opacities=gaussians.opacities.at[3].set(0.0), means=gaussians.means.at[5].set(jnp.nan)
    )
    reports = [save_gaussians(tmp_path / f"{name}{suffix}", gaussians) for name in "ab"]
    assert [(r.num_written, r.num_dropped) for r in reports] == [(18, 2)] * 2
    assert (tmp_path / f"a{suffix}").read_bytes() == (tmp_path / f"b{suffix}").read_bytes()
    assert ss.load_scene(tmp_path / f"a{suffix}").num_gaussians == 18


@pytest.mark.parametrize("suffix", FORMATS)
def test_the_renderer_of_a_scene_is_told_where_the_format_can(tmp_path, suffix):
    save_gaussians(tmp_path / f"a{suffix}", scene_for(suffix))
    assert read_scene(tmp_path / f"a{suffix}").render_mode == ("default" if suffix == ".splat" else "mip")
    save_gaussians(tmp_path / f"b{suffix}", scene_for(suffix), render_mode="default")
    assert read_scene(tmp_path / f"b{suffix}").render_mode == "default"


@pytest.mark.parametrize("suffix", [".ply", ".compressed.ply", ".glb", ".gltf"])
def test_the_offset_of_a_far_scene_is_kept(tmp_path, suffix):
    offset = tuple(np.array([4.5e6, -0.1, 3.0]))  # numbers of NumPy, as a pose gives them
    report = save_gaussians(tmp_path / f"a{suffix}", scene_for(suffix), offset=offset)
    found = read_scene(tmp_path / f"a{suffix}")
    assert report.offset == found.offset == (4.5e6, -0.1, 3.0)
    assert "[4500000.0, -0.1, 3.0]" in report.warning
    assert_draws(found.gaussians, scene_for(suffix), least_db(suffix))


@pytest.mark.parametrize("suffix", FORMATS)
def test_files_cut_off_or_damaged_are_refused_or_finite(tmp_path, suffix):
    good, bad = tmp_path / f"a{suffix}", tmp_path / f"bad{suffix}"
    save_gaussians(good, scene_for(suffix, n=12))
    data, rng, num_refused = good.read_bytes(), random.Random(1), 0
    for _ in range(NUM_MUTANTS):
        mutant = bytearray(data[: rng.randrange(len(data))] if rng.random() < 0.3 else data)
        for _ in range(rng.randrange(1, 4) if mutant else 0):
            # Half of the changes are near the beginning, where headers are.
            mutant[rng.randrange(len(mutant) if rng.random() < 0.5 else min(200, len(mutant)))] = rng.randrange(256)
        bad.write_bytes(mutant)
        try:
            found = ss.load_scene(bad)
        except InputError as error:
            num_refused += 1
            assert "bad" in str(error) and "\n" not in str(error) and len(str(error)) < 700
        else:
            assert all(np.isfinite(np.asarray(getattr(found, name))).all() for name in FIELDS)
    assert num_refused > 0


@pytest.mark.parametrize("suffix", FORMATS)
def test_a_file_of_another_format_is_refused(tmp_path, suffix):
    Image.fromarray(np.zeros((5, 5, 3), np.uint8)).save(tmp_path / "image.png")
    (tmp_path / f"a{suffix}").write_bytes((tmp_path / "image.png").read_bytes())
    with pytest.raises(InputError):
        ss.load_scene(tmp_path / f"a{suffix}")
    with pytest.raises(InputError, match="cannot be read"):
        ss.load_scene(tmp_path / f"missing{suffix}")


def test_a_flipped_bit_of_a_checked_format_is_refused(tmp_path):
    rng = random.Random(0)
    for suffix in (".spz", ".sog"):  # gzip and zip hold checksums
        path = tmp_path / f"a{suffix}"
        save_gaussians(path, scene_for(suffix))
        data = path.read_bytes()
        for _ in range(20):
            mutant = bytearray(data)
            mutant[rng.randrange(len(data) // 4, len(data) // 2)] ^= 1 << rng.randrange(8)
            path.write_bytes(mutant)
            with pytest.raises(InputError):
                ss.load_scene(path)


def test_a_compressed_scene_is_known_by_its_header(tmp_path):
    save_gaussians(tmp_path / "a.compressed.ply", scene(2))
    (tmp_path / "plain_name.ply").write_bytes((tmp_path / "a.compressed.ply").read_bytes())
    np.testing.assert_array_equal(
        ss.load_scene(tmp_path / "plain_name.ply").means, ss.load_scene(tmp_path / "a.compressed.ply").means
    )


def test_any_format_is_exported_from_any_other(tmp_path, capsys):
    gaussians = scene_for(".splat", n=100)
    save_ply(tmp_path / "0.ply", gaussians)
    names = ["0.ply", "1.spz", "2.sog", "3.glb", "4.compressed.ply", "5.gltf", "6.splat", "7.ply"]
    for source, to in itertools.pairwise(names):
        assert run("export", str(tmp_path / source), "--to", str(tmp_path / to)) == 0
        assert "100 Gaussians" in capsys.readouterr().out
    # Readers go by the header, so an ordinary file of that name would be read too.
    assert [name for name in names if is_compressed_ply(tmp_path / name)] == ["4.compressed.ply"]
    assert_draws(ss.load_scene(tmp_path / "7.ply"), gaussians, 30.0)  # the losses of four formats add up


# Decoders written after the descriptions of the formats, one Gaussian at a time.


def of_glb(path) -> Gaussians:
    """Gaussians of a .glb in the axes of the file's node."""
    data = path.read_bytes()
    magic, version, length, json_length, json_kind = struct.unpack("<4sII I4s", data[:20])
    assert (magic, version, length, json_kind) == (b"glTF", 2, len(data), b"JSON") and json_length % 4 == 0
    document, buffer = json.loads(data[20 : 20 + json_length]), data[28 + json_length :]
    size, kind = struct.unpack_from("<I4s", data, 20 + json_length)
    assert kind == b"BIN\0" and size == len(buffer) and document["extensionsUsed"] == ["KHR_gaussian_splatting"]
    assert document["nodes"][0]["rotation"] == [0, 0, 1, 0]
    (primitive,) = document["meshes"][0]["primitives"]
    assert primitive["mode"] == 0
    assert primitive["extensions"]["KHR_gaussian_splatting"] == {
        "kernel": "ellipse",
        "colorSpace": "srgb_rec709_display",
    }
    attributes = {}
    for name, place in primitive["attributes"].items():
        accessor = document["accessors"][place]
        view = document["bufferViews"][accessor["bufferView"]]
        columns = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]]
        assert accessor["componentType"] == 5126 and view["byteOffset"] % 4 == 0
        assert view["byteLength"] == 4 * columns * accessor["count"]
        numbers = struct.unpack_from(f"<{columns * accessor['count']}f", buffer, view["byteOffset"])
        attributes[name.removeprefix("KHR_gaussian_splatting:")] = np.reshape(numbers, (-1, columns))
    accessor = document["accessors"][primitive["attributes"]["POSITION"]]
    assert accessor["min"] == attributes["POSITION"].min(axis=0).tolist()
    assert accessor["max"] == attributes["POSITION"].max(axis=0).tolist()
    bands = [f"SH_DEGREE_{band}_COEF_{term}" for band in range(4) for term in range(2 * band + 1)]
    return Gaussians(
        means=jnp.asarray(attributes["POSITION"], jnp.float32),
        quats=jnp.asarray(np.roll(attributes["ROTATION"], 1, axis=1), jnp.float32),
        scales=jnp.asarray(attributes["SCALE"], jnp.float32),
        opacities=jnp.asarray(attributes["OPACITY"][:, 0], jnp.float32),
        sh=jnp.asarray(np.stack([attributes[name] for name in bands if name in attributes], axis=1), jnp.float32),
    )


def of_sog(path) -> Gaussians:
    with zipfile.ZipFile(path) as archive:
        meta = json.loads(archive.read("meta.json"))
        assert meta["version"] == 2
        pixels = {
            name: np.asarray(Image.open(io.BytesIO(archive.read(name))).convert("RGBA")).astype(int)
            for name in archive.namelist()
            if name.endswith(".webp")
        }
    of = lambda name, i: pixels[name][i // pixels[name].shape[1], i % pixels[name].shape[1]].tolist()  # noqa: E731
    rows = []
    for i in range(meta["count"]):
        low, high = of(meta["means"]["files"][0], i), of(meta["means"]["files"][1], i)
        mean = []
        for axis in range(3):
            span = meta["means"]["maxs"][axis] - meta["means"]["mins"][axis]
            log = meta["means"]["mins"][axis] + span * (high[axis] * 256 + low[axis]) / 65535
            mean.append(math.copysign(math.exp(abs(log)) - 1, log))
        *three, alpha = of("quats.webp", i)
        quat = [(level / 255 - 0.5) * math.sqrt(2) for level in three]
        quat.insert(alpha - 252, math.sqrt(max(0.0, 1 - sum(x * x for x in quat))))
        scales = [math.exp(meta["scales"]["codebook"][index]) for index in of("scales.webp", i)[:3]]
        *color, opacity = of("sh0.webp", i)
        sh = [[meta["sh0"]["codebook"][index] for index in color]]
        if "shN" in meta:
            terms = {1: 3, 2: 8, 3: 15}[meta["shN"]["bands"]]
            label = of("shN_labels.webp", i)
            entry = label[0] + 256 * label[1]
            row = pixels["shN_centroids.webp"][entry // 64]
            for term in range(terms):
                sh.append([meta["shN"]["codebook"][row[entry % 64 * terms + term][c]] for c in range(3)])
        rows.append((mean, quat, scales, opacity / 255, sh))
    columns = zip(*rows, strict=True)
    return Gaussians(**{name: jnp.asarray(x, jnp.float32) for name, x in zip(FIELDS, columns, strict=True)})


@pytest.mark.parametrize(("suffix", "decode"), [(".glb", of_glb), (".sog", of_sog)])
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_a_plain_decoder_gets_what_our_reader_gets(tmp_path, suffix, decode, degree):
    gaussians, path = scene(degree, n=200), tmp_path / f"a{suffix}"
    save_gaussians(path, gaussians)
    found = decode(path)
    assert_draws(found, gaussians, least_db(suffix))  # the axes of the node of a .glb are those of the scene
    assert_draws(ss.load_scene(path), found, 80.0)


@pytest.fixture
def splat_transform(tmp_path):
    """Converts a scene file with PlayCanvas's splat-transform."""
    program = shutil.which("splat-transform")
    if program is None:
        pytest.skip("no splat-transform on the PATH: npm install -g @playcanvas/splat-transform")

    def convert(source, name):
        to = tmp_path / name
        subprocess.run([program, "-q", "-w", "-g", "cpu", str(source), str(to)], check=True, capture_output=True)
        return to

    return convert


@pytest.mark.slow  # starts Node
@pytest.mark.parametrize("suffix", [".compressed.ply", ".ply", ".spz", ".sog", ".splat"])
def test_splat_transform_reads_what_we_write(tmp_path, splat_transform, suffix):
    gaussians = scene_for(suffix, n=1000)
    save_gaussians(tmp_path / f"a{suffix}", gaussians)
    assert_draws(of_ply(splat_transform(tmp_path / f"a{suffix}", "theirs.ply")), gaussians, least_db(suffix))


@pytest.mark.slow  # starts Node
@pytest.mark.parametrize("suffix", [".compressed.ply", ".ply", ".sog", ".glb"])
def test_we_read_what_splat_transform_writes(tmp_path, splat_transform, suffix):
    gaussians = scene_for(suffix, n=1000)
    save_ply(tmp_path / "a.ply", gaussians)
    theirs = splat_transform(tmp_path / "a.ply", f"theirs{suffix}")
    # It reads no .glb itself. Its palette for a .sog is too small for random SH, which is no matter of reading.
    wanted = gaussians if suffix == ".glb" else of_ply(splat_transform(theirs, "back.ply"))
    assert_draws(ss.load_scene(theirs), wanted, EXACT_DB)


def test_a_compressed_file_and_its_plain_decoder_agree(tmp_path):
    save_gaussians(tmp_path / "a.compressed.ply", scene(3, n=100))
    assert_draws(ss.load_scene(tmp_path / "a.compressed.ply"), of_compressed_ply(tmp_path / "a.compressed.ply"), 100.0)


@pytest.mark.parametrize("suffix", FORMATS)
@pytest.mark.parametrize("terms", [0, 2, 3, 25])
def test_sh_of_no_degree_that_files_hold_is_refused(tmp_path, suffix, terms):
    spoiled = replace(scene(0, n=5), sh=jnp.zeros((5, terms, 3)))
    with pytest.raises(InputError, match=f"1, 4, 9 or 16 terms for each Gaussian, got {terms}"):
        save_gaussians(tmp_path / f"a{suffix}", spoiled)
    assert not any(tmp_path.iterdir())


def test_a_sog_file_with_a_huge_image_or_number_is_refused(tmp_path, monkeypatch):
    save_gaussians(tmp_path / "a.sog", scene(0, n=5))
    with zipfile.ZipFile(tmp_path / "a.sog") as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    meta = json.loads(files["meta.json"])
    meta["means"]["mins"][0] = 10**400
    with zipfile.ZipFile(tmp_path / "b.sog", "w") as archive:
        for name, data in (files | {"meta.json": json.dumps(meta).encode()}).items():
            archive.writestr(name, data)
    with pytest.raises(InputError, match=r"b\.sog: cannot use"):
        read_scene(tmp_path / "b.sog")
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 1)  # as if the small images were beyond PIL's limit
    with pytest.raises(InputError, match=r"a\.sog: cannot use"):
        read_scene(tmp_path / "a.sog")
