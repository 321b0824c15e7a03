"""How long the city and single streets take to simulate, and how time and memory grow with their points.

Streets grow longer, as a city does; each is recorded in a process of its own, whose highest memory Linux keeps (VmHWM). A child's
ru_maxrss would begin with its parent's.
"""

import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import yaml

from scripts import simulate_city
from streetscan.io.arrays import load_npy

ROOT = Path(__file__).resolve().parents[1]
CITY = yaml.safe_load((ROOT / "config" / "datasets" / "city.yaml").read_text())
# (metres, pulses per second of each scanner): about 5, 25 and 100 million points; the last at the scanner's own rates.
STREETS = ((120.0, 80_000.0), (360.0, 140_000.0), (360.0, 550_000.0))
N_CORES = 2
_JOB = "from benchmarks.bench_simulation import record_alone as f; f{}"


def bench_simulation(streets: Sequence[tuple[float, float]] = STREETS, city: Mapping = CITY) -> list[dict]:
    """Rows of the city, two parts at a time, and of streets of growing size: time, time per million points, peak memory.

    A time per million that stays is linear; the last row is the largest street's over the smallest's.

    Args:
        streets: length in m and pulses per second of each.
        city: the facts of the data set.
    """
    rows, paces = _city_rows(city["simulation"], {part: facts["length_m"] for part, facts in city["parts"].items()}), []
    for length_m, pulses_per_s in streets:
        scanners = {"lines_per_s": 100 if pulses_per_s < 500_000 else 200, "pulses_per_s": pulses_per_s}
        n_points, seconds, peak_mib = _in_process(city["simulation"] | {"street": {}, "scanners": scanners}, "train", length_m)
        paces.append(seconds / n_points * 1e6)
        rows.append(_row("simulate_city", "time per million points", paces[-1], "s", n_points))
        rows.append(_row("simulate_city", "peak memory", peak_mib, "MiB", n_points))
    rows.append(_row("simulate_city", "time per million points, largest over smallest", paces[-1] / paces[0], "", n_points))
    return rows


def _city_rows(settings: Mapping, lengths_m: Mapping[str, float]) -> list[dict]:
    started = time.perf_counter()
    with ThreadPoolExecutor(N_CORES) as jobs:
        found = list(jobs.map(lambda part: _in_process(settings, *part), lengths_m.items()))
    seconds, n_points = time.perf_counter() - started, sum(n for n, *_ in found)
    return [
        _row("simulate_data_set_city", "time on two cores", seconds, "s", n_points),
        _row("simulate_data_set_city", "time per million points", seconds / n_points * 1e6, "s", n_points),
        _row("simulate_data_set_city", "peak memory of a part", max(peak for *_, peak in found), "MiB", n_points),
    ]


def _in_process(settings: Mapping, split: str, length_m: float) -> tuple[float, float, float]:
    """Points, seconds and highest memory in MiB of a street that is simulated in a process of its own."""
    command = [sys.executable, "-c", _JOB.format((settings, split, length_m))]
    printed = subprocess.run(command, check=True, capture_output=True, text=True, cwd=ROOT).stdout
    n_points, seconds, peak_mib = (float(v) for v in printed.split())
    return n_points, seconds, peak_mib


def _row(benchmark: str, metric: str, value: float, unit: str, n: float) -> dict:
    return {"benchmark": benchmark, "metric": metric, "value": value, "unit": unit, "peer": "", "n": int(n)}


def record_alone(settings: Mapping, split: str, length_m: float) -> None:
    """Simulate a street as `simulate_city` does, into a temporary folder; prints points, seconds, highest memory in MiB."""
    started = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        files = [Path(folder) / name for name in ("map.laz", "labels.npy", "instances.npy")]
        simulate_city.main(*files, settings, split, {"length_m": length_m}, seed=1)
        seconds, n_points = time.perf_counter() - started, len(load_npy(files[1], "simulate_city"))
    peak_kib = int(re.search(r"VmHWM:\s*(\d+) kB", Path("/proc/self/status").read_text())[1])
    print(n_points, seconds, peak_kib / 1024)
