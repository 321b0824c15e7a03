"""How good reconstructed keyframes are, against a drive's truth.

The scale is compared by the ways between cameras. Ranges of the dense cloud are compared with what the ray from the true reference
camera through each point meets in the simulated street; a real recording has no such truth. Most points of a street's cloud lie on the
road, which every method gets right, so what stands still above the ground and what could move are scored by themselves.
"""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
import yaml

from streetscan.classes import GROUND, MOVABLE_LABELS
from streetscan.errors import BadInput
from streetscan.geometry import interpolate_poses, invert, rotation_angle
from streetscan.io.files import find_file, read_yaml
from streetscan.io.las import read_las
from streetscan.io.trajectories import read_poses_csv

# Points of a dense cloud whose range is compared; more change no third digit.
_N_COMPARED = 20_000
# Metric to column of the keyframes' table, factor to its unit, and unit.
_SCORES = {
    "projection_error": ("projection_error_px", 1, "px"), "density_error": ("density_error_px", 1, "px"),
    "spaced_error": ("spaced_error_px", 1, "px"), "spread_error": ("spread_error_px", 1, "px"),
    "n_sparse": ("n_sparse", 1, ""), "n_dense": ("n_dense", 1, ""),
    "scale_error": ("scale_error", 100, "%"), "rotation_error": ("rotation_error_deg", 1, "deg"),
    "dense_error": ("dense_error", 100, "%"), "dense_shape_error": ("dense_shape_error", 100, "%"),
    "dense_ground_error": ("dense_ground_error", 100, "%"), "dense_standing_error": ("dense_standing_error", 100, "%"),
    "dense_movable_error": ("dense_movable_error", 100, "%"), "dense_far_error": ("dense_far_error", 100, "%"),
    "dense_standing_share": ("dense_standing_share", 100, "%"), "dense_off": ("dense_off", 100, "%"),
    "dense_standing_off": ("dense_standing_off", 100, "%"), "dense_far_off": ("dense_far_off", 100, "%"),
    "sfm_time": ("sfm_s", 1, "s"), "densification_time": ("densification_s", 1, "s"),
}  # fmt: skip
ERROR_COLUMNS = (
    "scale_error", "rotation_error_deg", "dense_error", "dense_shape_error", "dense_deviation", "n_compared",
    "dense_ground_error", "dense_standing_error", "dense_movable_error", "dense_far_error", "dense_standing_share", "dense_off",
    "dense_standing_off", "dense_far_off", "n_ground", "n_standing", "n_movable", "n_far", "n_missing",
)  # fmt: skip
# A point whose range is wrong by a larger share is off.
_OFF = 0.03
# An accepted keyframe is right when its scale and its turns are off by less.
_RIGHT_SCALE, _RIGHT_TURN_DEG = 0.015, 0.1


def evaluate_keyframe(
    summary: pd.Series, model_folder: str | Path, truth_folder: str | Path,
    true_surfaces: Callable[[int, np.ndarray], tuple[np.ndarray, np.ndarray]] | None, max_range_m: float,
) -> dict:  # fmt: skip
    """Errors of one keyframe; NaN where its status, or the truth, tells none.

    Args:
        summary: its row of `summarize`.
        model_folder: what `write_model` wrote.
        truth_folder: truth/ of the drive.
        true_surfaces: stamp in ns and directions (N, 3) in frame `camera` to distances (N,) in metres, inf where nothing is hit, and
            classes (N,); None without such truth.
        max_range_m: dense points nearer than this are compared; those up to twice as far are the far ones.
    Returns:
        `scale_error`: found over true ways of the cameras, minus one. `rotation_error_deg`: largest of the turns from the first camera.
        `dense_error`: median of |range - true| / true; `dense_shape_error`: the same with the true scale; `dense_deviation`: the median of
        (range - true) / true with the true scale. `n_compared`: points of those. The others are of `compare_ranges`.
    """
    errors = dict.fromkeys(ERROR_COLUMNS, np.nan) | {name: 0 for name in ERROR_COLUMNS if name.startswith("n_")}
    if not np.isfinite(summary.way_m):
        return errors
    cameras = read_yaml(Path(model_folder) / "cameras.yaml")
    times_ns = np.array([image["time_ns"] for image in cameras["images"]], np.int64)
    poses = np.array(
        [np.full((4, 4), np.nan) if i["T_image_camera"] is None else i["T_image_camera"] for i in cameras["images"]], np.float64
    )
    known = np.isfinite(poses).all(axis=(1, 2))
    found, true = invert(poses[known]), true_camera_poses(truth_folder, times_ns[known])
    i, j = np.triu_indices(len(found), 1)
    ways, true_ways = (np.linalg.norm(T[j, :3, 3] - T[i, :3, 3], axis=1) for T in (found, true))
    ratio = float(np.sum(ways * true_ways) / np.sum(true_ways**2))
    errors["scale_error"] = ratio - 1
    motions = [invert(T[:1]) @ T for T in (found, true)]
    errors["rotation_error_deg"] = float(np.degrees(rotation_angle(invert(motions[0]) @ motions[1]).max()))
    if true_surfaces is None:
        return errors
    points = read_las(Path(model_folder) / "dense.laz").points
    points = points[:: max(len(points) // _N_COMPARED, 1)]
    surfaces = true_surfaces(int(times_ns[cameras["reference"]]), points)
    return errors | compare_ranges(np.linalg.norm(points, axis=1), *surfaces, ratio, max_range_m)


def compare_ranges(ranges: np.ndarray, truth: np.ndarray, labels: np.ndarray, ratio: float, max_range_m: float) -> dict:
    """Errors of ranges (N,) against the true ones (N,), inf where the ray hits nothing, on surfaces of classes (N,).

    Args:
        ratio: found over true scale.
        max_range_m: as in `evaluate_keyframe`. A point whose ray hits nothing counts by its own range.
    Returns:
        `dense_error`, `dense_shape_error`, `dense_deviation` over all near points that have a true range (`n_compared`). Of these
        `ground`, `standing` (still, above the ground) and `movable` ones, and of the `far` ones, the median error and their number.
        `_off` is the share that is wrong by more than 3 %, points whose ray hits nothing among them (`n_missing` of the near ones);
        `dense_standing_share` that of `n_standing` in `n_compared`. No points: NaN.
    """
    is_hit = np.isfinite(truth)
    at = np.where(is_hit, truth, ranges)
    error = np.where(is_hit, np.abs(ranges / at - 1), np.inf)
    near, far = at < max_range_m, (at >= max_range_m) & (at < 2 * max_range_m)
    compared, is_ground, is_movable = near & is_hit, labels == GROUND, np.isin(labels, MOVABLE_LABELS)
    groups = {
        "ground": compared & is_ground,
        "standing": compared & ~is_ground & ~is_movable,
        "movable": compared & is_movable,
        "far": far & is_hit,
    }
    found = {"n_compared": int(compared.sum()), "n_missing": int((near & ~is_hit).sum()), "dense_error": _median(error[compared])}
    shape = ranges[compared] / ratio / truth[compared] - 1
    found |= {"dense_shape_error": _median(np.abs(shape)), "dense_deviation": _median(shape)}
    for name, rows in groups.items():
        found |= {f"n_{name}": int(rows.sum()), f"dense_{name}_error": _median(error[rows])}
    for name, rows in (("dense_off", near), ("dense_standing_off", groups["standing"]), ("dense_far_off", far)):
        found[name] = float((error[rows] > _OFF).mean()) if rows.any() else np.nan
    return found | {"dense_standing_share": found["n_standing"] / found["n_compared"] if found["n_compared"] else np.nan}


def _median(values: np.ndarray) -> float:
    return float(np.median(values)) if len(values) else np.nan


def true_camera_poses(truth_folder: str | Path, times_ns: np.ndarray) -> np.ndarray:
    """True poses of the camera (n, 4, 4), frame `map`, at images' stamps: as simulated, or from the lidar's poses and the extrinsics.

    Raises:
        BadInput: the truth knows neither.
    """
    folder = Path(truth_folder)
    if (folder / "camera_poses.csv").is_file():
        _, times_s, poses = read_poses_csv(folder / "camera_poses.csv")
        nearest = np.abs(times_s[:, None] - times_ns / 1e9).argmin(axis=0)
        if np.abs(times_s[nearest] - times_ns / 1e9).max(initial=0) > 1e-3:
            raise BadInput(folder / "camera_poses.csv", "lacks an image of a keyframe", "simulate the drive again")
        return poses[nearest]
    extrinsics = (yaml.safe_load(find_file(folder / "truth.yaml").read_text()) or {}).get("extrinsics")
    if extrinsics is None or not (folder / "poses.csv").is_file():
        raise BadInput(folder, "knows neither poses nor extrinsics", "evaluate a drive whose file gives both")
    _, times_s, poses = read_poses_csv(folder / "poses.csv")
    posed = np.isfinite(poses).all(axis=(1, 2))
    return interpolate_poses(times_ns / 1e9, times_s[posed], poses[posed]) @ invert(np.array(extrinsics["T_camera_lidar"]))


def score_reconstructions(keyframes: pd.DataFrame) -> pd.DataFrame:
    """`metric`, `value`, `unit`, `n` over the keyframes of a drive: medians over those that have a value, shares of all.

    `scale_right` and `turns_right`: shares of the accepted keyframes whose scale is within 1.5 %, and whose turns are within 0.1 degrees.
    """
    accepted, n = keyframes[keyframes["status"] == "ok"], len(keyframes)
    rows = [("accepted", 100 * len(accepted) / n if n else np.nan, "%", n)]
    for metric, column, limit in (("scale_right", "scale_error", _RIGHT_SCALE), ("turns_right", "rotation_error_deg", _RIGHT_TURN_DEG)):
        errors = accepted[column].abs().dropna()
        rows.append((metric, 100 * float((errors < limit).mean()) if len(errors) else np.nan, "%", len(errors)))
    for metric, (column, factor, unit) in _SCORES.items():
        values = accepted[column].abs().dropna() * factor
        rows.append((metric, float(values.median()) if len(values) else np.nan, unit, len(values)))
    return pd.DataFrame(rows, columns=["metric", "value", "unit", "n"])


def join_summaries(summaries: Sequence[pd.DataFrame], errors: Sequence[dict]) -> pd.DataFrame:
    """A row per keyframe: its summary and its errors."""
    table = pd.concat(summaries, ignore_index=True)
    return pd.concat([table, pd.DataFrame(errors, columns=list(ERROR_COLUMNS))], axis=1)
