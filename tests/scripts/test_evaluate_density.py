"""evaluate_density on a short street, seen by a tripod and by a van."""

import pandas as pd
import pytest

from scripts import evaluate_density, simulate_city

STREET = {"traffic_density": 0.3, "n_pedestrians": 4.0}
STATIC = {"street": STREET, "static_scanner": {"spacing_m": 28.0, "step_deg": 0.3}, "receiver": {}}
MOBILE = {
    "street": STREET,
    "scanners": {"lines_per_s": 60.0, "pulses_per_s": 20_000.0},
    "receiver": {},
    "cameras": {},
    "errors": {},
    "n_rounds": 1,
}


@pytest.fixture(scope="module")
def scans(tmp_path_factory):
    folder, paths = tmp_path_factory.mktemp("scans"), {}
    for name, settings in (("static", STATIC), ("mobile", MOBILE)):
        files = [folder / name / "map.laz", folder / name / "truth" / "labels.npy", folder / name / "truth" / "instances.npy"]
        simulate_city.main(*map(str, files), settings=settings, split="test", part={"length_m": 28.0}, seed=1)
        paths[name] = [str(f) for f in files[:2]]
    return paths


def test_static_density_falls_and_mobile_density_stays(scans, tmp_path):
    evaluate_density.main(scans["static"], scans["mobile"], str(tmp_path / "density.csv"), STATIC, "test", 28.0, 1, 20.0)
    table = pd.read_csv(tmp_path / "density.csv")
    assert set(table.scanner) == {"static", "mobile"}
    static, mobile = (table[table.scanner == s].set_index("x").value for s in ("static", "mobile"))
    # Beside the tripod it is far denser, and falls with the cube of the distance (h / d^3).
    assert static[2.0] > 10 * static[10.0]
    assert static[2.0] / static[10.0] > 3 * mobile[2.0] / mobile[10.0]
