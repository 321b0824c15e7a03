import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from streetscan import geometry
from streetscan.errors import BadInput

numbers = st.floats(-100, 100, allow_nan=False)
angles = st.floats(-3.1, 3.1)
poses = st.builds(
    lambda xyz, rpy: geometry.transform(xyz, rpy),
    st.tuples(numbers, numbers, numbers),
    st.tuples(angles, st.floats(-1.5, 1.5), angles),
)


def test_yaw_turns_forward_to_the_left():
    T = geometry.transform([1, 2, 3], [0, 0, np.pi / 2])
    np.testing.assert_allclose(geometry.apply(T, [[1, 0, 0]]), [[1, 3, 3]], atol=1e-12)


def test_roll_is_applied_first():
    # Roll brings y to z; the yaw that follows leaves z alone.
    T = geometry.transform([0, 0, 0], [np.pi / 2, 0, np.pi / 2])
    np.testing.assert_allclose(geometry.apply(T, [[0, 1, 0]]), [[0, 0, 1]], atol=1e-12)


@given(poses)
def test_inverse_undoes(T):
    np.testing.assert_allclose(geometry.compose(T, geometry.invert(T)), np.eye(4), atol=1e-9)


@given(poses, poses)
def test_composition_equals_applying_in_turn(T_a_b, T_b_c):
    points = np.array([[1.0, -2.0, 3.0], [-40.0, 0.0, 7.0]])
    expected = geometry.apply(T_a_b, geometry.apply(T_b_c, points))
    np.testing.assert_allclose(geometry.apply(geometry.compose(T_a_b, T_b_c), points), expected, atol=1e-9)


@given(poses)
def test_angles_and_quaternions_rebuild_the_transform(T):
    np.testing.assert_allclose(geometry.transform(T[:3, 3], geometry.rpy_of_transform(T)), T, atol=1e-9)
    np.testing.assert_allclose(geometry.transform_of_quaternion(T[:3, 3], geometry.quaternion_of_transform(T)), T, atol=1e-9)


@given(poses, st.floats(0.1, 10), st.booleans())
def test_similarity_is_recovered(T, scale, with_scale):
    rng = np.random.default_rng(0)
    source = rng.normal(size=(20, 3)) * 5
    S = T.copy()
    if with_scale:
        S[:3, :3] *= scale
    fitted = geometry.fit_similarity(source, geometry.apply(S, source), with_scale=with_scale)
    np.testing.assert_allclose(fitted, S, atol=1e-7)
    np.testing.assert_allclose(geometry.invert(S) @ S, np.eye(4), atol=1e-8)


def test_similarity_of_planar_points_is_no_reflection():
    source = np.array([[0, 0, 0], [1, 0, 0], [0, 2, 0], [3, 1, 0]], float)
    T = geometry.transform([1, 2, 3], [0.1, 0.2, 0.3])
    fitted = geometry.fit_similarity(source, geometry.apply(T, source))
    np.testing.assert_allclose(fitted, T, atol=1e-9)


@pytest.mark.parametrize("source", [np.zeros((3, 3)), np.arange(4)[:, None] * np.ones(3), np.zeros((2, 3)), np.zeros((0, 3))])
def test_similarity_refuses_too_little(source):
    with pytest.raises(ValueError):
        geometry.fit_similarity(source, source)


def test_poses_between_poses():
    poses = np.stack([geometry.transform([0, 0, 0]), geometry.transform([2, 0, 0], [0, 0, 1.0])])
    halfway = geometry.interpolate_poses([0.5], [0.0, 1.0], poses)[0]
    np.testing.assert_allclose(halfway, geometry.transform([1, 0, 0], [0, 0, 0.5]), atol=1e-12)


def test_no_pose_outside_what_is_known():
    poses = np.stack([np.eye(4)] * 2)
    found = geometry.interpolate_poses([-0.1, 0.0, 1.0, 1.1], [0.0, 1.0], poses)
    assert np.isnan(found[[0, 3]]).all()
    assert np.isfinite(found[[1, 2]]).all()
    assert np.isnan(geometry.interpolate_poses([2.0], [0.0], poses[:1])).all()


def test_poses_turn_the_short_way():
    poses = np.stack([geometry.transform(rpy_rad=[0, 0, np.radians(170)]), geometry.transform(rpy_rad=[0, 0, np.radians(-170)])])
    yaw = geometry.rpy_of_transform(geometry.interpolate_poses([0.5], [0, 1], poses))[0, 2]
    assert abs(geometry.angle_difference(yaw, np.pi)) < 1e-9


@pytest.mark.parametrize("times", [[0.0, 0.0], [1.0, 0.0]])
def test_times_must_increase(times):
    with pytest.raises(ValueError):
        geometry.interpolate_poses([0.5], times, np.stack([np.eye(4)] * 2))


@given(st.floats(-20, 20), st.floats(-20, 20))
def test_angle_difference_is_short_and_right(a, b):
    d = geometry.angle_difference(a, b)
    assert -np.pi <= d <= np.pi
    assert np.isclose(np.cos(d), np.cos(a - b), atol=1e-9)
    assert np.isclose(np.sin(d), np.sin(a - b), atol=1e-9)


@given(st.floats(0, np.pi))
def test_rotation_angle(angle):
    assert np.isclose(geometry.rotation_angle(geometry.transform(rpy_rad=[angle, 0, 0])), angle, atol=1e-7)


def test_one_transform_each():
    T = np.stack([geometry.transform([i, 0, 0]) for i in range(3)])
    np.testing.assert_allclose(geometry.apply(T, np.zeros((3, 3)))[:, 0], [0, 1, 2])


def test_a_rotation_with_few_digits_is_made_exact():
    R = np.round(geometry.transform(rpy_rad=[0.3, -0.2, 1.0])[:3, :3], 5)
    exact = geometry.check_rotation(R, "calib")
    np.testing.assert_allclose(exact @ exact.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(exact, R, atol=1e-4)


@pytest.mark.parametrize("matrix", [np.diag([1, 1, -1]), 2 * np.eye(3), np.zeros((3, 3)), np.full((3, 3), np.nan)])
def test_what_is_no_rotation_is_refused(matrix):
    with pytest.raises(BadInput, match="calib"):
        geometry.check_rotation(matrix, "calib")
