"""Ground of one frame: slopes, car roofs, kerbs, and frames that have none."""

import numpy as np
import pytest
from street_frames import SENSOR_HEIGHT_M, pose, scan, street_boxes

from streetscan.errors import BadInput
from streetscan.geometry import apply, transform
from streetscan.localization.ground import GroundSettings, find_ground


@pytest.fixture(scope="module")
def frame():
    """Points of a frame in the street of boxes, frame `lidar`."""
    return scan(pose(3.0), street_boxes(), np.random.default_rng(0))[0]


def test_points_on_the_road_are_ground_and_points_on_things_are_not(frame):
    ground = find_ground(frame)
    truly_above = ground.points[:, 2] + SENSOR_HEIGHT_M > 0.15
    assert ground.has_plane
    assert np.mean((ground.heights_m > 0.1) == truly_above) > 0.99
    assert np.allclose(ground.plane, [0, 0, -SENSOR_HEIGHT_M], atol=0.01)


def test_roofs_of_cars_are_no_ground(frame):
    ground = find_ground(frame)
    heights = ground.points[:, 2] + SENSOR_HEIGHT_M
    roof = np.abs(heights - 1.45) < 0.03
    assert roof.sum() > 100
    assert (ground.heights_m[roof] > 1).mean() > 0.98


@pytest.mark.parametrize("slope", [-0.08, 0.08])
def test_a_street_that_climbs_is_followed(frame, slope):
    tilted = apply(transform(rpy_rad=(0, np.arctan(slope), 0)), frame)
    ground = find_ground(tilted)
    level = find_ground(frame)
    assert np.isclose(ground.plane[0], -slope, atol=0.01)
    both, a, b = np.intersect1d(ground.rows, level.rows, return_indices=True)
    assert len(both) > 0.98 * len(level.rows)
    assert np.mean((ground.heights_m[a] > 0.2) == (level.heights_m[b] > 0.2)) > 0.97


def test_points_out_of_range_and_nan_are_left_out(frame):
    broken = frame.copy()
    broken[::7] = np.nan
    ground = find_ground(broken, GroundSettings(range_m=20))
    assert np.hypot(*ground.points[:, :2].T).max() < 20
    assert np.hypot(*ground.points[:, :2].T).min() >= 2
    assert (ground.points == broken[ground.rows]).all()


@pytest.mark.parametrize(
    "points",
    [np.empty((0, 3)), np.full((50, 3), np.nan), np.full((50, 3), np.inf), np.array([[5.0, 0, -1]])],
    ids=["no point", "NaN", "infinite", "one point"],
)
def test_a_frame_without_ground_says_so(points):
    ground = find_ground(points)
    assert not ground.has_plane
    assert np.isnan(ground.heights_m).all()


def test_ground_only():
    rng = np.random.default_rng(1)
    points = np.c_[rng.uniform(-25, 25, (20_000, 2)), rng.normal(-1.7, 0.01, 20_000)]
    ground = find_ground(points)
    assert np.isclose(ground.plane[2], -1.7, atol=0.01)
    assert (ground.heights_m < 0.1).all()


def test_another_shape_is_refused():
    with pytest.raises(BadInput, match="shape"):
        find_ground(np.zeros((10, 4)))
    with pytest.raises(BadInput, match="range_m"):
        GroundSettings(range_m=1.0)
