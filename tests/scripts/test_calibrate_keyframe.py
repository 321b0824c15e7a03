"""A toy keyframe calibrated; keyframes that cannot be, and input of other steps that does not fit."""

import numpy as np
import pandas as pd
import pytest
import yaml
from toy_calibration import T_CAMERA_LIDAR, calibrate_toy, toy_keyframe

from streetscan.errors import BadInput


def test_the_calibration_is_written_with_its_verdict(calibrated):
    found = yaml.safe_load(calibrated["calibration_path"].read_text())
    assert found["status"] == "ok", found["reason"]
    np.testing.assert_allclose(found["T_camera_lidar"], T_CAMERA_LIDAR, atol=0.03)
    assert np.array(found["projection"]).shape == (3, 4)
    assert {"image_width", "camera_matrix", "distortion_model", "stages", "residuals_px"} <= set(found)
    row = pd.read_csv(calibrated["summary_path"], dtype={"keyframe": str}).iloc[0]
    assert (row.keyframe, row.status) == ("00", "ok")
    assert row.n_matched >= 4
    assert row.n_shots == 1


def test_the_pictures_are_drawn(calibrated):
    names = {path.stem for path in calibrated["pictures_folder"].glob("*.png")}
    assert names == {
        "lidar_objects", "sfm_objects", "lidar_shapes", "sfm_shapes", "aligned_objects", "aligned", "overlay", "overlay_before", "curves",
        "overlay_place", "overlay_curves", "matched", "lidar_pillars", "sfm_pillars", "aligned_start", "aligned_curves",
    }  # fmt: skip


def test_with_moving_things_it_is_drawn_what_they_do_to_the_alignment(tmp_path, toy_inputs):
    is_dynamic = np.arange(len(toy_keyframe().clouds.points_lidar)) < 5
    np.savez(tmp_path / "00.npz", is_dynamic=is_dynamic)
    calibrated = calibrate_toy(tmp_path, toy_inputs, dynamic_folder=tmp_path)
    names = {path.stem for path in calibrated["pictures_folder"].glob("*.png")}
    assert {"overlay_raw", "aligned_raw"} <= names


def test_a_keyframe_that_was_not_reconstructed_keeps_its_status(tmp_path, toy_inputs):
    (tmp_path / "summary.csv").write_text("keyframe,status,reason,reference\n00,not_matched,no two images,-1\n")
    outputs = calibrate_toy(tmp_path, toy_inputs | {"model_summary_path": tmp_path / "summary.csv"})
    found = yaml.safe_load(outputs["calibration_path"].read_text())
    assert (found["status"], found["reason"], found["projection"]) == ("not_matched", "no two images", None)
    assert pd.read_csv(outputs["summary_path"]).loc[0, "status"] == "not_matched"


def test_moving_points_of_another_frame_are_refused(tmp_path, toy_inputs):
    np.savez(tmp_path / "00.npz", is_dynamic=np.zeros(5, bool))
    with pytest.raises(BadInput, match="5 points for a frame of"):
        calibrate_toy(tmp_path, toy_inputs, dynamic_folder=tmp_path)


def test_an_unknown_setting_is_refused(tmp_path, toy_inputs):
    with pytest.raises(BadInput, match="no such key"):
        calibrate_toy(tmp_path, toy_inputs, settings={"allignment": {}})
