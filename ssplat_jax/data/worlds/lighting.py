"""Light of the made worlds, baked per vertex: a sky term darkened near objects, and shadowed Lambert lights."""

import numpy as np

from ssplat_jax.data.worlds.rooms import World


def bake(world: World, rng: np.random.Generator) -> list[np.ndarray]:
    """Returns RGB light of every vertex, one array (n, 3) a mesh."""
    if world.outdoor:
        lights = [
            (
                np.array([30.0, 18, 40]) * rng.choice([-1, 1], 3) * [1, 1, 0] + [0, 0, 40],
                np.array([0.8, 0.74, 0.62]),
                0.0,
            )
        ]
        ambient = np.array([0.42, 0.46, 0.54])
    else:
        places = rng.uniform(0.2, 0.8, (int(rng.integers(2, 4)), 2)) * world.high[:2]
        warm = rng.uniform(-0.12, 0.12)
        tint = np.array([1 + warm, 1, 1 - warm])
        lights = [(np.array([*p, world.high[2] - 0.15]), tint * rng.uniform(0.5, 0.8), 0.18) for p in places]
        ambient = 0.36 * tint
    return [_light(mesh.points, mesh.normals, world, lights, ambient) for mesh in world.meshes]


def _light(points, normals, world, lights, ambient) -> np.ndarray:
    low, high = world.obstacles[:, 0], world.obstacles[:, 1]
    lifted = points + 0.02 * normals
    gap = np.maximum(np.maximum(low - lifted[:, None], lifted[:, None] - high), 0)
    near = np.exp(-np.linalg.norm(gap, axis=2) / 0.12) * (np.linalg.norm(gap, axis=2) > 1e-9)
    open_sky = np.clip(1 - 0.35 * near.max(1), 0.4, 1)
    if not world.outdoor:
        walls = np.minimum(points, world.high - points)
        open_sky *= 1 - 0.3 * np.exp(-np.sort(np.abs(walls), 1)[:, 1] / 0.25)
    total = open_sky[:, None] * ambient * (0.85 + 0.15 * normals[:, 2:])
    for position, color, falloff in lights:
        ray = position - lifted
        distance = np.linalg.norm(ray, axis=1)
        facing = np.clip((ray * normals).sum(1) / distance, 0, 1)
        lit = 1 - 0.75 * _blocked(lifted, ray, low, high)
        total = total + (facing * lit / (1 + falloff * distance**2))[:, None] * color * (1 if world.outdoor else 1.4)
    return total


def _blocked(points, rays, low, high) -> np.ndarray:
    """True if the segment to a light passes through the middle of an object's box."""
    shrink = 0.1 * (high - low)
    inverse = 1 / np.where(np.abs(rays) < 1e-9, 1e-9, rays)[:, None]
    t0, t1 = (low + shrink - points[:, None]) * inverse, (high - shrink - points[:, None]) * inverse
    enter, leave = np.minimum(t0, t1).max(2), np.maximum(t0, t1).min(2)
    return ((leave > np.maximum(enter, 0)) & (enter > 0.0) & (enter < 1)).any(1).astype(float)
