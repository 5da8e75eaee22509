"""A long experiment gives back the memory maps of programs that it no longer needs."""

import jax
import jax.numpy as jnp
import pytest
from ssplat_experiments import warm_sessions
from ssplat_experiments.program_memory import make_room

from ssplat_jax.config import preset
from ssplat_jax.core.cpu_backend import MAPS


@pytest.mark.skipif(not MAPS.exists(), reason="only Linux counts memory maps there")
def test_programs_are_dropped_only_when_there_are_many():
    held = [jax.jit(lambda x, n=n: jnp.sin(x) * n) for n in range(40)]
    for program in held:
        program(jnp.ones(3)).block_until_ready()
    session = warm_sessions.new_session(preset("tiny"))
    before = num_maps()
    make_room(before + 1000)
    assert warm_sessions.new_session(preset("tiny")) is session
    make_room(0)
    assert num_maps() <= before - len(held)
    assert warm_sessions.new_session(preset("tiny")) is not session
    assert float(held[7](jnp.zeros(3))[0]) == 0.0  # compiled again


def num_maps() -> int:
    return len(MAPS.read_text().splitlines())
