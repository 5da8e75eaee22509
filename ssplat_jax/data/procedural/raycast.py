"""Ray caster: exact depth and antialiased color of a `Scene`, compiled once for all scenes.

The direction of a ray has camera z = 1, so the parameter of a hit is its z-depth. Each solid is a unit shape (cube,
ball, cylinder along y) in its own frame, and is hit where the ray has entered all of its slabs; the shell around the
world is hit where the ray leaves it. Depth is that of the pixel center. Color is the mean of `supersample` rays per
pixel, each with a trilinear texture lookup at the footprint of the ray. Loops end at the scene's counts, so unused rows
cost nothing.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ssplat_jax.core.kept_programs import Kept
from ssplat_jax.data.procedural.scene import FIRST_ROWS, NUM_BALLS, NUM_BOXES, NUM_SOLIDS, AnyArray, Scene
from ssplat_jax.data.procedural.textures import LEVEL_OFFSETS, NUM_LEVELS, NUM_TEXELS, SIZE

_TINY = 1e-9  # smallest denominator, and smallest depth of a hit
_FAR = 1e9  # depth of rays that miss

Rays = tuple[Float[Array, "s h w"], Float[Array, "s h w"], Float[Array, "s h w"]]


@functools.partial(Kept, static_argnums=(3, 4, 5))
def raycast(
    scene: Scene,
    viewmats: Float[AnyArray, "v 4 4"],
    Ks: Float[AnyArray, "v 3 3"],
    height: int,
    width: int,
    supersample: int = 2,
) -> tuple[Float[Array, "v h w 3"] | None, Float[Array, "v h w"]]:
    """Renders images in [0, 1], with `supersample` color rays per pixel, and z-depths in units of the scene.

    With `supersample` 0 there are no images, and the same depths.

    Limits:
        Cameras outside the shell or inside a solid look through it; keep `clearance` positive.
        The relative error of a depth is below 2e-5 (float32), except at silhouettes, in scenes a few units in size.
    """

    def render_view(camera):
        viewmat, K = camera
        rotation = viewmat[:3, :3].T
        origin = -jnp.einsum("ij,j->i", rotation, viewmat[:3, 3], precision=jax.lax.Precision.HIGHEST)
        rays = _ray_directions(rotation, K, height, width, _pixel_offsets(supersample))
        t, solid_idx = _nearest_hits(scene, origin, rays)
        if not supersample:
            return None, t[0]
        depth, t, solid_idx = t[0], t[-supersample:], solid_idx[-supersample:]
        rays = (rays[0][-supersample:], rays[1][-supersample:], rays[2][-supersample:])
        colors = _shade(scene, origin, rays, t, solid_idx, pixel=1.0 / (K[0, 0] * supersample**0.5))
        return jnp.mean(colors, axis=0), depth

    return jax.lax.map(render_view, (jnp.asarray(viewmats), jnp.asarray(Ks)))


def _pixel_offsets(count: int) -> np.ndarray:
    """Offsets of rays in a pixel: its center, and for `count` > 1 also that many points of a rank-1 lattice."""
    center = np.full((1, 2), 0.5, np.float32)
    if count <= 1:
        return center
    k = np.arange(count)
    step = next(s for s in range(round(0.62 * count), count + 1) if np.gcd(s, count) == 1)
    lattice = (np.stack([k, k * step % count], axis=-1) + 0.5) / count
    return np.concatenate([center, lattice.astype(np.float32)])


def _ray_directions(rotation: Array, K: Array, height: int, width: int, offsets: np.ndarray) -> Rays:
    """World directions of the rays through all pixels at all offsets, with camera z = 1."""
    x = (jnp.arange(width, dtype=jnp.float32) + offsets[:, :1] - K[0, 2]) / K[0, 0]
    y = (jnp.arange(height, dtype=jnp.float32) + offsets[:, 1:] - K[1, 2]) / K[1, 1]
    x, y = x[:, None, :], y[:, :, None]
    dx, dy, dz = (rotation[i, 0] * x + rotation[i, 1] * y + rotation[i, 2] for i in range(3))
    return dx, dy, dz


# -- intersection -----------------------------------------------------------------------------------------------------


def _to_unit(frame: AnyArray, origin: Array, rays: Rays):
    """Rays in the unit frame of a solid: origin (three scalars) and directions (three images)."""
    start = [
        frame[i, 0] * origin[0] + frame[i, 1] * origin[1] + frame[i, 2] * origin[2] + frame[i, 3] for i in range(3)
    ]
    steps = [frame[i, 0] * rays[0] + frame[i, 1] * rays[1] + frame[i, 2] * rays[2] for i in range(3)]
    return start, steps


def _slab(start: Array, step: Array) -> tuple[Array, Array]:
    """Depths at which a ray enters and leaves the slab |x| <= 1."""
    inverse = 1.0 / jnp.where(jnp.abs(step) < _TINY, _TINY, step)
    a, b = (-1.0 - start) * inverse, (1.0 - start) * inverse
    return jnp.minimum(a, b), jnp.maximum(a, b)


def _quadric(start: list[Array], steps: list[Array]) -> tuple[Array, Array]:
    """Depths at which a ray enters and leaves the unit ball of the given axes (two: an infinite cylinder)."""
    a = jnp.maximum(sum(d * d for d in steps), _TINY)
    b = sum(o * d for o, d in zip(start, steps, strict=True))
    # Squared distance of closest approach; it avoids the cancellation in b^2 - a c.
    miss = sum((o - b / a * d) ** 2 for o, d in zip(start, steps, strict=True))
    root = jnp.sqrt(jnp.maximum(1.0 - miss, 0.0) / a)
    enter, leave = -b / a - root, -b / a + root
    return jnp.where(miss > 1.0, _FAR, enter), jnp.where(miss > 1.0, -_FAR, leave)


def _box_interval(start, steps):
    """Depths at which a ray enters and leaves the unit cube."""
    slabs = [_slab(o, d) for o, d in zip(start, steps, strict=True)]
    return functools.reduce(jnp.maximum, [s[0] for s in slabs]), functools.reduce(jnp.minimum, [s[1] for s in slabs])


def _cylinder_interval(start, steps):
    """Depths at which a ray enters and leaves the unit cylinder along y."""
    enter, leave = _quadric([start[0], start[2]], [steps[0], steps[2]])
    cap_enter, cap_leave = _slab(start[1], steps[1])
    return jnp.maximum(enter, cap_enter), jnp.minimum(leave, cap_leave)


def _nearest_hits(scene: Scene, origin: Array, rays: Rays) -> tuple[Float[Array, "s h w"], Int[Array, "s h w"]]:
    """Z-depth and row index of the first surface along each ray; the box and dome of the shell follow the solids."""
    _, box_exit = _box_interval(*_to_unit(scene.frames[NUM_SOLIDS], origin, rays))
    _, dome_exit = _quadric(*_to_unit(scene.frames[NUM_SOLIDS + 1], origin, rays))
    t = jnp.minimum(box_exit, dome_exit)
    solid_idx = jnp.where(dome_exit < box_exit, NUM_SOLIDS + 1, NUM_SOLIDS).astype(jnp.int32)
    for (first, end), interval in zip(_ranges(scene), (_box_interval, _quadric, _cylinder_interval), strict=True):

        def closer(i, best, interval=interval):
            t, solid_idx = best
            enter, leave = interval(*_to_unit(scene.frames[i], origin, rays))
            is_hit = (enter <= leave) & (enter > _TINY) & (enter < t)
            return jnp.where(is_hit, enter, t), jnp.where(is_hit, i, solid_idx)

        t, solid_idx = jax.lax.fori_loop(first, end, closer, (t, solid_idx))
    return t, solid_idx


def _ranges(scene: Scene) -> list[tuple[int, Array]]:
    """Ranges of the used rows of boxes, balls and cylinders."""
    return [(first, first + scene.counts[i]) for i, first in enumerate(FIRST_ROWS.values())]


# -- shading ----------------------------------------------------------------------------------------------------------


def _shade(
    scene: Scene, origin: Array, rays: Rays, t: Array, solid_idx: Array, pixel: Array
) -> Float[Array, "s h w 3"]:
    """Color of each hit; `pixel` is the footprint of a ray at unit depth."""
    points = [o + t * d for o, d in zip(origin, rays, strict=True)]
    frame = jnp.moveaxis(scene.frames.reshape(-1, 12)[solid_idx], -1, 0)
    local = [frame[4 * i] * points[0] + frame[4 * i + 1] * points[1] + frame[4 * i + 2] * points[2] + frame[4 * i + 3]
             for i in range(3)]  # fmt: skip
    face_idx, unit_normal = _faces(local, solid_idx)
    normal = [sum(frame[4 * i + j] * unit_normal[i] for i in range(3)) for j in range(3)]
    length = jnp.sqrt(sum(n * n for n in normal))
    reach = jnp.sqrt(sum(d * d for d in rays))
    facing = jnp.abs(sum(n * d for n, d in zip(normal, rays, strict=True))) / (length * reach)
    outward = jnp.where(solid_idx >= NUM_SOLIDS, -1.0, 1.0)
    lambert = outward * sum(n * scene.light[j] for j, n in enumerate(normal)) / length

    face = jnp.moveaxis(scene.faces.reshape(-1, scene.faces.shape[-1])[solid_idx * 6 + face_idx], -1, 0)
    u = face[0] * local[0] + face[1] * local[1] + face[2] * local[2] + face[3]
    v = face[4] * local[0] + face[5] * local[1] + face[6] * local[2] + face[7]
    # Nearer to the long side of the footprint than to the short one: some blur at grazing angles, but little moire.
    texels = t * pixel * face[8] * SIZE * jnp.maximum(facing, 0.08) ** -0.6
    texture_idx = scene.face_textures.reshape(-1)[solid_idx * 6 + face_idx]
    albedo = _sample_textures(scene.pyramids, texture_idx, u, v, jnp.log2(jnp.maximum(texels, 1.0)))
    shaded = (scene.ambient + (1.0 - scene.ambient) * (0.5 + 0.5 * lambert)) * _occlusion(scene, points, solid_idx)
    light = shaded + face[15] * (1.0 - shaded)
    colors = [jnp.clip((albedo[c] * face[9 + c] + face[12 + c]) * light, 0.0, 1.0) for c in range(3)]
    return jnp.stack(colors, axis=-1)


def _faces(local: list[Array], solid_idx: Array):
    """Index of the face (0..5: -x +x -y +y -z +z), by the dominant axis, and outward normal in the unit frame."""
    is_cylinder = (solid_idx >= NUM_BOXES + NUM_BALLS) & (solid_idx < NUM_SOLIDS)
    is_round = ((solid_idx >= NUM_BOXES) & (solid_idx < NUM_SOLIDS)) | (solid_idx == NUM_SOLIDS + 1)
    ax, ay, az = (jnp.abs(p) for p in local)
    is_cap = is_cylinder & (ay > 0.9999)
    ay = jnp.where(is_cylinder, jnp.where(is_cap, 2.0, 0.0), ay)
    is_x, is_y = (ax >= ay) & (ax >= az), (ay > ax) & (ay >= az)
    sign = [jnp.where(p < 0, -1.0, 1.0) for p in local]
    is_smooth = is_round & ~is_cap
    flat = [is_x, is_y, ~is_x & ~is_y]
    normal = [jnp.where(is_smooth, p, jnp.where(f, s, 0.0)) for p, f, s in zip(local, flat, sign, strict=True)]
    normal[1] = jnp.where(is_cylinder & ~is_cap, 0.0, normal[1])
    chosen = jnp.where(is_x, local[0], jnp.where(is_y, local[1], local[2]))
    axis = jnp.where(is_x, 0, jnp.where(is_y, 1, 2))
    return 2 * axis + (chosen > 0).astype(jnp.int32), normal


def _occlusion(scene: Scene, points: list[Array], solid_idx: Array) -> Float[Array, "s h w"]:
    """Soft darkening near other solids and in the corners of the shell."""
    reach = scene.occlusion_reach

    def darken(i, light):
        frame, half = scene.frames[i], scene.halves[i]
        away = [jnp.maximum(jnp.abs(frame[j, 0] * points[0] + frame[j, 1] * points[1] + frame[j, 2] * points[2]
                                    + frame[j, 3]) - 1.0, 0.0) * half[j] for j in range(3)]  # fmt: skip
        near = jnp.maximum(1.0 - jnp.sqrt(sum(a * a for a in away)) / reach, 0.0)
        return light * jnp.where(solid_idx == i, 1.0, 1.0 - scene.occlusion * near * near)

    light = jnp.ones_like(points[0])
    for first, end in _ranges(scene):
        light = jax.lax.fori_loop(first, end, darken, light)
    frame, half = scene.frames[NUM_SOLIDS], scene.halves[NUM_SOLIDS]
    gaps = [(1.0 - jnp.abs(frame[j, j] * points[j] + frame[j, 3])) * half[j] for j in range(3)]
    is_shell = solid_idx == NUM_SOLIDS
    for gap in gaps:
        near = jnp.maximum(1.0 - jnp.maximum(gap, 0.0) / reach, 0.0)
        # One of the three gaps is that to the wall itself; its constant factor is divided out below.
        light = light * (1.0 - scene.occlusion * 0.6 * near * near)
    return jnp.where(is_shell, light / (1.0 - scene.occlusion * 0.6), light)


# -- textures ---------------------------------------------------------------------------------------------------------


def _sample_textures(pyramids: AnyArray, texture_idx: Array, u: Array, v: Array, level: Array) -> list[Array]:
    """Trilinear, mirrored texture lookup at (u, v) in tiles; `level` is the fractional mip level."""
    low = jnp.clip(jnp.floor(level), 0.0, NUM_LEVELS - 2.0)
    blend = jnp.clip(level - low, 0.0, 1.0)
    low_idx = low.astype(jnp.int32)
    near = _sample_level(pyramids, texture_idx, u, v, low_idx)
    far = _sample_level(pyramids, texture_idx, u, v, low_idx + 1)
    return [n + blend * (f - n) for n, f in zip(near, far, strict=True)]


def _sample_level(pyramids: AnyArray, texture_idx: Array, u: Array, v: Array, level: Array) -> list[Array]:
    """Bilinear, mirrored texture lookup in one mip level."""
    size = jnp.right_shift(jnp.int32(SIZE), level)
    base = texture_idx * NUM_TEXELS + jnp.asarray(LEVEL_OFFSETS, jnp.int32)[level]
    x0, x1, fx = _mirrored(u, size)
    y0, y1, fy = _mirrored(v, size)
    texels = pyramids.reshape(-1)
    rows = []
    for y in (y0, y1):
        left, right = (_unpack(texels[base + y * size + x]) for x in (x0, x1))
        rows.append([a + fx * (b - a) for a, b in zip(left, right, strict=True)])
    return [a + fy * (b - a) for a, b in zip(*rows, strict=True)]


def _mirrored(u: Array, size: Array) -> tuple[Array, Array, Array]:
    """Indices of the two texels around coordinate `u`, mirrored at tile borders, and the fraction between them."""
    folded = 1.0 - jnp.abs(u - 2.0 * jnp.floor(u / 2.0) - 1.0)
    x = folded * size.astype(jnp.float32) - 0.5
    floor = jnp.floor(x)
    first = floor.astype(jnp.int32)
    return jnp.maximum(first, 0), jnp.minimum(first + 1, size - 1), x - floor


def _unpack(texel: Array) -> list[Array]:
    """Red, green and blue in [0, 1] of packed texels."""
    channels = [jnp.bitwise_and(jnp.right_shift(texel, jnp.uint32(s)), jnp.uint32(255)) for s in (0, 8, 16)]
    return [c.astype(jnp.int32).astype(jnp.float32) * (1.0 / 255.0) for c in channels]
