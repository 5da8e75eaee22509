"""gsplat's CUDA rasterizer as `ssplat bench render` times it beside ours; needs an NVIDIA GPU.

    pip install torch gsplat
    ssplat bench render --against experiments/gsplat_rasterizer.py --full-hd --json render.json

What both draw: color, alpha and expected depth of the same Gaussians, dilated by 0.3 square pixels; the gradient
reaches means, quaternions, scales, opacities and colors. Written for gsplat 1.5.
"""

from collections.abc import Callable

import torch  # pyright: ignore[reportMissingImports]
from gsplat import rasterization  # pyright: ignore[reportMissingImports]
from numpy import ndarray


def candidates(
    means: ndarray,
    quats: ndarray,
    scales: ndarray,
    opacities: ndarray,
    colors: ndarray,
    viewmat: ndarray,
    K: ndarray,
    width: int,
    height: int,
) -> dict[str, Callable[[], None]]:
    """`forward` and `forward_backward`, which return when the device is done. Arrays as `ssplat_jax` has them."""
    gaussians = [torch.tensor(x, device="cuda") for x in (means, quats, scales, opacities, colors)]
    viewmats, intrinsics = (torch.tensor(x, device="cuda")[None] for x in (viewmat, K))

    def draw():
        out, alphas, _ = rasterization(*gaussians, viewmats, intrinsics, width, height, render_mode="RGB+ED")
        return out, alphas

    def forward():
        with torch.no_grad():
            draw()
        torch.cuda.synchronize()

    def forward_backward():
        out, alphas = draw()
        loss = (out[..., :3] ** 2).sum() + alphas.sum() + out[..., 3].sum()
        torch.autograd.grad(loss, gaussians)
        torch.cuda.synchronize()

    for x in gaussians:
        x.requires_grad_()
    return {"forward": forward, "forward_backward": forward_backward}
