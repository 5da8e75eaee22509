"""Each effect: right when on, no operation when off, on only where a scene needs it."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ssplat_jax.core.cameras import Camera
from ssplat_jax.core.errors import InputError
from ssplat_jax.core.pytree import replace
from ssplat_jax.rasterizer import Effects, effects_for, filter_3d, render
from ssplat_jax.rasterizer.effects import distort, sampling_rates
from ssplat_jax.rasterizer.projection import project
from tests.rasterizer.scenes import cameras, cloud

LENS = np.array([-0.2, 0.05, 0.002, -0.003, 0.01], np.float32)
EXPOSURE = np.concatenate([np.diag([1.2, 0.9, 1.1]), [[0.01], [0.0], [-0.02]]], axis=1).astype(np.float32)
OUTPUTS = ("color", "alpha", "depth")

plainly = pytest.mark.usefixtures("compiled_plainly")  # laws within a tolerance, of programs used once


ARRAYS = {
    "captured": cameras(16, 16),
    "distortion": jnp.asarray(LENS),
    "exposures": jnp.asarray(EXPOSURE),
    "features": jnp.ones((8, 2)),
}
FLAGS = {"captured": "filter_3d", "distortion": "distortion", "exposures": "exposure"}


@functools.cache  # many effects are compared with the same program
def program_of(effects: Effects, degree: int = 3, *, arrays: tuple[str, ...] = ()) -> str:
    """The program as it is given to the compiler."""
    gaussians, camera = cloud(8, degree=degree), cameras(16, 16)
    given = {name.removeprefix("no "): ARRAYS.get(name) for name in arrays}
    drawn = jax.jit(lambda gaussians: render(gaussians, camera, effects=effects, max_pairs=1 << 12, **given))
    return drawn.lower(gaussians).as_text()


def num_operations(program: str) -> int:
    return program.count(" = ")


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
    without = num_operations(program_of(off))
    if name == "sh":
        # SH bands that are not evaluated are still checked for NaN, one comparison an entry.
        never = num_operations(program_of(off, degree=0))
        assert without in (never, never + 1)
    assert num_operations(program_of(on)) > without


@pytest.mark.parametrize("name", ARRAYS)
def test_an_array_that_is_absent_adds_no_operation(name):
    """An explicit None, and a flag that is off, are the program that never heard of the array."""
    never, having = program_of(Effects()), program_of(Effects(), arrays=(name,))
    assert program_of(Effects(), arrays=(f"no {name}",)) == never
    if name in FLAGS:
        assert program_of(Effects(**{FLAGS[name]: False}), arrays=(name,)) == never
        assert program_of(Effects(**{FLAGS[name]: True}), arrays=(name,)) == having
        with pytest.raises(InputError, match=f"{FLAGS[name]} is on and wants {name}"):
            render(cloud(8), cameras(16, 16), effects=Effects(**{FLAGS[name]: True}))
    assert num_operations(having) > num_operations(never)


def test_distortion_follows_opencvs_formula_and_derivative():
    x, y = np.random.default_rng(0).uniform(-0.5, 0.5, (2, 1, 50))
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


def zoomed(camera: Camera) -> Camera:
    """The camera with twice the resolution."""
    Ks = camera.Ks * jnp.array([[2.0], [2.0], [1.0]])
    return replace(camera, Ks=Ks, width=2 * camera.width, height=2 * camera.height)


def test_effects_for_finds_only_what_can_be_seen():
    gaussians, camera = cloud(degree=3), cameras(210, 300, batch=2)
    assert effects_for(gaussians, camera) == Effects(sh_degree=3)
    for first, degree in ((4, 1), (1, 0)):
        for faint in (0.0, 1e-12, 1e-5):
            scene = replace(gaussians, sh=gaussians.sh.at[:, first:].set(faint))
            assert effects_for(scene, camera).sh_degree == degree
    for lens, is_seen in ((np.zeros(5), False), (1e-9 * LENS, False), (LENS, True), (1e-3 * LENS, True)):
        lenses = jnp.asarray(np.stack([np.zeros(5), lens]), jnp.float32)
        assert effects_for(gaussians, camera, distortion=lenses).distortion is is_seen
    same = jnp.asarray(np.stack([EXPOSURE] * 2))
    for more, is_seen in ((0.0, False), (1e-4, False), (0.1, True)):
        assert effects_for(gaussians, camera, exposures=same.at[0, 0, 0].add(more)).exposure is is_seen
    assert effects_for(gaussians, camera[0], exposures=jnp.asarray(EXPOSURE)).exposure
    assert not effects_for(gaussians, camera[0], exposures=jnp.eye(3, 4)).exposure


@plainly
def test_the_3d_filter_is_wanted_where_a_zoom_shows_its_absence():
    camera = cameras(13, 11)
    fine, coarse = cloud(20, size=0.01), cloud(20, size=3.0)  # smaller and much larger than a captured pixel
    assert not effects_for(fine, camera, captured=camera).filter_3d
    assert effects_for(fine, zoomed(camera), captured=camera).filter_3d
    assert not effects_for(coarse, zoomed(camera), captured=camera).filter_3d


@plainly
def test_effects_that_are_left_out_change_no_level():
    """The image with the effects that are chosen against the one with all of them, faint ones included."""
    gaussians, camera = cloud(20, degree=3), cameras(13, 11)
    scene = replace(gaussians, sh=gaussians.sh.at[:, 4:].multiply(1e-4))
    arrays = {"distortion": jnp.asarray(1e-6 * LENS), "exposures": jnp.eye(3, 4) * 1.001}
    chosen = effects_for(scene, camera, **arrays)
    assert (chosen.sh_degree, chosen.distortion, chosen.exposure) == (1, False, False)
    least, most = (render(scene, camera, effects=e, max_pairs=1 << 12, **arrays) for e in (chosen, Effects()))
    assert 0 < float(jnp.abs(least.color - most.color).max()) < 1.5 / 255  # half a level by each of three


@plainly
def test_a_wide_lens_shapes_gaussians_by_its_derivative():
    lens, focal, center = jnp.array([-0.15, 0.012, 0, 0, 0], jnp.float32), 200.0, jnp.array([200.0, 150.0])
    means = jnp.array([[1.6, 1.2, 1.0], [0.3, -0.2, 1.0], [-1.5, 1.1, 1.0]])

    @jax.jit
    @jax.jacobian
    def jacobian_at(point):
        distorted, _ = distort(*(point[i][None, None] / point[2] for i in range(2)), lens[None])
        return focal * jnp.stack([axis[0, 0] for axis in distorted]) + center

    K = jnp.array([[focal, 0, center[0]], [0, focal, center[1]], [0, 0, 1]])
    camera = Camera(viewmats=jnp.eye(4)[None], Ks=K[None], width=400, height=300)
    scene = replace(cloud(3, degree=0), means=means, scales=jnp.full((3, 3), 0.01), opacities=jnp.full(3, 0.9))
    drawn = jax.jit(lambda scene: project(scene, camera, Effects(distortion=True, antialias="none"), lens[None]))
    splats = drawn(scene)
    for mean, factors in zip(means, np.asarray(splats.conic_factors[0], np.float64), strict=True):
        jacobian, (p, q, r) = np.asarray(jacobian_at(mean), np.float64), factors
        wanted = np.linalg.inv(1e-4 * jacobian @ jacobian.T)
        np.testing.assert_allclose([[2 * p * p, 2 * p * q], [2 * p * q, 2 * (q * q + r * r)]], wanted, rtol=2e-3)


def test_the_3d_filter_knows_mirrored_cameras():
    view = cameras(21, 30)
    K = np.array(view.Ks)
    K[0, 0], K[0, 2] = -K[0, 0], 21 - K[0, 2]
    mirrored = replace(view, Ks=jnp.asarray(K))
    scene = cloud(20)
    plain, turned = (np.asarray(sampling_rates(scene, camera)) for camera in (view, mirrored))
    assert plain.max() > 0
    np.testing.assert_allclose(turned, plain, rtol=1e-5)
    assert effects_for(scene, mirrored, captured=view) == effects_for(scene, view, captured=view)
