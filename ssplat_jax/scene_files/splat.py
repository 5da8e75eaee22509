"""The .splat file of the first browser viewers, which is written only: 32 bytes per Gaussian, constant colors.

    x y z (float32) · scales (float32, standard deviations) · r g b opacity (uint8) · w x y z (uint8, 128 + 128 q)

Rows are sorted by volume times opacity, largest first, because a viewer may draw the scene before it is loaded
completely. There is no header: viewers assume that y points down and dilate as 3DGS does.
"""

import numpy as np

from ssplat_jax.core.gaussians import SH_C0
from ssplat_jax.scene_files.splat_rows import SplatRows, to_bytes

ROW = np.dtype([("mean", "<f4", 3), ("scales", "<f4", 3), ("rgba", "u1", 4), ("quat", "u1", 4)])


def encode_splat(rows: SplatRows) -> bytes:
    """The bytes of a .splat; colors are clipped to [0, 1], SH bands above the constant one are dropped."""
    prominence = rows.log_scales.sum(axis=1) + np.log(rows.opacities)
    order = np.argsort(-prominence, kind="stable")
    table = np.zeros(len(rows), ROW)
    table["mean"] = rows.means[order]
    table["scales"] = np.exp(rows.log_scales[order])
    table["rgba"][:, :3] = to_bytes(255 * (0.5 + SH_C0 * rows.sh[order, 0]))
    table["rgba"][:, 3] = to_bytes(255 * rows.opacities[order])
    table["quat"] = to_bytes(128 + 128 * rows.quats[order])
    return table.tobytes()
