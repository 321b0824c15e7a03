"""A user's own scan of the tiny street, as a data set file and a config that labels it."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import yaml
from dag import HOME

from streetscan.classes import NAMES
from streetscan.clouds import PointCloud
from streetscan.io.las import write_las


@dataclass
class TinyScan:
    """Name, config file and folder of a scan that is ready to run."""

    name: str
    config: Path
    folder: Path


def write_scan(folder: Path, name: str, parts: dict[str, PointCloud], truth: str, **config) -> TinyScan:
    """Write LAZ files, a data set file and a config for them."""
    facts = yaml.safe_load((HOME / "config" / "datasets" / "own_scan.yaml").read_text())
    facts |= {"name": name, "title": name, "truth": truth, "parts": {}}
    for part, cloud in parts.items():
        write_las(folder / f"{name}_{part}.laz", cloud)
        facts["parts"][part] = {"files": [f"{name}_{part}.laz"], "n_tiles": 2}
    if truth == "labels":
        facts["reader"]["label"] = "class_id"
        facts["class_map"] = dict(enumerate(NAMES)) | {255: "unlabelled"}
    datasets = folder / "datasets"
    datasets.mkdir(exist_ok=True)
    (datasets / f"{name}.yaml").write_text(yaml.safe_dump(facts))
    path = folder / f"{name}.config.yaml"
    own = {"data_root": str(folder), "datasets_folder": str(datasets), "label_map": {"tile_m": 8}}
    path.write_text(yaml.safe_dump(own | config))
    return TinyScan(name, path, folder)


@pytest.fixture
def tiny_scan(tiny_world, tmp_path) -> TinyScan:
    """The tiny street without truth."""
    folder = tmp_path / "scan"
    folder.mkdir()
    return write_scan(folder, "tiny", {"all": tiny_world.cloud}, "none", labelled_maps=["tiny/c2cnn_shipped"])


@pytest.fixture
def labelled_scan(tiny_world, tmp_path) -> TinyScan:
    """The tiny street three times, moved and jittered, with labels; a training of seconds."""
    folder = tmp_path / "labelled"
    folder.mkdir()
    parts = {}
    for i, part in enumerate(("train", "validation", "test")):
        jitter = np.random.default_rng(i).normal(0, 0.005, tiny_world.cloud.points.shape)
        fields = {"intensity": tiny_world.cloud.fields["intensity"], "class_id": tiny_world.labels}
        parts[part] = PointCloud(tiny_world.cloud.points + [100.0 * i, 0, 0] + jitter, fields, tiny_world.cloud.crs)
    return write_scan(
        folder,
        "tiny",
        parts,
        "labels",
        labelled_maps=["tiny/c2cnn"],
        n_threads=1,
        extract_samples={"n_per_class_train": 400, "n_per_class_validation": 100},
        train_segmenter={"schedule": {"n_epochs": 2, "samples_per_epoch": 3000}},
    )
