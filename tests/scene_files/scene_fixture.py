"""Small random scenes, and cameras in front of them."""

import jax.numpy as jnp
import numpy as np

from ssplat_jax.core.cameras import Camera
from ssplat_jax.core.gaussians import Gaussians

FIELDS = ("means", "quats", "scales", "opacities", "sh")


def scene(degree: int = 2, n: int = 60, seed: int = 0) -> Gaussians:
    """Random Gaussians of various sizes and opacities in front of the camera at the origin."""
    rng = np.random.default_rng(seed)
    means = rng.uniform([-1, -1, 2], [1, 1, 4], (n, 3))
    return Gaussians(
        means=jnp.asarray(means, jnp.float32),
        quats=jnp.asarray(rng.normal(size=(n, 4)), jnp.float32),
        scales=jnp.asarray(np.exp(rng.uniform(-4, -1, (n, 3))), jnp.float32),
        opacities=jnp.asarray(rng.uniform(0.05, 1.0, n), jnp.float32),
        sh=jnp.asarray(rng.normal(size=(n, (degree + 1) ** 2, 3)) * 0.3, jnp.float32),
    )


def compressed_ply(degree: int = 1, n: int = 300) -> bytes:
    """A compressed .ply of random words, all of which are valid."""
    rng, num_rest = np.random.default_rng(0), 3 * ((degree + 1) ** 2 - 1)
    limits = [f"{end}_{axis}" for axes in ("x y z", "scale_x scale_y scale_z", "r g b") for end in ("min", "max")
              for axis in axes.split()]  # fmt: skip
    header = ["ply", "format binary_little_endian 1.0", f"element chunk {-(-n // 256)}"]
    header += [f"property float {name}" for name in limits] + [f"element vertex {n}"]
    header += [f"property uint packed_{name}" for name in ("position", "rotation", "scale", "color")]
    header += [f"element sh {n}"] * (num_rest > 0) + [f"property uchar f_rest_{i}" for i in range(num_rest)]
    chunks = rng.uniform([-1] * 3 + [1] * 3 + [-4] * 3 + [-1] * 3 + [0] * 3 + [1] * 3, size=(-(-n // 256), 18))
    words, rest = rng.integers(1 << 32, size=(n, 4)).astype("<u4"), rng.integers(256, size=(n, num_rest))
    parts = chunks.astype("<f4").tobytes(), words.tobytes(), rest.astype(np.uint8).tobytes()
    return "\n".join([*header, "end_header\n"]).encode() + b"".join(parts)


def camera(x: float = 0.0) -> Camera:
    """Camera near the origin that looks along +z."""
    viewmat = jnp.eye(4).at[0, 3].set(x)
    return Camera(viewmats=viewmat, Ks=jnp.array([[40.0, 0, 24], [0, 40, 16], [0, 0, 1]]), width=48, height=32)
