"""Made worlds: the depth of the renderer is the analytic distance."""

from pathlib import Path

import numpy as np
import pytest

from ssplat_jax.core.errors import InputError
from ssplat_jax.data.open_capture import open_capture
from ssplat_jax.data.worlds.gl_renderer import GlRenderer, open_context
from ssplat_jax.data.worlds.meshes import box, patch
from ssplat_jax.data.worlds.world_capture import write_worlds


def test_box_normals_point_outward():
    mesh = box([-1, -2, -3], [1, 2, 3])
    assert ((mesh.points * mesh.normals).sum(1) >= 1 - 1e-9).all()


@pytest.fixture
def context():
    try:
        return open_context()
    except InputError as error:
        pytest.skip(f"the OpenGL driver or moderngl is missing: {error}")


def test_depth_is_the_distance_to_a_slanted_plane(context):
    plane = patch([-50, -50, -30], [100, 0, 40], [0, 100, 0])  # z = 0.4 x - 10
    textures = np.full((1, 4, 4, 3), 128, np.uint8)
    _, depth = GlRenderer(context, [plane], [np.ones_like(plane.points)], textures, (32, 24)).render(np.eye(4), 40.0)
    x = (np.arange(32) + 0.5 - 16) / 40.0  # a ray reaches (x z, ., -z) with -z = 0.4 x z - 10
    np.testing.assert_allclose(depth, np.broadcast_to(10 / (1 + 0.4 * x), (24, 32)), rtol=1e-3)


def contents(folder: Path) -> dict[str, bytes]:
    return {str(file.relative_to(folder)): file.read_bytes() for file in sorted(folder.rglob("*")) if file.is_file()}


def test_a_world_is_the_same_bytes_and_a_stop_loses_none(context, tmp_path):
    whole, stopped = tmp_path / "whole", tmp_path / "stopped"
    assert write_worlds(whole, 2, seed=3, size=(48, 36), frames=2) == 2

    def stop(done, note=""):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_worlds(stopped, 2, seed=3, size=(48, 36), frames=2, advance=stop)
    (stopped / "world_00001.partial").mkdir()  # as a kill leaves it
    assert write_worlds(stopped, 2, seed=3, size=(48, 36), frames=2) == 1  # the first world is kept
    assert contents(stopped) == contents(whole)
    with pytest.raises(InputError, match="repeat those options"):
        write_worlds(whole, 2, seed=4, size=(48, 36), frames=2)
    (whole / "worlds.json").write_text("{")
    with pytest.raises(InputError, match="wanted JSON"):
        write_worlds(whole, 2, seed=3, size=(48, 36), frames=2)

    capture = open_capture(stopped / "world_00001")
    assert len(capture) == 2 and (capture.width, capture.height) == (48, 36)
    depth = capture.depth(0)
    assert depth is not None and 0.1 < np.median(depth[depth > 0]) < 60
