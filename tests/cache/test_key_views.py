"""The ring of key views: what enters, and what leaves when it is full."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ssplat_jax.cache.key_views import KeyViews, camera_distances, empty_key_views, keep_views, usable
from ssplat_jax.core.cameras import Camera
from ssplat_jax.core.pytree import replace
from tests.model.small import side_by_side

HEIGHT, WIDTH, SLOTS = 2, 3, 4
KEEP = jax.jit(lambda ring, arrivals: keep_views(ring, arrivals, depth=2.0))
USABLE = jax.jit(usable)


def views(places, first: int = 0) -> KeyViews:
    """Views from places on a line; the color of an image is its number."""
    viewmats = jnp.asarray(side_by_side(places), jnp.float32)
    images = np.arange(first, first + len(places), dtype=np.float32)[:, None, None, None] / 255
    camera = Camera(viewmats, jnp.tile(jnp.eye(3), (len(places), 1, 1)), width=WIDTH, height=HEIGHT)
    return KeyViews.of(camera, jnp.asarray(np.broadcast_to(images, (len(places), HEIGHT, WIDTH, 3))))


def places(ring: KeyViews) -> list[float]:
    return sorted(np.asarray(-ring.viewmats[:, 0, 3])[np.asarray(ring.valid)].round(3).tolist())


def empty() -> KeyViews:
    return empty_key_views(SLOTS, HEIGHT, WIDTH)


def test_a_full_ring_takes_views_that_lie_apart_alone():
    ring = KEEP(empty(), views([0.0, 1.0, 5.0]))
    np.testing.assert_array_equal(ring.images[:3, 0, 0, 0], [0, 1, 2])
    assert np.asarray(ring.valid).tolist() == [True, True, True, False]
    ring = KEEP(ring, views([9.0], first=3))
    for place in (5.0, 5.9, 9.5):  # nearer than any two kept ones
        again = KEEP(ring, views([place], first=9))
        assert places(again) == [0.0, 1.0, 5.0, 9.0] and int(again.images.max()) == 3
    ring = KEEP(ring, views([12.0], first=4))  # 0 and 1 are most alike; of them, 1 is nearer to the next
    assert places(ring) == [0.0, 5.0, 9.0, 12.0]
    np.testing.assert_array_equal(ring.images[1], np.full((HEIGHT, WIDTH, 3), 4))


def test_views_keep_covering_a_long_walk():
    """After 40 views along a line, every place walked is within twice the spacing of a perfect ring of 8."""
    spacing = 0.37
    ring = empty_key_views(8, HEIGHT, WIDTH)
    for first in range(0, 40, 4):
        ring = KEEP(ring, views(spacing * np.arange(first, first + 4.0)))
    kept = np.array(places(ring))
    gaps = np.abs(spacing * np.arange(40)[:, None] - kept).min(axis=1)
    assert len(kept) == 8 and gaps.max() <= 2 * spacing * 40 / 8


def test_a_single_slot_holds_the_newest_view():
    ring = empty_key_views(1, HEIGHT, WIDTH)
    for place in (0.0, 0.0, 3.0):
        ring = KEEP(ring, views([place]))
    assert places(ring) == [3.0]


@pytest.mark.parametrize("name", ["viewmats", "Ks", "exposures"])
def test_views_that_cannot_be_used_stay_out(name):
    arrival = views([3.0, 4.0, 5.0, 6.0], first=7)
    array = getattr(arrival, name)
    bad = array.at[(0,) * array.ndim].set(np.nan).at[(1,) + (0,) * (array.ndim - 1)].set(np.inf)
    arrival = replace(arrival, **{name: bad}, valid=jnp.array([True, True, False, True]))
    assert places(KEEP(empty(), arrival)) == [6.0] and USABLE(arrival).tolist() == [False, False, False, True]
    one = views([3.0])
    for unlike in ({"exposures": jnp.array([[1.0, 1.0, 0.0]])}, {"Ks": one.Ks.at[0, 0, 0].set(-1.0)}):
        assert USABLE(one).all() and not USABLE(replace(one, **unlike)).any()


def test_distances_are_moves_over_depth_plus_turns():
    turn = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]], np.float32)
    viewmats = np.tile(np.eye(4, dtype=np.float32), (3, 1, 1))
    viewmats[1, :3, :3] = turn  # the same center, a quarter turn
    viewmats[2, 2, 3] = 3.0
    got = np.asarray(camera_distances(jnp.asarray(viewmats), 2.0))
    np.testing.assert_allclose(got, [[0, 2**0.5, 1.5], [2**0.5, 0, 1.5 + 2**0.5], [1.5, 1.5 + 2**0.5, 0]], atol=1e-6)
