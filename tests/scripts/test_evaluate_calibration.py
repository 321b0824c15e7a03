"""The toy's calibration scored against its truth."""

import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml
from toy_calibration import START_NS, combine_toy

from scripts import evaluate_calibration
from streetscan.classes import CAR, VEGETATION
from streetscan.geometry import transform
from streetscan.io.mcap import iterate_images

KNOCK = transform([0.5, 0, 0], (0, 0, np.radians(5)))


def evaluate(folder, toy_inputs, calibrated, truth_folder=None) -> dict[str, pd.DataFrame]:
    """The three tables."""
    of_drive = combine_toy(folder, toy_inputs, calibrated)
    paths = {name: folder / f"{name}.csv" for name in ("errors_path", "transforms_path", "scores_path")}
    evaluate_calibration.main(
        drive_path=toy_inputs["drive_path"], truth_folder=truth_folder or toy_inputs["drive_path"].parent / "truth",
        keyframes_path=toy_inputs["keyframes_path"], calibration_paths=[calibrated["calibration_path"]],
        drive_calibration_path=of_drive["calibration_path"], history_path=of_drive["history_path"], **paths,
    )  # fmt: skip
    return {name.removesuffix("_path"): pd.read_csv(path).fillna({"set": "", "stage": ""}) for name, path in paths.items()}


def test_the_drive_is_scored(tmp_path, toy_inputs, calibrated):
    tables = evaluate(tmp_path, toy_inputs, calibrated)
    errors = tables["errors"].set_index("stage")
    assert errors.loc["final", "all_x_px"] < 1
    assert errors.loc["final", "all_y_px"] < 1
    assert errors.loc["final", "speed_kmh"] == pytest.approx(28.8, abs=0.1)
    transforms = tables["transforms"].set_index("keyframe")
    assert transforms.loc["drive", "rotation_deg"] < 0.1
    assert transforms.loc["drive", "translation_m"] < 0.05
    scores = tables["scores"].set_index(["set", "stage", "metric"])["value"]
    assert scores["", "", "accepted"] == 100
    assert scores["slow", "final", "x_mean"] < 1
    assert np.isnan(scores["", "shift", "noticed_after"])


@pytest.mark.parametrize(("from_s", "off"), [(1.0, []), (1.5, ["drive"])])
def test_a_keyframe_is_compared_with_the_place_at_its_image_and_the_drive_with_the_last(from_s, off, tmp_path, toy_inputs, calibrated):
    """The toy's image is at 1.012 s; what it was calibrated to holds at that time."""
    truth_folder = tmp_path / "truth"
    shutil.copytree(toy_inputs["drive_path"].parent / "truth", truth_folder)
    truth = yaml.safe_load((truth_folder / "truth.yaml").read_text())
    place, right = truth["extrinsics"], truth["extrinsics"]["T_camera_lidar"]
    wrong = (KNOCK @ np.array(right)).tolist()
    place["T_camera_lidar"], later = (wrong, right) if from_s < 1.012 else (right, wrong)
    place["shift"] = {"from_image_time_ns": START_NS + round(from_s * 1e9), "T_camera_lidar": later}
    (truth_folder / "truth.yaml").write_text(yaml.safe_dump(truth))
    transforms = evaluate(tmp_path, toy_inputs, calibrated, truth_folder)["transforms"].set_index("keyframe")
    assert transforms.index.tolist() == ["00", "drive"]
    for name, row in transforms.iterrows():
        assert row["rotation_deg"] == pytest.approx(5.0 if name in off else 0.0, abs=0.1)


def test_the_share_of_the_image_that_could_move_is_told(tmp_path, toy_inputs, calibrated):
    truth_folder = tmp_path / "truth"
    shutil.copytree(toy_inputs["drive_path"].parent / "truth", truth_folder)
    assert evaluate(tmp_path, toy_inputs, calibrated)["errors"]["movable_share"].isna().all()
    truth = yaml.safe_load((truth_folder / "truth.yaml").read_text())
    (truth_folder / "truth.yaml").write_text(yaml.safe_dump(truth | {"masks": {"type": "labels"}}))
    (truth_folder / "masks").mkdir()
    time_ns = yaml.safe_load(Path(calibrated["calibration_path"]).read_text())["image_time_ns"]
    for number, image in enumerate(iterate_images(toy_inputs["drive_path"])):
        labels = np.zeros((10, 20), np.uint8)
        labels[:4] = CAR if image.time_ns == time_ns else VEGETATION
        np.savez(truth_folder / "masks" / f"{number:06d}.npz", labels=labels, instances=labels.astype(np.uint32))
    tables = evaluate(tmp_path, toy_inputs, calibrated, truth_folder)
    assert set(tables["errors"]["movable_share"]) == {0.4}
    scores = tables["scores"].set_index("metric")
    assert scores.loc["accepted", "n"] == 1
    assert scores.loc["accepted_open", "n"] == 0
    assert np.isnan(scores.loc["accepted_open", "value"])
