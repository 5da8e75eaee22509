"""Stream frames: they can be inverted, and do not change what a camera sees."""

import jax.numpy as jnp
import numpy as np
import pytest

from ssplat_jax.core.cameras import project_points, transform_points
from ssplat_jax.core.gaussians import Gaussians
from ssplat_jax.core.rotations import quats_to_matrices, sh_rotation
from ssplat_jax.data.stream_frame import StreamFrame

FLOAT64_ROUNDING = 1e-12
FLOAT32_PIXELS = 2e-3  # 1000 pixels x float32's 1e-7 x a dozen operations
FLOAT32_ROUNDING = 2e-6

EARTH = np.array([4.2e6, 6.1e5, 4.7e6])  # earth-centered meters, where float32 has a spacing of 0.5 m


def random_rotation(rng):
    q, r = np.linalg.qr(rng.normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    return q * np.linalg.det(q)


def random_pose(rng, center):
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = random_rotation(rng), center
    return pose


def frame_at(pose, scale=1.7):
    return StreamFrame.at_camera(pose, scale=scale, near=0.5, far=8.0)


@pytest.mark.parametrize("origin", [np.zeros(3), EARTH])
def test_points_survive_a_round_trip(origin):
    rng = np.random.default_rng(0)
    frame = frame_at(random_pose(rng, origin))
    points = origin + rng.normal(size=(50, 3))
    back = frame.points_to_capture(frame.points_to_stream(points))
    np.testing.assert_allclose(back, points, rtol=0, atol=FLOAT64_ROUNDING * max(1, np.abs(origin).max()))


def test_cameras_survive_a_round_trip():
    rng = np.random.default_rng(2)
    frame = frame_at(random_pose(rng, np.ones(3)))
    poses = np.stack([random_pose(rng, rng.normal(size=3)) for _ in range(5)])
    back = frame.camtoworlds(frame.viewmats(poses).astype(np.float64))
    np.testing.assert_allclose(back, poses, rtol=0, atol=FLOAT32_ROUNDING)


@pytest.mark.parametrize("origin", [np.zeros(3), EARTH])
def test_a_point_is_seen_at_the_same_pixel_and_at_scaled_depth(origin):
    rng = np.random.default_rng(3)
    frame = frame_at(random_pose(rng, origin))
    pose = random_pose(rng, origin + rng.normal(size=3))
    K = np.array([[500.0, 0, 310], [0, 480, 250], [0, 0, 1]])
    in_camera = np.concatenate([rng.uniform(-1, 1, (40, 2)), rng.uniform(1, 4, (40, 1))], -1)
    points = in_camera @ pose[:3, :3].T + pose[:3, 3]
    truth = (in_camera @ K.T)[:, :2] / in_camera[:, 2:]
    viewmat = jnp.asarray(frame.viewmats(pose))
    stream_points = jnp.asarray(frame.points_to_stream(points), jnp.float32)
    pixels, depths = project_points(transform_points(viewmat, stream_points), jnp.asarray(K, jnp.float32))
    np.testing.assert_allclose(pixels, truth, rtol=0, atol=FLOAT32_PIXELS)
    np.testing.assert_allclose(depths, frame.scale * in_camera[:, 2], rtol=FLOAT32_ROUNDING * 4)


def gaussians(rng, degree):
    n, k = 30, (degree + 1) ** 2
    return Gaussians(
        means=jnp.asarray(rng.normal(size=(n, 3)), jnp.float32),
        quats=jnp.asarray(rng.normal(size=(n, 4)), jnp.float32),
        scales=jnp.asarray(rng.uniform(0.01, 0.2, (n, 3)), jnp.float32),
        opacities=jnp.asarray(rng.uniform(size=n), jnp.float32),
        sh=jnp.asarray(rng.normal(size=(n, k, 3)), jnp.float32),
    )


def covariances(g):
    axes = np.asarray(quats_to_matrices(g.quats), np.float64) * np.asarray(g.scales, np.float64)[:, None, :]
    return np.einsum("nij,nkj->nik", axes, axes)


def test_gaussians_in_the_capture_frame_are_the_same_ellipsoids():
    rng = np.random.default_rng(5)
    frame = frame_at(random_pose(rng, np.array([3.0, -2.0, 1.0])), scale=0.4)
    before = gaussians(rng, 0)
    after = frame.gaussians_to_capture(before)
    means = np.asarray(after.means, np.float64)
    np.testing.assert_allclose(frame.points_to_stream(means), before.means, rtol=0, atol=4 * FLOAT32_ROUNDING)
    turn = frame.rotation / frame.scale
    wanted = np.einsum("ij,njk,lk->nil", turn, covariances(before), turn)
    np.testing.assert_allclose(covariances(after), wanted, rtol=0, atol=1e-5 * np.abs(wanted).max())
    np.testing.assert_array_equal(after.opacities, before.opacities)
    np.testing.assert_allclose(after.sh, before.sh, rtol=0, atol=FLOAT32_ROUNDING)


def test_a_small_scene_far_from_the_origin_keeps_its_points():
    """A scene of centimeters in units of kilometers: an offset in whole units would be zero."""
    rng = np.random.default_rng(6)
    frame = frame_at(random_pose(rng, np.array([0.3, -0.4, 0.2])), scale=1e6)
    before = gaussians(rng, 0)
    assert any(frame.offset) and np.abs(frame.origin - frame.offset).max() <= 0.5 / frame.scale
    means = np.asarray(frame.gaussians_to_capture(before, offset=frame.offset).means, np.float64) + frame.offset
    np.testing.assert_allclose(frame.points_to_stream(means), before.means, rtol=0, atol=4 * FLOAT32_ROUNDING)


def legendre_color(sh, direction):
    """Color of SH of degree 1, as splat viewers compute it."""
    x, y, z = direction
    c0, c1 = 0.28209479177387814, 0.4886025119029199
    return 0.5 + c0 * sh[0] - c1 * y * sh[1] + c1 * z * sh[2] - c1 * x * sh[3]


def test_colors_turn_with_the_scene():
    rng = np.random.default_rng(6)
    frame = frame_at(random_pose(rng, np.zeros(3)))
    before = gaussians(rng, 1)
    after = frame.gaussians_to_capture(before)
    direction = rng.normal(size=3)
    direction /= np.linalg.norm(direction)
    for n in range(5):
        seen = legendre_color(np.asarray(before.sh[n], np.float64), frame.rotation.T @ direction)
        np.testing.assert_allclose(legendre_color(np.asarray(after.sh[n]), direction), seen, atol=4 * FLOAT32_ROUNDING)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_sh_rotation_is_orthogonal_and_a_homomorphism(degree):
    rng = np.random.default_rng(7)
    a, b = random_rotation(rng), random_rotation(rng)
    mixing = sh_rotation(a, degree)
    np.testing.assert_allclose(mixing @ mixing.T, np.eye((degree + 1) ** 2), rtol=0, atol=1e-11)
    np.testing.assert_allclose(sh_rotation(a @ b, degree), mixing @ sh_rotation(b, degree), rtol=0, atol=1e-11)
