"""Control curves: bins by hand, and what they move."""

import numpy as np
import pytest

from streetscan.calibration.control_curves import bin_parameters, fit_curves

UP = np.array([0.0, 0, 1])
ORIGIN = np.zeros(3)


def test_two_control_points_make_a_line_of_equal_bins():
    control = np.array([(10.0, 0, 0), (0, 10.0, 0)])
    curves = fit_curves(control, control + [1.0, 2, 3], np.ones(2), ORIGIN, UP, n_bins=2)
    np.testing.assert_allclose(curves.bins_lidar, [(7.5, 2.5, 0), (2.5, 7.5, 0)])
    np.testing.assert_allclose(curves.shifts, np.tile([1.0, 2, 3], (2, 1)))


def test_bins_lie_in_the_middles_of_equal_parts_of_each_segment():
    # Three control points: degree 2, Greville abscissae 0, 1/2, 1.
    np.testing.assert_allclose(bin_parameters(3, 2), [0.125, 0.375, 0.625, 0.875])
    assert len(bin_parameters(6, 10)) == 50


def test_a_point_moves_with_its_nearest_bin():
    control = np.array([(10.0, 0, 0), (0, 10.0, 0)])
    curves = fit_curves(control, control + [[0, 0, 1.0], [0, 0, 3.0]], np.ones(2), ORIGIN, UP, n_bins=2)
    # The bins lie a quarter and three quarters of the way from the one shift to the other.
    np.testing.assert_allclose(curves.move(np.array([(10.0, 0, 0), (0, 12.0, 5)])), [(10.0, 0, 1.5), (0, 12.0, 7.5)])
    assert curves.move(np.empty((0, 3))).shape == (0, 3)


@pytest.mark.parametrize("n", [2, 3, 4, 9])
def test_a_common_shift_moves_every_point_by_it(n):
    angles = np.linspace(-1.2, 1.2, n)
    control = np.c_[15 * np.cos(angles), 15 * np.sin(angles), np.linspace(0, 2, n)]
    weights = np.arange(1.0, n + 1)
    curves = fit_curves(control, control + [0.3, -0.2, 0.1], weights, ORIGIN, UP)
    points = np.random.default_rng(0).uniform(-20, 20, (50, 3))
    np.testing.assert_allclose(curves.move(points) - points, np.tile([0.3, -0.2, 0.1], (50, 1)), atol=1e-9)


def test_the_order_of_the_control_points_does_not_matter():
    rng = np.random.default_rng(1)
    control, shifts, weights = rng.uniform(-15, 15, (7, 3)), rng.normal(0, 0.1, (7, 3)), rng.uniform(1, 9, 7)
    order = rng.permutation(7)
    points = rng.uniform(-15, 15, (20, 3))
    a = fit_curves(control, control + shifts, weights, ORIGIN, UP).move(points)
    b = fit_curves(control[order], (control + shifts)[order], weights[order], ORIGIN, UP).move(points)
    np.testing.assert_allclose(a, b)


def test_a_curve_ends_where_nothing_is():
    # Objects ahead only: the curve goes from one side to the other through the front, not around the back.
    angles = np.radians([170, 100, 60, -60, -100, -170]) - np.pi
    control = np.c_[10 * np.cos(angles), 10 * np.sin(angles), np.zeros(6)]
    curves = fit_curves(control, control, np.ones(6), ORIGIN, UP)
    assert abs(np.diff(curves.control_lidar, axis=0)).max() < 20
    gaps = np.linalg.norm(np.diff(curves.control_lidar, axis=0), axis=1)
    ends = np.linalg.norm(curves.control_lidar[0] - curves.control_lidar[-1])
    assert ends >= gaps.max() - 1e-9


def test_one_control_point_makes_no_curve():
    assert fit_curves(np.zeros((1, 3)), np.ones((1, 3)), np.ones(1), ORIGIN, UP) is None
