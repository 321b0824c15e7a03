"""How long a street takes to simulate, how time and memory grow with its points, and how long a camera's picture takes."""

import resource
import subprocess
import sys
import time

# Pulse rates of one 120 m street: about 1, 2 and 4 million points.
PULSE_RATES = (20_000, 40_000, 80_000)
N_PICTURES = 4
_JOB = "from benchmarks.bench_simulation import record_street_alone as f; f({})"


def bench_simulation() -> list[dict]:
    """Rows of a street recorded at three pulse rates, each in a process of its own so that its memory is its own."""
    rows = []
    for rate in PULSE_RATES:
        output = subprocess.run([sys.executable, "-c", _JOB.format(rate)], check=True, capture_output=True, text=True).stdout
        n_points, seconds, peak_mib = (float(v) for v in output.split())
        for metric, value, unit in (("time per million points", seconds / n_points * 1e6, "s"), ("peak memory", peak_mib, "MiB")):
            rows.append({"benchmark": "simulate_city", "metric": metric, "value": value, "unit": unit, "peer": "", "n": int(n_points)})
    return rows + bench_camera()


def bench_camera() -> list[dict]:
    """Rows of a picture of 1288 x 964 pixels in a street with heavy traffic, and of the share that casting rays takes of it."""
    import numpy as np

    from streetscan.simulation.camera import Camera, mount_camera, render, settle_exposure
    from streetscan.simulation.layout import build_street
    from streetscan.simulation.raycasting import SceneCaster
    from streetscan.simulation.recording import drive_road

    class TimedCaster(SceneCaster):
        seconds = 0.0

        def _timed(self, method, *rays):
            started = time.perf_counter()
            found = method(*rays)
            self.seconds += time.perf_counter() - started
            return found

        def cast(self, *rays):
            return self._timed(super().cast, *rays)

        def is_blocked(self, *rays):
            return self._timed(super().is_blocked, *rays)

    scene = build_street(120.0, "train", 1)
    trajectory = drive_road(scene.roads[0], 30.0, scene.lane_offset_m, 0.0, np.random.default_rng(0))
    caster, camera, T_vehicle_camera = TimedCaster(scene, 2.0, 5.0), Camera(), mount_camera((0.5, 0.0, 1.9), pitch_deg=2.0)
    auto_exposure = settle_exposure(caster, trajectory, T_vehicle_camera, camera, 2.5)
    times_s, rng = np.linspace(2.5, 4.5, N_PICTURES + 1), np.random.default_rng(0)
    render(caster, trajectory, T_vehicle_camera, camera, times_s[0], auto_exposure, rng)
    caster.seconds, started, cpu_started = 0.0, time.perf_counter(), time.process_time()
    for time_s in times_s[1:]:
        render(caster, trajectory, T_vehicle_camera, camera, time_s, auto_exposure, rng)
    seconds, cpu_seconds = time.perf_counter() - started, time.process_time() - cpu_started
    figures = (
        ("time per image", seconds / N_PICTURES, "s"),
        ("processor time per image", cpu_seconds / N_PICTURES, "s"),
        ("share of ray casting", caster.seconds / seconds, ""),
    )
    return [
        {"benchmark": "camera", "metric": metric, "value": value, "unit": unit, "peer": "", "n": N_PICTURES}
        for metric, value, unit in figures
    ]


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
