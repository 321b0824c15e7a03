"""The chain of poses as CSV: the columns of streetscan.io.trajectories, and what registration knows beyond them."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from streetscan.errors import BadInput
from streetscan.geometry import quaternion_of_transform, transform_of_quaternion
from streetscan.io.files import find_file
from streetscan.io.trajectories import write_tum
from streetscan.registration.odometry import FramePose

_POSE = ("x_m", "y_m", "z_m", "qx", "qy", "qz", "qw")
_MOTION = ("vx_mps", "vy_mps", "vz_mps", "wx_radps", "wy_radps", "wz_radps")
_SIGMAS = ("std_x_m", "std_y_m", "std_z_m", "std_roll_rad", "std_pitch_rad", "std_yaw_rad")
COLUMNS = ("frame", "time_s", "status", *_POSE, "segment", "n_points", "overlap", "score", "n_iterations", *_MOTION, *_SIGMAS)


def tabulate_poses(poses: Sequence[FramePose]) -> pd.DataFrame:
    """One row per frame with the columns of `COLUMNS`; the pose is that of the lidar in the frame of its segment's first frame."""
    rows = []
    for p in poses:
        pose = [*p.T_segment_lidar[:3, 3], *(quaternion_of_transform(p.T_segment_lidar) if p.is_posed else np.full(4, np.nan))]
        sigmas = np.sqrt(np.diag(p.covariance))
        numbers = (p.segment, p.n_points, p.overlap, p.score, p.n_iterations)
        rows.append((p.index, f"{p.time_s:.9f}", p.status, *pose, *numbers, *p.velocity_mps, *p.turn_rate_radps, *sigmas))
    return pd.DataFrame(rows, columns=COLUMNS)


def read_pose_table(path: str | Path) -> list[FramePose]:
    """The rows of a table `tabulate_poses` made; covariances are diagonal.

    Raises:
        BadInput: no such file, or one without these columns.
    """
    try:
        table = pd.read_csv(find_file(path), dtype={"status": str})
        columns = [table[list(names)].to_numpy(np.float64) for names in (_POSE, _MOTION, _SIGMAS)]
        plain = [table[n].to_numpy() for n in ("frame", "time_s", "status", "segment", "n_points", "overlap", "score", "n_iterations")]
    except (ValueError, KeyError, UnicodeDecodeError, pd.errors.ParserError) as error:
        raise BadInput(path, f"no table of registered frames ({error})", "run register_frames again") from error
    poses = []
    for (index, time_s, status, segment, n_points, overlap, score, n_iterations), pose, motion, sigmas in zip(
        zip(*plain, strict=True), *columns, strict=True
    ):
        row = FramePose(int(index), float(time_s), str(status), int(segment))
        if row.is_posed:
            row.T_segment_lidar = transform_of_quaternion(pose[:3], pose[3:])
        row.velocity_mps, row.turn_rate_radps, row.covariance = motion[:3], motion[3:], np.diag(sigmas**2)
        row.n_points, row.overlap, row.score, row.n_iterations = int(n_points), float(overlap), float(score), int(n_iterations)
        poses.append(row)
    return poses


def write_tum_segment(path: str | Path, poses: Sequence[FramePose]) -> None:
    """Write the longest segment as TUM (`time x y z qx qy qz qw`); a file without rows when nothing was registered."""
    posed = [p for p in poses if p.is_posed]
    longest = np.bincount([p.segment for p in posed]).argmax() if posed else -1
    rows = [p for p in posed if p.segment == longest]
    write_tum(path, np.array([p.time_s for p in rows]), np.array([p.T_segment_lidar for p in rows]).reshape(-1, 4, 4))
