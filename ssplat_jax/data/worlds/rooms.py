"""Layout of the made worlds: rooms with openings, furniture and objects, and streets with facades and trees."""

import dataclasses

import numpy as np

from ssplat_jax.data.worlds.meshes import Mesh, bend, box, displace, lathe, move, patch, surface, torus
from ssplat_jax.data.worlds.textures import NUM_TEXTURES


@dataclasses.dataclass
class World:
    """Meshes, the free box in which cameras move, and the boxes of the objects (cameras and light avoid them)."""

    meshes: list[Mesh]
    low: np.ndarray  # (3,) free box, meters
    high: np.ndarray
    obstacles: np.ndarray  # (n, 2, 3) low and high corners
    outdoor: bool


def make_world(rng: np.random.Generator, outdoor: bool) -> World:
    """A random world; the state of `rng` determines it."""
    size = (
        np.array([*rng.uniform(9, 16, 2), 7.0]) if outdoor else np.array([*rng.uniform(4, 8, 2), rng.uniform(2.5, 3.3)])
    )
    meshes = _street(rng, size) if outdoor else _room(rng, size)
    objects: list[Mesh] = []
    for _ in range(int(rng.integers(20, 45))):
        objects += _placed(rng, size, outdoor)
    obstacles = np.array([[mesh.points.min(0), mesh.points.max(0)] for mesh in objects])
    return World(meshes + objects, np.zeros(3), size, obstacles, outdoor)


def _layer(rng) -> int:
    return int(rng.integers(NUM_TEXTURES))


def _room(rng, size) -> list[Mesh]:
    x, y, z = np.diag(size)
    zero = np.zeros(3)
    meshes = [patch(zero, x, y, 0.2, int(rng.choice([1, 2, 7, 8, 0]))), patch(z, y, x, 0.3, 5)]
    layers = rng.choice([5, 11, 0, 6, 2], 4)
    for corner, u, layer in zip([zero, x, x + y, y], [x, y, -x, -y], layers, strict=True):
        meshes += _wall(rng, corner, u, size[2], int(layer))
    return meshes


def _wall(rng, corner, u, height, layer) -> list[Mesh]:
    """A wall facing left of its run `u`, with a window or door that opens on a panel half a meter behind."""
    a, b = np.sort(rng.uniform(0.15, 0.85, 2))
    if b - a < 0.15:
        b = a + 0.15
    low, high = (0.0, 2.1) if rng.random() < 0.4 else (0.9, 2.0)
    up = np.array([0, 0, 1.0])
    out = np.cross(u, up) / np.linalg.norm(u)  # away from the room
    strips = [(0, a, 0, height), (b, 1, 0, height), (a, b, high, height), (a, b, 0, low)]
    meshes = [
        patch(corner + s * u + bottom * up, (t - s) * u, (top - bottom) * up, 0.2, layer)
        for s, t, bottom, top in strips
        if top > bottom
    ]
    for panel in meshes:  # u x up points out of the room; the shader lights both sides, the baker needs the inside
        panel.normals = -panel.normals
    back = patch(
        corner + (a - 0.1) * u + 0.5 * out, (b - a + 0.2) * u, height * up, 0.2, 9 if rng.random() < 0.5 else 12
    )
    back.normals = -back.normals
    frame = []
    for s in (a, (a + b) / 2, b):
        foot = corner + s * u
        frame.append(box(foot + low * up - 0.03, foot + high * up + 0.03, 0.4, 1))
    poster = patch(
        corner + 0.02 * u - 0.01 * out + 1.2 * up, 0.12 * u, 0.7 * up, 0.2, int(rng.choice([3, 4, 9, 10, 15]))
    )
    poster.normals = -poster.normals
    return [*meshes, back, poster, *frame]


def _street(rng, size) -> list[Mesh]:
    a, b = np.meshgrid(np.linspace(-25, size[0] + 25, 90), np.linspace(-25, size[1] + 25, 90), indexing="ij")
    ground = 0.12 * np.sin(a * 0.7 + rng.uniform(0, 6)) * np.sin(b * 0.6) - 0.12
    meshes = [surface(np.stack([a, b, ground], -1), int(rng.choice([0, 2, 6, 8])))]
    for side in range(4):
        for i in range(3):
            wide, high = rng.uniform(4, 7), rng.uniform(4, 11)
            along = -4 + i * 7.5
            low = np.array(
                [[along, -6, -1], [along, size[1] + 2, -1], [-6, along, -1], [size[0] + 2, along, -1]][side], float
            )
            depth = np.array([wide, 4, high]) if side < 2 else np.array([4, wide, high])
            meshes.append(box(low, low + depth, 0.5, _layer(rng)))
            meshes += _windows(rng, low, low + depth)
    return meshes


def _windows(rng, low, high) -> list[Mesh]:
    layer, meshes = _layer(rng), []
    for z in np.arange(1.0, high[2] - 1.2, 1.8):
        for axis in (0, 1):
            for s in np.arange(low[axis] + 0.6, high[axis] - 1.2, 1.6):
                first, last = low - 0.08, high + 0.08
                first[axis], last[axis], first[2], last[2] = s, s + 0.9, z, z + 1.2
                meshes.append(box(first, last, 1.0, layer))
    return meshes


def _placed(rng, size, outdoor) -> list[Mesh]:
    """One piece of furniture or clutter at a random free place."""
    at = np.array([*(rng.uniform(0.06, 0.94, 2) * size[:2]), 0.0])
    if rng.random() < 0.65:  # most furniture stands along a wall
        axis = int(rng.integers(2))
        at[axis] = rng.choice([0.45, size[axis] - 0.45])
    turn = rng.normal(0, 0.15) + rng.integers(4) * np.pi / 2
    makers = [_tree, _lathed, _crate] if outdoor else [_table, _shelf, _lathed, _crate, _cable]
    maker = makers[int(rng.integers(len(makers)))]
    return [move(part, at, turn) for part in maker(rng)]


def _table(rng) -> list[Mesh]:
    wide, deep, high, layer = rng.uniform(0.4, 0.8), rng.uniform(0.3, 0.5), rng.uniform(0.4, 0.8), _layer(rng)
    top = [box([-wide, -deep, high - 0.04], [wide, deep, high], 0.15, layer)]
    legs = [
        box(
            [sx * (wide - 0.05) - 0.02, sy * (deep - 0.05) - 0.02, 0],
            [sx * (wide - 0.05) + 0.02, sy * (deep - 0.05) + 0.02, high],
            0.3,
            layer,
        )
        for sx in (-1, 1)
        for sy in (-1, 1)
    ]
    things = [
        move(part, [rng.uniform(-wide, wide) * 0.7, rng.uniform(-deep, deep) * 0.6, high]) for part in _small(rng)
    ]
    return top + legs + things


def _small(rng) -> list[Mesh]:
    return [
        box([-0.1, -0.08, 0], [0.1, 0.08, rng.uniform(0.05, 0.3)], 0.1, _layer(rng)),
        move(torus(0.1, 0.03, _layer(rng)), [0.2, 0, 0.03]),
        move(_vase(rng, 0.3), [-0.25, 0, 0]),
    ]


def _vase(rng, height) -> Mesh:
    t = np.linspace(0, 1, 14)
    radii = height * (0.2 + 0.12 * np.sin(rng.uniform(2, 6) * t + rng.uniform(0, 3)))
    radii[0] = radii[-1] = 0.0
    return lathe(radii, height * t, _layer(rng))


def _lathed(rng) -> list[Mesh]:
    return [bend(displace(_vase(rng, rng.uniform(0.4, 1.2)), rng, rng.uniform(0, 0.03)), rng.uniform(-0.15, 0.15))]


def _crate(rng) -> list[Mesh]:
    half = rng.uniform(0.15, 0.4, 2)
    t = np.linspace(0, np.pi, 10)
    ball = displace(lathe(0.15 * np.sin(t), 0.15 - 0.15 * np.cos(t), _layer(rng)), rng, 0.03)
    high = rng.uniform(0.25, 1.0)
    return [box([*-half, 0], [*half, high], 0.12, _layer(rng)), move(ball, [0, 0, high])]


def _shelf(rng) -> list[Mesh]:
    wide, layer, high = rng.uniform(0.35, 0.6), _layer(rng), rng.uniform(1.2, 2.0)
    parts = [box([s * wide - 0.015, -0.15, 0], [s * wide + 0.015, 0.15, high], 0.2, layer) for s in (-1, 1)]
    for z in np.arange(0.1, high, 0.38):
        parts.append(box([-wide, -0.15, z], [wide, 0.15, z + 0.025], 0.2, layer))
        for x in np.arange(-wide + 0.05, wide - 0.1, 0.16):
            tall = rng.uniform(0.1, 0.3)
            parts.append(
                box([x, -0.1, z + 0.025], [x + rng.uniform(0.03, 0.13), 0.1, z + 0.025 + tall], 0.3, _layer(rng))
            )
    return parts


def _cable(rng) -> list[Mesh]:
    return [bend(lathe(np.full(14, 0.012), np.linspace(0, 1.8, 14), _layer(rng), sides=8), rng.uniform(-0.2, 0.2))]


def _tree(rng) -> list[Mesh]:
    trunk, t = rng.uniform(1.0, 2.2), np.linspace(0, np.pi, 12)
    parts = [bend(lathe(np.linspace(0.12, 0.06, 12), np.linspace(0, trunk, 12), 1), rng.uniform(-0.05, 0.05))]
    for _ in range(6):
        r = rng.uniform(0.25, 0.55)
        leaves = displace(lathe(r * np.sin(t), -r * np.cos(t), 6), rng, 0.2)
        parts.append(move(leaves, [*rng.normal(0, 0.35, 2), trunk + rng.uniform(0, 0.8)]))
    return parts
