"""Camera and lidar calibrated at one keyframe, with a verdict and pictures."""

from pathlib import Path

import pandas as pd

from streetscan.calibration.calibration_files import read_clouds, summarize, write_calibration
from streetscan.calibration.calibration_pictures import write_pictures
from streetscan.calibration.keyframe_calibration import CalibrationSettings, KeyframeCalibration, calibrate_keyframe
from streetscan.calibration.keyframes import find_camera, read_keyframes
from streetscan.io.arrays import save_npz
from streetscan.io.atomic import atomic_folder
from streetscan.io.tables import save_tables
from streetscan.localization.settings import build
from streetscan.logs import logged
from streetscan.registration.pose_tables import read_pose_table


def main(
    drive_path: str | Path, keyframes_path: str | Path, poses_path: str | Path, model_folder: str | Path, model_summary_path: str | Path,
    dynamic_folder: str | Path | None, calibration_path: str | Path, evidence_path: str | Path, pictures_folder: str | Path,
    summary_path: str | Path, keyframe: int, settings: dict,
) -> None:  # fmt: skip
    """
    Args:
        drive_path, keyframes_path, poses_path: the drive, and what choose_keyframes and register_frames made of it.
        model_folder, model_summary_path: of reconstruct_keyframe.
        dynamic_folder: moving points of lidar frames, of detect_dynamic; None takes none for moving.
        calibration_path, evidence_path, pictures_folder, summary_path: to write: YAML, .npz, PNG, one row.
        keyframe: its number.
        settings: keys of CalibrationSettings.
    """
    checked = build(CalibrationSettings, settings, "calibrate_keyframe.settings")
    chosen, model = read_keyframes(keyframes_path)[keyframe], pd.read_csv(model_summary_path, keep_default_na=False).iloc[0]
    made = KeyframeCalibration(model.status, model.reason)
    with atomic_folder(pictures_folder) as pictures:
        if model.status == "ok":
            clouds = read_clouds(drive_path, chosen, model_folder, read_pose_table(poses_path), dynamic_folder)
            made = calibrate_keyframe(clouds, checked)
            write_pictures(pictures, made, clouds, checked.objects)
        write_calibration(calibration_path, made, chosen, int(model.reference), find_camera(drive_path))
        save_npz(evidence_path, evidence=made.evidence)
        save_tables({summary_path: summarize(made, keyframe)})


if __name__ == "__main__":
    with logged(snakemake.log[0]):
        i, o = snakemake.input, snakemake.output
        inputs = {"drive_path": i.drive, "keyframes_path": i.keyframes, "poses_path": i.poses, "dynamic_folder": i.dynamic or None}
        outputs = {"calibration_path": o.calibration, "evidence_path": o.evidence, "pictures_folder": o.pictures, "summary_path": o.summary}
        main(**inputs, model_folder=i.model, model_summary_path=i.model_summary, **outputs, **snakemake.params)
