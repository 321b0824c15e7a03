"""The script that scans a street of the simulated city."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest

from streetscan.classes import N_CLASSES, PHANTOM, UNLABELLED
from streetscan.errors import BadInput
from streetscan.io.las import iterate_las, read_las

SETTINGS = {
    "street": {"traffic_density": 0.5, "n_pedestrians": 10.0},
    "scanners": {"lines_per_s": 40.0, "pulses_per_s": 15_000.0},
    "receiver": {},
    "cameras": {},
    "errors": {},
    "n_rounds": 1,
}


@pytest.fixture(scope="module")
def main():
    path = Path(__file__).parents[2] / "scripts" / "simulate_city.py"
    spec = importlib.util.spec_from_file_location("simulate_city", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.main


def simulate(main, folder: Path, split: str = "test", seed: int = 1, settings: dict = SETTINGS, length_m: float = 40.0) -> list[Path]:
    files = [folder / "map.laz", folder / "truth" / "labels.npy", folder / "truth" / "instances.npy"]
    main(*files, settings=settings, split=split, part={"length_m": length_m}, seed=seed)
    return files


@pytest.fixture(scope="module")
def street(main, tmp_path_factory) -> list[Path]:
    return simulate(main, tmp_path_factory.mktemp("street"))


def bytes_without_date(path: Path) -> bytes:
    """A LAS file's bytes but for the day its header says it was written on."""
    content = bytearray(path.read_bytes())
    content[90:94] = bytes(4)
    return bytes(content)


def test_the_map_holds_what_a_scanner_knows_and_truth_lies_apart(street):
    cloud, labels, instances = read_las(street[0]), np.load(street[1]), np.load(street[2])
    assert set(cloud.fields) == {"intensity", "time_s", "rgb", "return_number", "n_returns", "classification"}
    assert set(cloud.fields["classification"]) == {0}
    assert len(cloud) == len(labels) == len(instances) > 100_000
    assert cloud.crs == "EPSG:23700"
    assert (labels.dtype, instances.dtype) == (np.uint8, np.uint32)
    assert set(labels) <= {*range(N_CLASSES), UNLABELLED}
    assert {0, 1, PHANTOM, 5, 6} <= set(labels)
    assert (cloud.fields["return_number"] <= cloud.fields["n_returns"]).all()
    assert cloud.fields["rgb"].std() > 10


def test_an_instance_has_one_class_apart_from_its_phantom(street):
    labels, instances = np.load(street[1]), np.load(street[2])
    pairs = np.unique(np.stack([instances[labels != PHANTOM], labels[labels != PHANTOM]]), axis=1)
    named = pairs[0][pairs[0] > 0]
    # A house's creeper or a tree's trunk may be of another class than the rest of it; most objects are of one.
    assert len(np.unique(named)) > 0.8 * len(named)


def test_the_same_seed_gives_identical_files_and_another_does_not(main, street, tmp_path):
    again, other = simulate(main, tmp_path / "again"), simulate(main, tmp_path / "other", seed=2)
    assert bytes_without_date(again[0]) == bytes_without_date(street[0])
    assert bytes_without_date(other[0]) != bytes_without_date(street[0])
    for i in (1, 2):
        assert again[i].read_bytes() == street[i].read_bytes()


def test_splits_lie_apart(main, street, tmp_path):
    train = next(iterate_las(simulate(main, tmp_path, split="train")[0])).points
    assert np.abs(train.mean(axis=0) - read_las(street[0]).points.mean(axis=0))[:2].max() > 1000


def test_a_street_that_cannot_be_leaves_nothing(main, tmp_path):
    with pytest.raises(BadInput, match="20 m or longer"):
        simulate(main, tmp_path, length_m=5.0)
    assert list(tmp_path.rglob("*.*")) == []
