"""Streams a live source: one posed image at a time, as a phone or a robot sends them."""

import sys
from collections.abc import Iterator

import numpy as np

import ssplat_jax as ss


def source(path: str) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Stands for a camera: (RGB image, 3x3 intrinsics in pixels, 4x4 world-to-camera transform), one after another."""
    capture = ss.open_capture(path)
    for i in range(len(capture)):
        camera = capture.camera(i)
        yield capture.image(i), np.asarray(camera.Ks), np.asarray(camera.viewmats)


def main(path: str) -> ss.Gaussians:
    session = ss.Session(ss.StreamSplat(ss.preset("tiny")), ss.load_params("tiny"))
    for number, (image, K, viewmat) in enumerate(source(path), start=1):
        if (out := session.push(image, K, viewmat)) is not None:  # every fourth view completes a chunk
            print(f"{number} views, mean confidence {float(out.confidences.mean()):.2f}")
    session.flush()  # the views that still wait, however few
    gaussians = session.gaussians()
    if session.stream_frame is not None:
        ss.save_ply("live.ply", session.stream_frame.gaussians_to_capture(gaussians))  # in the frame of the poses
    return gaussians


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else "procedural:room")
