"""train_image_detector on a tiny drive."""

import pandas as pd
import pytest
import yaml

from scripts import train_image_detector
from streetscan.calibration.detectors.opening import open_image_detector
from streetscan.errors import BadInput
from streetscan.simulation.layout import GENERATOR_VERSION

NETWORK = {"width": 128, "channels": [4, 4, 8, 8], "min_centre": 0.2, "min_pixels": 4, "centre_reach": 2}
SCHEDULE = {"n_steps": 3, "batch": 1, "cut": [32, 48], "class_weights": [1, 1, 1, 1], "seed": 1}


def test_weights_that_the_detector_takes(detection_drive, tmp_path):
    outputs = [str(tmp_path / name) for name in ("weights.safetensors", "settings.yaml", "history.csv")]
    train_image_detector.main([detection_drive.mcap], [detection_drive.truth], outputs, NETWORK, SCHEDULE, 1)
    open_image_detector("city", outputs[:2], {})
    settings = yaml.safe_load((tmp_path / "settings.yaml").read_text())
    assert settings["generator_version"] == GENERATOR_VERSION
    assert settings["channels"] == NETWORK["channels"]
    assert pd.read_csv(outputs[2])["step"].tolist() == [3]


def test_a_drive_without_masks(detection_drive, tmp_path):
    (tmp_path / "truth").mkdir()
    with pytest.raises(BadInput, match=r"masks/000000\.npz"):
        train_image_detector.main([detection_drive.mcap], [str(tmp_path / "truth")], [], NETWORK, SCHEDULE, 1)
