"""The ray-caster: exact depth and antialiased color of a `Scene`, one compilation for every scene.

Rays carry a direction whose camera z is 1, so the parameter of a hit is its z-depth. Each solid is a unit shape (cube,
ball, cylinder along y) in its own frame, entered where all of its slabs have been entered; the shell closes the world
and is left, not entered. Depth is that of the pixel's center; color is the mean of `supersample` rays per pixel, each
with a trilinear texture lookup at the ray's own footprint. Unused rows cost nothing: loops run to the scene's counts.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ssplat_jax.data.procedural.scene import NUM_BALLS, NUM_BOXES, NUM_SOLIDS, AnyArray, Scene
from ssplat_jax.data.procedural.textures import LEVEL_OFFSETS, NUM_LEVELS, NUM_TEXELS, SIZE

_TINY = 1e-9
_FAR = 1e9

Rays = tuple[Float[Array, "s h w"], Float[Array, "s h w"], Float[Array, "s h w"]]


@functools.partial(jax.jit, static_argnames=("height", "width", "supersample"))
def raycast(
    scene: Scene,
    viewmats: Float[AnyArray, "v 4 4"],
    Ks: Float[AnyArray, "v 3 3"],
    height: int,
    width: int,
    supersample: int = 2,
) -> tuple[Float[Array, "v h w 3"], Float[Array, "v h w"]]:
    """Images in [0, 1] and z-depths of the scene in every view, `supersample` color rays a pixel.

    Limits:
        A camera outside the shell or inside a solid sees what lies beyond, not an error: keep `clearance` positive.
        float32: relative error of a depth below 2e-5, silhouettes apart, in scenes a few units across.
    """

    def render_view(camera):
        viewmat, K = camera
        origin, rotation = _camera_frame(viewmat)
        rays = _ray_directions(rotation, K, height, width, _pixel_offsets(supersample))
        t, solid_idx = _nearest_hits(scene, origin, rays)
        depth, t, solid_idx = t[0], t[-supersample:], solid_idx[-supersample:]
        rays = (rays[0][-supersample:], rays[1][-supersample:], rays[2][-supersample:])
        colors = _shade(scene, origin, rays, t, solid_idx, pixel=1.0 / (K[0, 0] * supersample**0.5))
        return jnp.mean(colors, axis=0), depth

    return jax.lax.map(render_view, (jnp.asarray(viewmats), jnp.asarray(Ks)))


@functools.partial(jax.jit, static_argnames=("height", "width"))
def raycast_depths(
    scene: Scene, viewmats: Float[AnyArray, "v 4 4"], Ks: Float[AnyArray, "v 3 3"], height: int, width: int
) -> Float[Array, "v h w"]:
    """Z-depths alone, as `raycast` gives them."""

    def render_view(camera):
        viewmat, K = camera
        origin, rotation = _camera_frame(viewmat)
        rays = _ray_directions(rotation, K, height, width, _pixel_offsets(1))
        return _nearest_hits(scene, origin, rays)[0][0]

    return jax.lax.map(render_view, (jnp.asarray(viewmats), jnp.asarray(Ks)))


def _camera_frame(viewmat: Array) -> tuple[Array, Array]:
    """Camera center and camera-to-world rotation."""
    rotation = viewmat[:3, :3].T
    return -jnp.einsum("ij,j->i", rotation, viewmat[:3, 3], precision=jax.lax.Precision.HIGHEST), rotation


def _pixel_offsets(count: int) -> np.ndarray:
    """The pixel's center; where `count` > 1, then that many points of a rank-1 lattice inside the pixel."""
    center = np.full((1, 2), 0.5, np.float32)
    if count <= 1:
        return center
    k = np.arange(count)
    step = next(s for s in range(round(0.62 * count), count + 1) if np.gcd(s, count) == 1)
    lattice = (np.stack([k, k * step % count], axis=-1) + 0.5) / count
    return np.concatenate([center, lattice.astype(np.float32)])


def _ray_directions(rotation: Array, K: Array, height: int, width: int, offsets: np.ndarray) -> Rays:
    """World directions with unit camera z through every pixel at every offset."""
    x = (jnp.arange(width, dtype=jnp.float32) + offsets[:, :1] - K[0, 2]) / K[0, 0]
    y = (jnp.arange(height, dtype=jnp.float32) + offsets[:, 1:] - K[1, 2]) / K[1, 1]
    x, y = x[:, None, :], y[:, :, None]
    dx, dy, dz = (rotation[i, 0] * x + rotation[i, 1] * y + rotation[i, 2] for i in range(3))
    return dx, dy, dz


# -- intersection -----------------------------------------------------------------------------------------------------


def _to_unit(frame: AnyArray, origin: Array, rays: Rays):
    """A ray in a solid's unit frame: three scalars and three images."""
    start = [
        frame[i, 0] * origin[0] + frame[i, 1] * origin[1] + frame[i, 2] * origin[2] + frame[i, 3] for i in range(3)
    ]
    steps = [frame[i, 0] * rays[0] + frame[i, 1] * rays[1] + frame[i, 2] * rays[2] for i in range(3)]
    return start, steps


def _slab(start: Array, step: Array) -> tuple[Array, Array]:
    """Where a ray enters and leaves the slab |x| <= 1."""
    inverse = 1.0 / jnp.where(jnp.abs(step) < _TINY, _TINY, step)
    a, b = (-1.0 - start) * inverse, (1.0 - start) * inverse
    return jnp.minimum(a, b), jnp.maximum(a, b)


def _quadric(start: list[Array], steps: list[Array]) -> tuple[Array, Array]:
    """Where a ray enters and leaves the unit ball of as many axes as it is given (two: an endless cylinder)."""
    a = jnp.maximum(sum(d * d for d in steps), _TINY)
    b = sum(o * d for o, d in zip(start, steps, strict=True))
    # The squared distance of closest approach, without the cancellation of b^2 - a c.
    miss = sum((o - b / a * d) ** 2 for o, d in zip(start, steps, strict=True))
    root = jnp.sqrt(jnp.maximum(1.0 - miss, 0.0) / a)
    enter, leave = -b / a - root, -b / a + root
    return jnp.where(miss > 1.0, _FAR, enter), jnp.where(miss > 1.0, -_FAR, leave)


def _box_interval(start, steps):
    slabs = [_slab(o, d) for o, d in zip(start, steps, strict=True)]
    return functools.reduce(jnp.maximum, [s[0] for s in slabs]), functools.reduce(jnp.minimum, [s[1] for s in slabs])


def _ball_interval(start, steps):
    return _quadric(start, steps)


def _cylinder_interval(start, steps):
    enter, leave = _quadric([start[0], start[2]], [steps[0], steps[2]])
    cap_enter, cap_leave = _slab(start[1], steps[1])
    return jnp.maximum(enter, cap_enter), jnp.minimum(leave, cap_leave)


def _nearest_hits(scene: Scene, origin: Array, rays: Rays) -> tuple[Float[Array, "s h w"], Int[Array, "s h w"]]:
    """Z-depth and index of what each ray meets first; the shell's box and dome come after the solids."""
    _, box_exit = _box_interval(*_to_unit(scene.frames[NUM_SOLIDS], origin, rays))
    _, dome_exit = _ball_interval(*_to_unit(scene.frames[NUM_SOLIDS + 1], origin, rays))
    t = jnp.minimum(box_exit, dome_exit)
    solid_idx = jnp.where(dome_exit < box_exit, NUM_SOLIDS + 1, NUM_SOLIDS).astype(jnp.int32)
    for (first, end), interval in zip(_ranges(scene), (_box_interval, _ball_interval, _cylinder_interval), strict=True):

        def closer(i, best, interval=interval):
            t, solid_idx = best
            enter, leave = interval(*_to_unit(scene.frames[i], origin, rays))
            is_hit = (enter <= leave) & (enter > _TINY) & (enter < t)
            return jnp.where(is_hit, enter, t), jnp.where(is_hit, i, solid_idx)

        t, solid_idx = jax.lax.fori_loop(first, end, closer, (t, solid_idx))
    return t, solid_idx


def _ranges(scene: Scene) -> list[tuple[int, Array]]:
    """First and one past the last used row of boxes, balls and cylinders."""
    return [(first, first + scene.counts[i]) for i, first in enumerate((0, NUM_BOXES, NUM_BOXES + NUM_BALLS))]


# -- shading ----------------------------------------------------------------------------------------------------------


def _shade(
    scene: Scene, origin: Array, rays: Rays, t: Array, solid_idx: Array, pixel: Array
) -> Float[Array, "s h w 3"]:
    """Color of each hit; `pixel` is a ray's footprint at unit depth."""
    points = [o + t * d for o, d in zip(origin, rays, strict=True)]
    frame = jnp.moveaxis(scene.frames.reshape(-1, 12)[solid_idx], -1, 0)
    local = [frame[4 * i] * points[0] + frame[4 * i + 1] * points[1] + frame[4 * i + 2] * points[2] + frame[4 * i + 3]
             for i in range(3)]  # fmt: skip
    face_idx, unit_normal = _faces(local, solid_idx)
    normal = [sum(frame[4 * i + j] * unit_normal[i] for i in range(3)) for j in range(3)]
    length = jnp.sqrt(sum(n * n for n in normal))
    facing = jnp.abs(sum(n * d for n, d in zip(normal, rays, strict=True))) / (
        length * jnp.sqrt(sum(d * d for d in rays))
    )
    outward = jnp.where(solid_idx >= NUM_SOLIDS, -1.0, 1.0)
    lambert = outward * sum(n * scene.light[j] for j, n in enumerate(normal)) / length

    face = jnp.moveaxis(scene.faces.reshape(-1, scene.faces.shape[-1])[solid_idx * 6 + face_idx], -1, 0)
    u = face[0] * local[0] + face[1] * local[1] + face[2] * local[2] + face[3]
    v = face[4] * local[0] + face[5] * local[1] + face[6] * local[2] + face[7]
    # Nearer to the long than to the short side of the footprint: a little blur at grazing angles, hardly any moire.
    texels = t * pixel * face[8] * SIZE * jnp.maximum(facing, 0.08) ** -0.6
    texture_idx = scene.face_textures.reshape(-1)[solid_idx * 6 + face_idx]
    albedo = _sample_textures(scene.pyramids, texture_idx, u, v, jnp.log2(jnp.maximum(texels, 1.0)))
    shaded = (scene.ambient + (1.0 - scene.ambient) * (0.5 + 0.5 * lambert)) * _occlusion(scene, points, solid_idx)
    light = shaded + face[15] * (1.0 - shaded)
    colors = [jnp.clip((albedo[c] * face[9 + c] + face[12 + c]) * light, 0.0, 1.0) for c in range(3)]
    return jnp.stack(colors, axis=-1)


def _faces(local: list[Array], solid_idx: Array):
    """Face (0..5: -x +x -y +y -z +z) by the dominant axis, and the outward normal in the unit frame."""
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
    """Soft darkening where another solid, or the shell's corners, are near."""
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
        # The wall itself is one of the three: it darkens by the same factor everywhere, which is taken out again.
        light = light * (1.0 - scene.occlusion * 0.6 * near * near)
    return jnp.where(is_shell, light / (1.0 - scene.occlusion * 0.6), light)


# -- textures ---------------------------------------------------------------------------------------------------------


def _sample_textures(pyramids: AnyArray, texture_idx: Array, u: Array, v: Array, level: Array) -> list[Array]:
    """Trilinear, mirrored lookup at (u, v) in tiles; `level` is the fractional mip level."""
    low = jnp.clip(jnp.floor(level), 0.0, NUM_LEVELS - 2.0)
    blend = jnp.clip(level - low, 0.0, 1.0)
    low_idx = low.astype(jnp.int32)
    near = _sample_level(pyramids, texture_idx, u, v, low_idx)
    far = _sample_level(pyramids, texture_idx, u, v, low_idx + 1)
    return [n + blend * (f - n) for n, f in zip(near, far, strict=True)]


def _sample_level(pyramids: AnyArray, texture_idx: Array, u: Array, v: Array, level: Array) -> list[Array]:
    """Bilinear, mirrored lookup in one level of the pyramid."""
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
    """The two texels around tile coordinate `u`, mirrored at every tile border, and the fraction between them."""
    folded = 1.0 - jnp.abs(u - 2.0 * jnp.floor(u / 2.0) - 1.0)
    x = folded * size.astype(jnp.float32) - 0.5
    floor = jnp.floor(x)
    first = floor.astype(jnp.int32)
    return jnp.maximum(first, 0), jnp.minimum(first + 1, size - 1), x - floor


def _unpack(texel: Array) -> list[Array]:
    """Red, green, blue in [0, 1] of a packed texel."""
    channels = [jnp.bitwise_and(jnp.right_shift(texel, jnp.uint32(s)), jnp.uint32(255)) for s in (0, 8, 16)]
    return [c.astype(jnp.int32).astype(jnp.float32) * (1.0 / 255.0) for c in channels]
