"""choose_keyframes on a tiny drive."""

import pandas as pd
from toy_camera import write_camera_drive

from scripts import choose_keyframes


def test_a_row_per_place(tmp_path):
    path = write_camera_drive(tmp_path / "drive.mcap", n_images=4)
    settings = {"n_images": 3, "min_columns": 0, "min_movement_px": 2.0}
    choose_keyframes.main(path, tmp_path / "keyframes.csv", 3, settings)
    table = pd.read_csv(tmp_path / "keyframes.csv", dtype=str)
    assert table.keyframe.tolist() == ["00", "01", "02"]
    assert table.status.tolist() == ["ok", "ok", "no_images"]
    assert table.images.tolist()[:2] == ["0 1 2", "1 2 3"]
    assert table.lidar_frame.tolist() == ["0", "1", "-1"]
