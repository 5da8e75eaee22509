"""Outside jit the pairs are counted once for each kind of render, and nothing is left out for it."""

import importlib

import numpy as np
import pytest

from ssplat_jax.core.pytree import replace
from ssplat_jax.rasterizer import render
from tests.rasterizer.scenes import cameras, cloud

pytestmark = pytest.mark.usefixtures("compiled_plainly")
module = importlib.import_module("ssplat_jax.rasterizer.render")


@pytest.fixture
def counts(monkeypatch):
    """Numbers of pairs that were counted in a pass of their own."""
    found, real = [], module._count
    monkeypatch.setattr(module, "_CAPACITIES", {})
    monkeypatch.setattr(module, "_count", lambda *arguments: found.append(real(*arguments)) or found[-1])
    return found


def test_pairs_are_counted_in_the_first_render_alone(counts):
    scene, camera = cloud(40), cameras(16, 24)
    first, second = render(scene, camera), render(scene, camera)
    assert len(counts) == 1 and int(first.num_pairs) == counts[0]
    np.testing.assert_array_equal(first.color, second.color)
    render(scene, cameras(24, 16))
    assert len(counts) == 2  # another kind


def test_a_scene_that_needs_more_room_loses_nothing(counts, monkeypatch):
    monkeypatch.setattr(module, "MIN_CAPACITY", 64)
    small, camera = cloud(40, size=0.002), cameras(16, 24)
    large = replace(small, scales=small.scales * 200)
    needed = int(render(large, camera, max_pairs=1 << 10).num_pairs)
    render(small, camera)
    (held,) = module._CAPACITIES.values()
    assert held < needed
    again = render(large, camera)
    assert len(counts) == 1 and int(again.num_overflow) == 0
    np.testing.assert_array_equal(again.color, render(large, camera, max_pairs=1 << 10).color)
    assert list(module._CAPACITIES.values()) == [module.round_up(needed)]
