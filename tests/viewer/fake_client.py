"""Scenes and runs to view, and a client of viser without a browser, which keeps what it is sent."""

import contextlib
import socket
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

import ssplat_jax as ss
from ssplat_jax.core.pytree import replace
from ssplat_jax.data.stream_frame import StreamFrame
from ssplat_jax.streaming.scene_delta import SceneDelta


def free_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def scene(num_gaussians=50, size=1.0):
    rng = np.random.default_rng(0)
    values = {
        "means": size * rng.uniform([-1, -1, 2], [1, 1, 4], (num_gaussians, 3)),
        "quats": rng.normal(size=(num_gaussians, 4)),
        "scales": size * rng.uniform(0.02, 0.2, (num_gaussians, 3)),
        "opacities": rng.uniform(0.2, 0.9, num_gaussians),
        "colors": rng.uniform(size=(num_gaussians, 3)),
    }
    return ss.Gaussians.from_rgb(**{name: jnp.asarray(x, jnp.float32) for name, x in values.items()})


def frame(origin=(0.0, 0.0, 0.0)):
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec([0.3, -0.2, 0.5]).as_matrix()
    pose[:3, 3] = origin
    return StreamFrame.at_camera(pose, scale=2.0, near=0.5, far=8.0)


def delta(rows, seed):
    """Changes of two Gaussians for each of some rows."""
    rng, count = np.random.default_rng(seed), 2 * len(rows)
    gaussians = replace(scene(count), opacities=jnp.asarray(rng.uniform(0.2, 0.9, count), jnp.float32))
    return SceneDelta(np.asarray(rows, np.int32), gaussians, 8, rng.uniform(0.2, 0.9, count).astype(np.float32))


def header(stream=None, exposure=(1.0, 1.0, 1.0)):
    """The header of a delta."""
    return {"frame": (frame() if stream is None else stream).to_dict(), "exposure": list(exposure)}


class Handle(SimpleNamespace):
    """A control or a node of the scene."""

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
        self.num_updates = getattr(self, "num_updates", 0) + 1


class Gui:
    """The panel; controls are found by their label."""

    def __init__(self):
        self.controls = {}

    def _add(self, label, **fields):
        self.controls[label] = Handle(**fields)
        return self.controls[label]

    def set_panel_label(self, label):
        self.label = label

    def add_markdown(self, content):
        return self._add("facts", content=content)

    def add_dropdown(self, label, options, *, initial_value, hint):
        return self._add(label, options=options, value=initial_value)

    def add_slider(self, label, min, max, step, initial_value, *, visible, hint):
        return self._add(label, min=min, max=max, value=initial_value, visible=visible)

    def add_checkbox(self, label, initial_value, hint):
        return self._add(label, value=initial_value)

    def add_button_group(self, label, options):
        return self._add(label, options=options)

    def add_button(self, label):
        return self._add(label)


class FakeClient:
    """The client: panel, scene, camera and downloads."""

    def __init__(self, width=48, height=32):
        self.client_id, self.gui, self.scene = 0, Gui(), self
        self.nodes, self.backgrounds, self.downloads = {}, [], {}
        self.camera = SimpleNamespace(
            wxyz=np.array([1.0, 0.0, 0.0, 0.0]),
            position=np.zeros(3),
            look_at=np.array([0.0, 0.0, 1.0]),
            up_direction=np.array([0.0, -1.0, 0.0]),
            fov=0.9,
            image_width=width,
            image_height=height,
        )

    def atomic(self):
        return contextlib.nullcontext()

    def add_gaussian_splats(self, name, **fields):
        self.nodes[name] = Handle(**fields)
        return self.nodes[name]

    def add_camera_frustum(self, name, **fields):
        self.nodes[name] = Handle(removed=False, **fields)
        return self.nodes[name]

    def set_background_image(self, image, format, **_):
        self.backgrounds.append(image)

    def send_file_download(self, filename, content, **_):
        self.downloads[filename] = content

    def get_render(self, height, width, **_):
        picture = np.full((height, width, 4), 77, np.uint8)
        picture[..., 3] = 255
        picture[0] = 0  # a hole
        return picture
