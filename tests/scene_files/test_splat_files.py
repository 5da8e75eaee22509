""".spz and .splat files: decoders written after the descriptions of the formats get the scene that was written."""

import gzip
import math
import struct

import jax.numpy as jnp
import numpy as np
import pytest

from ssplat_jax.core.errors import InputError
from ssplat_jax.core.gaussians import SH_C0, Gaussians
from ssplat_jax.core.pytree import replace
from ssplat_jax.rasterizer import render
from ssplat_jax.rasterizer.outputs import sh_basis
from ssplat_jax.scene_files.ply import load_ply, save_ply
from ssplat_jax.scene_files.splat import save_splat
from ssplat_jax.scene_files.spz import save_spz
from tests.commands.test_cli import run
from tests.scene_files.scene_fixture import camera, decibels, scene

RENDER_DB = 35.0  # 8 bits: errors of 1/510 in color, 3 % in size, half a degree in orientation
AXES = np.diag([1.0, -1.0, -1.0, 1.0])  # axes of .spz: x right, y up, z backward


def read_spz(path) -> tuple[Gaussians, dict]:
    """Decodes a .spz file; Gaussians are in the axes of the file."""
    data = gzip.decompress(path.read_bytes())
    magic, version, n, degree, bits, flags, reserved = struct.unpack("<IIIBBBB", data[:16])
    assert (magic, version, reserved) == (0x5053474E, 3, 0)
    k, at = (degree + 1) ** 2 - 1, 16
    fields = {}
    for name, size in (("means", 9), ("alphas", 1), ("colors", 3), ("scales", 3), ("quats", 4), ("sh", 3 * k)):
        fields[name] = [data[at + i * size : at + (i + 1) * size] for i in range(n)]
        at += n * size
    assert at == len(data)
    means = [
        [int.from_bytes(row[3 * a : 3 * a + 3], "little", signed=True) / 2**bits for a in range(3)]
        for row in fields["means"]
    ]
    sh = np.zeros((n, k + 1, 3))
    for i in range(n):
        sh[i, 0] = [(byte / 255 - 0.5) / 0.15 for byte in fields["colors"][i]]
        for term in range(k):
            sh[i, 1 + term] = [(byte - 128) / 128 for byte in fields["sh"][i][3 * term : 3 * term + 3]]
    as_array = lambda x, *shape: jnp.asarray(np.reshape(x, (n, *shape)), jnp.float32)  # noqa: E731
    gaussians = Gaussians(
        means=as_array(means, 3),
        quats=as_array([smallest_three(int.from_bytes(row, "little")) for row in fields["quats"]], 4),
        scales=as_array([[math.exp(byte / 16 - 10) for byte in row] for row in fields["scales"]], 3),
        opacities=as_array([row[0] / 255 for row in fields["alphas"]]),
        sh=as_array(sh, k + 1, 3),
    )
    return gaussians, {"flags": flags, "fractional_bits": bits}


def smallest_three(word: int) -> list[float]:
    """Quaternion wxyz of 32 bits: two bits for the omitted entry of xyzw, then ten for each of the others."""
    xyzw, largest = [0.0] * 4, word >> 30
    for entry in (3, 2, 1, 0):
        if entry != largest:
            xyzw[entry] = (word & 511) / 511 / math.sqrt(2) * (-1 if word >> 9 & 1 else 1)
            word >>= 10
    xyzw[largest] = math.sqrt(1 - sum(x * x for x in xyzw))
    return [xyzw[3], *xyzw[:3]]


def read_splat(path) -> Gaussians:
    """Decodes a .splat file, 32 bytes per Gaussian."""
    rows = [struct.unpack("<6f8B", row) for row in batched(path.read_bytes(), 32)]
    columns = np.array(rows, np.float64).reshape(-1, 14)
    return Gaussians.from_rgb(
        means=jnp.asarray(columns[:, :3], jnp.float32),
        scales=jnp.asarray(columns[:, 3:6], jnp.float32),
        colors=jnp.asarray(columns[:, 6:9] / 255, jnp.float32),
        opacities=jnp.asarray(columns[:, 9] / 255, jnp.float32),
        quats=jnp.asarray((columns[:, 10:] - 128) / 128, jnp.float32),
    )


def batched(data: bytes, size: int) -> list[bytes]:
    return [data[i : i + size] for i in range(0, len(data), size)]


def one(**changes) -> Gaussians:
    fields = {
        "means": jnp.array([[1.0, -2.0, 3.0]]),
        "quats": jnp.array([[0.5, 0.5, -0.5, 0.5]]),
        "scales": jnp.array([[1.0, math.exp(-2.0), math.exp(1.0)]]),
        "opacities": jnp.array([0.8]),
        "colors": jnp.array([[1.0, 0.0, 0.2]]),
    }
    return replace(Gaussians.from_rgb(**fields), **changes)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_a_spz_file_draws_the_scene(tmp_path, degree):
    # A camera in the axes of the file sees the same image, which checks the signs of all terms.
    gaussians = scene(degree)
    save_spz(tmp_path / "a.spz", gaussians)
    held, header = read_spz(tmp_path / "a.spz")
    assert header["flags"] == 1  # made for the Mip filter
    for view in (camera(), camera(0.4)):
        turned = replace(view, viewmats=view.viewmats @ jnp.asarray(AXES, jnp.float32))
        drawn = render(gaussians, view).color
        assert float(drawn.std()) > 0.05
        assert decibels(drawn, render(held, turned).color) >= RENDER_DB


def test_spz_colors_agree_in_corresponding_directions(tmp_path):
    # One term at a time, since an image hardly shows terms that vanish along the optical axis.
    terms, n = 16, 15
    sh = np.zeros((n, terms, 3))
    sh[np.arange(n), 1 + np.arange(n)] = 0.5
    gaussians = replace(scene(3, n=n), sh=jnp.asarray(sh, jnp.float32))
    save_spz(tmp_path / "a.spz", gaussians)
    held, _ = read_spz(tmp_path / "a.spz")
    directions = np.random.default_rng(0).normal(size=(40, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    ours, theirs = (sh_basis(jnp.asarray(d, jnp.float32), 3)[:, 1:] for d in (directions, directions @ AXES[:3, :3]))
    assert np.abs(ours @ gaussians.sh[:, 1:, 0].T - theirs @ held.sh[:, 1:, 0].T).max() < 1e-5


def test_spz_values_are_off_by_half_a_step_at_most(tmp_path):
    gaussians = scene(3, n=500)
    save_spz(tmp_path / "a.spz", gaussians)
    held, header = read_spz(tmp_path / "a.spz")
    assert header["fractional_bits"] == 21  # the largest coordinate is nearly 4 = 2^23 / 2^21
    off = lambda name: np.abs(np.asarray(getattr(held, name), np.float64) - np.asarray(getattr(gaussians, name)))  # noqa: E731
    means = np.asarray(held.means, np.float64) * [1, -1, -1]
    assert np.abs(means - gaussians.means).max() <= 0.51 * 2.0**-21
    assert off("opacities").max() <= 0.501 / 255
    assert off("sh")[:, 0].max() <= 0.501 / 255 / 0.15
    assert np.abs(np.log(np.asarray(held.scales) / gaussians.scales)).max() <= 0.501 / 16
    quats = np.asarray(gaussians.quats, np.float64) * [1, 1, -1, -1]
    cosines = np.abs(np.sum(quats * np.asarray(held.quats, np.float64), axis=1)) / np.linalg.norm(quats, axis=1)
    assert np.degrees(2 * np.arccos(np.minimum(cosines, 1))).max() <= 0.4


def test_spz_bytes_of_one_gaussian(tmp_path):
    save_spz(tmp_path / "a.spz", one())
    data = gzip.decompress((tmp_path / "a.spz").read_bytes())
    assert data[:16] == b"NGSP" + struct.pack("<IIBBBB", 3, 1, 0, 21, 1, 0)  # 3 x 2^21 < 2^23 <= 3 x 2^22
    fixed = b"".join(round(x * 2**21).to_bytes(3, "little", signed=True) for x in (1.0, 2.0, -3.0))
    assert data[16:25] == fixed
    assert data[25] == 204
    dc = lambda color: round(255 * (0.5 + 0.15 * (color - 0.5) / SH_C0))  # noqa: E731
    assert list(data[26:29]) == [dc(1.0), dc(0.0), dc(0.2)]
    assert list(data[29:32]) == [160, 128, 176]
    assert smallest_three(int.from_bytes(data[32:36], "little")) == pytest.approx([0.5, 0.5, 0.5, -0.5], abs=2e-3)
    assert len(data) == 36


@pytest.mark.parametrize(("reach", "bits"), [(0.01, 23), (0.9999, 23), (1.0, 22), (2047.0, 12), (8e6, 0)])
def test_spz_positions_are_as_fine_as_24_bits_allow(tmp_path, reach, bits):
    save_spz(tmp_path / "a.spz", one(means=jnp.array([[0.0, -reach, reach / 3]], jnp.float32)))
    held, header = read_spz(tmp_path / "a.spz")
    assert header["fractional_bits"] == bits
    assert np.asarray(held.means)[0] == pytest.approx([0, reach, -reach / 3], abs=0.51 * 2.0**-bits)


def test_spz_positions_of_a_tiny_scene_are_off_by_half_a_step(tmp_path):
    means = np.random.default_rng(0).uniform(-5e-4, 5e-4, (500, 3)).astype(np.float32)
    save_spz(tmp_path / "a.spz", replace(scene(n=500), means=jnp.asarray(means)))
    held, _ = read_spz(tmp_path / "a.spz")
    error = np.abs(np.asarray(held.means, np.float64) * [1, -1, -1] - means).max()
    assert 2.0**-23 * np.abs(means).max() < error <= 2.0**-24  # more than the share of larger scenes


def test_spz_refuses_what_its_positions_cannot_hold(tmp_path):
    with pytest.raises(InputError, match=r"8388607 units.*write a \.ply"):
        save_spz(tmp_path / "a.spz", one(means=jnp.array([[0.0, 0.0, 9e6]])))
    assert list(tmp_path.iterdir()) == []


def test_values_beyond_a_byte_are_clipped_not_wrapped(tmp_path):
    extreme = one(scales=jnp.array([[1e-9, 1e6, 0.0]]), opacities=jnp.array([1.0]), sh=jnp.array([[[9.0, -9.0, 0.0]]]))
    save_spz(tmp_path / "a.spz", extreme)
    held, _ = read_spz(tmp_path / "a.spz")
    assert np.asarray(held.scales)[0] == pytest.approx([math.exp(-10), math.exp(255 / 16 - 10), math.exp(-10)])
    assert float(held.opacities[0]) == 1.0
    assert np.asarray(held.sh)[0, 0] == pytest.approx([1 / 0.3, -1 / 0.3, 0], abs=0.02)
    save_splat(tmp_path / "a.splat", extreme)
    assert (tmp_path / "a.splat").read_bytes()[24:28] == bytes([255, 0, 128, 255])


def test_a_splat_file_draws_the_scene(tmp_path):
    gaussians = scene(degree=0)
    colors = jnp.clip(0.5 + SH_C0 * gaussians.sh[:, 0], 0, 1)
    gaussians = replace(gaussians, sh=((colors - 0.5) / SH_C0)[:, None])
    save_splat(tmp_path / "a.splat", gaussians)
    for view in (camera(), camera(0.4)):
        drawn, read = (render(g, view).color for g in (gaussians, read_splat(tmp_path / "a.splat")))
        assert float(drawn.std()) > 0.05
        assert decibels(drawn, read) >= RENDER_DB


def test_splat_rows_are_sorted_by_coverage(tmp_path):
    gaussians = scene(n=200)
    save_splat(tmp_path / "a.splat", gaussians)
    held = read_splat(tmp_path / "a.splat")
    cover = np.prod(np.asarray(held.scales, np.float64), axis=1) * np.asarray(held.opacities)
    assert np.all(cover[1:] <= cover[:-1] * 1.05)  # opacities are rounded
    volumes = np.sort(np.prod(np.asarray(gaussians.scales, np.float64), axis=1))
    assert np.sort(np.prod(np.asarray(held.scales, np.float64), axis=1)) == pytest.approx(volumes, rel=1e-5)


def test_splat_bytes_of_one_gaussian(tmp_path):
    save_splat(tmp_path / "a.splat", one(quats=jnp.array([[2.0, 0.0, -2.0, 0.0]])))
    row = (tmp_path / "a.splat").read_bytes()
    assert struct.unpack("<6f", row[:24]) == pytest.approx((1, -2, 3, 1, math.exp(-2), math.exp(1)))
    assert list(row[24:]) == [255, 0, 51, 204, 219, 128, 37, 128]  # 128 +- 90.5, rounded to even


@pytest.mark.parametrize("save", [save_splat, save_spz])
def test_dropped_rows_are_counted_and_files_are_deterministic(tmp_path, save):
    gaussians = scene(degree=1, n=10)
    gaussians = replace(
        gaussians,
        opacities=gaussians.opacities.at[2].set(0.0),
        means=gaussians.means.at[5, 1].set(jnp.nan),
        quats=gaussians.quats.at[7].set(0.0),
    )
    reports = [save(tmp_path / name, gaussians) for name in ("a", "b")]
    assert [(r.num_written, r.num_dropped) for r in reports] == [(8, 2)] * 2
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


@pytest.mark.parametrize("degree", [0, 3])
def test_empty_scenes_are_written(tmp_path, degree):
    nothing = replace(scene(degree), opacities=jnp.zeros(60))
    assert save_splat(tmp_path / "a.splat", nothing).num_written == 0
    assert (tmp_path / "a.splat").read_bytes() == b""
    save_spz(tmp_path / "a.spz", nothing)
    assert read_spz(tmp_path / "a.spz")[0].num_gaussians == 0


def test_export_converts_a_ply(tmp_path, capsys):
    gaussians = scene(degree=2)
    ply = tmp_path / "scene.ply"
    for mode, flags in (("mip", 1), ("default", 0)):
        save_ply(ply, gaussians, render_mode=mode, offset=(0.0, 0.0, 1e7))
        for name in ("to.spz", "to.splat", "to.ply"):
            assert run("export", str(ply), "--to", str(tmp_path / name)) == 0
            said = capsys.readouterr()
            assert "60 Gaussians" in said.out
            assert "positions are counted from [0.0, 0.0, 10000000.0]" in " ".join(said.err.split())
        assert read_spz(tmp_path / "to.spz")[1]["flags"] == flags
        assert (tmp_path / "to.ply").read_bytes() == ply.read_bytes()
        means = np.asarray(read_spz(tmp_path / "to.spz")[0].means) * [1, -1, -1]
        assert np.abs(means - load_ply(ply).means).max() < 1e-5


@pytest.mark.parametrize("name", ["scene.txt", "scene", "scene.PLY"])
def test_unknown_extensions_are_refused_before_reading(tmp_path, capsys, name):
    assert run("export", str(tmp_path / "missing"), "--to", str(tmp_path / name)) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "*.compressed.ply, *.ply, *.spz" in line and name in line
    assert list(tmp_path.iterdir()) == []
