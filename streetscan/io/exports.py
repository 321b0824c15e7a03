"""Drives written in other people's formats, and what each of them cannot hold."""

import csv
import shutil
from collections.abc import Iterable
from functools import partial
from pathlib import Path

import numpy as np

from streetscan.errors import BadInput
from streetscan.frames import CAMERA, CameraImage, CameraModel, GpsFix, LidarFrame, Mounting
from streetscan.io import kitti, trajectories
from streetscan.io.arrays import load_npy
from streetscan.io.atomic import atomic_folder, atomic_path
from streetscan.io.files import read_text, read_yaml
from streetscan.io.images import decode_image, encode_png
from streetscan.io.mcap import iterate_drive, open_drive_writer, read_metadata, read_topics
from streetscan.io.pcd_sequence import write_pcd_frame

# What a drive may hold, and how each format keeps it; what is not named here is lost.
KEPT = {
    "kitti_odometry": {
        "points": "velodyne/000000.bin, float32",
        "intensity": "fourth column; NaN when the drive has none",
        "stamps": "times.txt, seconds since the first frame",
        "images": "image_2/000000.png; JPEG is decoded and written as PNG",
        "intrinsics": "calib.txt, P0 to P3 (all the one camera)",
        "true poses": "poses.txt, of camera 0 when its true place is known, else of the lidar",
        "true labels": "labels/000000.label",
        "true extrinsics": "calib.txt, Tr",
    },
    "pcd_sequence": {
        "points": "000000.pcd, float32",
        "intensity": "field intensity",
        "ring": "field ring",
        "firing times": "field time_offset_s",
        "stamps": "times.txt, Unix seconds",
        "date": "times.txt",
    },
    "mcap": {
        "points": "/lidar",
        "intensity": "/lidar",
        "ring": "/lidar",
        "firing times": "/lidar, time_offset_s",
        "stamps": "/lidar",
        "date": "/lidar",
        "images": "/camera/image",
        "intrinsics": "/camera/calibration",
        "distortion": "/camera/calibration",
        "further cameras": "topics of their own",
        "gps": "/gps",
        "mounting": "/tf",
        "origin": "metadata streetscan",
    },
}
# "date" is when the first frame was taken, "frame status" that of the frames that are not `ok` in the frames.csv beside the drive;
# "further images" are those a format with one image per frame has no number for, "further cameras" images of cameras other than
# `/camera`; "shifted extrinsics" are those after a shift of the camera, for which no format has a place; "origin" is the drive's
# description, source and licence.
CONTENTS = (
    "points", "intensity", "ring", "firing times", "stamps", "images", "image stamps", "intrinsics", "distortion", "gps", "mounting",
    "true poses", "true labels", "true extrinsics", "shifted extrinsics", "further images", "further cameras", "date", "frame status",
    "origin",
)  # fmt: skip
# MCAP keeps the stamp of every image of its own.
KEPT["mcap"]["image stamps"] = "/camera/image"


def export_drive(
    mcap_path: str | Path, output: str | Path, format: str, truth_folder: str | Path | None = None, frames: range | None = None
) -> dict[str, int]:
    """Write a drive in another format, streaming.

    Args:
        mcap_path: drive.mcap.
        output: the folder (kitti_odometry, pcd_sequence) or file (mcap) to write; it replaces what is there.
        format: a key of KEPT.
        truth_folder: the drive's truth/, or None to leave truth out.
        frames: which frames, counted from 0; None: all. Images, fixes and the rest between the first and the last come along.
    Returns:
        what was dropped because the format has no place for it: a member of CONTENTS to how many frames or records had it.
    Raises:
        BadInput: an unknown format, no drive, or no frame in the range.
    """
    origin = {key: text for key, text in read_metadata(mcap_path, "streetscan").items() if key in ("drive", "description", "source")}
    writers = {"kitti_odometry": _write_kitti, "pcd_sequence": _write_pcd, "mcap": partial(_write_mcap, origin)}
    if format not in writers:
        raise BadInput("format", f"'{format}'", f"choose one of {', '.join(writers)}")
    present: dict[str, int] = dict.fromkeys(CONTENTS, 0)
    records = _counted(_in_range(iterate_drive(mcap_path, read_topics(mcap_path)), frames), present, mcap_path)
    if "further cameras" not in KEPT[format]:
        records = (r for r in records if getattr(r, "camera", CAMERA) == CAMERA)
    truth = None if truth_folder is None else _Truth(Path(truth_folder), present)
    writers[format](records, Path(output), truth, present)
    present["origin"] = int(bool(origin))
    present["frame status"] = _count_not_ok(Path(mcap_path).with_name("frames.csv"), frames)
    return {name: n for name, n in present.items() if n and name not in KEPT[format]}


def _count_not_ok(table: Path, frames: range | None) -> int:
    """Frames of the range that are not `ok`; 0 without a table."""
    if not table.is_file():
        return 0
    rows = csv.DictReader(read_text(table).splitlines())
    return sum(row.get("status") != "ok" for i, row in enumerate(rows) if frames is None or i in frames)


def format_losses(format: str, dropped: dict[str, int]) -> str:
    """The table of what was dropped, as text; empty when nothing was."""
    if not dropped:
        return ""
    width = max(len(name) for name in dropped)
    rows = [f"  {name:<{width}}  {n:>7}" for name, n in dropped.items()]
    return "\n".join([f"{format} has no place for:", f"  {'content':<{width}}  records", *rows])


class _Truth:
    """The truth beside a drive, as far as it is there."""

    def __init__(self, folder: Path, present: dict[str, int]):
        self._labels = folder / "labels"
        self.poses = self.T_camera_lidar = None
        if not folder.is_dir():
            raise BadInput(folder, "no such folder", "import the drive again, or leave the truth out")
        if (folder / "poses.csv").is_file():
            self.poses = trajectories.read_poses_csv(folder / "poses.csv")[2]
            present["true poses"] = len(self.poses)
        if (extrinsics := read_yaml(folder / "truth.yaml").get("extrinsics")) is not None:
            self.T_camera_lidar = np.array(extrinsics["T_camera_lidar"])
            present["true extrinsics"] = 1
            present["shifted extrinsics"] = int("shift" in extrinsics)
        present["true labels"] = len(list(self._labels.glob("*.npy")))

    def labels(self, frame: int) -> np.ndarray | None:
        path = self._labels / f"{frame:06d}.npy"
        return load_npy(path, "import_drive") if path.is_file() else None


def _in_range(records: Iterable, frames: range | None) -> Iterable:
    """The records with each lidar frame's number set to its place in the drive, and those outside the range left out."""
    number = 0
    for record in records:
        is_frame = isinstance(record, LidarFrame)
        if frames is not None and number >= frames.stop:
            return
        is_static = isinstance(record, CameraModel | Mounting)
        if frames is None or is_static or number in frames:
            if is_frame:
                record.number = number
            yield record
        number += is_frame


def _counted(records: Iterable, present: dict[str, int], where: str | Path) -> Iterable:
    """The records, while what they hold is counted; BadInput at their end when no lidar frame was among them."""
    for record in records:
        match record:
            case LidarFrame():
                names = ["points", "stamps", "date"]
                names += [
                    n
                    for n, v in (("intensity", record.intensity), ("ring", record.ring), ("firing times", record.time_offset_s))
                    if v is not None
                ]
            case CameraImage():
                names = ["images", "image stamps"] if record.camera == CAMERA else ["further cameras"]
            case CameraModel() if record.camera != CAMERA:
                names = []
            case CameraModel():
                names = ["intrinsics"] + (["distortion"] if np.any(record.D) else [])
            case GpsFix():
                names = ["gps"]
            case Mounting():
                names = ["mounting"]
        for name in names:
            present[name] += 1
        yield record
    if not present["stamps"]:
        raise BadInput(where, "holds no lidar frame in that range", "import the drive again, or choose other frames")


def _write_kitti(records: Iterable, output: Path, truth: _Truth | None, present: dict[str, int]) -> None:
    with atomic_folder(output) as folder:
        (folder / "velodyne").mkdir()
        images, stamps, numbers, model = _NumberedImages(folder / "image_2"), [], [], None
        for record in records:
            match record:
                case CameraModel():
                    model = record
                case CameraImage():
                    images.add(record)
                case LidarFrame():
                    name = f"{len(stamps):06d}"
                    images.begin_frame(len(stamps), record.time_ns)
                    stamps.append(record.time_ns)
                    numbers.append(record.number)
                    (folder / "velodyne" / f"{name}.bin").write_bytes(kitti.scan_bytes(record.points, record.intensity))
                    labels = truth.labels(record.number) if truth is not None else None
                    if labels is not None:
                        (folder / "labels").mkdir(exist_ok=True)
                        (folder / "labels" / f"{name}.label").write_bytes(labels.astype("<u4").tobytes())
        present["further images"] = images.finish()
        times = [f"{(t - stamps[0]) / 1e9:.9f}" for t in stamps]
        (folder / "times.txt").write_text("\n".join(times) + "\n")
        T = None if truth is None else truth.T_camera_lidar
        if model is not None:
            (folder / "calib.txt").write_text(kitti.calibration_text(model, T))
        if truth is not None and truth.poses is not None:
            trajectories.write_kitti_poses(folder / "poses.txt", _kitti_poses(truth.poses[numbers], T))


class _NumberedImages:
    """Gives each frame the image nearest to it in time: KITTI numbers frames and has no stamps of images.

    An image belongs to the frame before or after it, whichever is nearer; so it waits until the next frame is known.
    """

    def __init__(self, folder: Path):
        self._folder = folder
        self._waiting: list[CameraImage] = []
        self._frames: list[tuple[int, int]] = []
        self._gaps_ns: dict[int, int] = {}
        self._n_further = 0

    def add(self, image: CameraImage) -> None:
        self._waiting.append(image)
        # Before the next frame only the first and the last of the waiting can be anybody's nearest.
        if len(self._waiting) > 2:
            del self._waiting[1]
            self._n_further += 1

    def begin_frame(self, number: int, time_ns: int) -> None:
        self._frames = [*self._frames[-1:], (number, time_ns)]
        self._place()

    def finish(self) -> int:
        """Place what still waits; the number of images that belong to no frame."""
        self._place()
        return self._n_further

    def _place(self) -> None:
        for image in self._waiting:
            gap_ns, number = min((abs(time_ns - image.time_ns), number) for number, time_ns in self._frames)
            is_nearer = gap_ns < self._gaps_ns.get(number, 2**63)
            self._n_further += number in self._gaps_ns or not is_nearer
            if is_nearer:
                self._gaps_ns[number] = gap_ns
                self._folder.mkdir(exist_ok=True)
                data = image.data if image.format == "png" else encode_png(decode_image(image))
                (self._folder / f"{number:06d}.png").write_bytes(data)
        self._waiting = []
        self._gaps_ns = {number: self._gaps_ns[number] for number, _ in self._frames if number in self._gaps_ns}


def _kitti_poses(poses: np.ndarray, T_camera_lidar: np.ndarray | None) -> np.ndarray:
    """Poses relative to the first known one, of the camera when its place is known, as the benchmark writes them."""
    known = np.flatnonzero(np.isfinite(poses).all(axis=(1, 2)))
    if not len(known):
        return poses
    relative = np.linalg.inv(poses[known[0]]) @ poses
    return relative if T_camera_lidar is None else T_camera_lidar @ relative @ np.linalg.inv(T_camera_lidar)


def _write_pcd(records: Iterable, output: Path, truth: _Truth | None, present: dict[str, int]) -> None:
    with atomic_folder(output) as folder:
        stamps = []
        for record in records:
            if isinstance(record, LidarFrame):
                write_pcd_frame(folder / f"{len(stamps):06d}.pcd", record)
                stamps.append(record.time_ns)
        (folder / "times.txt").write_text("".join(f"{t // 10**9}.{t % 10**9:09d}\n" for t in stamps))


def _write_mcap(origin: dict[str, str], records: Iterable, output: Path, truth: _Truth | None, present: dict[str, int]) -> None:
    if output.is_dir():
        shutil.rmtree(output)
    with atomic_path(output) as unfinished, open_drive_writer(unfinished) as writer:
        if origin:
            writer.write_metadata("streetscan", origin)
        time_ns, static = None, []
        for record in records:
            # Intrinsics and mountings carry no stamp of their own: they take the one of the record that follows.
            if isinstance(record, CameraModel | Mounting):
                static.append(record)
                continue
            for item in static:
                (writer.write_calibration if isinstance(item, CameraModel) else writer.write_mounting)(item, record.time_ns)
            static, time_ns = [], record.time_ns
            write = {LidarFrame: writer.write_lidar, CameraImage: writer.write_image, GpsFix: writer.write_fix}[type(record)]
            write(record)
        for item in static:
            (writer.write_calibration if isinstance(item, CameraModel) else writer.write_mounting)(item, time_ns or 0)
