"""Images of the fast path and the reference against the NumPy oracle, and gradients against the reference's."""

import functools
import inspect
import re
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ssplat_jax.core.cpu_backend import short_exp
from ssplat_jax.core.errors import InputError
from ssplat_jax.core.gaussians import Gaussians, mask_gaussians
from ssplat_jax.core.pytree import replace
from ssplat_jax.rasterizer import Effects, binning, compositing, constants, effects_for, filter_3d, render
from ssplat_jax.rasterizer.binning import Grid, TileIntersections, intersect_tiles, sorted_table
from ssplat_jax.rasterizer.projection import Splats, project
from ssplat_jax.rasterizer.reference import render_reference
from ssplat_jax.rasterizer.render import TILES, round_up
from ssplat_jax.scene_files.formats import save_ply
from tests.rasterizer import oracle
from tests.rasterizer.scenes import cameras, cloud

FORWARD = 2e-5  # float32 sums of about 60 samples, depths up to 4
GRADIENT = 1e-4  # relative L2, float32 against float64
ALL = Effects(outputs=("color", "alpha", "depth", "median_depth"), background=(0.2, 0.5, 0.9))

plainly = pytest.mark.usefixtures("compiled_plainly")  # laws within a tolerance, of programs used once


def relative(a, b) -> float:
    a, b = np.asarray(a, np.float64), np.asarray(b, np.float64)
    return float(np.linalg.norm(a - b) / max(np.linalg.norm(b), 1e-12))


@pytest.fixture(scope="module")
def scene():
    return cloud(degree=3), cameras(21, 30)  # portrait, and no multiple of a tile


@pytest.mark.parametrize(
    "antialias", ["mip", *(pytest.param(name, marks=pytest.mark.slow) for name in ("classic", "none"))]
)
def test_both_paths_equal_the_numpy_oracle(scene, antialias):
    gaussians, camera = scene
    effects = ALL.replace(antialias=antialias, background=None)
    images = oracle.render(gaussians, camera.viewmats, camera.Ks, 21, 30, antialias)
    with jax.enable_x64(True):
        reference = jax.jit(lambda *inputs: render_reference(*inputs, effects=effects))
        exact = jax.tree.map(np.asarray, reference(*jax.tree.map(lambda x: x.astype(jnp.float64), scene)))
    fast = render(gaussians, camera, effects=effects)
    for name, wanted in zip(("color", "alpha", "depth", "median_depth"), images, strict=True):
        np.testing.assert_allclose(getattr(exact, name), wanted, atol=1e-10, err_msg=name)
        np.testing.assert_allclose(getattr(fast, name), wanted, atol=FORWARD, err_msg=name)


random = np.random.default_rng(3)
WEIGHTS = [random.normal(size=(2, 10, 12, *tail)) for tail in ((3,), (), (), (2,))]
SHAPES = np.repeat([[1, 1, 1], [20.0, 0.1, 0.1], [8, 8, 8]], [28, 8, 4], axis=0)  # with needles, and wide ones
STRETCHED = replace(cloud(40), scales=cloud(40).scales * SHAPES.astype(np.float32))
DIFFERENTIATED = (STRETCHED, cameras(12, 10, batch=2), jnp.asarray(random.normal(size=(40, 2)), jnp.float32))
DIRECTIONS = jax.tree.map(lambda x: random.normal(size=x.shape), DIFFERENTIATED)


def loss_of(renderer, inputs, **options):
    """A loss of all images of which neither the first derivative nor the second vanishes."""
    out = renderer(*inputs[:2], features=inputs[2], effects=Effects(background=(0.2, 0.5, 0.9)), **options)
    images = (out.color, out.alpha, out.depth, out.features)
    total = jnp.sum((out.color - 0.3) ** 2) + 0.1 * jnp.sum(out.depth**2) + jnp.sum(out.alpha**2)
    return total + sum(jnp.sum(jnp.asarray(c, x.dtype) * x) for c, x in zip(WEIGHTS, images, strict=True)), out


GRADIENT_OF_RENDER = jax.grad(functools.partial(loss_of, render, max_pairs=1 << 12), has_aux=True)
GRADIENT_OF_REFERENCE = jax.jit(jax.grad(functools.partial(loss_of, render_reference), has_aux=True))
DIFFERENTIATE = jax.jit(GRADIENT_OF_RENDER)


def exact_gradient(shift: float):
    """The gradient of the reference in float64, at `shift` times `DIRECTIONS` from the scene."""
    with jax.enable_x64(True):
        moved = jax.tree.map(lambda x, d: np.asarray(x, np.float64) + shift * d, DIFFERENTIATED, DIRECTIONS)
        return jax.tree.map(np.asarray, GRADIENT_OF_REFERENCE(jax.tree.map(jnp.asarray, moved))[0])


def test_gradients_equal_the_reference_in_float64():
    got, wanted = DIFFERENTIATE(DIFFERENTIATED)[0], exact_gradient(0.0)
    for (path, a), b in zip(jax.tree_util.tree_leaves_with_path(got), jax.tree.leaves(wanted), strict=True):
        assert relative(a, b) < GRADIENT, (jax.tree_util.keystr(path), relative(a, b))
        assert np.vdot(a, b) / np.linalg.norm(a) / np.linalg.norm(b) > 0.99999, jax.tree_util.keystr(path)


@plainly
def test_second_derivatives_equal_the_reference_in_float64():
    """The product of the Hessian with a vector, in float32, against central differences of the reference's gradient."""
    directions = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), DIRECTIONS)
    got = jax.jit(lambda x, d: jax.jvp(lambda x: GRADIENT_OF_RENDER(x)[0], (x,), (d,))[1])(DIFFERENTIATED, directions)
    ahead, behind = exact_gradient(1e-6), exact_gradient(-1e-6)
    wanted = jax.tree.map(lambda a, b: (a - b) / 2e-6, ahead, behind)
    for (path, a), b in zip(jax.tree_util.tree_leaves_with_path(got), jax.tree.leaves(wanted), strict=True):
        assert np.linalg.norm(b) > 0 and relative(a, b) < 1e-3, jax.tree_util.keystr(path)


def test_a_negative_focal_length_mirrors_the_image(scene):
    """The Gaussians are large, so their shape shows where the Jacobian is taken."""
    gaussians, camera = cloud(20, size=0.3), scene[1]
    K = np.array(camera.Ks)
    K[1, 1], K[1, 2] = -K[1, 1], 30 - K[1, 2]
    mirrored = replace(camera, Ks=jnp.asarray(K))
    color, flipped = (np.asarray(render(gaussians, c).color) for c in (camera, mirrored))
    np.testing.assert_allclose(flipped[::-1], color, atol=FORWARD)
    wanted = oracle.render(gaussians, mirrored.viewmats, mirrored.Ks, 21, 30)[0]
    np.testing.assert_allclose(flipped, wanted, atol=FORWARD)


def test_an_image_does_not_depend_on_the_unit_of_the_scene():
    """Captures come in millimeters, in kilometers, and in units of their own."""
    gaussians, camera = cloud(30, degree=1), cameras(21, 30)
    draw = jax.jit(lambda g, c: render(g, c, captured=c, max_pairs=1 << 12))
    wanted = draw(gaussians, camera)
    for unit in (1e-6, 1e-3, 1e3, 1e5):
        viewmats = camera.viewmats.at[:3, 3].multiply(unit)
        scene = replace(gaussians, means=unit * gaussians.means, scales=unit * gaussians.scales)
        out = draw(scene, replace(camera, viewmats=viewmats))
        np.testing.assert_allclose(out.color, wanted.color, atol=1e-4)
        np.testing.assert_allclose(out.depth, unit * wanted.depth, atol=1e-3 * unit)


def test_overflow_is_counted_inside_jit_and_retried_outside(scene):
    wanted = render(*scene)
    assert int(wanted.num_overflow) == 0
    retried = render(*scene, max_pairs=64)
    np.testing.assert_array_equal(retried.color, wanted.color)
    assert int(retried.num_overflow) == 0
    inside = jax.jit(lambda g: render(g, scene[1], max_pairs=64))(scene[0])
    assert int(inside.num_overflow) == int(wanted.num_pairs) - 64 > 0


@plainly
def test_images_and_gradients_are_those_of_any_side_of_a_tile():
    scene, camera = cloud(), cameras(21, 30)  # no multiple of a tile

    def drawn(gaussians, tile):
        out = render(gaussians, camera, effects=ALL, max_pairs=1 << 12, tile=tile)
        images = jnp.concatenate([out.color, out.alpha[..., None], out.depth[..., None]], axis=-1)
        return jnp.sum(images**2), (images, out.median_depth, out.num_overflow)

    found = {t: jax.jit(jax.value_and_grad(drawn, has_aux=True), static_argnums=1)(scene, t) for t in TILES}
    (_, (images, median, _)), gradient = found[8]
    assert float(jnp.abs(images).max()) > 0.5
    for (_, (other, other_median, overflow)), other_gradient in found.values():
        assert int(overflow) == 0
        np.testing.assert_allclose(other, images, atol=2e-5)
        np.testing.assert_allclose(other_median, median, atol=2e-5)
        for a, b in zip(jax.tree.leaves(other_gradient), jax.tree.leaves(gradient), strict=True):
            assert np.linalg.norm(a - b) < 1e-4 * np.linalg.norm(b)


@plainly
@pytest.mark.parametrize("transform", [jax.checkpoint, jax.vmap], ids=["checkpoint", "vmap"])
def test_a_transform_that_hides_the_number_of_pairs_says_if_its_guess_was_too_low(transform, recwarn):
    """Large Gaussians, of more than four tiles each; 4,096 pairs are the least that is guessed."""
    gaussians, camera = cloud(600, size=0.2), cameras(80, 96)
    counted = int(render(gaussians, camera).num_pairs)
    assert counted > round_up(4 * gaussians.num_gaussians)
    batch = jax.tree.map(lambda x: x[None], gaussians) if transform is jax.vmap else gaussians
    warnings.simplefilter("always")
    jax.block_until_ready(transform(lambda g: render(g, camera).color)(batch))
    jax.effects_barrier()
    (said,) = {str(w.message) for w in recwarn}
    assert f"max_pairs={1 << (counted - 1).bit_length()}" in said


def test_the_guess_inside_jit_holds_four_tiles_of_every_gaussian():
    gaussians, camera = cloud(3000, size=0.03), cameras(80, 96)
    counted = int(render(gaussians, camera).num_pairs)
    assert round_up(gaussians.num_gaussians) < counted <= 4 * gaussians.num_gaussians
    assert int(jax.jit(lambda g: render(g, camera).num_overflow)(gaussians)) == 0


@plainly
@pytest.mark.slow  # the retry is tested forward in every run
def test_gradients_outside_jit_include_every_pair():
    # Larger Gaussians than the default capacity inside jit is made for: more than four tiles each.
    gaussians, camera = cloud(600, size=0.2), cameras(80, 96)
    counted = int(render(gaussians, camera).num_pairs)
    assert counted > round_up(4 * gaussians.num_gaussians)
    loss = lambda g, **options: jnp.sum(render(g, camera, **options).color ** 2)  # noqa: E731
    value, gradient = jax.value_and_grad(loss)(gaussians)
    wanted_value, wanted = jax.jit(jax.value_and_grad(functools.partial(loss, max_pairs=counted)))(gaussians)
    np.testing.assert_allclose(value, wanted_value, rtol=1e-6)
    for a, b in zip(jax.tree.leaves(gradient), jax.tree.leaves(wanted), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-5 * float(jnp.abs(b).max()))


@plainly
def test_short_exp_is_the_exponential():
    low = constants.LOG_ALPHA_MIN
    powers = np.linspace(low, 0.0, 1_000_001)
    for dtype, allowed in ((jnp.float32, 3e-6), (jnp.float64, 1e-15)):
        with jax.enable_x64(dtype == jnp.float64):
            given = jnp.asarray(powers, dtype)
            alphas = np.asarray(jax.jit(lambda x: short_exp(x, low))(given), np.float64)
            np.testing.assert_allclose(alphas, np.exp(np.asarray(given, np.float64)), rtol=allowed, atol=0)
            assert short_exp(jnp.array([-jnp.inf], dtype), low)[0] == 0
            capped = short_exp(jnp.array([compositing.LOG_ALPHA_MAX], dtype), low)[0]
            assert compositing.CAPPED_ALPHA <= capped < 1.0


def test_a_non_finite_camera_sees_nothing_and_harms_no_other():
    gaussians, camera, features = DIFFERENTIATED
    wanted = DIFFERENTIATE(DIFFERENTIATED)[1].color[0]
    for field, entry in (("viewmats", jnp.nan), ("Ks", jnp.inf), ("Ks", 0.0)):
        bad = replace(camera, **{field: getattr(camera, field).at[1, 0, 0].set(entry)})
        gradients, out = DIFFERENTIATE((gaussians, bad, features))
        assert not out.alpha[1].any() and int(out.num_non_finite) == gaussians.num_gaussians
        np.testing.assert_array_equal(out.color[0], wanted)
        for gradient in jax.tree.leaves(gradients):
            assert np.isfinite(gradient).all()


def test_rows_with_non_finite_features_are_culled_and_counted(scene):
    out = render(*scene, features=jnp.ones((60, 2)).at[3, 1].set(jnp.nan), max_pairs=1 << 12)
    without = mask_gaussians(scene[0], jnp.arange(60) != 3)
    assert int(out.num_non_finite) == 1 and np.isfinite(out.features).all()
    np.testing.assert_array_equal(out.color, render(without, scene[1], max_pairs=1 << 12).color)


@pytest.mark.parametrize("field", ["opacities", "scales"])
def test_raw_values_of_files_are_told_from_activated_ones(scene, field, tmp_path):
    """Logits of opacities and logarithms of scales have the shapes of what they stand for."""
    gaussians, camera = scene
    raw = {"opacities": jnp.linspace(-4.0, 6.0, 60), "scales": jnp.log(gaussians.scales)}
    spoiled = replace(gaussians, **{field: raw[field]})
    for use in (lambda: render(spoiled, camera), lambda: save_ply(tmp_path / "a.ply", spoiled)):
        with pytest.raises(InputError, match=f"{field}: wanted activated values"):
            use()


@pytest.mark.parametrize("dtype", [jnp.uint8, jnp.float32])
def test_colors_of_0_to_255_are_refused(scene, dtype):
    fields = {name: getattr(scene[0], name) for name in ("means", "quats", "scales", "opacities")}
    with pytest.raises(InputError, match="divide bytes by 255"):
        inspect.unwrap(Gaussians.from_rgb)(**fields, colors=jnp.full((60, 3), 128, dtype))


K, VIEW = np.asarray(cameras(21, 30).Ks), np.asarray(cameras(21, 30).viewmats)
SPOILED = {
    "skew": {"Ks": K + 2 * np.eye(3, k=1) * [0, 1, 0]},
    "a shear of rows": {"Ks": K + 2 * np.eye(3, k=-1) * [1, 0, 0]},
    "twice the matrix": {"Ks": 2 * K},
    "camera to world, transposed": {"viewmats": VIEW.T},
    "a scale in the pose": {"viewmats": np.diag([3.0, 3.0, 3.0, 1.0]) @ VIEW},
}


@pytest.mark.parametrize("name", SPOILED)
def test_cameras_that_would_be_drawn_otherwise_are_refused(scene, name):
    """Intrinsics with skew, or not divided by K[2, 2], and poses that are none, wherever a camera enters."""
    gaussians, camera = scene
    fields = {field: jnp.asarray(value, jnp.float32) for field, value in SPOILED[name].items()}
    spoiled = replace(camera, **fields)
    (field,) = SPOILED[name]
    for use in (
        lambda: render(gaussians, spoiled),
        lambda: render(gaussians, camera, captured=spoiled),
        lambda: jax.grad(lambda g: render(g, spoiled).color.sum())(gaussians),
        lambda: render_reference(gaussians, spoiled),
        lambda: effects_for(gaussians, spoiled),
        lambda: filter_3d(gaussians, spoiled),
    ):
        with pytest.raises(InputError, match=rf"{field}: wanted \["):
            use()


@plainly
def test_a_scene_of_no_gaussians_is_black(scene):
    out = render(jax.tree.map(lambda x: x[:0], scene[0]), scene[1])
    assert not out.color.any() and not out.alpha.any() and int(out.num_pairs) == 0


@plainly
def test_arrays_closed_over_by_a_traced_function_are_rendered(scene):
    wanted = render(*scene).color
    inside = jax.jit(lambda factor: factor * render(*scene).color)
    np.testing.assert_allclose(inside(jnp.float32(2.0)), 2 * wanted, atol=1e-6)


def test_pairs_that_exceed_an_index_are_counted_and_refused():
    # 20,000 Gaussians before each of the 129,600 tiles of a 4k image: 2.6e9 pairs, negative in 32 bits.
    flat = cloud(1, size=1e3)
    wall = jax.tree.map(lambda x: jnp.broadcast_to(x, (20_000, *x.shape[1:])), replace(flat, opacities=jnp.ones(1)))
    camera = cameras(3840, 2160)
    with pytest.raises(InputError, match="at most 1073741824"):
        render(wall, camera)
    with jax.enable_x64(False):
        grid = Grid(num_images=1, height=2160, width=3840, tile=8)
        one_axis = replace(camera, viewmats=camera.viewmats[None], Ks=camera.Ks[None])
        pairs = pairs_of(jax.jit(lambda: project(wall, one_axis, Effects()))(), grid, 1 << 12)
    assert int(pairs.num_pairs) == 2**31 - 1


@functools.partial(jax.jit, static_argnums=(1, 2))
def pairs_of(splats: Splats, grid: Grid, capacity: int) -> TileIntersections:
    """The tile intersections of splats without channels."""
    table, order = sorted_table(splats, jnp.zeros((*splats.depths.shape, 0)), grid)
    return intersect_tiles(table, order // splats.depths.shape[1], grid, capacity)


def test_intersections_depend_neither_on_the_capacity_nor_on_the_pieces_that_are_sorted(monkeypatch):
    """From a capacity of 65,536 on, the smallest share that holds the pairs is sorted: every share is chosen here.

    There are several images, equal depths, a capacity that the pieces do not divide, and one too small.
    """
    camera, grid = cameras(90, 130, batch=3), Grid(num_images=3, height=130, width=90, tile=8)
    twice = jax.tree.map(lambda x: jnp.concatenate([x, x[::-1]]), cloud(2000, degree=0, size=0.2))
    project_shown = jax.jit(lambda shown: project(mask_gaussians(twice, shown), camera, Effects()))
    capacity, everything = (1 << 16) + 11, jnp.ones(4000, bool)
    total = int(pairs_of(project_shown(everything), grid, 2 * capacity).num_pairs)
    shares = (0.5, 0.58, 0.68, 0.8, 0.95)
    parts = [project_shown(jnp.arange(4000) < int(4000 * share * capacity / total)) for share in shares]
    parts.append(project_shown(everything))
    assert total > capacity
    found = {}
    for pieces, room in ((1, 2 * capacity), (16, capacity)):
        monkeypatch.setattr(binning, "SORT_PIECES", pieces)
        pairs_of.clear_cache()
        found[pieces] = [pairs_of(part, grid, room) for part in parts[:-1]]
        found[pieces].append(pairs_of(parts[-1], grid, capacity))
    chosen = {np.searchsorted(np.array([17, 20, 24, 28, 32]) / 32, int(x.num_pairs) / capacity) for x in found[1][:-1]}
    assert chosen == {0, 1, 2, 3, 4}
    for wanted, got in zip(*found.values(), strict=True):
        held = int(wanted.bounds[-1])
        assert int(got.num_pairs) == int(wanted.num_pairs) and held > capacity / 8
        np.testing.assert_array_equal(got.bounds, wanted.bounds)
        np.testing.assert_array_equal(got.rows[:held], wanted.rows[:held])


def test_the_schedule_of_an_accelerator_agrees(monkeypatch):
    """In sizes that no other test has, since what is traced is kept; two of the accelerator's steps for each tile."""
    gaussians, camera = cloud(200, degree=1, size=0.3), cameras(26, 35, batch=2)

    @functools.partial(jax.jit, static_argnums=1)
    def results(gaussians, max_pairs):
        def loss(gaussians):
            out = render(gaussians, camera, effects=ALL, max_pairs=max_pairs)
            return jnp.sum((out.color - 0.3) ** 2) + jnp.sum(out.depth), out

        return jax.value_and_grad(loss, has_aux=True)(gaussians)

    (_, wanted), wanted_gradients = results(gaussians, 1 << 13)
    monkeypatch.setattr(compositing, "ON_CPU", compositing.ON_ACCELERATOR)
    (_, got), gradients = results(gaussians, 3 << 12)
    num_tiles = 2 * -(-26 // 8) * -(-35 // 8)
    assert compositing.ON_ACCELERATOR.step_size < int(wanted.num_pairs) / num_tiles
    np.testing.assert_array_equal(got.median_depth, wanted.median_depth)
    for name in ("color", "alpha", "depth"):
        np.testing.assert_allclose(getattr(got, name), getattr(wanted, name), atol=FORWARD, err_msg=name)
    for a, b in zip(jax.tree.leaves(gradients), jax.tree.leaves(wanted_gradients), strict=True):
        assert np.linalg.norm(b) > 0 and relative(a, b) < 1e-5


def test_programs_for_a_gpu_do_not_branch(monkeypatch):
    """A GPU asks the host at every branch; the loop over Gaussians would have three of them."""
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    scene = cloud(50), cameras(13, 11)  # sizes of no other test, since what is traced is kept
    traced = jax.jit(lambda g, c: render(g, c, max_pairs=1 << 12)).trace(*scene)
    assert num_branches(traced.lower(lowering_platforms=("cpu",)).as_text()) > 3
    assert num_branches(traced.lower(lowering_platforms=("cuda",)).as_text()) == 0


def num_branches(program: str) -> int:
    """Branches on a value that only the running program knows; the choice of a platform is on a constant."""
    branches = re.finditer(r'"stablehlo.case"\((%\w+)\)', program)
    conditions = [program[: branch.start()].rpartition(f"{branch[1]} = ")[2] for branch in branches]
    return sum(condition.startswith("stablehlo.convert") for condition in conditions)


# Last: it empties the caches of compiled programs.
@pytest.mark.slow  # nothing compiled before it serves after it
def test_keys_wider_than_32_bits_sort_alike(scene, monkeypatch):
    jax.clear_caches()  # both are compiled here, alike
    wanted = render(*scene, max_pairs=1 << 12)
    monkeypatch.setattr(binning, "KEY_BITS", 4)
    jax.clear_caches()
    np.testing.assert_array_equal(render(*scene, max_pairs=1 << 12).color, wanted.color)
    jax.clear_caches()
