"""OpenGL renderer of the made worlds: color with 2x2 supersampling and linear z-depth from the same pass."""

import numpy as np

from ssplat_jax.core.errors import InputError
from ssplat_jax.data.worlds.meshes import Mesh

NEAR, FAR = 0.05, 200.0  # meters

_VERTEX = """#version 330
uniform mat4 view; uniform vec4 lens; in vec3 point; in vec3 light; in vec3 texel;
out vec3 shade; out vec3 place; out float depth;
void main() {
  vec4 p = view * vec4(point, 1); depth = -p.z; shade = light; place = texel;
  gl_Position = vec4(lens.x * p.x, lens.y * p.y, lens.z * p.z + lens.w, -p.z);
}"""
_FRAGMENT = """#version 330
uniform sampler2DArray skins; uniform float exposure; in vec3 shade; in vec3 place; in float depth;
layout(location = 0) out vec4 color; layout(location = 1) out float distance_z;
void main() {
  vec3 c = pow(texture(skins, place).rgb, vec3(2.2)) * shade * exposure;
  color = vec4(pow(clamp(c, 0, 1), vec3(1 / 2.2)), 1); distance_z = depth;
}"""


def open_context():
    """An OpenGL context without a window.

    Raises:
        InputError: moderngl or the OpenGL driver is missing.
    """
    try:
        import moderngl  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise InputError('made worlds: moderngl is missing; pip install "ssplat-jax[worlds]".') from error
    try:
        return moderngl.create_context(standalone=True, backend="egl")  # pyright: ignore[reportCallIssue, reportArgumentType]
    except Exception as error:  # moderngl raises plain Exception
        raise InputError(
            f"made worlds: no OpenGL driver ({error}); on Debian: apt-get install libegl1 libgl1-mesa-dri."
        ) from error


class GlRenderer:
    """A world on the OpenGL device, rendered at one size."""

    def __init__(self, context, meshes: list[Mesh], lights: list[np.ndarray], textures: np.ndarray, size) -> None:
        self._context, (self.width, self.height) = context, size
        shown = self.width * 2, self.height * 2
        self._program = context.program(vertex_shader=_VERTEX, fragment_shader=_FRAGMENT)
        rows = [
            np.concatenate([m.points, light, m.uv * 0.7, np.full((len(m.points), 1), m.layer)], 1)
            for m, light in zip(meshes, lights, strict=True)
        ]
        starts = np.cumsum([0, *map(len, rows)])
        order = np.concatenate([m.triangles + s for m, s in zip(meshes, starts, strict=False)]).astype(np.uint32)
        self._buffers = (
            context.buffer(np.concatenate(rows).astype(np.float32).tobytes()),
            context.buffer(order.tobytes()),
        )
        content = [(self._buffers[0], "3f 3f 3f", "point", "light", "texel")]
        self._mesh = context.vertex_array(self._program, content, self._buffers[1])
        layers, side = textures.shape[:2]
        self._skins = context.texture_array((side, side, layers), 3, textures.tobytes())
        self._skins.build_mipmaps()
        self._skins.filter = context.LINEAR_MIPMAP_LINEAR, context.LINEAR
        self._skins.anisotropy = 8.0
        self._targets = (
            context.texture(shown, 4),
            context.texture(shown, 1, dtype="f4"),
            context.depth_renderbuffer(shown),
        )
        self._frame = context.framebuffer(self._targets[:2], self._targets[2])

    def render(self, camtoworld: np.ndarray, focal: float, exposure: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
        """Renders one view.

        Args:
            camtoworld: camera-to-world pose with OpenGL axes, meters.
            focal: focal length in pixels; the center of the image is the principal point.
            exposure: factor on the light.

        Returns:
            Image uint8 (h, w, 3) and z-depth float32 (h, w) in meters, 0 for the sky.
        """
        self._frame.use()
        self._context.enable(self._context.DEPTH_TEST)
        self._frame.clear()
        view = np.linalg.inv(camtoworld).astype(np.float32)
        self._program["view"].write(view.T.tobytes())
        self._program["exposure"].value = exposure
        depth_row = -(FAR + NEAR) / (FAR - NEAR), -2 * FAR * NEAR / (FAR - NEAR)
        self._program["lens"].value = (2 * focal / self.width, 2 * focal / self.height, *depth_row)
        self._skins.use(0)
        self._mesh.render()
        h, w = self.height, self.width
        color = (
            np.frombuffer(self._frame.read(components=4), np.uint8)
            .reshape(2 * h, 2 * w, 4)[::-1, :, :3]
            .astype(np.float32)
        )
        depth = np.frombuffer(self._frame.read(components=1, attachment=1, dtype="f4"), np.float32).reshape(
            2 * h, 2 * w
        )[::-1]
        sky = np.linspace([120, 160, 215], [214, 224, 235], 2 * h, dtype=np.float32)[:, None]
        color = np.where(depth[..., None] > 0, color, sky)
        image = color.reshape(h, 2, w, 2, 3).mean((1, 3))
        return np.round(image).astype(np.uint8), _pixel_depth(depth.reshape(h, 2, w, 2))

    def release(self) -> None:
        """Frees the memory of the device."""
        for item in (self._mesh, *self._buffers, self._skins, self._frame, *self._targets, self._program):
            item.release()


def _pixel_depth(samples: np.ndarray) -> np.ndarray:
    """Depth at pixel centers: 1/z is linear on a plane, so its mean is exact; at edges the nearest sample."""
    far = np.where(samples > 0, samples, np.inf)
    nearest, farthest = far.min((1, 3)), far.max((1, 3))
    plane = 1 / np.maximum((1 / far).mean((1, 3)), 1e-9)
    return np.where(np.isinf(nearest), 0, np.where(farthest < 1.1 * nearest, plane, nearest)).astype(np.float32)
