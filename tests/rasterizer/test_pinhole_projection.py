"""The gradient of the projection in closed form, against the automatic one and differences in float64."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ssplat_jax.core.gaussians import Gaussians
from ssplat_jax.rasterizer import Effects, constants
from ssplat_jax.rasterizer.pinhole_projection import project_pinhole
from ssplat_jax.rasterizer.projection import project
from tests.rasterizer.scenes import cameras, cloud, concatenate

NUM = 120
PARTS = ("means2d", "conic_factors", "opacities", "depths")


def scene(dtype=np.float32) -> Gaussians:
    """Gaussians before two cameras, and beside them on all sides, behind them, needles, discs, absent ones."""
    random, given = np.random.default_rng(1), cloud(NUM, degree=0, dtype=np.float64)
    aside = random.uniform([-6, -6, 0.1], [6, 6, 2], (NUM, 3))
    shapes = np.exp(random.uniform(-4, 0, (NUM, 3)))
    third = np.arange(NUM) % 3
    quats = np.array(given.quats) * np.exp(random.uniform(-3, 3, (NUM, 1)))
    quats[:3] = 0
    opacities = np.where(np.arange(NUM) % 7 > 0, given.opacities, 0)
    before = np.where(np.arange(NUM) % 10 > 0, 1, -1)[:, None]
    return Gaussians(
        means=jnp.asarray(np.where(third[:, None] == 0, aside, given.means) * before, dtype),
        quats=jnp.asarray(quats, dtype),
        scales=jnp.asarray(np.where(third[:, None] == 1, shapes, given.scales), dtype),
        opacities=jnp.asarray(opacities, dtype),
        sh=jnp.asarray(given.sh, dtype),
    )


@functools.partial(jax.jit, static_argnums=(0, 4))
def pulled(function, gaussians, camera, cotangents, antialias):
    """Slopes of the sum of the outputs times `cotangents` by every input."""

    def loss(gaussians, camera):
        splats = function(gaussians, camera, Effects(antialias=antialias))
        return sum(jnp.sum(getattr(splats, name) * cotangents[name]) for name in PARTS)

    return jax.grad(loss, argnums=(0, 1))(gaussians, camera)


@functools.partial(jax.jit, static_argnums=2)
def visible_in_any(gaussians, camera, antialias):
    return project(gaussians, camera, Effects(antialias=antialias)).visible.any(axis=0)


def cotangents_of(num: int, dtype, num_cameras: int = 2) -> dict:
    random, sizes = np.random.default_rng(2), {"means2d": (2,), "conic_factors": (3,), "opacities": (), "depths": ()}
    return {name: jnp.asarray(random.normal(size=(num_cameras, num, *sizes[name])), dtype) for name in PARTS}


def inputs(dtype):
    return scene(dtype), cameras(40, 30, batch=2, dtype=dtype), cotangents_of(NUM, dtype)


def assert_close(got, wanted, tolerance: float) -> None:
    for (path, a), b in zip(jax.tree_util.tree_leaves_with_path(got), jax.tree.leaves(wanted), strict=True):
        a, b = np.asarray(a, np.float64), np.asarray(b, np.float64)
        a, b = a.reshape(len(a), -1), b.reshape(len(b), -1)
        error, size = np.linalg.norm(a - b, axis=1), np.linalg.norm(b, axis=1)
        assert np.isfinite(a).all(), jax.tree_util.keystr(path)
        assert (error <= tolerance * size + 1e-3 * tolerance * size.max()).all(), jax.tree_util.keystr(path)


@pytest.mark.parametrize("antialias", ["mip", pytest.param("none", marks=pytest.mark.slow)])
def test_the_gradient_is_the_automatic_one_in_float64(antialias):
    with jax.enable_x64(True):
        given = *inputs(np.float64), antialias
        got, wanted = pulled(project_pinhole, *given), pulled(project, *given)
        seen = np.asarray(visible_in_any(*given[:2], antialias))
    assert 0.3 < seen.mean() < 0.9
    assert np.abs(np.asarray(wanted[0].means)[seen]).min(axis=1).max() > 0
    assert_close(got, wanted, 1e-8)


def test_float32_is_as_exact_as_the_automatic_gradient():
    with jax.enable_x64(True):
        exact = pulled(project, *inputs(np.float64), "mip")
    given = *inputs(np.float32), "mip"
    for name in ("means", "quats", "scales", "opacities"):
        errors = []
        for function in (project_pinhole, project):
            got = np.asarray(getattr(pulled(function, *given)[0], name), np.float64).reshape(NUM, -1)
            wanted = np.asarray(getattr(exact[0], name)).reshape(NUM, -1)
            errors.append(np.linalg.norm(got - wanted, axis=1) / (np.linalg.norm(wanted, axis=1) + 1e-30))
        assert np.median(errors[0]) < 1e-5, name
        assert np.quantile(errors[0], 0.95) < 2 * np.quantile(errors[1], 0.95) + 1e-6, name


def test_extreme_rows_have_finite_slopes_and_what_is_not_visible_none():
    """10,000 Gaussians whose entries span all magnitudes that `render` lets through."""
    random, num = np.random.default_rng(3), 10_000
    spread = lambda *shape: random.normal(size=shape) * 10.0 ** random.uniform(-20, 12, (num, *[1] * (len(shape) - 1)))  # noqa: E731
    single = lambda x: jnp.asarray(np.clip(x, -constants.MAX_MAGNITUDE, constants.MAX_MAGNITUDE), jnp.float32)  # noqa: E731
    means = spread(num, 3)
    means[:, 2] = np.where(random.random(num) < 0.5, random.uniform(0, 4, num), means[:, 2])
    gaussians = Gaussians(
        means=single(means),
        quats=single(spread(num, 4)),
        scales=single(spread(num, 3)),
        opacities=single(random.uniform(-0.1, 1.2, num)),
        sh=jnp.zeros((num, 1, 3)),
    )
    gaussians = concatenate([gaussians, cloud(200, degree=0)])
    camera = cameras(40, 30, batch=2)
    is_seen = np.asarray(visible_in_any(gaussians, camera, "mip"))
    cotangents = cotangents_of(num + 200, np.float32) | {"depths": jnp.zeros((2, num + 200))}
    by_gaussian, _ = pulled(project_pinhole, gaussians, camera, cotangents, "mip")
    assert 150 < is_seen.sum() < 5000
    for leaf in jax.tree.leaves(by_gaussian):
        assert np.isfinite(leaf).all()
        assert not np.asarray(leaf)[~is_seen].any()
