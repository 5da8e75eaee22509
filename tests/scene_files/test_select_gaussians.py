"""Selection on export: specks and unconfirmed floaters go, surfaces stay, and what is thinned is thinned alike."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ssplat_jax.core.errors import InputError
from ssplat_jax.core.gaussians import Gaussians
from ssplat_jax.core.pytree import replace
from ssplat_jax.scene_files.ply import load_ply, save_ply
from ssplat_jax.scene_files.select_gaussians import (
    FLOATER,
    REACH,
    SPECK,
    Selection,
    prune_mask,
    select_gaussians,
    thinned_mask,
)
from tests.commands.test_cli import run
from tests.scene_files.scene_fixture import scene

SIGMA, STEP = 0.1, 0.2


def sheet(rows: int, columns: int, at, sigma=SIGMA, step=STEP) -> Gaussians:
    """A flat square grid of Gaussians that touch their neighbors."""
    x, y = np.meshgrid(np.arange(columns) * step, np.arange(rows) * step)
    means = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1) + at
    return Gaussians.from_rgb(
        means=jnp.asarray(means, jnp.float32),
        quats=jnp.tile(jnp.array([1.0, 0, 0, 0]), (x.size, 1)),
        scales=jnp.full((x.size, 3), sigma),
        opacities=jnp.full(x.size, 0.8),
        colors=jnp.full((x.size, 3), 0.4),
    )


def joined(*parts: Gaussians) -> Gaussians:
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *parts)


def kept_by_part(parts, mask):
    ends = np.cumsum([part.num_gaussians for part in parts])
    return [bool(x.all()) if x.all() == x.any() else None for x in np.split(mask, ends[:-1])]


def test_small_clusters_go_and_surfaces_of_any_size_stay():
    parts = [
        sheet(40, 40, [0, 0, 0]),
        sheet(3, 5, [0, 0, 5.0]),  # 15: a speck
        sheet(4, 4, [0, 0, -5.0]),  # 16
        sheet(30, 30, [0, 0, 90.0], sigma=2.0, step=4.0),  # far away, as coarse as it is far
        sheet(1, 1, [0, 0, 0.3 + 2 * SIGMA * REACH]),  # alone in front of the surface
    ]
    mask = prune_mask(joined(*parts))
    assert kept_by_part(parts, mask) == [True, False, True, True, False]


def test_a_cluster_of_one_view_goes_unless_another_confirms_it():
    parts = [sheet(40, 40, [0, 0, 0]), sheet(5, 5, [0, 0, 5.0]), sheet(5, 5, [0, 0, -5.0]), sheet(8, 8, [0, 0, 9.0])]
    assert SPECK <= 25 < FLOATER == 64
    members = np.ones(1600 + 25 + 25 + 64, int)
    members[1600 + 25 + 3] = 2
    mask = prune_mask(joined(*parts), members)
    assert kept_by_part(parts, mask) == [True, False, True, True]
    assert prune_mask(joined(*parts)).all()  # nothing is known of the views: no speck is that large


def test_clusters_are_those_of_all_pairs_that_touch():
    rng = np.random.default_rng(0)
    means = rng.uniform(0, 20, (400, 3))
    gaussians = replace(scene(0, n=400), means=jnp.asarray(means, jnp.float32), scales=jnp.full((400, 3), 0.25))
    reach = 2 * REACH * 0.25
    near = np.linalg.norm(means[:, None] - means[None], axis=2) <= reach
    seen = np.full(400, -1)
    for start in range(400):  # by flooding, one cluster after the other
        if seen[start] < 0:
            front = {start}
            while front:
                seen[list(front)] = start
                front = {j for i in front for j in np.flatnonzero(near[i]) if seen[j] < 0}
    sizes = np.bincount(seen, minlength=400)[seen]
    wanted = sizes >= SPECK
    assert 0 < wanted.sum() < 400
    np.testing.assert_array_equal(prune_mask(gaussians), wanted)


def test_the_largest_cluster_of_a_tiny_scene_stays():
    tiny = sheet(1, 3, [0, 0, 0])
    assert prune_mask(tiny).all() and prune_mask(tiny, np.ones(3, int)).all()
    assert len(prune_mask(sheet(0, 0, [0, 0, 0]))) == 0


@pytest.mark.parametrize("num_kept", [1, 7, 20, 49])
def test_exactly_so_many_stay_in_their_order(num_kept):
    gaussians = scene(1, n=50)
    selected = select_gaussians(gaussians, Selection(max_splats=num_kept))
    assert (selected.num_pruned, selected.num_cut) == (0, 50 - num_kept)
    mask = thinned_mask(gaussians, num_kept)
    assert mask.sum() == num_kept
    for ours, theirs in zip(jax.tree.leaves(selected.gaussians), jax.tree.leaves(gaussians), strict=True):
        np.testing.assert_array_equal(ours, np.asarray(theirs)[mask])


@pytest.mark.parametrize(
    ("num_kept", "factor"),
    [(600, 600 / (500 * 1.1125)), (800, (800 - 500) / (500 * 0.3025))],  # with 800 all of the most opaque are kept
)
def test_thinning_keeps_as_often_as_opacity_squared(num_kept, factor):
    values = np.array([0.9, 0.45, 0.3, 0.1])  # squares 0.81, 0.2025, 0.09 and 0.01
    opacities = np.random.default_rng(0).permutation(np.tile(values, 500))
    gaussians = replace(sheet(40, 50, [0, 0, 0]), opacities=jnp.asarray(opacities, jnp.float32))
    mask = thinned_mask(gaussians, num_kept)
    shares = [mask[opacities == value].mean() for value in values]
    np.testing.assert_allclose(shares, np.minimum(factor * values**2, 1.0), atol=0.02)


def test_thinning_takes_the_same_share_everywhere():
    parts = [sheet(20, 20, [x, 0, 0]) for x in (0.0, 100.0, 300.0, 301.0)]
    mask = thinned_mask(joined(*parts), 500)
    shares = np.split(mask, 4)
    assert all(abs(int(share.sum()) - 125) <= 2 for share in shares[:2]) and mask.sum() == 500
    in_a_quarter = mask[:400].reshape(20, 20)[:10, :10].sum()
    assert abs(int(in_a_quarter) - 125 / 4) <= 6


def test_rows_that_no_file_holds_take_no_place():
    gaussians = scene(0, n=50)
    gaussians = replace(
        gaussians, opacities=gaussians.opacities.at[:10].set(0.0), scales=gaussians.scales.at[10].set(jnp.nan)
    )
    selected = select_gaussians(gaussians, Selection(max_splats=30))
    assert (selected.num_cut, selected.gaussians.num_gaussians) == (9, 41)
    everything = select_gaussians(gaussians, Selection())
    assert (everything.num_cut, everything.num_pruned, everything.gaussians.num_gaussians) == (0, 0, 50)


def test_export_prints_what_it_left_out(tmp_path, capsys):
    parts = [sheet(20, 20, [0, 0, 0]), sheet(3, 4, [0, 0, 50.0])]
    save_ply(tmp_path / "scene.ply", joined(*parts))
    to = tmp_path / "less.ply"
    assert run("export", str(tmp_path / "scene.ply"), "--to", str(to), "--max-splats", "300") == 0
    said = capsys.readouterr().out
    assert "300 Gaussians (112 beyond --max-splats were left out)" in said
    assert load_ply(to).num_gaussians == 300
    assert run("export", str(tmp_path / "scene.ply"), "--to", str(to)) == 0  # by default nothing is left out
    assert "412 Gaussians\n" in capsys.readouterr().out


def test_export_says_that_what_is_not_written_has_no_effect(tmp_path, capsys, monkeypatch):
    """As a file of another maker may have it: ours hold visible Gaussians alone."""
    with monkeypatch.context() as patch:
        patch.setattr("ssplat_jax.scene_files.export_rows.MIN_OPACITY", 0.0)
        faint = sheet(1, 7, [0, 0, 9.0])
        faint = replace(faint, opacities=jnp.full(7, 0.001))
        save_ply(tmp_path / "scene.ply", joined(sheet(5, 5, [0, 0, 0]), faint))
    assert run("export", str(tmp_path / "scene.ply"), "--to", str(tmp_path / "less.ply")) == 0
    assert "25 Gaussians (7 more have no visible effect and were not written)\n" in capsys.readouterr().out


def test_no_splats_at_all_is_bad_usage(tmp_path, capsys):
    save_ply(tmp_path / "scene.ply", scene(0))
    to = tmp_path / "none.ply"
    assert run("export", str(tmp_path / "scene.ply"), "--to", str(to), "--max-splats", "0") == 2
    assert "--max-splats: wanted at least 1, got 0" in capsys.readouterr().err and not to.exists()
    with pytest.raises(InputError, match="at least 1"):
        Selection(max_splats=-3)
