"""Mitsuba's ray tracer of Gaussians for `ssplat bench render`: another renderer that needs no CUDA, with gradients.

    pip install mitsuba    # it compiles by LLVM, a package of the system such as Debian's libllvm19; 15 is too old
    ssplat bench render --against experiments/on_mitsuba.py

A ray meets the Gaussians one after the other, and their density is taken in three dimensions ("3D Gaussian Ray
Tracing", Moenne-Loccoz et al., 2024), so that its images differ from those of a rasterizer, which flattens Gaussians
and dilates them.
"""

from collections.abc import Callable
from typing import Any

import drjit as dr  # pyright: ignore[reportMissingImports]
import mitsuba as mi  # pyright: ignore[reportMissingImports]
import numpy as np

from ssplat_jax.core.gaussians import SH_C0

MAX_HITS = 1024  # Gaussians that a ray meets at most: no ray of the timed scenes meets more before it is opaque
AXES = np.diag([-1.0, -1.0, 1.0, 1.0])  # of Mitsuba's cameras in ours: x to the left, y up


def mitsuba_scene(means, quats, scales, opacities, colors, viewmat, K, width: int, height: int):
    """Mitsuba's scene of Gaussians and one camera, from arrays of NumPy; the principal point is the image's center."""
    mi.set_variant("llvm_ad_rgb")
    quats = quats[:, [1, 2, 3, 0]] / np.linalg.norm(quats, axis=-1, keepdims=True)
    parts = {"centers": means, "scales": scales, "quaternions": quats}
    parts |= {"opacities": opacities[:, None], "sh_coeffs": (colors - 0.5) / SH_C0}
    arrays = {name: mi.TensorXf(np.ascontiguousarray(part, np.float32)) for name, part in parts.items()}
    sensor = {
        "type": "perspective",
        "fov": float(np.degrees(2 * np.arctan(width / (2 * K[0, 0])))),
        "near_clip": 1e-3,
        "to_world": mi.ScalarTransform4f(np.linalg.inv(viewmat.astype(np.float64)) @ AXES),
        "film": {"type": "hdrfilm", "width": width, "height": height, "rfilter": {"type": "box"}},
    }
    integrator = {"type": "volprim_rf_basic", "max_depth": MAX_HITS, "srgb_primitives": False}
    gaussians = {"type": "ellipsoids", **arrays}
    return mi.load_dict({"type": "scene", "integrator": integrator, "sensor": sensor, "gaussians": gaussians})


def candidates(*scene_arrays) -> dict[str, Callable[[], Any]]:
    """`forward` and `forward_backward`, which wait for the result: colors of one ray a pixel.

    The arguments are those of `mitsuba_scene`; the gradient reaches all arrays of the Gaussians.
    """
    scene = mitsuba_scene(*scene_arrays)
    params = mi.traverse(scene)
    learned = [f"gaussians.{name}" for name in ("data", "opacities", "sh_coeffs")]

    def forward():
        dr.eval(mi.render(scene, spp=1))
        dr.sync_thread()

    def forward_backward():
        for name in learned:
            dr.enable_grad(params[name])
        image = mi.render(scene, params, spp=1)
        dr.backward(dr.sum(image * image, axis=None))
        dr.eval([dr.grad(params[name]) for name in learned])
        dr.sync_thread()

    return {"forward": forward, "forward_backward": forward_backward}
