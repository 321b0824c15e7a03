"""Frames of an imported drive in order, levelled, with their grid classes, by number.

The grid and the street stand upright, whatever way the lidar is mounted (Józsa & Benedek 2013, 7.2 tilts it by 45 degrees for facades):
frames are read in frame `level`, which sits at the lidar and has the axes of the vehicle.
"""

import hashlib
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from streetscan.errors import BadInput
from streetscan.frames import LidarFrame
from streetscan.geometry import invert
from streetscan.io.frame_arrays import FrameArrays
from streetscan.io.mcap import TF, iterate_drive, iterate_lidar
from streetscan.registration.merging import MergeFrame
from streetscan.registration.odometry import Frame, FramePose


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
            BadInput: the classes are something else, the drive does not say how its lidar is mounted, or it is over before the first
                frame wanted.
        """
        self._drive_path, self._classes_path = Path(drive_path), Path(classes_path)
        self._classes = FrameArrays(classes_path, "segment_frames")
        self._T_level_lidar = np.eye(4)
        self._T_level_lidar[:3, :3] = read_mounting(drive_path)[:3, :3]
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

    def poses_of_lidar(self, poses: list[FramePose]) -> list[FramePose]:
        """Poses of frame `level`, as registration finds them, as poses of the lidar."""
        return [_turned(pose, self._T_level_lidar) for pose in poses]

    def poses_of_level(self, poses: list[FramePose]) -> list[FramePose]:
        """The inverse of `poses_of_lidar`."""
        return [_turned(pose, invert(self._T_level_lidar)) for pose in poses]

    def _read(self, first: int, last: int) -> Iterator[tuple[int, LidarFrame]]:
        first, last = max(first, self.first), min(last, self.last)
        if self._stream is None or first < self._next:
            self._stream, self._next = enumerate(iterate_level(self._drive_path)), 0
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


def _turned(pose: FramePose, T_frame_other: np.ndarray) -> FramePose:
    """The pose of another frame with the same origin; motion in that one's axes."""
    R = T_frame_other[:3, :3].T
    return replace(
        pose,
        T_segment_lidar=pose.T_segment_lidar @ T_frame_other,
        velocity_mps=R @ pose.velocity_mps,
        turn_rate_radps=R @ pose.turn_rate_radps,
    )


def iterate_level(drive_path: str | Path) -> Iterator[LidarFrame]:
    """The lidar frames of a drive with their points in frame `level`. BadInput as in `read_mounting` and `iterate_lidar`."""
    R = read_mounting(drive_path)[:3, :3].astype(np.float32)
    is_level = np.array_equal(R, np.eye(3, dtype=np.float32))
    for frame in iterate_lidar(drive_path):
        yield frame if is_level else replace(frame, points=frame.points @ R.T)


def read_mounting(drive_path: str | Path) -> np.ndarray:
    """T_vehicle_lidar (4, 4) as a drive holds it; the frame `vehicle` lies on the road, so its z is the lidar's height.

    Raises:
        BadInput: the drive does not hold it, or the lidar is not above the road.
    """
    for mounting in iterate_drive(drive_path, (TF,)):
        T = {("vehicle", "lidar"): mounting.T_parent_child, ("lidar", "vehicle"): invert(mounting.T_parent_child)}
        if (mounting.parent, mounting.child) in T:
            T_vehicle_lidar = T[mounting.parent, mounting.child]
            if not T_vehicle_lidar[2, 3] > 0:
                found = f"the lidar is mounted {T_vehicle_lidar[2, 3]:g} m above the road"
                raise BadInput(drive_path, found, "mend mounting in the drive's file")
            return T_vehicle_lidar
    raise BadInput(drive_path, "does not say how high the lidar is above the road", "add its mounting on the vehicle to the drive's file")
