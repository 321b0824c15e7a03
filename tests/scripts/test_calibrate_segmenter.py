"""The step on a toy part: a network with other confidence and the same labels, and tables of what it is worth."""

import numpy as np
import pandas as pd
import pytest
from toy_parts import SETTINGS, make_part

from scripts import calibrate_segmenter
from streetscan.io.arrays import save_npy, save_npz
from streetscan.segmentation.c2cnn import C2CNN, load_network, save_network
from streetscan.segmentation.sparse import open_workers
from streetscan.segmentation.training import sample_logits

NAMES = ("weights.safetensors", "settings.yaml", "scores.csv", "reliability.csv")


@pytest.fixture
def inputs(tmp_path):
    part = make_part(1)
    part.grid.save(tmp_path / "voxels.npz")
    save_npz(tmp_path / "samples.npz", keys=part.samples.keys, labels=part.samples.labels)
    for name, n in (("validation", 40), ("train", 4000)):
        save_npy(tmp_path / f"{name}.npy", np.repeat(np.array([0, 1, 6, 255], np.uint8), [n, n // 2, n // 20, 9]))
    save_network(C2CNN(SETTINGS, seed=1), tmp_path / "trained.safetensors", tmp_path / "settings.yaml")
    network = [tmp_path / "trained.safetensors", tmp_path / "settings.yaml"]
    training = [tmp_path / "train.npy", tmp_path / "samples.npz"]
    return {
        "network_paths": network,
        "training": training,
        "validation": [tmp_path / "validation.npy", training[1], tmp_path / "voxels.npz"],
    }


def run(inputs, folder, prior_power=0.0):
    outputs = [folder / name for name in NAMES]
    calibrate_segmenter.main(
        **inputs,
        outputs=outputs,
        prior_power=prior_power,
        schedule={"patch_voxels": 15, "class_power": 0.0},
        n_turns=1,
        n_threads=1,
        groups={"Wall": ["facade"]},
    )
    return outputs


def predictions(paths):
    network = load_network(*paths)
    with open_workers(1) as workers:
        return sample_logits(network, make_part(1), workers)[0].argmax(1).numpy()


def test_labels_stay_and_tables_are_written(inputs, tmp_path):
    outputs = run(inputs, tmp_path / "out")
    np.testing.assert_array_equal(predictions(outputs[:2]), predictions(inputs["network_paths"]))
    scores, reliability = (pd.read_csv(path) for path in outputs[2:])
    assert {"temperature", "calibration_error", "loss", "f", "n_voxels", "n_occupied"} <= set(scores["metric"])
    assert "group:Wall" in set(scores["class"])
    assert list(reliability) == ["stage", "confidence", "accuracy", "n", "protocol"]


def test_expected_shares_move_labels_to_what_is_common(inputs, tmp_path):
    even, natural = (predictions(run(inputs, tmp_path / str(power), power)[:2]) for power in (0.0, 1.0))
    assert (natural == 0).sum() > (even == 0).sum()
    assert not np.isin(natural, (2, 3, 4, 5, 7, 8)).any()
