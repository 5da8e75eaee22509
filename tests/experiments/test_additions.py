"""The additions: read from the presets, one field a step, gains that add up."""

import itertools

import pytest
from ssplat_experiments import additions as additions_experiment
from ssplat_experiments.additions import KEPT, add_gains, additions, differing_fields, findings, unmeasured, variants

from ssplat_jax.config import preset


def flat(config):
    return {
        f"{g}.{f}": v for g, fields in config.to_dict().items() if isinstance(fields, dict) for f, v in fields.items()
    }


def differing(a, b):
    a, b = flat(a), flat(b)
    return [name for name in a if a[name] != b[name]]


@pytest.mark.slow
def test_each_step_changes_one_field():
    found = additions()
    steps = variants(found)
    path = [config for way, _, config in steps if way == "added"]
    taken = [config for way, _, config in steps if way == "taken away"]
    assert [differing(a, b) for a, b in itertools.pairwise(path)] == [[a.field] for a in found]
    assert [differing(path[-1], config) for config in taken] == [[a.field] for a in found]
    assert differing(path[-1], preset("tiny")) == ["memory.capacity"]  # the memory starts small


@pytest.mark.slow  # traces the network for every field
def test_no_differing_field_is_forgotten():
    listed = [a.field for a in (*additions(), *unmeasured())]
    assert sorted(listed) == sorted(a.field for a in differing_fields())
    assert {"memory.voxel_size", "additions.depth_readout"} <= set(listed)
    assert all(preset("tiny").get(a.field) == a.ours != a.literal for a in differing_fields())


def test_gains_along_the_path_add_up():
    rows = [
        {"scene": "room", "path": "added", "step": str(n), "literal_psnr": p, "shown_psnr": 2 * p,
         "literal_ssim": p / 20, "shown_ssim": p / 16, "chunk_ms": 10.0 * n, "peak_memory_bytes": 100 * n}
        for n, p in enumerate((10.0, 12.0, 11.5))
    ]  # fmt: skip
    rows.append(rows[0] | {"path": "taken away", "step": "first", "literal_psnr": 11.0, "chunk_ms": 15.0})
    add_gains(rows)
    gains = [row["literal_gain_db"] for row in rows[1:3]]
    assert gains == [2.0, -0.5] and sum(gains) == rows[2]["literal_psnr"] - rows[0]["literal_psnr"]
    assert (rows[3]["literal_gain_db"], rows[3]["added_ms"], rows[3]["added_bytes"]) == (0.5, 5.0, 200)
    assert [row["literal_gain_ssim"] for row in rows[1:]] == [0.1, -0.025, 0.075]


@pytest.mark.parametrize(
    "without, verdict",
    [
        ({}, "not earned here; kept: captures come in any unit"),
        ({"literal_psnr": 19.9}, "earned in PSNR literal"),
        ({"shown_psnr": 25.5, "shown_ssim": 0.69}, "earned in SSIM shown"),
        ({"literal_ssim": 0.61}, "not earned here"),
    ],
)
def test_an_addition_is_judged_by_what_its_absence_costs(without, verdict, monkeypatch):
    monkeypatch.setattr(additions_experiment, "unmeasured", lambda: [])
    ours = {"literal_psnr": 20.0, "shown_psnr": 25.0, "literal_ssim": 0.6, "shown_ssim": 0.7}
    rows = [
        {"scene": scene, "path": path, "step": step, "chunk_ms": 1.0, "peak_memory_bytes": None} | ours | scores
        for scene in ("room", "fox")
        for path, step, scores in (("added", "last", {}), ("taken away", "stream.scene_scale=1.0", without))
    ]
    add_gains(rows)
    assert verdict in findings(rows)[0]
    assert "on 2 scenes" in findings(rows)[0]


@pytest.mark.slow  # traces the network for every field
def test_what_is_kept_for_another_reason_is_an_addition():
    assert KEPT.keys() <= {a.field for a in additions()}
