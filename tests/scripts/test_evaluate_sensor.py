"""evaluate_sensor: the simulated HDL-64E beside the real one of KITTI's drive 0001."""

import pandas as pd
import pytest
import yaml
from toy_recordings import ROOT, SCHEMA

from scripts.evaluate_sensor import main
from scripts.import_drive import main as import_main
from scripts.simulate_drive import main as simulate_main


@pytest.fixture(scope="module")
def drives(tmp_path_factory, shared_data):
    """Eight frames of the city's main road, and the recording."""
    folder = tmp_path_factory.mktemp("sensor")
    city = yaml.safe_load((ROOT / "config" / "datasets" / "city.yaml").read_text())
    facts = yaml.safe_load((ROOT / "config" / "drives" / "city_main_road.yaml").read_text())
    facts["simulation"] |= {"n_frames": 8}
    (folder / "city.yaml").write_text(yaml.safe_dump(facts))
    street = city["simulation"]["street"] | {"length_m": 120, "crs": city["crs"]}
    outputs = {n: [folder / n / name for name in ("drive.mcap", "frames.csv", "truth")] for n in ("city", "kitti")}
    simulate_main(folder / "city.yaml", SCHEMA, folder, "city_main_road", street, 1, 1, *outputs["city"])
    import_main(ROOT / "config" / "drives" / "kitti_0001.yaml", SCHEMA, shared_data, "kitti_0001", *outputs["kitti"])
    return {name: paths[0] for name, paths in outputs.items()}


def test_the_simulated_sensor_is_like_the_real_one(drives, tmp_path):
    main(drives["city"], drives["kitti"], tmp_path / "s.csv", tmp_path / "p.png", ["city", "kitti"], [1.73, 1.73], 2.5, 79.0)
    table = pd.read_csv(tmp_path / "s.csv")
    single = table[table["x"].isna()].set_index("statistic")
    assert single.loc["points_per_frame", "ratio"] == pytest.approx(1.0, abs=0.25)
    assert single.loc["range_overlap", "drive"] >= 0.8
    assert single.loc["rings_within_25_percent", "drive"] >= 0.9
    assert single.loc["road_ring_spacing_m", "ratio"] == pytest.approx(1.0, abs=0.25)
    assert abs(single.loc["no_return_share", "drive"] - single.loc["no_return_share", "reference"]) < 0.1
    assert (tmp_path / "p.png").stat().st_size > 10_000
