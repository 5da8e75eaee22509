"""The additions: read from the presets, one field a step, gains that add up."""

import itertools

from ssplat_experiments.additions import add_gains, additions, differing_fields, unmeasured, variants

from ssplat_jax.config import preset


def flat(config):
    return {
        f"{g}.{f}": v for g, fields in config.to_dict().items() if isinstance(fields, dict) for f, v in fields.items()
    }


def differing(a, b):
    a, b = flat(a), flat(b)
    return [name for name in a if a[name] != b[name]]


def test_each_step_changes_one_field():
    found = additions()
    steps = variants(found)
    path = [config for way, _, config in steps if way == "added"]
    taken = [config for way, _, config in steps if way == "taken away"]
    assert [differing(a, b) for a, b in itertools.pairwise(path)] == [[a.field] for a in found]
    assert [differing(path[-1], config) for config in taken] == [[a.field] for a in found]
    assert differing(path[-1], preset("tiny")) == ["memory.capacity"]  # the memory starts small


def test_no_differing_field_is_forgotten():
    listed = [a.field for a in (*additions(), *unmeasured())]
    assert sorted(listed) == sorted(a.field for a in differing_fields())
    assert {"memory.voxel_size", "depth.confidence"} <= set(listed)
    assert all(preset("tiny").get(a.field) == a.ours != a.literal for a in differing_fields())


def test_gains_along_the_path_add_up():
    rows = [
        {"scene": "room", "path": "added", "step": str(n), "literal_psnr": p, "shown_psnr": 2 * p, "chunk_ms": 10.0 * n,
         "peak_memory_bytes": 100 * n}
        for n, p in enumerate((10.0, 12.0, 11.5))
    ]  # fmt: skip
    rows.append(rows[0] | {"path": "taken away", "step": "first", "literal_psnr": 11.0, "chunk_ms": 15.0})
    add_gains(rows)
    gains = [row["literal_gain_db"] for row in rows[1:3]]
    assert gains == [2.0, -0.5] and sum(gains) == rows[2]["literal_psnr"] - rows[0]["literal_psnr"]
    assert (rows[3]["literal_gain_db"], rows[3]["added_ms"], rows[3]["added_bytes"]) == (0.5, 5.0, 200)
