"""Frames of the street of boxes on its map: poses, verdicts, large coordinates, and everything that can be wrong."""

import numpy as np
import pytest
from street_frames import SENSOR_HEIGHT_M, pose, scan, street_boxes
from street_maps import UTM_SHIFT, make_street_reference, street

from streetscan.classes import COLUMN, FACADE
from streetscan.geometry import rotation_angle, transform
from streetscan.localization.localizer import LocalizerSettings, Start, VotingLocalizer
from streetscan.localization.voting import Window


@pytest.fixture(scope="module")
def reference():
    return make_street_reference()


def in_map(x: float, y: float = 0.0, yaw: float = 0.0) -> np.ndarray:
    T = pose(x, y, yaw)
    T[:3, 3] += UTM_SHIFT
    return T


def seen_from(x: float, y: float = 0.0, yaw: float = 0.0, seed: int = 0) -> np.ndarray:
    return scan(pose(x, y, yaw), street()[0], np.random.default_rng(seed), n_beams=64, n_azimuths=1200)[0]


def error(found: np.ndarray, true: np.ndarray) -> tuple[float, float]:
    difference = np.linalg.inv(true) @ found
    return float(np.linalg.norm(difference[:3, 3])), float(np.degrees(rotation_angle(difference)))


@pytest.mark.parametrize("n_keypoints", [1, 4, 8, 16])
def test_the_vote_alone_finds_a_frame(reference, n_keypoints):
    localizer = VotingLocalizer(reference, LocalizerSettings(n_keypoints=n_keypoints, is_refined=False))
    T = in_map(4.0, 1.0, 0.05)
    found = localizer.locate(seen_from(4.0, 1.0, 0.05), Start(T[:2, 3] + [5.0, -6.0], 0.05 + np.radians(9)))
    metres, degrees = error(found.T_map_lidar, T)
    assert metres < 0.3
    assert degrees < 1.0
    assert found.n_inliers >= 3
    assert np.array_equal(found.T_map_lidar, found.T_vote)


@pytest.mark.parametrize(("x", "shift", "turn_deg"), [(-12.0, (6, -6), 20), (3.0, (-8, 3), -35), (14.0, (0.5, 0.2), 1)])
def test_a_refined_pose_is_within_centimetres_and_is_believed(reference, x, shift, turn_deg):
    T = in_map(x, -0.5, -0.02)
    found = VotingLocalizer(reference).locate(seen_from(x, -0.5, -0.02), Start(T[:2, 3] + shift, -0.02 + np.radians(turn_deg)))
    metres, degrees = error(found.T_map_lidar, T)
    assert found.status == "ok"
    assert metres < 0.08
    assert degrees < 0.2
    assert found.is_refined
    assert found.overlap > found.overlap_start
    assert (np.linalg.eigvalsh(found.covariance) > 0).all()


def test_a_shift_of_utm_size_changes_nothing():
    near, far = make_street_reference(np.array([0.3, -0.2, 5.0])), make_street_reference(UTM_SHIFT + [0.3, -0.2, 5.0])
    points, start = seen_from(2.0), np.array([5.0, -4.0])
    a = VotingLocalizer(near).locate(points, Start(start, 0.1))
    b = VotingLocalizer(far).locate(points, Start(start + UTM_SHIFT[:2], 0.1))
    assert a.status == b.status == "ok"
    assert np.allclose(a.T_map_lidar[:3, 3] + UTM_SHIFT, b.T_map_lidar[:3, 3], atol=0.01)
    assert np.allclose(a.T_map_lidar[:3, :3], b.T_map_lidar[:3, :3], atol=1e-3)


def test_a_start_without_heading_and_fifty_metres_off_is_found(reference):
    T = in_map(5.0, 0.0, 2.5)
    found = VotingLocalizer(reference).locate(seen_from(5.0, 0.0, 2.5), Start(T[:2, 3] + [-38.0, 3.0]))
    metres, degrees = error(found.T_map_lidar, T)
    assert found.status == "ok"
    assert metres < 0.05
    assert degrees < 0.2


def test_every_bad_frame_has_a_status_and_no_pose(reference):
    localizer, start = VotingLocalizer(reference), Start(in_map(0)[:2, 3], 0.0)
    frames = {
        "no_points": np.empty((0, 3)),
        "no_points ": np.full((500, 3), np.nan),
        "no_ground": np.array([[5.0, 0, -1], [6, 0, 0], [0, 7, 3]]),
    }
    for name, points in frames.items():
        found = localizer.locate(points, start)
        assert found.status == name.strip()
        assert np.isnan(found.T_map_lidar).all()


def test_ground_only_is_not_localized(reference):
    rng = np.random.default_rng(1)
    points = np.c_[rng.uniform(-25, 25, (20_000, 2)), rng.normal(-SENSOR_HEIGHT_M, 0.01, 20_000)]
    found = VotingLocalizer(reference).locate(points, Start(in_map(0)[:2, 3], 0.0))
    assert found.status == "too_few_objects"


def test_nan_points_do_no_harm(reference):
    points = seen_from(4.0)
    points[::5] = np.nan
    T = in_map(4.0)
    found = VotingLocalizer(reference).locate(points, Start(T[:2, 3] + [3, 3], 0.1))
    assert found.status == "ok"
    assert error(found.T_map_lidar, T)[0] < 0.05


def test_a_start_a_kilometre_off_is_off_the_map(reference):
    found = VotingLocalizer(reference).locate(seen_from(0.0), Start(in_map(0)[:2, 3] + [1000.0, 0], 0.0))
    assert found.status == "off_map"
    assert np.isnan(found.T_map_lidar).all()


def test_another_street_is_not_found_on_this_map(reference):
    """The same kind of street built from other draws: its frames must not be believed."""
    other, rng = street_boxes(np.random.default_rng(77)), np.random.default_rng(0)
    believed = []
    for x in (-15.0, -5.0, 5.0, 15.0):
        points = scan(pose(x), other, rng, n_beams=64, n_azimuths=1200)[0]
        believed.append(VotingLocalizer(reference).locate(points, Start(in_map(x)[:2, 3] + [2, 3], 0.05)).status == "ok")
    assert not any(believed)


def test_a_row_of_equal_poles_is_ambiguous():
    """Poles four metres apart along a bare road: the place along the row cannot be told."""
    poles = np.array([(x, s * 6.0 - 0.1, 0, x + 0.2, s * 6.0 + 0.1, 5) for x in np.arange(-48, 60, 4.0) for s in (-1, 1)])
    reference = make_street_reference(things=(poles, np.full(len(poles), COLUMN, np.uint8)))
    points = scan(pose(0.0), poles, np.random.default_rng(0), n_beams=64, n_azimuths=1200)[0]
    found = VotingLocalizer(reference).locate(points, Start(in_map(0)[:2, 3] + [1.0, 0.5], 0.02))
    assert found.status == "ambiguous"


def test_no_landmark_in_range():
    boxes, labels = street()
    bare = make_street_reference(things=(boxes[labels == FACADE], labels[labels == FACADE]))
    assert len(bare.landmarks) == 0
    points = scan(pose(0.0), boxes[labels == FACADE], np.random.default_rng(0), n_beams=64, n_azimuths=1200)[0]
    start = Start(in_map(0)[:2, 3] + [2.0, 1.0], 0.02)
    objects_alone = VotingLocalizer(bare, LocalizerSettings(is_recovered=False)).locate(points, start)
    assert objects_alone.status == "too_few_objects"
    assert np.isnan(objects_alone.T_map_lidar).all()
    found = VotingLocalizer(bare).locate(points, start)
    # Walls alone tell the place, or it is not believed.
    assert found.status != "ok" or error(found.T_map_lidar, in_map(0))[0] < 0.1


def test_the_search_reaches_no_farther_than_its_window(reference):
    T = in_map(0.0)
    small = LocalizerSettings(window=Window(turn_deg=5, shift_m=2), is_recovered=False)
    found = VotingLocalizer(reference, small).locate(seen_from(0.0), Start(T[:2, 3] + [9.0, 0.0], 0.0))
    assert found.status != "ok"


def test_a_tilted_sensor_is_levelled(reference):
    T = in_map(4.0) @ transform(rpy_rad=np.radians([1.5, -2.0, 0]))
    points = seen_from(4.0) @ transform(rpy_rad=np.radians([1.5, -2.0, 0]))[:3, :3]
    found = VotingLocalizer(reference).locate(points.astype(np.float32), Start(T[:2, 3] + [3, -3], 0.1))
    assert found.status == "ok"
    assert error(found.T_map_lidar, T)[0] < 0.06
