"""Networks on thinned maps: the same voxels for all, fewer of them with fewer points."""

import numpy as np

from streetscan.segmentation.c2cnn import C2CNN, Settings
from streetscan.segmentation.thinning import COLUMNS, score_thinned


def test_scores_by_share_and_network(toy_part):
    grid = toy_part.grid
    labels = np.where(grid.keys[:, 2] == -20, 0, 6).astype(np.uint8)
    labels[::50] = 255
    networks = {"a": C2CNN(toy_part.settings, seed=1), "b": C2CNN(Settings(k=9, count_scale="local"), seed=2)}
    scores = score_thinned(networks, grid, labels, (1.0, 0.1), n_per_class=40, seed=0)
    assert tuple(scores.columns) == COLUMNS
    accuracy = scores[(scores["class"] == "overall") & (scores["metric"] == "accuracy")]
    assert accuracy[["share", "model"]].to_numpy().tolist() == [[1.0, "a"], [1.0, "b"], [0.1, "a"], [0.1, "b"]]
    assert (accuracy["n"] == 80).all()
    again = score_thinned(networks, grid, labels, (1.0, 0.1), n_per_class=40, seed=0)
    assert scores.equals(again)
