"""Frames of a drive whose trajectory is known, as one map."""

import numpy as np

from streetscan import geometry
from streetscan.drive_maps import place_frames
from streetscan.frames import LidarFrame

# A wall of the map, seen while the sensor drives along x at 10 m/s.
WALL = np.c_[np.linspace(0, 20, 201), np.full(201, 8.0), np.full(201, 1.0)]
TIMES_S = 1e9 + np.arange(5) * 0.1


def pose(time_s: float) -> np.ndarray:
    return geometry.transform((10 * (time_s - TIMES_S[0]), 0, 2), (0, 0, 0.3))


def frame(stamp_s: float) -> LidarFrame:
    """The wall, each point in the sensor's frame at its own firing."""
    offsets = np.linspace(-0.05, 0.05, len(WALL))
    points = [geometry.apply(geometry.invert(pose(stamp_s + t)), p[None])[0] for t, p in zip(offsets, WALL, strict=True)]
    intensity = np.full(len(WALL), 0.5, np.float32)
    return LidarFrame(round(stamp_s * 1e9), np.array(points, np.float32), intensity, time_offset_s=offsets.astype(np.float32))


def test_a_wall_seen_on_the_move_is_straight_and_where_it_stands():
    poses = np.stack([pose(t) for t in TIMES_S])
    clouds = list(place_frames([frame(t) for t in TIMES_S], TIMES_S, poses))
    assert len(clouds) == 5
    for cloud in clouds:
        assert np.abs(cloud.points[:, 1:] - [8.0, 1.0]).max() < 2e-3
        assert set(cloud.fields["intensity"]) == {32768}
    np.testing.assert_allclose(clouds[2].points, WALL, atol=2e-3)
    # What was fired before the first pose or after the last is left out.
    assert len(clouds[0]) < len(WALL)
    np.testing.assert_allclose(np.ptp(clouds[2].fields["time_s"]), 0.1, atol=1e-6)


def test_frames_without_a_pose_and_points_out_of_range_are_left_out():
    poses = np.stack([pose(t) for t in TIMES_S])
    poses[3:] = np.nan
    clouds = list(place_frames([frame(t) for t in TIMES_S], TIMES_S, poses, max_range_m=9.0))
    assert len(clouds) == 3
    # The sensor stands at x = 0, 1 and 2, 8 m from the wall: within 9 m are 4.0 m of it to either side.
    for i, cloud in enumerate(clouds[1:], start=1):
        assert 0 < len(cloud) < len(WALL)
        assert np.abs(cloud.points[:, 0] - i).max() < 4.6
