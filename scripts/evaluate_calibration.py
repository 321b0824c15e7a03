"""Pixel errors of a drive's calibrated keyframes, and errors of their transforms, against its truth."""

from collections.abc import Sequence
from pathlib import Path

import pandas as pd

from streetscan.calibration import calibration_evaluation as evaluation
from streetscan.calibration.keyframes import read_keyframe_lidar, read_keyframes
from streetscan.io.files import read_yaml
from streetscan.io.tables import read_csv, save_tables
from streetscan.logs import logged


def main(
    drive_path: str | Path, truth_folder: str | Path, keyframes_path: str | Path, calibration_paths: Sequence[str | Path],
    drive_calibration_path: str | Path, history_path: str | Path, errors_path: str | Path, transforms_path: str | Path,
    scores_path: str | Path,
) -> None:  # fmt: skip
    """
    Args:
        drive_path, truth_folder: drive.mcap and truth/.
        keyframes_path: of choose_keyframes.
        calibration_paths: of calibrate_keyframe, one per keyframe.
        drive_calibration_path, history_path: of calibrate_drive.
        errors_path, transforms_path, scores_path: tables to write: per keyframe and stage, per keyframe and the drive, over all.
    """
    extrinsics = read_yaml(Path(truth_folder) / "truth.yaml").get("extrinsics") or {}
    errors, transforms = [], []
    keyframes, calibrations = read_keyframes(keyframes_path), [read_yaml(path) for path in calibration_paths]
    times_ns = evaluation.times_of_images(keyframes, calibrations)
    shares = evaluation.find_movable_shares(drive_path, truth_folder, times_ns)
    for keyframe, found, time_ns, share in zip(keyframes, calibrations, times_ns, shares, strict=True):
        truth = None
        if found["stages"] and evaluation.has_true_pixels(truth_folder):
            frame = read_keyframe_lidar(drive_path, keyframe)
            truth = evaluation.find_true_pixels(frame, keyframe.lidar_frame, found["image_time_ns"], truth_folder, found)
        errors += evaluation.score_keyframe(found, keyframe.index, truth, share)
        T = found["T_camera_lidar"] if extrinsics else None
        transforms.append(evaluation.score_transform(f"{keyframe.index:02d}", found["status"], T, extrinsics, time_ns))
    drive = read_yaml(drive_calibration_path)
    # What was kept was not found here.
    T = drive["T_camera_lidar"] if extrinsics and drive["status"] == "ok" else None
    of_drive = {"offset_s": drive["time_offset_s"], "std": drive.get("std"), "bend": drive.get("bend")}
    transforms.append(evaluation.score_transform("drive", drive["status"], T, extrinsics, **of_drive))
    tables = pd.DataFrame(errors, columns=evaluation.COLUMNS), pd.DataFrame(transforms, columns=evaluation.TRANSFORM_COLUMNS)
    scores = evaluation.summarize_errors(*tables, read_csv(history_path, ("is_shifted", "in_force"), "calibrate_drive"))
    save_tables({errors_path: tables[0], transforms_path: tables[1], scores_path: scores})


if __name__ == "__main__":
    with logged(snakemake.log[0]):
        i, o = snakemake.input, snakemake.output
        inputs = {"drive_path": i.drive, "truth_folder": i.truth, "keyframes_path": i.keyframes}
        found = {"calibration_paths": list(i.calibrations), "drive_calibration_path": i.drive_calibration, "history_path": i.history}
        main(**inputs, **found, errors_path=o.errors, transforms_path=o.transforms, scores_path=o.scores)
