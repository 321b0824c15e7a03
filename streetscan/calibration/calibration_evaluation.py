"""Calibrations against truth: pixel errors of projected lidar points, and errors of the transform.

Source: Nagy (2020), 4.4.1, Tables 4.1 and 4.2 (N-235 to N-239).

The true pixel of a lidar point is where the camera, at the image's time, sees the surface point that was hit: known for what stands still
in a simulated drive. A real recording has no such truth; there only transforms are compared, where its file gives extrinsics.

A camera that was moved in mid-drive has two true places: a keyframe is compared with the one at its image, the drive with the last.

ASSUME: the thesis picks ten corner-like points of a keyframe by hand; ours are ten depth edges of what stands still, spread over the image.
ASSUME: its average and deviation are those of the absolute errors along an axis.
ASSUME: a point that comes to lie behind the camera is infinitely far off; so is the mean it enters.
ASSUME: a keyframe is on a hard stretch when things that could move fill more than a quarter of its image (`HARD_SHARE`, of the true masks):
a queue of cars and trams, which hides what stands still from both sensors.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from streetscan.calibration.detectors.drive_truth import read_true_mask
from streetscan.calibration.detectors.image_detections import DYNAMIC_LABELS
from streetscan.calibration.edges import depth_edges
from streetscan.calibration.keyframes import Keyframe
from streetscan.calibration.linear_projection import project_linear
from streetscan.calibration.projection import choose_spread, project_pinhole
from streetscan.calibration.reconstruction_evaluation import true_camera_poses
from streetscan.extrinsics import extrinsics_at, is_after_shift
from streetscan.frames import LidarFrame
from streetscan.geometry import apply, interpolate_poses, invert, rotation_angle
from streetscan.io.arrays import load_npy
from streetscan.io.files import find_file, read_yaml
from streetscan.io.mcap import iterate_images
from streetscan.io.trajectories import read_tum

# The thesis' slow set ends at this speed.
SLOW_KMH = 30.0
N_FEATURES = 10
# Things faster than this move; their points have no place in the image that truth tells.
_MOVING_MPS = 0.1
COLUMNS = (
    "keyframe", "status", "stage", "speed_kmh", "x_px", "x_deviation_px", "y_px", "y_deviation_px", "all_x_px", "all_x_deviation_px",
    "all_y_px", "all_y_deviation_px", "n_points", "median_distance_m", "edge_margin_px", "sigma_x_px", "sigma_y_px", "hausdorff_m",
    "n_lidar_voxels", "n_sfm_voxels", "movable_share",
)  # fmt: skip
# Of COLUMNS what calibrate_keyframe found.
_FIGURES = ("median_distance_m", "edge_margin_px", "sigma_x_px", "sigma_y_px", "hausdorff_m", "n_lidar_voxels", "n_sfm_voxels")
HARD_SHARE = 0.25
# ASSUME: a keyframe is truly good, and should pass the gates, when its transform is within these.
GOOD_DEG, GOOD_M = 0.3, 0.2
GATE_SHARE = 0.95
# ASSUME: a calibration is wrong beyond any of these, of its transform and of its feature points' mean error along an axis: about twice the
# thesis' projections, and more than a user of the cloud would overlook.
WRONG_DEG, WRONG_M, WRONG_PX = 1.0, 0.3, 5.0
_WRONG = {"rotation_deg": WRONG_DEG, "translation_m": WRONG_M, "x_px": WRONG_PX, "y_px": WRONG_PX}
TRANSFORM_COLUMNS = (
    "keyframe", "status", "is_after_shift", "rotation_deg", "translation_m", "forward_m", "offset_error_s", "sigma_m", "sigma_deg",
    "bend_deg", "bend_std_deg",
)  # fmt: skip


@dataclass
class TruePixels:
    """Where static lidar points of a keyframe are in its image.

    Attributes:
        points: (N, 3) raw points, frame `lidar`.
        time_offset_s: (N,) float32 firing minus the frame's stamp.
        pixels: (N, 2) in the rectified image.
        features: (F,) int64 rows of the feature points.
        speed_kmh: of the vehicle.
    """

    points: np.ndarray
    time_offset_s: np.ndarray
    pixels: np.ndarray
    features: np.ndarray
    speed_kmh: float


def has_true_pixels(truth_folder: str | Path) -> bool:
    """Whether the truth of a drive tells the place of every point: a simulated one does."""
    return (Path(truth_folder) / "trajectory.tum").is_file()


def find_true_pixels(frame: LidarFrame, number: int, image_time_ns: int, truth_folder: str | Path, camera: dict) -> TruePixels:
    """True pixels of a frame's static points that lie in the image.

    Args:
        frame: as recorded.
        number: of the frame in the drive.
        image_time_ns: stamp of the image.
        truth_folder: truth/ of a simulated drive.
        camera: `camera_matrix`, `image_width` and `image_height` of the rectified image.
    Raises:
        BadInput: a file of the truth is missing.
    """
    folder = Path(truth_folder)
    times_s, vehicle = read_tum(find_file(folder / "trajectory.tum"))
    T_vehicle_lidar = np.array(read_yaml(folder / "truth.yaml")["mountings"]["T_vehicle_lidar"])
    stamp_s = frame.time_ns / 1e9
    # Firings of ten microseconds share a pose.
    steps, step_of = np.unique(np.round(frame.time_offset_s.astype(np.float64) * 1e5).astype(np.int64), return_inverse=True)
    poses = interpolate_poses(stamp_s + steps * 1e-5, times_s, vehicle) @ T_vehicle_lidar
    in_map = apply(poses[step_of.reshape(-1)], frame.points)
    T_map_camera = true_camera_poses(folder, np.array([image_time_ns]))[0]
    pixels = project_pinhole(in_map, np.array(camera["camera_matrix"]), invert(T_map_camera))
    with np.errstate(invalid="ignore"):
        seen = ((pixels >= 0) & (pixels <= [camera["image_width"] - 1, camera["image_height"] - 1])).all(axis=1)
    seen &= _is_still(folder, number)
    points = frame.points[seen].astype(np.float64)
    edges = _rows_of(depth_edges(frame.points), frame.points)[seen]
    candidates = np.flatnonzero(edges)
    features = candidates[choose_spread(pixels[seen][candidates], N_FEATURES)] if len(candidates) else candidates
    a, b = interpolate_poses(np.array([stamp_s - 0.05, stamp_s + 0.05]), times_s, vehicle)
    speed_kmh = float(np.linalg.norm(b[:3, 3] - a[:3, 3]) / 0.1 * 3.6)
    return TruePixels(points, frame.time_offset_s[seen], pixels[seen], features, speed_kmh)


def _is_still(folder: Path, number: int) -> np.ndarray:
    """(N,) bool: points of a frame on nothing that moves just then."""
    objects = pd.read_csv(find_file(folder / "objects.csv"))
    moving = objects[(objects["frame"] == number) & (objects["speed_mps"] > _MOVING_MPS)]["instance"]
    return ~np.isin(load_npy(folder / "instances" / f"{number:06d}.npy", "simulate_drive"), moving.to_numpy())


def _rows_of(chosen: np.ndarray, points: np.ndarray) -> np.ndarray:
    """(N,) bool: which points are among the chosen ones."""
    keys = np.ascontiguousarray(points).view([("", points.dtype)] * 3).ravel()
    return np.isin(keys, np.ascontiguousarray(chosen.astype(points.dtype)).view([("", points.dtype)] * 3).ravel())


def find_movable_shares(drive_path: str | Path, truth_folder: str | Path, times_ns: Sequence[int]) -> list[float]:
    """The share of each of these images that shows things that could move, by the true masks as recorded; NaN where there is no such image
    or no mask."""
    shares, wanted = {}, set(times_ns) if "masks" in read_yaml(Path(truth_folder) / "truth.yaml") else set()
    for number, image in enumerate(iterate_images(drive_path) if wanted else ()):
        if image.time_ns in wanted:
            shares[image.time_ns] = float(np.isin(read_true_mask(truth_folder, number)[0], DYNAMIC_LABELS).mean())
    return [shares.get(t, np.nan) for t in times_ns]


def score_keyframe(calibration: dict, keyframe: int, truth: TruePixels | None, movable_share: float = np.nan) -> list[dict]:
    """A row of COLUMNS for each stage of a keyframe and for its final projection (`final`); one without numbers where there is none."""
    stages = {name: np.array(P) for name, P in calibration["stages"].items()}
    if calibration["projection"] is not None:
        stages["final"] = np.array(calibration["projection"])
    rows = []
    for stage, projection in (stages or {"final": None}).items():
        row = dict.fromkeys(COLUMNS, np.nan) | {
            "keyframe": f"{keyframe:02d}",
            "status": calibration["status"],
            "stage": stage,
            "n_points": 0,
            "movable_share": movable_share,
        }
        if truth is not None:
            row["speed_kmh"] = truth.speed_kmh
        if truth is not None and projection is not None:
            errors = pixel_errors(projection, truth.points, truth.pixels)
            for prefix, own in (("", errors[truth.features]), ("all_", errors)):
                for axis, name in enumerate("xy"):
                    mean, deviation = _mean_and_deviation(own[:, axis])
                    row |= {f"{prefix}{name}_px": mean, f"{prefix}{name}_deviation_px": deviation}
            row["n_points"] = len(errors)
        if stage == "final":
            row |= {name: calibration["figures"].get(name, np.nan) for name in _FIGURES}
        rows.append(row)
    return rows


def pixel_errors(projection: np.ndarray, points: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Absolute errors (N, 2) of points (N, 3) by a projection (3, 4) from their true pixels; infinite where one comes to lie behind."""
    errors = np.abs(project_linear(projection, points) - pixels)
    return np.where(np.isnan(errors), np.inf, errors)


def _mean_and_deviation(errors: np.ndarray) -> tuple[float, float]:
    """Of errors (N,): NaN of none, infinite where one is."""
    if len(errors) == 0:
        return np.nan, np.nan
    return (float(errors.mean()), float(errors.std())) if np.isfinite(errors).all() else (np.inf, np.inf)


def is_wrong(found: pd.DataFrame) -> pd.Series:
    """(N,) bool: calibrations beyond `WRONG_DEG`, `WRONG_M` or `WRONG_PX`.

    Args:
        found: `rotation_deg`, `translation_m`, `x_px` and `y_px`; NaN where there is no truth to tell, which is not held against it.
    """
    return pd.concat([found[name].astype(float) > limit for name, limit in _WRONG.items()], axis=1).any(axis=1)


def is_known(found: pd.DataFrame) -> pd.Series:
    """(N,) bool: whether truth tells anything that `is_wrong` looks at."""
    return found[list(_WRONG)].notna().any(axis=1)


def times_of_images(keyframes: Sequence[Keyframe], calibrations: Sequence[dict]) -> list[int]:
    """The stamps in ns of the images that keyframes were, or would have been, calibrated at.

    Without a reconstruction it is the first image; a place without images counts as the one before it.
    """
    times_ns = [-1]
    for keyframe, found in zip(keyframes, calibrations, strict=True):
        own_ns = found["image_time_ns"] or next(iter(keyframe.image_times_ns), keyframe.lidar_time_ns)
        times_ns.append(max(own_ns, times_ns[-1]))
    return times_ns[1:]


def score_transform(
    name: str, status: str, T: list | None, extrinsics: dict, image_time_ns: float = math.inf, offset_s: float | None = None,
    std: dict | None = None, bend: dict | None = None,
) -> dict:  # fmt: skip
    """A row of TRANSFORM_COLUMNS: a found T_camera_lidar against the true one.

    Args:
        name: the keyframe, or `drive`.
        status: its status.
        T: 4 x 4, or None.
        extrinsics: of the truth; see `extrinsics_at`.
        image_time_ns: stamp of the image whose extrinsics count; inf is the end of the drive.
        offset_s: found time offset, or None.
        std: `x_y_z_m` and `turn_deg`, or None.
        bend: `found_deg` and `std_deg` of the error that the ways of a drive's cameras have in common, each may be None; no truth tells it.
    """
    row = dict.fromkeys(TRANSFORM_COLUMNS, np.nan) | {"keyframe": name, "status": status}
    row["is_after_shift"] = is_after_shift(extrinsics, image_time_ns)
    if T is not None:
        true, found = extrinsics_at(extrinsics, image_time_ns), np.array(T)
        shift = found[:3, 3] - true[:3, 3]
        row |= {"rotation_deg": float(np.degrees(rotation_angle(invert(true) @ found))), "translation_m": float(np.linalg.norm(shift))}
        row["forward_m"] = float(shift[2])
    if offset_s is not None and "time_offset_s" in extrinsics:
        row["offset_error_s"] = offset_s - extrinsics["time_offset_s"]
    if std is not None:
        row |= {"sigma_m": float(np.linalg.norm(std["x_y_z_m"])), "sigma_deg": float(np.linalg.norm(std["turn_deg"]))}
    if bend is not None:
        found = bend["found_deg"], bend["std_deg"]
        row |= {name: np.nan if v is None else v for name, v in zip(("bend_deg", "bend_std_deg"), found, strict=True)}
    return row


def summarize_errors(errors: pd.DataFrame, transforms: pd.DataFrame, history: pd.DataFrame) -> pd.DataFrame:
    """`set`, `stage`, `metric`, `value`, `unit`, `n` of a drive.

    Args:
        errors: rows of `score_keyframe`.
        transforms: rows of `score_transform`, that of the drive named `drive`.
        history: of calibrate_drive, a row per keyframe.
    Returns:
        the share of accepted keyframes, of all and off the hard stretches (`accepted_open`), their mean pixel errors by speed (stage
        `final`) and stage by stage, how bad accepted ones are at their worst (stage `worst`), how many have which status (stage `status`),
        medians of the clouds' Hausdorff distance and voxels, the errors of the drive's transform and its own deviations, and how a shift of
        the camera was noticed (stage `shift`).

    Stages are compared on the same keyframes, those that have every stage; `n_with_stage` tells how many have this one.
    """
    rows = []
    finals = errors.drop_duplicates("keyframe")
    n = len(finals)
    is_ok, is_open = finals["status"] == "ok", finals["movable_share"].astype(float) <= HARD_SHARE
    rows.append(("", "", "accepted", 100 * float(is_ok.mean()) if n else np.nan, "%", n))
    if finals["movable_share"].notna().any():
        rows.append(("", "", "accepted_open", 100 * float(is_ok[is_open].mean()), "%", int(is_open.sum())))
    accepted = errors[errors["status"] == "ok"].dropna(subset="x_px")
    for name, chosen in (("slow", accepted["speed_kmh"] <= SLOW_KMH), ("fast", accepted["speed_kmh"] > SLOW_KMH)):
        own = accepted[chosen]
        stages = [stage for stage in dict.fromkeys(own["stage"]) if stage != "final"]
        counts = own[own["stage"] != "final"].groupby("keyframe").size()
        has_all = own["keyframe"].isin(counts.index[counts == len(stages)])
        for stage in stages:
            with_stage = own["stage"] == stage
            rows += _means_of(name, stage, own[with_stage & has_all])
            rows.append((name, stage, "n_with_stage", float(with_stage.sum()), "", own["keyframe"].nunique()))
        rows += _means_of(name, "final", own[own["stage"] == "final"]) if len(own) else []
    rows += [("", "status", status, float(count), "", n) for status, count in finals["status"].value_counts().items()]
    found = errors[errors["stage"] == "final"]
    for metric, own in (("hausdorff_m", found[found["status"] == "ok"]), ("n_lidar_voxels", found), ("n_sfm_voxels", found)):
        known = own[metric].dropna().astype(float)
        rows.append(("", "", metric.removesuffix("_m"), float(known.median()), "m" * metric.endswith("_m"), len(known)))
    rows += _worst_of(errors, transforms)
    for row in transforms[transforms["keyframe"] == "drive"].to_dict("records"):
        for column, metric, unit in (
            ("rotation_deg", "rotation", "deg"),
            ("translation_m", "translation", "m"),
            ("sigma_deg", "rotation_sigma", "deg"),
            ("sigma_m", "translation_sigma", "m"),
            ("offset_error_s", "offset_error", "s"),
            ("bend_deg", "bend", "deg"),
            ("bend_std_deg", "bend_sigma", "deg"),
        ):
            rows.append(("", "drive", metric, row[column], unit, int((finals["status"] == "ok").sum())))
        for metric, sigma, error in (("rotation_ratio", "sigma_deg", "rotation_deg"), ("translation_ratio", "sigma_m", "translation_m")):
            rows.append(("", "drive", metric, row[sigma] / row[error] if row[error] else np.nan, "fraction", int(is_ok.sum())))
    rows += _shift_of(transforms[transforms["keyframe"] != "drive"], history)
    return pd.DataFrame(rows, columns=["set", "stage", "metric", "value", "unit", "n"])


def _means_of(name: str, stage: str, own: pd.DataFrame) -> list[tuple]:
    """Rows of the means over keyframes of their own mean errors and deviations."""
    rows = []
    for prefix in ("", "all_"):
        for axis in "xy":
            for metric, column in (("mean", f"{prefix}{axis}_px"), ("deviation", f"{prefix}{axis}_deviation_px")):
                rows.append((name, stage, f"{prefix}{axis}_{metric}", float(own[column].mean()), "px", len(own)))
    return rows


def _worst_of(errors: pd.DataFrame, transforms: pd.DataFrame) -> list[tuple]:
    """Rows of accepted keyframes: the share that is wrong, and of each error the value 95 % stay within, and the largest.

    The 95 % is an error that occurred, the next above, since keyframes are few and one may be infinite.
    """
    final = errors[(errors["stage"] == "final") & (errors["status"] == "ok")]
    own = final.merge(transforms[["keyframe", "rotation_deg", "translation_m"]], on="keyframe", how="left")
    known = own[is_known(own)]
    if len(known) == 0:
        return []
    rows = [("", "worst", "ok_but_wrong", 100 * float(is_wrong(known).mean()), "%", len(known))]
    for column in ("x_px", "y_px", "all_x_px", "all_y_px", "rotation_deg", "translation_m"):
        name, unit = column.rsplit("_", 1)
        values = own[column].dropna().to_numpy(float)
        if len(values):
            rows.append(("", "worst", f"{name}_p95", float(np.quantile(values, 0.95, method="higher")), unit, len(values)))
            rows.append(("", "worst", f"{name}_max", float(values.max()), unit, len(values)))
    return rows


def _shift_of(transforms: pd.DataFrame, history: pd.DataFrame) -> list[tuple]:
    """Rows of how a shift was noticed, of a row per keyframe; NaN where there was none, or where it was not.

    Keyframes are counted from the first one after the shift, refused ones too: up to the first that is too far off the mounting before
    (`is_shifted`), and up to the one after which a keyframe since the shift gives the calibration in force, whose errors these are. Alarms
    before the shift, and all of a drive without one, are false.
    """
    is_after = transforms["is_after_shift"].to_numpy(bool)
    numbers, in_force = transforms["keyframe"].astype(int)[is_after], history["in_force"][is_after]
    is_alarm, is_renewed = history["is_shifted"].to_numpy(bool), in_force.isin(numbers).to_numpy()
    renewed = transforms[is_after][numbers.isin(in_force[is_renewed][:1])]
    n = int(is_after.sum())
    return [
        ("", "shift", "noticed_after", _first(is_alarm[is_after]), "keyframes", n),
        ("", "shift", "recalibrated_after", _first(is_renewed), "keyframes", n),
        ("", "shift", "rotation", float(renewed["rotation_deg"].mean()), "deg", n),
        ("", "shift", "translation", float(renewed["translation_m"].mean()), "m", n),
        ("", "shift", "false_alarms", float(is_alarm[~is_after].sum()), "keyframes", len(is_after) - n),
    ]


def _first(flags: np.ndarray) -> float:
    """Which flag is the first that is set, counted from 1; NaN when none is."""
    return float(flags.argmax()) + 1 if flags.any() else np.nan


def limit_gates(errors: pd.DataFrame, transforms: pd.DataFrame, limits: Mapping[str, float]) -> pd.DataFrame:
    """How each gate treats keyframes that truth calls good, within `GOOD_DEG` and `GOOD_M`, and the others that were calibrated.

    Args:
        errors, transforms: rows of `score_keyframe` and `score_transform` of one or several drives, with a column `drive`.
        limits: what each gate asks for, by a column of `errors`; `edge_margin_px` at least, all else at most.
    Returns:
        for each gate `gate`, `limit`; `limit_95`, with which 95 % of the good ones would pass; `good_passed` and `wrong_passed`, per cent
        of `n_good` and `n_wrong`.
    """
    # Read from a file the names of keyframes may have become numbers.
    own, theirs = (t.assign(keyframe=t["keyframe"].astype(str).str.zfill(2)) for t in (errors[errors["stage"] == "final"], transforms))
    found = own.merge(theirs, on=["drive", "keyframe"], suffixes=("", "_of_transform"))
    found = found[found["rotation_deg"].notna()]
    is_good = (found["rotation_deg"] <= GOOD_DEG) & (found["translation_m"] <= GOOD_M)
    rows = []
    for name, limit in limits.items():
        sign = -1.0 if name == "edge_margin_px" else 1.0
        values = sign * found[name].astype(float)
        passed = values <= sign * limit
        known = np.sort(values[is_good].dropna())
        least = sign * float(known[math.ceil(GATE_SHARE * len(known)) - 1]) if len(known) else np.nan
        shares = [100 * float(passed[rows_of].mean()) if rows_of.any() else np.nan for rows_of in (is_good, ~is_good)]
        rows.append((name, limit, least, *shares, int(is_good.sum()), int((~is_good).sum())))
    return pd.DataFrame(rows, columns=["gate", "limit", "limit_95", "good_passed", "wrong_passed", "n_good", "n_wrong"])
