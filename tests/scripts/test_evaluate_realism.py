"""evaluate_realism on the tiny street, as a real map and as a simulated one."""

import pandas as pd
import pytest

from scripts import evaluate_realism

SETTINGS = {"tile_m": 4.0, "tile_share": 1.0, "max_range_m": 20.0, "n_pulses": 8000}
SIMULATION = {
    "street": {"traffic_density": 0.3, "n_pedestrians": 4.0},
    "scanners": {"lines_per_s": 40.0, "pulses_per_s": 15_000.0},
    "receiver": {},
    "errors": {},
    "n_rounds": 1,
}


def run(tiny_map, table, truth, simulation=None):
    truth_path = str(tiny_map.parent / "truth" / "labels.npy") if truth else None
    evaluate_realism.main(str(tiny_map), truth_path, str(table), simulation, "test", 28.0, 1, **SETTINGS)
    return pd.read_csv(table)


def test_a_labelled_map(tiny_map, tmp_path):
    table = run(tiny_map, tmp_path / "realism.csv", truth=True)
    assert list(table) == ["statistic", "group", "x", "value", "n"]
    shares = table[table.statistic == "class_share"]
    assert shares.value.sum() == pytest.approx(1)
    assert {"isolated_share", "points_per_voxel", "intensity_share", "ground_density_per_m2"} <= set(table.statistic)
    assert not {"return_rate", "density_per_m2"} & set(table.statistic)


def test_a_map_without_labels(tiny_map, tmp_path):
    table = run(tiny_map, tmp_path / "realism.csv", truth=False)
    assert set(table[table.statistic == "class_share"].group) == {"unlabelled"}
    assert "phantom_share" not in set(table.statistic)


def test_a_simulated_map_has_return_rates_and_density_against_range(tiny_map, tmp_path):
    table = run(tiny_map, tmp_path / "realism.csv", truth=True, simulation=SIMULATION)
    rates = table[(table.statistic == "return_rate") & (table.group == "all")]
    assert rates.value.between(0, 1).all()
    assert 4000 < rates.n.sum() <= 8000
