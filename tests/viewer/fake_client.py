"""A client of viser without a browser: it keeps what it is sent."""

import contextlib
from types import SimpleNamespace

import numpy as np


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

    def __enter__(self):
        return self

    def __exit__(self, *_):
        pass


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

    def add_folder(self, label, *, visible):
        return self._add(label, visible=visible)

    def add_uplot(self, *, data, title, **_):
        return self._add(title, data=data)


class Scene:
    """The nodes by name, and the pictures behind them."""

    def __init__(self):
        self.nodes, self.backgrounds = {}, []

    def add_gaussian_splats(self, name, **fields):
        self.nodes[name] = Handle(**fields)
        return self.nodes[name]

    def add_camera_frustum(self, name, **fields):
        self.nodes[name] = Handle(removed=False, **fields)
        return self.nodes[name]

    def set_background_image(self, image, format, **_):
        self.backgrounds.append(image)


class FakeClient:
    """The client: panel, scene, camera and downloads."""

    def __init__(self, width=48, height=32):
        self.client_id, self.gui, self.scene, self.downloads = 0, Gui(), Scene(), {}
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

    def send_file_download(self, filename, content, **_):
        self.downloads[filename] = content

    def get_render(self, height, width, **_):
        picture = np.full((height, width, 4), 77, np.uint8)
        picture[..., 3] = 255
        picture[0] = 0  # a hole
        return picture
