"""Frames of an imported drive in order, with their grid classes, by number."""

import hashlib
from collections.abc import Iterator
from pathlib import Path

from streetscan.errors import BadInput
from streetscan.frames import LidarFrame
from streetscan.geometry import invert
from streetscan.io.frame_arrays import FrameArrays
from streetscan.io.mcap import TF, iterate_drive, iterate_lidar
from streetscan.registration.merging import MergeFrame
from streetscan.registration.odometry import Frame


class DriveFrames:
    """Reads a drive's frames once from front to back when the wanted numbers rise; starts again when they do not."""

    def __init__(self, drive_path: str | Path, classes_path: str | Path, first: int = 0, last: int | None = None, every: int = 1):
        """
        Args:
            drive_path: drive.mcap.
            classes_path: what segment_frames wrote.
            first, last: frame numbers given, `last` not included; None gives all from the first on.
            every: every how many frames one is given (a slower sensor); numbers count all frames of the drive.
        Raises:
            BadInput: the classes are something else, or the drive is over before the first frame wanted.
        """
        self._drive_path, self._classes_path = Path(drive_path), Path(classes_path)
        self._classes = FrameArrays(classes_path, "segment_frames")
        self.last = len(self._classes) if last is None else min(last, len(self._classes))
        self.first, self._every = first, every
        if first >= self.last > 0:
            raise BadInput(drive_path, f"frames {first} to {self.last} of {len(self._classes)} hold no frame", "choose frames it has")
        self._stream: Iterator[tuple[int, LidarFrame]] | None = None
        self._next = 0

    @property
    def digest(self) -> str:
        """A name for what is read: equal names, equal frames and classes."""
        digest = hashlib.sha256(repr((self.first, self.last, self._every)).encode())
        for path in (self._drive_path, self._classes_path):
            with path.open("rb") as stream:
                digest.update(hashlib.file_digest(stream, "sha256").digest())
        return digest.hexdigest()[:16]

    def _read(self, first: int, last: int) -> Iterator[tuple[int, LidarFrame]]:
        first, last = max(first, self.first), min(last, self.last)
        if self._stream is None or first < self._next:
            self._stream, self._next = enumerate(iterate_lidar(self._drive_path)), 0
        while self._next < last:
            index, frame = next(self._stream, (None, None))
            if frame is None:
                return
            self._next = index + 1
            if index >= first and (index - self.first) % self._every == 0:
                yield index, frame

    def frames(self, first: int, last: int) -> Iterator[Frame]:
        """For registration: the frames with numbers in [first, last). BadInput when the classes are of another drive."""
        for index, frame in self._read(first, last):
            labels = self._classes.read(index, len(frame))
            yield Frame(index, frame.time_ns / 1e9, frame.points, labels, _offsets(frame))

    def merge_frames(self, first: int, last: int) -> Iterator[MergeFrame]:
        """For merging, likewise."""
        for index, frame in self._read(first, last):
            labels = self._classes.read(index, len(frame))
            yield MergeFrame(index, frame.time_ns / 1e9, frame.points, labels, _offsets(frame), frame.intensity)


def _offsets(frame: LidarFrame):
    """None when all points hold at the stamp already."""
    offsets = frame.time_offset_s
    return None if offsets is None or not offsets.any() else offsets


def read_sensor_height_m(drive_path: str | Path) -> float:
    """Height of the lidar above the road, from the mounting in a drive: the frame `vehicle` lies on the road.

    Raises:
        BadInput: the drive does not hold it, or the lidar is not above the road.
    """
    for mounting in iterate_drive(drive_path, (TF,)):
        T = {("vehicle", "lidar"): mounting.T_parent_child, ("lidar", "vehicle"): invert(mounting.T_parent_child)}
        if (mounting.parent, mounting.child) in T:
            height_m = float(T[mounting.parent, mounting.child][2, 3])
            if not height_m > 0:
                raise BadInput(drive_path, f"the lidar is mounted {height_m:g} m above the road", "mend mounting in the drive's file")
            return height_m
    raise BadInput(drive_path, "does not say how high the lidar is above the road", "add its mounting on the vehicle to the drive's file")
