"""The benchmark of the simulation, on a street of metres and a scanner of few pulses."""

import pytest

from benchmarks import bench_simulation
from benchmarks.bench_simulation import CITY


def test_a_street_is_recorded_and_measured(capsys):
    few = CITY["simulation"] | {"scanners": {"lines_per_s": 20, "pulses_per_s": 2000}}
    bench_simulation.record_alone(few, "train", 20.0)
    n_points, seconds, peak_mib = map(float, capsys.readouterr().out.split())
    assert n_points > 1000
    assert seconds > 0
    assert peak_mib > 50


def test_rows_of_the_city_and_of_growing_streets(monkeypatch):
    """Measurements by hand: 40 points a metre, 2 s per million points, and 100 MiB."""
    monkeypatch.setattr(bench_simulation, "_in_process", lambda _, split, length_m: (40 * length_m, 80e-6 * length_m, 100.0))
    *rows, growth = bench_simulation.bench_simulation(streets=((100.0, 8000.0), (300.0, 550_000.0)))
    assert [r["n"] for r in rows if r["metric"] == "time per million points"] == [40 * 360, 4000, 12_000]
    assert [r["value"] for r in rows if r["benchmark"] == "simulate_city" and r["unit"] == "s"] == pytest.approx([2, 2])
    assert growth["value"] == pytest.approx(1)
