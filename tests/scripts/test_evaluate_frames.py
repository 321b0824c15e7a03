"""evaluate_frames on a tiny drive whose labels say what each point of it is."""

import numpy as np
import pandas as pd
import pytest
import yaml

from scripts import evaluate_frames
from streetscan.errors import BadInput
from streetscan.io.mcap import iterate_lidar

ROAD, BUILDING, OTHER = 40, 50, 99


def write_truth(folder, drive_path, ids="semantickitti", n_dropped=0):
    """Everything at the height of the road is road, what is higher than a car is building."""
    (folder / "labels").mkdir(parents=True)
    for i, frame in enumerate(iterate_lidar(drive_path)):
        z = frame.points[:, 2]
        labels = np.where(z < -1.7, ROAD, np.where(z > 0.2, BUILDING, OTHER)).astype(np.uint32)
        np.save(folder / "labels" / f"{i:06d}.npy", labels[n_dropped:] | 7 << 16)
    (folder / "truth.yaml").write_text(yaml.safe_dump({"labels": {"ids": ids}}))


def test_precision_and_recall(registered_drive, tmp_path):
    drive_path, classes_path = registered_drive.paths.values()
    write_truth(tmp_path / "truth", drive_path)
    evaluate_frames.main(tmp_path / "truth", classes_path, tmp_path / "scores.csv")
    table = pd.read_csv(tmp_path / "scores.csv").set_index(["class", "metric"])
    assert table.loc[("ground", "precision"), "value"] > 99
    assert table.loc[("tall_structure", "recall"), "value"] > 90
    assert np.isnan(table.loc[("short_object", "recall"), "value"])


@pytest.mark.parametrize("wrong", [{"ids": "cityscapes"}, {"n_dropped": 3}])
def test_labels_that_do_not_fit(registered_drive, tmp_path, wrong):
    drive_path, classes_path = registered_drive.paths.values()
    write_truth(tmp_path / "truth", drive_path, **wrong)
    with pytest.raises(BadInput):
        evaluate_frames.main(tmp_path / "truth", classes_path, tmp_path / "scores.csv")
    assert not (tmp_path / "scores.csv").exists()
