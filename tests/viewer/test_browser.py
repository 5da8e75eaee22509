"""One browser: what it is sent for what a person chooses. Its client is a fake one."""

import contextlib
import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

import ssplat_jax as ss
from ssplat_jax.core.cameras import Camera
from ssplat_jax.core.gaussians import mean_color
from ssplat_jax.core.pytree import replace
from ssplat_jax.rasterizer import fill_holes
from ssplat_jax.storage.chunk_records import ChunkRecord, RecordedView, make_thumbnail, save_chunk_record, save_delta
from ssplat_jax.storage.run_folder import RunFolder
from ssplat_jax.viewer import view_scene as browser_module
from ssplat_jax.viewer.stage import Stage, draw, open_source, visible_splats
from ssplat_jax.viewer.view_scene import Browser, Viewer
from tests.rasterizer.scenes import balls
from tests.viewer.fake_client import FakeClient, delta, frame, free_port, header

pytestmark = pytest.mark.usefixtures("compiled_plainly")

SIZE = (48, 32)
FOCAL = 16 / np.tan(0.45)
K = np.array([[FOCAL, 0, 24], [0, FOCAL, 16], [0, 0, 1]])
LEVEL = 1 / 255


@pytest.fixture(autouse=True)
def small_pictures(monkeypatch):
    monkeypatch.setattr(browser_module, "DRAFT", (24, 16))
    monkeypatch.setattr(browser_module, "FINE", SIZE)


def pose(x=0.0, z=0.0):
    matrix = np.eye(4)
    matrix[:3, 3] = [x, 0.0, z]
    return matrix


def record(k):
    """The record of chunk k = 1, 2, ... of two views."""
    views = []
    for i in (2 * k - 2, 2 * k - 1):
        image = make_thumbnail(np.full((24, 32, 3), i / 20, np.float32))
        K = np.array([[32.0, 0, 16], [0, 32.0, 12], [0, 0, 1]])
        views.append(RecordedView(i, pose(float(i), -1.0), K, np.array([1.0, 1 + i, 0.5]), image))
    return ChunkRecord(2 * k, (32, 24), tuple(views), 0.5 / k, 0.1 * k, 100 * k)


class Run:
    """A run that grows by deltas and records, and a browser on it."""

    def __init__(self, path):
        self.folder, self.num_chunks = RunFolder(path), 0
        self.folder.deltas.mkdir(parents=True)
        self.stage = Stage(open_source(path), max_gaussians=1000)
        self.client = FakeClient(*SIZE)
        self.browser = Browser(self.client, self.stage)
        self.controls = self.client.controls

    def grow(self):
        self.num_chunks += 1
        rows = [0, 1] if self.num_chunks == 1 else [self.num_chunks]
        stream = dataclasses.replace(frame(), far=32.0)
        part = delta(rows, self.num_chunks)
        save_delta(self.folder.delta(2 * self.num_chunks), part, header(stream, [1.0, 2.0, 1.0]))
        save_chunk_record(self.folder.chunk_record(2 * self.num_chunks), record(self.num_chunks))
        self.update()

    def update(self):
        self.stage.refresh()
        self.browser.update()

    def choose(self, label, value):
        self.controls[label].value = value
        self.update()

    @property
    def splats(self):
        return self.client.nodes["/scene"]

    def sent(self):
        """The number of Gaussians that the browser has now."""
        return len(self.splats.centers)


@pytest.fixture
def run(tmp_path):
    pytest.importorskip("viser")
    return Run(tmp_path)


def test_a_browser_follows_the_run(run):
    run.update()
    assert not run.client.nodes
    run.grow()
    assert run.sent() == 4
    assert run.stage.distance == pytest.approx(2.0)  # sqrt(0.5 * 32) stream units
    gaussians, splats = run.stage.scene, run.splats
    means = np.asarray(gaussians.means)[np.asarray(gaussians.opacities) > 0]
    np.testing.assert_allclose(splats.centers * splats.scale * run.stage.distance, means, atol=1e-4)
    run.grow()
    run.grow()
    assert run.sent() == 8
    assert run.controls[""].content.startswith("**8** Gaussians from **6** views\n\nlast chunk 0.17 s, 30% of")
    updates = run.splats.num_updates
    run.update()
    assert run.splats.num_updates == updates  # nothing changed, nothing is sent
    wanted = visible_splats(run.stage.scene, run.stage.unit, 1000)
    np.testing.assert_array_equal(run.splats.centers, wanted["centers"])
    np.testing.assert_array_equal(run.splats.rgbs, wanted["rgbs"])


def test_cameras_stand_where_the_views_were_taken_and_a_click_goes_there(run):
    run.grow()
    run.grow()
    assert list(run.client.nodes) == ["/scene"]
    run.choose("Cameras", True)
    nodes = run.client.nodes
    assert set(nodes) == {"/scene", *(f"/cameras/{i}" for i in range(4))}
    third = nodes["/cameras/3"]
    np.testing.assert_allclose(third.position, np.array([3.0, 0.0, -1.0]) / run.stage.distance)
    assert third.fov == pytest.approx(2 * np.arctan(12 / 32)) and third.aspect == pytest.approx(4 / 3)
    assert abs(third.image.mean() / 255 - 3 / 20) < 0.01
    third.click()
    np.testing.assert_allclose(run.client.camera.position, third.position)
    run.choose("Cameras", False)
    assert all(nodes[f"/cameras/{i}"].removed for i in range(4))


def test_a_picture_is_drawn_coarsely_then_finely_and_only_when_something_changes(run):
    run.grow()
    run.controls["Show"].value = "depth"
    run.update()
    pictures = run.client.backgrounds
    assert pictures[-1].shape == (16, 24, 3) and not run.splats.visible
    run.update()
    assert pictures[-1].shape == (32, 48, 3)
    count = len(pictures)
    run.update()
    assert len(pictures) == count
    run.client.camera.position = np.array([0.1, 0.0, 0.0])
    run.update()
    assert pictures[-1].shape == (16, 24, 3) and len(pictures) == count + 1
    run.update()
    run.grow()
    assert pictures[-1].shape == (16, 24, 3) and len(pictures) == count + 3
    run.choose("Show", "splats")
    assert pictures[-1] is None and run.splats.visible and run.sent() == 6


def test_a_drawn_picture_is_that_of_the_rasterizer_however_it_is_stretched():
    colors, at = [[0.9, 0.2, 0.1], [0.1, 0.3, 0.9]], pose(0.1)
    viewed = balls([[-0.6, 0, 2], [0.6, 0, 2.1]], [0.6, 0.6, 0.01], 0.99, colors)  # flat, side by side
    viewmats, Ks = (jnp.asarray(x, jnp.float32) for x in (np.linalg.inv(at), K))
    out = ss.render(viewed, Camera(viewmats=viewmats, Ks=Ks, width=48, height=32))
    wanted = np.clip(fill_holes(out.color, out.alpha, mean_color(viewed)), 0, 1)
    found = draw(viewed, "color", at, K, SIZE)
    np.testing.assert_allclose(found / 255, wanted, atol=0.51 * LEVEL)
    assert found.min() > 0  # holes take the colors around them
    # A window of another shape shows the same view, stretched: its blocks of 4 x 8 are those of 8 x 8 before.
    narrow = draw(viewed, "color", at, np.diag([0.5, 1, 1]) @ K, (24, 32))
    blocks = [x.reshape(4, 8, 6, -1, 3).mean(axis=(1, 3)) / 255 for x in (found, narrow)]
    is_covered = np.asarray(out.alpha).reshape(4, 8, 6, 8).mean(axis=(1, 3)) > 0.8  # holes are filled by the pixel
    np.testing.assert_allclose(*(x[is_covered] for x in blocks), atol=0.05)
    assert is_covered.sum() > 5 and np.std(blocks[0][is_covered]) > 0.05


def test_depth_is_light_near_and_dark_far():
    viewed = balls([[-0.5, 0, 2], [0.5, 0, 4]], [0.25, 0.25, 0.01], 0.99)
    depth = draw(viewed, "depth", pose(), K, SIZE).astype(float)
    left, right = (slice(14, 18), slice(13, 17)), (slice(14, 18), slice(27, 30))
    assert depth[left].mean() > depth[right].mean() + 40 and (depth[:, 0] == 0).any()


def restarted(folder, stream, *, size=1.0):
    """Writes the first chunk of a run, in place of what the run wrote before."""
    for path in folder.deltas.glob("*"):
        path.unlink()
    part = delta([0, 1], 1)
    gaussians = replace(part.gaussians, scales=size * part.gaussians.scales)
    save_delta(folder.delta(2), dataclasses.replace(part, gaussians=gaussians), header(stream))


def test_a_run_of_other_poses_is_seen_from_its_own_start(tmp_path):
    pytest.importorskip("viser")
    folder, first = RunFolder(tmp_path), frame()
    restarted(folder, first)
    save_chunk_record(folder.chunk_record(2), record(1))
    stage, client = Stage(open_source(tmp_path), max_gaussians=1000), FakeClient()
    with contextlib.closing(Viewer(stage, host="127.0.0.1", port=free_port())) as viewer:
        viewer.welcome(client)  # before there is a scene
        stage.refresh()
        viewer.update()
        assert client.camera.fov == viewer._server.initial_camera.fov == pytest.approx(2 * np.arctan(24 / 2 / 32))
        node, start, units = client.nodes["/scene"], stage.start, (stage.unit, stage.distance)
        client.camera.position = np.array([9.0, 9.0, 9.0])
        restarted(folder, dataclasses.replace(first, far=9.0), size=0.5)  # the same place, a wider range
        assert stage.refresh() and stage.num_starts == 1
        viewer.update()
        assert client.nodes["/scene"] is node and not node.removed and node.num_updates == 1
        assert stage.start is start and (stage.unit, stage.distance) == units
        np.testing.assert_array_equal(client.camera.position, 9.0)
        restarted(folder, dataclasses.replace(first, origin=np.array([1.0, 2.0, 3.0]), far=32.0), size=0.5)
        assert stage.refresh() and stage.num_starts == 2
        viewer.update()
        sent = client.nodes["/scene"]
        assert node.removed and sent is not node
        assert stage.unit == pytest.approx(units[0] / 2) and stage.distance == pytest.approx(2 * units[1])
        assert sent.scale == pytest.approx(stage.unit / stage.distance) and sent.scale == pytest.approx(node.scale / 4)
        np.testing.assert_allclose(client.camera.position * stage.distance, [1.0, 2.0, 3.0])
