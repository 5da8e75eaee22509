"""Parts of a report: pictures, scores and records."""

import numpy as np

from ssplat_jax.storage.chunk_records import ChunkRecord, RecordedView, make_thumbnail


def smooth_picture(k, height=24, width=96):
    y, x = np.mgrid[:height, :width] / width
    return np.stack([x, y, 0.5 + 0.4 * np.sin(6 * x + k)], axis=-1).astype(np.float32)


def score(frame):
    block = {"psnr": 20.0 + frame / 10, "ssim": 0.7, "lpips": None}
    return {"frame": frame, "shown": block, "literal": block | {"psnr": 15.25}, "coverage": 0.9}


def record(num_views):
    views = tuple(
        RecordedView(i, np.eye(4), np.eye(3), np.array([1.0, 1 + i / 50, 1.0]), make_thumbnail(smooth_picture(i)))
        for i in range(num_views - 4, num_views)
    )
    return ChunkRecord(num_views, (96, 24), views, 0.25, num_views / 40, 1000 * num_views)


COMMON = {
    "capture": 'a <room> & "more"',
    "size": [96, 24],
    "exposures": {"0": [1.0, 1.0, 1.0], "1": [1.5, 1.0, 1.0]},
    "cache": {"voxels": 10, "capacity": 20, "accepted_fraction": 0.5},
    "stream_frame": {"near": 1.0, "far": 4.0, "scale": 2.0, "warning": None},
    "compile_s": 1.5,
    "config_hash": "0123456789ab",
}
