"""Random worlds: rooms, corridors, streets, piles of objects, clutter and yards, in meters.

Each kind is a function `SceneBuilder -> Scene` in a registry; furniture has a registry of its own.
"""

import dataclasses
from collections.abc import Callable

import numpy as np

from ssplat_jax.data.procedural.scene import Finish, Scene, SceneBuilder, random_rotation, yaw_rotation
from ssplat_jax.data.procedural.textures import texture_library

# Texture groups for objects of any kind.
_EVERYTHING = ("photo", "floor", "pattern", "noise", "facade", "leaves", "photo")


def sample_scene(seed: int, kind: str, *, only_used: bool = False) -> Scene:
    """A random world, which depends on the arguments and the release of scikit-image.

    Args:
        seed: any non-negative integer.
        kind: one of `SCENE_KINDS`.
        only_used: the scene holds the textures that it shows, instead of all, which take seconds to prepare.
    """
    rng = np.random.default_rng([1, seed])
    rng.random()  # the shipped weights were trained on the worlds after this number
    return _RECIPES[kind](SceneBuilder(rng, texture_library(), only_used))


# -- furniture: each piece stands on the floor at (x, z), within about `size` of it ------------------------------------


def _cabinet(b: SceneBuilder, x: float, z: float, yaw: float, size: float) -> None:
    height = b.rng.uniform(0.5, 2.0)
    half = np.array([size * b.rng.uniform(0.5, 0.9), height / 2, size * b.rng.uniform(0.3, 0.6)])
    b.box([x, -half[1], z], half, b.finish(*_EVERYTHING, tile=b.rng.choice([0.0, 0.6, 1.0, 1.5])), yaw)
    if height < 1.4:
        _trinket(b, x, -height, z, size * 0.3)


def _table(b: SceneBuilder, x: float, z: float, yaw: float, size: float) -> None:
    height, thick = b.rng.uniform(0.45, 0.9), b.rng.uniform(0.02, 0.05)
    half = np.array([size * 0.8, thick, size * b.rng.uniform(0.4, 0.7)])
    wood = b.finish("floor", "noise", "wall", "pattern", tile=1.0)
    b.box([x, -height, z], half, wood, yaw)
    legs = ((-1, -1), (1, -1), (-1, 1), (1, 1)) if b.rng.random() < 0.5 else ((0, 0),)
    c, s = np.cos(yaw), np.sin(yaw)
    for i, j in legs:
        lx, lz = i * half[0] * 0.85, j * half[2] * 0.85
        center = [x + c * lx + s * lz, -height / 2 + thick / 2, z - s * lx + c * lz]
        b.add("cylinder", center, [0.03, height / 2 - thick / 2, 0.03], wood)
    _trinket(b, x, -height - thick, z, size * 0.35)


def _shelf(b: SceneBuilder, x: float, z: float, yaw: float, size: float) -> None:
    """Boards between two sides, or a block of books."""
    half = np.array([size * 0.7, b.rng.uniform(0.5, 1.0), 0.18])
    if b.rng.random() < 0.5:
        b.box([x, -half[1], z], half, b.finish("facade", "leaves", tile=0.0), yaw)
        return
    wood = b.finish("floor", "wall", "noise", tile=0.8)
    for level in np.linspace(0.03, 2 * half[1], int(b.rng.integers(3, 5))):
        b.box([x, -level, z], [half[0], 0.02, half[2]], wood, yaw)
    c, s = np.cos(yaw), np.sin(yaw)
    for side in (-1, 1):
        center = [x + side * c * half[0], -half[1], z - side * s * half[0]]
        b.box(center, [0.02, half[1], half[2]], wood, yaw)


def _sofa(b: SceneBuilder, x: float, z: float, yaw: float, size: float) -> None:
    cloth = b.finish("noise", "pattern", "wall", "floor", tile=0.7)
    c, s = np.cos(yaw), np.sin(yaw)
    b.box([x, -0.22, z], [size * 0.8, 0.22, size * 0.4], cloth, yaw)
    b.box([x - s * size * 0.4, -0.42, z - c * size * 0.4], [size * 0.8, 0.42, 0.1], cloth, yaw)
    if b.rng.random() < 0.6:
        b.add("box", [x, -0.58, z], [0.22, 0.2, 0.08], b.finish(*_EVERYTHING, tile=0.4), random_rotation(b.rng))


def _lamp(b: SceneBuilder, x: float, z: float, yaw: float, size: float) -> None:
    height = b.rng.uniform(1.1, 1.8)
    b.add("cylinder", [x, -height / 2, z], [0.025, height / 2, 0.025], b.finish("wall", "noise"))
    b.add("ball", [x, -height, z], b.rng.uniform(0.12, 0.22), b.finish("wall", "pattern", glow=0.5))


def _stack(b: SceneBuilder, x: float, z: float, yaw: float, size: float) -> None:
    top = 0.0
    for _ in range(b.rng.integers(2, 4)):
        half = size * b.rng.uniform(0.25, 0.5, 3)
        b.box([x, -top - half[1], z], half, b.finish(*_EVERYTHING, tile=0.5, same=False), yaw + b.rng.normal(0, 0.3))
        top += 2 * half[1]


def _barrel(b: SceneBuilder, x: float, z: float, yaw: float, size: float) -> None:
    height = b.rng.uniform(0.3, 0.9)
    radius = size * b.rng.uniform(0.3, 0.6)
    b.add("cylinder", [x, -height / 2, z], [radius, height / 2, radius], b.finish(*_EVERYTHING, tile=0.7))
    _trinket(b, x, -height, z, radius)


def _trinket(b: SceneBuilder, x: float, y: float, z: float, size: float) -> None:
    """Small object that stands at height `y`."""
    half = b.rng.uniform(0.3, 0.8, 3) * size
    finish = b.finish(*_EVERYTHING, tile=b.rng.choice([0.0, 0.3, 0.5]))
    shape = b.rng.choice(["box", "box", "ball", "cylinder"])
    if shape == "ball":
        half[:] = half[1]
    half[2] = half[0] if shape == "cylinder" else half[2]
    rotation = None if shape == "ball" else yaw_rotation(b.rng.uniform(0, 2 * np.pi))
    b.add(str(shape), [x, y - half[1], z], half, finish, rotation)


_FURNITURE: tuple[Callable[[SceneBuilder, float, float, float, float], None], ...] = (
    _cabinet, _cabinet, _table, _table, _shelf, _sofa, _lamp, _stack, _barrel,
)  # fmt: skip


def _furnish(b: SceneBuilder, half_x: float, half_z: float, count: int, middle: float) -> None:
    """Furniture along the walls of a room around the origin, outside a free circle of radius `middle`."""
    taken: list[tuple[float, float, float]] = []
    for _ in range(count * 8):
        size = b.rng.uniform(0.35, 0.9)
        side, along = b.rng.integers(4), b.rng.uniform(-0.85, 0.85)
        inset = 0.45 * size if b.rng.random() < 0.75 else b.rng.uniform(0.5, 1.2)
        x = along * half_x if side < 2 else (half_x - inset) * (1 if side == 2 else -1)
        z = along * half_z if side >= 2 else (half_z - inset) * (1 if side == 0 else -1)
        if np.hypot(x, z) < middle + size or any(np.hypot(x - p, z - q) < 0.8 * (size + r) for p, q, r in taken):
            continue
        yaw = (np.pi, 0.0, -np.pi / 2, np.pi / 2)[side] + (b.rng.normal(0, 0.4) if b.rng.random() < 0.3 else 0.0)
        taken.append((x, z, size))
        _FURNITURE[b.rng.integers(len(_FURNITURE))](b, float(x), float(z), float(yaw), size)
        if len(taken) == count:
            return


def _posters(b: SceneBuilder, half_x: float, half_z: float, count: int) -> None:
    """Pictures on the walls of a room around the origin."""
    for _ in range(count):
        w, h = b.rng.uniform(0.2, 0.6, 2)
        height, along = b.rng.uniform(1.2, 1.8), b.rng.uniform(-0.8, 0.8)
        finish = b.finish("photo", "photo", "leaves", tile=0.0)
        side = 1 if b.rng.random() < 0.5 else -1
        if b.rng.random() < 0.5:
            b.box([along * half_x, -height, side * half_z], [w, h, 0.03], finish)
        else:
            b.box([side * half_x, -height, along * half_z], [0.03, h, w], finish)


# -- kinds ------------------------------------------------------------------------------------------------------------


def _wall_finish(b: SceneBuilder) -> Finish:
    """Finish of a wall: mostly plain, sometimes wallpaper or brick."""
    if b.rng.random() < 0.55:
        return b.finish("wall", tile=b.rng.uniform(1.5, 4.0), same=b.rng.random() < 0.5)
    return b.finish("pattern", "noise", "floor", "photo", tile=b.rng.uniform(0.8, 3.0), same=b.rng.random() < 0.6)


def _indoor_shell(b: SceneBuilder, half_x: float, half_z: float, height: float) -> None:
    ceiling = b.finish("wall", "wall", "floor", tile=2.0, glow=0.15)
    b.shell([0, -height / 2, 0], [half_x, height / 2, half_z], _wall_finish(b), b.finish("floor", "noise", tile=1.5),
            ceiling)  # fmt: skip
    b.dome(60.0, ceiling)


def _room(b: SceneBuilder) -> Scene:
    half_x, half_z, height = b.rng.uniform(1.8, 3.5), b.rng.uniform(2.0, 4.0), b.rng.uniform(2.3, 3.2)
    _indoor_shell(b, half_x, half_z, height)
    if b.rng.random() < 0.3:
        _partition(b, half_x, half_z * b.rng.uniform(0.3, 0.6), height)
    _furnish(b, half_x, half_z, int(b.rng.integers(6, 13)), middle=0.8)
    _posters(b, half_x, half_z, int(b.rng.integers(2, 7)))
    eye = [b.rng.uniform(-0.4, 0.4), -b.rng.uniform(1.0, 1.7), b.rng.uniform(-0.4, 0.4)]
    return b.build(focus=[0, -0.7, 0], orbit_radius=1.3, eye=eye, sensor=b.rng.random() < 0.3)


def _partition(b: SceneBuilder, half_x: float, z: float, height: float) -> None:
    """Wall across the room at `z`, with an opening for a door."""
    finish = _wall_finish(b)
    door, wide, tall = b.rng.uniform(-0.5, 0.5) * half_x, b.rng.uniform(0.4, 0.7), min(2.0, height - 0.2)
    for low, high in ((-half_x, door - wide), (door + wide, half_x)):
        b.box([(low + high) / 2, -height / 2, z], [(high - low) / 2, height / 2, 0.06], finish)
    b.box([door, -(tall + height) / 2, z], [wide, (height - tall) / 2, 0.06], finish)


def _corridor(b: SceneBuilder) -> Scene:
    half_x, half_z, height = b.rng.uniform(0.9, 1.6), b.rng.uniform(5.0, 7.0), b.rng.uniform(2.3, 3.0)
    depth = b.rng.uniform(0.5, 1.5)
    _indoor_shell(b, half_x + depth, half_z, height)
    wall = _wall_finish(b)
    for side in (-1, 1):
        z = -half_z
        while z < half_z:
            length, gap = b.rng.uniform(1.5, 4.0), b.rng.uniform(0.6, 1.6)
            center = [side * (half_x + depth / 2), -height / 2, z + length / 2]
            b.box(center, [depth / 2, height / 2, length / 2], wall if b.rng.random() < 0.7 else _wall_finish(b))
            z += length + gap
    for z in np.linspace(-half_z, half_z, 5)[1:-1] + b.rng.uniform(-0.4, 0.4, 3):
        b.box([0, -height + 0.03, z], [0.15, 0.03, 0.5], b.finish("wall", glow=1.0))
    _posters(b, half_x, half_z, 4)
    for _ in range(4):
        side = b.rng.choice([-1, 1])
        _FURNITURE[b.rng.integers(len(_FURNITURE))](b, side * (half_x - 0.2), b.rng.uniform(-0.9, 0.9) * half_z,
                                                    side * np.pi / 2, 0.35)  # fmt: skip
    radius = b.rng.uniform(0.04, 0.1)
    b.add("cylinder", [half_x * b.rng.uniform(-0.8, 0.8), -height + 0.15, 0], [radius, half_z, radius],
          b.finish("noise", "wall"), np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]))  # fmt: skip
    eye = [0.0, -b.rng.uniform(1.1, 1.7), b.rng.uniform(-0.8, 0.8) * half_z]
    return b.build(focus=[0, -1, 0], orbit_radius=half_x * 1.2, eye=eye, sensor=b.rng.random() < 0.3)


def _outdoors(b: SceneBuilder, radius: float, ground: Finish, brightness: float = 1.0) -> None:
    """Ground plane and sky. `brightness` multiplies the colors of the sky; a bright one is overexposed."""
    sky = b.finish("sky", tile=radius * b.rng.uniform(1.0, 2.0), tint=0.1, glow=1.0, is_centered=True)
    sky = dataclasses.replace(sky, gain=tuple(brightness * gain for gain in sky.gain))
    b.dome(radius, sky)
    b.shell([0, -2 * radius, 0], [2 * radius, 2 * radius, 2 * radius], sky, ground, sky)


def _street(b: SceneBuilder) -> Scene:
    half_x, radius = b.rng.uniform(2.0, 3.5), b.rng.uniform(14.0, 20.0)
    _outdoors(b, radius, b.finish("floor", "noise", "floor", tile=b.rng.uniform(1.0, 3.0)))
    for side in (-1, 1):
        z = -radius
        while z < radius:
            length, height, depth = b.rng.uniform(2.0, 6.0), b.rng.uniform(2.5, 7.0), b.rng.uniform(1.0, 2.0)
            finish = b.finish("facade", "pattern", "facade", "photo", "floor", tile=b.rng.uniform(2.0, 4.0))
            x = side * (half_x + depth + b.rng.uniform(0, 0.6))
            b.box([x, -height / 2, z + length / 2], [depth, height / 2, length / 2], finish)
            z += length + (b.rng.uniform(0.5, 1.5) if b.rng.random() < 0.4 else 0.0)
    for side in (-1, 1):
        walk = half_x * 0.75
        b.box([side * (walk + 1), -0.06, 0], [1.0, 0.06, radius], b.finish("floor", tile=1.0))
        for z in b.rng.uniform(-8, 8, 3):
            _roadside(b, side * walk, z)
    eye = [b.rng.uniform(-0.5, 0.5) * half_x, -b.rng.uniform(1.3, 1.8), b.rng.uniform(-5, 5)]
    return b.build(focus=[0, -1.2, 0], orbit_radius=half_x * 0.6, eye=eye, sensor=b.rng.random() < 0.3)


def _roadside(b: SceneBuilder, x: float, z: float) -> None:
    """Tree, pole, parked car, or stack of boxes."""
    style = b.rng.integers(4)
    if style == 0:
        tall = b.rng.uniform(1.5, 2.5)
        b.add("cylinder", [x, -tall / 2, z], [0.1, tall / 2, 0.1], b.finish("noise", tile=0.6))
        b.add("ball", [x, -tall - 0.5, z], b.rng.uniform(0.6, 1.0), b.finish("leaves", "noise", "photo", tile=1.0))
    elif style == 1:
        tall = b.rng.uniform(2.0, 4.0)
        b.add("cylinder", [x, -tall / 2, z], [0.05, tall / 2, 0.05], b.finish("wall", "noise"))
        b.box([x, -tall, z], [0.3, 0.2, 0.02], b.finish("photo", "pattern", tile=0.0), b.rng.uniform(0, 3))
    elif style == 2:
        paint = b.finish("wall", "photo", tile=2.0, tint=0.5)
        b.box([x, -0.55, z], [0.7, 0.3, 1.6], paint)
        b.box([x, -1.05, z - 0.1], [0.6, 0.25, 0.8], b.finish("wall", "noise", tile=1.0))
    else:
        _stack(b, x, z, b.rng.uniform(0, 3), 0.8)


def _objects(b: SceneBuilder) -> Scene:
    """Pile of objects on the ground or on a table, outdoors or in a room, with cameras around it."""
    radius = b.rng.uniform(5.0, 8.0)
    ground = b.finish("floor", "noise", "pattern", "photo", tile=b.rng.uniform(0.8, 2.5))
    if b.rng.random() < 0.5:
        _outdoors(b, radius, ground)
    else:
        _indoor_shell(b, radius * 0.55, radius * 0.6, b.rng.uniform(2.5, 4.0))
    height = 0.0
    if b.rng.random() < 0.5:
        height = b.rng.uniform(0.4, 0.8)
        b.box([0, -height + 0.04, 0], [0.7, 0.04, 0.7], b.finish("floor", "pattern", "noise"), b.rng.uniform(0, 3))
        b.add("cylinder", [0, -height / 2, 0], [0.06, height / 2, 0.06], b.finish("noise", "wall"))
    for _ in range(b.rng.integers(6, 13)):
        x, z = b.rng.normal(0, 0.25, 2).clip(-0.55, 0.55)
        size = b.rng.uniform(0.12, 0.4)
        if b.rng.random() < 0.3:
            half = b.rng.uniform(0.3, 1.0, 3) * size
            finish = b.finish(*_EVERYTHING, tile=0.5, same=False)
            b.add("box", [x, -height - half.max() * 0.8, z], half, finish, random_rotation(b.rng))
        else:
            _trinket(b, x, -height, z, size * b.rng.uniform(1.0, 2.0))
    for angle in np.linspace(0, 2 * np.pi, 10)[:-1] + b.rng.uniform(0, 1):
        far = b.rng.uniform(0.5, 0.85) * radius * (0.6 if b.rng.random() < 0.5 else 1.0)
        if far > 2.6:
            _FURNITURE[b.rng.integers(len(_FURNITURE))](b, far * np.sin(angle), far * np.cos(angle), angle + np.pi, 0.9)
    orbit = b.rng.uniform(1.2, 1.9)
    return b.build(focus=[0, -height - 0.2, 0], orbit_radius=orbit, eye=[0, -height - 0.7, -orbit],
                   sensor=b.rng.random() < 0.3)  # fmt: skip


def _clutter(b: SceneBuilder) -> Scene:
    """Floating solids of all sizes and orientations around a free middle, without the regularities of real scenes."""
    half = b.rng.uniform(2.0, 4.0, 3)
    b.shell([0, 0, 0], half, b.finish(*_EVERYTHING, "wall", tile=b.rng.uniform(0.8, 3.0), same=False),
            b.finish(*_EVERYTHING, tile=1.5), b.finish(*_EVERYTHING, "wall", tile=1.5))  # fmt: skip
    b.dome(60.0, b.finish("noise"))
    for _ in range(b.rng.integers(10, 36)):
        direction = b.rng.standard_normal(3)
        center = direction / np.linalg.norm(direction) * b.rng.uniform(1.3, 1.0 * half.max())
        size = min(np.exp(b.rng.uniform(np.log(0.06), np.log(0.7))), 0.55 * np.linalg.norm(center))
        extent = size * b.rng.uniform(0.15, 1.0, 3)
        shape = str(b.rng.choice(["box", "box", "box", "ball", "cylinder"]))
        if shape == "cylinder":
            extent[2] = extent[0]
        finish = b.finish(*_EVERYTHING, "wall", tile=b.rng.uniform(0.3, 1.2), same=b.rng.random() < 0.5, is_turned=True)
        b.add(shape, center, size if shape == "ball" else extent, finish, random_rotation(b.rng))
    return b.build(focus=[0, 0, 0], orbit_radius=0.8, eye=[0, 0, 0], sensor=b.rng.random() < 0.3)


SKY_DISTANCE = 30.0  # surfaces of a yard that are farther away, in meters, are sky or the ground near the horizon


def _yard(b: SceneBuilder) -> Scene:
    """Buildings behind lawns, hedges and trees, under a sky that is far away, as in photographs taken outdoors."""
    ground = b.finish("noise", "leaves", "floor", "photo", tile=b.rng.uniform(0.8, 3.0))
    _outdoors(b, b.rng.uniform(80.0, 300.0), ground, brightness=np.exp(b.rng.uniform(0.0, 1.5)))
    distance = b.rng.uniform(4.5, 12.0)
    _building(b, b.rng.uniform(-2, 2), distance, b.rng.uniform(-0.4, 0.4))
    if b.rng.random() < 0.6:
        side = b.rng.choice([-1, 1])
        _building(b, side * b.rng.uniform(9, 13), distance * b.rng.uniform(0.3, 1.3), side * b.rng.uniform(0.5, 1.4))
    for _ in range(b.rng.integers(1, 4)):
        _hedge(b, b.rng.uniform(-5, 5), distance * b.rng.uniform(0.2, 0.75))
    for _ in range(b.rng.integers(1, 4)):
        _roadside(b, b.rng.uniform(-6, 6), distance * b.rng.uniform(0.1, 0.8))
    eye = [b.rng.uniform(-2, 2), -b.rng.uniform(1.3, 2.0), -b.rng.uniform(0.0, 3.0)]
    return b.build(focus=[0, -1.5, distance * 0.7], orbit_radius=distance * 0.7, eye=eye, sensor=b.rng.random() < 0.5)


def _building(b: SceneBuilder, x: float, z: float, yaw: float) -> None:
    """House with a plinth, columns or a porch, whose front is at (x, z); the back is away from the origin."""
    half = np.array([b.rng.uniform(3.0, 8.0), b.rng.uniform(1.6, 5.0), 2.0])
    c, s = np.cos(yaw), np.sin(yaw)
    at = lambda right, up, ahead: [x + c * right + s * ahead, -up, z - s * right + c * ahead]  # noqa: E731
    b.box(at(0, half[1], half[2]), half, b.finish("facade", "floor", "pattern", "photo", tile=b.rng.uniform(1, 3)), yaw)
    b.box(at(0, 0.3, -0.05), [half[0], 0.3, 0.1], b.finish("wall", "noise", "floor"), yaw)
    trim = b.finish("wall", "noise", "wall", tile=2.0)
    for right in np.linspace(-0.8, 0.8, b.rng.integers(0, 5)) * half[0]:
        b.box(at(right, half[1], -0.15), [0.2, half[1], 0.25], trim, yaw)
    b.box(at(0, 2 * half[1], half[2]), [half[0] + 0.4, 0.15, half[2] + 0.5], trim, yaw)


def _hedge(b: SceneBuilder, x: float, z: float) -> None:
    """Overlapping boxes of leaves, each turned a little."""
    leaves = b.finish("leaves", "noise", "leaves", "photo", tile=b.rng.uniform(0.4, 1.2), is_turned=True)
    half = np.array([b.rng.uniform(0.3, 0.6), b.rng.uniform(0.2, 0.8), b.rng.uniform(0.25, 0.6)])
    for i in range(int(b.rng.integers(2, 6))):
        extent = half * b.rng.uniform(0.8, 1.2, 3)
        b.box([x + 1.6 * i * half[0], -extent[1], z + b.rng.normal(0, 0.1)], extent, leaves, b.rng.normal(0, 0.3))


_RECIPES: dict[str, Callable[[SceneBuilder], Scene]] = {
    recipe.__name__[1:]: recipe for recipe in (_room, _corridor, _street, _objects, _clutter, _yard)
}
SCENE_KINDS = tuple(_RECIPES)
SCENE_SHARES = (0.32, 0.12, 0.12, 0.26, 0.18, 0.0)
"""Probabilities of the kinds, in their order, in training samples that ask for none."""
