"""Registration by objects (Nagy 2020, 3.4.2): the coarse alignment is within half a metre, the NDT within centimetres."""

import numpy as np
import pytest
from street_frames import drive, scan
from street_maps import street

from streetscan.geometry import invert, transform
from streetscan.registration.ndt import NdtSettings
from streetscan.registration.object_target import ObjectTarget
from streetscan.registration.odometry import Frame, OdometrySettings, register_frames


@pytest.fixture(scope="module")
def pair():
    """Two frames 1 m and 2 degrees apart, and the motion between them."""
    rng, boxes = np.random.default_rng(0), street()[0]
    poses = [transform([0.0, 0, 1.8]), transform([1.0, 0.1, 1.8], (0, 0, np.radians(2)))]
    points = [scan(T, boxes, rng, n_beams=64, n_azimuths=1200)[0].astype(np.float64) for T in poses]
    return points, invert(poses[0]) @ poses[1]


def test_the_vote_is_within_half_a_metre_and_the_ndt_within_centimetres(pair):
    (target_points, source_points), T = pair
    target = ObjectTarget(NdtSettings(), 0.3)
    target.add(target_points, np.eye(4))
    # Predicted as if the vehicle stood still.
    found = target.fit(source_points, np.eye(4))
    assert np.linalg.norm((target.T_coarse - T)[:3, 3]) < 0.5
    assert np.linalg.norm((found.T_target_source - T)[:3, 3]) < 0.08
    assert found.overlap > 0.25


def test_a_target_elsewhere_gives_the_same_motion(pair):
    (target_points, source_points), T = pair
    T_street = transform([140.0, -60.0, 3.0], (0, 0, 1.1))
    target = ObjectTarget(NdtSettings(), 0.3)
    target.add(target_points, T_street)
    found = target.fit(source_points, T_street)
    assert np.linalg.norm((invert(T_street) @ found.T_target_source - T)[:3, 3]) < 0.08


def test_state_and_forgetting(pair):
    (target_points, source_points), _ = pair
    target, again = ObjectTarget(NdtSettings(), 0.3), ObjectTarget(NdtSettings(), 0.3)
    target.add(target_points, np.eye(4))
    again.restore(target.state())
    a, b = (t.fit(source_points, np.eye(4)).T_target_source for t in (target, again))
    assert np.array_equal(a, b)
    target.drop_beyond(np.zeros(3), 15.0)
    assert 0 < len(target.state()["starts"]) < len(again.state()["starts"])
    target.clear()
    assert target.is_empty
    assert np.array_equal(target.fit(source_points, np.eye(4)).T_target_source, np.eye(4))


def test_a_drive_comes_back():
    points, poses = drive(8, speed_mps=8.0, n_beams=64, n_azimuths=1000)
    settings = OdometrySettings(method="objects", target="previous", classes=())
    rows = list(register_frames((Frame(i, 0.1 * i, p) for i, p in enumerate(points)), settings))
    assert [r.status for r in rows] == ["start"] + ["ok"] * 7
    truth = np.array([invert(poses[0]) @ T for T in poses])
    assert max(np.linalg.norm(r.T_segment_lidar[:3, 3] - T[:3, 3]) for r, T in zip(rows, truth, strict=True)) < 0.3
