"""One calibration of a drive from its accepted keyframes, and which keyframe's is in force when."""

from collections.abc import Sequence
from pathlib import Path

from streetscan.calibration.calibration_files import read_initial, read_results, write_drive_calibration
from streetscan.calibration.drive_calibration import DriveCalibrationSettings, combine_keyframes, follow_drive, keyframes_in_force
from streetscan.calibration.keyframes import find_camera, read_keyframes
from streetscan.io.tables import save_tables
from streetscan.localization.settings import build
from streetscan.logs import logged
from streetscan.registration.pose_tables import read_pose_table


def main(
    drive_path: str | Path, keyframes_path: str | Path, poses_path: str | Path, calibration_paths: Sequence[str | Path],
    evidence_paths: Sequence[str | Path], calibration_path: str | Path, history_path: str | Path, settings: dict, seed: int,
) -> None:  # fmt: skip
    """
    Args:
        drive_path, keyframes_path, poses_path: the drive, and what choose_keyframes and register_frames made of it.
        calibration_paths, evidence_paths: of calibrate_keyframe, one of each per keyframe.
        calibration_path, history_path: to write: YAML, and a row per keyframe.
        settings: keys of DriveCalibrationSettings.
        seed: of the bootstrap.
    """
    results = read_results(calibration_paths, evidence_paths, read_keyframes(keyframes_path), read_pose_table(poses_path))
    chosen = build(DriveCalibrationSettings, settings, "calibrate_drive")
    held, _ = keyframes_in_force(results, chosen)
    made = combine_keyframes(held, chosen, seed, read_initial(drive_path))
    write_drive_calibration(calibration_path, made, results, find_camera(drive_path))
    save_tables({history_path: follow_drive(results, chosen)})


if __name__ == "__main__":
    with logged(snakemake.log[0]):
        i, o = snakemake.input, snakemake.output
        inputs = {"drive_path": i.drive, "keyframes_path": i.keyframes, "poses_path": i.poses}
        found = {"calibration_paths": list(i.calibrations), "evidence_paths": list(i.evidences)}
        main(**inputs, **found, calibration_path=o.calibration, history_path=o.history, **snakemake.params)
