"""The image baselines against geometry that is known."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from ssplat_experiments.baselines import baseline_scores, warp
from ssplat_experiments.context_length import until_full

from ssplat_jax.config import preset
from ssplat_jax.core.cameras import Camera
from ssplat_jax.data.capture import ArrayPixels
from ssplat_jax.data.open_capture import open_capture
from tests.model.small import side_by_side

K = np.array([[32.0, 0.0, 16.0], [0.0, 32.0, 12.0], [0.0, 0.0, 1.0]], np.float32)


def camera(x=0.0):
    """A camera that stands at x and looks along +z."""
    return Camera(viewmats=jnp.asarray(side_by_side([x])[0], jnp.float32), Ks=jnp.asarray(K), width=32, height=24)


def test_a_wall_is_warped_by_its_disparity():
    """At depth 2, a step of 0.25 moves a wall by 32 * 0.25 / 2 = 4 pixels."""
    image = np.random.default_rng(0).uniform(0.1, 1.0, (24, 32, 3)).astype(np.float32)
    depth = np.full((24, 32), 2.0, np.float32)
    depth[5:9, 11:15] = 0.0  # pixels without depth, of the view that is moved to, stay black
    warped, known = warp(image, camera(), camera(0.25), depth)
    np.testing.assert_array_equal(known, (depth > 0) & (np.arange(32) < 28))
    np.testing.assert_allclose(warped[known], np.pad(image[:, 4:], ((0, 0), (0, 4), (0, 0)))[known], atol=1e-5)
    assert not warped[~known].any()


def test_baselines_do_not_see_the_target():
    """A target of other pixels has the same baseline images: errors against it follow from those alone."""
    room = open_capture("procedural:room?frames=10", size=(32, 24))
    frame = room.stream_frame(preset("tiny"), range(5))
    depth = np.full((24, 32), 2.0, np.float32)
    context, i = (0, 1, 2, 3, 4), 6
    assert isinstance(room.pixels, ArrayPixels)
    pixels = room.pixels.images * (np.arange(10) != i)[:, None, None, None]
    black = dataclasses.replace(room, pixels=dataclasses.replace(room.pixels, images=pixels))
    seen, unseen = (baseline_scores(c, i, context, frame, depth, {})["mean color"]["literal"] for c in (room, black))
    mean = np.mean([room.image(j).mean(axis=(0, 1)) for j in context], axis=0)
    expected = -10 * np.log10(np.mean(mean**2))  # of the mean color against black
    assert abs(unseen.psnr - expected) < 1e-3 and seen.psnr != unseen.psnr


def test_the_first_number_of_views_without_memory_is_a_row_and_nothing_larger_is_tried():
    def rows(error, tried):
        for count in (2, 4, 8):
            tried.append(count)
            if count == 4:
                raise RuntimeError(error)
            yield [{"literal_psnr": 9.0}]

    found = until_full(rows("RESOURCE_EXHAUSTED: 9 GiB", tried := []), (2, 4, 8), {"suite": "room"})
    fits, full = {"views": 2, "literal_psnr": 9.0}, {"views": 4, "peak_memory_bytes": "OOM"}
    assert found == [{"suite": "room", **row} for row in (fits, full)] and tried == [2, 4]
    with pytest.raises(RuntimeError, match="INTERNAL"):
        until_full(rows("INTERNAL", []), (2, 4, 8), {})
