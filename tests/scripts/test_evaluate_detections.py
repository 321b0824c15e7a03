"""evaluate_detections on a tiny drive, with detectors that know nothing yet."""

from pathlib import Path

import pandas as pd
import pytest
import yaml

from scripts import evaluate_detections


def test_scores_of_images_and_frames(detection_drive, detectors, tmp_path):
    scores = tmp_path / "scores.csv"
    evaluate_detections.main(
        detection_drive.mcap, detection_drive.truth, **detectors, margin_m=0.1, foot_m=0.1, n_threads=1, min_pixels=10, range_m=15.0,
        scores=scores,
    )  # fmt: skip
    table = pd.read_csv(scores).set_index(["sensor", "class", "metric"])
    assert table.loc[("image", "car", "instance_recall"), "n"] == detection_drive.n_frames
    assert table.loc[("lidar", "car", "point_recall"), "n"] == 600 * detection_drive.n_frames
    assert table.loc[("lidar", "dynamic", "point_recall"), "n"] == 680 * detection_drive.n_frames
    assert table["value"].dropna().between(0, 100).all()


def test_weights_of_another_network_leave_out_their_sensor(detection_drive, detectors, tmp_path, caplog):
    scores = tmp_path / "scores.csv"
    swapped = detectors | {"image_files": detectors["lidar_files"]}
    evaluate_detections.main(
        detection_drive.mcap, detection_drive.truth, **swapped, margin_m=0.1, foot_m=0.1, n_threads=1, min_pixels=10, range_m=15.0,
        scores=scores,
    )  # fmt: skip
    assert set(pd.read_csv(scores)["sensor"]) == {"lidar"}
    assert "no scores" in caplog.text


@pytest.mark.parametrize("kept", ["labels", "masks"])
def test_drives_with_one_of_both(detection_drive, detectors, tmp_path, kept):
    known = yaml.safe_load(Path(detection_drive.truth, "truth.yaml").read_text())
    folder = tmp_path / "truth"
    folder.mkdir()
    (folder / "truth.yaml").write_text(yaml.safe_dump({kept: known[kept]}))
    for name in ("labels", "masks"):
        (folder / name).symlink_to(f"{detection_drive.truth}/{name}")
    scores = tmp_path / "scores.csv"
    evaluate_detections.main(
        detection_drive.mcap, str(folder), **detectors, margin_m=0.1, foot_m=0.1, n_threads=1, min_pixels=10, range_m=15.0, scores=scores
    )
    assert set(pd.read_csv(scores)["sensor"]) == {"lidar" if kept == "labels" else "image"}
