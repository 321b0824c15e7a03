"""How long a simulated drive's lidar frame and picture take on a street with heavy traffic, what share of it is ray casting, and
how memory grows with the length of a drive."""

import dataclasses
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from benchmarks.bench_drives import ROOT, SCHEMA, peak_memory_mb
from streetscan import geometry
from streetscan.drives import import_drive, read_drive_facts
from streetscan.simulation.camera import Camera, mount_camera, render, settle_exposure
from streetscan.simulation.changes import Day
from streetscan.simulation.drives import SimulatedRecording
from streetscan.simulation.layout import build_street
from streetscan.simulation.raycasting import SceneCaster
from streetscan.simulation.receiver import Receiver
from streetscan.simulation.recording import drive_road, without_collisions
from streetscan.simulation.rotating_lidar import HDL64E_RECEIVER, RotatingLidar, nominal_beams, record_frame

N_FRAMES = 20
N_PICTURES = 4


class TimedCaster(SceneCaster):
    """A caster that adds up the time its rays take."""

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


def bench_sensors() -> list[dict]:
    """Rows of a frame of an HDL-64E and of a picture of 1288 x 964 pixels on the city's main road, and of whole drives' memory."""
    scene = build_street(120.0, "train", 1, day=Day(), time_span_s=(-10.0, 10.0))
    trajectory = drive_road(scene.places["main_road"][0], 25.0, scene.lane_offset_m, 0.0, np.random.default_rng(1))
    caster = TimedCaster(without_collisions(scene, trajectory), 0.0, 10.0)
    lidar = RotatingLidar(nominal_beams(1), 10.0, geometry.transform((0.8, 0.0, 1.73)), Receiver(**HDL64E_RECEIVER))
    camera, T_vehicle_camera = Camera(), mount_camera((0.5, 0.0, 1.9), pitch_deg=2.0)
    auto_exposure = settle_exposure(caster, trajectory, T_vehicle_camera, camera, 2.5)
    times_s, rng = np.linspace(2.5, 4.5, N_PICTURES + 1), np.random.default_rng(0)

    def take_picture(number: int) -> None:
        render(caster, trajectory, T_vehicle_camera, camera, times_s[number], auto_exposure, rng)

    frames = _time(caster, "lidar frame", lambda number: record_frame(caster, lidar, trajectory, number, 1), N_FRAMES)
    return frames + _time(caster, "image", take_picture, N_PICTURES) + bench_memory()


def bench_memory(lengths: tuple[int, int] = (50, 300)) -> list[dict]:
    """Rows of the peak memory of whole processes that simulate drives of so many lidar frames."""
    peaks_mb = []
    for n_frames in lengths:
        code = f"from benchmarks.bench_sensors import _simulate; print(_simulate({n_frames}))"
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=True)
        peaks_mb.append(float(done.stdout.split()[-1]))
    rows = [_row("peak memory", peak, "MB", n) for peak, n in zip(peaks_mb, lengths, strict=True)]
    return [*rows, _row("peak memory, the longer drive's over the shorter's", peaks_mb[1] / peaks_mb[0], "1", lengths[1])]


def _simulate(n_frames: int) -> float:
    """Peak resident memory in MB after a drive along the city's training street at 10 km/h, without images."""
    facts = read_drive_facts(ROOT / "config" / "drives" / "city_train_main_road.yaml", SCHEMA)
    changed = {k: v for k, v in facts.simulation.items() if k != "camera"} | {"n_frames": n_frames, "speed_kmh": 10, "start_m": 5}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        street = {"length_m": 120.0, "crs": facts.crs}
        recording = SimulatedRecording(dataclasses.replace(facts, simulation=changed), "long", street, 1, folder, folder / "resume", 0)
        import_drive(recording, "long", folder / "d.mcap", folder / "f.csv", folder / "truth")
    return peak_memory_mb()


def _time(caster: TimedCaster, name: str, record, n: int) -> list[dict]:
    """Rows of recording number 1 to `n`; number 0 compiles."""
    record(0)
    caster.seconds, started, cpu_started = 0.0, time.perf_counter(), time.process_time()
    for number in range(1, n + 1):
        record(number)
    seconds, cpu_seconds = time.perf_counter() - started, time.process_time() - cpu_started
    figures = (
        (f"time per {name}", seconds / n, "s"),
        (f"processor time per {name}", cpu_seconds / n, "s"),
        (f"share of ray casting, {name}", caster.seconds / seconds, ""),
    )
    return [_row(metric, value, unit, n) for metric, value, unit in figures]


def _row(metric: str, value: float, unit: str, n: int) -> dict:
    return {"benchmark": "simulate_drive", "metric": metric, "value": value, "unit": unit, "peer": "", "n": n}
