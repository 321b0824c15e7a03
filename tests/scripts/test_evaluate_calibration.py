"""The toy's calibration scored against its truth."""

import pandas as pd
import pytest
from toy_calibration import combine_toy

from scripts import evaluate_calibration


def test_the_drive_is_scored(tmp_path, toy_inputs, calibrated):
    of_drive = combine_toy(tmp_path, toy_inputs, calibrated)
    paths = {name: tmp_path / f"{name}.csv" for name in ("errors_path", "transforms_path", "scores_path")}
    evaluate_calibration.main(
        drive_path=toy_inputs["drive_path"], truth_folder=toy_inputs["drive_path"].parent / "truth",
        keyframes_path=toy_inputs["keyframes_path"], calibration_paths=[calibrated["calibration_path"]],
        drive_calibration_path=of_drive["calibration_path"], **paths,
    )  # fmt: skip
    errors = pd.read_csv(paths["errors_path"]).set_index("stage")
    assert errors.loc["final", "all_x_px"] < 1
    assert errors.loc["final", "all_y_px"] < 1
    assert errors.loc["final", "speed_kmh"] == pytest.approx(28.8, abs=0.1)
    transforms = pd.read_csv(paths["transforms_path"]).set_index("keyframe")
    assert transforms.loc["drive", "rotation_deg"] < 0.1
    assert transforms.loc["drive", "translation_m"] < 0.05
    scores = pd.read_csv(paths["scores_path"], keep_default_na=False).set_index(["set", "stage", "metric"])["value"]
    assert float(scores["", "", "accepted"]) == 100
    assert float(scores["slow", "final", "x_mean"]) < 1
