"""segment_frames on a tiny drive."""

import numpy as np
import pandas as pd
import pytest
from toy_drives import write_drive

from scripts import segment_frames
from streetscan.errors import BadInput
from streetscan.frames import Mounting
from streetscan.geometry import transform

OPTIONS = {"grid": {}, "foot_method": "none", "foot_m": 0.1, "outlier_neighbours": 0}


def test_classes(registered_drive):
    summary = pd.read_csv(registered_drive.folder / "classes.csv")
    assert len(summary) == registered_drive.n_frames
    assert (summary.n_ground[summary.frame != 4] > 1000).all()
    assert summary.loc[4, ["n_sparse", "n_ground", "n_short_object", "n_tall_structure"]].sum() == 0
    assert 100 * summary.n_sparse.sum() / summary.filter(like="n_").to_numpy().sum() < 20
    timings = pd.read_csv(registered_drive.folder / "grid_timings.csv")
    assert timings.frame.tolist() == summary.frame.tolist()
    assert (timings.duration_s > 0).all()


@pytest.mark.parametrize(
    ("mountings", "said"),
    [
        ((), "how high the lidar is"),
        ((Mounting("vehicle", "gps", transform([0, 0, 1.8])),), "how high the lidar is"),
        ((Mounting("vehicle", "lidar", transform([0, 0, 0])),), "above the road"),
    ],
)
def test_a_drive_must_say_how_high_its_lidar_is(tmp_path, mountings, said):
    write_drive(tmp_path / "drive.mcap", [np.zeros((5, 3), np.float32)], mountings)
    with pytest.raises(BadInput, match=said):
        segment_frames.main(tmp_path / "drive.mcap", tmp_path / "c.npz", tmp_path / "c.csv", tmp_path / "t.csv", **OPTIONS)
    assert [p.name for p in tmp_path.iterdir()] == ["drive.mcap"]


def test_the_vehicle_may_be_given_in_the_lidar(tmp_path):
    points = np.random.default_rng(1).uniform(-10, 10, (20000, 3)).astype(np.float32)
    points[:, 2] = -1.8
    outputs = {}
    for name, mounting in (("a", ("vehicle", "lidar", 1.8)), ("b", ("lidar", "vehicle", -1.8))):
        write_drive(tmp_path / f"{name}.mcap", [points], (Mounting(*mounting[:2], transform([0, 0, mounting[2]])),))
        segment_frames.main(tmp_path / f"{name}.mcap", tmp_path / "c.npz", tmp_path / f"{name}.csv", tmp_path / "t.csv", **OPTIONS)
        outputs[name] = (tmp_path / f"{name}.csv").read_text()
    assert outputs["a"] == outputs["b"]
    assert pd.read_csv(tmp_path / "a.csv").n_ground[0] > 19_900
