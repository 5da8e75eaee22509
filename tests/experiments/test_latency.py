"""Latency: every stage is waited for, and compilation is not timed."""

import time

import jax
import pytest
from ssplat_experiments.latency import STAGES, median_ms, stage_times

from ssplat_jax.core.cameras import Camera
from ssplat_jax.streaming.session import Session
from tests.model import small


def test_compilation_and_preparation_are_not_timed():
    waits = iter([0.2, 0.01, 0.01, 0.01])
    assert 9 <= median_ms(lambda wait: time.sleep(wait), 3, prepare=lambda: next(waits)) < 60

    slow_start = iter([0.2, 0.0, 0.0, 0.0])
    assert median_ms(lambda _: None, 3, prepare=lambda: time.sleep(next(slow_start))) < 50


@pytest.mark.slow
@pytest.mark.usefixtures("compiled_plainly")
def test_stages_are_timed_without_touching_the_stream():
    session, chunk = Session(small.MODEL, small.params()), small.chunk()
    session.feed(chunk)
    before = jax.device_get(session.cache)
    camera = Camera(viewmats=chunk.viewmats[0], Ks=chunk.Ks[0], width=small.WIDTH, height=small.HEIGHT)
    times = stage_times(session, chunk, camera, repeats=1)
    assert tuple(times) == STAGES and all(ms >= 0 for ms in times.values())
    assert times["render"] > 0
    jax.tree.map(lambda a, b: (a == b).all() or pytest.fail("the cache changed"), before, jax.device_get(session.cache))
