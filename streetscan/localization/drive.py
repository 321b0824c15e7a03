"""The frames of a drive on the map, one after the other.

Each frame is localized from its own start (the thesis), or from where the last one was found (tracking): a small window around the
pose that the motion predicts, and the whole window again once the track is lost. Motion, from the last poses or else from GPS,
also frees each frame of the vehicle's movement during the revolution.
"""

import logging
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np

from streetscan.errors import BadInput
from streetscan.frames import LidarFrame
from streetscan.geometry import rpy_of_transform
from streetscan.localization.localizer import Location, Start
from streetscan.localization.starts import Starts
from streetscan.localization.voting import Window
from streetscan.sweeps import deskew, velocity_between

logger = logging.getLogger(__name__)
MODES = ("gps", "even", "tracking", "none")


class Localizer(Protocol):
    """Whatever finds the pose of one frame."""

    def locate(self, points: np.ndarray, start: Start) -> Location:
        """The pose of (N, 3) points, frame `lidar`, searched from a start in `map`."""


@dataclass(frozen=True)
class DriveSettings:
    """How the frames of a drive follow one another.

    Attributes:
        mode: `gps` and `even`: every frame from its own start; `tracking`: from the last pose; `none`: from the position alone, heading
            unknown, in the wide window.
        is_deskewed: undo the motion within a revolution, where it is known and the points have times.
        every: every how many frames one is localized.
        n_frames: so many of these, evenly over the drive; None is all.
        first: the first one.
        tracking_window: searched around a predicted pose.
        max_lost: after so many frames in a row without `ok` the track is lost.
        wide_window: of mode `none`.
    """

    mode: str = "gps"
    is_deskewed: bool = True
    every: int = 1
    n_frames: int | None = None
    first: int = 0
    tracking_window: Window = field(default_factory=lambda: Window(turn_deg=6.0, shift_m=3.0, rise_m=1.0))
    max_lost: int = 3
    wide_window: Window = field(default_factory=lambda: Window(turn_deg=180.0, shift_m=60.0, turn_step_deg=0.5))

    def __post_init__(self):
        if self.mode not in MODES:
            raise BadInput("localizers.start", f"'{self.mode}'", f"choose one of {', '.join(MODES)}")


@dataclass
class FrameLocation:
    """One row: a frame's number, its stamp, its start and what was found."""

    index: int
    time_s: float
    start: Start
    location: Location


# Two poses farther apart in time do not show the motion between them.
_MAX_INTERVAL_S = 0.5
# Poses of this many frames are the motion: the noise of two of them, 0.1 s apart, would be half a metre per second.
_N_MOTION = 4


class _Track:
    """The last believed poses, newest last."""

    def __init__(self):
        self._times_s, self._poses, self.n_lost = [], [], 0

    def add(self, time_s: float, location: Location) -> None:
        if location.status != "ok":
            self.n_lost += 1
            return
        if self._times_s and not 0 < time_s - self._times_s[-1] <= _MAX_INTERVAL_S:
            self._times_s, self._poses = [], []
        self._times_s = [*self._times_s, time_s][-_N_MOTION:]
        self._poses = [*self._poses, location.T_map_lidar][-_N_MOTION:]
        self.n_lost = 0

    def motion_at(self, time_s: float) -> tuple[np.ndarray, np.ndarray] | None:
        """Velocity (3,) and turn rate (3,), frame `lidar`; None when the track is too short or too old."""
        if len(self._poses) < 2 or not 0 < time_s - self._times_s[-1] <= _MAX_INTERVAL_S:
            return None
        return velocity_between(self._poses[0], self._poses[-1], self._times_s[-1] - self._times_s[0])

    def predict(self, time_s: float) -> np.ndarray | None:
        """(3,) x, y and yaw in `map` at a time; None when unknown."""
        if not self._poses or not 0 < time_s - self._times_s[-1] <= 10 * _MAX_INTERVAL_S:
            return None
        T, motion, ahead_s = self._poses[-1], self.motion_at(time_s), time_s - self._times_s[-1]
        yaw = rpy_of_transform(T)[2]
        if motion is None:
            return np.array([*T[:2, 3], yaw])
        velocity, turn = T[:3, :3] @ motion[0], T[:3, :3] @ motion[1]
        return np.array([*(T[:2, 3] + velocity[:2] * ahead_s), yaw + turn[2] * ahead_s])


def localize_drive(
    frames: Iterable[tuple[int, LidarFrame]], starts: Starts, localizer: Localizer, settings: DriveSettings = DriveSettings()
) -> Iterator[FrameLocation]:
    """A row per wanted frame, as they come.

    Args:
        frames: numbers and frames in the order of recording.
        starts: of all frames of the drive, by number.
        localizer: on the map.
        settings: see DriveSettings.
    """
    s, track = settings, _Track()
    wanted = range(s.first, len(starts.xy_m), s.every)
    wanted = set(wanted if s.n_frames is None else spread_frames(wanted, s.n_frames))
    for index, frame in frames:
        if index not in wanted:
            continue
        time_s = frame.time_ns / 1e9
        start = _start_of(index, time_s, starts, track, s)
        if start is None:
            location = Location("no_points" if len(frame) == 0 else "no_start")
            start = Start(np.full(2, np.nan))
        else:
            begun = time.perf_counter()
            points = _freed_of_motion(index, frame, time_s, starts, track, s)
            freed = time.perf_counter()
            location = localizer.locate(points, start)
            location.seconds[0] += freed - begun
        track.add(time_s, location)
        yield FrameLocation(index, time_s, start, location)


def spread_frames(numbers: Sequence[int], n: int) -> list[int]:
    """n of the numbers, evenly over them, first and last included; all of fewer."""
    return [numbers[i] for i in np.unique(np.linspace(0, len(numbers) - 1, n).astype(int))] if len(numbers) else []


def log_verdicts(rows: Sequence[FrameLocation]) -> None:
    """Say how many frames have which verdict."""
    counts = Counter(row.location.status for row in rows)
    logger.info("%d frames: %s", len(rows), ", ".join(f"{n} {status}" for status, n in counts.most_common()) or "none")


def _start_of(index: int, time_s: float, starts: Starts, track: _Track, s: DriveSettings) -> Start | None:
    predicted = track.predict(time_s) if s.mode == "tracking" else None
    if predicted is not None and track.n_lost < s.max_lost:
        # A frame that was not believed widens the window of the next: its motion was only guessed.
        w = s.tracking_window
        window = replace(w, turn_deg=w.turn_deg * (1 + track.n_lost), shift_m=w.shift_m * (1 + track.n_lost))
        return Start(predicted[:2], float(predicted[2]), window)
    xy, yaw = starts.xy_m[index], float(starts.yaw_rad[index])
    if not np.isfinite(xy).all():
        # Lost without GPS: the last pose is the best that is known, and its heading is not to be trusted for ever.
        return None if predicted is None else Start(predicted[:2], float("nan"))
    return Start(xy, float("nan"), s.wide_window) if s.mode == "none" else Start(xy, yaw)


def _freed_of_motion(index: int, frame: LidarFrame, time_s: float, starts: Starts, track: _Track, s: DriveSettings) -> np.ndarray:
    offsets = frame.time_offset_s
    if not s.is_deskewed or offsets is None or not offsets.any():
        return frame.points
    motion = track.motion_at(time_s)
    if motion is None:
        speed, rate = starts.speed_mps[index], np.nan_to_num(starts.turn_rate_radps[index])
        if not np.isfinite(speed):
            return frame.points
        motion = np.array([speed, 0, 0]), np.array([0, 0, rate])
    return deskew(frame.points, offsets, *motion)
