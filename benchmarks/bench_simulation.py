"""How long a street and a drive take to simulate, what share is ray casting, and how time and memory grow with their points."""

import resource
import subprocess
import sys
import time

import numpy as np

# Pulse rates of one 120 m street: about 1, 2 and 4 million points.
PULSE_RATES = (20_000, 40_000, 80_000)
_JOB = "from benchmarks.bench_simulation import record_street_alone as f; f({})"
_FRAMES_JOB = "from benchmarks.bench_simulation import record_frames_alone as f; f()"
N_FRAMES = 20


def bench_simulation() -> list[dict]:
    """Rows of a street recorded at three pulse rates, each in a process of its own so that its memory is its own."""
    rows = []
    for rate in PULSE_RATES:
        output = subprocess.run([sys.executable, "-c", _JOB.format(rate)], check=True, capture_output=True, text=True).stdout
        n_points, seconds, peak_mib = (float(v) for v in output.split())
        for metric, value, unit in (("time per million points", seconds / n_points * 1e6, "s"), ("peak memory", peak_mib, "MiB")):
            rows.append({"benchmark": "simulate_city", "metric": metric, "value": value, "unit": unit, "peer": "", "n": int(n_points)})
    output = subprocess.run([sys.executable, "-c", _FRAMES_JOB], check=True, capture_output=True, text=True).stdout
    frame_s, share = (float(v) for v in output.split())
    for metric, value, unit in (("time per lidar frame", frame_s, "s"), ("share of ray casting", share, "1")):
        rows.append({"benchmark": "simulate_drive", "metric": metric, "value": value, "unit": unit, "peer": "", "n": N_FRAMES})
    return rows


def record_frames_alone() -> None:
    """Record frames of a HDL-64E on the city's main road; prints seconds per frame and the share of them spent casting rays."""
    from streetscan import geometry
    from streetscan.simulation.changes import Day
    from streetscan.simulation.layout import build_street
    from streetscan.simulation.raycasting import SceneCaster
    from streetscan.simulation.receiver import Receiver
    from streetscan.simulation.recording import drive_road, without_collisions
    from streetscan.simulation.rotating_lidar import HDL64E_RECEIVER, RotatingLidar, nominal_beams, record_frame

    class TimedCaster(SceneCaster):
        casting_s = 0.0

        def cast(self, *arguments):
            started = time.perf_counter()
            hits = super().cast(*arguments)
            self.casting_s += time.perf_counter() - started
            return hits

    scene = build_street(120.0, "train", 1, day=Day(), time_span_s=(-10.0, 10.0))
    trajectory = drive_road(scene.places["main_road"][0], 25.0, scene.lane_offset_m, 0.0, np.random.default_rng(1))
    caster = TimedCaster(without_collisions(scene, trajectory), 0.0, 10.0)
    lidar = RotatingLidar(nominal_beams(1), 10.0, geometry.transform((0.8, 0.0, 1.73)), Receiver(**HDL64E_RECEIVER))
    record_frame(caster, lidar, trajectory, 0, 1)  # the first one compiles
    caster.casting_s, started = 0.0, time.perf_counter()
    for number in range(N_FRAMES):
        record_frame(caster, lidar, trajectory, number, 1)
    seconds = time.perf_counter() - started
    print(seconds / N_FRAMES, caster.casting_s / seconds)


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
