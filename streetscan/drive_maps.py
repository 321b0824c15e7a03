"""A drive's frames as one map, put where known poses say."""

from collections.abc import Iterable, Iterator

import numpy as np

from streetscan import geometry
from streetscan.clouds import PointCloud
from streetscan.frames import LidarFrame
from streetscan.sweeps import deskew_along


def place_frames(
    frames: Iterable[LidarFrame], pose_times_s: np.ndarray, T_map_lidar: np.ndarray, min_range_m: float = 2.5, max_range_m: float = 60.0
) -> Iterator[PointCloud]:
    """The frames in the frame `map`, each de-skewed along the trajectory.

    Args:
        frames: of the drive.
        pose_times_s: (K,) seconds, increasing.
        T_map_lidar: (K, 4, 4); NaN where unknown.
        min_range_m, max_range_m: points nearer (the vehicle itself) or farther than this are left out.
    Yields:
        clouds with `time_s` and, where the frame has it, `intensity` 0..65535; points fired where no pose is known are left out.
    """
    known = np.isfinite(T_map_lidar).all(axis=(1, 2))
    pose_times_s, T_map_lidar = pose_times_s[known], T_map_lidar[known]
    for frame in frames:
        time_s = frame.time_ns / 1e9
        T_map_stamp = geometry.interpolate_poses(np.array([time_s]), pose_times_s, T_map_lidar)[0]
        if len(frame) == 0 or not np.isfinite(T_map_stamp).all():
            continue
        offsets = np.zeros(len(frame)) if frame.time_offset_s is None else frame.time_offset_s
        points = geometry.apply(T_map_stamp, deskew_along(frame.points, offsets, time_s, pose_times_s, T_map_lidar))
        ranges = np.linalg.norm(frame.points, axis=1)
        kept = np.isfinite(points).all(axis=1) & (ranges > min_range_m) & (ranges < max_range_m)
        fields = {"time_s": time_s + offsets[kept].astype(np.float64)}
        if frame.intensity is not None:
            fields["intensity"] = np.round(65535 * np.clip(frame.intensity[kept], 0, 1)).astype(np.uint16)
        yield PointCloud(points[kept], fields)
