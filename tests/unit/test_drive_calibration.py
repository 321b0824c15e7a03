"""Keyframes combined into one calibration: offsets, outliers, covariance, and which is in force."""

from dataclasses import replace

import numpy as np
import pytest
from toy_calibration import START_NS

from streetscan.calibration.drive_calibration import (
    DriveCalibrationSettings,
    KeyframeResult,
    combine_keyframes,
    follow_drive,
    keyframes_in_force,
    pool_bends,
)
from streetscan.calibration.edges import Bend
from streetscan.calibration.motion import LidarMotion
from streetscan.geometry import apply, invert, moved_by, rotation_angle, transform
from streetscan.registration.odometry import FramePose

# Keyframes here say nothing of what their clouds leave open: these are all of their scatter.
SETTINGS = DriveCalibrationSettings(keyframe_m=0.04, keyframe_deg=0.1)
T_TRUE = np.array([[0.0, -1, 0, 0.1], [0, 0, -1, -0.2], [1, 0, 0, -0.4], [0, 0, 0, 1]]) @ transform([0, 0, 0], (0.01, 0.02, -0.03))


def motion(speed_mps: float, turn_radps: float = 0.0) -> LidarMotion:
    """Twenty poses of a lidar that drives at one speed and turns; the frame is the tenth, its image 20 ms later."""
    poses = []
    for k in range(21):
        t = 0.1 * (k - 10)
        pose = FramePose(k, START_NS / 1e9 + 0.1 * k, "ok", 0)
        pose.T_segment_lidar = transform([speed_mps * t, 0, 0], (0, 0, turn_radps * t))
        poses.append(pose)
    return LidarMotion(poses, START_NS + 1_000_000_000, START_NS + 1_020_000_000)


def keyframe(
    index: int, speed_mps: float = 8.0, error: np.ndarray | None = None, offset_s: float = 0.0, status: str = "ok", turn_radps: float = 0.0
):
    """A keyframe of the true mounting, or of one that is off by a transform, with an offset of the images' stamps."""
    m = motion(speed_mps, turn_radps)
    T = T_TRUE if error is None else T_TRUE @ error
    T_stamp = T @ invert(m.at([m.image_s - offset_s])[0])
    rng = np.random.default_rng(index)
    points, normals = rng.uniform([5, -5, -1], [20, 5, 2], (200, 3)), rng.normal(size=(200, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    evidence = np.concatenate([points, apply(T_stamp, points), normals], axis=1)
    return KeyframeResult(index, status, T_stamp, m, evidence)


def noise(rng, m: float = 0.03, deg: float = 0.08) -> np.ndarray:
    return transform(rng.normal(0, m, 3), np.radians(rng.normal(0, deg, 3)))


def test_one_keyframe_is_its_own_calibration_with_the_deviation_of_one():
    made = combine_keyframes([keyframe(0)], SETTINGS)
    np.testing.assert_allclose(made.T_camera_lidar, T_TRUE, atol=1e-6)
    sigmas = np.sqrt(np.diag(made.covariance))
    assert 0.02 < sigmas[0] < 0.08
    assert sigmas[6] == pytest.approx(0.005, rel=0.1)


def test_many_keyframes_are_better_than_one_and_say_so():
    rng, errors, nees = np.random.default_rng(0), [], []
    for _ in range(40):
        offset_s = rng.normal(0, 0.005)
        made = combine_keyframes([keyframe(k, error=noise(rng), offset_s=offset_s) for k in range(12)], SETTINGS)
        shift = made.T_camera_lidar[:3, 3] - T_TRUE[:3, 3]
        errors.append(np.linalg.norm(shift))
        nees.append(np.linalg.norm(shift) / np.sqrt(np.trace(made.covariance[:3, :3])))
    assert np.mean(errors) < 0.06
    # Sigma within a factor of two of the true error.
    assert 0.5 < np.sqrt(np.mean(np.square(nees))) < 2


def test_a_keyframe_that_disagrees_loses_its_weight():
    rng = np.random.default_rng(1)
    keyframes = [keyframe(k, error=noise(rng)) for k in range(8)] + [keyframe(8, error=transform([1.0, 0.5, 0], (0, 0, 0.1)))]
    made = combine_keyframes(keyframes)
    assert made.weights[-1] < 0.01
    assert np.linalg.norm(made.T_camera_lidar[:3, 3] - T_TRUE[:3, 3]) < 0.05
    assert np.degrees(rotation_angle(invert(T_TRUE) @ made.T_camera_lidar)) < 0.15


def test_different_speeds_tell_the_offset():
    keyframes = [keyframe(k, speed_mps=speed, offset_s=0.02) for k, speed in enumerate(np.linspace(2, 16, 30))]
    made = combine_keyframes(keyframes, DriveCalibrationSettings(offset_std_s=0.05, keyframe_m=0.01))
    assert made.time_offset_s == pytest.approx(0.02, abs=1e-3)
    np.testing.assert_allclose(made.T_camera_lidar[:3, 3], T_TRUE[:3, 3], atol=0.01)


def test_an_offset_in_a_bend_turns_the_camera_too():
    # 20 ms of a vehicle that turns by 20 degrees a second are 0.4 degrees.
    turns = np.radians([-20.0, -10, 0, 10, 20, 20])
    keyframes = [keyframe(k, speed_mps=5.0 + k, offset_s=0.02, turn_radps=turn) for k, turn in enumerate(turns)]
    settings = replace(SETTINGS, offset_std_s=0.05)
    made = combine_keyframes(keyframes, settings)
    assert made.time_offset_s == pytest.approx(0.02, abs=1e-3)
    assert np.degrees(rotation_angle(invert(T_TRUE) @ made.T_camera_lidar)) < 0.02
    np.testing.assert_allclose(made.T_camera_lidar[:3, 3], T_TRUE[:3, 3], atol=0.01)
    # The offset tells the turn, so that none of them is off the others.
    _, deviations = keyframes_in_force(keyframes, settings)
    assert np.nanmax(deviations) < 0.5


def test_all_in_one_bend_the_turn_is_as_uncertain_as_the_offset():
    turn = np.radians(20.0)
    made = combine_keyframes([keyframe(k, speed_mps=0.0, offset_s=0.02, turn_radps=turn) for k in range(6)])
    error = rotation_angle(invert(T_TRUE) @ made.T_camera_lidar)
    sigma = np.sqrt(np.trace(made.covariance[3:6, 3:6]))
    assert error > np.radians(0.2)
    assert error < 4 * sigma + 1e-9


def test_one_speed_does_not_tell_it_and_the_deviation_is_what_was_expected():
    """At 10 m/s the 5 ms expected are 5 cm along the road, whatever the offset is: a larger one must be given."""
    for expected_s in (0.005, 0.02):
        made = combine_keyframes([keyframe(k, offset_s=0.02) for k in range(10)], DriveCalibrationSettings(offset_std_s=expected_s))
        assert abs(made.time_offset_s) < 0.001
        assert np.sqrt(made.covariance[6, 6]) == pytest.approx(expected_s, rel=0.01)
        along = np.sqrt(np.trace(made.covariance[:3, :3]))
        assert along == pytest.approx(10.0 * expected_s, rel=0.2)


def test_speeds_that_differ_tell_an_offset_larger_than_expected():
    """20 ms where 5 are expected; at eight speeds a third of it would be left if it were held to that."""
    keyframes = [keyframe(k, speed_mps=speed, offset_s=0.02) for k, speed in enumerate(np.linspace(5, 14, 8))]
    made = combine_keyframes(keyframes)
    assert made.time_offset_s == pytest.approx(0.02, abs=0.002)
    np.testing.assert_allclose(made.T_camera_lidar[:3, 3], T_TRUE[:3, 3], atol=0.02)


def test_noise_is_no_offset():
    rng = np.random.default_rng(5)
    keyframes = [keyframe(k, speed_mps=9 + 0.1 * k, error=noise(rng)) for k in range(8)]
    assert abs(combine_keyframes(keyframes).time_offset_s) < 0.005


def test_without_an_accepted_keyframe_there_is_none():
    made = combine_keyframes([keyframe(0, status="no_match")])
    assert made.status == "no_keyframes"
    assert np.isnan(made.T_camera_lidar).all()
    assert combine_keyframes([]).status == "no_keyframes"


def test_without_an_accepted_keyframe_what_was_in_force_stays():
    refused = replace(keyframe(0, status="not_better"), reason="0.017 m from the planes, the one in force 0.016 m")
    made = combine_keyframes([refused], T_in_force=T_TRUE)
    assert made.status == "kept"
    np.testing.assert_array_equal(made.T_camera_lidar, T_TRUE)
    assert np.isnan(made.covariance).all()
    assert combine_keyframes([keyframe(0)], T_in_force=np.eye(4)).status == "ok"
    assert follow_drive([refused])["reason"].tolist() == [refused.reason]


def test_the_bootstrap_repeats():
    rng = np.random.default_rng(2)
    keyframes = [keyframe(k, error=noise(rng)) for k in range(5)]
    np.testing.assert_array_equal(combine_keyframes(keyframes, seed=3).covariance, combine_keyframes(keyframes, seed=3).covariance)


def test_a_shifted_mounting_is_noticed_and_replaced():
    knock = transform([0, 0.03, 0], (0, 0, np.radians(1.0)))
    keyframes = [keyframe(0), keyframe(1), keyframe(2, status="no_match"), keyframe(3, error=knock), keyframe(4, error=knock)]
    table = follow_drive(keyframes)
    # One keyframe that is off may be wrong; the second that agrees with it is not.
    assert table["action"].tolist() == ["replaced", "kept", "kept", "kept", "replaced"]
    # The second is still off the mounting before, and tells that it has moved.
    assert table["is_shifted"].tolist() == [False, False, False, True, True]
    assert table["in_force"].tolist() == [0, 0, 0, 0, 4]
    held, _ = keyframes_in_force(keyframes)
    assert [k.index for k in held] == [3, 4]


def test_a_small_knock_is_noticed_within_three_keyframes():
    rng = np.random.default_rng(5)
    knock = transform([0.03, 0, 0], (0, 0, np.radians(0.5)))
    keyframes = [keyframe(k, error=noise(rng, 0.02, 0.05)) for k in range(5)]
    keyframes += [keyframe(5 + k, error=knock @ noise(rng, 0.02, 0.05)) for k in range(3)]
    held, deviations = keyframes_in_force(keyframes, DriveCalibrationSettings(keyframe_m=0.02, keyframe_deg=0.06))
    assert (deviations[1:5] < 1.8).all()
    assert (deviations[5:7] > 1.8).all()
    assert [k.index for k in held] == [5, 6, 7]
    made = combine_keyframes(held)
    assert np.degrees(rotation_angle(invert(T_TRUE @ knock) @ made.T_camera_lidar)) < 0.15


def test_one_wrong_keyframe_is_no_moved_mounting():
    rng = np.random.default_rng(6)
    wrong = keyframe(2, error=transform([0.3, 0.2, 0], (0, 0, 0.05)))
    keyframes = [keyframe(0, error=noise(rng)), keyframe(1, error=noise(rng)), wrong, keyframe(3, error=noise(rng))]
    assert [k.index for k in keyframes_in_force(keyframes, SETTINGS)[0]] == [0, 1, 3]


def test_a_wrong_first_keyframe_gives_way():
    rng = np.random.default_rng(7)
    wrong = keyframe(0, error=transform([0.3, 0.2, 0], (0, 0, 0.05)))
    keyframes = [wrong, keyframe(1, error=noise(rng)), keyframe(2, error=noise(rng))]
    assert [k.index for k in keyframes_in_force(keyframes, SETTINGS)[0]] == [1, 2]


def test_a_keyframe_counts_where_it_knows():
    # One does not know x, the other not the turn.
    blind = np.diag([0.0, 0, 0, 1.0, 0, 0])
    turned = np.diag([0.01, 0.01, 0.01, 0.0, 0, 0])
    a, b = (
        keyframe(0, speed_mps=0.0, error=transform([0, 0.2, 0])),
        keyframe(1, speed_mps=0.0, error=transform(rpy_rad=(0, 0, np.radians(1)))),
    )
    # The camera's x is the lidar's -y.
    a.covariance, b.covariance = blind, turned
    made = combine_keyframes([a, b])
    error = invert(T_TRUE) @ made.T_camera_lidar
    assert np.degrees(rotation_angle(error)) < 0.1
    assert np.abs(error[:3, 3]).max() < 0.03


def test_a_drive_begins_without_a_calibration():
    table = follow_drive([keyframe(0, status="too_few_objects"), keyframe(1)])
    assert table["action"].tolist() == ["none", "replaced"]
    assert table["in_force"].tolist() == [-1, 1]


def test_which_of_two_is_better_is_told_by_the_evidence_of_both():
    # Each fits its own evidence best; that of the first is flawless, and the second's error shows on it as much as on its own.
    worse = keyframe(1, error=transform([0, 0.05, 0]))
    worse.evidence = np.concatenate(
        [worse.evidence[:, :3], worse.evidence[:, 3:6] + 0.01 * worse.evidence[:, 6:], worse.evidence[:, 6:]], 1
    )
    table = follow_drive([keyframe(0), worse])
    assert table["action"].tolist() == ["replaced", "kept"]
    assert table["distance_before_m"][1] < table["distance_m"][1]
    assert follow_drive([worse, keyframe(0)])["action"].tolist() == ["replaced", "replaced"]


def bent_keyframe(index: int, bend_deg: float, told_deg: float, std_deg: float, made_deg: float = 0.0) -> KeyframeResult:
    """A keyframe whose camera went another way by `bend_deg`, less what it is corrected by, and what its image edges tell of it."""
    response = np.array([0.0, 1.0, 0.0, 0.5, 0.0, 0.1])
    k = keyframe(index)
    wrong = moved_by(k.T_camera_stamp, response * np.radians(made_deg - bend_deg))
    bend = Bend(np.radians(told_deg), np.radians(std_deg))
    return replace(k, T_camera_stamp=wrong, bend=bend, bend_made_rad=np.radians(made_deg), bend_response=response)


def test_keyframes_that_tell_an_error_together_are_all_corrected():
    # None is sure by itself but the last, which is corrected already.
    told = [0.35, 0.2, 0.3, 0.25, 0.4, 0.3]
    keyframes = [bent_keyframe(k, 0.3, t, 0.2) for k, t in enumerate(told)] + [bent_keyframe(6, 0.3, 0.3, 0.1, made_deg=0.3)]
    made = combine_keyframes(keyframes)
    assert made.is_straightened
    assert np.degrees(made.bend.rad) == pytest.approx(0.3, abs=0.01)
    np.testing.assert_allclose(made.T_camera_lidar, T_TRUE, atol=1e-3)
    assert np.degrees(rotation_angle(invert(combine_keyframes(keyframes[:2]).T_camera_lidar) @ T_TRUE)) > 0.25


def test_what_keyframes_do_not_tell_surely_corrects_none():
    keyframes = [bent_keyframe(k, 0.0, told, 0.2) for k, told in enumerate([0.3, -0.2, 0.25, 0.1])]
    made = combine_keyframes(keyframes)
    assert not made.is_straightened
    np.testing.assert_allclose(made.T_camera_lidar, T_TRUE, atol=1e-6)


def test_pooled_errors_by_hand():
    pooled = pool_bends([bent_keyframe(0, 0, 0.1, 0.1), bent_keyframe(1, 0, 0.2, 0.2), bent_keyframe(2, 0, 5.0, np.inf)])
    # Weights 4 to 1: (4 * 0.1 + 0.2) / 5, deviation 0.1 * sqrt(4 / 5).
    assert np.degrees([pooled.rad, pooled.std_rad]) == pytest.approx([0.12, 0.1 * np.sqrt(0.8)])
    apart = pool_bends([bent_keyframe(0, 0, 0.5, 0.1), bent_keyframe(1, 0, -0.5, 0.1)])
    # Ten deviations between them: five times as unsure, times the square root of two.
    assert np.degrees(apart.std_rad) == pytest.approx(0.5)
    assert np.isinf(pool_bends([bent_keyframe(0, 0, 0.1, 0.1)]).std_rad)
