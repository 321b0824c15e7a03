"""The way of the vehicle as lidar and camera see it."""

import numpy as np
import pytest
from toy_calibration import SPEED_MPS, START_NS, T_CAMERA_LIDAR, lidar_poses, toy_keyframe, true_stamp

from streetscan.calibration.alignment import IcpSettings, prepare_target, refine_alignment
from streetscan.calibration.ways import TURN_OFF_PER_TURN, lidar_way, make_way
from streetscan.geometry import apply, invert, rotation_angle, transform, transform_of_rotation

STAMP_NS = START_NS + 1_000_000_000
IMAGES_NS = [STAMP_NS + 100_000_000 * i - 350_000_000 for i in range(8)]


def turning_poses(rate_rad_s: float) -> list:
    """A lidar that turns to the left at its speed, in a circle."""
    poses = lidar_poses()
    for pose in poses:
        angle = rate_rad_s * (pose.time_s - START_NS / 1e9)
        place = SPEED_MPS / rate_rad_s * np.array([np.sin(angle), 1 - np.cos(angle), 0])
        pose.T_segment_lidar = transform(place, (0, 0, angle))
    return poses


def way_of(poses, T_camera_lidar=T_CAMERA_LIDAR, std_s=0.0):
    """The way of a camera on the vehicle, images seen from the one in the middle, and the lidar at its stamp in its frame."""
    lidar = lidar_way(poses, STAMP_NS, IMAGES_NS, IMAGES_NS[3])
    at_images = [lidar_way(poses, STAMP_NS, [t, t], IMAGES_NS[3]).T_stamp_first for t in IMAGES_NS]
    cameras = [lidar.T_stamp_image @ invert(T_camera_lidar)] + [T @ invert(T_camera_lidar) for T in at_images]
    T_sfm_stamp = invert(cameras[0])
    return make_way(lidar, np.array([(T_sfm_stamp @ T)[:3, 3] for T in cameras]), 0.005, std_s), T_sfm_stamp


@pytest.mark.parametrize("poses", [lidar_poses(), turning_poses(0.4)], ids=["straight", "turning"])
def test_sensors_on_one_vehicle_go_one_way(poses):
    way, T_sfm_stamp = way_of(poses)
    assert abs(way.turn_off(T_sfm_stamp)) < 1e-4


def test_a_wrong_yaw_shows_and_a_wrong_place_does_not():
    way, T = way_of(lidar_poses())
    for yaw in (0.02, -0.3):
        turned = transform_of_rotation(transform(rpy_rad=(0, yaw, 0))[:3, :3]) @ T
        assert way.turn_off(turned) == pytest.approx(yaw, rel=0.02)
        assert TURN_OFF_PER_TURN @ [0, yaw, 0] == yaw
    assert way.turn_off(transform([2.0, 0, 5.0]) @ T) == pytest.approx(0, abs=1e-9)


def test_a_camera_that_believes_to_go_to_the_right_is_put_right():
    way, T = way_of(lidar_poses())
    assert way.straightened(-0.1).turn_off(T) == pytest.approx(-0.1)


def test_in_a_turn_times_count():
    straight, _ = way_of(lidar_poses(), std_s=0.02)
    turning, _ = way_of(turning_poses(0.4), std_s=0.02)
    assert straight.std_rad == pytest.approx(0.005 / (0.7 * SPEED_MPS), rel=1e-3)
    assert turning.std_rad == pytest.approx(np.hypot(0.005 / (0.7 * SPEED_MPS), 0.02 * 0.4), rel=0.02)


def test_a_way_that_is_not_known_is_none():
    assert lidar_way([], STAMP_NS, IMAGES_NS, IMAGES_NS[0]) is None
    assert lidar_way(lidar_poses(), STAMP_NS, IMAGES_NS[:1], IMAGES_NS[0]) is None
    parted = lidar_poses()
    for pose in parted[11:]:
        pose.segment = 1
    assert lidar_way(parted, STAMP_NS, IMAGES_NS, IMAGES_NS[0]) is None
    # A break before the first image parts nothing; poses before it are of another frame.
    parted = lidar_poses()
    for pose in parted[:7]:
        pose.segment, pose.T_segment_lidar = 1, transform([0, 50, 0]) @ pose.T_segment_lidar
    later = [t + 300_000_000 for t in IMAGES_NS]
    found = lidar_way(parted, STAMP_NS + 300_000_000, later, later[0])
    np.testing.assert_allclose(found.of(np.zeros(3)), [0.7 * SPEED_MPS, 0, 0], atol=1e-6)
    lidar = lidar_way(lidar_poses(), STAMP_NS, IMAGES_NS, IMAGES_NS[0])
    assert make_way(lidar, np.array([[0, 0, 0], [0, 0, 0], [0, 0, 0.2]]), 0.005, 0.03) is None
    assert make_way(lidar, np.zeros((9, 3)), 0.005, 0.03) is None
    assert make_way(None, np.eye(3), 0.005, 0.03) is None


@pytest.mark.parametrize("is_scaled", [True, False])
def test_a_road_alone_takes_its_yaw_from_the_way(is_scaled):
    # An even road holds height, roll and pitch; of the yaw it tells nothing.
    rng = np.random.default_rng(0)
    road = np.c_[rng.uniform(2, 30, 20_000), rng.uniform(-8, 8, 20_000), np.full(20_000, -1.7)]
    way, T = way_of(lidar_poses())
    cameras = np.array([np.zeros(3), *np.outer(np.arange(8), way.bearing_sfm / 7)])
    settings = IcpSettings(is_scaled=is_scaled)
    start = transform_of_rotation(transform(rpy_rad=(0, np.radians(0.8), 0))[:3, :3]) @ T
    found = {}
    for name, own in (("without", None), ("with", way)):
        target = prepare_target(apply(T, road), cameras, 500.0, settings, own)
        found[name] = refine_alignment(road[::3], target, start, settings)
    off = {name: np.degrees(rotation_angle(invert(T) @ f.T_sfm_lidar)) for name, f in found.items()}
    assert off["without"] > 0.5
    assert off["with"] < 0.1
    yaw_std = {name: np.degrees(np.sqrt(f.covariance[1, 1])) for name, f in found.items()}
    assert yaw_std["with"] < 0.3 < yaw_std["without"]


def test_the_toy_goes_one_way():
    toy = toy_keyframe()
    assert make_way(toy.clouds.way, toy.clouds.cameras_sfm, 0.005, 0.03).turn_off(true_stamp()) == pytest.approx(0, abs=1e-3)
