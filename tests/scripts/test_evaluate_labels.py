import numpy as np
import pandas as pd
import pytest

from scripts.evaluate_labels import main
from streetscan.errors import BadInput
from streetscan.io.label_tiles import write_label_tile

GROUPS = {"vehicle": ["car", "tram_bus"], "pole_like": ["column"]}


@pytest.fixture
def paths(tiny_world, tmp_path):
    """Truth, the truth as prediction in three parts, and the two tables to write."""
    truth = tiny_world.labels
    np.save(tmp_path / "labels.npy", truth)
    tiles = [tmp_path / f"voxels_{k}of3.npz" for k in range(3)]
    for path, rows in zip(tiles, np.array_split(np.arange(len(truth)), 3), strict=True):
        write_label_tile(path, rows, np.where(truth == 255, 0, truth)[rows], np.ones(len(rows)))
    return [tmp_path / "labels.npy", tiles, tmp_path / "out" / "scores.csv", tmp_path / "out" / "confusion.csv"]


def test_truth_scores_perfectly(paths, tiny_world):
    main(*paths, n_per_class=200, groups=GROUPS, seed=1)
    scores, confusion = pd.read_csv(paths[2]), pd.read_csv(paths[3])
    assert (scores.value[(scores.unit == "%") & (scores.metric != "calibration_error")] == 100.0).all()
    even = scores[(scores.protocol == "even") & (scores["class"] == "car")]
    assert (even.n == 200).all()
    assert confusion.n.sum() == 9 * 200 + (tiny_world.labels != 255).sum()


def test_the_seed_draws_the_even_set(paths):
    tile = paths[1][0]
    labels = np.load(tile)["labels"]
    write_label_tile(tile, np.load(tile)["rows"], (labels + np.arange(len(labels)) % 2) % 9, np.ones(len(labels)))
    texts = []
    for seed in (1, 1, 2):
        main(*paths, n_per_class=200, groups={}, seed=seed)
        texts.append(paths[2].read_text())
    assert texts[0] == texts[1] != texts[2]


def test_smoothed_labels_are_scored_beside_those_before(paths, tiny_world):
    for path in paths[1]:
        rows, labels = np.load(path)["rows"], np.load(path)["labels"]
        write_label_tile(path, rows, labels, np.ones(len(rows)), np.where(labels == 5, 0, labels))
    main(*paths, n_per_class=200, groups=GROUPS, seed=1)
    scores, confusion = pd.read_csv(paths[2]), pd.read_csv(paths[3])
    recall = scores[(scores["class"] == "car") & (scores.metric == "recall") & (scores.protocol == "even")].set_index("labels")["value"]
    assert recall.to_dict() == {"map": 100.0, "alone": 0.0}
    # Only the map has a confidence.
    assert set(scores.labels[scores.metric == "calibration_error"]) == {"map"}
    assert (confusion.groupby("labels").n.sum() == 9 * 200 + (tiny_world.labels != 255).sum()).all()


def test_a_missing_part_leaves_no_table(paths):
    paths[1] = paths[1][:2]
    with pytest.raises(BadInput, match="in no part"):
        main(*paths, n_per_class=200, groups={}, seed=1)
    assert not paths[2].exists()
