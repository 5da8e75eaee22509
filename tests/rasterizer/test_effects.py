"""Each effect: right when on, no operation when off, on only where a scene needs it."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ssplat_jax.core.cameras import Camera
from ssplat_jax.core.errors import InputError
from ssplat_jax.core.gaussians import Gaussians, mask_gaussians
from ssplat_jax.core.pytree import replace
from ssplat_jax.rasterizer import Effects, effects_for, filter_3d, render
from ssplat_jax.rasterizer.effects import distort, sampling_rates
from ssplat_jax.rasterizer.projection import project, tangent_bounds
from ssplat_jax.rasterizer.reference import render_reference
from tests.rasterizer.scenes import cameras, cloud, concatenate

LENS = np.array([-0.2, 0.05, 0.002, -0.003, 0.01], np.float32)
EXPOSURE = np.concatenate([np.diag([1.2, 0.9, 1.1]), [[0.01], [0.0], [-0.02]]], axis=1).astype(np.float32)
OUTPUTS = ("color", "alpha", "depth")

plainly = pytest.mark.usefixtures("compiled_plainly")  # laws within a tolerance, of programs used once


def operations(gaussians, camera, effects: Effects, **arrays) -> tuple[int, float]:
    """Operations in the traced program, calls included, and what XLA says it computes."""

    def count(jaxpr) -> int:
        is_program = lambda p: hasattr(p, "eqns") or hasattr(p, "jaxpr")  # noqa: E731
        parts = [p for e in jaxpr.eqns for p in jax.tree.leaves(e.params, is_leaf=is_program)]
        return len(jaxpr.eqns) + sum(count(getattr(p, "jaxpr", p)) for p in parts if is_program(p))

    def program(gaussians):
        return render(gaussians, camera, effects=effects, max_pairs=1 << 12, **arrays)

    traced = jax.jit(program).trace(gaussians)
    cost = traced.lower().cost_analysis() or {}
    return count(traced.jaxpr.jaxpr), float(cost.get("flops", 0.0))


ARRAYS = {
    "captured": cameras(16, 16),
    "distortion": jnp.asarray(LENS),
    "exposures": jnp.asarray(EXPOSURE),
    "features": jnp.ones((8, 2)),
}
FLAGS = {"captured": "filter_3d", "distortion": "distortion", "exposures": "exposure"}


@functools.cache  # many effects are compared with the same program
def operations_of(effects: Effects, degree: int = 3, *, arrays: tuple[str, ...] = ()) -> tuple[int, float]:
    gaussians, camera = cloud(8, degree=3), cameras(16, 16)
    scene = replace(gaussians, sh=gaussians.sh[:, : (degree + 1) ** 2])
    return operations(scene, camera, effects, **{name: ARRAYS[name] for name in arrays})


EFFECTS = {
    "sh": (Effects(sh_degree=3), Effects(sh_degree=0)),
    "mip": (Effects(), Effects(antialias="none")),
    "classic": (Effects(antialias="mip"), Effects(antialias="classic")),
    "background": (Effects(background=(0.1, 0.2, 0.3)), Effects()),
    "depth": (Effects(), Effects(outputs=("color", "alpha"))),
    "alpha": (Effects(outputs=("color", "alpha")), Effects(outputs=("color",))),
    "median_depth": (Effects(outputs=(*OUTPUTS, "median_depth")), Effects()),
}


@pytest.mark.parametrize("name", EFFECTS)
def test_an_effect_that_is_off_adds_no_operation(name):
    on, off = EFFECTS[name]
    without, having = map(operations_of, (off, on))
    if name == "sh":
        # SH bands that are not evaluated are still checked for NaN, one comparison an entry.
        never = operations_of(off, degree=0)
        assert without[0] in (never[0], never[0] + 1)
    assert having[0] > without[0] and having[1] > without[1]


@pytest.mark.parametrize("name", ARRAYS)
def test_an_array_that_is_absent_adds_no_operation(name):
    """An explicit None, and a flag that is off, are the program that never heard of the array."""
    never, having = operations_of(Effects()), operations_of(Effects(), arrays=(name,))
    scene = cloud(8, degree=3), cameras(16, 16)
    assert operations(*scene, Effects(), **{name: None}) == never
    if name in FLAGS:
        assert operations(*scene, Effects(**{FLAGS[name]: False})) == never
        assert operations_of(Effects(**{FLAGS[name]: True}), arrays=(name,)) == having
    assert having[0] > never[0] and having[1] > never[1]


@plainly
@pytest.mark.parametrize("draw", [render, render_reference], ids=["tiles", "reference"])
@pytest.mark.parametrize("name", FLAGS)
def test_an_array_alone_switches_its_effect_on(name, draw):
    scene = cloud(8, size=0.02), cameras(16, 16)
    options = {"max_pairs": 1 << 12} if draw is render else {}
    plain = draw(*scene, **options)
    alone, flagged = (
        draw(*scene, effects=effects, **{name: ARRAYS[name]}, **options)
        for effects in (Effects(), Effects(**{FLAGS[name]: True}))
    )
    np.testing.assert_array_equal(alone.color, flagged.color)
    assert float(jnp.abs(alone.color - plain.color).max()) > 1e-3


@plainly
def test_features_are_composited_whenever_given():
    scene, features = (cloud(8), cameras(16, 16)), ARRAYS["features"]
    out = render(*scene, features=features, max_pairs=1 << 12)
    np.testing.assert_allclose(out.features, jnp.stack([out.alpha] * 2, axis=-1), atol=1e-6)


@pytest.mark.parametrize("draw", [render, render_reference], ids=["tiles", "reference"])
@pytest.mark.parametrize("name", FLAGS)
def test_a_flag_that_contradicts_its_array_is_refused(name, draw):
    scene = cloud(8), cameras(16, 16)
    with pytest.raises(InputError, match=f"{FLAGS[name]} is off and wants no {name}, got one; leave it out"):
        draw(*scene, effects=Effects(**{FLAGS[name]: False}), **{name: ARRAYS[name]})
    with pytest.raises(InputError, match=f"{FLAGS[name]} is on and wants {name}, got none; pass it"):
        draw(*scene, effects=Effects(**{FLAGS[name]: True}))


def test_distortion_follows_opencvs_formula_and_derivative():
    random = np.random.default_rng(0)
    x, y = random.uniform(-0.5, 0.5, (2, 1, 50))
    k1, k2, p1, p2, k3 = LENS.astype(float)

    def opencv(x, y):
        r2 = x**2 + y**2
        radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
        across = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
        return np.array([across, y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y])

    (dx, dy), slopes = distort(*(jnp.asarray(v, jnp.float32) for v in (x, y)), jnp.asarray(LENS)[None])
    np.testing.assert_allclose(np.stack([dx, dy]), opencv(x, y), atol=1e-6)
    h = 1e-6
    measured = [*(opencv(x + h, y) - opencv(x - h, y)) / 2 / h, *(opencv(x, y + h) - opencv(x, y - h)) / 2 / h]
    for got, wanted in zip(slopes, (measured[0], measured[2], measured[1], measured[3]), strict=True):
        np.testing.assert_allclose(got, wanted, atol=1e-5)


@plainly
@pytest.mark.slow  # programs of its own
def test_a_lens_of_zeros_is_a_pinhole():
    gaussians, camera = cloud(), cameras(21, 30)
    lens = render(gaussians, camera, effects=Effects(distortion=True), distortion=jnp.zeros(5), max_pairs=1 << 12)
    np.testing.assert_allclose(lens.color, render(gaussians, camera, max_pairs=1 << 12).color, atol=1e-5)


@plainly
def test_exposure_is_affine_in_color():
    gaussians, camera = cloud(), cameras(21, 30)
    plain = np.asarray(render(gaussians, camera, max_pairs=1 << 12).color)
    out = render(gaussians, camera, effects=Effects(exposure=True), exposures=jnp.asarray(EXPOSURE), max_pairs=1 << 12)
    np.testing.assert_allclose(out.color, np.maximum(plain @ EXPOSURE[:, :3].T + EXPOSURE[:, 3], 0), atol=1e-5)


def test_the_3d_filter_has_its_variance_and_keeps_mass():
    gaussians, camera = cloud(size=0.01), cameras(210, 300)
    smoothed = filter_3d(gaussians, camera)
    view = np.asarray(camera.viewmats)
    points = np.asarray(gaussians.means) @ view[:3, :3].T + view[:3, 3]
    pixels = points[:, :2] / points[:, 2:] * np.diag(camera.Ks)[:2] + np.asarray(camera.Ks)[:2, 2]
    seen = np.all(np.abs(pixels / [210, 300] - 0.5) < 0.6, axis=1)
    assert seen.sum() > 20
    added = np.asarray(smoothed.scales) ** 2 - np.asarray(gaussians.scales) ** 2
    wanted = 0.2 * (points[:, 2] / float(camera.Ks[0, 0])) ** 2
    np.testing.assert_allclose(added[seen], np.broadcast_to(wanted[seen, None], added[seen].shape), rtol=1e-3)
    mass = lambda g: np.asarray(g.opacities) * np.prod(np.asarray(g.scales), axis=1)  # noqa: E731
    np.testing.assert_allclose(mass(smoothed), mass(gaussians), rtol=1e-5)


def test_the_3d_filter_without_seeing_cameras_does_nothing():
    gaussians, camera = cloud(), cameras(21, 30)
    away = replace(camera, viewmats=camera.viewmats.at[2, 3].set(-100.0))
    np.testing.assert_allclose(filter_3d(gaussians, away).scales, gaussians.scales, rtol=1e-6)


def test_effects_for_finds_only_what_the_scene_needs():
    gaussians, camera = cloud(degree=3), cameras(210, 300, batch=2)
    assert effects_for(gaussians, camera) == Effects(sh_degree=3)
    flat = replace(gaussians, sh=gaussians.sh.at[:, 4:].set(0.0))
    assert effects_for(flat, camera).sh_degree == 1
    assert effects_for(replace(gaussians, sh=gaussians.sh.at[:, 1:].set(0.0)), camera).sh_degree == 0
    assert not effects_for(gaussians, camera, distortion=jnp.zeros((2, 5))).distortion
    assert effects_for(gaussians, camera, distortion=jnp.asarray(np.stack([LENS] * 2))).distortion
    same = jnp.asarray(np.stack([EXPOSURE] * 2))
    assert not effects_for(gaussians, camera, exposures=same).exposure
    assert effects_for(gaussians, camera, exposures=same.at[0, 0, 0].add(0.1)).exposure
    assert not effects_for(gaussians, camera, captured=camera).filter_3d
    closer = Camera(viewmats=camera.viewmats, Ks=camera.Ks * jnp.array([[2.0], [2.0], [1.0]]), width=420, height=600)
    assert effects_for(gaussians, closer, captured=camera).filter_3d


@plainly
def test_effects_left_out_by_effects_for_change_no_pixel():
    gaussians, camera = cloud(degree=3), cameras(21, 30)
    flat = replace(gaussians, sh=gaussians.sh.at[:, 4:].set(0.0))
    least = render(flat, camera, effects=effects_for(flat, camera), max_pairs=1 << 12)
    np.testing.assert_allclose(least.color, render(flat, camera, max_pairs=1 << 12).color, atol=1e-6)


@pytest.mark.parametrize(
    "fields", [{"sh_degree": 4}, {"antialias": "fxaa"}, {"outputs": ("colors",)}], ids=["degree", "antialias", "output"]
)
def test_unknown_effects_are_refused(fields):
    with pytest.raises(InputError, match="effects:"):
        Effects(**fields)


def one(mean, size=0.01) -> Gaussians:
    return Gaussians(
        means=jnp.array([mean], jnp.float32),
        quats=jnp.array([[1.0, 0.0, 0.0, 0.0]]),
        scales=jnp.full((1, 3), size),
        opacities=jnp.array([0.9]),
        sh=jnp.ones((1, 1, 3)),
    )


WIDE = Camera(
    viewmats=jnp.eye(4),
    Ks=jnp.array([[200.0, 0, 200], [0, 200.0, 150], [0, 0, 1]]),
    width=400,
    height=300,
)


@pytest.mark.parametrize(("lens", "tangent"), [((-0.1, 0.003, 0, 0, 0), 4.1), ((-0.3, 0.03, 0, 0, 0), 2.2)])
@plainly
@pytest.mark.slow  # programs of its own
def test_points_that_a_lens_folds_into_the_image_are_culled(lens, tangent):
    # Outside its first maximum the polynomial falls, and farther out it rises again: ghosts from the side.
    lens = jnp.array(lens, jnp.float32)
    assert 1 + tangent**2 * (3 * lens[0] + tangent**2 * 5 * lens[1]) > 0  # it rises again
    out = render(one([tangent, 0.1, 1.0]), WIDE, effects=Effects(distortion=True), distortion=lens, max_pairs=1 << 12)
    assert int(out.num_pairs) == 0
    assert int(render(one([0.2, 0.1, 1.0]), WIDE, effects=Effects(distortion=True), distortion=lens).num_pairs) > 0


@pytest.mark.parametrize("mean", [(1.6, 1.2, 1.0), (0.3, -0.2, 1.0), (-1.5, 1.1, 1.0)])
@plainly
@pytest.mark.slow  # programs of its own
def test_a_wide_lens_shapes_gaussians_by_its_derivative(mean):
    lens = jnp.array([-0.15, 0.012, 0, 0, 0], jnp.float32)

    def pixel(point):
        (x, y), _ = distort(*(point[i][None, None] / point[2] for i in range(2)), lens[None])
        return jnp.stack([200 * x[0, 0] + 200, 200 * y[0, 0] + 150])

    jacobian = np.asarray(jax.jacobian(pixel)(jnp.array(mean)), np.float64)
    wanted = np.linalg.inv(1e-4 * jacobian @ jacobian.T)
    camera = replace(WIDE, viewmats=WIDE.viewmats[None], Ks=WIDE.Ks[None])
    splats = project(one(mean), camera, Effects(distortion=True, antialias="none"), lens[None])
    p, q, r = np.asarray(splats.conic_factors[0, 0], np.float64)
    np.testing.assert_allclose([[2 * p * p, 2 * p * q], [2 * p * q, 2 * (q * q + r * r)]], wanted, rtol=2e-3)


@plainly
@pytest.mark.slow  # a program of its own
def test_a_lens_has_finite_gradients_far_from_its_axis():
    lens = jnp.array([0.1, 0.01, 0, 0, 0.01], jnp.float32)

    def loss(means):
        scene = replace(one([0.0, 0.0, 1.0]), means=means)
        out = render(scene, WIDE, effects=Effects(distortion=True), distortion=lens, max_pairs=1 << 12)
        return out.color.sum()

    for mean in ([1e6, 0.0, 0.05], [1e3, 1e3, 0.02], [0.1, 0.0, 1.0]):
        assert np.isfinite(jax.jit(jax.grad(loss))(jnp.array([mean]))).all()


def test_the_3d_filter_ignores_absent_rows():
    captured = Camera(
        viewmats=jnp.stack([jnp.eye(4), jnp.eye(4).at[2, 3].set(50.0)]),
        Ks=jnp.stack([WIDE.Ks] * 2),
        width=400,
        height=300,
    )
    seen, unseen = one([0.0, 0.0, 1.0]), one([0.0, 0.0, -100.0])
    scene = concatenate([seen, unseen])
    absent = mask_gaussians(seen, jnp.zeros(1, bool))
    alone, padded = filter_3d(scene, captured), filter_3d(concatenate([scene, absent]), captured)
    np.testing.assert_array_equal(padded.scales[:2], alone.scales)


def test_effects_for_needs_a_single_exposure_unless_identity():
    scene, camera = cloud(4), cameras(16, 16)
    several = jnp.asarray(np.stack([EXPOSURE] * 3))
    for exposures, wanted in ((EXPOSURE, True), (np.eye(3, 4, dtype=np.float32), False), (several, False)):
        assert effects_for(scene, camera, exposures=jnp.asarray(exposures)).exposure is wanted


def test_the_3d_filter_takes_the_size_of_a_negative_scale():
    captured = Camera(viewmats=jnp.eye(4)[None], Ks=WIDE.Ks[None], width=400, height=300)
    scene = one([0.0, 0.0, 1.0])
    plain, mirrored = filter_3d(scene, captured), filter_3d(replace(scene, scales=-scene.scales), captured)
    np.testing.assert_array_equal(plain.opacities, mirrored.opacities)
    assert float(plain.opacities[0]) > 0


def test_effects_given_as_lists_are_hashable():
    listed, plain = (Effects(outputs=kind(["color"]), background=kind([1.0, 0.0, 0.0])) for kind in (list, tuple))
    assert listed == plain and hash(listed) == hash(plain)


def test_a_background_has_three_parts():
    with pytest.raises(InputError, match="three numbers"):
        Effects(background=(1.0, 0.0))


@pytest.mark.parametrize("center", [32.0, 20.0, -8.0])
def test_bounds_of_the_jacobian_widen_outwards_on_every_side(center):
    """The bounds of a mirrored camera are the mirrored bounds, with and without a lens that sees farther."""
    K = jnp.array([[40.0, 0, center], [0, 40, 24], [0, 0, 1]])
    view, mirrored = (Camera(viewmats=jnp.eye(4)[None], Ks=k[None], width=64, height=48)
                      for k in (K, K.at[0, 2].set(64 - center)))  # fmt: skip
    for wider in (None, jnp.full((1, 1), 1.5)):
        left, right, upper, lower = (float(x[0, 0]) for x in tangent_bounds(view, wider))
        other_left, other_right, *_ = (float(x[0, 0]) for x in tangent_bounds(mirrored, wider))
        assert (left, right, upper) == pytest.approx((-other_right, -other_left, -lower), rel=1e-6)
    plain = [float(x[0, 0]) for x in tangent_bounds(view)]
    wide = [left, right, upper, lower]
    assert wide[0] <= plain[0] and wide[1] >= plain[1] and wide[2] < plain[2] and wide[3] > plain[3]
    if center > 0:
        assert wide[0] == pytest.approx(1.5 * plain[0]) and wide[1] == pytest.approx(1.5 * plain[1])


def test_the_3d_filter_knows_mirrored_cameras():
    view = cameras(21, 30)
    K = np.array(view.Ks)
    K[0, 0], K[0, 2] = -K[0, 0], 21 - K[0, 2]
    mirrored = replace(view, Ks=jnp.asarray(K))
    means = cloud(20).means
    plain, turned = (np.asarray(sampling_rates(means, camera)) for camera in (view, mirrored))
    assert plain.max() > 0
    np.testing.assert_allclose(turned, plain, rtol=1e-5)
    assert effects_for(cloud(20), mirrored, captured=view) == effects_for(cloud(20), view, captured=view)
