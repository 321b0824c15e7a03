"""The lidar's motion around a keyframe."""

import numpy as np
from toy_calibration import IMAGE_S, SPEED_MPS, START_NS, T_CAMERA_LIDAR, lidar_poses, toy_keyframe, true_stamp

from streetscan.calibration.motion import LidarMotion, motion_of
from streetscan.geometry import transform

STAMP_NS = START_NS + 1_000_000_000


def motion() -> LidarMotion:
    return LidarMotion(lidar_poses(), STAMP_NS, STAMP_NS + round(IMAGE_S * 1e9))


def test_a_frame_is_freed_of_its_motion():
    toy = toy_keyframe()
    freed = motion().deskew(toy.clouds.points_lidar, toy.clouds.time_offset_s)
    np.testing.assert_allclose(freed, toy.points_stamp, atol=2e-4)


def test_the_motion_between_the_stamps_is_taken_out():
    np.testing.assert_allclose(motion().to_image(true_stamp()), T_CAMERA_LIDAR, atol=1e-6)
    # A stamp that is 10 ms ahead belongs to an image taken before.
    shifted = motion().to_image(true_stamp(), 0.01)
    np.testing.assert_allclose(shifted[:3, 3], T_CAMERA_LIDAR[:3, 3] - T_CAMERA_LIDAR[:3, :3] @ [0.01 * SPEED_MPS, 0, 0], atol=1e-6)


def test_the_twist_is_that_of_the_lidar_in_its_own_axes():
    # Unix seconds in float64 step by 0.24 microseconds.
    np.testing.assert_allclose(motion().twist_at_image(), [0, 0, 0, SPEED_MPS, 0, 0], atol=1e-3)
    turning = lidar_poses()
    for k, pose in enumerate(turning):
        pose.T_segment_lidar = pose.T_segment_lidar @ transform(rpy_rad=(0, 0, 0.03 * k))
    twist = LidarMotion(turning, STAMP_NS, STAMP_NS + round(IMAGE_S * 1e9)).twist_at_image()
    np.testing.assert_allclose(twist[:3], [0, 0, 0.3], atol=1e-3)
    # The lidar is turned by 0.3 rad at its stamp: the way it goes lies to its right.
    turn_rad = 0.3 * (1 + IMAGE_S)
    np.testing.assert_allclose(twist[3:], SPEED_MPS * np.array([np.cos(turn_rad), -np.sin(turn_rad), 0]), atol=0.02)


def test_frames_that_were_not_registered_tell_no_motion():
    assert motion_of([], STAMP_NS, STAMP_NS) is None
    assert motion_of(lidar_poses(), STAMP_NS + 60_000_000_000, STAMP_NS + 60_000_000_000) is None
