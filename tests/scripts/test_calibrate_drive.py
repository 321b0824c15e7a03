"""The calibration of a drive of one toy keyframe, accepted or not."""

import numpy as np
import pandas as pd
import yaml
from toy_calibration import T_CAMERA_LIDAR, calibrate_toy, combine_toy
from toy_drives import write_drive

from streetscan.frames import Mounting
from streetscan.geometry import invert


def test_the_drive_has_a_calibration_with_its_deviation(tmp_path, toy_inputs, calibrated):
    outputs = combine_toy(tmp_path, toy_inputs, calibrated)
    found = yaml.safe_load(outputs["calibration_path"].read_text())
    assert found["status"] == "ok"
    assert found["keyframes"] == {"ok": 1}
    np.testing.assert_allclose(found["T_camera_lidar"], T_CAMERA_LIDAR, atol=0.05)
    assert np.array(found["covariance"]).shape == (7, 7)
    assert pd.read_csv(outputs["history_path"])["action"].tolist() == ["replaced"]


def test_without_an_accepted_keyframe_it_has_none(tmp_path, toy_inputs):
    (tmp_path / "summary.csv").write_text("keyframe,status,reason,reference\n00,not_matched,no two images,-1\n")
    refused = calibrate_toy(tmp_path, toy_inputs | {"model_summary_path": tmp_path / "summary.csv"})
    outputs = combine_toy(tmp_path, toy_inputs, refused)
    found = yaml.safe_load(outputs["calibration_path"].read_text())
    assert (found["status"], found["keyframes"], found["T_camera_lidar"]) == ("no_keyframes", {"not_matched": 1}, None)
    assert pd.read_csv(outputs["history_path"])["action"].tolist() == ["none"]


def test_a_drive_without_intrinsics_goes_through(tmp_path, toy_inputs):
    (tmp_path / "summary.csv").write_text("keyframe,status,reason,reference\n00,bad_intrinsics,no intrinsics,-1\n")
    write_drive(tmp_path / "bare.mcap", [np.ones((3, 3), np.float32)])
    inputs = toy_inputs | {"model_summary_path": tmp_path / "summary.csv", "drive_path": tmp_path / "bare.mcap"}
    refused = calibrate_toy(tmp_path, inputs)
    found = yaml.safe_load(combine_toy(tmp_path, inputs, refused)["calibration_path"].read_text())
    assert (found["status"], found["keyframes"]) == ("no_keyframes", {"bad_intrinsics": 1})
    assert "camera_matrix" not in found


def test_without_an_accepted_keyframe_the_user_s_own_stays(tmp_path, toy_inputs):
    (tmp_path / "summary.csv").write_text("keyframe,status,reason,reference\n00,not_matched,no two images,-1\n")
    own = Mounting("lidar", "camera", invert(T_CAMERA_LIDAR), "tape measure")
    write_drive(tmp_path / "mounted.mcap", [np.ones((3, 3), np.float32)], (own,))
    inputs = toy_inputs | {"model_summary_path": tmp_path / "summary.csv", "drive_path": tmp_path / "mounted.mcap"}
    outputs = combine_toy(tmp_path, inputs, calibrate_toy(tmp_path, inputs))
    found = yaml.safe_load(outputs["calibration_path"].read_text())
    assert found["status"] == "kept"
    np.testing.assert_allclose(found["T_camera_lidar"], T_CAMERA_LIDAR, atol=1e-9)
    assert found["time_offset_s"] is None
    assert pd.read_csv(outputs["history_path"])["reason"].tolist() == ["no two images"]
