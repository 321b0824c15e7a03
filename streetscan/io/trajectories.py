"""Trajectories as text: KITTI's twelve numbers, TUM (evo) and our CSV with one row per frame.

Quaternions are in the order x y z w.
"""

from pathlib import Path

import numpy as np
import pandas as pd

from streetscan import geometry
from streetscan.errors import BadInput
from streetscan.io.atomic import atomic_path
from streetscan.io.files import find_file, read_text

CSV_COLUMNS = ("frame", "time_s", "status", "x_m", "y_m", "z_m", "qx", "qy", "qz", "qw")


def read_kitti_poses(path: str | Path) -> np.ndarray:
    """Poses (K, 4, 4) of a KITTI file, one row of twelve numbers (3x4, row by row) per frame.

    Raises:
        BadInput: no such file, a row without twelve numbers, or a pose that is no rigid motion.
    """
    rows = _rows(path, 12)
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3] = rows.reshape(-1, 3, 4)
    return _checked(poses, path)


def write_kitti_poses(path: str | Path, poses: np.ndarray) -> None:
    """Write poses (K, 4, 4) as KITTI rows; an unknown pose (NaN) stays a row of `nan`, so the row is still the frame's number."""
    with atomic_path(path) as partial:
        np.savetxt(partial, np.asarray(poses, np.float64)[:, :3].reshape(-1, 12), fmt="%.9e")


def read_tum(path: str | Path) -> tuple[np.ndarray, np.ndarray]:
    """Times (K,) in seconds and poses (K, 4, 4) of a TUM file: `time x y z qx qy qz qw` per row, `#` comments.

    Raises:
        BadInput: no such file, a row without eight numbers, a quaternion of length zero, or times that do not increase.
    """
    rows = _rows(path, 8)
    lengths = np.linalg.norm(rows[:, 4:], axis=1)
    if (lengths < 1e-6).any():
        raise BadInput(path, f"the quaternion of row {int(np.argmin(lengths)) + 1} has length zero", "write it as x y z w")
    if (np.diff(rows[:, 0]) <= 0).any():
        raise BadInput(path, f"time does not increase after row {int(np.argmax(np.diff(rows[:, 0]) <= 0)) + 1}", "sort it by time")
    return rows[:, 0], geometry.transform_of_quaternion(rows[:, 1:4], rows[:, 4:])


def write_tum(path: str | Path, times_s: np.ndarray, poses: np.ndarray) -> None:
    """Write the known poses (K, 4, 4) with their times (K,) as TUM; an unknown pose (NaN) has no place there and is left out."""
    poses, times_s = np.asarray(poses, np.float64), np.asarray(times_s, np.float64)
    known = np.isfinite(poses).all(axis=(1, 2))
    rows = np.c_[times_s[known], poses[known, :3, 3], geometry.quaternion_of_transform(poses[known])]
    with atomic_path(path) as partial:
        np.savetxt(partial, rows, fmt=["%.9f"] + ["%.6f"] * 3 + ["%.9f"] * 4)


def write_poses_csv(path: str | Path, frames: np.ndarray, times_s: np.ndarray, poses: np.ndarray) -> None:
    """Write one row per frame: number, time, status (`ok`, or `unknown` with NaN), position in metres, quaternion.

    Args:
        path: the file.
        frames: (K,) frame numbers.
        times_s: (K,) seconds.
        poses: (K, 4, 4), NaN where unknown.
    """
    poses = np.asarray(poses, np.float64).reshape(-1, 4, 4)
    known = np.isfinite(poses).all(axis=(1, 2))
    quaternions = np.full((len(poses), 4), np.nan)
    if known.any():
        quaternions[known] = geometry.quaternion_of_transform(poses[known])
    columns = [frames, times_s, np.where(known, "ok", "unknown"), *poses[:, :3, 3].T, *quaternions.T]
    table = pd.DataFrame(dict(zip(CSV_COLUMNS, columns, strict=True)))
    # A float64 of Unix seconds holds no more than the microsecond.
    table["time_s"] = [f"{t:.6f}" for t in table["time_s"]]
    with atomic_path(path) as partial:
        table.to_csv(partial, index=False, float_format="%.9f", na_rep="nan")


def read_poses_csv(path: str | Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Frame numbers (K,), times (K,) and poses (K, 4, 4), NaN where unknown, of a file `write_poses_csv` wrote.

    Raises:
        BadInput: no such file, or one without these columns.
    """
    try:
        table = pd.read_csv(find_file(path))
        values = table[list(CSV_COLUMNS[3:])].to_numpy(np.float64)
        frames, times_s = table["frame"].to_numpy(np.int64), table["time_s"].to_numpy(np.float64)
    except (ValueError, KeyError, UnicodeDecodeError, pd.errors.ParserError) as error:
        raise BadInput(path, f"no table of poses ({error})", f"write the columns {', '.join(CSV_COLUMNS)}") from error
    poses = np.full((len(table), 4, 4), np.nan)
    known = np.isfinite(values).all(axis=1)
    if known.any():
        poses[known] = geometry.transform_of_quaternion(values[known, :3], values[known, 3:])
    return frames, times_s, poses


def _rows(path: str | Path, n_columns: int) -> np.ndarray:
    lines = [line.split("#", 1)[0].split() for line in read_text(path).splitlines()]
    lines = [(number, words) for number, words in enumerate(lines, start=1) if words]
    if not lines:
        raise BadInput(path, "holds no pose", f"write {n_columns} numbers per row")
    for number, words in lines:
        if len(words) != n_columns:
            raise BadInput(path, f"line {number} has {len(words)} numbers instead of {n_columns}", f"write {n_columns} numbers per row")
    try:
        rows = np.array([words for _, words in lines], np.float64)
    except ValueError as error:
        raise BadInput(path, f"something is no number ({error})", f"write {n_columns} numbers per row") from error
    if not np.isfinite(rows).all():
        raise BadInput(path, "NaN or infinite numbers", "leave unknown poses out")
    return rows


def _checked(poses: np.ndarray, path: str | Path) -> np.ndarray:
    deviation = np.abs(poses[:, :3, :3] @ np.swapaxes(poses[:, :3, :3], 1, 2) - np.eye(3)).max(axis=(1, 2))
    bad = np.flatnonzero((deviation > 1e-3) | (np.linalg.det(poses[:, :3, :3]) < 0))
    if len(bad):
        geometry.check_rotation(poses[bad[0], :3, :3], f"{path}, row {bad[0] + 1}")
    return poses
