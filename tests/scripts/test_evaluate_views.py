"""evaluate_views on the tiny street."""

import numpy as np
import pandas as pd
import pytest

from scripts import evaluate_views
from streetscan.classes import CAR, FACADE, GROUND, UNLABELLED
from streetscan.errors import BadInput
from streetscan.io.label_tiles import write_label_tile
from streetscan.voxels import voxelize


@pytest.fixture
def inputs(tiny_map, tiny_world, tmp_path):
    """The map, its grid, its label map in two parts and the truth of its voxels."""
    grid = voxelize([tiny_world.cloud.points], 0.2)
    grid.save(tmp_path / "voxels.npz")
    true = np.full(len(grid), UNLABELLED, np.uint8)
    true[grid.find(grid.keys_of(tiny_world.cloud.points))] = tiny_world.labels
    np.save(tmp_path / "labels.npy", true)
    labels = np.where(true == UNLABELLED, GROUND, true)
    rows = np.arange(len(grid))
    paths = []
    for k in range(2):
        part = rows[k::2]
        paths.append(str(tmp_path / f"voxels_{k}of2.npz"))
        write_label_tile(paths[-1], part, labels[part], np.full(len(part), 0.9))
    return {
        "map_path": str(tiny_map),
        "voxels_path": str(tmp_path / "voxels.npz"),
        "prediction_paths": paths,
        "width_px": 120,
        "reach_m": 60.0,
        "n_failures": 3,
        "k": 9,
    }


def test_pictures_with_truth(inputs, tmp_path):
    evaluate_views.main(**inputs, truth_path=str(tmp_path / "labels.npy"), folder=str(tmp_path / "views"))
    names = {f"{kind}_{side}.png" for kind in ("predicted", "true", "errors") for side in ("top", "street")}
    names |= {f"{kind}_{side}.jpg" for kind in ("intensity", "rgb") for side in ("top", "street")}
    names |= {"true_houses.png", "intensity_houses.jpg", "rgb_houses.jpg"}
    names |= {"class_shares.svg", "reliability.svg", "volumes.png", "failures.csv"}
    assert {p.name for p in (tmp_path / "views").iterdir()} == names


def test_pictures_without_truth(inputs, tmp_path):
    evaluate_views.main(**inputs, truth_path=None, folder=str(tmp_path / "views"))
    labels = {p.name for p in (tmp_path / "views").iterdir() if p.suffix != ".jpg"}
    assert labels == {"predicted_top.png", "predicted_street.png", "class_shares.svg", "volumes.png"}


def test_an_incomplete_label_map_is_refused(inputs, tmp_path):
    with pytest.raises(BadInput, match="in no part"):
        evaluate_views.main(
            **inputs | {"prediction_paths": inputs["prediction_paths"][:1]}, truth_path=None, folder=str(tmp_path / "views")
        )
    assert not (tmp_path / "views").exists()


def test_failures_are_drawn_and_listed(inputs, tmp_path):
    true = np.load(tmp_path / "labels.npy")
    called_facade = np.where(true == CAR, FACADE, np.where(true == UNLABELLED, GROUND, true))
    for k, path in enumerate(inputs["prediction_paths"]):
        rows = np.arange(len(true))[k::2]
        write_label_tile(path, rows, called_facade[rows], np.full(len(rows), 0.9))
    evaluate_views.main(**inputs, truth_path=str(tmp_path / "labels.npy"), folder=str(tmp_path / "views"))
    failures = pd.read_csv(tmp_path / "views" / "failures.csv")
    assert failures[["true", "predicted"]].to_numpy().tolist() == [["car", "facade"]]
    assert (tmp_path / "views" / "failures.png").is_file()
