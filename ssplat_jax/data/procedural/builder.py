"""`SceneBuilder`: assembles a `Scene` one solid at a time."""

import dataclasses

import numpy as np

from ssplat_jax.data.procedural.scene import AWAY, NUM_BALLS, NUM_BOXES, NUM_SOLIDS, Scene
from ssplat_jax.data.procedural.textures import TextureLibrary

# Axes of the unit frame along which u and v run on each face; on walls v runs along +y, down.
_FACE_AXES = ((2, 1), (2, 1), (0, 2), (0, 2), (0, 1), (0, 1))


@dataclasses.dataclass(frozen=True)
class Finish:
    """Appearance of the faces of a solid."""

    textures: tuple[int, ...]  # one is drawn for each face
    tile: float = 1.0  # length of one tile; 0 stretches one tile over each face
    gain: tuple[float, float, float] = (1.0, 1.0, 1.0)
    bias: tuple[float, float, float] = (0.0, 0.0, 0.0)
    glow: float = 0.0  # 1: self-luminous, without shading
    is_turned: bool = False  # tiles are rotated by a random angle
    is_centered: bool = False  # tiles are symmetric about the center of the solid, which hides the seams of a dome


def yaw_rotation(angle: float) -> np.ndarray:
    """Returns the rotation matrix about the vertical axis by an angle in radians."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


def random_rotation(rng: np.random.Generator) -> np.ndarray:
    """Returns a uniformly distributed random rotation matrix."""
    q, r = np.linalg.qr(rng.standard_normal((3, 3)))
    q = q * np.sign(np.diag(r))
    return q * np.sign(np.linalg.det(q))


class SceneBuilder:
    """Builder of a scene; solids beyond the fixed number of rows of their shape are dropped."""

    def __init__(self, rng: np.random.Generator, library: TextureLibrary) -> None:
        self.rng = rng
        self.library = library
        rows = NUM_SOLIDS + 2
        self.frames = np.tile(np.concatenate([np.eye(3), np.full((3, 1), AWAY)], axis=1), (rows, 1, 1))
        self.halves = np.ones((rows, 3))
        self.faces = np.zeros((rows, 6, 16))
        self.face_textures = np.zeros((rows, 6), np.int32)
        self._next = {"box": 0, "ball": NUM_BOXES, "cylinder": NUM_BOXES + NUM_BALLS}
        self._end = {"box": NUM_BOXES, "ball": NUM_BOXES + NUM_BALLS, "cylinder": NUM_SOLIDS}

    # -- finishes ---------------------------------------------------------------------------------------------------

    def finish(self, *groups: str, tile: float = 1.0, same: bool = True, tint: float = 0.15, **options) -> Finish:
        """Returns a random finish from one of the texture `groups`.

        Args:
            groups: groups of the texture library.
            tile: length of one tile; 0 stretches one tile over each face.
            same: whether all faces have the same texture.
            tint: largest relative change of a color channel.
            **options: other fields of `Finish`.

        Returns:
            The finish.
        """
        rng = self.rng
        ids = self.library.groups[groups[rng.integers(len(groups))]]
        textures = tuple(int(i) for i in rng.choice(ids, 1 if same else 3))
        gain = rng.uniform(0.75, 1.2) * rng.uniform(1 - tint, 1 + tint, 3)
        return Finish(textures, tile=tile, gain=tuple(gain), **options)

    def _cover(self, row: int, finish: Finish) -> None:
        """Sets the faces of a solid that has been placed."""
        half = self.halves[row]
        for face, axes in enumerate(_FACE_AXES):
            self.face_textures[row, face] = finish.textures[self.rng.integers(len(finish.textures))]
            uv = np.zeros((2, 4))
            if finish.tile == 0:
                uv[0, axes[0]], uv[1, axes[1]], uv[:, 3] = 0.5, 0.5, 0.5
                per_length = 0.5 / half[axes[1]]
            else:
                angle = self.rng.uniform(0, 2 * np.pi) if finish.is_turned else 0.0
                c, s = np.cos(angle), np.sin(angle)
                uv[:, axes] = np.array([[c, -s], [s, c]]) * half[list(axes)] / finish.tile
                uv[:, 3] = 0.0 if finish.is_centered else self.rng.uniform(0, 2, 2)
                per_length = 1 / finish.tile
            self.faces[row, face] = [*uv[0], *uv[1], per_length, *finish.gain, *finish.bias, finish.glow]

    # -- solids -----------------------------------------------------------------------------------------------------

    def add(self, shape: str, center, half, finish: Finish, rotation: np.ndarray | None = None) -> None:
        """Adds a solid.

        Args:
            shape: "box", "ball" or "cylinder" (along its y axis).
            center: position in the world.
            half: half extents along the axes of the solid.
            finish: appearance.
            rotation: from the solid to the world; by default none.
        """
        row = self._next[shape]
        if row == self._end[shape]:
            return
        self._next[shape] += 1
        self._place(row, center, half, finish, np.eye(3) if rotation is None else rotation)

    def _place(self, row: int, center, half, finish: Finish, rotation: np.ndarray) -> None:
        """Fills one row of the scene."""
        half = np.broadcast_to(np.asarray(half, np.float64), (3,))
        matrix = rotation.T / half[:, None]
        self.frames[row] = np.concatenate([matrix, -matrix @ np.asarray(center, np.float64)[:, None]], axis=1)
        self.halves[row] = half
        self._cover(row, finish)

    def box(self, center, half, finish: Finish, yaw: float = 0.0) -> None:
        """Adds a box that is rotated about the vertical axis.

        Args:
            center: position in the world.
            half: half extents along the axes of the box.
            finish: appearance.
            yaw: angle in radians.
        """
        self.add("box", center, half, finish, yaw_rotation(yaw))

    def shell(self, center, half, walls: Finish, floor: Finish, ceiling: Finish) -> None:
        """Sets the outer box of the world.

        Args:
            center: position in the world.
            half: half extents.
            walls: appearance of the walls.
            floor: appearance of the floor.
            ceiling: appearance of the ceiling.
        """
        self._place(NUM_SOLIDS, center, half, walls, np.eye(3))
        wall_faces, wall_textures = self.faces[NUM_SOLIDS].copy(), self.face_textures[NUM_SOLIDS].copy()
        for finish, face in ((floor, 3), (ceiling, 2)):
            self._cover(NUM_SOLIDS, finish)
            wall_faces[face], wall_textures[face] = self.faces[NUM_SOLIDS, face], self.face_textures[NUM_SOLIDS, face]
        self.faces[NUM_SOLIDS], self.face_textures[NUM_SOLIDS] = wall_faces, wall_textures

    def dome(self, radius: float, finish: Finish) -> None:
        """Sets the outer ball of the world, around the origin."""
        self._place(NUM_SOLIDS + 1, np.zeros(3), radius, finish, np.eye(3))

    # -- scene ------------------------------------------------------------------------------------------------------

    def build(self, *, focus, orbit_radius: float, eye, sensor: bool = False) -> Scene:
        """Returns the scene under a random light.

        Args:
            focus: point that orbits look at.
            orbit_radius: distance of orbits from `focus`.
            eye: free point at which walks start.
            sensor: whether views have changes of exposure and noise.

        Returns:
            The scene.
        """
        rng = self.rng
        light = np.array([rng.normal(), -rng.uniform(0.4, 2.0), rng.normal()])
        floats = {
            "frames": self.frames,
            "halves": self.halves,
            "faces": self.faces,
            "light": light / np.linalg.norm(light),
            "ambient": rng.uniform(0.4, 0.75),
            "occlusion": rng.uniform(0.2, 0.5),
            "occlusion_reach": rng.uniform(0.15, 0.5) * orbit_radius / 2,
            "exposure_jitter": rng.uniform(0.0, 0.08) if sensor else 0.0,
            "sensor_noise": rng.uniform(0.0, 0.015) if sensor else 0.0,
            "focus": focus,
            "orbit_radius": orbit_radius,
            "eye": eye,
        }
        arrays = {name: np.asarray(value, np.float32) for name, value in floats.items()}
        firsts = {"box": 0, "ball": NUM_BOXES, "cylinder": NUM_BOXES + NUM_BALLS}
        counts = np.array([self._next[shape] - first for shape, first in firsts.items()], np.int32)
        return Scene(**arrays, counts=counts, face_textures=self.face_textures, pyramids=self.library.pyramids)
