"""The unit of a cloud from the lidar's motion: known drives, with a lever arm, turns and noise."""

import numpy as np
import pytest

from streetscan.calibration.scale import NoScale, ScaleSettings, estimate_scale
from streetscan.geometry import invert, transform
from streetscan.registration.odometry import FramePose

METRES_PER_UNIT = 3.7
T_LIDAR_CAMERA = transform([0.4, 0.1, -0.2], [-np.pi / 2, 0.0, -np.pi / 2])


def pose_at(time_s: float, turn_radps: float) -> np.ndarray:
    """T_map_lidar at 7 m/s, turning."""
    yaw = turn_radps * time_s
    radius = 7 / turn_radps if turn_radps else 0.0
    xy = (radius * np.sin(yaw), radius * (1 - np.cos(yaw))) if turn_radps else (7 * time_s, 0.0)
    return transform([*xy, 0.0], [0, 0, yaw])


def drive(turn_radps: float = 0.0, noise_m: float = 0.0, segments=(0,) * 14) -> tuple[np.ndarray, np.ndarray, list[FramePose]]:
    """Cameras in units of structure from motion, their times, and the lidar's poses at 10 Hz."""
    rng, image_times = np.random.default_rng(0), 0.5 + np.arange(8) / 28
    cameras = np.array([invert(pose_at(t, turn_radps) @ T_LIDAR_CAMERA) for t in image_times])
    cameras[:, :3, 3] /= METRES_PER_UNIT
    poses = []
    for i, segment in enumerate(segments):
        T = pose_at(0.1 * i, turn_radps)
        T[:3, 3] += rng.normal(0, noise_m, 3)
        poses.append(FramePose(i, 0.1 * i, "ok", segment, T_segment_lidar=T))
    return cameras, image_times, poses


def test_a_straight_drive_tells_the_scale_and_no_lever_arm():
    scale = estimate_scale(*drive())
    assert scale.value == pytest.approx(METRES_PER_UNIT, rel=1e-6)
    assert scale.way_m == pytest.approx(7 / 4)
    assert np.abs(scale.lever_m).max() < 1e-6
    assert 0 < scale.std < 0.02 * METRES_PER_UNIT


def test_a_bend_makes_the_scale_uncertain_and_says_so():
    """In a steady bend a camera beside the lidar has a longer or a shorter way, and nothing tells it from another scale."""
    cameras, times, poses = drive(turn_radps=0.3)
    found = estimate_scale(cameras, times, poses)
    assert found.value == pytest.approx(METRES_PER_UNIT, rel=0.01)
    assert found.std > 0.3 * 0.5 / 7 * METRES_PER_UNIT * 0.9
    assert found.std > 2 * estimate_scale(*drive()).std
    with pytest.raises(NoScale, match="uncertain"):
        estimate_scale(*drive(turn_radps=1.2))


def test_noise_of_poses_is_smoothed():
    cameras, times, poses = drive(noise_m=0.01)
    assert estimate_scale(cameras, times, poses).value == pytest.approx(METRES_PER_UNIT, rel=0.015)


def shaken(noise_m: float, seed: int) -> np.ndarray:
    """The cameras of `drive`, each off by noise along every axis."""
    cameras = invert(drive()[0])
    cameras[:, :3, 3] += np.random.default_rng(seed).normal(0, noise_m / METRES_PER_UNIT, (8, 3))
    return invert(cameras)


def test_the_deviation_grows_with_what_does_not_fit():
    """Noise of the cameras' places of 1, 3 and 5 % of the way: the deviation that is told is the one that is found."""
    _, times, poses = drive()
    loose = ScaleSettings(max_std=1.0, max_misfit=1.0)
    for noise_m in (0.02, 0.05, 0.09):
        found = [estimate_scale(shaken(noise_m, seed), times, poses, loose) for seed in range(100)]
        off = np.array([scale.value / METRES_PER_UNIT - 1 for scale in found])
        told = np.mean([scale.std for scale in found]) / METRES_PER_UNIT
        assert told == pytest.approx(np.sqrt(np.mean(off**2)), rel=0.25), noise_m
        assert abs(off.mean()) < 0.4 * told


def test_ways_of_another_shape_tell_no_scale():
    _, times, poses = drive()
    for seed in range(20):
        for noise_m in (0.175, 0.35):
            with pytest.raises(NoScale, match="ways of the cameras and of the lidar differ"):
                estimate_scale(shaken(noise_m, seed), times, poses)


def test_turns_of_cameras_are_compared_with_the_lidars():
    """Angles need no extrinsics. Intrinsics 20 % too long would have the cameras turn by as much too little."""
    cameras, times, poses = drive(turn_radps=0.3)
    assert estimate_scale(cameras, times, poses).turn_off_deg < 1e-3
    lazy = invert(cameras)
    lazy[:, :3, :3] = [lazy[0, :3, :3] @ transform([0, 0, 0], [0, -0.8 * 0.3 * (t - times[0]), 0])[:3, :3] for t in times]
    assert estimate_scale(invert(lazy), times, poses).turn_off_deg == pytest.approx(np.degrees(0.2 * 0.3 * 7 / 28), rel=1e-3)


def test_long_ways_tell_the_scale():
    """An error of the cameras' places as long as a step of the vehicle: least squares alone would make the scale 4 % too small."""
    _, times, poses = drive()
    loose = ScaleSettings(max_std=1.0, max_misfit=1.0)
    found = np.mean([estimate_scale(shaken(0.1, seed), times, poses, loose).value for seed in range(100)])
    assert found == pytest.approx(METRES_PER_UNIT, rel=0.025)


def test_times_that_do_not_increase_are_refused():
    cameras, times, poses = drive()
    times[4] = times[3]
    with pytest.raises(NoScale, match="do not increase"):
        estimate_scale(cameras, times, poses)
    with pytest.raises(NoScale, match="do not increase"):
        estimate_scale(cameras, times[::-1], poses)


def test_an_image_that_was_not_registered_is_left_out():
    cameras, times, poses = drive()
    cameras[3] = np.nan
    assert estimate_scale(cameras, times, poses).value == pytest.approx(METRES_PER_UNIT, rel=1e-6)


def test_the_scale_is_not_guessed():
    cameras, times, poses = drive()
    with pytest.raises(NoScale, match="0 frames"):
        estimate_scale(cameras, times, [])
    with pytest.raises(NoScale, match="one segment"):
        estimate_scale(*drive(segments=(0,) * 7 + (1,) * 7))
    with pytest.raises(NoScale, match=r"moved by 1\.75 m"):
        estimate_scale(cameras, times, poses, ScaleSettings(min_way_m=2.0))
    with pytest.raises(NoScale, match="uncertain"):
        estimate_scale(cameras, times, poses, ScaleSettings(max_std=1e-5))
    for pose in poses:
        pose.status = "lost"
    with pytest.raises(NoScale):
        estimate_scale(cameras, times, poses)
