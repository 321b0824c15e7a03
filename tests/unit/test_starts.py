"""Starts from GPS: position, heading, motion, gaps, lever arm; starts spread over the window."""

import numpy as np
import pytest

from streetscan.errors import BadInput
from streetscan.frames import GpsFix, Mounting
from streetscan.geodesy import grid_turn, unproject
from streetscan.geometry import transform
from streetscan.localization.starts import even_starts, read_poses_on_map, starts_of_fixes
from streetscan.localization.voting import Window
from streetscan.registration.odometry import FramePose
from streetscan.registration.pose_tables import tabulate_poses

CRS = "EPSG:32632"
EAST, NORTH = 456_000.0, 5_428_000.0
NS = 1_000_000_000


def fixes(times_s, speed_mps=8.0, yaw_rad=0.3, with_heading=True):
    """Of a straight drive at an even speed, without errors."""
    way = np.asarray(times_s)[:, None] * speed_mps * np.array([np.cos(yaw_rad), np.sin(yaw_rad)])
    latitude, longitude = unproject(way + [EAST, NORTH], CRS)
    headings = np.pi / 2 - (yaw_rad - grid_turn(latitude, longitude, CRS))
    return [
        GpsFix(round(t * NS), float(a), float(b), float("nan"), heading_rad=float(h) if with_heading else None)
        for t, a, b, h in zip(times_s, latitude, longitude, headings, strict=True)
    ]


@pytest.mark.parametrize("with_heading", [True, False])
def test_position_heading_and_motion(with_heading):
    frames = np.arange(10, 60) * 0.1
    starts = starts_of_fixes(fixes(np.arange(0, 7, 0.2), with_heading=with_heading), frames, CRS)
    expected = frames[:, None] * 8.0 * np.array([np.cos(0.3), np.sin(0.3)]) + [EAST, NORTH]
    assert np.allclose(starts.xy_m, expected, atol=0.01)
    assert np.allclose(starts.yaw_rad, 0.3, atol=1e-3)
    assert np.allclose(starts.speed_mps, 8.0, atol=0.01)
    if with_heading:
        assert np.allclose(starts.turn_rate_radps, 0, atol=1e-3)


def test_the_lidar_is_not_where_the_antenna_is():
    mountings = [Mounting("vehicle", "gps", transform([0.3, 0, 1.5])), Mounting("vehicle", "lidar", transform([0.8, 0.2, 1.8]))]
    times = np.arange(0, 4, 0.2)
    bare, moved = (starts_of_fixes(fixes(times), np.array([2.0]), CRS, m) for m in ((), mountings))
    expected = [0.5 * np.cos(0.3) - 0.2 * np.sin(0.3), 0.5 * np.sin(0.3) + 0.2 * np.cos(0.3)]
    assert np.allclose(moved.xy_m - bare.xy_m, expected, atol=1e-3)


def test_a_long_gap_leaves_frames_without_a_start():
    times = np.concatenate([np.arange(0, 2, 0.2), np.arange(8, 10, 0.2)])
    starts = starts_of_fixes(fixes(times), np.array([1.0, 2.5, 5.0, 9.0]), CRS)
    assert np.isfinite(starts.xy_m).all(axis=1).tolist() == [True, True, False, True]


def test_a_standing_vehicle_without_a_compass_has_no_heading():
    starts = starts_of_fixes(fixes(np.arange(0, 4, 0.2), speed_mps=0.0, with_heading=False), np.array([2.0]), CRS)
    assert np.isnan(starts.yaw_rad).all()
    assert np.isfinite(starts.xy_m).all()


def test_no_fix_and_no_reference_system():
    assert np.isnan(starts_of_fixes([], np.zeros(3), None).xy_m).all()
    with pytest.raises(BadInput, match="no reference system"):
        starts_of_fixes(fixes([0.0]), np.zeros(1), None)
    broken = [GpsFix(0, float("nan"), 8.0, 0.0)]
    assert np.isnan(starts_of_fixes(broken, np.zeros(1), CRS).xy_m).all()


def test_even_starts_fill_the_window_and_stay_inside():
    poses = np.tile(transform([EAST, NORTH, 115], [0, 0, 2.0]), (200, 1, 1))
    starts = even_starts(np.arange(200) / 10, poses, Window(), 1)
    turns, (c, s) = np.degrees(starts.yaw_rad - 2.0), (np.cos(starts.yaw_rad), np.sin(starts.yaw_rad))
    east, north = (np.array([EAST, NORTH]) - starts.xy_m).T
    offsets = np.c_[c * east + s * north, c * north - s * east]
    assert 11 < np.abs(offsets).max() < 12
    assert 40 < np.abs(turns).max() < 45
    # As many starts in each quarter of the window.
    quarters = np.bincount((offsets > 0) @ [1, 2])
    assert np.ptp(quarters) < 15
    assert np.array_equal(starts.xy_m, even_starts(np.arange(200) / 10, poses, Window(), 1).xy_m)


def test_even_starts_know_the_motion_of_the_poses():
    poses = np.array([transform([EAST + 0.8 * i, NORTH, 115], [0, 0, 0.01 * i]) for i in range(5)])
    poses[3] = np.nan
    starts = even_starts(np.arange(5) / 10, poses, Window(), 1)
    assert np.allclose(starts.speed_mps[1:3], 8.0, atol=0.01)
    assert np.allclose(starts.turn_rate_radps[1:3], 0.1, atol=1e-3)
    assert np.isnan(starts.speed_mps[[0, 3, 4]]).all()


def test_poses_on_the_street_of_a_drives_own_frames_are_those_they_were_registered_at(tmp_path):
    rows = [FramePose(i, i / 10, "ok" if i != 12 else "too_few_points", int(i > 13)) for i in range(10, 16)]
    for row in rows:
        if row.is_posed:
            row.T_segment_lidar = transform([row.index, 0, 0])
    tabulate_poses(rows).to_csv(tmp_path / "poses.csv", index=False)
    times_s, poses = read_poses_on_map(tmp_path / "poses.csv")
    assert len(poses) == 16
    known = np.flatnonzero(np.isfinite(poses).all(axis=(1, 2)))
    # Frame 12 was not registered, and the frames after 13 are of another segment.
    assert known.tolist() == [10, 11, 13]
    assert np.allclose(poses[13, :3, 3], [13, 0, 0])
    assert times_s[11] == 1.1
