"""`Browser`: one client of the viewer, which looks at the stage with a camera and a panel of its own."""

from typing import Any

import numpy as np
from jaxtyping import Float64, UInt8
from scipy.spatial.transform import Rotation

from ssplat_jax.core.gaussians import Gaussians
from ssplat_jax.core.numerics import evenly_spread
from ssplat_jax.data.posed_image import pose_from_quat
from ssplat_jax.storage.chunk_records import RecordedView, open_thumbnail
from ssplat_jax.viewer.stage import DRAFT, FINE, KINDS, Stage, draw

SPLATS = "splats"
"""The choice of what to show that the browser draws itself."""

FRUSTUM_DEPTH = 0.06  # in the browser's units
MOST_FRUSTA = 300  # of more views, evenly spread ones are shown


class Browser:
    """One client.

    Args:
        client: viser's handle of it.
        stage: the scene.
    """

    def __init__(self, client: Any, stage: Stage) -> None:
        self._client, self._stage = client, stage
        gui = client.gui
        gui.set_panel_label("ssplat")
        self._facts = gui.add_markdown("")
        hint = "All but splats are drawn by ssplat's rasterizer at this window's camera."
        self._kind = gui.add_dropdown("Show", (SPLATS, *KINDS), initial_value=SPLATS, hint=hint)
        hint = "Streamed cameras with their images; click on one to go there."
        self._cameras = gui.add_checkbox("Cameras", initial_value=False, hint=hint)
        self._node: Any = None  # the splats
        self._frusta: dict[int, Any] = {}  # by frame
        self._shown: tuple = ()  # version of the scene, and whether the browser draws it
        self._noted: tuple = ()  # what cameras and facts were last updated for
        self._scene: Gaussians | None = None
        self._drawn: tuple = ()  # what was shown, kind and camera of the picture
        self._is_fine = False

    def update(self) -> None:
        """Brings the browser up to date; called many times a second."""
        self._update_scene()
        self._update_notes()
        if self._kind.value != SPLATS and self._scene is not None:
            self._update_drawing(self._scene)

    def _update_scene(self) -> None:
        """Sends the scene if it has changed, or is wanted in another way."""
        is_drawn = self._kind.value != SPLATS
        wanted = (self._stage.version, is_drawn)
        if wanted == self._shown:
            return
        self._shown, self._scene = wanted, self._stage.scene
        if self._scene is None:
            return
        if not is_drawn:
            self._client.scene.set_background_image(None, format="png")
            self._drawn = ()
            self._send_splats(self._scene)
        if self._node is not None:
            self._node.visible = not is_drawn

    def _send_splats(self, scene: Gaussians) -> None:
        splats = self._stage.splats(scene)
        if len(splats["centers"]) == 0:  # viser has no splats without Gaussians
            self._remove_splats()
        elif self._node is None:
            scale = self._stage.unit / self._stage.distance
            self._node = self._client.scene.add_gaussian_splats("/scene", **splats, scale=scale)
        else:
            self._node.set_gaussians(**splats)

    def _remove_splats(self) -> None:
        if self._node is not None:
            self._node.remove()
        self._node = None

    def _update_notes(self) -> None:
        """Brings streamed cameras and facts up to date."""
        run, shows_cameras = self._stage.run, self._cameras.value
        noted = (self._stage.records_version, self._stage.version, shows_cameras)
        if noted == self._noted:
            return
        self._noted = noted
        records, views = run.records, run.views()
        if self._scene is not None:
            num_shown = int((np.asarray(self._scene.opacities) > 0).sum())
            facts = f"**{num_shown:,}** Gaussians"
            if records:
                facts += f" from **{len(views)}** views"
                facts += f"\n\nlast chunk {records[-1].seconds:.2f} s, {records[-1].occupancy:.0%} of the cache in use"
            self._facts.content = facts
        self._show_frusta(views if shows_cameras else [])

    def _show_frusta(self, views: list[RecordedView]) -> None:
        """Shows these cameras, and no others."""
        views = [views[place] for place in evenly_spread(len(views), MOST_FRUSTA)]
        for frame in self._frusta.keys() - {view.frame for view in views}:
            self._frusta.pop(frame).remove()
        for view in views:
            if view.frame not in self._frusta:
                self._frusta[view.frame] = self._add_frustum(view)

    def _add_frustum(self, view: RecordedView) -> Any:
        (width, height), pose = self._stage.run.records[0].size, self._stage.to_browser(view.camtoworld)
        node = self._client.scene.add_camera_frustum(
            f"/cameras/{view.frame}",
            fov=float(2 * np.arctan(height / 2 / view.K[1, 1])),
            aspect=width / height,
            scale=FRUSTUM_DEPTH,
            color=(70, 110, 165),
            thickness=1.5,
            thickness_units="screen",
            image=open_thumbnail(view.thumbnail),
            wxyz=_wxyz(pose),
            position=pose[:3, 3],
        )
        node.on_click(lambda _: self._go_to(pose))
        return node

    # -- pictures by our rasterizer -----------------------------------------------------------------------------------

    def _update_drawing(self, scene: Gaussians) -> None:
        """Draws the scene at the browser's camera: coarsely while it moves, finely once it rests."""
        camera, kind = self._client.camera, self._kind.value
        looks = (*camera.wxyz, *camera.position, camera.fov, camera.image_width, camera.image_height)
        is_known = self._drawn == (wanted := (self._shown, kind, looks))
        if is_known and self._is_fine:
            return
        picture = self._draw(scene, kind, FINE if is_known else DRAFT)
        self._client.scene.set_background_image(picture, format="jpeg", jpeg_quality=92)
        self._drawn, self._is_fine = wanted, is_known

    def _draw(self, scene: Gaussians, kind: str, size: tuple[int, int]) -> UInt8[np.ndarray, "h w 3"]:
        """A picture at the browser's camera, of a size (width, height) that is stretched over its window."""
        camera, (width, height), stage = self._client.camera, size, self._stage
        fy = height / 2 / np.tan(camera.fov / 2)
        fx = fy * width / height * max(camera.image_height, 1) / max(camera.image_width, 1)
        K = np.array([[fx, 0.0, width / 2], [0.0, fy, height / 2], [0.0, 0.0, 1.0]])
        pose = pose_from_quat(camera.wxyz, np.asarray(camera.position) * stage.distance, "browser")
        return draw(scene, kind, pose, K, size)

    # -- camera -------------------------------------------------------------------------------------------------------

    def start_at(self, pose: Float64[np.ndarray, "4 4"], fov: float | None) -> None:
        """Moves the camera to where the stage starts, at distance 1 from what it looks at.

        Without an angle of view it keeps its own. The stage may have other units than before, so splats and cameras are
        sent anew.
        """
        self._show_frusta([])
        self._remove_splats()
        self._shown, self._noted = (), ()
        camera = self._client.camera
        with self._client.atomic():
            if fov is not None:
                camera.fov = fov
            camera.up_direction, camera.position = -pose[:3, 1], pose[:3, 3]
            camera.look_at = pose[:3, 3] + pose[:3, 2]

    def _go_to(self, pose: Float64[np.ndarray, "4 4"]) -> None:
        with self._client.atomic():
            self._client.camera.position, self._client.camera.wxyz = pose[:3, 3], _wxyz(pose)


def _wxyz(pose: Float64[np.ndarray, "4 4"]) -> Float64[np.ndarray, "4"]:
    """The quaternion of a pose."""
    return Rotation.from_matrix(pose[:3, :3]).as_quat()[[3, 0, 1, 2]]
