"""Small captures in memory, captures with other poses, and the stream frame of the first camera."""

import dataclasses

import numpy as np
from scipy.spatial.transform import Rotation

from ssplat_jax.data.capture import ArrayPixels, Capture
from ssplat_jax.data.posed_image import Frame
from ssplat_jax.data.stream_frame import StreamFrame


def smooth_capture(num_frames=6, height=48, width=64):
    """Capture in memory whose images hold their own pixel coordinates: (x, y, i), scaled."""
    ys, xs = np.meshgrid(np.arange(height) + 0.5, np.arange(width) + 0.5, indexing="ij")
    images = np.stack([np.stack([xs / width, ys / height, 0 * xs + i / 10], -1) for i in range(num_frames)])
    depths = np.stack([1 + xs / width + i for i in range(num_frames)])
    frames, K = [], np.array([[60.0, 0, 30.0], [0, 61.0, 26.0], [0, 0, 1]])
    for i in range(num_frames):
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_euler("z", 10.0 * i, degrees=True).as_matrix()
        pose[:3, 3] = [0.3 * i, 0.05 * i, 0.1]
        frames.append(Frame(name=str(i), camtoworld=pose, K=K, width=width, height=height))
    pixels = ArrayPixels(images=images.astype(np.float32), depths=depths.astype(np.float32))
    return Capture(name="smooth", format="memory", frames=tuple(frames), pixels=pixels, width=width, height=height)


def with_poses(capture, camtoworlds):
    """The capture with other poses."""
    pairs = zip(capture.frames, camtoworlds, strict=True)
    return dataclasses.replace(capture, frames=tuple(dataclasses.replace(f, camtoworld=pose) for f, pose in pairs))


def frame_of(capture, scale=1.0):
    """Stream frame of the first camera."""
    return StreamFrame.at_camera(capture.frames[0].camtoworld, scale=scale, near=0.5, far=8.0)
