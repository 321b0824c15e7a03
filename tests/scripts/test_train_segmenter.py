"""The step on the tiny street: files written whole, weights that fit their settings."""

import numpy as np
import pandas as pd
import pytest
import yaml

from scripts import train_segmenter
from streetscan.errors import BadInput
from streetscan.io.arrays import save_npy, save_npz
from streetscan.segmentation.c2cnn import Settings, load_network
from streetscan.segmentation.samples import draw_samples, vote_labels
from streetscan.voxels import voxelize

NETWORK = {"k": 9, "channels": ["count", "height"], "n_hidden": 24}
SCHEDULE = {"n_epochs": 2, "samples_per_epoch": 600, "patch_voxels": 15}


@pytest.fixture
def inputs(tiny_world, tmp_path):
    grid = voxelize([tiny_world.cloud.points], 0.2)
    grid.height_m = (grid.mean_z_m - tiny_world.ground_z_m(grid.centres)).astype(np.float32)
    labels = vote_labels(grid, [(tiny_world.cloud.points, tiny_world.labels)])
    rows, sample_labels = draw_samples(labels, 60, np.random.default_rng(1))
    grid.save(tmp_path / "voxels.npz")
    save_npy(tmp_path / "labels.npy", labels)
    save_npz(tmp_path / "samples.npz", keys=grid.keys[rows], labels=sample_labels)
    part = [tmp_path / "voxels.npz", tmp_path / "samples.npz"]
    return {"training": part, "validation": part, "labels": tmp_path / "labels.npy", "initial": []}


def outputs(folder):
    return [folder / name for name in ("weights.safetensors", "settings.yaml", "history.csv")]


def run(inputs, folder, **more):
    settings = {"network": NETWORK, "schedule": SCHEDULE, "n_threads": 1, "device": "cpu"} | more
    train_segmenter.main(**inputs, outputs=outputs(folder), **settings)


def test_weights_settings_and_history_are_written(inputs, tmp_path):
    run(inputs, tmp_path / "out")
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == ["history.csv", "settings.yaml", "weights.safetensors"]
    network = load_network(*outputs(tmp_path / "out")[:2])
    assert network.settings == Settings(size_m=0.2, **NETWORK)
    history = pd.read_csv(tmp_path / "out" / "history.csv")
    assert list(history.epoch) == [1, 2]
    assert (history.train_loss > 0).all()
    assert "classes" in yaml.safe_load((tmp_path / "out" / "settings.yaml").read_text())


def test_equal_inputs_give_equal_files(inputs, tmp_path):
    for name in "ab":
        run(inputs, tmp_path / name)
    a, b = (outputs(tmp_path / name)[0].read_bytes() for name in "ab")
    assert a == b


def test_fine_tuning_needs_equal_settings(inputs, tmp_path):
    run(inputs, tmp_path / "first")
    tuned = inputs | {"initial": outputs(tmp_path / "first")[:2]}
    run(tuned, tmp_path / "second")
    with pytest.raises(BadInput, match="other settings"):
        run(tuned, tmp_path / "third", network=NETWORK | {"k": 11})
    assert not (tmp_path / "third").exists()


def test_a_gpu_that_is_not_there_is_named(inputs, tmp_path, monkeypatch):
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    with pytest.raises(BadInput, match="finds no NVIDIA GPU"):
        run(inputs, tmp_path / "out", device="cuda")
    with pytest.raises(BadInput, match="'tpu' is unknown"):
        run(inputs, tmp_path / "out", device="tpu")
    assert not (tmp_path / "out").exists()
