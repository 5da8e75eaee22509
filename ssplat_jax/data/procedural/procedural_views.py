"""Rendered procedural views: random samples for training and smooth captures for the demo."""

import dataclasses
from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from ssplat_jax.core.errors import InputError
from ssplat_jax.data.procedural.paths import look_at, sample_path
from ssplat_jax.data.procedural.raycast import raycast
from ssplat_jax.data.procedural.scene import NUM_SOLIDS, Scene, clearance, fade_scene, scale_scene
from ssplat_jax.data.procedural.scenes import SCENE_KINDS, SCENE_SHARES, SKY_DISTANCE, sample_scene

ViewArrays = tuple[
    Float[np.ndarray, "v h w 3"], Float[np.ndarray, "v h w"], Float[np.ndarray, "v 4 4"], Float[np.ndarray, "v 3 3"]
]

MIN_DEPTH, MAX_DEPTH = 0.3, 15.0  # of a training sample, in its units
MEDIANS = (1.2, 3.5)  # range of the median depth of a training sample
STEP_RANGE = (0.005, 0.4)  # typical step over median depth: from consecutive video frames to a set of photos
BASELINES = (0.004, 0.45)  # range of the median step over the median depth of a training sample
MIN_DEPTH_RATIO = 1.4  # 95th over 5th percentile of depth; samples with less show little but a wall
_FIRST_STEPS = 4  # views that measure the depth before the path is generated
_PROBE = 8  # the depth that determines the scale of a sample has this many times fewer rows and columns
_PATHS = {  # suitable paths by kind of world; repeated ones are more likely
    "room": ("handheld", "handheld", "sideways", "forward", "pan", "orbit"),
    "corridor": ("forward", "forward", "handheld", "sideways"),
    "street": ("forward", "handheld", "sideways", "pan"),
    "objects": ("orbit", "orbit", "orbit", "gazing"),
    "clutter": ("handheld", "sideways", "forward", "pan", "orbit"),
    "yard": ("sideways", "sideways", "gazing", "orbit", "handheld", "forward"),
}


def training_sample(
    seed: int,
    num_views: int,
    height: int,
    width: int,
    *,
    steps: tuple[float, float] = STEP_RANGE,
    kinds: tuple[str, ...] = (),
) -> ViewArrays:
    """Rendered views of a random path through a random world.

    The units of a sample are such that the median depth is between 1.2 and 3.5 and all surfaces are between about 0.3
    and 15 away, but for the sky.

    Args:
        seed: the same arguments give the same sample.
        num_views: number of views, in the order of time.
        height: image rows.
        width: image columns.
        steps: range of the typical distance between consecutive views over the median depth, log-uniform. Single steps
            are up to three times as long.
        kinds: kinds of worlds, of which one is drawn; repeated ones are more likely. Empty: all but yards, with their
            shares.

    Returns:
        Images in [0, 1], z-depths (of yards, infinite beyond `SKY_DISTANCE`), camera-to-world poses and intrinsics in
        pixels.
    """
    rng = np.random.default_rng([3, seed])
    found = None
    while found is None:
        kind = str(rng.choice(kinds)) if kinds else str(rng.choice(SCENE_KINDS, p=SCENE_SHARES))
        scene = sample_scene(int(rng.integers(2**31)), kind)
        sky = SKY_DISTANCE if kind == "yard" else np.inf
        found = _scaled_path(rng, scene, _PATHS[kind], num_views, height, width, steps, sky)
    scene, poses, Ks, factor = found
    # One ray a pixel costs a third of two.
    images, depths = map(np.asarray, raycast(scene, _inverted(poses), Ks, height, width, 1))
    depths = np.where(depths < factor * sky, depths, np.inf).astype(np.float32)
    return _through_sensor(rng, scene, images), depths, poses, Ks


def _scaled_path(rng, scene: Scene, kinds: tuple[str, ...], num_views: int, height: int, width: int, steps, sky: float):
    """Scene, poses, intrinsics and length of a meter in the units of the sample; None if the path is unsuitable."""
    kind = kinds[rng.integers(len(kinds))]
    seed = int(rng.integers(2**31))
    step = np.exp(rng.uniform(*np.log(steps)))
    # A few views measure the median depth, which determines the steps of the whole path.
    poses, Ks = sample_path(seed, scene, kind, _FIRST_STEPS, height, width, step=step * float(scene.orbit_radius) * 1.5)
    depths = _probe(scene, poses, Ks, height, width, sky)
    if not len(depths):
        return None
    poses, Ks = sample_path(seed, scene, kind, num_views, height, width, step=step * float(np.median(depths)))
    depths = _probe(scene, poses, Ks, height, width, sky)
    if not len(depths):
        return None
    median = float(np.median(depths))
    target = rng.uniform(*MEDIANS)
    factor = min(max(target / median, 1.1 * MIN_DEPTH / float(depths.min())), 0.9 * MAX_DEPTH / float(depths.max()))
    free = factor * clearance(scene, poses[:, :3, 3]).min()
    baselines = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=-1) / median
    is_flat = np.quantile(depths, 0.95) < MIN_DEPTH_RATIO * np.quantile(depths, 0.05)
    if free < MIN_DEPTH or factor * depths.min() < 1.09 * MIN_DEPTH or not MEDIANS[0] <= factor * median <= MEDIANS[1]:
        return None
    if is_flat or (num_views > 1 and not BASELINES[0] <= np.median(baselines) <= BASELINES[1]):
        return None
    poses[:, :3, 3] *= np.float32(factor)
    return scale_scene(scene, factor), poses, Ks, factor


def _probe(scene: Scene, poses: np.ndarray, Ks: np.ndarray, height: int, width: int, sky: float) -> np.ndarray:
    """Depths below `sky` of all views, at a low resolution; none if most of the pixels are farther."""
    rows, cols = max(height // _PROBE, 12), max(width // _PROBE, 12)
    coarse = Ks * np.array([cols / width, rows / height, 1], np.float32)[:, None]
    depths = np.asarray(raycast(scene, _inverted(poses), coarse, rows, cols, 0)[1])
    nearer = depths[depths < sky]
    return nearer if 2 * len(nearer) > depths.size else nearer[:0]


def _inverted(poses: np.ndarray) -> np.ndarray:
    """World-to-camera matrices of camera-to-world poses, inverted in float64."""
    return np.linalg.inv(poses.astype(np.float64)).astype(np.float32)


def _through_sensor(rng: np.random.Generator, scene: Scene, images: np.ndarray) -> np.ndarray:
    """Applies an automatic exposure, and the gains per view and the noise of the scene's sensor."""
    mean = float(images.mean())
    gains = np.clip(mean, 0.3, 0.6) / mean * np.exp(float(scene.exposure_jitter) * rng.standard_normal(len(images)))
    images = images * gains.astype(np.float32)[:, None, None, None]
    if scene.sensor_noise:
        images = images + np.float32(scene.sensor_noise) * rng.standard_normal(images.shape, np.float32)
    return np.clip(images, 0, 1)


# -- captures for the demo --------------------------------------------------------------------------------------------


def procedural_capture_arrays(name: str, num_frames: int, height: int, width: int, seed: int = 0) -> ViewArrays:
    """The views of the capture `procedural:NAME` in meters.

    `room`, `orbit` and `corridor` are smooth paths that cover their world evenly. `revisit` has weak textures, noise
    and a path that returns: half of its views go around a room, then the camera stands at four places, closer to what
    it saw before, and hardly moves. `laps` walks the path of `room` again and again. Another `seed` selects another
    world of the same kind.
    """
    if name not in CAPTURES:
        options = "with the options ?frames=73&size=128x96&seed=0&depth=on"
        raise InputError(f"procedural:{name}: no such capture; there is {', '.join(CAPTURES)}, {options}.")
    route = _ROUTES[name]
    rng = np.random.default_rng([4, route.first_seed + seed])
    while True:
        scene = fade_scene(sample_scene(int(rng.integers(2**31)), route.kind, only_used=True), route.contrast)
        places = (np.arange(num_frames) + 0.5) / num_frames
        poses = np.stack([route.pose(scene, place) for place in places]).astype(np.float32)
        if clearance(scene, poses[:, :3, 3]).min() > MIN_DEPTH:
            break
    focal = 0.8 * max(height, width)
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]], np.float32)
    Ks = np.tile(K, (num_frames, 1, 1))
    images, depths = map(np.asarray, raycast(scene, _inverted(poses), Ks, height, width, 2))
    images = images * np.float32(np.clip(images.mean(), 0.38, 0.55) / images.mean())
    if route.noise:
        images = images + np.float32(route.noise) * rng.standard_normal(images.shape, np.float32)
    return np.clip(images, 0, 1), depths, poses, Ks


def _around_room(scene: Scene, s: float) -> np.ndarray:
    """Pose after `s` laps on a circle around the middle of a room, looking across it."""
    angle = 2 * np.pi * s
    position = np.array([0.5 * np.sin(angle), -1.4 + 0.15 * np.sin(3 * angle), 0.5 * np.cos(angle)])
    return look_at(position, np.array([-np.sin(angle), -1.15, -np.cos(angle)]))


def _around_object(scene: Scene, s: float) -> np.ndarray:
    """Pose at `s` in [0, 1] on a circle of varying height around the pile of objects."""
    angle, focus, radius = 2 * np.pi * s, np.asarray(scene.focus, np.float64), 1.15 * float(scene.orbit_radius)
    elevation = 0.45 + 0.2 * np.sin(2 * angle)
    around = [np.cos(elevation) * np.sin(angle), -np.sin(elevation), np.cos(elevation) * np.cos(angle)]
    return look_at(focus + radius * np.array(around), focus)


def _along_corridor(scene: Scene, s: float) -> np.ndarray:
    """Pose at `s` in [0, 1] on the way along a corridor, looking left and right."""
    half_z = float(scene.halves[NUM_SOLIDS, 2])
    position = np.array([0.12 * np.sin(9 * s), -1.45 + 0.05 * np.sin(14 * s), half_z * (-0.85 + 1.3 * s)])
    return look_at(position, position + np.array([0.45 * np.sin(11 * s), 0.12, 1.0]))


_FIRST_LOOK = 0.5  # share of the views of `revisit` that go around the room
_STEP_AHEAD = 0.6  # meters by which its later places are nearer
_SWAY = 0.015  # meters to either side that the camera moves there


def _back_in_room(scene: Scene, s: float) -> np.ndarray:
    """Pose at `s` in [0, 1]: around the room, then at four places of that circle, nearer to the wall across."""
    if s < _FIRST_LOOK:
        return _around_room(scene, s / _FIRST_LOOK)
    place, time = divmod(4 * (s - _FIRST_LOOK) / (1 - _FIRST_LOOK), 1)
    pose = _around_room(scene, (place + 0.5) / 4)
    pose[:3, 3] += _STEP_AHEAD * pose[:3, 2] + _SWAY * (np.sin(2 * np.pi * time) * pose[:3, 0])
    return pose


@dataclasses.dataclass(frozen=True)
class _Route:
    """A capture: the kind of world, the path through it, and how well its surfaces can be matched."""

    kind: str
    pose: Callable[[Scene, float], np.ndarray]
    first_seed: int  # of a representative world, which is added to the user's
    contrast: float = 1.0  # of the textures, as a fraction
    noise: float = 0.0  # standard deviation of a pixel's noise


_LAPS = 9.7  # no whole number, so that the laps of a round number of frames share no view

_ROUTES = {
    "room": _Route("room", _around_room, 13),
    "laps": _Route("room", lambda scene, s: _around_room(scene, _LAPS * s), 13),
    "orbit": _Route("objects", _around_object, 3),
    "corridor": _Route("corridor", _along_corridor, 8),
    "revisit": _Route("room", _back_in_room, 13, contrast=0.2, noise=0.01),
}
CAPTURES = tuple(_ROUTES)
