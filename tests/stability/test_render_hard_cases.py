"""Hard cases of the rasterizer by name, and a sweep over extremes of every input.

One compiled program serves every case (64 Gaussians, 24x16 pixels, SH degree 3), so a case costs no compilation; one
more serves crowds (4096). Each must give finite images and finite gradients by every input and, where a limit exists,
the right image.
"""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ssplat_jax.core.cameras import Camera
from ssplat_jax.core.gaussians import Gaussians
from ssplat_jax.core.pytree import replace
from ssplat_jax.rasterizer import Effects, render
from ssplat_jax.rasterizer.outputs import apply_exposures
from tests.model.small import finite
from tests.rasterizer import oracle

NUM, CROWD, WIDTH, HEIGHT = 64, 4096, 24, 16
EFFECTS = Effects(outputs=("color", "alpha", "depth", "median_depth"))
TOLERANCE = 1e-4  # float32 against the float64 oracle
FIELDS = ("means", "quats", "scales", "opacities", "sh")
F = np.float32


def base(num: int = NUM) -> dict[str, np.ndarray]:
    """One visible gray Gaussian in the middle; the other rows absent."""
    arrays = {
        "means": np.zeros((num, 3)),
        "quats": np.tile([1.0, 0.0, 0.0, 0.0], (num, 1)),
        "scales": np.full((num, 3), 0.1),
        "opacities": np.zeros(num),
        "sh": np.zeros((num, 16, 3)),
        "viewmat": np.eye(4),
        "K": np.array([[20.0, 0, 12], [0, 20, 8], [0, 0, 1]]),
    }
    arrays["means"][0], arrays["opacities"][0] = [0.05, -0.02, 2.0], 0.8
    arrays["sh"][:, 0] = [0.4, -0.2, 0.7]
    return arrays


def backdrop(a: dict) -> None:
    """A second, plain Gaussian behind the hard one: it must still be seen."""
    a["means"][1], a["scales"][1], a["opacities"][1] = [0.2, 0.1, 4.0], 0.5, 0.6


def changed(rows: int | slice, **fields) -> Callable[[dict], None]:
    """A change of `viewmat`, `K` and fields of some rows; before a plain backdrop if it is the first row alone."""

    def change(a):
        if rows == 0:
            backdrop(a)
        for key, value in fields.items():
            a[key][... if key in ("viewmat", "K") else rows] = value

    return change


CASES = {}
simple = lambda name, **fields: CASES.update({name: changed(0, **fields)})  # noqa: E731
whole = functools.partial(changed, slice(None))

# -- position
simple("at the camera center", means=[0, 0, 0])
simple("on the near plane", means=[0, 0, 0.01])
simple("just before the near plane", means=[0, 0, 0.0099])
simple("just behind the near plane", means=[0, 0, 0.0101], scales=1e-4)
simple("near and huge", means=[0, 0, 0.02], scales=1.0)
simple("behind", means=[0, 0, -2])
simple("beside the camera", means=[1e-3, 0, 1e-30])
simple("off screen to the right by 1e8 px", means=[1e7, 0, 2.0])
simple("off screen but reaching in", means=[2.5, 0, 2.0], scales=0.6)
simple("grazing the image plane", means=[5.0, 0, 0.05], scales=0.2)
simple("very far", means=[0, 0, 1e8])
simple("very far and huge", means=[0, 0, 1e8], scales=1e7)
simple("on a pixel center", means=[0.05, 0.05, 2.0])
simple("on a tile corner", means=[0.4, 0.0, 2.0])
simple("at the image corner", means=[-1.2, -0.8, 2.0])
# -- shape
simple("scale 0", scales=0.0)
simple("scale 1e-30", scales=1e-30)
simple("scale 1e6", scales=1e6)
simple("scale 1e11", scales=1e11)
simple("one scale 0", scales=[0.0, 0.2, 0.2])
simple("disc towards the camera", scales=[0.2, 0.2, 0.0])
simple("disc on edge", scales=[0.0, 0.3, 0.3])
simple("needle 1e6 : 1, large", scales=[1e3, 1e-3, 1e-3])
simple("needle along the view", scales=[1e-6, 1e-6, 1.0])
simple("needle on the diagonal", scales=[1.0, 1e-6, 1e-6], quats=[0.92, 0, 0, 0.38])
simple("determinant to 0", scales=[1.0, 1e-5, 1e-5], quats=[0.9, 0.1, 0.2, 0.3])
simple("negative scale", scales=-0.1)
# -- rotation
simple("quaternion 0", quats=0.0)
simple("quaternion unnormalized", quats=[3.0, 1.0, -2.0, 0.5])
simple("quaternion 1e-20", quats=[1e-20, 0, 1e-20, 0])
simple("quaternion 1e11", quats=[1e11, 1e11, 0, 0])
simple("quaternion NaN", quats=np.nan)
simple("quaternion of half a turn", quats=[0.0, 1.0, 0, 0], scales=[0.1, 0.2, 0.3])
# -- opacity
simple("opacity 0", opacities=0.0)
simple("opacity 1/255", opacities=1 / 255)
simple("opacity just below 1/255", opacities=0.99 / 255)
simple("opacity 1", opacities=1.0)
simple("opacity above 1", opacities=1.5)
simple("opacity negative", opacities=-0.5)
simple("opacity 1e-40", opacities=1e-40)
# -- color
simple("color below 0", sh=-5.0)
simple("color 1e6", sh=1e6)
simple("SH looking along the pole", means=[0, 0, 2.0], sh=np.linspace(-0.5, 0.5, 48).reshape(16, 3))
simple("SH of degree 3 aside", means=[0.8, 0.5, 2.0], sh=np.linspace(-0.5, 0.5, 48).reshape(16, 3))
# -- not finite: culled and counted
for field in ("means", "scales", "opacities", "sh"):
    simple(f"{field} NaN", **{field: np.nan})
    simple(f"{field} infinite", **{field: np.inf})
simple("one NaN entry", means=[np.nan, 0, 2.0])
# -- camera
simple("focal 1", K=[[1, 0, 12], [0, 1, 8], [0, 0, 1]])
simple("focal 1e5", K=[[1e5, 0, 12], [0, 1e5, 8], [0, 0, 1]], means=[0, 0, 2.0], scales=1e-4)
simple("unequal focals", K=[[5, 0, 12], [0, 80, 8], [0, 0, 1]])
simple("principal point outside the image", K=[[20, 0, -30], [0, 20, 40], [0, 0, 1]])
simple(
    "world shifted by 6.4e6",
    means=[0.05, -0.02, 6.4e6 + 2],
    viewmat=np.eye(4) - 6.4e6 * np.eye(4)[:, 2:3] * np.eye(4)[3],
)
simple("camera upside down", viewmat=np.diag([-1.0, -1, 1, 1]))


# -- all rows
def colored(num: int) -> np.ndarray:
    """SH of degree 3 with a color for each row."""
    sh = np.zeros((num, 16, 3))
    sh[:, 0] = np.random.default_rng(1).normal(size=(num, 3))
    return sh


def in_a_row(num: int) -> np.ndarray:
    """Means behind one another."""
    return np.stack([np.zeros(num), np.zeros(num), np.linspace(1, 3, num)], axis=1)


across = np.random.default_rng(0).uniform(-0.5, 0.5, (NUM, 2))
steps = np.random.default_rng(0).permutation(NUM) * (np.nextafter(F(2), F(3)) - F(2))
aligned = np.tile([0.05, -0.02, 2.0], (NUM, 1))
CASES |= {
    "empty scene": whole(opacities=0),
    "every row masked, with NaN in them": whole(opacities=0, means=np.nan),
    "coincident Gaussians": whole(means=aligned, opacities=0.5),
    "equal depths": whole(means=np.c_[across, np.full(NUM, 2.0)], opacities=0.6, sh=colored(NUM)),
    "opaque layers": whole(means=in_a_row(NUM), scales=10.0, opacities=0.985),
    "opaque layers that end on the stop": whole(means=in_a_row(NUM), scales=10.0, opacities=1.0),
    "faint layers down to the stop": whole(means=in_a_row(NUM), scales=10.0, opacities=0.17),
    "depths one ulp apart": whole(means=np.c_[aligned[:, :2], 2.0 + steps], opacities=0.3, scales=0.3, sh=colored(NUM)),
    "more opacity than a tile can hold, all behind": whole(means=[0, 0, -1.0], opacities=1.0),
}


# Cases with no limit to compare with: the value depends on rounding that float32 decides otherwise than float64.
WITHOUT_LIMIT = {
    "world shifted by 6.4e6",  # a step of float32 is 0.5 there
    "scale 1e11",
    "faint layers down to the stop",
    "opaque layers that end on the stop",  # (1 - 0.99)^2 is the stop itself
    "opacity 1/255",
    "color 1e6",
}


layers = {"means": in_a_row(CROWD), "scales": 10.0, "sh": colored(CROWD)}
CROWDS = {
    "thousands of coincident Gaussians": whole(means=[0.05, -0.02, 2.0], opacities=0.02, sh=colored(CROWD)),
    "thousands of opaque layers": whole(**layers, opacities=0.985),  # the transmittance underflows many times over
    "thousands of faint layers": whole(**layers, opacities=0.005),  # 1800 of them to the stop
}


@functools.cache
def program(effects: Effects = EFFECTS, max_pairs: int = 1 << 12):
    """Images, and gradients of a loss that uses all of them; `arrays` are what `effects` need."""

    def loss(gaussians, camera, arrays):
        out = render(gaussians, camera, effects=effects, near=oracle.NEAR, max_pairs=max_pairs, **arrays)
        images = (out.color, out.alpha, out.depth, out.median_depth)
        weights = np.random.default_rng(5).normal(size=(HEIGHT, WIDTH)).astype(F)
        total = sum(jnp.sum(x * (weights[..., None] if x.ndim == 3 else weights)) for x in images)
        return total + jnp.sum(out.color**2), out

    differentiated = jax.jit(jax.value_and_grad(loss, argnums=(0, 1), has_aux=True))
    return lambda gaussians, camera, **arrays: differentiated(gaussians, camera, arrays)


def build(arrays: dict[str, np.ndarray]) -> tuple[Gaussians, Camera]:
    gaussians = Gaussians(**{name: jnp.asarray(arrays[name], jnp.float32) for name in FIELDS})
    view, K = (jnp.asarray(arrays[name], jnp.float32) for name in ("viewmat", "K"))
    return gaussians, Camera(viewmats=view, Ks=K, width=WIDTH, height=HEIGHT)


def check(change: Callable[[dict], None], num: int = NUM, max_pairs: int = 1 << 12, *, has_limit: bool = True):
    """Renders a case: finite, with the right image where it has a limit. Gives the arrays, the output and gradients."""
    arrays = base(num)
    change(arrays)
    gaussians, camera = build(arrays)
    (value, out), grads = program(max_pairs=max_pairs)(gaussians, camera)
    assert finite((value, out)), "value"
    assert finite(grads), "gradient"
    if has_limit:
        assert_right(gaussians, camera, out)
    return arrays, out, grads


@pytest.mark.parametrize("name", CASES)
def test_hard_case(name):
    arrays, out, (grads, _) = check(CASES[name], has_limit=name not in WITHOUT_LIMIT)
    broken = ~np.all([np.isfinite(arrays[k].reshape(NUM, -1)).all(1) for k in FIELDS], axis=0)
    assert int(out.num_non_finite) == int(np.sum(broken & (arrays["opacities"] != 0)))
    assert all(np.all(np.asarray(x)[broken] == 0) for x in jax.tree.leaves(grads))


@pytest.mark.parametrize("name", CROWDS)
@pytest.mark.usefixtures("compiled_plainly")
def test_crowd(name):
    _, out, _ = check(CROWDS[name], CROWD, max_pairs=1 << 15)
    assert int(out.num_pairs) >= CROWD and int(out.num_overflow) == 0


def assert_right(gaussians: Gaussians, camera: Camera, out) -> None:
    """The images are the oracle's but for samples at a threshold, which rounding decides."""
    color, alpha, depth, median = oracle.render(gaussians, camera.viewmats, camera.Ks, WIDTH, HEIGHT)
    band = np.abs(np.asarray(out.alpha) - alpha) > 1 / 300  # a sample at the 1/255 threshold, decided by rounding
    assert band.mean() < 0.02
    scale = max(1.0, np.abs(color).max())
    assert np.abs(np.where(band[..., None], 0, out.color - color)).max() <= TOLERANCE * scale
    assert np.abs(np.where(band, 0, out.alpha - alpha)).max() <= TOLERANCE
    seen = (alpha > 0.02) & ~band
    assert np.abs(np.where(seen, out.depth - depth, 0)).max() <= TOLERANCE * max(1.0, depth.max())
    assert np.mean(np.abs(np.asarray(out.median_depth) - median) > 1e-5 * max(1.0, median.max())) < 0.02


ARRAYS = {
    "distortion": jnp.array([-0.3, 0.1, 0.01, -0.02, 0.05]),
    "exposures": jnp.array([[1.2, 0.0, 0.1, 0.01], [0.0, 0.9, 0.0, 0.0], [0.0, 0.0, 1.1, -0.02]]),
}


@pytest.mark.parametrize("has_every_effect", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_ten_thousand_extremes_have_no_non_finite_gradient(has_every_effect):
    """Every field of every Gaussian drawn from its extremes, 64 at a time, in front of extreme cameras."""
    effects = EFFECTS.replace(background=(0.1, 0.5, 0.9)) if has_every_effect else EFFECTS
    random = np.random.default_rng(7)
    pick = lambda values, size: random.choice(np.array(values), size)  # noqa: E731
    bad = 0
    for _ in range(10_000 // NUM + 1):
        arrays = base()
        sign = pick([-1, 1], (NUM, 3))
        arrays["means"] = sign * pick([0, 1e-30, 1e-3, 0.01, 0.3, 2, 1e4, 1e8, np.nan], (NUM, 3))
        arrays["scales"] = pick([0, 1e-30, 1e-12, 1e-6, 0.1, 3, 1e3, 1e6, np.inf], (NUM, 3))
        quats = pick([-1, 0, 1e-20, 1, 1e10, np.nan], (NUM, 4))
        arrays["quats"] = quats if random.uniform() < 0.5 else random.normal(size=(NUM, 4))
        arrays["opacities"] = pick([0, 1e-30, 1 / 255, 0.5, 0.99, 1, 2], NUM)
        arrays["sh"] = pick([-3, -1, 0, 1e-30, 1, 3], (NUM, 16, 3))
        focal = pick([1.0, 20.0, 1e5], 2)
        arrays["K"] = np.array([[focal[0], 0, 12], [0, focal[1], 8], [0, 0, 1]])
        gaussians, camera = build(arrays)
        given = ARRAYS | {"captured": camera} if has_every_effect else {}
        (value, out), grads = program(effects)(gaussians, camera, **given)
        bad += not finite((value, out, grads))
    assert bad == 0


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_an_exposure_that_is_not_finite_corrects_nothing(bad):
    color = jnp.asarray(np.random.default_rng(0).uniform(size=(2, 4, 5, 3)), jnp.float32)
    exposures = jnp.stack([jnp.eye(3, 4).at[1, 3].set(bad), 2.0 * jnp.eye(3, 4)])
    np.testing.assert_allclose(apply_exposures(color, exposures), [color[0], 2.0 * color[1]], rtol=1e-6)
    by_color, by_exposures = jax.jit(jax.grad(lambda *x: apply_exposures(*x).sum(), (0, 1)))(color, exposures)
    np.testing.assert_allclose(by_color, [jnp.ones_like(color[0]), 2.0 * jnp.ones_like(color[1])], rtol=1e-6)
    assert not by_exposures[0].any() and np.isfinite(by_exposures).all() and by_exposures[1].any()


def test_an_image_of_one_pixel():
    gaussians, camera = build(base())
    out = render(gaussians, replace(camera, width=1, height=1), effects=EFFECTS, max_pairs=1 << 12)
    assert out.color.shape == (1, 1, 3) and finite(out)
    wanted = oracle.render(gaussians, camera.viewmats, camera.Ks, 1, 1)
    np.testing.assert_allclose(out.color, wanted[0], atol=TOLERANCE)
