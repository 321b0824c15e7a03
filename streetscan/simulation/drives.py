"""A drive through the simulated street on another day, as a recording like any other.

It gives the same stream of frames and fixes as `streetscan.drives.Recording`, so it is imported into the same form; its truth
(poses, labels, objects' motion, what changed in the street) is exact and goes the same way, apart.
"""

import hashlib
import json
import logging
import time
import zlib
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np
import pandas as pd

from streetscan import geometry
from streetscan.classes import NAMES
from streetscan.drives import DriveFacts, Record, TruthFacts
from streetscan.errors import BadInput
from streetscan.frames import CameraModel, GpsFix, LidarFrame, Mounting, nanoseconds
from streetscan.io.atomic import atomic_path
from streetscan.io.tables import save_tables
from streetscan.io.trajectories import write_tum
from streetscan.simulation.changes import Day
from streetscan.simulation.gps import Gps, record_fixes
from streetscan.simulation.layout import build_street
from streetscan.simulation.raycasting import SceneCaster
from streetscan.simulation.receiver import Receiver
from streetscan.simulation.recording import Trajectory, drive_road, without_collisions
from streetscan.simulation.rotating_lidar import HDL64E_RECEIVER, RotatingLidar, nominal_beams, read_beams, record_frame
from streetscan.simulation.scene import Actor, Scene

logger = logging.getLogger(__name__)
_LOG_EVERY_S = 10.0
_NS = 1_000_000_000


@dataclass(frozen=True)
class SimulatedDrive:
    """The section `simulation` of a drive's file; see config/drive.schema.yaml for each key."""

    dataset: str
    split: str
    place: str
    n_frames: int
    speed_kmh: float
    start_m: float = 0.0
    number: int = 0
    backwards: bool = False
    traffic_density: float | None = None
    day: Day = field(default_factory=Day)
    lidar: dict = field(default_factory=dict)
    gps: Gps = field(default_factory=Gps)


def read_simulation(values: dict) -> SimulatedDrive:
    """The section as read from YAML, checked against the schema before."""
    parts = {"day": Day, "gps": Gps}
    return SimulatedDrive(**{k: parts[k](**v) if k in parts else v for k, v in values.items()})


class SimulatedRecording:
    """A drive that is recorded while it is read; see `streetscan.drives.Recording` for what each member is."""

    def __init__(
        self, facts: DriveFacts, name: str, street: dict, seed: int, data_root: str | Path, resume_folder: str | Path, n_threads: int
    ):
        """
        Args:
            facts: the drive's file, with its section `simulation`.
            name: of the drive; two drives of one street differ by it.
            street: of `streetscan.simulation.layout.build_street`, as the map of the drive's data set was made with.
            seed: of the city and of everything random.
            data_root: the folder a calibration file is relative to.
            resume_folder: where finished frames are kept until the drive is whole.
            n_threads: of the ray caster.
        Raises:
            BadInput: the street has no such place, or it is too short for the drive.
        """
        self._drive = drive = read_simulation(facts.simulation)
        self._seed = zlib.crc32(f"{seed} {name}".encode())
        self.path = facts.where
        truth = TruthFacts(labels={"ids": "streetscan"}, poses={"source": "simulated: exact"})
        self.facts = replace(facts, truth=truth, start_time_s=facts.start_time_s)
        self.mountings = [
            Mounting(m["parent"], m["child"], geometry.transform(m["xyz_m"], np.radians(m["rpy_deg"])), m["source"]) for m in facts.mounting
        ]
        self.camera_model: CameraModel | None = None
        self.T_camera_lidar: np.ndarray | None = None
        self._start_ns = nanoseconds(facts.start_time_s)
        self._lidar = _make_lidar(drive.lidar, facts.rate_hz, data_root, seed)
        self._end_s = drive.n_frames / facts.rate_hz

        changed = street if drive.traffic_density is None else street | {"traffic_density": drive.traffic_density}
        scene = build_street(split=drive.split, seed=seed, day=drive.day, time_span_s=(-10.0, self._end_s + 5.0), **changed)
        self._crs = scene.crs
        self._trajectory = _plan(scene, drive, self._end_s, self._seed, facts.where)
        self._scene = without_collisions(scene, self._trajectory)
        self._caster = SceneCaster(self._scene, 0.0, self._end_s, n_threads)
        inputs = [asdict(drive), facts.rate_hz, facts.start_time_s, street, seed, name]
        self._kept = Path(resume_folder) / hashlib.sha256(json.dumps(inputs, sort_keys=True).encode()).hexdigest()[:16]

    @property
    def has_true_poses(self) -> bool:
        return True

    def true_pose(self, frame: LidarFrame) -> np.ndarray:
        """T_map_lidar (4, 4) of a frame."""
        return self._vehicle_poses(np.array([(frame.time_ns - self._start_ns) / _NS]))[0] @ self._lidar.T_vehicle_lidar

    def records(self) -> Iterator[Record]:
        """Frames and fixes in the order of time. A drive that was stopped gives the frames it had made again without making them."""
        rng = np.random.default_rng([self._seed, 1])
        fixes = record_fixes(self._caster, self._drive.gps, self._trajectory, self._crs, self._end_s, rng, self._start_ns)
        stamps = [(self._start_ns + round(self._lidar.stamp_s(n) * _NS), n) for n in range(self._drive.n_frames)]
        progress = _Progress(len(stamps), "frame")
        for time_ns, item in sorted([*stamps, *((f.time_ns, f) for f in fixes)], key=lambda pair: pair[0]):
            if isinstance(item, GpsFix):
                yield item
                continue
            frame = self._frame(item)
            frame.time_ns = time_ns
            progress.step()
            yield frame

    def write_truth(self, folder: Path, times_ns: list[int]) -> dict:
        """Write the vehicle's trajectory, the objects' motion and what changed in the street; says in a mapping what there is."""
        trajectory = self._trajectory
        count = int(np.ceil((self._end_s - trajectory.start_s) * trajectory.rate_hz)) + 1
        times_s = trajectory.start_s + np.arange(count) / trajectory.rate_hz
        write_tum(folder / "trajectory.tum", times_s + self._start_ns / _NS, self._vehicle_poses(times_s))
        save_tables({
            folder / "objects.csv": _tabulate_objects(self._scene.actors, [(t - self._start_ns) / _NS for t in times_ns], times_ns),
            folder / "changes.csv": pd.DataFrame(self._scene.changes),
        })  # fmt: skip
        with atomic_path(folder / "changes.json") as partial:
            partial.write_text(json.dumps(count_changes(self._scene.changes), indent=1) + "\n")
        return {
            "instances": {"type": "uint32, one file per frame, in the order of the points; 0 is none"},
            "trajectory": {"file": "trajectory.tum", "frame": "T_map_vehicle; firings lie between its poses, which are linear in time"},
            "mountings": {
                "T_vehicle_lidar": self._lidar.T_vehicle_lidar.tolist(),
                "T_vehicle_gps": geometry.transform(self._drive.gps.position_m).tolist(),
            },
        }

    def _vehicle_poses(self, times_s: np.ndarray) -> np.ndarray:
        """T_map_vehicle (n, 4, 4)."""
        positions, rotations = self._trajectory.at(times_s)
        return geometry.transform_of_rotation(rotations, positions)

    def _frame(self, number: int) -> LidarFrame:
        path = self._kept / f"lidar_{number:06d}.npz"
        names = ("points", "intensity", "ring", "time_offset_s", "labels", "instances")
        if path.is_file():
            with np.load(path) as arrays:
                columns = {n: arrays[n] for n in names}
            return LidarFrame(0, **columns, number=number, status="ok" if len(columns["points"]) else "empty")
        frame = record_frame(self._caster, self._lidar, self._trajectory, number, self._seed)
        with atomic_path(path) as partial, partial.open("wb") as stream:
            np.savez(stream, **{n: getattr(frame, n) for n in names})
        return frame


class _Progress:
    """Says now and then how far a long work is and how long it will still take."""

    def __init__(self, n: int, what: str):
        self._n, self._what, self._done = n, what, 0
        self._started = self._said = time.perf_counter()

    def step(self) -> None:
        """One more is done."""
        self._done += 1
        now = time.perf_counter()
        if now - self._said >= _LOG_EVERY_S or self._done == self._n:
            each = (now - self._started) / self._done
            logger.info("%s %d of %d, %.2f s each, %.0f s left", self._what, self._done, self._n, each, each * (self._n - self._done))
            self._said = now


def count_changes(changes: list[dict]) -> dict:
    """How many objects of each class stayed, moved, went, are others or new; and the share of the map's objects that stayed."""
    table = pd.DataFrame(changes, columns=["class", "change"])
    counts = pd.crosstab(table["class"], table["change"])
    result = {}
    for name, row in counts.iterrows():
        n_before = int(row.drop("new", errors="ignore").sum())
        result[name] = {"n_before": n_before} | {c: int(n) for c, n in row.items() if n}
        result[name]["share_same"] = round(float(row.get("same", 0)) / n_before, 3) if n_before else None
    return result


def _make_lidar(settings: dict, rate_hz: float, data_root: str | Path, seed: int) -> RotatingLidar:
    calibration = settings.get("calibration")
    beams = nominal_beams(seed) if calibration is None else read_beams(Path(data_root) / calibration, seed)
    T = geometry.transform(settings["xyz_m"], np.radians(settings["rpy_deg"]))
    return RotatingLidar(beams, rate_hz, T, Receiver(**HDL64E_RECEIVER | settings.get("receiver", {})))


def _plan(scene: Scene, drive: SimulatedDrive, duration_s: float, seed: int, where: object) -> Trajectory:
    """The drive along the wanted place, from time 0."""
    lines = scene.places.get(drive.place, [])
    if drive.number >= len(lines):
        raise BadInput(where, f"place '{drive.place}' number {drive.number} of a street that has {len(lines)}", "choose another place")
    line = lines[drive.number][::-1] if drive.backwards else lines[drive.number]
    along = np.append(0, np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1)))
    if drive.start_m >= along[-1] - 1:
        raise BadInput(where, f"start_m {drive.start_m} on a line of {along[-1]:.0f} m", "start earlier")
    start = np.array([np.interp(drive.start_m, along, line[:, i]) for i in range(3)])
    road = np.concatenate([[start], line[along > drive.start_m + 0.1]])
    trajectory = drive_road(road, drive.speed_kmh, scene.lane_offset_m, 0.0, np.random.default_rng([seed, 2]))
    if trajectory.end_s < duration_s:
        found = f"{drive.n_frames} frames take {duration_s:.1f} s, the drive is over after {trajectory.end_s:.1f} s"
        raise BadInput(where, found, "take fewer frames, drive slower or start earlier")
    return trajectory


def _tabulate_objects(actors: list[Actor], times_s: list[float], times_ns: list[int]) -> pd.DataFrame:
    """Where everything that may move is at each frame's stamp: one row per frame and object."""
    tables = []
    stamps = np.array(times_s)
    for actor in actors:
        positions, yaws = actor.pose_at(stamps)
        low, high = actor.mesh.vertices.min(axis=0), actor.mesh.vertices.max(axis=0)
        label = int(np.bincount(actor.mesh.labels).argmax())
        table = {"frame": np.arange(len(stamps)), "time_s": [f"{t // _NS}.{t % _NS:09d}" for t in times_ns]}
        table |= {"instance": int(actor.mesh.instances[0]), "class": NAMES[label]}
        table |= {"x_m": positions[:, 0].round(4), "y_m": positions[:, 1].round(4), "z_m": positions[:, 2].round(4)}
        table |= {"yaw_rad": yaws.round(5), "speed_mps": actor.speed_at(stamps).round(3)}
        table |= dict(zip(("length_m", "width_m", "height_m"), (high - low).round(3), strict=True))
        tables.append(pd.DataFrame(table))
    columns = ["frame", "time_s", "instance", "class", "x_m", "y_m", "z_m", "yaw_rad", "speed_mps", "length_m", "width_m", "height_m"]
    if not tables:
        return pd.DataFrame(columns=columns)
    return pd.concat(tables).sort_values(["frame", "instance"], kind="stable")[columns]
