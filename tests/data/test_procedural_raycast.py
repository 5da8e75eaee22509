"""Ray caster: comparison with analytic rays in float64, and consistency of depth between views."""

import numpy as np
import pytest
from scipy.ndimage import generate_binary_structure, maximum_filter, minimum_filter

from ssplat_jax.data.procedural.paths import look_at, sample_path
from ssplat_jax.data.procedural.raycast import raycast
from ssplat_jax.data.procedural.scene import Finish, SceneBuilder, random_rotation, scale_scene
from ssplat_jax.data.procedural.scenes import sample_scene
from ssplat_jax.data.procedural.textures import TextureLibrary

HEIGHT, WIDTH = 48, 64
ROOM = np.array([4.0, 3.0, 5.0])  # half of its sides
DEPTH_TOLERANCE = 2e-5  # relative; a few float32 roundings
COLOR_TOLERANCE = 1.5 / 255  # texels have 8 bits


def inverted(poses):
    return np.linalg.inv(poses.astype(np.float64)).astype(np.float32)


def empty_builder():
    """A shell, with a library of a white tile and of one with a dark left half."""
    tiles = np.full((2, 256, 256, 3), 255, np.uint8)
    tiles[1, :, :128] = 51
    b = SceneBuilder(np.random.default_rng(0), TextureLibrary(tiles, {"wall": np.array([0, 1])}))
    white = Finish((0,), glow=1.0, gain=(0.2, 0.4, 0.6))
    b.shell([0, 0, 0], ROOM, white, white, white)
    b.dome(100.0, white)
    return b


def built(b):
    return b.build(focus=[0, 0, 0], orbit_radius=1.0, eye=[0, 0, 0])


def slab_depths(origin, directions, center, half, rotation):
    """Depths at which rays enter and leave a rotated box."""
    start, step = (origin - center) @ rotation, directions @ rotation
    with np.errstate(divide="ignore"):
        a, b = (-half - start) / step, (half - start) / step
    return np.minimum(a, b).max(-1), np.maximum(a, b).min(-1)


def ball_entry(origin, directions, center, radius):
    offset = origin - center
    a, b, c = (directions**2).sum(-1), directions @ offset, offset @ offset - radius**2
    root = b * b - a * c
    return np.where(root >= 0, (-b - np.sqrt(np.maximum(root, 0))) / a, np.inf)


def cylinder_entry(origin, directions, center, radius, half, rotation):
    start, step = (origin - center) @ rotation, directions @ rotation
    a = step[..., 0] ** 2 + step[..., 2] ** 2
    b = step[..., 0] * start[0] + step[..., 2] * start[2]
    root = b * b - a * (start[0] ** 2 + start[2] ** 2 - radius**2)
    entry = np.full(a.shape, np.inf)
    side = (-b - np.sqrt(np.maximum(root, 0))) / a
    on_side = (root >= 0) & (np.abs(start[1] + side * step[..., 1]) <= half) & (side > 0)
    entry[on_side] = side[on_side]
    for cap in (-half, half):
        t = (cap - start[1]) / step[..., 1]
        on_cap = ((start[0] + t * step[..., 0]) ** 2 + (start[2] + t * step[..., 2]) ** 2 <= radius**2) & (t > 0)
        entry = np.where(on_cap, np.minimum(entry, t), entry)
    return entry


@pytest.mark.parametrize("shape", ["box", "ball", "cylinder"])
def test_solids_are_hit_at_their_analytic_depth(shape):
    b = empty_builder()
    rotation = random_rotation(np.random.default_rng(5))
    center = np.array([0.2, -0.1, 0.4])
    half = {"box": np.array([0.9, 0.5, 0.3]), "ball": np.full(3, 0.8), "cylinder": np.array([0.4, 0.9, 0.4])}[shape]
    b.add(shape, center, half, Finish((0,)), rotation)
    K = np.array([[50, 0, 30.3], [0, 51, 25.1], [0, 0, 1]])
    pose = look_at(np.array([0.3, -0.4, -3.1]), np.array([0.1, 0.1, 0.0])).astype(np.float32)
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH] + 0.5
    rays = np.stack([(x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1], np.ones_like(x)], axis=-1)
    origin, directions = pose[:3, 3], rays @ pose[:3, :3].T
    if shape == "box":
        enter, leave = slab_depths(origin, directions, center, half, rotation)
        entry = np.where(enter <= leave, enter, np.inf)
    elif shape == "ball":
        entry = ball_entry(origin, directions, center, 0.8)
    else:
        entry = cylinder_entry(origin, directions, center, 0.4, 0.9, rotation)
    assert 50 < np.isfinite(entry).sum() < 0.9 * entry.size
    wanted = np.minimum(entry, slab_depths(origin, directions, np.zeros(3), ROOM, np.eye(3))[1])
    depths = np.asarray(raycast(built(b), inverted(pose[None]), K[None].astype(np.float32), HEIGHT, WIDTH, 0)[1])[0]
    # Rays that graze a silhouette may fall on either side of it.
    ok = np.abs(depths - wanted) <= DEPTH_TOLERANCE * wanted
    assert ok.mean() > 0.998
    cross = generate_binary_structure(2, 1)
    jumps = maximum_filter(wanted, footprint=cross) - wanted, wanted - minimum_filter(wanted, footprint=cross)
    assert ok[np.maximum(*jumps) < 0.1].all()


def test_glowing_face_shows_its_texel_times_gain():
    """On a wall facing -z, u = 0 is at -x, so the dark half of the tile is on the left."""
    b = empty_builder()
    b.box([0, 0, 2.0], [2.0, 2.0, 0.1], Finish((1,), tile=0.0, glow=1.0, gain=(0.5, 1.0, 0.25)))
    pose = look_at(np.array([0.0, 0.0, -1.0]), np.array([0.0, 0.0, 1.0])).astype(np.float32)
    K = np.array([[[50.0, 0, 32], [0, 50, 24], [0, 0, 1]]], np.float32)
    image = np.asarray(raycast(built(b), inverted(pose[None]), K, HEIGHT, WIDTH)[0])[0]
    gain = np.array([0.5, 1.0, 0.25])
    np.testing.assert_allclose(image[:, 10:26], np.broadcast_to(0.2 * gain, (HEIGHT, 16, 3)), atol=COLOR_TOLERANCE)
    np.testing.assert_allclose(image[:, 38:54], np.broadcast_to(gain, (HEIGHT, 16, 3)), atol=COLOR_TOLERANCE)


def test_scaled_scene_looks_the_same_from_scaled_cameras():
    scene = sample_scene(3, "room")
    poses, Ks = sample_path(3, scene, "orbit", 1, HEIGHT, WIDTH, step=0.1)
    images, depths = raycast(scene, inverted(poses), Ks, HEIGHT, WIDTH)
    poses[:, :3, 3] *= 2.5
    scaled_images, scaled_depths = raycast(scale_scene(scene, 2.5), inverted(poses), Ks, HEIGHT, WIDTH)
    close = np.abs(np.asarray(scaled_depths) - 2.5 * np.asarray(depths)) < 1e-4 * np.asarray(scaled_depths)
    assert close.mean() > 0.998  # the rest are silhouettes
    assert np.quantile(np.abs(np.asarray(images) - np.asarray(scaled_images)), 0.99) < 0.01
