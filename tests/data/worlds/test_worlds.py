"""Made worlds: the depth of the renderer is the analytic distance."""

import numpy as np
import pytest

from ssplat_jax.data.worlds.gl_renderer import GlRenderer, open_context
from ssplat_jax.data.worlds.meshes import box, patch
from ssplat_jax.errors import InputError


def test_box_normals_point_outward():
    mesh = box([-1, -2, -3], [1, 2, 3])
    assert ((mesh.points * mesh.normals).sum(1) >= 1 - 1e-9).all()


def test_depth_is_the_distance_to_a_slanted_plane():
    try:
        context = open_context()
    except InputError as error:
        pytest.skip(f"the OpenGL driver or moderngl is missing: {error}")
    plane = patch([-50, -50, -30], [100, 0, 40], [0, 100, 0])  # z = 0.4 x - 10
    textures = np.full((1, 4, 4, 3), 128, np.uint8)
    _, depth = GlRenderer(context, [plane], [np.ones_like(plane.points)], textures, (32, 24)).render(np.eye(4), 40.0)
    x = (np.arange(32) + 0.5 - 16) / 40.0  # a ray reaches (x z, ., -z) with -z = 0.4 x z - 10
    np.testing.assert_allclose(depth, np.broadcast_to(10 / (1 + 0.4 * x), (24, 32)), rtol=1e-3)
