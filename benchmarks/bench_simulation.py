"""How long a street and a drive take to simulate, what share is ray casting, and how time and memory grow with a street's points.

Streets grow longer, as a city does; each is recorded in a process of its own, whose highest memory Linux keeps (VmHWM). A child's
ru_maxrss would begin with its parent's.
"""

import re
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

# (metres, pulses per second of each scanner): about 5, 25 and 100 million points; the last at the scanner's own rates.
STREETS = ((120.0, 80_000.0), (360.0, 140_000.0), (360.0, 550_000.0))
_JOB = "from benchmarks.bench_simulation import record_street_alone as f; f({}, {})"
_FRAMES_JOB = "from benchmarks.bench_simulation import record_frames_alone as f; f()"
_PICTURES_JOB = "from benchmarks.bench_simulation import render_pictures_alone as f; f()"
N_FRAMES, N_PICTURES = 20, 4


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
    for job, metric, n in ((_FRAMES_JOB, "time per lidar frame", N_FRAMES), (_PICTURES_JOB, "time per image", N_PICTURES)):
        output = subprocess.run([sys.executable, "-c", job], check=True, capture_output=True, text=True).stdout
        seconds, share = (float(v) for v in output.split())
        row = {"benchmark": "simulate_drive", "peer": "", "n": n}
        rows.append(row | {"metric": metric, "value": seconds, "unit": "s"})
        rows.append(row | {"metric": f"{metric}: share of ray casting", "value": share, "unit": "1"})
    return rows


def record_frames_alone() -> None:
    """Record frames of a HDL-64E on the city's main road; prints seconds per frame and the share of them spent casting rays."""
    from streetscan import geometry
    from streetscan.simulation.changes import Day
    from streetscan.simulation.layout import build_street
    from streetscan.simulation.receiver import Receiver
    from streetscan.simulation.recording import drive_road, without_collisions
    from streetscan.simulation.rotating_lidar import HDL64E_RECEIVER, RotatingLidar, nominal_beams, record_frame

    scene = build_street(120.0, "train", 1, day=Day(), time_span_s=(-10.0, 10.0))
    trajectory = drive_road(scene.places["main_road"][0], 25.0, scene.lane_offset_m, 0.0, np.random.default_rng(1))
    caster = _timed_caster()(without_collisions(scene, trajectory), 0.0, 10.0)
    lidar = RotatingLidar(nominal_beams(1), 10.0, geometry.transform((0.8, 0.0, 1.73)), Receiver(**HDL64E_RECEIVER))
    record_frame(caster, lidar, trajectory, 0, 1)  # the first one compiles
    caster.casting_s, started = 0.0, time.perf_counter()
    for number in range(N_FRAMES):
        record_frame(caster, lidar, trajectory, number, 1)
    seconds = time.perf_counter() - started
    print(seconds / N_FRAMES, caster.casting_s / seconds)


def render_pictures_alone() -> None:
    """Render pictures of 1288 x 964 pixels in heavy traffic; prints seconds per picture and the share of them spent casting rays."""
    from streetscan.simulation.camera import Camera, mount_camera, render, settle_exposure
    from streetscan.simulation.layout import build_street
    from streetscan.simulation.recording import drive_road, without_collisions

    scene = build_street(120.0, "train", 1)
    trajectory = drive_road(scene.roads[0], 30.0, scene.lane_offset_m, 0.0, np.random.default_rng(0))
    caster = _timed_caster()(without_collisions(scene, trajectory), 2.0, 5.0)
    view = trajectory, mount_camera((0.5, 0.0, 1.9), pitch_deg=2.0), Camera()
    auto_exposure, rng = settle_exposure(caster, *view, 2.5), np.random.default_rng(0)
    times_s = np.linspace(2.5, 4.5, N_PICTURES + 1)
    render(caster, *view, times_s[0], auto_exposure, rng)  # the first one compiles
    caster.casting_s, started = 0.0, time.perf_counter()
    for time_s in times_s[1:]:
        render(caster, *view, time_s, auto_exposure, rng)
    seconds = time.perf_counter() - started
    print(seconds / N_PICTURES, caster.casting_s / seconds)


def _timed_caster() -> type:
    """A scene's caster that counts the seconds it casts; made here, so that a street's process does not import it."""
    from streetscan.simulation.raycasting import SceneCaster

    class TimedCaster(SceneCaster):
        casting_s = 0.0

        def cast(self, *arguments):
            return self._timed(super().cast, *arguments)

        def is_blocked(self, *arguments):
            return self._timed(super().is_blocked, *arguments)

        def _timed(self, method, *arguments):
            started = time.perf_counter()
            found = method(*arguments)
            self.casting_s += time.perf_counter() - started
            return found

    return TimedCaster


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
