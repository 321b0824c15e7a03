"""The step on the tiny street: trees that know the classes they were shown, files whole, tiles equal to the whole."""

import numpy as np
import pandas as pd
import pytest

from scripts import label_map, train_baseline
from streetscan.classes import NAMES, UNLABELLED
from streetscan.errors import BadInput
from streetscan.io.arrays import save_npz
from streetscan.io.label_tiles import read_label_tiles
from streetscan.io.las import read_las
from streetscan.segmentation.baselines.boosted_trees import load_trees
from streetscan.segmentation.samples import draw_samples, vote_labels
from streetscan.voxels import voxelize

NEIGHBOURS = [8, 24]
SCHEDULE = {"n_rounds": 12, "n_leaves": 15, "learning_rate": 0.2, "min_leaf": 5, "patience": 5, "seed": 1}
FILES = ("model.txt", "settings.yaml", "history.csv")


@pytest.fixture
def inputs(tiny_world, tiny_map, tmp_path):
    grid = voxelize([tiny_world.cloud.points], 0.2)
    grid.height_m = (grid.mean_z_m - tiny_world.ground_z_m(grid.centres)).astype(np.float32)
    grid.save(tmp_path / "voxels.npz")
    labels = vote_labels(grid, [(tiny_world.cloud.points, tiny_world.labels)])
    parts = {}
    for name, seed in (("training", 1), ("validation", 2)):
        rows, sample_labels = draw_samples(labels, 80, np.random.default_rng(seed))
        save_npz(tmp_path / f"{name}.npz", keys=grid.keys[rows], labels=sample_labels)
        parts[name] = [tmp_path / "voxels.npz", tmp_path / f"{name}.npz"]
    return parts | {"map_path": tiny_map, "labels": labels}


def train(inputs, folder, **more):
    outputs = [folder / name for name in FILES]
    parts = {name: inputs[name] for name in ("training", "validation")}
    train_baseline.main(**parts, outputs=outputs, **({"neighbours": NEIGHBOURS, "schedule": SCHEDULE, "n_threads": 1} | more))
    return outputs


def label(inputs, network_paths, folder, tiles, neighbours=NEIGHBOURS):
    paths = folder / f"map_{tiles}.laz", folder / f"voxels_{tiles}.npz"
    voxels = inputs["training"][0]
    label_map.main(inputs["map_path"], voxels, network_paths, *paths, tiles, 4.0, 1, None, 1, "cpu", {"neighbours": neighbours})
    return paths


def test_trees_learn_the_street_and_their_history_is_kept(inputs, tmp_path):
    outputs = train(inputs, tmp_path / "trees")
    assert sorted(p.name for p in (tmp_path / "trees").iterdir()) == sorted(FILES)
    history = pd.read_csv(outputs[2])
    assert history.epoch.tolist() == list(range(1, len(history) + 1))
    assert history.train_loss.iloc[-1] < history.train_loss.iloc[0]
    assert history.validation_accuracy.max() > 0.8
    paths = label(inputs, outputs[:2], tmp_path / "out", "0of1")
    predicted, confidence = read_label_tiles([paths[1]], len(inputs["labels"]))
    known = inputs["labels"] != UNLABELLED
    assert (predicted == inputs["labels"])[known].mean() > 0.8
    assert ((confidence > 1 / 9) & (confidence <= 1)).all()
    assert "label" in read_las(paths[0]).fields


def test_equal_inputs_give_equal_files_on_any_number_of_threads(inputs, tmp_path):
    a, b = (train(inputs, tmp_path / str(n), n_threads=n) for n in (1, 2))
    assert a[0].read_bytes().split(b"parameters:")[0] == b[0].read_bytes().split(b"parameters:")[0]
    assert a[1].read_bytes() == b[1].read_bytes()


def test_groups_together_label_what_one_labels(inputs, tmp_path):
    outputs = train(inputs, tmp_path / "trees")
    n = len(inputs["labels"])
    parts = [label(inputs, outputs[:2], tmp_path / "four", f"{k}of4")[1] for k in range(4)]
    whole = label(inputs, outputs[:2], tmp_path / "one", "0of1")[1]
    for a, b in zip(read_label_tiles(parts, n), read_label_tiles([whole], n), strict=True):
        np.testing.assert_array_equal(a, b)


def test_trees_of_other_settings_and_damaged_ones_are_refused(inputs, tmp_path):
    outputs = train(inputs, tmp_path / "trees")
    with pytest.raises(BadInput, match="neighbours"):
        label(inputs, outputs[:2], tmp_path / "out", "0of1", [8, 30])
    assert not (tmp_path / "out").exists()
    outputs[1].write_text(outputs[1].read_text().replace("24", "25"))
    with pytest.raises(BadInput, match="features"):
        load_trees(*outputs[:2])
    outputs[0].write_text("tree\n")
    with pytest.raises(BadInput, match="LightGBM"):
        load_trees(*outputs[:2])
    assert NAMES[0] in outputs[1].read_text()


def test_a_class_the_part_lacks_is_no_obstacle(inputs, tmp_path):
    keys, labels = (np.load(inputs["training"][1])[name] for name in ("keys", "labels"))
    kept = labels != NAMES.index("phantom")
    save_npz(tmp_path / "fewer.npz", keys=keys[kept], labels=labels[kept])
    outputs = train(inputs | {"training": [inputs["training"][0], tmp_path / "fewer.npz"]}, tmp_path / "trees")
    paths = label(inputs, outputs[:2], tmp_path / "out", "0of1")
    predicted, _ = read_label_tiles([paths[1]], len(inputs["labels"]))
    assert not (predicted == NAMES.index("phantom")).any()
