"""`Scene`, a procedural world of a fixed number of solids inside a closed shell, and `SceneBuilder`, which makes one.

The world has OpenCV's handedness with +y down; the floor is the plane y = 0, and cameras have negative y. Solids are
transformed unit shapes: cubes |x|,|y|,|z| <= 1, balls, and cylinders of radius 1 along y, in that order; unused rows
lie far outside the shell. Two rows follow the solids, the box and the dome of the shell. The world is the inside of
their intersection, so every ray ends.
"""

import dataclasses

import numpy as np
from jaxtyping import Array, Float, Int, UInt32

from ssplat_jax.core.pytree import pytree, replace
from ssplat_jax.data.procedural.textures import TextureLibrary, pack_pyramids

NUM_BOXES, NUM_BALLS, NUM_CYLINDERS = 32, 6, 10  # rows of each shape
NUM_SOLIDS = NUM_BOXES + NUM_BALLS + NUM_CYLINDERS
FIRST_ROWS = {"box": 0, "ball": NUM_BOXES, "cylinder": NUM_BOXES + NUM_BALLS}
AWAY = 1e5  # position of unused solids, in scene units
_MIDDLE_ALBEDO = 0.45  # of a texture without gain and bias

AnyArray = np.ndarray | Array


@pytree
class Scene:
    """Procedural world with fixed array shapes; the `s` rows are `NUM_SOLIDS` solids, and the shell's box and dome."""

    # -- geometry
    frames: Float[AnyArray, "s 3 4"]  # world -> unit frame of the solid
    halves: Float[AnyArray, "s 3"]  # half extents along the solid's axes
    counts: Int[AnyArray, "3"]  # used rows of boxes, balls, cylinders
    # -- appearance, for each of the faces -x +x -y +y -z +z
    faces: Float[AnyArray, "s 6 16"]  # u and v from unit coordinates (4 + 4), tiles per length, gain 3, bias 3, glow
    face_textures: Int[AnyArray, "s 6"]
    pyramids: UInt32[AnyArray, "num_textures texels"]  # `textures.TextureLibrary.pyramids`
    # -- light
    light: Float[AnyArray, "3"]  # unit vector towards the light
    ambient: Float[AnyArray, ""]  # share of light without direction
    occlusion: Float[AnyArray, ""]  # darkening at contact, in [0, 1)
    occlusion_reach: Float[AnyArray, ""]  # length over which the darkening fades
    # -- sensor; `training_sample` uses it, `raycast` does not
    exposure_jitter: Float[AnyArray, ""]  # standard deviation of a view's log gain
    sensor_noise: Float[AnyArray, ""]  # standard deviation of a pixel's noise
    # -- places for cameras
    focus: Float[AnyArray, "3"]  # point that orbits look at
    orbit_radius: Float[AnyArray, ""]  # distance of orbits from `focus`
    eye: Float[AnyArray, "3"]  # free point at which walks start


def scale_scene(scene: Scene, factor: float) -> Scene:
    """The scene with all lengths multiplied by `factor`; it looks the same from scaled cameras."""
    f = np.float32(factor)
    frames = np.concatenate([scene.frames[..., :3] / f, scene.frames[..., 3:]], axis=-1)
    faces = np.array(scene.faces)
    faces[..., 8] /= f
    names = ("halves", "occlusion_reach", "focus", "orbit_radius", "eye")
    lengths = {name: np.asarray(getattr(scene, name) * f) for name in names}
    return replace(scene, frames=frames, faces=faces, **lengths)


def fade_scene(scene: Scene, contrast: float) -> Scene:
    """The scene with `contrast` times the deviations of its albedos from the middle gray of their face."""
    faces = np.array(scene.faces)
    gains, biases = faces[..., 9:12], faces[..., 12:15]
    biases += (1 - contrast) * _MIDDLE_ALBEDO * gains
    gains *= contrast
    return replace(scene, faces=faces)


def clearance(scene: Scene, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    """The distance from points to the nearest surface, negative inside a solid or outside the shell.

    Limits:
        Exact outside boxes, round balls and round cylinders; a lower bound for stretched balls.
    """
    frames, halves = np.asarray(scene.frames, np.float64), np.asarray(scene.halves, np.float64)
    local = np.einsum("sij,nj->nsi", frames[..., :3], points) + frames[..., 3]
    boxes, balls, cylinders, outer = np.split(local, np.cumsum([NUM_BOXES, NUM_BALLS, NUM_CYLINDERS]), axis=1)
    shell, dome = outer[:, 0], outer[:, 1]
    box_half, ball_half, cylinder_half = np.split(halves[:NUM_SOLIDS], np.cumsum([NUM_BOXES, NUM_BALLS]))

    def outside(gaps):  # distance to a box of which `gaps` are the signed distances along its axes
        return np.linalg.norm(np.maximum(gaps, 0), axis=-1) + np.minimum(gaps.max(axis=-1), 0)

    box = outside((np.abs(boxes) - 1) * box_half)
    ball = (np.linalg.norm(balls, axis=-1) - 1) * ball_half.min(axis=-1)
    radial = (np.hypot(cylinders[..., 0], cylinders[..., 2]) - 1) * cylinder_half[:, 0]
    cylinder = outside(np.stack([radial, (np.abs(cylinders[..., 1]) - 1) * cylinder_half[:, 1]], axis=-1))
    walls = ((1 - np.abs(shell)) * halves[NUM_SOLIDS]).min(axis=-1)
    sky = (1 - np.linalg.norm(dome, axis=-1)) * halves[NUM_SOLIDS + 1].min()
    solids = np.concatenate([box, ball, cylinder], axis=1).min(axis=1)
    return np.minimum(solids, np.minimum(walls, sky))


# -- building ---------------------------------------------------------------------------------------------------------

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
    """The rotation matrix about the vertical axis by an angle in radians."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


def random_rotation(rng: np.random.Generator) -> np.ndarray:
    """A uniformly distributed random rotation matrix."""
    q, r = np.linalg.qr(rng.standard_normal((3, 3)))
    q = q * np.sign(np.diag(r))
    return q * np.sign(np.linalg.det(q))


class SceneBuilder:
    """Builder of a scene; solids beyond the fixed number of rows of their shape are dropped."""

    def __init__(self, rng: np.random.Generator, library: TextureLibrary, only_used: bool = False) -> None:
        self.rng = rng
        self.library = library
        self.only_used = only_used  # the scene holds the textures that it shows: many scenes share all of them
        rows = NUM_SOLIDS + 2
        self.frames = np.tile(np.concatenate([np.eye(3), np.full((3, 1), AWAY)], axis=1), (rows, 1, 1))
        self.halves = np.ones((rows, 3))
        self.faces = np.zeros((rows, 6, 16))
        self.face_textures = np.zeros((rows, 6), np.int32)
        self._next = dict(FIRST_ROWS)
        self._limits = {"box": NUM_BOXES, "ball": NUM_BOXES + NUM_BALLS, "cylinder": NUM_SOLIDS}

    def finish(self, *groups: str, tile: float = 1.0, same: bool = True, tint: float = 0.15, **options) -> Finish:
        """A random finish from one of the texture `groups`, with other fields of `Finish` as `options`.

        All faces have the same texture if `same`; `tint` is the largest relative change of a color channel.
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

    def add(self, shape: str, center, half, finish: Finish, rotation: np.ndarray | None = None) -> None:
        """Adds a "box", "ball" or "cylinder" (along its y axis) of the given half extents along its own axes."""
        row = self._next[shape]
        if row == self._limits[shape]:
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
        """Adds a box that is rotated by `yaw` radians about the vertical axis."""
        self.add("box", center, half, finish, yaw_rotation(yaw))

    def shell(self, center, half, walls: Finish, floor: Finish, ceiling: Finish) -> None:
        """Sets the outer box of the world."""
        self._place(NUM_SOLIDS, center, half, walls, np.eye(3))
        wall_faces, wall_textures = self.faces[NUM_SOLIDS].copy(), self.face_textures[NUM_SOLIDS].copy()
        for finish, face in ((floor, 3), (ceiling, 2)):
            self._cover(NUM_SOLIDS, finish)
            wall_faces[face], wall_textures[face] = self.faces[NUM_SOLIDS, face], self.face_textures[NUM_SOLIDS, face]
        self.faces[NUM_SOLIDS], self.face_textures[NUM_SOLIDS] = wall_faces, wall_textures

    def dome(self, radius: float, finish: Finish) -> None:
        """Sets the outer ball of the world, around the origin."""
        self._place(NUM_SOLIDS + 1, np.zeros(3), radius, finish, np.eye(3))

    def build(self, *, focus, orbit_radius: float, eye, sensor: bool = False) -> Scene:
        """The scene under a random light; with `sensor`, views have changes of exposure and noise."""
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
        counts = np.array([self._next[shape] - first for shape, first in FIRST_ROWS.items()], np.int32)
        if not self.only_used:
            return Scene(**arrays, counts=counts, face_textures=self.face_textures, pyramids=self.library.pyramids)
        used, places = np.unique(self.face_textures, return_inverse=True)
        pyramids = np.pad(pack_pyramids(self.library.tiles[used]), ((0, -len(used) % 32), (0, 0)))  # for few shapes
        face_textures = places.reshape(self.face_textures.shape).astype(np.int32)
        return Scene(**arrays, counts=counts, face_textures=face_textures, pyramids=pyramids)
