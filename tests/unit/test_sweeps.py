import numpy as np
import pytest

from streetscan import geometry
from streetscan.sweeps import azimuth_offsets, azimuths_of, deskew, deskew_along, forward_time, velocity_between


def ring(n=3600, radius_m=10.0, clockwise=True, first_rad=np.pi):
    """Points of one beam in the order of firing, and their times in a revolution of 0.1 s that passes forward at 0.05 s."""
    times = (np.arange(n) + 0.5) / n * 0.1
    azimuths = first_rad + (-1 if clockwise else 1) * 2 * np.pi * times / 0.1
    return radius_m * np.stack([np.cos(azimuths), np.sin(azimuths), 0 * azimuths], axis=1), times


def test_clockwise_is_rear_left_front_right():
    points = np.array([[-1, 1e-9, 0], [0, 1, 0], [1, 0, 0], [0, -1, 0], [-1, -1e-9, 0]])
    np.testing.assert_allclose(azimuth_offsets(azimuths_of(points), -0.05, 0.05), [-0.05, -0.025, 0, 0.025, 0.05], atol=1e-7)
    np.testing.assert_allclose(
        azimuth_offsets(azimuths_of(points), -0.05, 0.05, "counterclockwise"), [0.05, 0.025, 0, -0.025, -0.05], atol=1e-7
    )


def test_halves_of_different_length():
    points = np.array([[0, 1, 0], [0, -1, 0]])
    np.testing.assert_allclose(azimuth_offsets(azimuths_of(points), -0.06, 0.04), [-0.03, 0.02], atol=1e-7)


def test_offsets_of_no_point():
    assert azimuth_offsets(np.empty(0), -0.05, 0.05).shape == (0,)


@pytest.mark.parametrize("clockwise", [True, False])
def test_forward_time_is_found(clockwise):
    points, times = ring(clockwise=clockwise)
    assert forward_time(points, 1e9 + times) == pytest.approx(1e9 + 0.05, abs=1e-6)
    assert forward_time(points[::7], times[::7]) == pytest.approx(0.05, abs=1e-6)


def test_forward_time_without_forward_points():
    points, times = ring()
    rear = points[:, 0] < 0
    assert forward_time(points[rear], times[rear]) == pytest.approx(0.05, abs=1e-3)


def test_forward_time_of_a_sweep_cut_in_front():
    points, times = ring(first_rad=0.0)
    assert forward_time(points, times) == pytest.approx(0.0, abs=1e-6)


def test_forward_time_of_nothing():
    assert np.isnan(forward_time(np.empty((0, 3)), np.empty(0)))
    assert np.isnan(forward_time(np.array([[-1.0, 0, 0]]), np.array([0.0])))


def test_a_moving_sensor_sees_the_standing_wall_again():
    velocity, turn = np.array([15.0, 0.3, 0.0]), np.array([0.0, 0.01, 0.4])
    standing, times = ring()
    offsets = times - 0.05
    # What the moving sensor measures: the standing points, brought into its frame at each firing.
    T = np.stack([geometry.transform_of_rotation(np.eye(3))] * len(times))
    from scipy.spatial.transform import Rotation

    T[:, :3, :3], T[:, :3, 3] = Rotation.from_rotvec(offsets[:, None] * turn).as_matrix(), offsets[:, None] * velocity
    measured = geometry.apply(geometry.invert(T), standing)
    assert np.abs(measured - standing).max() > 0.5
    np.testing.assert_allclose(deskew(measured, offsets, velocity, turn), standing, atol=1e-9)


def test_along_a_trajectory_equals_the_constant_motion():
    T0, T1 = geometry.transform([5, 6, 7], [0, 0, 0.3]), geometry.transform([6.2, 6.5, 7], [0, 0, 0.3])
    velocity, turn = velocity_between(T0, T1, 0.1)
    points, times = ring(360)
    offsets = times - 0.05
    pose_times = np.array([99.9, 100.0, 100.1])
    poses = np.stack([T0 @ geometry.invert(geometry.invert(T0) @ T1), T0, T1])
    along = deskew_along(points, offsets, 100.0, pose_times, poses)
    np.testing.assert_allclose(along, deskew(points, offsets, velocity, turn), atol=2e-5)


def test_points_fired_outside_the_trajectory_are_unknown():
    along = deskew_along(np.ones((2, 3)), np.array([-0.05, 0.05]), 100.0, np.array([99.9, 100.0]), np.stack([np.eye(4)] * 2))
    assert np.isfinite(along[0]).all()
    assert np.isnan(along[1]).all()


def test_a_de_skewed_recording_stays_as_it_is():
    points, _ = ring(36)
    np.testing.assert_array_equal(deskew(points, np.zeros(36), [10, 0, 0], [0, 0, 1]), points)
