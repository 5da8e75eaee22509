"""Random camera paths through free space that imitate hand-held video.

A path is generated step by step. Each style gives the wanted direction of the next step and of the gaze. The step is
deflected if it would come too close to a surface, and the gaze follows with some inertia. Step lengths are fractions of
the visible median depth, because matching depends on parallax instead of distance.
"""

import dataclasses

import numpy as np
from jaxtyping import Float

from ssplat_jax.data.procedural.scene import Scene, clearance

UP = np.array([0.0, -1.0, 0.0])
MAX_IRREGULARITY = 0.7  # largest deviation of the log of a path's steps; the smallest, 0.1, is an even walk
MIN_CLEARANCE = 0.45  # meters to all surfaces, where a path can keep them
MAX_STEP_FACTOR = 3.0  # largest ratio of a step to the typical step, in either direction


@dataclasses.dataclass
class _Walker:
    """State of the camera along a path."""

    position: np.ndarray
    heading: np.ndarray  # unit
    gaze: np.ndarray  # unit
    roll: float
    turn: float  # sense of rotation of an orbit or pan, -1 or 1


def sample_path(
    seed: int, scene: Scene, kind: str, num_views: int, height: int, width: int, *, step: float
) -> tuple[Float[np.ndarray, "v 4 4"], Float[np.ndarray, "v 3 3"]]:
    """The camera-to-world poses of a random path through a scene, and the intrinsics that they share.

    `step` is the typical distance between consecutive views. `kind` is one of `PATH_KINDS`.
    """
    rng = np.random.default_rng([2, seed])
    rng.random()  # as in `sample_scene`
    walker = _start(rng, scene, kind)
    wobble, irregularity = rng.uniform(0.0, 0.03), rng.uniform(0.1, MAX_IRREGULARITY)
    poses = []
    for _ in range(num_views):
        forward = _unit(walker.gaze + wobble * rng.standard_normal(3))
        poses.append(look_along(walker.position, forward, walker.roll))
        factor = np.clip(np.exp(irregularity * rng.standard_normal()), 1 / MAX_STEP_FACTOR, MAX_STEP_FACTOR)
        _advance(rng, scene, walker, _STYLES[kind], step * float(factor))
    return np.stack(poses).astype(np.float32), _intrinsics(rng, num_views, height, width)


def _intrinsics(rng: np.random.Generator, num_views: int, height: int, width: int) -> np.ndarray:
    """A focal length of 0.6 to 1.3 long sides and a principal point up to 4 % off the center."""
    focal = np.exp(rng.uniform(np.log(0.6), np.log(1.3))) * max(height, width)
    cx, cy = (0.5 + rng.uniform(-0.04, 0.04, 2)) * [width, height]
    K = np.array([[focal, 0, cx], [0, focal * rng.uniform(0.99, 1.01), cy], [0, 0, 1]], np.float32)
    return np.tile(K, (num_views, 1, 1))


# -- steps ------------------------------------------------------------------------------------------------------------


def _start(rng: np.random.Generator, scene: Scene, kind: str) -> _Walker:
    """Walker at a random free point: around the focus for an orbit, near the eye otherwise."""
    radius, focus = float(scene.orbit_radius), np.asarray(scene.focus, np.float64)
    heading = _unit(rng.standard_normal(3) * [1, 0.15, 1])
    if kind in ("orbit", "gazing"):
        azimuth, elevation = rng.uniform(0, 2 * np.pi, 64), rng.uniform(0.05, 0.9, 64)
        around = [np.cos(elevation) * np.sin(azimuth), -np.sin(elevation), np.cos(elevation) * np.cos(azimuth)]
        spots = focus + radius * rng.uniform(0.85, 1.15) * np.stack(around, axis=-1)
    else:
        spots = np.asarray(scene.eye, np.float64) + radius * 0.8 * rng.standard_normal((64, 3)) * [1, 0.15, 1]
    spots = np.concatenate([spots, np.asarray(scene.eye, np.float64)[None]])
    free = clearance(scene, spots)
    ok = np.flatnonzero(free > 1.3 * MIN_CLEARANCE)
    position = spots[ok[0] if len(ok) else int(np.argmax(free))]
    to_focus = _unit(focus - position)
    if kind in ("orbit", "gazing"):
        gaze = to_focus
    else:
        # Most paths start with a view across the middle of the world, where most objects are.
        gaze = _level((to_focus if rng.random() < 0.6 else heading) + rng.normal(0, 0.2, 3))
    heading = gaze if kind == "forward" else heading
    return _Walker(position, heading, gaze, rng.normal(0, 0.06), float(rng.choice([-1.0, 1.0])))


def _advance(rng, scene: Scene, walker: _Walker, style, distance: float) -> None:
    """Moves the walker by one step and turns its gaze."""
    wish, gaze, share, inertia = style(rng, scene, walker)
    walker.heading = _free_heading(rng, scene, walker, wish, distance * share)
    walker.position = walker.position + distance * share * walker.heading
    walker.gaze = _unit(inertia * walker.gaze + (1 - inertia) * gaze)
    walker.roll = 0.9 * walker.roll + rng.normal(0, 0.01)


def _free_heading(rng, scene: Scene, walker: _Walker, wish: np.ndarray, distance: float):
    """Direction near `wish` that stays clear of surfaces for this step and the next two."""
    ahead = distance * np.array([1.0, 3.0])
    if clearance(scene, walker.position + ahead[:, None] * wish).min() > MIN_CLEARANCE:
        return wish
    options = wish + rng.standard_normal((32, 3)) * np.linspace(0.1, 3, 32)[:, None] * [1, 0.3, 1]
    options /= np.maximum(np.linalg.norm(options, axis=-1, keepdims=True), 1e-9)
    points = walker.position + ahead[:, None, None] * options
    free = clearance(scene, points.reshape(-1, 3)).reshape(2, -1).min(axis=0)
    ok = np.flatnonzero(free > MIN_CLEARANCE)
    return options[ok[0] if len(ok) else int(np.argmax(free))]


def look_along(position: np.ndarray, forward: np.ndarray, roll: float = 0.0) -> Float[np.ndarray, "4 4"]:
    """The camera-to-world pose at `position` with +z along the unit vector `forward`, level up to `roll`."""
    right = _unit(np.cross(forward, UP))
    down = np.cross(forward, right)
    c, s = np.cos(roll), np.sin(roll)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([c * right + s * down, c * down - s * right, forward], axis=-1)
    pose[:3, 3] = position
    return pose


def look_at(position: np.ndarray, target: np.ndarray) -> Float[np.ndarray, "4 4"]:
    """The level camera-to-world pose at `position` that looks at `target`."""
    return look_along(position, _unit(target - position))


def _unit(x: np.ndarray) -> np.ndarray:
    """`x` at unit length."""
    return x / max(float(np.linalg.norm(x)), 1e-9)


def _turned(direction: np.ndarray, angle: float) -> np.ndarray:
    """`direction` rotated about the vertical axis."""
    c, s = np.cos(angle), np.sin(angle)
    x, y, z = direction
    return np.array([c * x + s * z, y, -s * x + c * z])


def _level(direction: np.ndarray) -> np.ndarray:
    """Unit vector of `direction` at half its steepness."""
    return _unit(direction * [1.0, 0.5, 1.0])


# -- styles: (wanted heading, wanted gaze, share of the step taken, inertia of the gaze) -------------------------------


def _forward(rng, scene: Scene, walker: _Walker):
    """Moves in the viewing direction and sways."""
    heading = _level(_turned(walker.heading, rng.normal(0, 0.08)) + rng.normal(0, 0.04) * UP)
    return heading, _unit(heading + rng.normal(0, 0.15, 3) * [1, 0.5, 1]), 1.0, 0.8


def _sideways(rng, scene: Scene, walker: _Walker):
    """Moves at right angles to the gaze."""
    heading = _level(_turned(walker.gaze, walker.turn * np.pi / 2) + rng.normal(0, 0.15, 3))
    return heading, _level(_turned(walker.gaze, rng.normal(0, 0.03))), 1.0, 0.7


def _orbit(rng, scene: Scene, walker: _Walker):
    """Circles the focus at varying height and looks at it."""
    to_focus = np.asarray(scene.focus, np.float64) - walker.position
    tangent = walker.turn * _unit(np.cross(to_focus, UP))
    drift = (np.linalg.norm(to_focus) / float(scene.orbit_radius) - 1) * _unit(to_focus)
    climb = 0.8 * walker.heading[1] + rng.normal(0, 0.15)
    return _unit(tangent + drift + [0, climb, 0]), _unit(to_focus), 1.0, 0.3


def _pan(rng, scene: Scene, walker: _Walker):
    """Turns in place, with small movements."""
    gaze = _turned(walker.gaze, walker.turn * rng.uniform(0.1, 0.35)) + rng.normal(0, 0.05) * UP
    wish = _level(_turned(walker.gaze, walker.turn * np.pi / 2) + rng.normal(0, 0.3, 3))
    return wish, _unit(gaze), 0.8, 0.5


def _handheld(rng, scene: Scene, walker: _Walker):
    """Wanders in three dimensions with a drifting gaze."""
    heading = _unit(walker.heading + rng.normal(0, 0.4, 3) * [1, 0.6, 1])
    return heading, _unit(walker.gaze + rng.normal(0, 0.12, 3) * [1, 0.5, 1]), 1.0, 0.6


def _gazing(rng, scene: Scene, walker: _Walker):
    """Wanders in front of the focus and looks near it."""
    to_focus = np.asarray(scene.focus, np.float64) - walker.position
    drift = (np.linalg.norm(to_focus) / float(scene.orbit_radius) - 1) * _unit(to_focus)
    heading = _unit(walker.heading + drift + rng.normal(0, 0.4, 3) * [1, 0.6, 1])
    return heading, _unit(_unit(to_focus) + rng.normal(0, 0.15, 3)), 1.0, 0.6


_STYLES = {style.__name__[1:]: style for style in (_forward, _sideways, _orbit, _gazing, _pan, _handheld)}
PATH_KINDS = tuple(_STYLES)
