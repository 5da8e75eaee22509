"""Camera walks through a made world: hand-held walks, orbits and returns, clear of the objects."""

import numpy as np

from ssplat_jax.data.worlds.rooms import World

CLEARANCE = 0.3  # meters


def sample_walk(world: World, rng: np.random.Generator, num_frames: int) -> np.ndarray:
    """Camera-to-world poses (v, 4, 4) with OpenGL axes, meters; two of three return to their start."""
    middle, reach = world.high / 2, world.high / 2
    phase, turn = rng.uniform(0, 2 * np.pi), rng.uniform(0.5, 2.0) * rng.choice([-1, 1])
    t = np.linspace(0, 1, num_frames)
    if rng.random() < 0.33:
        t = 1 - np.abs(2 * t - 1)
    angle = phase + turn * t
    radius = rng.uniform(0.35, 0.65) * (1 + 0.15 * np.sin(3 * t + phase))
    eye_height = rng.uniform(1.2, 1.7) + 0.1 * np.sin(5 * t + phase)
    inward = rng.random() < 0.6  # looks across the world, or along the walk
    poses = []
    for a, r, z in zip(angle, radius, eye_height, strict=True):
        eye = np.array([middle[0] + r * reach[0] * np.cos(a), middle[1] + r * reach[1] * np.sin(a), z])
        across = a + np.pi + 0.3 * np.sin(2 * a) if inward else a + turn / abs(turn) * 1.9
        gaze = np.array([np.cos(across), np.sin(across), -0.22 + 0.1 * np.sin(3 * a)])
        poses.append(look(eye, gaze + rng.normal(0, 0.01, 3)))
    return np.stack(poses)


def look(eye: np.ndarray, gaze: np.ndarray) -> np.ndarray:
    """Camera-to-world pose (OpenGL axes) at `eye` that looks along `gaze`, with z up."""
    back = -gaze / np.linalg.norm(gaze)
    right = np.cross([0, 0, 1.0], back)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3] = np.stack([right, np.cross(back, right), back, eye], 1)
    return pose


def num_blocked(world: World, poses: np.ndarray) -> int:
    """Number of poses closer than `CLEARANCE` to the box of an object."""
    eyes = poses[:, None, :3, 3]
    gap = np.maximum(np.maximum(world.obstacles[:, 0] - eyes, eyes - world.obstacles[:, 1]), 0)
    return int((np.linalg.norm(gap, axis=2).min(1) < CLEARANCE).sum())
