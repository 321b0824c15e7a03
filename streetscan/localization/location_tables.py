"""Localized frames as CSV: one row per frame, whatever became of it."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from streetscan.errors import BadInput
from streetscan.geometry import quaternion_of_transform, transform_of_quaternion
from streetscan.io.files import find_file
from streetscan.io.trajectories import write_tum
from streetscan.localization.drive import FrameLocation
from streetscan.localization.localizer import Location, Start

_POSE = ("x_m", "y_m", "z_m", "qx", "qy", "qz", "qw")
_AXES = ("x", "y", "z", "roll", "pitch", "yaw")
_UPPER = np.triu_indices(6)
COVARIANCE = tuple(f"cov_{_AXES[i]}_{_AXES[j]}" for i, j in zip(*_UPPER, strict=True))
_NUMBERS = ("consensus", "margin", "n_objects", "n_landmarks", "n_inliers", "overlap_start", "overlap", "fit", "plane_margin")
_SECONDS = ("detection_s", "vote_s", "refinement_s")
# The pose columns hold believed poses alone; `found_` whatever was found, `vote_` the vote alone, `start_` where the search began.
COLUMNS = (
    "frame", "time_s", "status", *_POSE, *(f"found_{n}" for n in _POSE), *(f"vote_{n}" for n in _POSE),
    "start_x_m", "start_y_m", "start_yaw_rad", "source", "is_refined", *_NUMBERS, *_SECONDS, *COVARIANCE,
)  # fmt: skip


def tabulate_locations(rows: Sequence[FrameLocation]) -> pd.DataFrame:
    """One row per frame with the columns of COLUMNS; poses are T_map_lidar, quaternions x y z w, covariances m and rad, axes of `map`."""
    table = []
    for row in rows:
        found = row.location
        believed = found.T_map_lidar if found.status == "ok" else np.full((4, 4), np.nan)
        poses = [v for T in (believed, found.T_map_lidar, found.T_vote) for v in _pose_values(T)]
        numbers = [getattr(found, name) for name in _NUMBERS]
        start = (*row.start.xy_m, row.start.yaw_rad)
        table.append(
            (row.index, f"{row.time_s:.9f}", found.status, *poses, *start, found.source, int(found.is_refined), *numbers)
            + (*found.seconds, *found.covariance[_UPPER])
        )
    return pd.DataFrame(table, columns=COLUMNS)


def read_locations(path: str | Path) -> list[FrameLocation]:
    """The rows of a table `tabulate_locations` made.

    Raises:
        BadInput: no such file, or one without these columns.
    """
    try:
        table = pd.read_csv(find_file(path), dtype={"status": str, "source": str}, keep_default_na=True)
        missing = [c for c in COLUMNS if c not in table]
        if missing:
            raise KeyError(missing[0])
        blocks = [table[list(names)].to_numpy(np.float64) for names in _BLOCKS]
    except (ValueError, KeyError, UnicodeDecodeError, pd.errors.ParserError) as error:
        raise BadInput(path, f"no table of localized frames ({error})", "run localize_frames again") from error
    rows = []
    for i, record in enumerate(table.to_dict("records")):
        found, vote, start, seconds, upper = (b[i] for b in blocks)
        covariance = np.zeros((6, 6))
        covariance[_UPPER] = upper
        covariance = np.triu(covariance) + np.triu(covariance, 1).T
        location = Location(str(record["status"]), _pose_of(found), _pose_of(vote), **{n: record[n] for n in _NUMBERS})
        location.source = record["source"] if isinstance(record["source"], str) else ""
        location.is_refined, location.covariance, location.seconds = bool(record["is_refined"]), covariance, seconds
        rows.append(FrameLocation(int(record["frame"]), float(record["time_s"]), Start(start[:2], float(start[2])), location))
    return rows


def write_tum_of(path: str | Path, rows: Sequence[FrameLocation]) -> None:
    """Write the believed poses as TUM (`time x y z qx qy qz qw`), T_map_lidar."""
    believed = [row for row in rows if row.location.status == "ok"]
    write_tum(path, np.array([r.time_s for r in believed]), np.array([r.location.T_map_lidar for r in believed]).reshape(-1, 4, 4))


_BLOCKS = (
    tuple(f"found_{n}" for n in _POSE),
    tuple(f"vote_{n}" for n in _POSE),
    ("start_x_m", "start_y_m", "start_yaw_rad"),
    _SECONDS,
    COVARIANCE,
)


def _pose_values(T: np.ndarray) -> tuple:
    known = np.isfinite(T).all()
    return (*T[:3, 3], *(quaternion_of_transform(T) if known else np.full(4, np.nan)))


def _pose_of(values: np.ndarray) -> np.ndarray:
    return transform_of_quaternion(values[:3], values[3:]) if np.isfinite(values).all() else np.full((4, 4), np.nan)
