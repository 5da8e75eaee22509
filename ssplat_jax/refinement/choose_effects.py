"""The effects that a scene's residuals call for."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from ssplat_jax.cache.key_views import KeyViews
from ssplat_jax.core.errors import InputError
from ssplat_jax.core.gaussians import Gaussians
from ssplat_jax.refinement.refine_config import RefineConfig
from ssplat_jax.refinement.refine_effects import NAMES, RefineEffects
from ssplat_jax.refinement.view_residuals import ViewResiduals, view_residuals

MOST_LOOKED_AT = 16
"""Most key views whose residuals are fitted, evenly spread: each fit renders its view."""
FEWEST_FITS = 3
"""Fits that a verdict needs; with fewer nothing is asked for."""
SMALLEST_EXPLAINED = 0.05
"""Share of the squared residual that pose and focal length must explain for one of them to be revised."""
ENOUGH_EXPLAINED = 0.8
"""Fraction of what both explain: the focal length, or else the pose, is the only reason if it explains more."""
SMALLEST_GAIN = 0.03
"""Spread of log exposures over views above which they are revised."""
SMALLEST_TINT = 0.015
"""Spread of the channels' log exposures around their mean above which white balance is revised."""


@dataclasses.dataclass(frozen=True)
class EffectsChoice:
    """Effects with the measurement behind each."""

    effects: RefineEffects
    reasons: tuple[str, ...]  # a sentence for every effect, on or off


def refine_effects_for(gaussians: Gaussians, key_views: KeyViews) -> EffectsChoice:
    """The fewest effects that explain why key views differ from the scene. Call it outside jit.

    Up to 16 key views are rendered, and the residual of each is fitted by a small motion of its camera, a focal length
    and exposures (`view_residuals`). An effect is on if the median over these views is beyond a bound; errors of the
    scene alone stay below it.

    Args:
        gaussians: the scene.
        key_views: the views; those that are not valid are left out.

    Returns:
        The effects, with a reason for each.
    """
    slots = np.flatnonzero(np.asarray(key_views.valid))
    places = sorted({round(x) for x in np.linspace(0, len(slots) - 1, min(len(slots), MOST_LOOKED_AT))})
    return choose_effects(view_residuals(gaussians, key_views, [int(slots[p]) for p in places]))


def choose_effects(residuals: ViewResiduals) -> EffectsChoice:
    """The verdict of `refine_effects_for` on given fits."""
    fitted = np.isfinite(residuals.errors)
    if fitted.sum() < FEWEST_FITS:
        reason = f"wanted {FEWEST_FITS} views that the scene covers, got {fitted.sum()}; nothing is revised"
        return EffectsChoice(RefineEffects(), (reason,))
    turn = float(np.degrees(np.median(np.linalg.norm(residuals.twists[fitted, :3], axis=1))))
    motion = float(np.median(np.linalg.norm(residuals.twists[fitted, 3:], axis=1)))
    log_focal = float(np.median(residuals.log_focals[fitted]))
    by_focal, by_pose, by_both = (float(x) for x in np.median(residuals.explained[fitted], axis=0))
    is_off = by_both > SMALLEST_EXPLAINED
    focal = is_off and (by_focal > ENOUGH_EXPLAINED * by_both or by_pose < ENOUGH_EXPLAINED * by_both)
    poses = is_off and by_focal <= ENOUGH_EXPLAINED * by_both
    gains = residuals.log_gains[fitted]
    brightness = gains.mean(axis=1, keepdims=True)
    gain, tint = _spread(brightness), float(np.max([_spread(c) for c in (gains - brightness).T]))
    effects = RefineEffects(
        poses=poses, focal=focal, exposures=gain > SMALLEST_GAIN, white_balance=tint > SMALLEST_TINT
    )
    reasons = (
        f"poses {_is(poses)}: turning cameras by {turn:.2f} degrees and moving them by {100 * motion:.1f} % of the"
        f" depth explains {100 * by_pose:.0f} % of the squared residual",
        f"focal {_is(focal)}: changing focal lengths by {100 * log_focal:+.1f} % explains {100 * by_focal:.0f} % of it",
        f"exposures {_is(effects.exposures)}: the brightness of views varies by {100 * gain:.1f} %",
        f"white_balance {_is(effects.white_balance)}: the tint of views varies by {100 * tint:.1f} %",
    )
    return EffectsChoice(effects, reasons)


def effects_by_name(
    names: Sequence[str], gaussians: Gaussians, key_views: KeyViews, *, poses_stay: bool = False
) -> EffectsChoice:
    """The effects of the given names: some of `poses`, `focal`, `exposures`, `white_balance`, or `auto` alone.

    Args:
        names: the effects.
        gaussians: the scene; only `auto` looks at it.
        key_views: the views to compare with it; only `auto` looks at them.
        poses_stay: leaves `poses` off: they were adjusted before the stream, and gradients would follow errors of the
            scene.

    Returns:
        The effects; reasons come with `auto`, and with `poses` if they stay.

    Raises:
        InputError: a name is unknown, or `auto` comes with others.
    """
    if tuple(names) == ("auto",):
        choice = refine_effects_for(gaussians, key_views)
    elif unknown := [name for name in names if name not in NAMES]:
        raise InputError(f"refine: wanted effects among auto (alone), {', '.join(NAMES)}; got {unknown[0]!r}.")
    else:
        choice = EffectsChoice(RefineEffects(**{name: True for name in names}), ())
    if not poses_stay:
        return choice
    reasons = tuple(reason for reason in choice.reasons if not reason.startswith("poses"))
    if "poses" in names:
        reasons += ("poses stay: they were adjusted before the stream",)
    return EffectsChoice(dataclasses.replace(choice.effects, poses=False), reasons)


def with_effects(config: RefineConfig, choice: EffectsChoice) -> RefineConfig:
    """`config` with the effects of `choice` on besides its own."""
    chosen = {name: True for name in choice.effects.names}
    return dataclasses.replace(config, effects=dataclasses.replace(config.effects, **chosen))


def _spread(values: np.ndarray) -> float:
    """Median distance from the median."""
    return float(np.median(np.abs(values - np.median(values))))


def _is(on: bool) -> str:
    return "on" if on else "off"
