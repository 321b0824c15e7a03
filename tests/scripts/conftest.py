"""A tiny drive through segment_frames, register_frames and merge_frames; a toy keyframe through calibrate_keyframe."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from street_frames import drive
from toy_calibration import calibrate_toy, toy_keyframe, write_keyframe
from toy_drives import RegisteredDrive, write_drive
from toy_localization import write_files

from scripts import merge_frames, segment_frames
from streetscan.calibration.detectors.city import CityNetwork, CitySettings
from streetscan.calibration.detectors.pointpillars import PointPillars, street_settings
from streetscan.io.trajectories import write_poses_csv
from streetscan.io.weights import save_settings, save_weights


@pytest.fixture(scope="session")
def registered_drive(tmp_path_factory) -> RegisteredDrive:
    """The drive, made once; treat it as read-only."""
    made = RegisteredDrive(8, tmp_path_factory.mktemp("drive"))
    folder = made.folder
    points, poses = drive(made.n_frames, speed_mps=6.0)
    points[4] = np.empty((0, 3), np.float32)
    times_ns = write_drive(folder / "drive.mcap", points)
    (folder / "truth").mkdir()
    write_poses_csv(folder / "truth" / "poses.csv", np.arange(made.n_frames), times_ns / 1e9, poses)
    segment_frames.main(
        **made.paths, summary_path=folder / "classes.csv", timings_path=folder / "grid_timings.csv", grid={}, foot_method="reclassify",
        foot_m=0.1, outlier_neighbours=0,
    )  # fmt: skip
    made.register(folder, target="street")
    merge_frames.main(
        **made.paths, poses_path=folder / "poses.csv", tiles_folder=folder / "tiles", elevation_path=folder / "elevation.asc",
        picture_path=folder / "street.png", classes=["ground", "tall_structure"], group_frames=3,
    )  # fmt: skip
    return made


@pytest.fixture(scope="session")
def localization_files(tmp_path_factory):
    """The street of boxes as files, made once; treat them as read-only."""
    return write_files(tmp_path_factory.mktemp("street"))


@pytest.fixture(scope="session")
def detectors(tmp_path_factory) -> dict:
    """Files and settings of two small detectors with random weights, as detect_dynamic takes them."""
    folder = tmp_path_factory.mktemp("detectors")
    torch.manual_seed(1)
    city = CitySettings(width=64, channels=(4, 4, 8, 8))
    street = replace(street_settings(), pillar_channels=4, channels=(4, 4, 4), n_layers=(1, 1, 1), neck_channels=4)
    files = {}
    for name, network, settings in (("image", CityNetwork(city), city), ("lidar", PointPillars(street), street)):
        files[f"{name}_files"] = [str(folder / f"{name}.safetensors"), str(folder / f"{name}_settings.yaml")]
        save_weights(network, files[f"{name}_files"][0])
        save_settings(settings, files[f"{name}_files"][1])
    of_images, of_frames = {"method": "city", "settings": {}}, {"method": "street", "choice": {"min_score": 0.005}}
    return files | {"image_detector": of_images, "lidar_detector": of_frames}


@pytest.fixture(scope="session")
def toy_inputs(tmp_path_factory):
    """What the steps before calibrate_keyframe write, of a toy keyframe."""
    return write_keyframe(tmp_path_factory.mktemp("toy_keyframe"), toy_keyframe())


@pytest.fixture(scope="session")
def calibrated(tmp_path_factory, toy_inputs):
    """The outputs of calibrate_keyframe for it."""
    return calibrate_toy(tmp_path_factory.mktemp("calibrated"), toy_inputs)
