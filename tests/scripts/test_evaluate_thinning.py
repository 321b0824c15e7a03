"""The step on a toy part: a row per share, network and figure."""

import numpy as np
import pandas as pd
from toy_parts import SETTINGS, make_part

from scripts import evaluate_thinning
from streetscan.io.arrays import save_npy
from streetscan.segmentation.c2cnn import C2CNN, save_network


def test_table(tmp_path):
    grid = make_part(1).grid
    grid.save(tmp_path / "voxels.npz")
    save_npy(tmp_path / "labels.npy", np.where(grid.keys[:, 2] == -20, 0, 6).astype(np.uint8))
    paths = []
    for name in ("c2cnn", "c2cnn_local"):
        paths += [tmp_path / f"{name}.safetensors", tmp_path / f"{name}.yaml"]
        save_network(C2CNN(SETTINGS, seed=1), *paths[-2:])
    path = tmp_path / "out" / "scores.csv"
    evaluate_thinning.main(
        tmp_path / "voxels.npz", tmp_path / "labels.npy", paths, path, models=["c2cnn", "c2cnn_local"], shares=[1.0, 0.2],
        n_per_class=30, seed=1, n_threads=1,
    )  # fmt: skip
    scores = pd.read_csv(path)
    assert set(scores["model"]) == {"c2cnn", "c2cnn_local"}
    assert sorted(set(scores["share"])) == [0.2, 1.0]
