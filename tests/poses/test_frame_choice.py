"""Frames of a video: motion is measured in shares of the width, steps are equal, and blurred frames are passed over."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from ssplat_jax.poses.frame_choice import MIN_FRAMES, STEP, MotionMeter, choose_frames, displacement, sharpness

WIDTH, HEIGHT = 192, 108
WALL = gaussian_filter(np.random.default_rng(0).uniform(0, 255, (200, 1200)), 1.5) * 3
WALL = (WALL - WALL.min()).astype(np.float32)


def view(x, y=0):
    """Part of a textured wall, `x` pixels along it; between pixels, the two neighbors are mixed."""
    low, share = int(x), np.float32(x - int(x))
    window = WALL[y : y + HEIGHT, low : low + WIDTH + 1]
    return (1 - share) * window[:, :-1] + share * window[:, 1:]


@pytest.mark.parametrize(("x", "y"), [(0, 0), (3, 0), (0, 5), (6, 8), (17, 0)])
def test_displacement_is_the_length_of_the_shift(x, y):
    assert displacement(view(100, 20), view(100 + x, 20 + y)) == pytest.approx(np.hypot(x, y))


def test_a_picture_without_contrast_does_not_move():
    assert displacement(np.full((HEIGHT, WIDTH), 7.0, np.float32), view(0)) == 0
    assert displacement(np.ones((20, 30), np.float32), np.zeros((20, 30), np.float32)) == 0  # smaller than a block


@pytest.mark.parametrize("speed", [0.3, 2.0, 9.0])
def test_motion_adds_up_at_any_speed(speed):
    meter = MotionMeter()
    reached = [meter.add(view(speed * i)) for i in range(60)]
    assert reached[0] == 0 and (np.diff(reached) >= 0).all()
    # Whole pixels: off by one at the last key frame at most, and by rounding at each key frame.
    assert reached[-1] * WIDTH == pytest.approx(speed * 59, rel=0.12, abs=1.5)


def test_noise_of_a_still_picture_is_no_motion():
    meter, rng = MotionMeter(), np.random.default_rng(1)
    reached = [meter.add((view(50) + rng.normal(0, 6, (HEIGHT, WIDTH))).astype(np.float32)) for _ in range(30)]
    assert reached[-1] * WIDTH < 1


def test_blur_lowers_sharpness_and_brightness_does_not():
    assert sharpness(gaussian_filter(view(0), 1)) < 0.5 * sharpness(view(0))
    assert sharpness(view(0) + 30) == pytest.approx(sharpness(view(0)), rel=1e-4)


def test_chosen_frames_are_at_equal_steps_of_motion():
    """At half the speed, twice as many frames pass between two chosen ones; nothing is chosen twice while it stands."""
    motion = np.concatenate([np.linspace(0, 2, 100), np.full(80, 2.0), np.linspace(2, 4, 200)])
    chosen = choose_frames(motion, np.ones(len(motion)), 1000)
    gaps = np.diff(motion[chosen])
    assert gaps.min() >= 0.5 * STEP and gaps.max() <= 1.5 * STEP
    assert len(chosen) == pytest.approx(4 / STEP + 1, abs=1)
    still = (chosen >= 100) & (chosen < 180)
    assert still.sum() <= 1


def test_the_sharpest_frame_near_a_step_is_chosen():
    motion = np.linspace(0, 4, 401)  # 5 frames a step
    sharpnesses = np.random.default_rng(2).uniform(1, 2, 401)
    sharpnesses[::2] = 0.1  # every second frame is blurred
    chosen = choose_frames(motion, sharpnesses, 1000)
    assert (chosen[1:-1] % 2 == 1).all() and len(chosen) >= 80
    for i in chosen[1:-1]:
        step = round(float(motion[i]) / STEP)
        around = np.abs(motion - step * STEP) <= STEP / 4 + 1e-9
        assert sharpnesses[i] == sharpnesses[around].max()


def test_the_number_of_frames_is_bounded():
    motion = np.linspace(0, 40, 900)
    assert len(choose_frames(motion, np.ones(900), 120)) == 120
    assert len(choose_frames(motion / 1000, np.ones(900), 120)) == MIN_FRAMES
    np.testing.assert_array_equal(choose_frames(motion[:12], np.ones(12), 120), np.arange(12))  # a short video, whole
    assert choose_frames(np.zeros(50), np.arange(50.0), 120).tolist() == [49]  # nothing moves: the sharpest


def test_a_cut_is_bridged_by_the_nearest_frames():
    motion = np.concatenate([np.linspace(0, 1, 100), np.linspace(3, 4, 100)])
    chosen = choose_frames(motion, np.ones(200), 1000)
    assert {99, 100} <= set(chosen.tolist())
    assert (np.diff(chosen) > 0).all()
