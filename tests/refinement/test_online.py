"""Laws of refinement while streaming, on a painted wall whose tokens have the wrong colors."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ssplat_jax.cache.changes import no_change, unpack
from ssplat_jax.cache.fuse import fuse
from ssplat_jax.cache.hash_table import voxel_indices
from ssplat_jax.cache.key_views import KeyViews
from ssplat_jax.cache.state import Tokens, init_cache, with_refinement
from ssplat_jax.config import StreamConfig
from ssplat_jax.core.chunk import Chunk
from ssplat_jax.core.errors import InputError
from ssplat_jax.core.gaussians import SH_C0
from ssplat_jax.core.pytree import replace
from ssplat_jax.evaluation.metrics import psnr
from ssplat_jax.model.network import init_params
from ssplat_jax.model.streamsplat import ChunkOutput, StreamSplat
from ssplat_jax.rasterizer import render
from ssplat_jax.refinement import online
from ssplat_jax.storage.saved_states import load_state, save_state
from ssplat_jax.streaming.session import Session
from tests.cache.streams import tokens_at
from tests.model.small import chunk_of, side_by_side
from tests.rasterizer.scenes import balls
from tests.streaming.narrow_model import assert_same_bits

pytestmark = pytest.mark.usefixtures("compiled_plainly")

WIDE, HIGH, FOCAL, DEPTH = 32, 24, 24.0, 2.0
CONFIG = StreamConfig().replace(
    token_width=4, capacity=128, min_confidence=0.3, steps_per_chunk=3, overflow="drop_new", voxel_size=0.3
)
MODEL = StreamSplat(CONFIG)
SHIFTS = (0.0, 0.1, -0.1, 0.2)


@pytest.fixture(autouse=True)
def four_key_views(monkeypatch):
    monkeypatch.setattr("ssplat_jax.cache.state.NUM_KEY_VIEWS", 4)


@functools.cache
def params() -> dict:
    return init_params(jax.random.key(0), CONFIG, only=("decoder", "evidence"))


def wall_colors(points: np.ndarray) -> np.ndarray:
    """Paint of the wall at x and y."""
    x, y = points[..., 0], points[..., 1]
    return np.stack([0.5 + 0.3 * np.sin(3 * x), 0.5 + 0.3 * np.cos(2 * y), 0.5 + 0.2 * np.sin(x + y)], axis=-1)


def chunk(shifts=SHIFTS) -> Chunk:
    """Views of the wall z = DEPTH from cameras side by side that look along +z."""
    columns, rows = np.meshgrid(np.arange(WIDE) + 0.5, np.arange(HIGH) + 0.5)
    points = np.stack([(columns - WIDE / 2) / FOCAL * DEPTH, (rows - HIGH / 2) / FOCAL * DEPTH], axis=-1)
    images = [wall_colors(points + np.array([shift, 0.0])) for shift in shifts]
    K = [[FOCAL, 0, WIDE / 2], [0, FOCAL, HIGH / 2], [0, 0, 1]]
    return chunk_of(np.stack(images), side_by_side(shifts), K, near=1.0, far=4.0)


def summary(exposures=None) -> ChunkOutput:
    cells = jnp.zeros((4, HIGH // 4, WIDE // 4))
    return ChunkOutput(cells, cells, cells, jnp.ones((4, 3)) if exposures is None else exposures)


def tokens(seed: int = 0, behind: bool = False) -> Tokens:
    """A token for every cell of the first view, on the wall, with colors that are wrong by about 0.15."""
    rng = np.random.default_rng(seed)
    columns, rows = np.meshgrid(np.arange(2, WIDE, 4), np.arange(2, HIGH, 4))
    x, y = (columns.reshape(-1) - WIDE / 2) / FOCAL * DEPTH, (rows.reshape(-1) - HIGH / 2) / FOCAL * DEPTH
    z = np.full(len(x), -DEPTH if behind else DEPTH)
    means = np.stack([x, y, z], axis=-1) + rng.normal(size=(len(x), 3)) * 0.01
    rgbs = np.repeat(wall_colors(means)[:, None], CONFIG.head.gaussians_per_token, axis=1)
    rgbs = jnp.asarray(rgbs + 0.15 * rng.normal(size=rgbs.shape), jnp.float32).reshape(len(x), -1)
    feats, footprints = rng.normal(size=(len(x), 4)), jnp.full(len(x), 4 * DEPTH / FOCAL)
    return tokens_at(means, 0.9, feats, rgbs=rgbs, footprints=footprints)


FUSE = jax.jit(fuse, static_argnums=2)
_REVISE = jax.jit(functools.partial(online.refine_scene, MODEL))
DECODE = jax.jit(MODEL.decode)
_EMPTY = jax.jit(lambda: init_cache(CONFIG))
_WITH_REFINEMENT = jax.jit(lambda cache: with_refinement(cache, CONFIG, HIGH, WIDE))
_CELLS = jax.jit(lambda cache: voxel_indices(cache.means, cache.footprints, CONFIG)[0])
_CHANGE = jax.jit(lambda cache: unpack(cache.changes.reshape(-1, cache.changes.shape[-1])))


def revise(cache, chunk, output):
    return _REVISE(params(), cache, chunk, output)


def start(*more: Tokens):
    """A cache after one chunk's tokens, before its first refinement."""
    cache = _EMPTY()
    for part in (tokens(), *more):
        cache = FUSE(cache, part, CONFIG)
    return _WITH_REFINEMENT(cache)


def score(cache) -> float:
    """PSNR of a view that no chunk has shown."""
    view = chunk((0.05,))
    color = render(DECODE(params(), cache), view.camera, max_pairs=1 << 12).color
    return psnr(np.clip(np.asarray(color[0]), 0, 1), np.asarray(view.images[0]))


def test_views_never_shown_gain():
    before = start()
    after = revise(before, chunk(), summary())
    assert score(after) > score(before) + 1.0 and score(revise(after, chunk(), summary())) > score(after)


def test_only_places_changes_and_key_views_differ():
    before = start()
    after = revise(before, chunk(), summary())
    # The first chunk wrote every pivot: last_chunks is 0 already.
    assert_same_bits(replace(after, means=before.means, changes=before.changes, key_views=before.key_views), before)
    for name in ("means", "changes", "key_views"):
        pairs = zip(jax.tree.leaves(getattr(after, name)), jax.tree.leaves(getattr(before, name)), strict=True)
        assert any(np.any(new != old) for new, old in pairs), name
    np.testing.assert_array_equal(_CELLS(after), _CELLS(before))


def test_pivots_that_no_key_view_sees_keep_every_bit():
    before = start(tokens(3, behind=True))
    after = revise(before, chunk(), summary())
    is_behind = np.asarray(before.means[..., 2] < 0)
    for name in ("means", "changes", "last_chunks"):
        np.testing.assert_array_equal(*(np.asarray(getattr(cache, name))[is_behind] for cache in (after, before)))
    is_seen = np.asarray(after.alive) & ~is_behind
    assert np.asarray(after.changes)[is_seen].any(axis=-1).mean() > 0.9
    assert (np.asarray(after.last_chunks)[is_seen] == 1).mean() > 0.9
    assert not np.asarray(before.last_chunks)[is_seen].any()


def test_a_saved_stream_continues_to_the_same_bytes(tmp_path):
    once = revise(start(), chunk(), summary())
    save_state(tmp_path / "state.npz", once, {})
    loaded, _ = load_state(tmp_path / "state.npz")
    assert_same_bits(loaded, once)
    going_on = lambda cache: revise(FUSE(cache, tokens(5), CONFIG), chunk((0.3, 0.4, 0.5, 0.6)), summary())  # noqa: E731
    assert_same_bits(going_on(loaded), going_on(once))


ADVERSARIES = {
    "black": (replace(chunk(), images=jnp.zeros((4, HIGH, WIDE, 3))), summary()),
    "unknown exposure": (chunk(), summary(jnp.full((4, 3), jnp.nan).at[1:].set(1.0))),
    "duplicates": (chunk((0.0, 0.0, 0.0, 0.0)), summary()),
    "one view": (replace(chunk(), valid=jnp.arange(4) == 0), summary()),
    "poses that are not finite": (replace(chunk(), viewmats=chunk().viewmats.at[2].set(jnp.nan)), summary()),
}


@pytest.mark.parametrize("name", ADVERSARIES)
def test_any_key_views_leave_a_finite_bounded_scene(name):
    before = cache = start()
    for _ in range(4):
        cache = revise(cache, *ADVERSARIES[name])
    assert all(np.isfinite(x).all() for x in jax.tree.leaves((DECODE(params(), cache), cache.means, cache.changes)))
    np.testing.assert_array_equal(_CELLS(cache), _CELLS(before))
    change = jax.tree.map(np.asarray, _CHANGE(cache))
    assert np.abs(change.means).max() <= CONFIG.memory.voxel_size
    assert np.abs(change.log_scales).max() <= 1.5 and SH_C0 * np.abs(change.sh).max() <= 2.0001
    if name != "black":
        assert score(cache) > score(before) - 0.3


def places_of_round(ring, arrivals, num_chunks: int, num: int) -> list[float]:
    chosen = jax.jit(online.views_of_round, static_argnums=3)(ring, arrivals, jnp.int32(num_chunks), num)
    return [round(-float(x), 2) for x, valid in zip(chosen.viewmats[:, 0, 3], chosen.valid, strict=True) if valid]


def test_rounds_take_all_kept_views_about_equally_often():
    ring = with_key_views(start())
    new = (1.0, 1.1, 1.2, 1.3)
    arrivals = KeyViews.of(chunk(new).camera, chunk(new).images)
    rounds = [places_of_round(ring, arrivals, i, 3) for i in range(100)]
    taken = [place for places in rounds for place in places]
    assert all(len(set(places)) > 1 for places in rounds)
    assert {place: round(taken.count(place) / 75, 1) for place in set(taken)} == dict.fromkeys(map(float, SHIFTS), 1.0)
    unusable = replace(ring, exposures=ring.exposures.at[1].set(jnp.nan))
    taken = [place for i in range(20) for place in places_of_round(unusable, arrivals, i, 3)]
    assert set(taken) == set(SHIFTS) - {SHIFTS[1]}


def test_the_first_round_takes_the_new_views():
    ring = with_key_views(start())
    arrivals = KeyViews.of(chunk().camera, chunk().images)
    none_kept, none_new = (replace(views, valid=jnp.zeros(4, bool)) for views in (ring, arrivals))
    assert set(places_of_round(none_kept, arrivals, 0, 6)) == set(map(float, SHIFTS))
    assert places_of_round(none_kept, none_new, 0, 6) == []


def test_the_least_covered_pivots_are_taken_where_there_is_space_for_few(monkeypatch):
    """The right half of the wall is far away; behind the near left half there is another, nearer than the right one."""
    front, is_left = tokens(), np.asarray(tokens().means[:, :1] < 0)
    front = replace(front, means=jnp.where(is_left, front.means, 2 * front.means))
    hidden = replace(tokens(4), means=tokens(4).means * 1.15, valid=jnp.asarray(is_left[:, 0]))
    cache = _EMPTY()
    for part in (front, hidden, tokens(3, behind=True)):
        cache = FUSE(cache, part, CONFIG)
    cache = _WITH_REFINEMENT(cache)
    views = with_key_views(cache)
    view, invalid = (jax.tree.map(lambda x: x[0], v) for v in (views, replace(views, valid=jnp.zeros(4, bool))))
    depths, alive = np.asarray(cache.means.reshape(-1, 3)[:, 2]), np.asarray(cache.alive.reshape(-1))
    in_sight = alive & (depths > 0)
    is_hidden = in_sight & (depths > 1.07 * DEPTH) & (depths < 1.5 * DEPTH)
    num_visible = int((in_sight & ~is_hidden).sum())

    def visible(*views):
        program = jax.jit(lambda view: online.visible_pivots(cache, view, CONFIG))
        return [np.asarray(program(view)) for view in views]

    (many,) = visible(view)
    monkeypatch.setattr("ssplat_jax.refinement.online.PIVOTS_PER_CELL", 1)
    pivots, none = visible(view, invalid)
    assert is_hidden.sum() > 15 and 40 < num_visible <= len(pivots) == 48
    assert np.isin(np.flatnonzero(in_sight & ~is_hidden), pivots).mean() > 0.95
    assert sorted(many[many >= 0].tolist()) == np.flatnonzero(in_sight).tolist() and (many == -1).any()
    assert (none == -1).all()


def test_areas_before_equal_sums_in_numpy():
    random = np.random.default_rng(0)
    cells, depths, areas = random.integers(0, 7, 300), random.uniform(0.1, 50, 300), random.uniform(0, 1, 300)
    wanted = [areas[(cells == cell) & (depths < depth)].sum() for cell, depth in zip(cells, depths, strict=True)]
    single = lambda x: jnp.asarray(x, jnp.float32)  # noqa: E731
    got = online.areas_before(jnp.asarray(cells, jnp.int32), single(depths), single(areas), 7)
    np.testing.assert_allclose(got, wanted, atol=3e-5)


def with_key_views(cache):
    """The key views of a cache after one round."""
    views = revise(cache, chunk(), summary()).key_views
    assert views is not None
    return views


def test_a_session_refuses_half_of_a_request():
    for model, refine in (
        (MODEL, None),
        (StreamSplat(CONFIG.replace(steps_per_chunk=0)), online.online_refinement(MODEL)),
    ):
        with pytest.raises(InputError, match="online_refinement"):
            Session(model, params(), refine=refine).feed(chunk())
    assert online.online_refinement(StreamSplat(CONFIG.replace(steps_per_chunk=0))) is None


def test_a_gaussian_follows_the_mean_of_its_views():
    """Two photographs of one place disagree: the color stays near their mean, whichever was shown last."""
    base = balls([[0.0, 0.0, 2.0]], 4.0, 0.98, 0.3)
    images = jnp.stack([jnp.full((HIGH, WIDE, 3), value) for value in (0.3, 0.7)])
    views = KeyViews.of(chunk((0.0, 0.0)).camera, images)
    zeros = no_change(base)

    def step(change, view):
        change = replace(zeros, sh=online.online_step(base, change, views.at(view), max_pairs=4096).sh)  # colors alone
        return change, SH_C0 * change.sh[0, 0, 0]

    colors = 0.3 + np.asarray(jax.lax.scan(step, zeros, jnp.arange(120) % 2)[1])
    settled = colors[-20:]
    assert abs(settled.mean() - 0.5) < 0.03
    assert np.abs(settled - settled.mean()).max() < 0.03


def test_a_chunk_of_padding_changes_nothing():
    """Its round would belong to the chunk before, whose delta is out already."""
    cache = revise(start(), chunk(), summary())
    assert jnp.any(cache.key_views.valid) and jnp.any(cache.changes != 0)
    assert_same_bits(revise(cache, replace(chunk(), valid=jnp.zeros(4, bool)), summary()), cache)
