"""How good a chain of poses is: pairs that failed, absolute and relative errors, drift.

Source: Sturm et al. (2012) for APE and RPE, Geiger et al. (2012) for the drift over a distance; failed pairs as in
Józsa & Benedek (2013), Table 1, made a number: status not ok, or off the reference by more than a distance or an angle.
"""

from collections.abc import Sequence

import numpy as np
import pandas as pd
from scipy.signal import savgol_filter

from streetscan.errors import BadInput
from streetscan.geometry import apply, fit_similarity, invert, rotation_angle, rpy_of_transform
from streetscan.registration.odometry import FramePose

COLUMNS = ("metric", "value", "unit", "n")


def relative_errors(poses: np.ndarray, reference: np.ndarray, step: int = 1, is_planar: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """Errors of the motions from frame i to frame i + step.

    Args:
        poses, reference: (K, 4, 4) poses of the same frames, each in any frame of its own; NaN where unknown.
        step: frames between.
        is_planar: only x, y and yaw count (the reference has no height).
    Returns:
        distance in metres and angle in radians, (K - step,) each; NaN where one of the four poses is unknown.
    """
    n = max(len(poses) - step, 0)
    known = np.isfinite(poses).all(axis=(1, 2)) & np.isfinite(reference).all(axis=(1, 2))
    rows = np.flatnonzero(known[:n] & known[step : n + step])
    distance, angle = np.full(n, np.nan), np.full(n, np.nan)
    if len(rows):
        motion = invert(poses[rows]) @ poses[rows + step]
        error = invert(invert(reference[rows]) @ reference[rows + step]) @ motion
        distance[rows] = np.linalg.norm(error[:, : 2 if is_planar else 3, 3], axis=1)
        angle[rows] = np.abs(rpy_of_transform(error)[:, 2]) if is_planar else rotation_angle(error)
    return distance, angle


def absolute_errors(poses: np.ndarray, reference: np.ndarray, is_planar: bool = False) -> np.ndarray:
    """Distances (K,) in metres between positions after the rigid alignment that makes them smallest; NaN where unknown.

    Args:
        poses, reference: (K, 4, 4), NaN where unknown.
        is_planar: align and compare x and y only.
    Raises:
        BadInput: fewer than three known positions, or all on one spot or line (nothing to align).
    """
    a, b = poses[:, :3, 3].copy(), reference[:, :3, 3].copy()
    if is_planar:
        a[:, 2], b[:, 2] = 0, 0
    known = np.isfinite(a).all(axis=1) & np.isfinite(b).all(axis=1)
    errors = np.full(len(poses), np.nan)
    try:
        T = fit_similarity(a[known], b[known], with_scale=False)
    except ValueError as error:
        raise BadInput("the trajectory", f"cannot be aligned with the reference ({error})", "evaluate a drive that moves") from error
    errors[known] = np.linalg.norm(apply(T, a[known]) - b[known], axis=1)
    return errors


def drift_per_distance(poses: np.ndarray, reference: np.ndarray, length_m: float, is_planar: bool = False) -> np.ndarray:
    """Error of the motion over every stretch of a length, as a share of it.

    Args:
        poses, reference: (K, 4, 4), NaN where unknown.
        length_m: along the reference.
        is_planar: only x and y count.
    Returns:
        (S,) errors per metre, one for each frame from which the reference is long enough and both ends are known.
    """
    known = np.isfinite(poses).all(axis=(1, 2)) & np.isfinite(reference).all(axis=(1, 2))
    poses, reference = poses[known], reference[known]
    if len(poses) < 2:
        return np.empty(0)
    path_m = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(reference[:, : 2 if is_planar else 3, 3], axis=0), axis=1))])
    ends = np.searchsorted(path_m, path_m + length_m)
    starts = np.flatnonzero(ends < len(poses))
    ends = ends[starts]
    error = invert(invert(reference[starts]) @ reference[ends]) @ (invert(poses[starts]) @ poses[ends])
    return np.linalg.norm(error[:, : 2 if is_planar else 3, 3], axis=1) / length_m


def smooth_positions(times_s: np.ndarray, poses: np.ndarray, window_s: float = 1.0) -> np.ndarray:
    """Poses (K, 4, 4) with the jumps of satellite positions evened out: a parabola through each window; attitudes stay.

    Poses with gaps (NaN) stay as they are.

    ASSUME: a vehicle's path over a second is a parabola; GNSS positions jump by centimetres between frames and would count as
    errors of the registration.

    Args:
        times_s: (K,) increasing, nearly even.
        poses: (K, 4, 4).
        window_s: length of a window; 0 leaves the poses as they are.
    """
    if len(poses) < 5 or window_s <= 0 or not np.isfinite(poses).all():
        return poses
    interval_s = float(np.median(np.diff(times_s)))
    n = min(2 * round(window_s / interval_s / 2) + 1, len(poses) - (1 - len(poses) % 2))
    smoothed = poses.copy()
    if n >= 5:
        smoothed[:, :3, 3] = savgol_filter(poses[:, :3, 3], n, 2, axis=0)
    return smoothed


def find_failed_pairs(
    poses: Sequence[FramePose],
    reference: np.ndarray,
    is_planar: bool = False,
    max_distance_m: float = 0.5,
    max_angle_rad: float = np.radians(2.0),
) -> np.ndarray:
    """(K - 1,) bool: pairs of consecutive frames whose registration failed.

    Args:
        poses: (K) rows of the chain.
        reference: (K, 4, 4) true poses, NaN where unknown.
        is_planar: the reference has no height.
        max_distance_m, max_angle_rad: larger errors are failures.
    Returns:
        True where the second frame's status is not ok, its segment is another one, or it is off. A frame after a failed one counts by
        its motion since the last posed frame.
    """
    failed = np.array([p.status != "ok" for p in poses[1:]], np.bool_)
    last = 0
    for i in range(1, len(poses)):
        if not poses[i].is_posed:
            continue
        if not failed[i - 1] and poses[last].is_posed:
            pair = np.stack([poses[last].T_segment_lidar, poses[i].T_segment_lidar])
            distance, angle = relative_errors(pair, reference[[last, i]], is_planar=is_planar)
            failed[i - 1] = distance[0] > max_distance_m or angle[0] > max_angle_rad
        last = i
    return failed


def evaluate_chain(
    poses: Sequence[FramePose],
    reference: np.ndarray,
    duration_s: np.ndarray,
    is_planar: bool = False,
    drift_length_m: float = 50.0,
    max_distance_m: float = 0.5,
    max_angle_deg: float = 2.0,
) -> pd.DataFrame:
    """All figures of one chain, over its longest segment where poses are compared, over all pairs where failures are counted.

    Args:
        poses: (K) rows of register_frames.
        reference: (K, 4, 4) true poses of the same frames, NaN where unknown.
        duration_s: (K,) seconds each frame took.
        is_planar: the reference's heights are no truth.
        drift_length_m: see `drift_per_distance`.
        max_distance_m, max_angle_deg: see `find_failed_pairs`.
    Returns:
        a table with the columns of `COLUMNS`.
    Raises:
        BadInput: the reference is of another drive.
    """
    if not len(poses) == len(reference) == len(duration_s):
        raise BadInput("the reference", f"{len(reference)} poses for {len(poses)} frames", "give the truth of the same drive")
    failed = find_failed_pairs(poses, reference, is_planar, max_distance_m, np.radians(max_angle_deg))
    segments = np.array([p.segment if p.is_posed else -1 for p in poses])
    T = _longest_segment(poses)
    distance, angle = (e[np.isfinite(e)] for e in relative_errors(T, reference, is_planar=is_planar))
    drift = drift_per_distance(T, reference, drift_length_m, is_planar)
    try:
        ape = absolute_errors(T, reference, is_planar)
        ape = ape[np.isfinite(ape)]
    except BadInput:
        ape = np.empty(0)
    ms = 1000 * duration_s[1:]
    n_pairs = len(failed)
    rows = [
        ("failed_pairs", int(failed.sum()), "pairs", n_pairs),
        ("failed_share", 100 * failed.mean() if n_pairs else np.nan, "%", n_pairs),
        ("n_frames", len(poses), "frames", len(poses)),
        ("n_registered", int((segments >= 0).sum()), "frames", len(poses)),
        ("n_segments", int(segments.max(initial=-1)) + 1, "segments", len(poses)),
        ("pair_time_median", _of(np.median, ms), "ms", len(ms)),
        ("pair_time_p95", _of(lambda v: np.percentile(v, 95), ms), "ms", len(ms)),
        ("frame_rate", 1000 / _of(np.mean, ms), "fps", len(ms)),
        ("rpe_rmse", _of(_rmse, distance), "m", len(distance)),
        ("rpe_median", _of(np.median, distance), "m", len(distance)),
        ("rpe_max", _of(np.max, distance), "m", len(distance)),
        ("rpe_rotation_rmse", np.degrees(_of(_rmse, angle)), "deg", len(angle)),
        ("rpe_rotation_max", np.degrees(_of(np.max, angle)), "deg", len(angle)),
        ("ape_rmse", _of(_rmse, ape), "m", len(ape)),
        ("ape_max", _of(np.max, ape), "m", len(ape)),
        ("drift", 100 * _of(np.mean, drift), "%", len(drift)),
    ]
    return pd.DataFrame(rows, columns=COLUMNS)


def _longest_segment(poses: Sequence[FramePose]) -> np.ndarray:
    """(K, 4, 4) poses of the segment with most frames, NaN elsewhere."""
    segments = [p.segment for p in poses if p.is_posed]
    longest = np.bincount(segments).argmax() if segments else -1
    return np.array([p.T_segment_lidar if p.segment == longest else np.full((4, 4), np.nan) for p in poses]).reshape(-1, 4, 4)


def align_trajectory(poses: Sequence[FramePose], reference: np.ndarray, failed: np.ndarray, is_planar: bool = False) -> pd.DataFrame:
    """Positions of a chain beside the true ones, both in the frame of the first true pose, for a figure.

    Args:
        poses: (K) rows of the chain; positions of the longest segment are given.
        reference: (K, 4, 4), NaN where unknown.
        failed: (K - 1,) of `find_failed_pairs`.
        is_planar: the reference's heights are no truth.
    Returns:
        one row per frame: `frame`, `time_s`, `status`, `is_failed` (the pair that ends there), `x_m`, `y_m`, `z_m` and `true_x_m`,
        `true_y_m`, `true_z_m`; NaN where unknown. Chains start where the truth does, in its direction: what they drift shows.
    """
    T = _longest_segment(poses)
    both = np.flatnonzero(np.isfinite(T).all(axis=(1, 2)) & np.isfinite(reference).all(axis=(1, 2)))
    if len(both):
        T = invert(T[both[0]]) @ T
        reference = invert(reference[both[0]]) @ reference
    columns = {
        "frame": [p.index for p in poses],
        "time_s": [p.time_s for p in poses],
        "status": [p.status for p in poses],
        "is_failed": np.concatenate([[False], failed])[: len(poses)].astype(int),
    }
    for prefix, chain in (("", T), ("true_", reference)):
        for axis, name in enumerate("xyz"):
            columns[f"{prefix}{name}_m"] = np.full(len(poses), np.nan) if prefix and is_planar and name == "z" else chain[:, axis, 3]
    return pd.DataFrame(columns)


def _of(statistic, values: np.ndarray) -> float:
    """A statistic, NaN of nothing."""
    return float(statistic(values)) if len(values) else float("nan")


def _rmse(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))
