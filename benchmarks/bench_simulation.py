"""How long a street takes to simulate, and how time and memory grow with its points.

Streets grow longer, as a city does; each is recorded in a process of its own, whose highest memory Linux keeps (VmHWM). A child's
ru_maxrss would begin with its parent's.
"""

import re
import subprocess
import sys
import time
from pathlib import Path

# (metres, pulses per second of each scanner): about 5, 25 and 100 million points; the last at the scanner's own rates.
STREETS = ((120.0, 80_000.0), (360.0, 140_000.0), (360.0, 550_000.0))
_JOB = "from benchmarks.bench_simulation import record_street_alone as f; f({}, {})"


def bench_simulation(streets: tuple[tuple[float, float], ...] = STREETS) -> list[dict]:
    """Rows of streets of growing size: time per million points, peak memory, and how time grows from the smallest to the largest.

    A time per million that stays is linear; the last row is the largest street's over the smallest's.
    """
    rows, paces = [], []
    for street in streets:
        output = subprocess.run([sys.executable, "-c", _JOB.format(*street)], check=True, capture_output=True, text=True).stdout
        n_points, seconds, peak_mib = (float(v) for v in output.split())
        paces.append(seconds / n_points * 1e6)
        for metric, value, unit in (("time per million points", paces[-1], "s"), ("peak memory", peak_mib, "MiB")):
            rows.append({"benchmark": "simulate_city", "metric": metric, "value": value, "unit": unit, "peer": "", "n": int(n_points)})
    growth = {"metric": "time per million points, largest over smallest", "value": paces[-1] / paces[0], "unit": "", "n": int(n_points)}
    rows.append({"benchmark": "simulate_city", "peer": "", **growth})
    return rows


def record_street_alone(length_m: float, pulses_per_s: float) -> None:
    """Record one street and write it to a temporary folder; prints points, seconds and this process's highest memory in MiB."""
    import tempfile

    from streetscan.simulation.colouring import Cameras
    from streetscan.simulation.receiver import Receiver
    from streetscan.simulation.recording import Errors, record_street, write_map
    from streetscan.simulation.sensors import mobile_mapper

    started = time.perf_counter()
    scanners = mobile_mapper(lines_per_s=100 if pulses_per_s < 500_000 else 200, pulses_per_s=pulses_per_s)
    records = record_street("train", 1, {"length_m": length_m}, scanners, Receiver(), Cameras(), Errors(), 1)
    with tempfile.TemporaryDirectory() as folder:
        n_points = write_map(records, *(Path(folder) / name for name in ("map.laz", "labels.npy", "instances.npy")))
    seconds = time.perf_counter() - started
    peak_kib = int(re.search(r"VmHWM:\s*(\d+) kB", Path("/proc/self/status").read_text())[1])
    print(n_points, seconds, peak_kib / 1024)
