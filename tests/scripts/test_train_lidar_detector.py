"""train_lidar_detector on a tiny drive."""

import pandas as pd
import yaml

from scripts import train_lidar_detector
from streetscan.calibration.detectors.opening import open_lidar_detector
from streetscan.simulation.layout import GENERATOR_VERSION


def test_weights_that_the_detector_takes(detection_drive, tmp_path):
    outputs = [str(tmp_path / name) for name in ("weights.safetensors", "settings.yaml", "history.csv")]
    schedule = {"n_steps": 2, "batch": 1, "seed": 1}
    train_lidar_detector.main([detection_drive.mcap], [detection_drive.truth], outputs, schedule, 1)
    open_lidar_detector("street", outputs[:2], {"min_score": 0.3})
    settings = yaml.safe_load((tmp_path / "settings.yaml").read_text())
    assert settings["generator_version"] == GENERATOR_VERSION
    assert settings["classes"] == ["pedestrian", "tram_bus", "car"]
    assert pd.read_csv(outputs[2])["step"].tolist() == [2]
