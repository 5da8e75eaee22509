"""Compressed .ply files: a decoder of one Gaussian at a time gets the scene, and files of other writers are read."""

import math

import jax.numpy as jnp
import numpy as np
import pytest
from plyfile import PlyData, PlyElement

from ssplat_jax.core.errors import InputError
from ssplat_jax.core.gaussians import SH_C0, Gaussians
from ssplat_jax.core.pytree import replace
from ssplat_jax.rasterizer import render
from ssplat_jax.scene_files.compressed_ply import read_compressed_ply, save_compressed_ply
from tests.scene_files.scene_fixture import camera, decibels, scene

RENDER_DB = 35.0
FIELDS = ("means", "quats", "scales", "opacities", "sh")


def independent_gaussians(path) -> Gaussians:
    """Gaussians of a file, read with plyfile, one after the other, after the description of the format."""
    ply = PlyData.read(str(path))
    chunk, vertex = ply["chunk"].data, ply["vertex"].data
    rest = ply["sh"].data if "sh" in ply else None
    rows = []
    for i, row in enumerate(vertex):
        of = chunk[i // 256]
        vector = lambda word, names, of=of: [  # noqa: E731
            float(of[f"min_{name}"]) + fraction * (float(of[f"max_{name}"]) - float(of[f"min_{name}"]))
            for name, fraction in zip(names, unpacked(word), strict=True)
        ]
        red, green, blue, alpha = (int(row["packed_color"]) >> shift & 255 for shift in (24, 16, 8, 0))
        colors = [
            float(of[f"min_{c}"]) + level / 255 * (float(of[f"max_{c}"]) - float(of[f"min_{c}"]))
            for c, level in zip("rgb", (red, green, blue), strict=True)
        ]
        sh = [[(color - 0.5) / SH_C0 for color in colors]]
        if rest is not None:
            k = len(rest.dtype.names) // 3
            value = lambda c, term, i=i, k=k: ((int(rest[i][f"f_rest_{c * k + term}"]) + 0.5) / 256 - 0.5) * 8  # noqa: E731
            sh += [[value(c, term) for c in range(3)] for term in range(k)]
        rows.append(
            (
                vector(int(row["packed_position"]), "xyz"),
                smallest_three(int(row["packed_rotation"])),
                [math.exp(x) for x in vector(int(row["packed_scale"]), ("scale_x", "scale_y", "scale_z"))],
                alpha / 255,
                sh,
            )
        )
    columns = zip(*rows, strict=True)
    return Gaussians(**{name: jnp.asarray(x, jnp.float32) for name, x in zip(FIELDS, columns, strict=True)})


def unpacked(word: int) -> list[float]:
    return [(word >> 21) / 2047, (word >> 11 & 1023) / 1023, (word & 2047) / 2047]


def smallest_three(word: int) -> list[float]:
    others = [(level / 1023 * 2 - 1) / math.sqrt(2) for level in (word >> 20 & 1023, word >> 10 & 1023, word & 1023)]
    others.insert(word >> 30, math.sqrt(max(0.0, 1 - sum(x * x for x in others))))
    return others


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_a_compressed_file_draws_the_scene(tmp_path, degree):
    gaussians, path = scene(degree, n=600), tmp_path / "a.compressed.ply"
    report = save_compressed_ply(path, gaussians)
    assert (report.num_written, report.num_dropped) == (600, 0)
    ours, theirs = read_compressed_ply(path).gaussians, independent_gaussians(path)
    for name in FIELDS:
        np.testing.assert_allclose(getattr(ours, name), getattr(theirs, name), rtol=2e-6, atol=1e-6)
    for view in (camera(), camera(0.4)):
        drawn = render(gaussians, view).color
        assert float(drawn.std()) > 0.05
        assert decibels(drawn, render(theirs, view).color) >= RENDER_DB


def test_another_writers_file_is_decoded_as_it_was_meant(scenes):
    found, wanted = (
        read_compressed_ply(scenes / "guitar.compressed.ply").gaussians,
        np.load(scenes / "guitar_decoded.npz"),
    )
    np.testing.assert_allclose(found.means, wanted["means"], atol=1e-6)
    np.testing.assert_allclose(np.log(found.scales), wanted["log_scales"], atol=1e-5)
    np.testing.assert_allclose(found.opacities, wanted["opacity"], atol=1e-6)
    np.testing.assert_allclose(0.5 + SH_C0 * found.sh[:, 0], wanted["rgb"], atol=1e-6)
    unit = wanted["quats_wxyz"] / np.linalg.norm(wanted["quats_wxyz"], axis=1, keepdims=True)
    np.testing.assert_allclose(np.abs(np.sum(found.quats * unit, axis=1)), 1.0, atol=1e-6)


@pytest.mark.parametrize("n", [0, 1, 256, 257])
def test_chunks_of_one_gaussian_or_in_a_plane_stay_finite(tmp_path, n):
    gaussians = scene(0, n=n)
    gaussians = replace(gaussians, means=gaussians.means.at[:, 1].set(0.25), scales=jnp.full((n, 3), 0.1))
    save_compressed_ply(tmp_path / "a.compressed.ply", gaussians)
    found = read_compressed_ply(tmp_path / "a.compressed.ply").gaussians
    assert found.num_gaussians == n
    np.testing.assert_allclose(found.means[:, 1], 0.25, atol=1e-6)
    np.testing.assert_allclose(found.scales, 0.1, rtol=1e-5)
    assert all(np.isfinite(np.asarray(getattr(found, name))).all() for name in FIELDS)


def test_the_same_scene_gives_the_same_bytes(tmp_path):
    for name in ("a", "b"):
        save_compressed_ply(tmp_path / name, scene(1, n=300))
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


def test_neighbors_in_space_share_a_chunk(tmp_path):
    save_compressed_ply(tmp_path / "a.ply", scene(0, n=256 * 64))
    chunk = PlyData.read(str(tmp_path / "a.ply"))["chunk"].data
    sizes = np.stack([chunk[f"max_{c}"] - chunk[f"min_{c}"] for c in "xyz"], axis=1)
    # The scene is a cube of side 2; 64 cubes of side 0.5 would fill it.
    assert np.median(np.prod(sizes, axis=1)) < 4 * 2.0**3 / 64


def rewritten(path, *, chunk=lambda x: x, vertex=lambda x: x):
    ply = PlyData.read(str(path))
    elements = [PlyElement.describe(chunk(ply["chunk"].data), "chunk")]
    elements.append(PlyElement.describe(vertex(ply["vertex"].data), "vertex"))
    other = path.with_name("other.ply")  # plyfile has mapped the first one into memory
    PlyData(elements, byte_order="<").write(str(other))
    return other


def without(*names):
    return lambda table: np.array(
        table[[n for n in table.dtype.names if n not in names]].tolist(),
        [(n, table.dtype[n]) for n in table.dtype.names if n not in names],
    )


def with_nan(table):
    table = table.copy()
    table["max_y"][0] = np.nan
    return table


def test_files_without_ranges_of_colors_are_read(tmp_path):
    path = tmp_path / "a.ply"
    save_compressed_ply(path, scene(0, n=40))
    path = rewritten(path, chunk=without(*(f"{end}_{c}" for end in ("min", "max") for c in "rgb")))
    colors = 0.5 + SH_C0 * np.asarray(read_compressed_ply(path).gaussians.sh[:, 0])
    np.testing.assert_allclose([colors.min(), colors.max()], [0.0, 1.0], atol=1e-6)  # all levels of a byte


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"vertex": without("packed_scale")}, "'packed_scale'"),
        ({"chunk": without("max_z")}, "'max_z'"),
        ({"chunk": lambda x: with_nan(without("max_r")(x))}, "finite position"),  # a color's range is not needed
        ({"chunk": lambda x: x[:0]}, "a chunk for every 256 of 40"),
        ({"chunk": with_nan}, "finite position"),
    ],
)
def test_a_spoiled_file_is_refused_in_one_line(tmp_path, change, words):
    path = tmp_path / "a.ply"
    save_compressed_ply(path, scene(0, n=40))
    with pytest.raises(InputError) as caught:
        read_compressed_ply(rewritten(path, **change))
    assert words in str(caught.value) and "\n" not in str(caught.value)


def test_a_file_cut_off_anywhere_is_refused(tmp_path):
    path = tmp_path / "a.ply"
    save_compressed_ply(path, scene(1, n=40))
    data = path.read_bytes()
    for size in np.linspace(0, len(data) - 1, 60).astype(int):
        path.write_bytes(data[:size])
        with pytest.raises(InputError):
            read_compressed_ply(path)
