"""SH bands that refinement adds: a scene keeps its image until a step moves them, and learns colors that turn."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from ssplat_jax.config import StreamConfig
from ssplat_jax.core.errors import InputError
from ssplat_jax.core.gaussians import Gaussians, with_sh_degree
from ssplat_jax.core.pytree import replace
from ssplat_jax.data.open_capture import open_capture
from ssplat_jax.evaluation.psnr_ssim import psnr
from ssplat_jax.rasterizer import render
from ssplat_jax.refinement import RefineConfig, current_gaussians, init_refinement, refine, refine_on_capture
from ssplat_jax.refinement import present_rows as rows
from ssplat_jax.refinement.refine_config import FOR_CAPTURES
from tests.refinement.test_refine import (
    CONFIG,
    NUM,
    assert_same_bits,
    cameras,
    key_views,
    photographs,
    scene,
    step,
)

LINEAR = dataclasses.replace(CONFIG, sh_degree=1, sh_rate=0.5)


def turning() -> Gaussians:
    """The true scene with colors that change by 0.3 or so from one side to the other."""
    bands = np.random.default_rng(2).normal(0, 0.4, (NUM, 3, 3))
    return replace(scene(), sh=jnp.concatenate([scene().sh, jnp.asarray(bands, jnp.float32)], axis=1))


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_added_bands_are_zero_and_change_no_image(degree):
    padded = with_sh_degree(scene(), degree)
    assert padded.sh_degree == degree and not np.asarray(padded.sh[:, 1:]).any()
    before, after = (np.asarray(render(g, cameras(), max_pairs=1 << 12).color) for g in (scene(), padded))
    np.testing.assert_allclose(after, before, atol=1e-6)
    np.testing.assert_array_equal(with_sh_degree(turning(), degree).sh[:, :4], turning().sh)  # higher ones stay
    assert with_sh_degree(turning(), degree).sh_degree == max(degree, 1)


def test_no_band_is_added_by_default():
    assert init_refinement(scene()).start.sh_degree == 0 and RefineConfig().sh_degree == 0
    state = init_refinement(scene(), config=LINEAR)
    assert state.start.sh_degree == 1
    assert {leaf.shape for leaf in (state.revision.sh, state.first_moment.sh, state.second_moment.sh)} == {(NUM, 4, 3)}


def test_a_higher_band_moves_by_its_own_rate():
    """Adam's first step is the rate, whatever the gradient."""
    state, _ = step(init_refinement(scene(), config=LINEAR), key_views(1.0 - photographs()), config=LINEAR)
    moved = np.abs(np.asarray(state.revision.sh))
    constant, linear = moved[:, 0].max(), moved[:, 1:].max()
    assert linear == pytest.approx(0.5 * constant, rel=1e-3) and constant > 0


def test_colors_that_turn_are_learned_with_bands_alone():
    """On a view never shown; a constant color cannot follow."""
    seen, unseen = cameras(shifts=(-1.0, -0.6, -0.2, 0.2, 0.6, 1.0)), cameras(shifts=(0.4,))
    images, truth = (np.asarray(render(turning(), c, max_pairs=1 << 12).color) for c in (seen, unseen))
    fixed = dataclasses.replace(CONFIG, mean_rate=0.0, log_scale_rate=0.0, quat_rate=0.0, logit_opacity_rate=0.0)
    scores = {}
    for degree in (0, 1):
        config = dataclasses.replace(fixed, sh_degree=degree, sh_rate=0.5)
        refined, _ = refine(scene(), seen, jnp.asarray(images), steps=80, config=config)
        scores[degree] = psnr(np.clip(np.asarray(render(refined, unseen).color)[0], 0, 1), np.clip(truth[0], 0, 1))
    assert scores[1] > scores[0] + 3.0


def test_rows_come_back_to_their_places_with_their_bands(monkeypatch):
    monkeypatch.setattr(rows, "MIN_ROWS", 1)
    refined, _ = refine(scene(), cameras(), 1.0 - photographs(), steps=3, config=LINEAR)
    absent = np.asarray(scene().opacities) == 0
    assert rows.present_rows(scene()) is not None and refined.sh_degree == 1
    np.testing.assert_array_equal(refined.sh[absent], with_sh_degree(scene(), 1).sh[absent])
    assert np.asarray(refined.sh[~absent, 1:]).any()


def test_a_rate_of_zero_changes_no_bit_of_the_given_bands():
    state, _ = step(init_refinement(turning(), config=LINEAR), key_views(), rate=0.0, config=LINEAR)
    np.testing.assert_array_equal(current_gaussians(state).sh, turning().sh)


@pytest.mark.slow
def test_scenes_of_captures_get_bands():
    capture = open_capture("procedural:room?frames=4", size=(24, 16))
    frame = capture.stream_frame(StreamConfig())
    exposures = {i: np.ones(3, np.float32) for i in range(4)}
    found = refine_on_capture(scene(), capture, range(4), frame, exposures, steps=1)
    assert found[0].sh_degree == FOR_CAPTURES.sh_degree == 2
    plain = refine_on_capture(scene(), capture, range(4), frame, exposures, steps=1, config=RefineConfig())
    assert plain[0].sh_degree == 0


@pytest.mark.parametrize("degree", [-1, 4])
def test_a_degree_that_there_is_not_is_refused(degree):
    with pytest.raises(InputError, match="sh_degree must be 0 to 3"):
        RefineConfig(sh_degree=degree)


def test_no_steps_on_a_capture_return_the_scene_bit_for_bit():
    capture = open_capture("procedural:room?frames=4", size=(24, 16))
    exposures = {i: np.ones(3, np.float32) for i in range(4)}
    found = refine_on_capture(scene(), capture, range(4), capture.stream_frame(StreamConfig()), exposures, steps=0)
    assert found[0].sh_degree == 0 and found[1].num_steps == 0
    assert_same_bits(found[0], scene())
