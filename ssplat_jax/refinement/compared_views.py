"""Settings of refinement, and the key views that a scene is compared with: errors, order, which can be learned from."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ssplat_jax.cache.key_views import KeyViews, usable
from ssplat_jax.core.errors import InputError
from ssplat_jax.core.gaussians import Gaussians
from ssplat_jax.core.kept_programs import Kept
from ssplat_jax.core.pytree import replace
from ssplat_jax.rasterizer import Effects, RenderOutput, fill_holes, render
from ssplat_jax.rasterizer.render import TILE

EFFECTS = Effects(outputs=("color", "alpha"))
VIEWS_PER_STEP = 2  # whose gradients a step adds: a Gaussian that few views show moves more often
BLOCK = 8  # side of the pixel blocks that are held back together: neighbors of a pixel give its color away
GOLDEN = 2654435769  # 2^32 over the golden ratio
WORSE_THAN_USUAL = 2.0  # ratio to the median error above which a view is one of another scene, or of a wrong pose
MIN_COMPARED = 4  # views that a median needs to mean something
MAX_LEFT_OUT = 0.25  # share of the views that may be left out for their error: beyond it the scene is wrong

SSIM_SHARE = 0.2
"""Share of 1 - SSIM in the loss, that of 3DGS; the rest is the L1 error, which alone leaves fine texture blurred."""

WINDOW = np.exp(-0.5 * (np.arange(-5, 6) / 1.5) ** 2)
WINDOW /= WINDOW.sum()
"""Window of SSIM along one axis: a Gaussian of 1.5 pixels, 11 pixels wide (Wang et al., 2004)."""


@dataclasses.dataclass(frozen=True)
class RefineConfig:
    """Settings of refinement; learning rates and bounds are constants of `refine_step.py`. Frozen and hashable."""

    sh_degree: int = 0
    """SH degree that the scene gets, unless its own is higher: 0 adds no band."""
    shown_weight: float = 0.7
    """Weight of the L1 error with holes filled; the rest is the L1 error over black."""
    held_back: float = 1 / 32
    """Fraction of 8 x 8 pixel blocks that no gradient sees; their error says whether refinement still helps."""
    seed: int = 0
    """Seed of the order of views and of the pixels that are held back."""

    def __post_init__(self) -> None:
        self._require("sh_degree", "0 to 3", self.sh_degree in range(4))
        self._require("shown_weight", "in [0, 1]", 0 <= self.shown_weight <= 1)
        self._require("held_back", "in [0, 0.5]", 0 <= self.held_back <= 0.5)

    def _require(self, name: str, wanted: str, is_good: bool) -> None:
        if not is_good:
            raise InputError(f"refine: {name} must be {wanted}, got {getattr(self, name)!r}.")


FOR_CAPTURES = RefineConfig(sh_degree=2)
"""Configuration for scenes that a stream made of captures: colors of real surfaces depend on the direction of view."""


def errors_of_view(
    gaussians: Gaussians,
    background: Float[Array, "3"],
    view: KeyViews,
    *,
    max_pairs: int,
    tile: int = TILE,
    probe: Float[Array, "n c"] | None = None,
) -> tuple[Float[Array, "h w 3"], Float[Array, "h w 3"], RenderOutput]:
    """Differences between the render of a view and its photograph, at the photograph's exposure.

    Args:
        gaussians: the scene.
        background: color that fills holes, at the exposure of the scene.
        view: one view, without a batch axis.
        max_pairs: capacity for tile intersections (static).
        tile: side of a tile (static), pixels.
        probe: channels that are rendered beside the colors.

    Returns:
        The difference with holes filled, the difference over black, and the render.
    """
    out = render(gaussians, view.camera(), effects=EFFECTS, features=probe, max_pairs=max_pairs, tile=tile)
    target = view.colors
    filled = fill_holes(out.color, out.alpha, background)
    return filled * view.exposures - target, out.color * view.exposures - target, out


def view_loss(
    gaussians: Gaussians,
    background: Float[Array, "3"],
    view: KeyViews,
    slot: Int[Array, ""],
    config: RefineConfig,
    max_pairs: int,
    tile: int = TILE,
) -> tuple[Float[Array, ""], tuple[Float[Array, ""], Float[Array, ""], Int[Array, ""]]]:
    """Loss of the key view in `slot`: the L1 error with holes filled and over black, and SSIM of a mixture of both.

    Pixels that are held back, or not seen, take no part; SSIM, whose windows reach them, finds both images gray there.

    Returns:
        The loss, and the L1 errors of the pixels that are learned from and of those that are held back, and the tile
        intersections that did not fit.
    """
    filled, black, out = errors_of_view(gaussians, background, view, max_pairs=max_pairs, tile=tile)
    errors = jnp.mean(config.shown_weight * jnp.abs(filled) + (1 - config.shown_weight) * jnp.abs(black), axis=-1)
    held_back = held_back_pixels(errors.shape, slot, config)
    learned, held_back = (
        (~held_back, held_back) if view.seen is None else (view.seen & ~held_back, view.seen & held_back)
    )
    target = view.colors
    image = target + config.shown_weight * filled + (1 - config.shown_weight) * black
    unlike = dissimilarity(*(jnp.where(learned[..., None], x, 0.5) for x in (image, target)))
    loss = mean_over((1 - SSIM_SHARE) * errors + SSIM_SHARE * unlike, learned)
    return loss, (mean_over(errors, learned), mean_over(errors, held_back), out.num_overflow)


def dissimilarity(image: Float[Array, "h w 3"], target: Float[Array, "h w 3"]) -> Float[Array, "h w"]:
    """1 - SSIM of every pixel, the mean of its channels; images are mirrored at their borders.

    Limits:
        Equal images give 0 and no gradient, constant ones finite gradients: SSIM's denominators are above 1e-4 x 9e-4.
    """
    # As products with matrices: the gradient of eleven shifted slices takes seven times as long on a CPU.
    rows, columns = (window_matrix(size) for size in image.shape[:2])
    windowed = lambda x: jnp.matmul(jnp.matmul(rows, x, precision="highest"), columns.T, precision="highest")  # noqa: E731
    image, target = jnp.moveaxis(image, -1, 0), jnp.moveaxis(target, -1, 0)
    products = (image, target, image * image, target * target, image * target)
    mean, target_mean, square, target_square, product = map(windowed, products)
    means, squares = mean * target_mean, mean * mean + target_mean * target_mean
    alike = (2 * means + 1e-4) * (2 * (product - means) + 9e-4)
    alike /= (squares + 1e-4) * (square + target_square - squares + 9e-4)
    return jnp.mean(1.0 - alike, axis=0)


def window_matrix(size: int) -> Float[np.ndarray, "n n"]:
    """The window of SSIM around each of `size` pixels, one a row; pixels beyond a border are mirrored."""
    places = np.pad(np.arange(size), len(WINDOW) // 2, mode="symmetric")
    rows = np.eye(size, dtype=np.float32)[places]
    return np.asarray(sum(w * rows[k : k + size] for k, w in enumerate(WINDOW)), np.float32)


def held_back_pixels(size: tuple[int, ...], slot: Int[Array, ""], config: RefineConfig) -> Bool[Array, "h w"]:
    """Pixels of the view in `slot` that no gradient sees, by height and width: the same blocks at every step."""
    height, width = size
    key = jax.random.fold_in(jax.random.key(config.seed + 1), slot)
    blocks = jax.random.uniform(key, (-(-height // BLOCK), -(-width // BLOCK))) < config.held_back
    return jnp.repeat(jnp.repeat(blocks, BLOCK, axis=0), BLOCK, axis=1)[:height, :width]


def mean_over(errors: Float[Array, "h w"], pixels: Bool[Array, "h w"]) -> Float[Array, ""]:
    """Mean error of some pixels; 0 for none."""
    return jnp.sum(jnp.where(pixels, errors, 0.0)) / jnp.maximum(jnp.sum(pixels, dtype=errors.dtype), 1.0)


def views_of_step(step: Int[Array, ""], valid: Bool[Array, " v"], config: RefineConfig) -> Int[Array, " b"]:
    """Slots of the `VIEWS_PER_STEP` views that a step shows; `valid` marks the slots that hold a view."""
    places = step * VIEWS_PER_STEP + jnp.arange(VIEWS_PER_STEP, dtype=jnp.int32)
    return jax.vmap(lambda place: next_view(place, valid, config.seed))(places)


def next_view(place: Int[Array, ""], valid: Bool[Array, " v"], seed: int) -> Int[Array, ""]:
    """Slot of the view at `place` in the sequence of all steps' views.

    Every valid view is shown once a round. Any few views in a row lie evenly among the valid ones, which are in the
    order of the stream: in an order drawn by chance they do not, and what no view shows for a while stays as it was.
    A round begins at a place of its own, drawn by `seed`.
    """
    num_valid = jnp.maximum(jnp.sum(valid, dtype=jnp.int32), 1)
    begin = jax.random.uniform(jax.random.fold_in(jax.random.key(seed), place // num_valid), dtype=jnp.float32)
    ranks = jnp.cumsum(valid, dtype=jnp.int32) - 1
    order = jnp.argsort(jnp.where(valid, (golden_fractions(ranks) + begin) % 1.0, 2.0))
    return order[place % num_valid].astype(jnp.int32)


def golden_fractions(numbers: Int[Array, " n"]) -> Float[Array, " n"]:
    """Fractional parts of numbers over the golden ratio: those of any few numbers in a row lie evenly in [0, 1]."""
    return (numbers.astype(jnp.uint32) * jnp.uint32(GOLDEN)).astype(jnp.float32) / 2.0**32  # the product wraps around


def only_usable(gaussians: Gaussians, key_views: KeyViews, max_pairs: int, tile: int = TILE) -> KeyViews:
    """`key_views` whose unusable views are not valid. It looks at values: call it outside jit.

    A view is unusable if its exposure is not finite and positive, if its camera is not finite, or if its error is more
    than twice the median of all views: a black frame, another scene, a pose that is far off. At most a quarter of the
    views is left out for the error, the worst first, and none of fewer than four views. The error is the mean over
    what the scene covers, so a view of little known places stays.

    Raises:
        InputError: no view is left.
    """
    is_usable = np.array(_usable(key_views))
    slots, on_host = np.flatnonzero(is_usable), jax.device_get(key_views)
    errors = np.array([float(_covered_error(gaussians, on_host.at(slot), max_pairs, tile)) for slot in slots])
    is_usable[slots[contradicting(errors)]] = False
    if not is_usable.any():
        raise InputError(
            "refine: wanted at least one view with a finite camera and a positive, finite exposure, got none of"
            f" {key_views.num_slots}."
        )
    return replace(key_views, valid=jax.device_put(is_usable))


_usable = Kept(usable)


def contradicting(errors: Float[np.ndarray, " v"]) -> Int[np.ndarray, " b"]:
    """Places of the errors that are too large beside the others, see `only_usable`; NaN is never too large."""
    is_known = np.isfinite(errors)
    if is_known.sum() < MIN_COMPARED:
        return np.zeros(0, int)
    worst_first = np.argsort(-np.where(is_known, errors, -1.0), kind="stable")[: int(MAX_LEFT_OUT * is_known.sum())]
    return worst_first[errors[worst_first] > WORSE_THAN_USUAL * np.median(errors[is_known])]


@functools.partial(Kept, static_argnums=(2, 3))
def _covered_error(gaussians: Gaussians, view: KeyViews, max_pairs: int, tile: int) -> Float[Array, ""]:
    """Mean absolute error of a view over what the scene covers of it; NaN if it covers next to nothing."""
    out = render(gaussians, view.camera(), effects=EFFECTS, max_pairs=max_pairs, tile=tile)
    alpha = out.alpha if view.seen is None else jnp.where(view.seen, out.alpha, 0.0)
    # The uncovered share of a pixel is compared with nothing.
    errors = jnp.mean(jnp.abs(out.color * view.exposures - out.alpha[..., None] * view.colors), axis=-1)
    errors = errors if view.seen is None else jnp.where(view.seen, errors, 0.0)
    cover = jnp.sum(alpha)
    return jnp.where(cover > 0.01 * alpha.size, jnp.sum(errors) / jnp.maximum(cover, 1.0), jnp.nan)
