"""register_frames on a tiny drive."""

import numpy as np
import pandas as pd
import pytest
from street_frames import drive
from toy_drives import ALL_FRAMES, write_drive

from scripts import register_frames
from streetscan.errors import BadInput


def test_poses(registered_drive):
    n, folder = registered_drive.n_frames, registered_drive.folder
    table = pd.read_csv(folder / "poses.csv")
    assert table.status.tolist() == ["start", "ok", "ok", "ok", "empty", "ok", "ok", "ok"]
    assert np.allclose(table.x_m.drop(4), 0.6 * np.delete(np.arange(n), 4), atol=0.1)
    assert table.x_m.isna().tolist() == [i == 4 for i in range(n)]
    assert not (folder / "poses.csv.resume").exists()
    assert np.loadtxt(folder / "poses.tum").shape == (n - 1, 8)


def test_chosen_frames(registered_drive, tmp_path):
    registered_drive.register(tmp_path, {"first": 1, "last": 7, "every": 2})
    assert pd.read_csv(tmp_path / "poses.csv").frame.tolist() == [1, 3, 5]
    with pytest.raises(BadInput, match="hold no frame"):
        registered_drive.register(tmp_path, {"first": 8, "last": None, "every": 1})


@pytest.mark.parametrize("method", ["gicp", "vgicp", "kiss_icp"])
def test_peers(registered_drive, tmp_path, method):
    registered_drive.register(tmp_path, method=method, classes=["tall_structure"], thin_m=0.25, min_overlap=0.1)
    table = pd.read_csv(tmp_path / "poses.csv")
    assert table.status.tolist() == ["start", "ok", "ok", "ok", "empty", "ok", "ok", "ok"]
    assert abs(table.x_m[7] - 0.6 * 7) < 0.3


def test_a_killed_run_goes_on_unless_its_input_changed(registered_drive, tmp_path, monkeypatch):
    """The second group dies; the next run does not repeat the first, and does once the classes are others."""
    read_groups = []
    original = register_frames.DriveFrames.frames

    def frames(self, first, last):
        read_groups.append(first)
        if first == 3 and len(read_groups) == 2:
            raise KeyboardInterrupt
        yield from original(self, first, last)

    monkeypatch.setattr(register_frames.DriveFrames, "frames", frames)
    with pytest.raises(KeyboardInterrupt):
        registered_drive.register(tmp_path, target="street")
    registered_drive.register(tmp_path, target="street")
    assert read_groups == [0, 3, 3, 6]
    assert (tmp_path / "poses.csv").read_text() == (registered_drive.folder / "poses.csv").read_text()
    read_groups[:] = []
    with pytest.raises(KeyboardInterrupt):
        registered_drive.register(tmp_path, target="street")
    registered_drive.register(tmp_path, {"first": 0, "last": 7, "every": 1}, target="street")
    assert read_groups == [0, 3, 0, 3, 6]


def test_classes_of_another_drive_are_refused(registered_drive, tmp_path):
    points, _ = drive(2)
    write_drive(tmp_path / "other.mcap", [frame[:-5] for frame in points])
    with pytest.raises(BadInput, match="segment_frames"):
        register_frames.main(
            tmp_path / "other.mcap", registered_drive.paths["classes_path"], tmp_path / "p.csv", tmp_path / "p.tum", tmp_path / "t.csv",
            10, ALL_FRAMES, {},
        )  # fmt: skip
    assert not (tmp_path / "p.csv").exists()
