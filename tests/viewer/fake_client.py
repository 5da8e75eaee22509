"""Scenes and runs to view, and a client of viser without a browser, which keeps what it is sent."""

import contextlib
import socket
from types import SimpleNamespace

import numpy as np
from scipy.spatial.transform import Rotation

from ssplat_jax.data.stream_frame import StreamFrame
from ssplat_jax.streaming.scene_delta import SceneDelta
from tests.scene_files.scene_fixture import scene


def free_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def frame(origin=(0.0, 0.0, 0.0)):
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec([0.3, -0.2, 0.5]).as_matrix()
    pose[:3, 3] = origin
    return StreamFrame.at_camera(pose, scale=2.0, near=0.5, far=8.0)


def delta(rows, seed):
    """Changes of two Gaussians for each of some rows."""
    return SceneDelta(np.asarray(rows, np.int32), scene(0, 2 * len(rows), seed), 8)


def header(stream=None, exposure=(1.0, 1.0, 1.0)):
    """The header of a delta."""
    return {"frame": (frame() if stream is None else stream).to_dict(), "exposure": list(exposure)}


class Handle(SimpleNamespace):
    """A control or a node of the scene."""

    removed, num_updates = False, 0

    def on_click(self, callback):
        self.callback = callback

    def click(self, value=None):
        """Clicks on it, as a person does."""
        self.value = value
        self.callback(SimpleNamespace(target=self))

    def remove(self):
        self.removed = True

    def set_gaussians(self, **fields):
        self.__dict__.update(fields)
        self.num_updates += 1


class FakeClient:
    """The client, its panel and its scene: controls by label, nodes by name, and pictures."""

    def __init__(self, width=48, height=32):
        self.client_id, self.gui, self.scene = 0, self, self
        self.controls, self.nodes, self.backgrounds = {}, {}, []
        self.camera = SimpleNamespace(
            wxyz=np.array([1.0, 0.0, 0.0, 0.0]),
            position=np.zeros(3),
            look_at=np.array([0.0, 0.0, 1.0]),
            up_direction=np.array([0.0, -1.0, 0.0]),
            fov=0.9,
            image_width=width,
            image_height=height,
        )

    def __getattr__(self, method):
        """Any method of viser that adds a control or a node."""
        if not method.startswith("add_"):
            raise AttributeError(method)

        def add(name, *_, initial_value=None, **fields):
            held = self.nodes if name.startswith("/") else self.controls
            held[name] = Handle(value=initial_value, **fields)
            return held[name]

        return add

    def set_panel_label(self, label):
        self.label = label

    def atomic(self):
        return contextlib.nullcontext()

    def set_background_image(self, image, format, **_):
        self.backgrounds.append(image)
