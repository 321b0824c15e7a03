"""Known projections recovered; points behind the camera and too few of them."""

import numpy as np
import pytest

from streetscan.calibration.linear_projection import View, camera_of, fit_projection, linear_of, project_linear
from streetscan.geometry import apply, transform

K = np.array([[500.0, 0, 320], [0, 510.0, 240], [0, 0, 1]])
T_CAMERA_LIDAR = np.array([[0.0, -1, 0, 0.1], [0, 0, -1, -0.2], [1, 0, 0, 0.3], [0, 0, 0, 1]]) @ transform([0, 0, 0], (0.01, 0.02, -0.03))


def ahead(n: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform([6, -5, -1.5], [25, 5, 2], (n, 3))


def test_a_known_answer():
    # Straight ahead at 10 m, one metre to the left and half a metre up.
    P = linear_of(np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]]), K)
    np.testing.assert_allclose(project_linear(P, np.array([(10.0, 1.0, 0.5)])), [(320 - 50, 240 - 25.5)])


@pytest.mark.parametrize("n", [4, 6, 200])
def test_a_projection_is_recovered_from_its_pixels(n):
    points = ahead(n)
    fitted = fit_projection(points, project_linear(linear_of(T_CAMERA_LIDAR, K), points), K)
    np.testing.assert_allclose(fitted.T_camera_lidar, T_CAMERA_LIDAR, atol=1e-3)
    assert np.abs(fitted.residuals_px).max() < 0.05


def test_outliers_are_left_out():
    points = ahead(60)
    pixels = project_linear(linear_of(T_CAMERA_LIDAR, K), points)
    pixels[:5] += 80
    fitted = fit_projection(points, pixels, K)
    assert len(fitted.residuals_px) == 55
    np.testing.assert_allclose(fitted.T_camera_lidar, T_CAMERA_LIDAR, atol=1e-3)


def test_too_few_points_or_points_on_a_line_give_nothing():
    points = ahead(3)
    pixels = project_linear(linear_of(T_CAMERA_LIDAR, K), points)
    assert fit_projection(points, pixels, K) is None
    line = np.array([10.0, 0, 0]) + np.arange(8)[:, None] * [0.0, 0, 0.3]
    assert fit_projection(line, project_linear(linear_of(T_CAMERA_LIDAR, K), line), K) is None
    assert fit_projection(ahead(8), np.full((8, 2), np.nan), K) is None


def test_points_behind_the_camera_have_no_pixel():
    assert np.isnan(project_linear(linear_of(T_CAMERA_LIDAR, K), np.array([(-5.0, 0, 0)]))).all()


def test_a_similarity_has_the_pixels_of_its_rigid_part():
    view = View(transform([0.1, 0, 0.2], (0.01, 0, 0)), K, 640, 480)
    scaled = np.diag([1.1, 1.1, 1.1, 1]) @ T_CAMERA_LIDAR
    T = camera_of(view, np.linalg.inv(view.T_camera_sfm) @ scaled)
    points = ahead(10)
    np.testing.assert_allclose(np.linalg.det(T[:3, :3]), 1.0)
    np.testing.assert_allclose(project_linear(linear_of(T, K), points), project_linear(K @ scaled[:3], points))


def test_a_view_sees_what_falls_into_the_picture():
    view = View(T_CAMERA_LIDAR, K, 640, 480)
    points = np.array([(10.0, 0, 0), (-10.0, 0, 0), (10.0, 30, 0)])
    np.testing.assert_array_equal(view.sees(points), [True, False, False])
    np.testing.assert_allclose(view.project(points[:1]), project_linear(linear_of(T_CAMERA_LIDAR, K), points[:1]))
    assert apply(T_CAMERA_LIDAR, points[:1])[0, 2] > 9
