"""The step on a toy part: figures and time by turns and smoothing."""

import numpy as np
import pandas as pd
from toy_parts import SETTINGS, make_part

from scripts import evaluate_refinements
from streetscan.io.arrays import save_npy
from streetscan.segmentation.c2cnn import C2CNN, save_network
from streetscan.segmentation.inference import label_voxels


def test_table(tmp_path):
    grid, network = make_part(1).grid, C2CNN(SETTINGS, seed=1)
    grid.save(tmp_path / "voxels.npz")
    truth = np.where(grid.keys[:, 2] == -20, 0, 6).astype(np.uint8)
    truth[::40] = 255
    save_npy(tmp_path / "labels.npy", truth)
    paths = tmp_path / "weights.safetensors", tmp_path / "settings.yaml"
    save_network(network, *paths)
    evaluate_refinements.main(
        tmp_path / "voxels.npz", tmp_path / "labels.npy", paths, tmp_path / "scores.csv",
        smoothing={"cell_voxels": 2, "n_rounds": 4, "sharpness": 2.0}, tile_m=5.0, n_per_class=30, seed=1, n_threads=1,
    )  # fmt: skip
    scores = pd.read_csv(tmp_path / "scores.csv")
    by_kind = scores.groupby(["n_turns", "is_smoothed"])
    assert list(by_kind.groups) == [(1, False), (1, True), (4, False), (4, True)]
    assert (by_kind["metric"].agg(set).map(lambda found: {"f", "accuracy", "calibration_error", "time"} <= found)).all()
    alone = scores[(scores["n_turns"] == 1) & ~scores["is_smoothed"] & (scores["protocol"] == "natural")].set_index(["class", "metric"])
    labels = label_voxels(network, grid, 5.0).labels
    assert np.isclose(alone.loc[("overall", "accuracy"), "value"], 100 * (labels == truth)[truth != 255].mean())
    assert (scores.loc[scores["metric"] == "time", "value"] > 0).all()
