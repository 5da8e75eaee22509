"""Small random scenes, and cameras in front of them."""

import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from ssplat_jax.core.cameras import Camera
from ssplat_jax.core.gaussians import Gaussians
from ssplat_jax.core.rotations import sh_basis

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


def assert_turned(found: Gaussians, plain: Gaussians, turn: np.ndarray, scale: float = 1.0) -> None:
    """Colors seen along turned or mirrored directions, and covariances, are those of the turned or mirrored scene."""
    roots = [Rotation.from_quat(g.quats, scalar_first=True).as_matrix() * g.scales[:, None] for g in (found, plain)]
    covariances = [np.asarray(root @ root.transpose(0, 2, 1)) for root in roots]
    np.testing.assert_allclose(covariances[0], scale**2 * turn @ covariances[1] @ turn.T, atol=1e-5)
    directions = np.random.default_rng(0).normal(size=(40, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    basis = [np.asarray(sh_basis(jnp.asarray(d, jnp.float32), 3)) for d in (directions @ turn.T, directions)]
    colors = [np.einsum("dk,nkc->dnc", b[:, : g.sh.shape[1]], g.sh) for b, g in zip(basis, (found, plain), strict=True)]
    np.testing.assert_allclose(*colors, atol=1e-4)


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


def camera() -> Camera:
    """Camera at the origin that looks along +z."""
    return Camera(viewmats=jnp.eye(4), Ks=jnp.array([[40.0, 0, 24], [0, 40, 16], [0, 0, 1]]), width=48, height=32)
