"""Frames one after the other: tracking, getting lost and found again, motion within a revolution."""

import numpy as np
import pytest

from streetscan.errors import BadInput
from streetscan.frames import LidarFrame
from streetscan.geometry import transform
from streetscan.localization.drive import DriveSettings, localize_drive, spread_frames
from streetscan.localization.localizer import Location
from streetscan.localization.starts import Starts

N, SPEED = 12, 10.0


def true_pose(i: int) -> np.ndarray:
    return transform([i * 0.1 * SPEED, 0, 1.8])


class Oracle:
    """Finds the true pose of a frame when the window reaches it; `blind` frames are not found. Keeps what it was asked."""

    def __init__(self, blind=()):
        self.blind, self.asked, self.n = set(blind), [], 0

    def locate(self, points, start):
        i, self.n = self.n, self.n + 1
        self.asked.append((points, start))
        reach = 12.0 if start.window is None else start.window.shift_m
        T = true_pose(i)
        if i in self.blind or np.abs(start.xy_m - T[:2, 3]).max() > reach:
            return Location("ambiguous")
        return Location("ok", T, T.copy())


def frames(n=N, with_offsets=True):
    points = np.array([[5.0, 5.0, 0.0], [5, -5, 0]], np.float32)
    offsets = np.array([-0.025, 0.025], np.float32) if with_offsets else None
    return [(i, LidarFrame(round((1e9 + 0.1 * i) * 1e9), points.copy(), time_offset_s=offsets)) for i in range(n)]


def starts(n=N, error_m=4.0, known=True):
    xy = np.array([true_pose(i)[:2, 3] + error_m for i in range(n)])
    nothing = np.full(n, np.nan)
    return Starts(xy if known else np.full((n, 2), np.nan), nothing.copy() if not known else np.zeros(n), nothing.copy(), nothing.copy())


def run(oracle, mode, given=None, **settings):
    return list(localize_drive(frames(), given or starts(), oracle, DriveSettings(mode=mode, **settings)))


def test_every_frame_from_gps():
    oracle = Oracle()
    rows = run(oracle, "gps")
    assert [r.location.status for r in rows] == ["ok"] * N
    assert all(start.window is None for _, start in oracle.asked)


def test_every_second_frame_from_the_third_on():
    rows = list(localize_drive(frames(), starts(), Oracle(blind=range(N)), DriveSettings(every=2, first=3)))
    assert [r.index for r in rows] == [3, 5, 7, 9, 11]


def test_some_frames_evenly_over_the_drive():
    rows = list(localize_drive(frames(), starts(), Oracle(blind=range(N)), DriveSettings(n_frames=4)))
    assert [r.index for r in rows] == [0, 3, 7, 11]
    rows = list(localize_drive(frames(), starts(), Oracle(blind=range(N)), DriveSettings(n_frames=2, first=1, every=3)))
    assert [r.index for r in rows] == [1, 10]
    assert spread_frames([4, 5], 25) == [4, 5]
    assert spread_frames([], 25) == []


def test_tracking_predicts_with_the_motion():
    oracle = Oracle()
    run(oracle, "tracking")
    for i, (_, start) in enumerate(oracle.asked[2:], start=2):
        assert start.window.shift_m == 3
        assert np.allclose(start.xy_m, true_pose(i)[:2, 3], atol=1e-6)


def test_a_lost_track_is_found_again_from_gps():
    oracle = Oracle(blind=[4, 5, 6])
    rows = run(oracle, "tracking")
    statuses = [r.location.status for r in rows]
    assert statuses == ["ok"] * 4 + ["ambiguous"] * 3 + ["ok"] * 5
    windows = [None if s.window is None else s.window.shift_m for _, s in oracle.asked]
    assert windows[4:7] == [3, 6, 9]
    assert windows[7] is None


def test_a_lost_track_without_gps_searches_around_the_last_pose():
    oracle = Oracle(blind=[4, 5, 6])
    given = starts()
    given.xy_m[1:] = np.nan
    rows = run(oracle, "tracking", given)
    assert rows[7].location.status == "ok"
    assert np.isnan(oracle.asked[7][1].yaw_rad)


def test_without_gps_and_track_there_is_no_start():
    rows = run(Oracle(), "gps", starts(known=False))
    assert {r.location.status for r in rows} == {"no_start"}


def test_no_guess_has_no_heading_and_a_wide_window():
    oracle = Oracle()
    run(oracle, "none")
    assert all(np.isnan(s.yaw_rad) and s.window.turn_deg == 180 for _, s in oracle.asked)


def test_points_are_freed_of_the_motion_once_it_is_known():
    oracle = Oracle()
    run(oracle, "gps")
    raw = frames()[0][1].points
    assert np.array_equal(oracle.asked[0][0], raw)
    # 10 m/s for 25 ms: a quarter of a metre backwards before the stamp, forwards after it.
    assert np.allclose(oracle.asked[5][0][:, 0] - raw[:, 0], [-0.25, 0.25], atol=1e-3)
    given = starts()
    given.speed_mps[:] = SPEED
    oracle = Oracle()
    run(oracle, "gps", given)
    assert np.allclose(oracle.asked[0][0][:, 0] - raw[:, 0], [-0.25, 0.25], atol=1e-3)
    oracle = Oracle()
    run(oracle, "gps", given, is_deskewed=False)
    assert np.array_equal(oracle.asked[5][0], raw)


def test_an_unknown_mode_is_refused():
    with pytest.raises(BadInput, match="choose one of gps"):
        DriveSettings(mode="guess")
