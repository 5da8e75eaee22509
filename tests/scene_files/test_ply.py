"""PLY files: an independent reader gets the scene that was written."""

import os

import jax.numpy as jnp
import numpy as np
import pytest
from plyfile import PlyData

from ssplat_jax.core.errors import InputError, StorageError
from ssplat_jax.core.gaussians import SH_C0, Gaussians
from ssplat_jax.core.pytree import replace
from ssplat_jax.rasterizer import render
from ssplat_jax.scene_files.ply import load_ply, property_names, save_ply
from tests.scene_files.scene_fixture import ROUND_TRIP, camera, decibels, scene

RENDER_DB = 60.0  # root mean square of 0.001, far below a step of 8 bits


def independent_gaussians(path) -> Gaussians:
    """Gaussians of a file, read with plyfile and the formulas of the format."""
    v = PlyData.read(str(path))["vertex"].data
    stack = lambda *names: np.stack([v[name].astype(np.float64) for name in names], -1)  # noqa: E731
    rest = [name for name in v.dtype.names if name.startswith("f_rest_")]
    k = len(rest) // 3
    sh = np.stack(
        [stack(f"f_dc_{c}", *(f"f_rest_{c * k + i}" for i in range(k))) for c in range(3)], axis=-1
    )  # the k coefficients of red, then of green, then of blue
    return Gaussians(
        means=jnp.asarray(stack("x", "y", "z"), jnp.float32),
        quats=jnp.asarray(stack("rot_0", "rot_1", "rot_2", "rot_3"), jnp.float32),
        scales=jnp.asarray(np.exp(stack("scale_0", "scale_1", "scale_2")), jnp.float32),
        opacities=jnp.asarray(1 / (1 + np.exp(-stack("opacity")[:, 0])), jnp.float32),
        sh=jnp.asarray(sh, jnp.float32),
    )


def test_export_roundtrip_render(tmp_path):
    gaussians = scene(degree=3)
    save_ply(tmp_path / "a.ply", gaussians)
    for view in (camera(), camera(0.4)):
        drawn = render(gaussians, view).color
        assert float(drawn.std()) > 0.05  # the image shows the scene
        assert decibels(drawn, render(independent_gaussians(tmp_path / "a.ply"), view).color) >= RENDER_DB
        assert decibels(drawn, render(load_ply(tmp_path / "a.ply"), view).color) >= RENDER_DB


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
    assert list(ply["vertex"].data.dtype.names) == property_names(1)
    assert ply.comments == ["SplatRenderMode: mip", "SH degree: 1"]
    get = lambda *names: [float(row[name]) for name in names]  # noqa: E731
    assert get("x", "y", "z", "nx", "ny", "nz") == [1, -2, 3, 0, 0, 0]
    assert get("rot_0", "rot_1", "rot_2", "rot_3") == pytest.approx([0, 0.6, 0, 0.8])
    assert get("scale_0", "scale_1", "scale_2") == pytest.approx([-np.log(2), 0, np.log(2)])
    assert get("opacity") == pytest.approx([np.log(4)])
    assert get("f_dc_0", "f_dc_1", "f_dc_2") == pytest.approx(sh[0, 0])
    assert get(*(f"f_rest_{i}" for i in range(9))) == pytest.approx(sh[0, 1:].T.reshape(-1))  # R R R G G G B B B


def test_color_is_the_constant_band(tmp_path):
    one = Gaussians.from_rgb(
        means=jnp.zeros((1, 3)),
        quats=jnp.array([[1.0, 0, 0, 0]]),
        scales=jnp.ones((1, 3)),
        opacities=jnp.ones(1),
        colors=jnp.array([[0.9, 0.5, 0.1]]),
    )
    save_ply(tmp_path / "a.ply", one)
    row = PlyData.read(str(tmp_path / "a.ply"))["vertex"].data[0]
    assert [0.5 + SH_C0 * float(row[f"f_dc_{i}"]) for i in range(3)] == pytest.approx([0.9, 0.5, 0.1], abs=1e-6)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_written_scenes_are_read_back(tmp_path, degree):
    gaussians = scene(degree)
    report = save_ply(tmp_path / "a.ply", gaussians)
    again = load_ply(tmp_path / "a.ply")
    assert (report.num_written, report.num_dropped) == (60, 0) and again.sh_degree == degree
    unit = gaussians.quats / jnp.linalg.norm(gaussians.quats, axis=-1, keepdims=True)
    for name, wanted in (("means", gaussians.means), ("quats", unit), ("scales", gaussians.scales)):
        np.testing.assert_allclose(getattr(again, name), wanted, rtol=ROUND_TRIP, atol=1e-6)
    np.testing.assert_allclose(again.opacities, gaussians.opacities, atol=2e-6)  # opacities near 1 are clamped
    np.testing.assert_array_equal(again.sh, gaussians.sh)


def test_files_are_deterministic_and_survive_a_round_trip(tmp_path):
    save_ply(tmp_path / "a.ply", scene())
    save_ply(tmp_path / "b.ply", scene())
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()
    save_ply(tmp_path / "c.ply", load_ply(tmp_path / "a.ply"))
    a, c = independent_gaussians(tmp_path / "a.ply"), independent_gaussians(tmp_path / "c.ply")
    for name in ("means", "quats", "scales", "opacities", "sh"):
        np.testing.assert_allclose(getattr(a, name), getattr(c, name), rtol=ROUND_TRIP, atol=1e-6)


def test_invisible_rows_are_dropped_and_counted(tmp_path):
    good = scene(1, n=9)
    bad = replace(
        good,
        means=good.means.at[0, 1].set(jnp.nan),
        quats=good.quats.at[1, 0].set(jnp.inf),
        scales=good.scales.at[2, 2].set(-0.1).at[7, 0].set(jnp.inf),
        opacities=good.opacities.at[3].set(0.0).at[4].set(0.9 / 255).at[5].set(jnp.nan),
        sh=good.sh.at[6, 3, 0].set(-jnp.inf),
    )
    report = save_ply(tmp_path / "a.ply", bad)
    assert (report.num_written, report.num_dropped) == (1, 8)
    np.testing.assert_array_equal(load_ply(tmp_path / "a.ply").means, good.means[8:])


def test_every_written_number_is_finite(tmp_path):
    gaussians = replace(
        scene(0, n=4),
        opacities=jnp.array([1.0, 1.0, 1.0 / 254.0, 1.0]),
        scales=jnp.array([[0.0, 1e-30, 1.0], [1e30, 1.0, 1.0], [1.0, 1.0, 1.0], [1.0, 1.0, 1.0]]),
        quats=jnp.array([[0.0, 0, 0, 0], [1e-30, 0, 0, 0], [1e30, 0, 0, 0], [0, 1e-10, 0, 0]]),
    )
    assert save_ply(tmp_path / "a.ply", gaussians).num_written == 4
    rows = PlyData.read(str(tmp_path / "a.ply"))["vertex"].data
    numbers = np.stack([rows[name] for name in rows.dtype.names])
    assert np.isfinite(numbers).all()
    assert rows["opacity"].max() == pytest.approx(np.log(1e6), rel=1e-6)
    assert rows["scale_0"][0] == -20 and rows["scale_1"][0] == -20 and rows["scale_0"][1] == 20
    quats = np.stack([rows[f"rot_{i}"] for i in range(4)], -1)
    np.testing.assert_array_equal(quats, [[1, 0, 0, 0], [1, 0, 0, 0], [1, 0, 0, 0], [0, 1, 0, 0]])


def test_empty_scenes_are_written_and_read(tmp_path):
    empty = replace(scene(1), opacities=jnp.zeros(60))
    report = save_ply(tmp_path / "a.ply", empty)
    assert (report.num_written, report.num_dropped) == (0, 60)
    again = load_ply(tmp_path / "a.ply")
    assert again.num_gaussians == 0 and again.sh_degree == 1


def test_a_trained_scene_agrees_with_an_independent_reader(scenes):
    path = scenes / "kacytran_iter7000.ply"
    ours, theirs = load_ply(path), independent_gaussians(path)
    assert ours.num_gaussians == 9080 and ours.sh_degree == 3
    unit = theirs.quats / jnp.linalg.norm(theirs.quats, axis=-1, keepdims=True)
    np.testing.assert_array_equal(ours.means, theirs.means)
    np.testing.assert_array_equal(ours.sh, theirs.sh)
    np.testing.assert_allclose(ours.scales, theirs.scales, rtol=ROUND_TRIP)
    np.testing.assert_allclose(ours.opacities, theirs.opacities, atol=1e-6)
    np.testing.assert_allclose(ours.quats, unit, atol=1e-6)


def test_a_compressed_scene_is_refused_as_such(scenes):
    with pytest.raises(InputError, match="it is compressed"):
        load_ply(scenes / "guitar.compressed.ply")


def test_a_failed_write_leaves_the_old_file_and_nothing_else(tmp_path, monkeypatch):
    path = tmp_path / "a.ply"
    save_ply(path, scene(0))
    before = path.read_bytes()

    def no_space(descriptor):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", no_space)
    with pytest.raises(StorageError, match=r"a\.ply.*No space left"):
        save_ply(path, scene(3))
    assert path.read_bytes() == before and os.listdir(tmp_path) == ["a.ply"]


def test_a_folder_that_cannot_be_made_is_a_storage_error(tmp_path):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(StorageError, match="cannot be written"):
        save_ply(tmp_path / "file" / "a.ply", scene(0))


def test_render_modes_are_written_and_unknown_ones_refused(tmp_path):
    save_ply(tmp_path / "a.ply", scene(0), render_mode="default")
    assert "SplatRenderMode: default" in PlyData.read(str(tmp_path / "a.ply")).comments
    with pytest.raises(InputError, match="render_mode"):
        save_ply(tmp_path / "b.ply", scene(0), render_mode="antialiased")
    assert not (tmp_path / "b.ply").exists()
