"""A tiny drive through segment_frames, register_frames and merge_frames; a toy keyframe through calibrate_keyframe."""

import numpy as np
import pytest
from street_frames import drive
from toy_calibration import calibrate_toy, toy_keyframe, write_keyframe
from toy_drives import RegisteredDrive, write_drive
from toy_localization import write_files

from scripts import merge_frames, segment_frames
from streetscan.io.trajectories import write_poses_csv


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
def toy_inputs(tmp_path_factory):
    """What the steps before calibrate_keyframe write, of a toy keyframe."""
    return write_keyframe(tmp_path_factory.mktemp("toy_keyframe"), toy_keyframe())


@pytest.fixture(scope="session")
def calibrated(tmp_path_factory, toy_inputs):
    """The outputs of calibrate_keyframe for it."""
    return calibrate_toy(tmp_path_factory.mktemp("calibrated"), toy_inputs)
