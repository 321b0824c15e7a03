"""How long a street takes to simulate, and how time and memory grow with its points."""

import resource
import subprocess
import sys
import time

# Pulse rates of one 120 m street: about 1, 2 and 4 million points.
PULSE_RATES = (20_000, 40_000, 80_000)
_JOB = "from benchmarks.bench_simulation import record_street_alone as f; f({})"


def bench_simulation() -> list[dict]:
    """Rows of a street recorded at three pulse rates, each in a process of its own so that its memory is its own."""
    rows = []
    for rate in PULSE_RATES:
        output = subprocess.run([sys.executable, "-c", _JOB.format(rate)], check=True, capture_output=True, text=True).stdout
        n_points, seconds, peak_mib = (float(v) for v in output.split())
        for metric, value, unit in (("time per million points", seconds / n_points * 1e6, "s"), ("peak memory", peak_mib, "MiB")):
            rows.append({"benchmark": "simulate_city", "metric": metric, "value": value, "unit": unit, "peer": "", "n": int(n_points)})
    return rows


def record_street_alone(pulses_per_s: float) -> None:
    """Record one street without writing it; prints points, seconds and peak memory in MiB."""
    from streetscan.simulation.colouring import Cameras
    from streetscan.simulation.receiver import Receiver
    from streetscan.simulation.recording import Errors, record_street
    from streetscan.simulation.sensors import mobile_mapper

    started = time.perf_counter()
    scanners = mobile_mapper(lines_per_s=100, pulses_per_s=pulses_per_s)
    records = record_street("train", 1, {"length_m": 120.0}, scanners, Receiver(), Cameras(), Errors(), 1)
    n_points = sum(len(record.labels) for record in records)
    seconds = time.perf_counter() - started
    print(n_points, seconds, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)
