"""Views, depth candidates and sources; inputs, positions and Gaussians of tokens."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ssplat_jax.core.cameras import pixel_grid, transform_points
from ssplat_jax.core.chunk import check_chunk
from ssplat_jax.core.errors import InputError
from ssplat_jax.core.gaussians import SH_C0
from ssplat_jax.core.pytree import replace
from ssplat_jax.core.rotations import matrices_to_quats, quats_to_matrices
from ssplat_jax.model import decoder
from ssplat_jax.model.compact import START_OPACITY, CompactFeatures, Encoder, read_shapes, regress_tokens
from ssplat_jax.model.layers import sine_positions
from ssplat_jax.model.network import init_params
from ssplat_jax.model.views import (
    GRID_STRIDE,
    AnchoredDepth,
    DepthDistribution,
    TokenShapes,
    back_project,
    nearest_sources,
    patch_colors,
    prepare_views,
)
from tests.model.small import CONFIG, HEIGHT, MODEL, WIDTH, chunk, params, random_params, side_by_side

FLOAT32 = 1e-5
prepared = jax.jit(lambda chunk: prepare_views(chunk, CONFIG))
BACK_PROJECT, SOURCES = jax.jit(back_project), jax.jit(nearest_sources, static_argnums=2)


def test_padding_keeps_the_image_and_marks_inside_cells():
    views = prepared(chunk())
    np.testing.assert_array_equal(views.images[:, :HEIGHT, :WIDTH], chunk().images)
    np.testing.assert_array_equal(views.images[:, HEIGHT:, :WIDTH], np.repeat(chunk().images[:, -1:], 32 - HEIGHT, 1))
    np.testing.assert_array_equal(views.Ks, chunk().Ks)
    centers = np.asarray(pixel_grid(32, 32, GRID_STRIDE))
    wanted = (centers[..., 0] < WIDTH) & (centers[..., 1] < HEIGHT)
    np.testing.assert_array_equal(views.inside, np.broadcast_to(wanted, (3, 8, 8)))
    assert wanted.sum() == 6 * 7  # the centers of the seventh column, x = 26, lie in the image, x = 30 does not


def of_view(name: str, *place: int, to: float):
    """A change of one entry of view 1."""
    return lambda c: replace(c, **{name: getattr(c, name).at[(1, *place)].set(to)})


UNUSABLE_VIEWS = {
    "a focal length below 0": of_view("Ks", 0, 0, to=-28.0),
    "both focal lengths below 0": lambda c: replace(c, Ks=c.Ks.at[1, :2, :2].multiply(-1.0)),
    "a focal length of 0": of_view("Ks", 1, 1, to=0.0),
    "a NaN focal length": of_view("Ks", 0, 0, to=np.nan),
    "skew": of_view("Ks", 0, 1, to=2.0),
    "a last row of 0 0 2": of_view("Ks", 2, 2, to=2.0),
    "a NaN pose": of_view("viewmats", 0, 3, to=np.nan),
    "a mirrored pose": of_view("viewmats", 0, 0, to=-1.0),
    "a scaled pose": lambda c: replace(c, viewmats=c.viewmats.at[1, :3].multiply(2.0)),
    "a NaN pixel": of_view("images", 3, 4, 0, to=np.nan),
    "an infinite pixel": of_view("images", 3, 4, 0, to=np.inf),
    "colors up to 255": lambda c: replace(c, images=c.images.at[1].multiply(255.0)),
    "colors below 0": of_view("images", 3, 4, 0, to=-1.0),
}
UNUSABLE_RANGES = {"near": [0.0, -1.0, np.nan, 9.0], "far": [np.inf, np.nan, -1.0]}


@jax.jit
def gradients_of_views(chunk):
    """By images, poses and intrinsics."""

    def total(images, viewmats, Ks):
        views = prepare_views(replace(chunk, images=images, viewmats=viewmats, Ks=Ks), CONFIG)
        return sum(jnp.sum(jnp.sin(x)) for x in (views.images, views.viewmats, views.Ks))

    return jax.grad(total, argnums=(0, 1, 2))(chunk.images, chunk.viewmats, chunk.Ks)


@pytest.mark.parametrize("name", UNUSABLE_VIEWS)
def test_a_view_that_cannot_be_used_is_refused_and_inside_jit_padding(name):
    """All that the network reads of a chunk are its prepared views."""
    spoiled, padded = UNUSABLE_VIEWS[name](chunk()), replace(chunk(), valid=jnp.array([True, False, True]))
    got, wanted = prepared(spoiled), prepared(padded)
    assert got.unusable.tolist() == [False, True, False] and not wanted.unusable.any()
    jax.tree.map(np.testing.assert_array_equal, replace(got, unusable=wanted.unusable), wanted)
    for gradient in gradients_of_views(spoiled):
        assert np.isfinite(gradient).all() and not gradient[1].any() and gradient[0].any()
    with pytest.raises(InputError, match="chunk"):
        check_chunk(spoiled, 3)
    check_chunk(replace(spoiled, valid=padded.valid), 3)  # padding may hold anything


@pytest.mark.parametrize(("name", "value"), [(name, x) for name, values in UNUSABLE_RANGES.items() for x in values])
def test_without_a_range_of_depths_a_chunk_is_refused_and_inside_jit_padding(name, value):
    spoiled = replace(chunk(), **{name: jnp.float32(value)})
    got = prepared(spoiled)
    assert got.unusable.all() and not got.valid.any() and np.isfinite(got.log_candidates).all()
    with pytest.raises(InputError, match="near and far"):
        check_chunk(spoiled, 3)


def wrong(tree, **leaves):
    """`tree` with other leaves, past the checks of a construction by hand."""
    paths, form = jax.tree_util.tree_flatten_with_path(tree)
    return jax.tree.unflatten(form, [leaves.get(path[-1].name, leaf) for path, leaf in paths])


def test_a_step_and_a_run_refuse_chunks_of_other_shapes():
    """By one error that names the array, as users get it: without the tests' own type checks."""
    one = replace(chunk(), depths=jnp.zeros((3, *chunk().images.shape[1:3])))
    stacked = jax.tree.map(lambda x: jnp.stack([x, x]), one)
    check_chunk(stacked, 3, stacked=True)
    of_a_step = {"images": one.images[:2], "viewmats": one.viewmats[:, :3], "depths": jnp.zeros((3, 8, 8))}
    for name, leaf in (of_a_step | {"near": jnp.ones(3)}).items():
        for call in (MODEL.step, jax.jit(MODEL.step)):
            with pytest.raises(InputError, match=f"chunk: {name} must be"):
                call({}, MODEL.init_cache(), wrong(one, **{name: leaf}))
    with pytest.raises(InputError, match=r"chunk: valid must be \[t"):
        MODEL.run({}, MODEL.init_cache(), wrong(stacked, valid=stacked.valid[:1]))
    with pytest.raises(InputError, match=r"Chunks have 3 views \(`stream.chunk_size`\)"):
        check_chunk(chunk(views=2), 3)
    with pytest.raises(InputError, match=r"images must be \[t 3 h w 3\], got \[3, .*Stack chunks along a leading axis"):
        MODEL.run({}, MODEL.init_cache(), one)


def test_sources_are_the_nearest_other_views_valid_ones_first():
    sources, valid = SOURCES(jnp.asarray(side_by_side([0, 1, 3, 7])), jnp.ones(4, bool), 2)
    np.testing.assert_array_equal(sources, [[1, 2], [0, 2], [1, 0], [2, 1]])
    assert valid.all()
    sources, _ = SOURCES(jnp.asarray(side_by_side([0, 0, 0, 0])), jnp.ones(4, bool), 3)  # at one center
    assert [sorted(row) for row in np.asarray(sources).tolist()] == [[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]]
    sources, valid = SOURCES(jnp.asarray(side_by_side([0, 0.1, 5, 9])), jnp.array([True, False, True, True]), 3)
    np.testing.assert_array_equal(sources[0], [2, 3, 1])
    np.testing.assert_array_equal(valid[0], [True, True, False])
    alone, valid = SOURCES(jnp.asarray(side_by_side([0, 1])), jnp.array([True, False]), 3)
    assert alone.shape == (2, 1) and not valid[0].any() and int(alone[0, 0]) == 1


def test_position_code_is_that_of_detr():
    height, width, channels = 4, 6, 8
    wanted = np.zeros((height, width, channels))
    for y, x, c in np.ndindex(height, width, channels // 2):
        rate = 10000.0 ** (2 * (c // 2) / (channels // 2))
        wave = np.sin if c % 2 == 0 else np.cos
        wanted[y, x, c] = wave((y + 1) / height * 2 * np.pi / rate)
        wanted[y, x, channels // 2 + c] = wave((x + 1) / width * 2 * np.pi / rate)
    np.testing.assert_allclose(sine_positions(height, width, channels), wanted, atol=1e-5)


def test_shifted_windows_do_not_join_opposite_borders():
    views = prepared(chunk())
    cnn = jnp.asarray(np.random.default_rng(0).normal(size=(3, 8, 8, 16)), jnp.float32)

    config = CONFIG.replace(attention_blocks=2)
    weights = {"params": random_params(config)["encoder"]}

    @jax.jit
    def attended(cnn):
        sources = nearest_sources(views.viewmats, views.valid, config.network.num_sources)
        return Encoder(config).apply(weights, cnn, *sources, method="attend_views")

    changed = np.abs(np.asarray(attended(cnn.at[0, 0, 0].add(1.0))) - attended(cnn)).max(axis=-1) > 0
    # The first layer's windows are cells 0-3 and 4-7, the second's 0-1, 2-5 and 6-7.
    assert changed[:, :6, :6].all() and not changed[:, 6:].any() and not changed[:, :, 6:].any()


def decoded(m: int = 10, num_members=1, means=None, footprints=None, quats=None, rgbs=None, **changes):
    config = CONFIG.replace(**changes)
    given = {"means": means, "footprints": footprints, "quats": quats, "rgbs": rgbs}
    rng = np.random.default_rng(0)
    f32 = lambda x: jnp.asarray(x, jnp.float32)  # noqa: E731
    inputs = {
        "means": f32(rng.normal(size=(m, 3))),
        "feats": f32(rng.normal(size=(m, config.network.token_width))),
        "rgbs": f32(rng.uniform(size=(m, 3 * config.head.gaussians_per_token))),
        "quats": f32(rng.normal(size=(m, 4))),
        "footprints": f32(rng.uniform(0.01, 0.3, m)),
    } | {name: x for name, x in given.items() if x is not None}
    wanted = jax.eval_shape(lambda key: init_params(key, config)["decoder"], jax.random.key(0))
    params = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape), wanted)

    @jax.jit
    def decode(feats, rgbs, num_members, **rest):
        shapes, parts = read_shapes(params, feats, config), decoder.divide_cells(rgbs, config)
        return decoder.decode_tokens(shapes, parts=parts, **rest, num_members=num_members, config=config)

    return decode(**inputs, num_members=jnp.broadcast_to(jnp.asarray(num_members), (m,))), inputs


def test_untrained_head_gives_a_disc_of_the_patch_color():
    gaussians, inputs = decoded(sh_degree=1, gaussians_per_token=1)
    np.testing.assert_array_equal(gaussians.means, inputs["means"])
    np.testing.assert_allclose(0.5 + SH_C0 * gaussians.sh[:, 0], inputs["rgbs"], atol=1e-6)
    np.testing.assert_array_equal(gaussians.sh[:, 1:], 0)
    wanted = np.outer(inputs["footprints"], [decoder.START_SCALE, decoder.START_SCALE, decoder.START_THICKNESS])
    np.testing.assert_allclose(gaussians.scales, wanted, rtol=1e-5)
    # The thin axis is the viewing direction of the token's camera.
    np.testing.assert_allclose(quats_to_matrices(gaussians.quats), quats_to_matrices(inputs["quats"]), atol=FLOAT32)
    np.testing.assert_allclose(gaussians.opacities, 1 / (1 + np.exp(-START_OPACITY)), rtol=1e-6)


def test_pivot_is_as_opaque_as_its_members_in_one_place_and_no_more_than_eight():
    members = np.array([0, 1, 2, 3, 17, 1000, 2**31 - 1], np.int32)
    gaussians, _ = decoded(len(members), num_members=jnp.asarray(members), gaussians_per_token=1)
    single = 1 / (1 + np.exp(-START_OPACITY))
    np.testing.assert_allclose(gaussians.opacities, 1 - (1 - single) ** np.minimum(members, 8.0), rtol=1e-6, atol=1e-7)

    @jax.jit
    @jax.value_and_grad
    def opacity(logit, n):
        one = lambda *shape: jnp.ones((1, *shape))  # noqa: E731
        config = CONFIG.replace(gaussians_per_token=4)
        shapes = TokenShapes(logit_opacities=logit[None], raw_scales=one(3), quats=one(4), sh=jnp.zeros((1, 1, 3)))
        values = {"means": one(3), "parts": decoder.divide_cells(one(12), config), "quats": one(4), "footprints": one()}
        return decoder.decode_tokens(shapes, **values, num_members=n, config=config).opacities[0]

    for logit in (-200.0, 0.0, 200.0):
        for n in (0, 1, 2**31 - 1):
            value, slope = opacity(jnp.float32(logit), jnp.array([n]))
            assert 0 <= value <= 1 and np.isfinite(slope)


@pytest.mark.parametrize("per_token", [1, 4, 16])
def test_gaussians_of_a_token_project_to_their_parts(per_token):
    """In the token's camera, each Gaussian projects to the center of the part whose color it has."""
    config = CONFIG.replace(gaussians_per_token=per_token)
    camera, images = prepared(chunk()), np.random.default_rng(0).uniform(size=(3, 32, 32, 3))
    colors = jax.jit(patch_colors, static_argnums=1)(jnp.asarray(images, jnp.float32), config)
    side = math.isqrt(per_token)
    positions, footprints = BACK_PROJECT(jnp.full((3, 8, 8), np.log(2.0)), camera)
    quats = jax.jit(matrices_to_quats)(jnp.asarray(np.swapaxes(camera.viewmats[:, :3, :3], -1, -2)))
    gaussians, _ = decoded(
        192,
        means=positions.reshape(-1, 3),
        footprints=footprints.reshape(-1),
        quats=jnp.repeat(quats, 64, axis=0),
        rgbs=colors.reshape(192, -1),
        gaussians_per_token=per_token,
    )
    points = jax.jit(transform_points)(camera.viewmats, gaussians.means.reshape(3, -1, 3))
    seen = np.einsum("vij,vnj->vni", camera.Ks, points)
    parts = seen[..., :2] / seen[..., 2:] * side / GRID_STRIDE
    # Footprints are square; cells are not quite, since fx and fy differ by 4 %.
    np.testing.assert_allclose(parts % 1, 0.5, atol=0.03)
    pooled = images.reshape(3, 8 * side, 4 // side, 8 * side, 4 // side, 3).mean(axis=(2, 4))
    columns, rows = np.floor(parts).astype(int).transpose(2, 0, 1)
    wanted = pooled[np.arange(3)[:, None], rows, columns]
    np.testing.assert_allclose(0.5 + SH_C0 * gaussians.sh[:, 0].reshape(3, -1, 3), wanted, atol=1e-5)


def divided(patch: np.ndarray) -> dict[tuple[int, int], tuple[int, np.ndarray]]:
    """Side and color of each part of a patch of 4 x 4 colors, by its first row and column: from coarse to fine."""
    colors = {side: patch.reshape(4 // side, side, 4 // side, side, 3).mean(axis=(1, 3)) for side in (1, 2, 4)}
    finer = lambda side: colors[side // 2] - np.repeat(np.repeat(colors[side], 2, axis=0), 2, axis=1)  # noqa: E731
    side = 4
    if np.sqrt(np.mean(finer(4) ** 2)) >= decoder.MIN_DETAIL[2]:
        side = 2
    if np.sqrt(np.mean(finer(2) ** 2)) >= decoder.MIN_DETAIL[1]:
        side = 1
    return {(r, c): (side, colors[side][r // side, c // side]) for r in range(0, 4, side) for c in range(0, 4, side)}


def test_a_patch_is_divided_as_its_detail_asks():
    rng = np.random.default_rng(0)
    coarse = np.repeat(np.repeat(rng.normal(size=(400, 2, 2, 3)), 2, axis=1), 2, axis=2)
    patches = 0.5 + rng.choice([0.0, 0.02, 0.1], (400, 1, 1, 1)) * coarse
    patches += rng.choice([0.0, 0.02, 0.1], (400, 1, 1, 1)) * rng.normal(size=(400, 4, 4, 3))
    config = CONFIG.replace(gaussians_per_token=16, detail=True)
    divide = jax.jit(decoder.divide_cells, static_argnums=1)
    parts = jax.tree.map(np.asarray, divide(jnp.asarray(patches.reshape(400, -1), jnp.float32), config))
    sides = set()
    for i, patch in enumerate(patches):
        wanted = divided(patch)
        present = np.asarray(parts.present[i]).reshape(4, 4)
        assert set(zip(*np.nonzero(present), strict=True)) == set(wanted)
        for (row, column), (side, color) in wanted.items():
            sides.add(side)
            place = 4 * row + column
            assert float(parts.growth[i]) == side
            np.testing.assert_allclose(parts.colors[i, place], color, atol=1e-5)
            center = [(column + side / 2) / 4 - 0.5, (row + side / 2) / 4 - 0.5]
            np.testing.assert_allclose([parts.right[i, place], parts.down[i, place]], center, atol=1e-6)
    assert sides == {1, 2, 4}


def test_a_patch_of_four_colors_becomes_the_gaussians_of_four_a_token():
    """And one of a single color that of one a token: only the detail of a patch is spared, not its shape."""
    rng = np.random.default_rng(0)
    for side in (1, 2):
        colors = jnp.asarray(rng.uniform(size=(10, side, side, 3)), jnp.float32)
        fine = jnp.repeat(jnp.repeat(colors, 4 // side, axis=1), 4 // side, axis=2)
        same = {"quats": jnp.asarray(rng.normal(size=(10, 4)), jnp.float32), "footprints": jnp.full(10, 0.1)}
        got, _ = decoded(rgbs=fine.reshape(10, -1), gaussians_per_token=16, detail=True, **same)
        wanted, _ = decoded(rgbs=colors.reshape(10, -1), gaussians_per_token=side**2, detail=False, **same)
        is_present = np.asarray(got.opacities) > 0
        shown = jax.tree.map(lambda x: np.asarray(x)[is_present], got)  # noqa: B023
        jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, rtol=1e-5, atol=1e-6), shown, wanted)


def test_scales_are_bounded_for_any_feature():
    raw = jnp.array([[1e30, -1e30, 0.0], [jnp.inf, -jnp.inf, 3.0]])
    for by_footprint in (True, False):
        scales = decoder.token_scales(raw, jnp.array([0.1, 1e9]), CONFIG.replace(footprint_scales=by_footprint))
        assert (scales >= decoder.MIN_SCALE).all() and (scales <= decoder.MAX_SCALE).all()
    literal = CONFIG.replace(footprint_scales=False, gaussians_per_token=1)
    scales = decoder.token_scales(jnp.array([[0.0, 1.0, 4.0]]), jnp.ones(1), literal)
    np.testing.assert_allclose(scales[0], np.log1p(np.exp([-4.0, -3.0, 0.0])), rtol=1e-5)


def test_depth_hints_pass_no_gradient_but_are_used():
    rng = np.random.default_rng(0)
    views = prepared(chunk())
    grid = views.inside.shape
    draw = lambda *shape: jnp.asarray(rng.uniform(size=shape), jnp.float32)  # noqa: E731
    network = CONFIG.network
    features = CompactFeatures(
        fine=draw(3, 2 * grid[1], 2 * grid[2], network.match_width),
        grid=draw(*grid, network.match_width),
        context=draw(*grid, 2 * network.encoder_widths[1]),
    )
    probs = draw(*grid, network.num_depths)
    distribution = DepthDistribution(probs=probs, logits=probs, decoder=draw(*grid, network.unet_width))

    @jax.jit
    def tokens_and_slopes(log_depths, confidences, context):
        def total(log_depths, confidences, context):
            depth = AnchoredDepth(probs, log_depths, confidences, confidences)
            seen = CompactFeatures(features.fine, features.grid, context)
            feats = regress_tokens(params()["tokens"], seen, distribution, depth, views, CONFIG)
            return jnp.sum(jnp.sin(3 * feats)), feats

        return jax.grad(total, argnums=(0, 1, 2), has_aux=True)(log_depths, confidences, context)

    depths, confidences = draw(*grid), draw(*grid)
    (by_depth, by_confidence, by_context), feats = tokens_and_slopes(depths, confidences, features.context)
    assert not by_depth.any() and not by_confidence.any() and by_context.any()
    assert np.any(tokens_and_slopes(depths + 0.3, confidences, features.context)[1] != feats)
    assert np.any(tokens_and_slopes(depths, 0.5 * confidences, features.context)[1] != feats)
