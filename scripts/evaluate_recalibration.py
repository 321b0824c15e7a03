"""A drive's keyframes calibrated again and again with other lidar frames and starts, and the bins of the vote changed, against truth."""

import pandas as pd

from streetscan.benchmarks.figures import save_figure, trial_errors
from streetscan.calibration import recalibration
from streetscan.calibration.detectors.opening import open_lidar_detector
from streetscan.calibration.dynamic_objects import find_dynamic_points
from streetscan.calibration.keyframe_calibration import CalibrationSettings
from streetscan.calibration.keyframes import read_keyframes
from streetscan.io.tables import save_tables
from streetscan.localization.settings import build
from streetscan.logs import logged
from streetscan.registration.pose_tables import read_pose_table


def main(
    drive: str, truth: str, keyframes: str, poses: str, models: list[str], lidar_files: list[str], lidar_detector: dict, margin_m: float,
    foot_m: float, settings: dict, n_trials: int, max_step: int, max_tilt_deg: float, max_in_force_deg: float, max_in_force_m: float,
    bins: list[dict], seed: int, n_threads: int, trials: str, sizes: str, scores: str, figure: str,
) -> None:  # fmt: skip
    """
    Args:
        drive, truth: drive.mcap and truth/.
        keyframes, poses, models: of choose_keyframes, register_frames and reconstruct_keyframe, one model per keyframe.
        lidar_files, lidar_detector, margin_m, foot_m, n_threads: as in detect_dynamic.
        settings: keys of CalibrationSettings.
        n_trials, max_step, max_tilt_deg, max_in_force_deg, max_in_force_m, seed: of `recalibration.draw_trials`.
        bins: sizes of the vote's bins, `turn_step_deg` and `step_m`.
        trials, sizes, scores, figure: to write: a row per trial, per keyframe and size of the bins, over all; a picture.
    """
    detector = open_lidar_detector(lidar_detector["method"], lidar_files, lidar_detector["choice"], n_threads)
    again = recalibration.Recalibrator(
        drive, truth, read_keyframes(keyframes), models, read_pose_table(poses),
        lambda frame: ~find_dynamic_points(detector, frame.points, frame.intensity, margin_m, foot_m).is_dynamic,
        build(CalibrationSettings, settings, "calibrate_keyframe.settings"),
    )  # fmt: skip
    limits = max_tilt_deg, max_in_force_deg, max_in_force_m
    drawn = sorted(recalibration.draw_trials(n_trials, again.usable, max_step, *limits, seed), key=lambda t: t.keyframe)
    of_trials = pd.DataFrame([again.run(t) for t in drawn], columns=recalibration.TRIAL_COLUMNS).sort_values("trial")
    of_bins = pd.DataFrame([r for k in again.usable for r in again.score_bins(k, bins)], columns=recalibration.BIN_COLUMNS)
    save_tables({trials: of_trials, sizes: of_bins, scores: recalibration.summarize_trials(of_trials, of_bins)})
    accepted = recalibration.is_accepted(of_trials)
    save_figure(trial_errors({axis: of_trials[f"all_{axis}_px"].where(accepted).to_numpy() for axis in "xy"}, "difference [px]"), figure)


if __name__ == "__main__":
    with logged(snakemake.log[0]):
        main(**{k: v for k, v in snakemake.input.items() if k != "code"}, **dict(snakemake.output.items()), **snakemake.params)
