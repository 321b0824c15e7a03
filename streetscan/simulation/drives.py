"""A drive through the simulated street on another day, as a recording like any other.

It gives the same stream of frames and fixes as `streetscan.drives.Recording`, so it is imported into the same form; its truth
(poses, labels, objects' motion, what changed in the street) is exact and goes the same way, apart.
"""

import hashlib
import json
import logging
import time
import zlib
from collections import Counter, deque
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np
import pandas as pd

from streetscan import geometry
from streetscan.classes import NAMES, UNLABELLED
from streetscan.drives import CameraFacts, DriveFacts, Record, TruthFacts, truth_of_camera
from streetscan.errors import BadInput
from streetscan.frames import CAMERA, CameraImage, LidarFrame, Mounting, nanoseconds
from streetscan.io.atomic import atomic_path
from streetscan.io.tables import save_tables
from streetscan.io.trajectories import write_poses_csv, write_tum
from streetscan.simulation.camera import AutoExposure, Camera, mount_camera, render, settle_exposure
from streetscan.simulation.changes import Day
from streetscan.simulation.daylight import Daylight
from streetscan.simulation.gps import Gps, record_fixes
from streetscan.simulation.layout import build_street
from streetscan.simulation.raycasting import SceneCaster
from streetscan.simulation.receiver import Receiver
from streetscan.simulation.recording import Trajectory, drive_road, replay_pass, without_collisions
from streetscan.simulation.rotating_lidar import (
    CAR_BOXES_M,
    HDL64E_RECEIVER,
    N_BEAMS,
    RotatingLidar,
    nominal_beams,
    read_beams,
    record_frame,
)
from streetscan.simulation.scene import Actor, Scene
from streetscan.simulation.sensors import VEHICLE_BOX_M

logger = logging.getLogger(__name__)
_LOG_EVERY_S, _REMEMBERED = 10.0, 50
_NS = 1_000_000_000
# The place of a drive that is the mapping vehicle's own, on the day of the map.
_MAPPING = "mapping"
CHANGE_COLUMNS = ["class", "change", "name", "instance", "instance_before", "x_m", "y_m", "moved_m"]


@dataclass(frozen=True)
class CameraShift:
    """A knock in mid-drive that leaves a camera elsewhere.

    ASSUME: it takes no time; an image is taken from where the camera sits in the middle of the exposure.

    Attributes:
        after_s: since the drive's start.
        xyz_m: forward, left and up, as the camera looked before.
        rpy_deg: roll, pitch and yaw of CameraMount, from how it looked before.
    """

    after_s: float
    xyz_m: tuple[float, float, float]
    rpy_deg: tuple[float, float, float]

    @property
    def T_camera_shifted(self) -> np.ndarray:
        return geometry.invert(_mount((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))) @ _mount(self.xyz_m, self.rpy_deg)


def _mount(xyz_m: tuple[float, float, float], rpy_deg: tuple[float, float, float]) -> np.ndarray:
    roll_deg, pitch_deg, yaw_deg = rpy_deg
    return mount_camera(xyz_m, yaw_deg, pitch_deg, roll_deg)


@dataclass(frozen=True)
class CameraMount:
    """A camera on the vehicle, and which of its images are rendered.

    Attributes:
        xyz_m: in the vehicle frame.
        rpy_deg: roll about the viewing direction, pitch downwards, yaw counter-clockwise from forward.
        rate_hz: images a second.
        n_keyframes: places of the drive, evenly spread, around which a window of images is rendered.
        window: images of a window, at the full rate.
        previews_per_s: images between the windows.
        is_full_rate: render every image.
        time_offset_s: what the images' stamps are ahead of the lidar's clock.
        jpeg_quality: of the images, 1 to 100.
        shift: where it sits from some moment on, or None.
        settings: what differs from `streetscan.simulation.camera.Camera`.
        daylight: what differs from `streetscan.simulation.daylight.Daylight`.
    """

    xyz_m: tuple[float, float, float]
    rpy_deg: tuple[float, float, float]
    rate_hz: float = 28.0
    n_keyframes: int = 2
    window: int = 10
    previews_per_s: float = 1.0
    is_full_rate: bool = False
    time_offset_s: float = 0.0
    jpeg_quality: int = 95
    shift: CameraShift | None = None
    settings: dict = field(default_factory=dict)
    daylight: dict = field(default_factory=dict)

    @property
    def T_vehicle_camera(self) -> np.ndarray:
        """(4, 4) from the start on."""
        return _mount(self.xyz_m, self.rpy_deg)

    def T_vehicle_camera_at(self, time_s: float) -> np.ndarray:
        """(4, 4) at a moment after the drive's start."""
        if self.shift is None or time_s < self.shift.after_s:
            return self.T_vehicle_camera
        return self.T_vehicle_camera @ self.shift.T_camera_shifted

    @property
    def lens(self) -> Camera:
        return Camera(**{k: tuple(v) if isinstance(v, list) else v for k, v in self.settings.items()})

    def image_times(self, end_s: float) -> list[tuple[float, bool]]:
        """Mid-exposures of the images rendered of a drive until `end_s`, and whether each follows the one before at the full rate.

        A window lies around the middle of each of `n_keyframes` equal parts of the drive.
        """
        n = int(end_s * self.rate_hz)
        chosen = set(range(n)) if self.is_full_rate else set()
        for k in range(self.n_keyframes):
            first = round((k + 0.5) / self.n_keyframes * end_s * self.rate_hz - self.window / 2)
            first = min(max(first, 0), max(n - self.window, 0))
            chosen |= set(range(first, min(first + self.window, n)))
        if self.previews_per_s and n:
            chosen |= {min(int((k + 0.5) / self.previews_per_s * self.rate_hz), n - 1) for k in range(int(end_s * self.previews_per_s))}
        return [((i + 0.5) / self.rate_hz, i - 1 in chosen) for i in sorted(chosen)]


@dataclass(frozen=True)
class SimulatedDrive:
    """The section `simulation` of a drive's file; see config/drive.schema.yaml for each key."""

    dataset: str
    split: str
    place: str
    n_frames: int
    speed_kmh: float | None = None
    start_m: float = 0.0
    number: int = 0
    backwards: bool = False
    blocks: tuple[int, int] | None = None
    traffic_density: float | None = None
    day: Day = field(default_factory=Day)
    lidar: dict = field(default_factory=dict)
    gps: Gps = field(default_factory=Gps)
    cameras: dict[str, CameraMount] = field(default_factory=dict)

    @property
    def is_mapping(self) -> bool:
        return self.place == _MAPPING


def read_simulation(values: dict) -> SimulatedDrive:
    """The section as read from YAML, checked against the schema before; the one `camera` becomes the camera of that name."""
    parts = {"day": Day, "gps": Gps}
    plain = {k: tuple(v) if isinstance(v, list) else v for k, v in values.items()}
    one = {CAMERA: plain.pop(CAMERA)} if CAMERA in plain else {}
    cameras = {name: _read_mount(mount) for name, mount in (one | plain.pop("cameras", {})).items()}
    return SimulatedDrive(**{k: parts[k](**v) if k in parts else v for k, v in plain.items()}, cameras=cameras)


def _read_mount(values: dict) -> CameraMount:
    return CameraMount(**values | ({"shift": CameraShift(**values["shift"])} if "shift" in values else {}))


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
            BadInput: the street has no such place, it is too short for the drive, or a camera is shifted after the drive's end.
        """
        self._drive = drive = read_simulation(facts.simulation)
        self._seed = zlib.crc32(f"{seed} {name}".encode())
        self.path = facts.where
        exact = {"source": "simulated: exact"}
        truth = TruthFacts(labels={"ids": "streetscan"}, poses=exact, extrinsics=exact if CAMERA in drive.cameras else None)
        self.facts = replace(facts, truth=truth, camera=CameraFacts() if drive.cameras else None)
        self.mountings = [
            Mounting(m["parent"], m["child"], geometry.transform(m["xyz_m"], np.radians(m["rpy_deg"])), m["source"]) for m in facts.mounting
        ]
        self._start_ns = nanoseconds(facts.start_time_s)
        self._lidar = _make_lidar(drive, facts.rate_hz, data_root, seed, facts.where)
        self._lenses = {name: mount.lens for name, mount in drive.cameras.items()}
        self._daylights = {name: Daylight(**mount.daylight) for name, mount in drive.cameras.items()}
        self._exposures: dict[str, AutoExposure] = {}
        self._n_kept = 0
        one = drive.cameras.get(CAMERA)
        self.camera_model = None if one is None else self._lenses[CAMERA].model
        self.T_camera_lidar = None if one is None else self._place_of(one.T_vehicle_camera)
        self._end_s = drive.n_frames / facts.rate_hz
        _check_shifts(drive, self._end_s, facts.where)

        changed = street if drive.traffic_density is None else street | {"traffic_density": drive.traffic_density}
        if drive.is_mapping:
            block = drive.blocks[0] if drive.blocks else 0
            scene, self._trajectory = replay_pass(drive.split, seed, changed, block)
            _check_length(self._trajectory, drive, self._end_s, facts.where)
        else:
            span_s = (-10.0, self._end_s + 5.0)
            scene = build_street(split=drive.split, seed=seed, day=drive.day, time_span_s=span_s, block=drive.blocks, **changed)
            self._trajectory = _plan(scene, drive, self._end_s, self._seed, facts.where)
        if facts.crs != scene.crs:
            raise BadInput(facts.where, f"crs {facts.crs} of a street in {scene.crs}", f"write crs: {scene.crs}")
        self._crs = scene.crs
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
        """Frames, images and fixes in the order of time. A drive that was stopped gives what it had made again without making it."""
        rng = np.random.default_rng([self._seed, 1])
        fixes = record_fixes(self._caster, self._drive.gps, self._trajectory, self._crs, self._end_s, rng, self._start_ns)
        events: list[tuple[int, str, Callable]] = [(fix.time_ns, "fix", lambda f=fix: f) for fix in fixes]
        for n in range(self._drive.n_frames):
            events.append((self._start_ns + round(self._lidar.stamp_s(n) * _NS), "frame", lambda n=n: self._frame(n)))
        for name, mount in self._drive.cameras.items():
            for n, (time_s, is_next) in enumerate(mount.image_times(self._end_s)):
                stamp_ns = self._stamp_of_image(mount, time_s)
                events.append((stamp_ns, "image", lambda c=name, n=n, t=time_s, i=is_next: self._image(c, n, t, i)))
        progress = _Progress(Counter(kind for _, kind, _ in events))
        yield from (replace(lens.model, camera=name) for name, lens in self._lenses.items())
        for time_ns, kind, make in sorted(events, key=lambda event: event[0]):
            n_kept, started = self._n_kept, time.perf_counter()
            record = make()
            record.time_ns = time_ns
            yield record
            # By now it is written, too.
            progress.step(kind, time.perf_counter() - started if self._n_kept == n_kept else None)

    def _stamp_of_image(self, mount: CameraMount, time_s: float) -> int:
        return self._start_ns + round((time_s + mount.time_offset_s) * _NS)

    def _place_of(self, T_vehicle_camera: np.ndarray) -> np.ndarray:
        """T_camera_lidar (4, 4)."""
        return geometry.invert(T_vehicle_camera) @ self._lidar.T_vehicle_lidar

    def true_surfaces(self, stamp_ns: int, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """What the camera sees at an image's stamp along directions (N, 3) in frame `camera`.

        Returns:
            distances (N,) in metres and classes (N,) uint8 of `streetscan.classes`; inf and 255 where nothing is hit.
        """
        mount = self._drive.cameras[CAMERA]
        time_s = (stamp_ns - self._start_ns) / _NS - mount.time_offset_s
        T_map_camera = self._vehicle_poses(np.array([time_s]))[0] @ mount.T_vehicle_camera_at(time_s)
        rays = directions / np.linalg.norm(directions, axis=1, keepdims=True) @ T_map_camera[:3, :3].T
        origins = np.tile(T_map_camera[:3, 3], (len(rays), 1))
        hits = self._caster.cast(origins, rays, np.full(len(rays), time_s))
        return hits.distances_m, np.where(hits.faces >= 0, self._caster.labels[hits.faces], UNLABELLED)

    def write_truth(self, folder: Path, times_ns: list[int]) -> dict:
        """Write the vehicle's trajectory, the objects' motion and what changed in the street; says in a mapping what there is."""
        trajectory = self._trajectory
        count = int(np.ceil((self._end_s - trajectory.start_s) * trajectory.rate_hz)) + 1
        times_s = trajectory.start_s + np.arange(count) / trajectory.rate_hz
        write_tum(folder / "trajectory.tum", times_s + self._start_ns / _NS, self._vehicle_poses(times_s))
        save_tables({
            folder / "objects.csv": _tabulate_objects(self._scene.actors, [(t - self._start_ns) / _NS for t in times_ns], times_ns),
            folder / "changes.csv": pd.DataFrame(self._scene.changes, columns=CHANGE_COLUMNS),
        })  # fmt: skip
        with atomic_path(folder / "changes.json") as partial:
            partial.write_text(json.dumps(count_changes(self._scene.changes), indent=1) + "\n")
        mountings = {"T_vehicle_lidar": self._lidar.T_vehicle_lidar, "T_vehicle_gps": geometry.transform(self._drive.gps.position_m)}
        contents = {
            "instances": {"type": "uint32, one file per frame, in the order of the points; 0 is none"},
            "trajectory": {"file": "trajectory.tum", "frame": "T_map_vehicle; firings lie between its poses, which are linear in time"},
        }
        if self._drive.cameras:
            contents["masks"] = {"type": "instances uint32 and labels uint8 of the pixels, one file per image in order of time"}
        places = {name: self._write_camera_truth(folder, name, mount) for name, mount in self._drive.cameras.items()}
        mountings |= {f"T_vehicle_{name}": mount.T_vehicle_camera for name, mount in self._drive.cameras.items()}
        if CAMERA in places:
            contents["extrinsics"] = places.pop(CAMERA)
        if places:
            contents["cameras"] = places
        return contents | {"mountings": {name: T.tolist() for name, T in mountings.items()}}

    def _write_camera_truth(self, folder: Path, name: str, mount: CameraMount) -> dict:
        """Write where a camera was at each of its images; says where it sits, and where and from which image on after a shift."""
        shown_s = np.array([t for t, _ in mount.image_times(self._end_s)])
        stamps_s = np.array([self._stamp_of_image(mount, t) for t in shown_s]) / _NS
        places = np.array([mount.T_vehicle_camera_at(t) for t in shown_s]).reshape(-1, 4, 4)
        poses = self._vehicle_poses(shown_s) @ places
        of_camera = truth_of_camera(folder, name)
        of_camera.mkdir(exist_ok=True)
        write_poses_csv(of_camera / "camera_poses.csv", np.arange(len(shown_s)), stamps_s, poses)
        place = {
            "T_camera_lidar": self._place_of(mount.T_vehicle_camera).tolist(),
            "time_offset_s": mount.time_offset_s,
            "source": "simulated: exact; images' stamps are time_offset_s ahead of the lidar's clock",
        }
        if mount.shift is not None:
            from_s, T_vehicle_camera = mount.shift.after_s, mount.T_vehicle_camera_at(mount.shift.after_s)
            later = {"from_image_time_ns": self._stamp_of_image(mount, from_s), "T_camera_lidar": self._place_of(T_vehicle_camera).tolist()}
            place["shift"] = later
        return place

    def _vehicle_poses(self, times_s: np.ndarray) -> np.ndarray:
        """T_map_vehicle (n, 4, 4)."""
        positions, rotations = self._trajectory.at(times_s)
        return geometry.transform_of_rotation(rotations, positions)

    def _frame(self, number: int) -> LidarFrame:
        def make() -> dict:
            frame = record_frame(self._caster, self._lidar, self._trajectory, number, self._seed)
            return {n: getattr(frame, n) for n in ("points", "intensity", "ring", "time_offset_s", "labels", "instances")}

        columns = self._keep(f"lidar_{number:06d}", make)
        return LidarFrame(0, **columns, number=number, status="ok" if len(columns["points"]) else "empty")

    def _image(self, name: str, number: int, time_s: float, is_next: bool) -> CameraImage:
        mount, daylight = self._drive.cameras[name], self._daylights[name]
        view = self._caster, self._trajectory, mount.T_vehicle_camera_at(time_s), self._lenses[name], time_s
        of_camera = [] if name == CAMERA else [zlib.crc32(name.encode())]

        def make() -> dict:
            # The automatic follows the light within a window, and has settled before it begins.
            auto = self._exposures[name] if is_next else settle_exposure(*view, daylight)
            image = render(*view, auto, np.random.default_rng([self._seed, 3, number, *of_camera]), daylight)
            quality = [cv2.IMWRITE_JPEG_QUALITY, mount.jpeg_quality]
            data = cv2.imencode(".jpg", image.rgb[..., ::-1], quality)[1]
            return {"data": data, "instances": image.instances, "labels": image.classes, "exposure": [auto.exposure_s, auto.gain]}

        kept = self._keep(f"{name}_{number:06d}", make)
        self._exposures[name] = AutoExposure(*(float(v) for v in kept["exposure"]))
        return CameraImage(0, kept["data"].tobytes(), "jpeg", instances=kept["instances"], labels=kept["labels"], camera=name)

    def _keep(self, name: str, make: Callable[[], dict]) -> dict[str, np.ndarray]:
        """Arrays made now, or by a run that was stopped."""
        path = self._kept / f"{name}.npz"
        if path.is_file():
            self._n_kept += 1
        else:
            with atomic_path(path) as partial, partial.open("wb") as stream:
                np.savez(stream, **make())
        with np.load(path) as arrays:
            return dict(arrays.items())


class _Progress:
    """Says now and then how far a drive is and how long it will still take; an image takes longer than a frame, a fix no time."""

    def __init__(self, counts: Counter):
        """
        Args:
            counts: how many records of each kind are to come.
        """
        self._n, self._left = counts.total(), counts.copy()
        # Of the last ones of each kind; their median passes over the first, for which kernels are compiled.
        self._seconds = {kind: deque(maxlen=_REMEMBERED) for kind in counts}
        self._started = self._said = time.perf_counter()

    def step(self, kind: str, seconds: float | None) -> None:
        """One more is done, in so many seconds; None when a run that was stopped had made it."""
        self._left[kind] -= 1
        if seconds is not None:
            self._seconds[kind].append(seconds)
        now, n_left = time.perf_counter(), self._left.total()
        if now - self._said >= _LOG_EVERY_S or not n_left:
            said = self._n - n_left, self._n, now - self._started, self.left_s
            logger.info("%d of %d frames, images and fixes after %.0f s, about %.0f s left", *said)
            self._said = now

    @property
    def left_s(self) -> float:
        """Seconds still to go; a kind of which none was made yet counts as the mean of the others."""
        known = {kind: float(np.median(seconds)) for kind, seconds in self._seconds.items() if seconds}
        usual = float(np.mean(list(known.values()))) if known else 0.0
        return sum(n * known.get(kind, usual) for kind, n in self._left.items())


def count_changes(changes: list[dict]) -> dict:
    """How many objects of each class stayed, moved, went, are others or new; and the share of the map's objects that stayed."""
    table = pd.DataFrame(changes, columns=CHANGE_COLUMNS)
    counts = pd.crosstab(table["class"], table["change"])
    result = {}
    for name, row in counts.iterrows():
        n_before = int(row.drop("new", errors="ignore").sum())
        result[name] = {"n_before": n_before} | {c: int(n) for c, n in row.items() if n}
        result[name]["share_same"] = round(float(row.get("same", 0)) / n_before, 3) if n_before else None
    return result


def _make_lidar(drive: SimulatedDrive, rate_hz: float, data_root: str | Path, seed: int, where: object) -> RotatingLidar:
    settings, boxes = drive.lidar, (VEHICLE_BOX_M,) if drive.is_mapping else CAR_BOXES_M
    calibration = settings.get("calibration")
    beams = nominal_beams(seed) if calibration is None else read_beams(Path(data_root) / calibration, seed)
    if len(beams) != N_BEAMS:
        raise BadInput(Path(data_root) / calibration, f"{len(beams)} lasers", f"give the calibration of a HDL-64E, which has {N_BEAMS}")
    height_m, roof_m = settings["xyz_m"][2], max(high[2] for _, high in boxes)
    if height_m <= roof_m:
        found = f"simulation.lidar.xyz_m puts the lidar {height_m} m above the road"
        raise BadInput(where, found, f"put it above the vehicle's roof, which is {roof_m} m high")
    T = geometry.transform(settings["xyz_m"], np.radians(settings["rpy_deg"]))
    return RotatingLidar(beams, rate_hz, T, Receiver(**HDL64E_RECEIVER | settings.get("receiver", {})), vehicle_boxes_m=boxes)


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
    _check_length(trajectory, drive, duration_s, where)
    return trajectory


def _check_length(trajectory: Trajectory, drive: SimulatedDrive, duration_s: float, where: object) -> None:
    if trajectory.end_s < duration_s:
        found = f"{drive.n_frames} frames take {duration_s:.1f} s, the drive is over after {trajectory.end_s:.1f} s"
        raise BadInput(where, found, "take fewer frames, drive slower or start earlier")


def _check_shifts(drive: SimulatedDrive, duration_s: float, where: object) -> None:
    for name, mount in drive.cameras.items():
        if mount.shift is not None and mount.shift.after_s >= duration_s:
            found = f"{name}.shift.after_s {mount.shift.after_s} in a drive of {duration_s:.1f} s"
            raise BadInput(where, found, "let the camera be shifted before the drive ends, or take more frames")


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
