"""Frames of an imported drive in order, with their grid classes, by number."""

from collections.abc import Iterator
from pathlib import Path

from streetscan.frames import LidarFrame
from streetscan.io.frame_arrays import FrameArrays
from streetscan.io.mcap import iterate_lidar
from streetscan.registration.merging import MergeFrame
from streetscan.registration.odometry import Frame


class DriveFrames:
    """Reads a drive's frames once from front to back when the wanted numbers rise; starts again when they do not."""

    def __init__(self, drive_path: str | Path, classes_path: str | Path, step: int = 1):
        """
        Args:
            drive_path: drive.mcap.
            classes_path: what segment_frames wrote.
            step: every how many frames one is given (a slower sensor); numbers count all frames.
        Raises:
            BadInput: the classes are something else.
        """
        self._drive_path, self._step = drive_path, step
        self._classes = FrameArrays(classes_path, "segment_frames")
        self._stream: Iterator[tuple[int, LidarFrame]] | None = None
        self._next = 0

    def __len__(self) -> int:
        return len(self._classes)

    def _read(self, first: int, last: int) -> Iterator[tuple[int, LidarFrame]]:
        if self._stream is None or first < self._next:
            self._stream, self._next = enumerate(iterate_lidar(self._drive_path)), 0
        while self._next < last:
            index, frame = next(self._stream, (None, None))
            if frame is None:
                return
            self._next = index + 1
            if index >= first and index % self._step == 0:
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
