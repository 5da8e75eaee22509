"""`ssplat view` and `ssplat run --view`: a server of viser (extra `viewer`), its browsers, and their loop.

Beside a run the viewer is a process of its own that reads the files of the run, as `ssplat view` does, so that the run
never waits for it. It draws on the CPU where the run has a GPU, and ends with the run's process.
"""

import contextlib
import io
import multiprocessing
import os
import signal
import socket
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64, UInt8
from scipy.spatial.transform import Rotation

from ssplat_jax.core.console import Reporter
from ssplat_jax.core.errors import InputError, StorageError, optional_package
from ssplat_jax.core.gaussians import Gaussians
from ssplat_jax.core.numerics import evenly_spread
from ssplat_jax.data.posed_image import pose_from_quat
from ssplat_jax.storage.chunk_records import RecordedView, open_thumbnail
from ssplat_jax.storage.run_folder import Interrupts, RunFolder
from ssplat_jax.viewer.stage import DRAFT, FINE, KINDS, GrowingScene, Source, Stage, draw

POLL_INTERVAL = 0.5  # seconds between checks for changes, so that browsers are sent at most two scenes a second
TICK = 1 / 30  # seconds between updates of the browsers
LOCAL_HOSTS = ("127.0.0.1", "localhost", "::1")  # addresses that only this machine can reach
MOST_BESIDE_RUN = 500_000  # Gaussians sent to a browser
LOWER_PRIORITY = 19  # `os.nice` of the viewer process (19 = lowest priority)
SPLATS = "splats"  # the choice of what to show that the browser draws itself
FRUSTUM_DEPTH = 0.06  # in the browser's units
MOST_FRUSTA = 300  # of more views, evenly spread ones are shown


class Browser:
    """One client of the viewer, which looks at the stage with a camera and a panel of its own.

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
        wxyz, position = Rotation.from_matrix(pose[:3, :3]).as_quat(scalar_first=True), pose[:3, 3]
        node = self._client.scene.add_camera_frustum(
            f"/cameras/{view.frame}",
            fov=float(2 * np.arctan(height / 2 / view.K[1, 1])),
            aspect=width / height,
            scale=FRUSTUM_DEPTH,
            color=(70, 110, 165),
            thickness=1.5,
            thickness_units="screen",
            image=open_thumbnail(view.thumbnail),
            wxyz=wxyz,
            position=position,
        )
        node.on_click(lambda _: self._go_to(position, wxyz))
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

    def _go_to(self, position: Float64[np.ndarray, "3"], wxyz: Float64[np.ndarray, "4"]) -> None:
        with self._client.atomic():
            self._client.camera.position, self._client.camera.wxyz = position, wxyz


class Viewer:
    """A server that shows a stage to browsers.

    Args:
        stage: the scene, refreshed already.
        host: address to listen on; a loopback address is reached by this machine only.
        port: port to listen on; the next free one if it is taken.

    Raises:
        InputError: viser is not installed, or cannot listen there.
    """

    def __init__(self, stage: Stage, *, host: str, port: int) -> None:
        viser = import_viser(host, port)
        self._stage, self.browsers = stage, {}  # by the clients' numbers
        with contextlib.redirect_stdout(io.StringIO()):  # viser's banner; `view_scene` says the address
            self._server: Any = viser.ViserServer(host=host, port=port, label="ssplat", verbose=False)
        self._server.gui.configure_theme(show_logo=False, show_share_button=False, control_width="medium")
        self._num_starts = 0  # start poses of the stage that were set
        self._server.on_client_connect(self.welcome)
        self._server.on_client_disconnect(lambda client: self.browsers.pop(client.client_id, None))
        name = "localhost" if host in (*LOCAL_HOSTS, "0.0.0.0", "::") else f"[{host}]" if ":" in host else host
        self.url = f"http://{name}:{self._server.get_port()}"
        self._set_start()

    def welcome(self, client: Any) -> None:
        """Takes a client in, whenever it comes; the next update sends it all that there is."""
        self.browsers[client.client_id] = Browser(client, self._stage)

    def _set_start(self) -> None:
        """Sets the pose with which browsers start, whenever the stage has a new one, and moves all browsers to it."""
        stage, server = self._stage, self._server
        if self._num_starts == stage.num_starts or stage.start is None:
            return
        self._num_starts, pose, fov = stage.num_starts, stage.start.copy(), stage.run.fov
        pose[:3, 3] /= stage.distance
        server.scene.set_up_direction(-pose[:3, 1])
        server.initial_camera.position, server.initial_camera.look_at = pose[:3, 3], pose[:3, 3] + pose[:3, 2]
        if fov is not None:
            server.initial_camera.fov = fov
        for browser in list(self.browsers.values()):
            browser.start_at(pose, fov)

    def update(self) -> None:
        """Brings every browser up to date with the stage; called many times a second."""
        self._set_start()
        for browser in list(self.browsers.values()):
            browser.update()

    def close(self) -> None:
        """Stops the server."""
        with contextlib.redirect_stdout(io.StringIO()):
            self._server.stop()


def import_viser(host: str, port: int) -> Any:
    """The package viser, about to listen at an address; at one of another machine it would wait forever.

    Raises:
        InputError: it is not installed, the address is another one, or the port is out of range.
    """
    viser = optional_package("viser", "viewer")
    try:
        if not 0 < port < 1 << 16:
            raise OSError("ports are 1 to 65535")
        family, kind, protocol, _, address = socket.getaddrinfo(host, 0, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind, protocol) as probe:
            probe.bind(address)
    except (OSError, UnicodeError) as error:
        raise InputError(f"view: cannot listen on {host}:{port} ({error}); choose another.") from error
    return viser


def view_scene(
    source: Source,
    *,
    host: str,
    port: int,
    max_gaussians: int,
    is_wanted: Callable[[], bool] = lambda: True,
    reporter: Reporter,
) -> int:
    """Shows a source and its changes until Ctrl-C.

    Args:
        source: where scenes come from; there need not be one yet.
        host: address to listen on.
        port: port to listen on; the next free one if it is taken.
        max_gaussians: most Gaussians sent to a browser.
        is_wanted: asked many times a second; the viewer ends when it says no.
        reporter: prints warnings.

    Returns:
        The signal that ended it; 0 if `is_wanted` did.

    Raises:
        InputError: the source or the address cannot be used, or viser is missing.
        StorageError: a file of the run is damaged.
    """
    stage = Stage(source, max_gaussians=max_gaussians)
    stage.refresh()
    viewer = Viewer(stage, host=host, port=port)
    try:
        if host not in LOCAL_HOSTS:
            reporter.warn(f"everyone who reaches this machine at {host} can view the scene; there is no password.")
        print(f"{viewer.url} shows {source.path}; Ctrl-C ends it", flush=True)
        polled = time.monotonic()
        with Interrupts() as interrupts:
            while not interrupts.received and is_wanted():
                viewer.update()
                time.sleep(TICK)
                if time.monotonic() - polled > POLL_INTERVAL:
                    polled = time.monotonic()
                    stage.refresh()
            return interrupts.received or 0
    finally:
        viewer.close()


@contextlib.contextmanager
def viewer_beside(folder: Path, port: int) -> Iterator[Callable[[], int]]:
    """Opens a viewer of a run that is about to write its deltas to `folder`, and closes it afterwards.

    Gives a function that waits until a signal comes or the viewer ends, and returns the signal, or 0.

    Args:
        folder: the folder of the run.
        port: the port to listen on; the next free one if it is taken.

    Raises:
        InputError: viser is not installed, or cannot listen there.
    """
    import_viser(LOCAL_HOSTS[0], port)
    context = multiprocessing.get_context("spawn")  # a fork would share JAX's threads and locks
    process = context.Process(target=_view_beside, args=(folder, port), daemon=True)
    process.start()

    def wait() -> int:
        with Interrupts() as interrupts:
            while process.is_alive() and not interrupts.received:
                process.join(0.2)
            return interrupts.received or 0

    try:
        yield wait
    finally:
        process.terminate()
        process.join()


def _view_beside(folder: Path, port: int) -> None:
    """The process beside a run: shows it until it is terminated or the run's process is gone."""
    import jax

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the run's process decides what Ctrl-C ends
    jax.config.update("jax_platforms", "cpu")
    with contextlib.suppress(OSError):
        os.nice(LOWER_PRIORITY)
    parent = multiprocessing.parent_process()
    try:
        view_scene(
            GrowingScene(RunFolder(folder)),
            host=LOCAL_HOSTS[0],
            port=port,
            max_gaussians=MOST_BESIDE_RUN,
            is_wanted=lambda: parent is None or parent.is_alive(),
            reporter=Reporter(quiet=True),
        )
    except (InputError, StorageError) as error:
        print(f"ssplat: the viewer has ended, the run goes on: {error}", file=sys.stderr)
