"""Pictures of a scene by our rasterizer, from the camera of a browser."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, UInt8

from ssplat_jax.core.cameras import Camera
from ssplat_jax.core.gaussians import mean_color
from ssplat_jax.evaluation.pictures import color_depth, color_normals, color_share, eight_bits, scale_ends
from ssplat_jax.rasterizer import Effects, fill_holes, render
from ssplat_jax.viewer.browser_camera import BrowserCamera
from ssplat_jax.viewer.viewed_scene import ViewedScene

KINDS = ("color", "depth", "normals", "confidence", "exposure")
"""Kinds of picture; `exposure` is color at the exposure of the nearest streamed view."""

DRAFT, FINE = (320, 240), (960, 640)
"""Sizes (width, height) of pictures while the camera moves, and when it rests. They are fixed, so that few programs are
compiled: pixels are not square, and the browser stretches a picture over its window."""

_jitted_fill_holes = jax.jit(fill_holes)


def draw(
    scene: ViewedScene,
    kind: str,
    camera: BrowserCamera,
    size: tuple[int, int],
    *,
    over_black: bool = False,
    exposure: Float[np.ndarray, "3"] | None = None,
) -> UInt8[np.ndarray, "h w 3"]:
    """Draws a scene.

    Depth is colored from light to dark over the depths of the picture, confidence from dark to light over [0, 1].

    Args:
        scene: the scene; without confidences, `confidence` shows the share of light that the scene stops.
        kind: one of `KINDS`.
        camera: from where, in the units of the scene.
        size: (width, height) of the picture.
        over_black: show holes black instead of in the colors around them.
        exposure: with the kind `exposure`, that of the view, relative to the first views of the run.
    """
    width, height = size
    viewmat, K = np.linalg.inv(camera.camtoworld), camera.K(size)
    view = Camera(
        viewmats=jnp.asarray(viewmat, jnp.float32), Ks=jnp.asarray(K, jnp.float32), width=width, height=height
    )
    features = None
    if kind == "confidence" and scene.confidences is not None:
        features = jnp.asarray(scene.confidences)[:, None]
    out = render(scene.gaussians, view, effects=Effects(antialias=scene.antialias), features=features)
    depth, alpha = np.asarray(out.depth), np.asarray(out.alpha)
    if kind == "depth":
        return eight_bits(color_depth(depth, *scale_ends(depth[depth > 0])))
    if kind == "normals":
        return eight_bits(color_normals(depth, K))
    if kind == "confidence":
        share = alpha if features is None else np.asarray(out.features)[..., 0] / np.maximum(alpha, 1e-6)
        return eight_bits(np.where(alpha[..., None] > 0.5, color_share(share), 0.0))
    color = np.asarray(
        out.color if over_black else _jitted_fill_holes(out.color, out.alpha, mean_color(scene.gaussians))
    )
    return eight_bits(color * (exposure / scene.exposure) if kind == "exposure" and exposure is not None else color)
