"""`Scene`: a procedural world of a fixed number of solids inside a closed shell, and the distance to its surfaces.

The world has OpenCV's handedness with +y down; the floor is the plane y = 0, and cameras have negative y. Solids are
transformed unit shapes: cubes |x|,|y|,|z| <= 1, balls, and cylinders of radius 1 along y, in that order; unused rows
lie far outside the shell. Two rows follow the solids, the box and the dome of the shell. The world is the inside of
their intersection, so every ray ends.
"""

import numpy as np
from jaxtyping import Array, Float, Int, UInt32

from ssplat_jax.core.pytree import pytree, replace

NUM_BOXES, NUM_BALLS, NUM_CYLINDERS = 32, 6, 10  # rows of each shape
NUM_SOLIDS = NUM_BOXES + NUM_BALLS + NUM_CYLINDERS
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
    """Returns the scene with all lengths multiplied by `factor`; it looks the same from scaled cameras."""
    f = np.float32(factor)
    frames = np.concatenate([scene.frames[..., :3] / f, scene.frames[..., 3:]], axis=-1)
    faces = np.array(scene.faces)
    faces[..., 8] /= f
    return replace(
        scene,
        frames=frames,
        halves=scene.halves * f,
        faces=faces,
        occlusion_reach=np.asarray(scene.occlusion_reach * f),
        focus=scene.focus * f,
        orbit_radius=np.asarray(scene.orbit_radius * f),
        eye=scene.eye * f,
    )


def fade_scene(scene: Scene, contrast: float) -> Scene:
    """Returns the scene with textures of less contrast: albedos move towards the middle gray of their face.

    Args:
        scene: the scene.
        contrast: factor on the deviations from that gray; 1 keeps the scene, 0 leaves surfaces without texture.
    """
    faces = np.array(scene.faces)
    gains, biases = faces[..., 9:12], faces[..., 12:15]
    biases += (1 - contrast) * _MIDDLE_ALBEDO * gains
    gains *= contrast
    return replace(scene, faces=faces)


def clearance(scene: Scene, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    """Returns the distance from points to the nearest surface, negative inside a solid or outside the shell.

    Limits:
        Exact outside boxes, round balls and round cylinders; a lower bound for stretched balls.
    """
    frames, halves = np.asarray(scene.frames, np.float64), np.asarray(scene.halves, np.float64)
    local = np.einsum("sij,nj->nsi", frames[..., :3], points) + frames[..., 3]
    boxes, balls, cylinders, outer = np.split(local, np.cumsum([NUM_BOXES, NUM_BALLS, NUM_CYLINDERS]), axis=1)
    shell, dome = outer[:, 0], outer[:, 1]
    box_half, ball_half, cylinder_half = np.split(halves[:NUM_SOLIDS], np.cumsum([NUM_BOXES, NUM_BALLS]))

    def outside(gaps):
        """Distance to a box of which `gaps` are the signed distances along its axes."""
        return np.linalg.norm(np.maximum(gaps, 0), axis=-1) + np.minimum(gaps.max(axis=-1), 0)

    box = outside((np.abs(boxes) - 1) * box_half)
    ball = (np.linalg.norm(balls, axis=-1) - 1) * ball_half.min(axis=-1)
    radial = (np.hypot(cylinders[..., 0], cylinders[..., 2]) - 1) * cylinder_half[:, 0]
    cylinder = outside(np.stack([radial, (np.abs(cylinders[..., 1]) - 1) * cylinder_half[:, 1]], axis=-1))
    walls = ((1 - np.abs(shell)) * halves[NUM_SOLIDS]).min(axis=-1)
    sky = (1 - np.linalg.norm(dome, axis=-1)) * halves[NUM_SOLIDS + 1].min()
    solids = np.concatenate([box, ball, cylinder], axis=1).min(axis=1)
    return np.minimum(solids, np.minimum(walls, sky))
