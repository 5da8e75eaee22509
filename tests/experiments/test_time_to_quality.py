"""Quality against seconds: what the stopwatch counts, where curves cross, and when a curve ends."""

import time

import jax
import jax.numpy as jnp
import pytest
from ssplat_experiments.stopwatch import Stopwatch, covered
from ssplat_experiments.time_curves import OPTIMIZED, TIMES, best_at, findings, lead
from ssplat_experiments.time_to_quality import PATIENCE, Curve, cases


def test_spans_that_overlap_count_once():
    assert covered([(1, 3), (2, 4), (2.5, 2.6), (6, 7)], 0, 10) == 4
    assert covered([(1, 3), (9, 12)], 2, 10) == 2
    assert covered([], 0, 10) == 0


def test_compilation_does_not_count_and_work_does():
    def slow_to_trace(x):
        time.sleep(0.3)
        return x + 1

    watch, program = Stopwatch(), jax.jit(slow_to_trace)
    with watch.running():
        jax.block_until_ready(program(jnp.ones(3)))
    assert watch.seconds < 0.2
    with watch.running():
        time.sleep(0.3)
    assert 0.3 <= watch.seconds < 0.6


def test_items_count_while_they_are_made():
    def items():
        for number in range(3):
            time.sleep(0.05)
            yield number

    watch, found = Stopwatch(), []
    for item in watch.over(items()):
        found.append(item)
        time.sleep(0.2)
    assert found == [0, 1, 2] and 0.15 <= watch.seconds < 0.4


def test_a_block_that_fails_leaves_no_listener():
    watch = Stopwatch()
    with pytest.raises(KeyError), watch.running():
        raise KeyError
    before = watch.seconds
    jax.block_until_ready(jax.jit(lambda x: 2 * x)(jnp.ones(5)))
    assert watch.seconds == before


def curve(method, *points, scene="room"):
    return [
        {"scene": scene, "method": method, "seconds": float(t), "literal_psnr": p, "shown_psnr": p + 1}
        for t, p in points
    ]


def test_the_lead_is_that_of_the_best_so_far():
    ours = curve("stream", (1, 15.0), (2, 20.0)) + curve("stream + offline 200", (3, 24.0), (5, 23.0))
    theirs = curve(OPTIMIZED, (1, 10.0), (4, 21.0), (10, 25.0), (20, 24.0))
    assert best_at(ours, 2.5, "literal_psnr") == 20.0 and best_at(ours, 30, "literal_psnr") == 24.0
    assert lead(ours + theirs, "literal_psnr") == 10.0
    assert lead(ours + theirs[:2], "literal_psnr") is None
    early = curve(OPTIMIZED, (0.5, 16.0))  # ahead at first, until the stream overtakes it
    assert lead(ours + early + theirs[:2], "literal_psnr") is None


def test_findings_tell_the_crossing_of_each_scene_and_column():
    rows = curve("stream", (1, 20.0)) + curve(OPTIMIZED, (2, 10.0), (3, 22.0))
    rows += curve("stream", (1, 20.0), scene="fox") + curve(OPTIMIZED, (3, 12.0), scene="fox")
    table, text = findings(rows)
    lines = text.splitlines()
    # Ours / theirs at 1, 3, 10 s ...; the optimization of the room was measured until 3 s.
    assert (
        table.splitlines()[2]
        == "| room | literal | "
        + " | ".join(["20.00 / -", "20.00 / 22.00", *["20.00 / 22.00 (ended)"] * (len(TIMES) - 2)])
        + " |"
    )
    assert len(lines) == 4 and "room, literal: per-scene optimization leads from 3.0 s on" in lines[0]
    assert "fox, shown: per-scene optimization does not lead in the end" in lines[3]
    assert "13.00 dB (-8.00 dB against the best of ours), after 3.0 s." in lines[3]
    assert findings(curve("stream", (1, 20.0))) == []


def test_a_curve_ends_when_no_column_improves_any_more():
    of = Curve("room", "any")
    scores = [(20.0, 21.0), (22.0, 23.0), (21.0, 22.0), (22.0, 22.9), (21.5, 23.0), (21.9, 22.0)]
    ended = []
    for literal, shown in scores:
        of.rows.append({"literal_psnr": literal, "shown_psnr": shown})
        ended.append(of.has_ended)
    assert PATIENCE == 3 and ended == [False, False, False, False, True, True]
    of.rows.append({"literal_psnr": 20.0, "shown_psnr": 23.1})
    assert not of.has_ended


def test_all_methods_are_measured_on_all_scenes():
    found = [case.name for case in cases(None, "cpu")]
    assert found[0] == "room, stream" and found[-1] == f"room, {OPTIMIZED}"
    assert [name for name in found if "offline" in name] == [f"room, stream + offline {n}" for n in (200, 800)]
    assert [name for name in found if "online" in name] == ["room, stream + online 5"]
