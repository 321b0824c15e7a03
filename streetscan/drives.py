"""A drive: its facts, the stream of frames of its recording, and the one form it is imported into.

Truth stays apart: the drive's MCAP holds neither labels, nor true poses, nor the true place of the camera.
"""

import csv
import logging
import os
from bisect import bisect_left
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import yaml

from streetscan import geodesy, geometry
from streetscan.errors import BadInput
from streetscan.frames import CAMERA, STATUSES, CameraImage, CameraModel, GpsFix, LidarFrame, Mounting, camera_model, nanoseconds
from streetscan.io import folders, kitti, range_images, trajectories
from streetscan.io.arrays import save_npy
from streetscan.io.atomic import atomic_folder, atomic_path
from streetscan.io.files import check_readable, read_yaml
from streetscan.io.images import image_size
from streetscan.io.mcap import open_drive_writer
from streetscan.io.pcap import PacketDecoder, iterate_pcap
from streetscan.io.point_columns import LidarConventions
from streetscan.io.rosbags import MessageConverter, iterate_bag, iterate_ros_mcap

logger = logging.getLogger(__name__)
Record = LidarFrame | CameraImage | GpsFix | CameraModel
FRAME_COLUMNS = (
    "frame", "number", "time_s", "status", "n_points", "n_dropped", "first_offset_s", "last_offset_s", "image_time_s", "image_status",
)  # fmt: skip
_STATUS = FRAME_COLUMNS.index("status")
_NS = 1_000_000_000


@dataclass(frozen=True)
class LidarFacts:
    """The section `lidar` of a drive's file; see config/drive.schema.yaml for each key."""

    files: str | None = None
    times: str | None = None
    times_start: str | None = None
    times_end: str | None = None
    layout: str | None = None
    topic: str | None = None
    model: str | None = None
    calibration: str | None = None
    points: str = "as_fired"
    direction: str = "clockwise"
    stamp: str = "forward"
    intensity_max: float = 1.0
    time_unit_s: float | None = None
    fov_deg: float = 360.0
    min_range_m: float = 0.1
    max_range_m: float = 300.0


@dataclass(frozen=True)
class CameraFacts:
    """The section `camera`; `calibration` stays a mapping."""

    files: str | None = None
    times: str | None = None
    topic: str | None = None
    info_topic: str | None = None
    stamp_offset_s: float = 0.0
    calibration: dict[str, Any] | None = None
    source: str = ""
    n_keyframes: int = 1


@dataclass(frozen=True)
class GpsFacts:
    """The section `gps`."""

    format: str | None = None
    files: str | None = None
    times: str | None = None
    topic: str | None = None


@dataclass(frozen=True)
class TruthFacts:
    """The section `truth`; its parts stay mappings."""

    labels: dict[str, str] | None = None
    poses: dict[str, Any] | None = None
    extrinsics: dict[str, Any] | None = None


@dataclass(frozen=True)
class DriveFacts:
    """A drive's file; see config/drive.schema.yaml for each key. `where` is the file, named in errors."""

    description: str
    source: str
    reader: str
    rate_hz: float
    root: str = ""
    lidar: LidarFacts = LidarFacts()
    start_time_s: float = 0.0
    frames: tuple[int, ...] | None = None
    crs: str | None = None
    camera: CameraFacts | None = None
    gps: GpsFacts | None = None
    mounting: tuple[dict[str, Any], ...] = ()
    truth: TruthFacts = field(default_factory=TruthFacts)
    simulation: dict[str, Any] | None = None
    where: str = "drive"

    @property
    def conventions(self) -> LidarConventions:
        lidar = self.lidar
        return LidarConventions(lidar.points, lidar.direction, lidar.stamp, 1 / self.rate_hz, lidar.intensity_max, lidar.time_unit_s)


def read_drive_facts(path: str | Path, schema_path: str | Path) -> DriveFacts:
    """The facts of a drive, checked against the schema.

    Args:
        path: config/drives/<drive>.yaml.
        schema_path: config/drive.schema.yaml.
    Raises:
        BadInput: no such file, no YAML, an unknown or missing key, a value of the wrong kind, or keys the reader needs and lacks.
    """
    raw, schema = read_yaml(path), read_yaml(schema_path)
    error = jsonschema.exceptions.best_match(jsonschema.Draft202012Validator(schema).iter_errors(raw))
    if error is not None:
        key = ".".join(str(p) for p in error.absolute_path) or "the file"
        raise BadInput(path, f"{key}: {error.message}", "correct the key; config/drive.schema.yaml describes each")
    if keys := _keys_not_finite(raw):
        raise BadInput(path, f"{keys[0]} is no finite number", "write a number")
    sections = {"lidar": LidarFacts, "camera": CameraFacts, "gps": GpsFacts, "truth": TruthFacts}
    values = {k: sections[k](**v) if k in sections else tuple(v) if isinstance(v, list) else v for k, v in raw.items()}
    facts = DriveFacts(**values, where=str(path))
    _check_keys(facts)
    return facts


def _keys_not_finite(values: Any, key: str = "") -> list[str]:
    """The keys below `key` that hold NaN or infinity, which are numbers to a schema."""
    if isinstance(values, float) and not np.isfinite(values):
        return [key]
    items = values.items() if isinstance(values, dict) else enumerate(values) if isinstance(values, list) else ()
    return [k for name, value in items for k in _keys_not_finite(value, f"{key}.{name}" if key else str(name))]


def _check_keys(facts: DriveFacts) -> None:
    """Refuse files that lack what their reader needs, or say what it would not read."""
    if facts.reader == "simulate":
        _check_simulation(facts)
        return
    if facts.simulation is not None:
        raise BadInput(facts.where, f"a section simulation beside reader '{facts.reader}'", "remove it, or write reader: simulate")
    is_folder, is_topic = facts.reader == "folder", facts.reader in ("bag", "mcap")
    needed = {"folder": "files", "bag": "topic", "mcap": "topic", "pcap": "model"}[facts.reader]
    for name, section in (("lidar", facts.lidar), ("camera", facts.camera), ("gps", facts.gps)):
        if section is None:
            continue
        if name == "lidar" or facts.reader != "pcap":
            if getattr(section, needed) is None:
                raise BadInput(facts.where, f"{name}.{needed} is missing", f"reader '{facts.reader}' needs it")
        else:
            raise BadInput(facts.where, f"a section {name}", "remove it: a capture holds no camera, and its positions are read without it")
        for key in ("files", "times", "layout", "format"):
            if getattr(section, key, None) is not None and not is_folder:
                raise BadInput(facts.where, f"{name}.{key}", f"remove it: reader '{facts.reader}' reads no numbered files")
        if getattr(section, "topic", None) is not None and not is_topic:
            raise BadInput(facts.where, f"{name}.topic", f"remove it: reader '{facts.reader}' has no topics")
    if (facts.lidar.times_start is None) != (facts.lidar.times_end is None):
        raise BadInput(facts.where, "only one of lidar.times_start and lidar.times_end", "write both or none")
    if facts.lidar.times_start is not None and (facts.lidar.times is None or facts.lidar.stamp != "forward"):
        raise BadInput(facts.where, "lidar.times_start and times_end", "write lidar.times, the times of facing forward, and stamp: forward")
    if facts.camera is not None and facts.camera.info_topic is not None:
        if not is_topic:
            raise BadInput(facts.where, "camera.info_topic", f"remove it: reader '{facts.reader}' has no topics")
        if facts.camera.calibration is not None:
            raise BadInput(facts.where, "both camera.info_topic and camera.calibration", "keep the one that is right")
    poses = facts.truth.poses or {}
    if poses.get("format") in ("kitti", "tum") and "file" not in poses:
        raise BadInput(facts.where, "truth.poses.file is missing", f"format '{poses['format']}' needs it")
    if poses.get("format") == "gnss" and not (facts.crs and facts.gps and is_folder):
        raise BadInput(facts.where, "truth.poses of format gnss", "write crs and gps too, and use reader 'folder'")
    if facts.truth.labels and not is_folder:
        raise BadInput(facts.where, "truth.labels", f"remove it: reader '{facts.reader}' reads no label files")


def _check_simulation(facts: DriveFacts) -> None:
    """Refuse what a simulated drive would not read, and what would make the map's own drive another one."""
    nothing = DriveFacts(facts.description, facts.source, facts.reader, facts.rate_hz)
    for key in ("root", "frames", "lidar", "camera", "gps", "truth"):
        if getattr(facts, key) != getattr(nothing, key):
            raise BadInput(facts.where, f"a key {key}", "remove it: what a simulated drive reads stands in its section simulation")
    drive = facts.simulation
    if drive["place"] != "mapping":
        return
    for key in ("speed_kmh", "start_m", "backwards", "number", "traffic_density", "day"):
        if key in drive:
            raise BadInput(facts.where, f"simulation.{key} at place 'mapping'", "remove it: that drive is the one the map was made on")
    if len(set(drive.get("blocks", ()))) > 1:
        found = f"simulation.blocks {drive['blocks']} at place 'mapping'"
        raise BadInput(facts.where, found, "name one block twice: the mapping vehicle drives through its street block by block")


class Recording:
    """One recording as its drive's file describes it: what stands still, and the stream of its records."""

    def __init__(self, facts: DriveFacts, data_root: str | Path):
        """
        Args:
            facts: the drive's file.
            data_root: the folder its root is relative to.
        Raises:
            BadInput: nothing lies at the root, or a calibration is missing or is none.
        """
        self.facts = facts
        self.path = Path(data_root) / facts.root
        if not os.path.exists(self.path):
            raise BadInput(self.path, "no such file or folder", "check root in the drive's file and data_root")
        check_readable(self.path)
        if facts.reader == "folder" and not self.path.is_dir():
            raise BadInput(self.path, "is no folder", f"check root and reader in {facts.where}")
        self.root = self.path if self.path.is_dir() else self.path.parent
        self.camera_model, self._T_camera_reference = self._read_camera()
        self.mountings = [
            Mounting(m["parent"], m["child"], geometry.transform(m["xyz_m"], np.radians(m["rpy_deg"])), m["source"]) for m in facts.mounting
        ]
        self.T_camera_lidar = self._read_extrinsics()
        self._track = self._read_track()
        self._poses = self._read_poses()

    def records(self) -> Iterator[Record]:
        """Frames, images and fixes roughly in the order of time, in constant memory; see each reader for its errors."""
        facts = self.facts
        if facts.reader == "folder":
            yield from self._merge_fixes(self._iterate_folder())
        elif facts.reader == "pcap":
            yield from iterate_pcap(self.path, self._packet_decoder())
        else:
            sections = (facts.lidar, facts.camera, facts.gps)
            topics = [s.topic for s in sections if s is not None]
            topics += [facts.camera.info_topic] if facts.camera is not None and facts.camera.info_topic else []
            converter = MessageConverter(self.path, facts.conventions, self._packet_decoder() if facts.lidar.model else None)
            iterate = iterate_bag if facts.reader == "bag" else iterate_ros_mcap
            expected = [LidarFrame]
            expected += [CameraImage, CameraModel] if facts.camera is not None else []
            expected += [GpsFix] if facts.gps is not None else []
            for record in iterate(self.path, tuple(topics), converter):
                if type(record) not in expected:
                    found = f"topics {', '.join(topics)} hold a {type(record).__name__}, for which {facts.where} has no section"
                    raise BadInput(self.path, found, "name topics of points, of images and of fixes in their sections")
                if isinstance(record, CameraImage):
                    record.time_ns += nanoseconds(facts.camera.stamp_offset_s)
                yield record
            if converter.n_without_position:
                logger.warning("%d fixes without a position were left out", converter.n_without_position)

    def true_pose(self, frame: LidarFrame) -> np.ndarray:
        """T_map_lidar (4, 4) of a frame, NaN where the truth does not reach."""
        if self._poses is None:
            return np.full((4, 4), np.nan)
        times_ns, poses = self._poses
        if times_ns is None:
            return poses[frame.number] if frame.number < len(poses) else np.full((4, 4), np.nan)
        # Differences of whole nanoseconds keep what a float64 of Unix seconds would lose.
        return geometry.interpolate_poses(np.array([(frame.time_ns - times_ns[0]) / _NS]), (times_ns - times_ns[0]) / _NS, poses)[0]

    @property
    def has_true_poses(self) -> bool:
        return self._poses is not None

    def write_truth(self, folder: Path, times_ns: list[int]) -> dict:
        """Write truth beyond labels, poses and extrinsics, of which a recording knows none; says in a mapping what there is."""
        return {}

    def _packet_decoder(self) -> PacketDecoder:
        lidar = self.facts.lidar
        calibration = None if lidar.calibration is None else self.root / lidar.calibration
        return PacketDecoder(lidar.model, calibration, self.path, lidar.fov_deg, lidar.min_range_m, lidar.max_range_m)

    def _iterate_folder(self) -> Iterator[LidarFrame | CameraImage]:
        facts, lidar, camera = self.facts, self.facts.lidar, self.facts.camera
        stamps = partial(folders.stamps_of, self.root, rate_hz=facts.rate_hz, start_ns=nanoseconds(facts.start_time_s))
        named = folders.list_files(self.root, lidar.files, "lidar.files")
        scan_paths = folders.count_frames(named, "lidar.files", lidar.times == "file_names")
        scans = folders.NumberedFiles(scan_paths, *stamps(lidar.times, scan_paths))
        images = None
        if camera is not None:
            times = camera.times if camera.times is not None else lidar.times
            paths = folders.list_files(self.root, camera.files, "camera.files")
            paths = folders.count_frames(paths, "camera.files", times == "file_names")
            of_image, _ = stamps(times, paths)
            images = folders.NumberedFiles(paths, lambda number: of_image(number) + nanoseconds(camera.stamp_offset_s))
        labels = {}
        if facts.truth.labels:
            labels = folders.list_files(self.root, facts.truth.labels["files"], "truth.labels.files")
            # Where scans are named by their times, the labels of a scan bear its time.
            labels = labels if scan_paths is named else {i: labels[n] for i, n in enumerate(named) if n in labels}
        layout = None if lidar.layout is None else range_images.read_layout(self.root / lidar.layout)
        read = folders.scan_reader(lidar.files, facts.conventions, layout, self._halves())
        yield from folders.iterate_folder(scans, images, labels, read, None if facts.frames is None else list(facts.frames))

    def _halves(self):
        """Stamp to (start, end) of its revolution relative to it, where the recording lists all three."""
        lidar = self.facts.lidar
        if lidar.times_start is None or lidar.times is None:
            return None
        middle, start, end = (kitti.read_times(self.root / t) for t in (lidar.times, lidar.times_start, lidar.times_end))
        if not len(middle) == len(start) == len(end):
            raise BadInput(
                self.root / lidar.times, f"lists of {len(middle)}, {len(start)} and {len(end)} times", "give lists of one recording"
            )
        bad = np.flatnonzero(~((start <= middle) & (middle <= end)))
        if len(bad):
            found = f"row {bad[0]} of the three lists is not in the order start, forward, end"
            raise BadInput(self.root / lidar.times, found, "check lidar.times_start and lidar.times_end")
        halves = {int(m): ((s - m) / _NS, (e - m) / _NS) for m, s, e in zip(middle, start, end, strict=True)}
        return halves.__getitem__

    def _merge_fixes(self, records: Iterator[LidarFrame | CameraImage]) -> Iterator[Record]:
        fixes = iter(_fixes(self._track)) if self._track is not None else iter(())
        fix = next(fixes, None)
        for record in records:
            while fix is not None and fix.time_ns <= record.time_ns:
                yield fix
                fix = next(fixes, None)
            yield record
        if fix is not None:
            yield fix
        yield from fixes

    def _read_camera(self) -> tuple[CameraModel | None, np.ndarray]:
        calibration = self.facts.camera.calibration if self.facts.camera is not None else None
        if calibration is None:
            return None, np.eye(4)
        if "file" in calibration:
            size = calibration.get("width"), calibration.get("height")
            return kitti.read_camera(self.root / calibration["file"], calibration["camera"], *size)
        K = np.array(calibration["K"], np.float64).reshape(3, 3)
        name, D = calibration.get("distortion_model", "plumb_bob"), calibration.get("D", [])
        size, where = (calibration["width"], calibration["height"]), f"{self.facts.where}, camera.calibration"
        return camera_model(*size, K, D, name, np.c_[K, np.zeros(3)], where), np.eye(4)

    def _read_extrinsics(self) -> np.ndarray | None:
        truth = self.facts.truth.extrinsics
        return None if truth is None else self._T_camera_reference @ self._rigid(truth["lidar_to_camera"], "truth.extrinsics")

    def _rigid(self, facts: dict[str, Any] | None, key: str) -> np.ndarray:
        if facts is None:
            return np.eye(4)
        if "file" in facts:
            return kitti.read_rigid(self.root / facts["file"], facts.get("key"))
        R = geometry.check_rotation(np.reshape(facts["rotation"], (3, 3)), f"{self.facts.where}, {key}.rotation")
        return geometry.transform_of_rotation(R, facts["xyz_m"])

    def _read_track(self) -> kitti.GnssTrack | None:
        gps = self.facts.gps
        if gps is None or gps.format is None:
            return None
        if gps.format == "csv":
            return kitti.read_gnss_csv(self.root / gps.files)
        # A file's number is its row in the list of times: a missing file must not move the fixes after it.
        numbered = folders.list_files(self.root, f"{gps.files}/*.txt", "gps.files")
        stamp, _ = folders.stamps_of(self.root, gps.times, numbered, self.facts.rate_hz, nanoseconds(self.facts.start_time_s))
        return kitti.read_oxts(list(numbered.values()), np.array([stamp(n) for n in numbered], np.int64))

    def _read_poses(self) -> tuple[np.ndarray | None, np.ndarray] | None:
        """Times (None: row n is frame number n) and T_map_lidar of the true poses."""
        truth = self.facts.truth.poses
        if truth is None:
            return None
        if truth["format"] == "kitti":
            T_camera_lidar = self._rigid(truth.get("lidar_to_camera"), "truth.poses.lidar_to_camera")
            return None, geometry.invert(T_camera_lidar) @ trajectories.read_kitti_poses(self.root / truth["file"]) @ T_camera_lidar
        if truth["format"] == "tum":
            times_s, poses = trajectories.read_tum(self.root / truth["file"])
            return np.array([nanoseconds(t) for t in times_s], np.int64), poses
        track = self._track
        if track.rpy_rad is None:
            raise BadInput(self.root / self.facts.gps.files, "holds no attitude", "add roll_rad, pitch_rad and yaw_rad")
        T_map_imu = geodesy.grid_poses(
            track.latitude_deg, track.longitude_deg, track.altitude_m, track.rpy_rad, self.facts.crs, self.facts.where
        )
        T_lidar_imu = self._rigid(truth.get("imu_to_lidar"), "truth.poses.imu_to_lidar")
        # KITTI's OXTS stamps now and then run backwards; poses are looked up between stamps that increase.
        increasing = np.concatenate([[True], track.time_ns[1:] > np.maximum.accumulate(track.time_ns)[:-1]])
        return track.time_ns[increasing], (T_map_imu @ geometry.invert(T_lidar_imu))[increasing]


def _fixes(track: kitti.GnssTrack) -> Iterator[GpsFix]:
    for i in range(len(track)):
        accuracy_m = track.accuracy_m[i]
        covariance = np.eye(3) * accuracy_m**2 if np.isfinite(accuracy_m) else None
        yield GpsFix(int(track.time_ns[i]), track.latitude_deg[i], track.longitude_deg[i], track.altitude_m[i], covariance)


def import_drive(recording: Recording, name: str, mcap_path: str | Path, frames_path: str | Path, truth_folder: str | Path) -> Counter:
    """Write a recording as MCAP, a table of its frames, and its truth apart; streaming, in memory that does not grow with points.

    Args:
        recording: the recording, or what has its members (`streetscan.simulation.drives.SimulatedRecording`).
        name: of the drive.
        mcap_path: drive.mcap.
        frames_path: frames.csv, one row per message of `/lidar`, in this order, with its status.
        truth_folder: gets poses.csv and poses.tum, labels/<frame>.npy and instances/<frame>.npy (uint32, the source's ids, in the order
            of the points), masks/<image>.npz (instances and labels of the pixels; of one of several cameras in a folder of its name), as
            far as there is truth; and truth.yaml, with the extrinsics, which says what there is.
    Returns:
        how many frames have each status.
    Raises:
        BadInput: the recording cannot be read, or not one of its frames is usable.
    """
    table = _FrameTable(recording.facts)
    n_fixes, models = 0, {} if recording.camera_model is None else {CAMERA: recording.camera_model}
    with atomic_folder(truth_folder) as truth, atomic_path(frames_path) as table_path, open_drive_writer(mcap_path) as writer:
        # What stands still has no stamp of its own and takes that of the next record.
        still: list[Mounting | CameraModel] = [*recording.mountings, *models.values()]
        for record in recording.records():
            if isinstance(record, CameraModel):
                # Cameras repeat their intrinsics with every image.
                if record.camera not in models or not record.equals(models[record.camera]):
                    models[record.camera] = record
                    still.append(record)
                continue
            for item in still:
                (writer.write_calibration if isinstance(item, CameraModel) else writer.write_mounting)(item, record.time_ns)
            still = []
            match record:
                case LidarFrame():
                    table.add_frame(record, recording.true_pose(record) if recording.has_true_poses else None)
                    writer.write_lidar(record)
                    for kind in ("labels", "instances"):
                        if (values := getattr(record, kind)) is not None:
                            save_npy(truth / kind / f"{table.n_frames - 1:06d}.npy", values)
                case CameraImage():
                    model = models.get(record.camera)
                    if record.status == "ok" and model is not None and model.width and image_size(record) != (model.width, model.height):
                        record.status = "other_size"
                    if record.instances is not None:
                        masks = truth_of_camera(truth, record.camera) / "masks"
                        with atomic_path(masks / f"{table.n_images[record.camera]:06d}.npz") as partial, partial.open("wb") as stream:
                            np.savez_compressed(stream, instances=record.instances, labels=record.labels)
                    table.add_image(record)
                    if record.status == "ok":
                        writer.write_image(record)
                case GpsFix():
                    n_fixes += 1
                    writer.write_fix(record)
        table.mark_order()
        counts = table.counts
        if not counts["ok"] + counts["partial"]:
            found = ", ".join(f"{n} {status}" for status, n in counts.items()) or "no frame"
            raise BadInput(recording.path, f"not one usable frame ({found})", "check the reader and the keys of section lidar")
        facts = recording.facts
        writer.write_metadata(
            "streetscan",
            {"drive": name, "description": facts.description, "source": facts.source, "n_frames": table.n_frames}
            | {f"n_{status}": n for status, n in counts.items()},
        )
        table.write(table_path)
        _write_truth(recording, table, truth)
    _log_summary(recording, table, n_fixes)
    return counts


class _FrameTable:
    """One row per lidar frame: small numbers only, so a drive of a million frames fits."""

    def __init__(self, facts: DriveFacts):
        self._facts = facts
        self.rows: list[list] = []
        self.poses: list[np.ndarray] = []
        self.counts: Counter = Counter()
        self.time_ns: list[int] = []
        self.n_unlabelled = 0
        self.image_ns: list[int] = []
        self.image_status: list[str] = []
        self.n_images: Counter = Counter()

    @property
    def n_frames(self) -> int:
        return len(self.rows)

    def add_frame(self, frame: LidarFrame, pose: np.ndarray | None) -> None:
        assert frame.status in STATUSES
        self.counts[frame.status] += 1
        offsets = frame.time_offset_s
        ends = ("nan", "nan") if offsets is None or not len(offsets) else (f"{offsets.min():.6f}", f"{offsets.max():.6f}")
        self.rows.append([self.n_frames, frame.number, _seconds_text(frame.time_ns), frame.status, len(frame), frame.n_dropped, *ends])
        self.time_ns.append(frame.time_ns)
        self.n_unlabelled += len(frame) > 0 and frame.labels is None
        if pose is not None:
            self.poses.append(pose)

    def mark_order(self) -> None:
        """Mark the fewest frames whose stamps are out of order, so one wrong stamp does not condemn all that follow."""
        for row, is_good in zip(self.rows, _in_order(self.time_ns), strict=True):
            if not is_good and row[_STATUS] in ("ok", "partial"):
                self.counts[row[_STATUS]] -= 1
                row[_STATUS] = "time_backwards"
                self.counts["time_backwards"] += 1
        self.counts = +self.counts

    def add_image(self, image: CameraImage) -> None:
        self.image_ns.append(image.time_ns)
        self.image_status.append(image.status)
        self.n_images[image.camera] += 1

    def write(self, path: str | Path) -> None:
        with Path(path).open("w", newline="") as stream:
            writer = csv.writer(stream)
            writer.writerow(FRAME_COLUMNS)
            for row, image in zip(self.rows, self._images_of_frames(), strict=True):
                writer.writerow([*row, *image])

    def _images_of_frames(self) -> list[tuple[str, str]]:
        """Time and status of the image nearest to each frame, within half a revolution."""
        if self._facts.camera is None:
            return [("nan", "none")] * self.n_frames
        lacking = "nan", "not_rendered" if self._facts.reader == "simulate" else "missing"
        if not self.image_ns:
            return [lacking] * self.n_frames
        order = np.argsort(self.image_ns, kind="stable")
        images, frames = np.array(self.image_ns, np.int64)[order], np.array(self.time_ns, np.int64)
        after = np.clip(np.searchsorted(images, frames), 1, max(len(images) - 1, 1))
        after = np.minimum(after, len(images) - 1)
        before = np.maximum(after - 1, 0)
        nearest = np.where(np.abs(images[after] - frames) < np.abs(images[before] - frames), after, before)
        is_near = np.abs(images[nearest] - frames) <= 0.5 * _NS / self._facts.rate_hz
        return [
            (_seconds_text(int(images[i])), self.image_status[order[i]]) if near else lacking
            for i, near in zip(nearest, is_near, strict=True)
        ]

    @property
    def images_lacking(self) -> Counter:
        """How many frames have no image, by the reason."""
        return Counter(status for _, status in self._images_of_frames() if status not in ("ok", "none"))


def truth_of_camera(folder: Path, camera: str) -> Path:
    """The folder for the truth of a camera's images within truth/: that of the one camera lies in truth/ itself."""
    return folder if camera == CAMERA else folder / camera


def _in_order(times_ns: list[int]) -> list[bool]:
    """Which of the times belong to the longest sequence that increases; of several the one whose times come first."""
    # Patience sorting from the back: ends[k] is the best start of a sequence of k + 1 times, negated.
    ends, holders, following = [], [], [-1] * len(times_ns)
    for i in reversed(range(len(times_ns))):
        k = bisect_left(ends, -times_ns[i])
        following[i] = holders[k - 1] if k else -1
        ends[k : k + 1], holders[k : k + 1] = [-times_ns[i]], [i]
    is_good = [False] * len(times_ns)
    i = holders[-1] if holders else -1
    while i >= 0:
        is_good[i] = True
        i = following[i]
    return is_good


def _seconds_text(time_ns: int) -> str:
    return f"{'-' if time_ns < 0 else ''}{abs(time_ns) // _NS}.{abs(time_ns) % _NS:09d}"


def _write_truth(recording: Recording, table: _FrameTable, folder: Path) -> None:
    facts = recording.facts
    contents: dict[str, Any] = {"labels": None, "poses": None, "extrinsics": None}
    if facts.truth.labels:
        n_labelled = len(list((folder / "labels").glob("*.npy")))
        contents["labels"] = {
            "ids": facts.truth.labels["ids"],
            "n_frames": n_labelled,
            "type": "uint32, one file per frame, in the order of the points",
        }
    if recording.has_true_poses:
        times_s = np.array(table.time_ns) / _NS
        poses = np.array(table.poses).reshape(-1, 4, 4)
        trajectories.write_poses_csv(folder / "poses.csv", np.arange(table.n_frames), times_s, poses)
        trajectories.write_tum(folder / "poses.tum", times_s, poses)
        contents["poses"] = {
            "crs": facts.crs,
            "frame": "map" if facts.crs else "local: the lidar at its first pose",
            "source": facts.truth.poses["source"],
        }
    if recording.T_camera_lidar is not None:
        contents["extrinsics"] = {"T_camera_lidar": recording.T_camera_lidar.tolist(), "source": facts.truth.extrinsics["source"]}
    contents |= recording.write_truth(folder, table.time_ns)
    with atomic_path(folder / "truth.yaml") as partial_path:
        partial_path.write_text(yaml.safe_dump(contents, sort_keys=False))


def _log_summary(recording: Recording, table: _FrameTable, n_fixes: int) -> None:
    logger.info("%d frames: %s", table.n_frames, ", ".join(f"{n} {status}" for status, n in table.counts.most_common()))
    for status, n in table.counts.items():
        if status != "ok":
            logger.warning("%d of %d frames are '%s': %s", n, table.n_frames, status, STATUSES[status])
    n_dropped = sum(row[5] for row in table.rows)
    if n_dropped:
        logger.info("%d returns without finite coordinates were left out", n_dropped)
    if recording.facts.truth.labels and table.n_unlabelled:
        logger.warning("%d of %d frames hold points and have no true labels", table.n_unlabelled, table.n_frames)
    if n_other := table.image_status.count("other_size"):
        logger.warning("%d images are of another size than the camera's calibration and were left out", n_other)
    lacking = table.images_lacking
    if n_between := lacking.pop("not_rendered", 0):
        n_beside = table.n_frames - n_between - lacking.total()
        logger.info("%d images were asked for, %d of %d frames have one beside them", len(table.image_ns), n_beside, table.n_frames)
    if lacking:
        reasons = ", ".join(f"{n} {status}" for status, n in lacking.most_common())
        logger.warning("%d of %d frames have no image (%s)", lacking.total(), table.n_frames, reasons)
    if not n_fixes:
        reason = "its poses are known in metres only" if recording.has_true_poses else "it holds no position"
        logger.info("no /gps: %s", reason)
