"""`Browser`: one client of the viewer, which looks at the stage with a camera, a panel and a time of its own."""

import dataclasses
import io
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from ssplat_jax.scene_files.formats import save_gaussians
from ssplat_jax.viewer.browser_camera import BrowserCamera, camera_of, set_camera
from ssplat_jax.viewer.drawn_view import DRAFT, FINE, draw
from ssplat_jax.viewer.figure_plots import FigurePlots
from ssplat_jax.viewer.frusta import Frusta
from ssplat_jax.viewer.panel import SPLATS, Panel
from ssplat_jax.viewer.playback import Orbit, PathPlayback
from ssplat_jax.viewer.stage import Stage
from ssplat_jax.viewer.viewed_scene import ViewedScene

RENDER_SECONDS = 30.0
"""Time that a browser has for a screenshot."""


class Browser:
    """One client.

    Args:
        client: viser's handle of it.
        stage: the scene.
    """

    def __init__(self, client: Any, stage: Stage) -> None:
        self._client, self._stage, self.panel = client, stage, Panel(client)
        self._frusta, self._plots = Frusta(client, self._go_to), FigurePlots(client, self.panel.figures)
        self._node: Any = None  # the splats
        self._playback: tuple[Orbit | PathPlayback, float] | None = None  # and the time of its start
        self._shown: tuple = ()  # version and chunk of the scene, and whether the browser draws it
        self._noted: tuple = ()  # what frusta and plots were last updated for
        self._scene: ViewedScene | None = None
        self._drawn: tuple[ViewedScene, str, BrowserCamera] | None = None
        self._is_fine = False
        self.panel.play.on_click(lambda event: self._play(event.target.value))
        self.panel.screenshot.on_click(lambda _: self._send_screenshot())
        self.panel.download.on_click(lambda _: self._send_scene())

    def update(self) -> None:
        """Brings the browser up to date; called many times a second."""
        self.panel.grow(self._stage.num_chunks)
        self._update_scene()
        self._update_notes()
        if self._playback is not None:
            motion, since = self._playback
            set_camera(self._client, motion.pose(time.monotonic() - since))
        if self.panel.kind != SPLATS and self._scene is not None:
            self._update_drawing(self._scene)

    def _update_scene(self) -> None:
        """Sends the scene if another one is wanted, or it is wanted in another way."""
        num_chunks, is_drawn = self.panel.num_chunks, self.panel.kind != SPLATS
        wanted = (self._stage.version, num_chunks, is_drawn)
        if wanted == self._shown:
            return
        if wanted[:2] != self._shown[:2]:
            self._scene = self._stage.scene(num_chunks)
        self._shown = wanted
        if self._scene is None:
            return
        if not is_drawn:
            self._show_background()
            self._send_splats(self._scene)
        if self._node is not None:
            self._node.visible = not is_drawn

    def _send_splats(self, scene: ViewedScene) -> None:
        splats = self._stage.splats(scene)
        fields = {field.name: getattr(splats, field.name) for field in dataclasses.fields(splats)}
        if len(splats.centers) == 0:
            if self._node is not None:
                self._node.remove()
                self._node = None
            return
        if self._node is None:
            scale = self._stage.unit / self._stage.distance
            self._node = self._client.scene.add_gaussian_splats("/scene", **fields, scale=scale)
        else:
            self._node.set_gaussians(**fields)

    def _show_background(self) -> None:
        """Sets the background behind the splats: black, or the browser's own."""
        black = np.zeros((1, 1, 3), np.uint8)
        self._client.scene.set_background_image(black if self._stage.over_black else None, format="png")
        self._drawn = None

    def _update_notes(self) -> None:
        """Brings frusta, plots and the line of facts up to date."""
        run, num_chunks = self._stage.run, self.panel.num_chunks
        noted = (self._stage.records_version, self._stage.version, num_chunks, self.panel.shows_cameras)
        if noted == self._noted:
            return
        self._noted = noted
        views = run.views(num_chunks)
        if self._scene is not None:
            num_shown = int((np.asarray(self._scene.gaussians.opacities) > 0).sum())
            self.panel.tell(f"**{num_shown:,}** Gaussians" + (f" from **{len(views)}** views" if views else ""))
        posed = [(view, self._stage.to_browser(view.camtoworld)) for view in views if self.panel.shows_cameras]
        self._frusta.show(posed, run.records[0].size if run.records else (1, 1))
        self.panel.figures.visible = len(run.records) > 1
        self._plots.show(run)

    def _update_drawing(self, scene: ViewedScene) -> None:
        """Draws the scene at the browser's camera: coarsely while it moves, finely once it rests."""
        camera, kind = camera_of(self._client), self.panel.kind
        is_known = self._drawn is not None and self._drawn[:2] == (scene, kind) and self._drawn[2].is_same(camera)
        if is_known and self._is_fine:
            return
        self._is_fine = is_known
        picture = self._draw(scene, kind, camera, FINE if is_known else DRAFT)
        self._client.scene.set_background_image(picture, format="jpeg", jpeg_quality=92)
        self._drawn = (scene, kind, camera)

    def _draw(self, scene: ViewedScene, kind: str, camera: BrowserCamera, size: tuple[int, int]) -> np.ndarray:
        """A picture of a scene at a camera of the browser."""
        placed = dataclasses.replace(camera, camtoworld=self._stage.to_scene(camera.camtoworld))
        exposure = None
        if kind == "exposure" and (view := self._stage.run.nearest(self._stage.to_capture(camera.camtoworld))):
            exposure = view.exposure
        return draw(scene, kind, placed, size, over_black=self._stage.over_black, exposure=exposure)

    def start_at(self, position: np.ndarray, target: np.ndarray, up: np.ndarray, fov: float | None) -> None:
        """Moves the camera to where the stage starts; without an angle of view it keeps its own.

        The stage may have other units than before, so splats and cameras are sent anew and motions end.
        """
        self._playback = None
        self._frusta.show([], (1, 1))
        if self._node is not None:
            self._node.remove()
        self._node, self._shown, self._noted = None, (), ()
        with self._client.atomic():
            if fov is not None:
                self._client.camera.fov = fov
            self._client.camera.up_direction = up
            self._client.camera.position = position
            self._client.camera.look_at = target

    def _go_to(self, pose: np.ndarray) -> None:
        """Takes the camera to a pose."""
        self._playback = None
        set_camera(self._client, pose)

    def _play(self, choice: str) -> None:
        """Starts or stops a motion of the camera."""
        if choice == "orbit":
            camera = self._client.camera
            motion = Orbit(*(np.array(x) for x in (camera.position, camera.look_at, camera.up_direction)))
            self._playback = (motion, time.monotonic())
        elif choice == "path" and len(poses := self._stage.run.path()):
            motion = PathPlayback(np.stack([self._stage.to_browser(pose) for pose in poses]))
            self._playback = (motion, time.monotonic())
        else:
            self._playback = None

    def _send_screenshot(self) -> None:
        """Downloads the window's picture as PNG: the browser's own, or that of the rasterizer."""
        camera, scene, kind = self._client.camera, self._scene, self.panel.kind
        size = (int(camera.image_width), int(camera.image_height))
        if kind == SPLATS or scene is None:
            pixels = self._client.get_render(size[1], size[0], transport_format="png", timeout=RENDER_SECONDS)
            paper = Image.new("RGBA", size, "black" if self._stage.over_black else "white")
            picture = Image.alpha_composite(paper, Image.fromarray(pixels).convert("RGBA"))  # holes are transparent
        else:
            picture = Image.fromarray(self._draw(scene, kind, camera_of(self._client), FINE))
        encoded = io.BytesIO()
        picture.convert("RGB").resize(size, Image.Resampling.LANCZOS).save(encoded, "PNG")
        self._client.send_file_download(f"ssplat_{kind}.png", encoded.getvalue(), save_immediately=True)

    def _send_scene(self) -> None:
        """Downloads the scene that is shown as .ply, in the capture's frame."""
        if (scene := self._scene) is None:
            return
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "scene.ply"
            save_gaussians(file, scene.gaussians, render_mode=scene.render_mode, offset=scene.offset)
            self._client.send_file_download(file.name, file.read_bytes(), save_immediately=True)
