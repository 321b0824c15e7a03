"""Calibrated again and again: how repeatable the calibration is, from which starts it is found, and what the bins of the vote do to it.

Source: Nagy (2020), 4.4.2, Fig. 4.12 (N-240, N-241).

A trial takes the camera's cloud of a keyframe and a lidar frame near it, and turns the lidar's axes at random: any yaw, roll and pitch
within a limit. Nothing of that turn is told to the calibration. In force is the true calibration, drawn off by an error of its own: small
ones must be kept, large ones replaced, and what is in force afterwards should not be worse than before.

ASSUME: the thesis draws 500 seed frames of a long drive and compares all points with a target-based calibration, which it says is off by
one to three pixels itself; we compare with the true pixels of all points that stand still.
ASSUME: for the bins, Algorithm 1 alone is looked at, without ICP: its highest peak is right when it is within 1 m and 3 degrees, and a
failure otherwise.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import pairwise
from pathlib import Path

import numpy as np
import pandas as pd

from streetscan.calibration.alignment import AlignmentSettings, vote_alignments
from streetscan.calibration.calibration_evaluation import TruePixels, find_true_pixels, is_known, is_wrong, pixel_errors
from streetscan.calibration.calibration_files import read_clouds
from streetscan.calibration.keyframe_calibration import (
    CalibrationFailed,
    CalibrationSettings,
    KeyframeCalibration,
    KeyframeClouds,
    calibrate_keyframe,
    prepare_objects,
)
from streetscan.calibration.keyframes import Keyframe, read_keyframe_lidar
from streetscan.calibration.linear_projection import linear_of, rigid_of
from streetscan.calibration.motion import motion_of
from streetscan.calibration.objects import CloudObjects
from streetscan.calibration.projection import project_pinhole
from streetscan.calibration.ways import lidar_way
from streetscan.extrinsics import extrinsics_at
from streetscan.frames import LidarFrame
from streetscan.geometry import apply, invert, moved_by, rotation_angle, transform
from streetscan.io.files import read_yaml
from streetscan.io.mcap import iterate_lidar
from streetscan.registration.odometry import FramePose

TRIAL_COLUMNS = (
    "trial", "keyframe", "lidar_frame", "roll_deg", "pitch_deg", "yaw_deg", "tilt_deg", "status", "x_px", "y_px", "all_x_px",
    "all_y_px", "rotation_deg", "translation_m", "in_force_deg", "in_force_m", "in_force_x_px",
    "in_force_y_px", "mounting_px", "in_force_mounting_px",
)  # fmt: skip
BIN_COLUMNS = ("keyframe", "turn_step_deg", "step_m", "is_found", "rotation_deg", "translation_m")
# A vote that is farther off is a failed registration.
_FAILED_M, _FAILED_DEG = 1.0, 3.0
# Tilts and yaws are counted in steps of so many degrees.
_STEPS_DEG = {"tilt": 2.5, "yaw": 45.0}
# Calibrations in force are counted by how far they are turned, degrees.
_IN_FORCE_DEG = (0.0, 0.1, 0.25, 0.5, 1.0, np.inf)
# A point farther off in the image, or behind the camera, counts as this far, pixels.
_FAR_PX = 1000.0
# Statuses of calibrations that pass all gates but, the second, the last: to be better than the one in force.
_PASSING = ("ok", "not_better")


@dataclass(frozen=True)
class Trial:
    """One calibration.

    Attributes:
        number: of the trial.
        keyframe: its number.
        frame_step: the lidar frame, counted from the keyframe's own.
        rpy_deg: turn of the lidar's axes.
        error: (6,) of the calibration in force: rotation vector in degrees and shift in m, in the camera's axes.
    """

    number: int
    keyframe: int
    frame_step: int
    rpy_deg: tuple[float, float, float]
    error: tuple[float, ...]

    @property
    def tilt_deg(self) -> float:
        """The larger of roll and pitch."""
        return max(abs(self.rpy_deg[0]), abs(self.rpy_deg[1]))

    @property
    def T_turned_lidar(self) -> np.ndarray:
        """(4, 4) from the lidar's frame into the turned one."""
        return transform(rpy_rad=np.radians(self.rpy_deg))

    def put_in_force(self, T_camera_lidar: np.ndarray) -> np.ndarray:
        """(4, 4) the calibration in force, of the lidar as it is mounted; `T_camera_lidar` is the true one."""
        return moved_by(T_camera_lidar, np.concatenate([np.radians(self.error[:3]), self.error[3:]]))


def draw_trials(
    n: int, keyframes: Sequence[int], max_step: int, max_tilt_deg: float, max_in_force_deg: float, max_in_force_m: float, seed: int
) -> Iterator[Trial]:
    """Trials spread evenly over keyframes.

    Args:
        n: how many; none without keyframes.
        keyframes: numbers of those with a cloud.
        max_step: lidar frames up to so many before and after the keyframe's.
        max_tilt_deg: largest roll and pitch.
        max_in_force_deg, max_in_force_m: largest error of the calibration in force, of its turn and its place. Directions are drawn, and
            one size for both: the square of an even draw, for it is small errors that are hard to tell from none.
        seed: of the draws.
    """
    rng, rng_in_force = np.random.default_rng(seed), np.random.default_rng([seed, 1])
    for number in range(n if len(keyframes) else 0):
        tilt = rng.uniform(-max_tilt_deg, max_tilt_deg, 2)
        rpy_deg = float(tilt[0]), float(tilt[1]), float(rng.uniform(-180, 180))
        size = rng_in_force.uniform() ** 2 * np.array([[max_in_force_deg], [max_in_force_m]])
        ways = rng_in_force.normal(size=(2, 3))
        error = (size * ways / np.linalg.norm(ways, axis=1, keepdims=True)).ravel()
        frame_step = int(rng.integers(-max_step, max_step + 1))
        yield Trial(number, keyframes[number % len(keyframes)], frame_step, rpy_deg, tuple(error.tolist()))


def turn_clouds(
    clouds: KeyframeClouds, frame: LidarFrame, is_static: np.ndarray, T_turned_lidar: np.ndarray, poses: list[FramePose],
    image_time_ns: int, T_in_force: np.ndarray | None = None,
) -> KeyframeClouds:  # fmt: skip
    """A keyframe's clouds with another lidar frame, as a lidar that is mounted turned would have given it.

    Args:
        clouds: of the keyframe.
        frame: the lidar frame.
        is_static: (N,) bool of its points.
        T_turned_lidar: (4, 4) a turn.
        poses: of register_frames.
        image_time_ns: stamp of the image that counts.
        T_in_force: (4, 4) T_camera_lidar in force, of the lidar as it is mounted; None for none.

    ASSUME: depth edges are found in the untilted frames and turned then; a tilt of some degrees hardly changes where they are.
    """
    turned = [replace(p, T_segment_lidar=p.T_segment_lidar @ invert(T_turned_lidar)) if p.is_posed else p for p in poses]
    return replace(
        clouds, points_lidar=apply(T_turned_lidar, frame.points).astype(np.float32), time_offset_s=frame.time_offset_s,
        is_static=is_static, motion=motion_of(turned, frame.time_ns, image_time_ns),
        T_initial=None if T_in_force is None else T_in_force @ invert(T_turned_lidar),
        way=lidar_way(turned, frame.time_ns, clouds.image_times_ns, image_time_ns),
        shots=tuple(s.turned(T_turned_lidar) for s in clouds.shots),
    )  # fmt: skip


def score_trial(
    trial: Trial, lidar_frame: int, turned: KeyframeClouds, made: KeyframeCalibration, truth: TruePixels, T_camera_lidar: np.ndarray
) -> dict:
    """A row of TRIAL_COLUMNS: mean absolute errors of the feature points' and of all static points' pixels, and those of the transform;
    the same of the calibration in force, under which points are freed of the vehicle's motion and stamps are taken as they are; and, of
    both, how far static points fall from where the true mounting has them (`mounting_px`).

    Args:
        trial, lidar_frame, turned: what was calibrated.
        made: the outcome.
        truth: of the lidar frame, in its own axes.
        T_camera_lidar: (4, 4) the true mounting, likewise.
    """
    roll, pitch, yaw = trial.rpy_deg
    row = dict.fromkeys(TRIAL_COLUMNS, np.nan) | {"trial": trial.number, "keyframe": f"{trial.keyframe:02d}", "lidar_frame": lidar_frame}
    row |= {"roll_deg": roll, "pitch_deg": pitch, "yaw_deg": yaw, "tilt_deg": trial.tilt_deg, "status": made.status}
    points, K = apply(trial.T_turned_lidar, truth.points), turned.view.K
    if made.projection is not None:
        errors = pixel_errors(made.projection, points, truth.pixels)
        row |= _pixel_means("", errors[truth.features]) | _pixel_means("all_", errors)
    if made.T_camera_lidar is not None:
        found = made.T_camera_lidar @ trial.T_turned_lidar
        row |= _errors_of(found, T_camera_lidar) | {"mounting_px": _mounting_px(truth.points, found, T_camera_lidar, K)}
    in_force = trial.put_in_force(T_camera_lidar)
    of_force = _errors_of(in_force, T_camera_lidar)
    row |= {"in_force_deg": of_force["rotation_deg"], "in_force_m": of_force["translation_m"]}
    row |= {"in_force_mounting_px": _mounting_px(truth.points, in_force, T_camera_lidar, K)}
    return row | _pixel_means("in_force_", _errors_in_force(turned, points, truth))


def _errors_in_force(turned: KeyframeClouds, points: np.ndarray, truth: TruePixels) -> np.ndarray:
    """(N, 2) absolute errors in pixels of points under the calibration in force."""
    if turned.motion is not None:
        points = turned.motion.deskew(points, truth.time_offset_s)
    return pixel_errors(linear_of(turned.T_stamp_in_force, turned.view.K), points, truth.pixels)


def _mounting_px(points: np.ndarray, found: np.ndarray, true: np.ndarray, K: np.ndarray) -> float:
    """Mean distance in the image between points (N, 3) under two transforms into the camera, at most `_FAR_PX` of each."""
    if len(points) == 0:
        return float("nan")
    off = np.linalg.norm(project_pinhole(points, K, found) - project_pinhole(points, K, true), axis=1)
    return float(np.fmin(off, _FAR_PX).mean())


def _pixel_means(prefix: str, errors: np.ndarray) -> dict[str, float]:
    return {f"{prefix}{name}_px": float(errors[:, axis].mean()) if len(errors) else np.nan for axis, name in enumerate("xy")}


def _errors_of(found: np.ndarray, true: np.ndarray) -> dict[str, float]:
    change = invert(true) @ found
    return {"rotation_deg": float(np.degrees(rotation_angle(change))), "translation_m": float(np.linalg.norm(change[:3, 3]))}


def score_bins(
    keyframe: int, lidar: CloudObjects, sfm: CloudObjects, T_sfm_lidar: np.ndarray, settings: AlignmentSettings, bins: Sequence[Mapping]
) -> list[dict]:
    """Rows of BIN_COLUMNS: the highest peak of Algorithm 1 for each size of its bins.

    Args:
        keyframe: its number.
        lidar, sfm: objects of the two clouds.
        T_sfm_lidar: (4, 4) the true one.
        settings: of the vote.
        bins: `turn_step_deg` and `step_m` of each size.
    """
    rows = []
    for size in bins:
        found = vote_alignments(lidar, sfm, replace(settings, scales=(1.0,), n_peaks=1, window=replace(settings.window, **size)))
        row = dict.fromkeys(BIN_COLUMNS, np.nan) | {"keyframe": f"{keyframe:02d}", "is_found": False} | dict(size)
        if found:
            row |= _errors_of(rigid_of(found[0].T_sfm_lidar), T_sfm_lidar)
            row["is_found"] = row["translation_m"] <= _FAILED_M and row["rotation_deg"] <= _FAILED_DEG
        rows.append(row)
    return rows


class Recalibrator:
    """Trials over the keyframes of a simulated drive."""

    def __init__(
        self, drive_path: str | Path, truth_folder: str | Path, keyframes: Sequence[Keyframe], model_folders: Sequence[str | Path],
        poses: list[FramePose], find_static: Callable[[LidarFrame], np.ndarray], settings: CalibrationSettings,
    ):  # fmt: skip
        """
        Args:
            drive_path, truth_folder: drive.mcap and truth/.
            keyframes: of the drive.
            model_folders: of reconstruct_keyframe, one per keyframe.
            poses: of register_frames.
            find_static: (N,) bool of a lidar frame's points.
            settings: of the calibration.
        """
        self._drive, self._truth, self._keyframes, self._models = drive_path, truth_folder, keyframes, [Path(m) for m in model_folders]
        self._poses, self._find_static, self._settings = poses, find_static, replace(settings, with_raw=False)
        self._extrinsics = read_yaml(Path(truth_folder) / "truth.yaml")["extrinsics"]
        self._clouds = lru_cache(maxsize=1)(self._read)

    @property
    def usable(self) -> list[int]:
        """Numbers of the keyframes that have a dense cloud."""
        return [k.index for k, model in zip(self._keyframes, self._models, strict=True) if (model / "dense.laz").is_file()]

    def run(self, trial: Trial) -> dict:
        """The row of one trial."""
        clouds, cameras, image_time_ns = self._clouds(trial.keyframe)
        number, frame = self._frame_of(trial)
        T_camera_lidar = extrinsics_at(self._extrinsics, image_time_ns)
        in_force = trial.put_in_force(T_camera_lidar)
        turned = turn_clouds(clouds, frame, self._find_static(frame), trial.T_turned_lidar, self._poses, image_time_ns, in_force)
        truth = find_true_pixels(frame, number, image_time_ns, self._truth, cameras)
        return score_trial(trial, number, turned, calibrate_keyframe(turned, self._settings), truth, T_camera_lidar)

    def score_bins(self, keyframe: int, bins: Sequence[Mapping]) -> list[dict]:
        """The rows of a keyframe's own lidar frame; none where its clouds hold no objects or its motion is not known."""
        clouds, _, image_time_ns = self._clouds(keyframe)
        try:
            lidar, sfm = prepare_objects(
                clouds.points_lidar[clouds.is_static], clouds.points_sfm[~clouds.is_dynamic_sfm], clouds, self._settings
            )
        except CalibrationFailed:
            return []
        if clouds.motion is None:
            return []
        image_s = clouds.motion.image_s - self._extrinsics.get("time_offset_s", 0.0)
        stamped = extrinsics_at(self._extrinsics, image_time_ns) @ invert(clouds.motion.at([image_s])[0])
        return score_bins(keyframe, lidar, sfm, invert(clouds.view.T_camera_sfm) @ stamped, self._settings.alignment, bins)

    def _read(self, keyframe: int) -> tuple[KeyframeClouds, dict, int]:
        model, chosen = self._models[keyframe], self._keyframes[keyframe]
        cameras = read_yaml(model / "cameras.yaml")
        clouds = read_clouds(self._drive, chosen, model, self._poses, None)
        clouds.is_static = self._find_static(read_keyframe_lidar(self._drive, chosen))
        return clouds, cameras, cameras["images"][cameras["reference"]]["time_ns"]

    def _frame_of(self, trial: Trial) -> tuple[int, LidarFrame]:
        """Number and lidar frame of a trial; at the ends of the drive the last there is."""
        number = min(max(self._keyframes[trial.keyframe].lidar_frame + trial.frame_step, 0), len(self._poses) - 1)
        time_ns = round(self._poses[number].time_s * 1e9)
        near = iterate_lidar(self._drive, time_ns - 1_000_000, time_ns + 1_000_000)
        return number, next(near)


def summarize_trials(trials: pd.DataFrame, bins: pd.DataFrame) -> pd.DataFrame:
    """`set`, `metric`, `value`, `unit`, `n`.

    Args:
        trials, bins: rows of `score_trial` and `score_bins`.
    Returns:
        over accepted trials the least, mean and largest error of all static points in x and y; the shares accepted, right (accepted, and
        not `is_wrong`) and ok but wrong, of all trials, and the first two by tilt and by yaw; for each size of the bins the share of
        failed registrations and the mean errors of the others. Accepted: by all gates but the last, to be better than what is in force.
        By how far that is turned, of accepted trials: the share that replaces it, the share that does and is farther off, and how far what
        is in force is off before and after, on the frame's true pixels and as mounted (`pixels_in_force`).
    """
    is_ok = is_accepted(trials)
    # What truth tells nothing of is not called right.
    is_right = is_ok & ~is_wrong(trials) & is_known(trials)
    accepted, rows = trials[is_ok], []
    rows += _shares("", is_ok, is_right)
    rows.append(("", "ok_but_wrong", _per_cent(is_ok & is_wrong(trials)), "%", len(trials)))
    for axis in "xy":
        for metric in ("min", "mean", "max"):
            rows.append(("", f"{axis}_{metric}", float(getattr(accepted[f"all_{axis}_px"], metric)()), "px", len(accepted)))
    for angle, width in _STEPS_DEG.items():
        for step, own in trials.groupby((trials[f"{angle}_deg"] // width).astype(int)):
            name = f"{angle} {step * width:g} to {(step + 1) * width:g} deg"
            rows += _shares(name, is_ok[own.index], is_right[own.index])
    rows += [row for name, own in _by_error_in_force(accepted) for row in _replacements(name, own)]
    for (turn, step), own in bins.groupby(["turn_step_deg", "step_m"]):
        name, right = f"bins {turn:g} deg {step:g} m", own[own["is_found"].astype(bool)]
        rows.append((name, "failed", 100 * (1 - len(right) / len(own)), "%", len(own)))
        rows.append((name, "rotation", float(right["rotation_deg"].mean()), "deg", len(right)))
        rows.append((name, "translation", float(right["translation_m"].mean()), "m", len(right)))
    return pd.DataFrame(rows, columns=["set", "metric", "value", "unit", "n"])


def is_accepted(trials: pd.DataFrame) -> pd.Series:
    """(N,) bool: trials that all gates accept but the last, to be better than the calibration in force."""
    return trials["status"].isin(_PASSING)


def pixels_in_force(accepted: pd.DataFrame, as_mounted: bool) -> tuple[pd.Series, pd.Series]:
    """(N,) pixels that what is in force is off, before and after accepted trials.

    Args:
        accepted: trials.
        as_mounted: mean distances from where the true mounting has static points. Else the mean errors of all static points of the trial's
            own frame from the true pixels in x and y, squared, added, and the root; there what is new has the error of the clocks in it,
            which in a turn moves pixels, and what was in force has not.
    """
    if as_mounted:
        before, new = accepted["in_force_mounting_px"].astype(float), accepted["mounting_px"].astype(float)
    else:
        before, new = (np.hypot(*(accepted[f"{of}_{axis}_px"].astype(float) for axis in "xy")) for of in ("in_force", "all"))
    return before, before.where(accepted["status"] != "ok", new)


def _by_error_in_force(accepted: pd.DataFrame) -> Iterator[tuple[str, pd.DataFrame]]:
    yield "in force", accepted
    for low, high in pairwise(_IN_FORCE_DEG):
        own = accepted[(accepted["in_force_deg"] >= low) & (accepted["in_force_deg"] < high)]
        if len(own):
            yield f"in force {low:g} to {high:g} deg" if np.isfinite(high) else f"in force from {low:g} deg", own


def _replacements(name: str, accepted: pd.DataFrame) -> list[tuple]:
    is_replaced = accepted["status"] == "ok"
    rows = [(name, "replaced", _per_cent(is_replaced), "%", len(accepted))]
    for as_mounted, of in ((False, ""), (True, "mounting_")):
        before, after = pixels_in_force(accepted, as_mounted)
        rows.append((name, f"{of}worse", _per_cent(after > before), "%", len(accepted)))
        rows += [(name, f"{of}{when}", float(px.mean()), "px", len(accepted)) for when, px in (("before", before), ("after", after))]
    return rows


def _shares(name: str, is_ok: pd.Series, is_right: pd.Series) -> list[tuple]:
    return [(name, metric, _per_cent(flags), "%", len(flags)) for metric, flags in (("accepted", is_ok), ("right", is_right))]


def _per_cent(flags: pd.Series) -> float:
    return 100 * float(flags.mean()) if len(flags) else np.nan
