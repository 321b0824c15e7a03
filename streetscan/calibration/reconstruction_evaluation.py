"""How good reconstructed keyframes are, against a drive's truth.

The scale is compared by the ways between cameras. Ranges of the dense cloud are compared with what the ray from the true reference
camera through each point meets in the simulated street; a real recording has no such truth.
"""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
import yaml

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
    "spread_error": ("spread_error_px", 1, "px"), "n_sparse": ("n_sparse", 1, ""), "n_dense": ("n_dense", 1, ""),
    "scale_error": ("scale_error", 100, "%"), "rotation_error": ("rotation_error_deg", 1, "deg"),
    "dense_error": ("dense_error", 100, "%"), "dense_shape_error": ("dense_shape_error", 100, "%"),
    "sfm_time": ("sfm_s", 1, "s"), "densification_time": ("densification_s", 1, "s"),
}  # fmt: skip
ERROR_COLUMNS = (
    "scale_error", "rotation_error_deg", "dense_error", "dense_shape_error", "dense_deviation", "n_compared",
)  # fmt: skip


def evaluate_keyframe(
    summary: pd.Series, model_folder: str | Path, truth_folder: str | Path, true_ranges: Callable[[int, np.ndarray], np.ndarray] | None,
    max_range_m: float,
) -> dict:  # fmt: skip
    """Errors of one keyframe; NaN where its status, or the truth, tells none.

    Args:
        summary: its row of `summarize`.
        model_folder: what `write_model` wrote.
        truth_folder: truth/ of the drive.
        true_ranges: stamp in ns and directions (N, 3) in frame `camera` to distances (N,) in metres; None without such truth.
        max_range_m: dense points farther away are not compared.
    Returns:
        `scale_error`: found over true ways of the cameras, minus one. `rotation_error_deg`: largest of the turns from the first camera.
        `dense_error`: median of |range - true| / true; `dense_shape_error`: the same with the true scale; `dense_deviation`: the median of
        (range - true) / true with the true scale. `n_compared`: points of those.
    """
    errors = dict.fromkeys(ERROR_COLUMNS, np.nan) | {"n_compared": 0}
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
    if true_ranges is None:
        return errors
    points = read_las(Path(model_folder) / "dense.laz").points
    points = points[:: max(len(points) // _N_COMPARED, 1)]
    ranges, truth = np.linalg.norm(points, axis=1), true_ranges(int(times_ns[cameras["reference"]]), points)
    near = np.isfinite(truth) & (truth < max_range_m)
    if near.any():
        errors["dense_error"] = float(np.median(np.abs(ranges[near] / truth[near] - 1)))
        shape = ranges[near] / ratio / truth[near] - 1
        errors |= {
            "dense_shape_error": float(np.median(np.abs(shape))),
            "dense_deviation": float(np.median(shape)),
            "n_compared": int(near.sum()),
        }
    return errors


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
    """`metric`, `value`, `unit`, `n` over the keyframes of a drive: medians over those that have a value, shares of all."""
    accepted, n = keyframes[keyframes["status"] == "ok"], len(keyframes)
    rows = [("accepted", 100 * len(accepted) / n if n else np.nan, "%", n)]
    for metric, (column, factor, unit) in _SCORES.items():
        values = accepted[column].abs().dropna() * factor
        rows.append((metric, float(values.median()) if len(values) else np.nan, unit, len(values)))
    return pd.DataFrame(rows, columns=["metric", "value", "unit", "n"])


def join_summaries(summaries: Sequence[pd.DataFrame], errors: Sequence[dict]) -> pd.DataFrame:
    """A row per keyframe: its summary and its errors."""
    table = pd.concat(summaries, ignore_index=True)
    return pd.concat([table, pd.DataFrame(errors, columns=list(ERROR_COLUMNS))], axis=1)
