"""The chain of frame poses: every frame registered to the one before it, or to the street so far.

Source: Józsa & Benedek (2013), 6.2 and 8.2.1 (J-16, J-31, J-42): only points of tall structure are matched, the previous motion is the
prediction, no other sensor is used. The report registers consecutive frames (`target: previous`); registering to the
Gaussians of the street so far (`target: street`) is ours and drifts less.

A frame that cannot be registered keeps its row: its pose is NaN, the next frame is tried against the same target with the motion
carried on in time, and when that fails too often the chain breaks: a new segment starts, with its own origin, and says so.
"""

import hashlib
import logging
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from streetscan.errors import BadInput
from streetscan.geometry import invert, rotation_angle
from streetscan.io.arrays import load_npz, save_npz
from streetscan.registration.grid_classes import NAMES, TALL_STRUCTURE, classes_of_names
from streetscan.registration.ndt import Fit, NdtSettings
from streetscan.registration.targets import Target, make_target
from streetscan.sweeps import deskew

logger = logging.getLogger(__name__)

STATUSES = {
    "ok": "registered",
    "start": "first frame of a segment; its pose is the segment's origin",
    "empty": "no point with finite coordinates",
    "too_few_points": "too few points of the wanted classes (ground only, a tunnel's mouth)",
    "repeated": "point for point the frame before",
    "time_backwards": "its stamp is not later than the last one, or is not a number",
    "low_overlap": "too few points found a counterpart",
    "poor_fit": "the points lie beside the surfaces they should lie on",
    "not_converged": "the search did not come to rest",
    "implausible_motion": "farther or faster than a vehicle moves",
}
_POSED = ("ok", "start")


@dataclass(frozen=True)
class OdometrySettings:
    """How frames are chained.

    Attributes:
        method: `ndt`, `objects`, `gicp`, `vgicp`, or `kiss_icp`, which has its own ways of predicting, judging and keeping the street.
        target: `previous` (the report) or `street` (all frames within `max_range_m`).
        classes: grid classes that are matched; empty matches the raw frame. Short objects beside tall structure lower the errors
            (APE) of nine drives of the city's training and validation streets by 6 to 46 %, but a chain that starts in a convoy of cars
            then takes it for a standstill.
        ndt: settings of the NDT.
        thin_m: the source points are averaged in cubes of this edge, for coarser fields in larger ones. Chosen on the city's
            validation street with the same time per frame: 0.25 this way drifts 0.11 % there, 0.5 at every size 0.19 %.
        max_range_m: points farther away are not matched, and the street is forgotten beyond.
        min_points: fewer points are not registered.
        min_overlap: smallest share of points in a cube with a Gaussian.
        min_fit: smallest mean score of the points that have one. ASSUME: of 107 pairs of kitti_0001 and the city's validation street, 1 to
            10 frames apart and searched without a prediction, right fits on tall structure score 0.47 and more, wrong ones
            0.37 and less, one of 19 more than 0.32; on raw frames the two overlap.
        keyframe_m: the target changes only when the vehicle moved by this since, so a standing vehicle cannot drift.
        keyframe_rad: ... or turned by this.
        is_predicted: start the search where the previous motion leads (the report); without, where the last frame was.
        is_deskewed: undo the motion within the revolution, when the points have times.
        max_speed_mps: a faster motion is implausible.
        max_acceleration_mps2: a larger change of the predicted speed is implausible.
        max_turn_rate_radps: a faster turn is implausible.
        max_lost_frames: after so many failures in a row the chain breaks.
        start_speeds_mps: forward speeds tried when no motion is known yet.
        n_threads: threads of small_gicp; NDT takes numba's.
    """

    method: str = "ndt"
    target: str = "street"
    classes: tuple[int, ...] = (TALL_STRUCTURE,)
    ndt: NdtSettings = field(default_factory=NdtSettings)
    thin_m: float = 0.25
    max_range_m: float = 100.0
    min_points: int = 200
    min_overlap: float = 0.25
    min_fit: float = 0.32
    keyframe_m: float = 0.05
    keyframe_rad: float = 0.005
    is_predicted: bool = True
    is_deskewed: bool = True
    max_speed_mps: float = 60.0
    max_acceleration_mps2: float = 15.0
    max_turn_rate_radps: float = 2.0
    max_lost_frames: int = 10
    start_speeds_mps: tuple[float, ...] = (0.0, 5.0, 10.0, 15.0, 20.0)
    n_threads: int = 2

    def __post_init__(self):
        if self.target not in ("previous", "street"):
            raise BadInput("register_frames.target", f"'{self.target}'", "choose previous or street")
        if any(c not in range(len(NAMES)) for c in self.classes):
            raise BadInput("register_frames.classes", f"{self.classes}", f"choose among {', '.join(NAMES)}")


def make_settings(values: Mapping[str, Any]) -> OdometrySettings:
    """Settings from plain values: `classes` are names, `ndt` holds the keys of NdtSettings. BadInput for an unknown key."""
    values = dict(values)
    if "classes" in values:
        values["classes"] = classes_of_names(values["classes"], "register_frames.classes")
    if "start_speeds_mps" in values:
        values["start_speeds_mps"] = tuple(float(v) for v in values["start_speeds_mps"])
    try:
        return OdometrySettings(**values | {"ndt": NdtSettings(**values.get("ndt", {}))})
    except TypeError as error:
        raise BadInput("register_frames", f"{error}", "correct the key in the config") from error


@dataclass
class FramePose:
    """One row of the chain.

    Attributes:
        index: number of the frame in the drive.
        time_s: its stamp.
        status: a key of STATUSES.
        segment: counts the breaks of the chain; poses of different segments have different origins.
        T_segment_lidar: (4, 4) pose in the frame of the segment's first frame; NaN unless the status is ok or start.
        velocity_mps, turn_rate_radps: (3,) motion since the last posed frame, frame `lidar` of that one; NaN when unknown.
        n_points: points of the wanted classes.
        overlap, score, n_iterations: of the fit; NaN and 0 without one.
        covariance: (6, 6) x, y, z (m), rotation vector (rad) in the segment's axes; NaN without a fit.
    """

    index: int
    time_s: float
    status: str
    segment: int
    T_segment_lidar: np.ndarray = field(default_factory=lambda: np.full((4, 4), np.nan))
    velocity_mps: np.ndarray = field(default_factory=lambda: np.full(3, np.nan))
    turn_rate_radps: np.ndarray = field(default_factory=lambda: np.full(3, np.nan))
    n_points: int = 0
    overlap: float = np.nan
    score: float = np.nan
    n_iterations: int = 0
    covariance: np.ndarray = field(default_factory=lambda: np.full((6, 6), np.nan))

    @property
    def is_posed(self) -> bool:
        return self.status in _POSED


@dataclass
class Frame:
    """What the chain needs of a frame.

    Attributes:
        index: number in the drive.
        time_s: stamp.
        points: (N, 3) float32 or float64, metres, frame `lidar`; NaN rows are left out.
        labels: (N,) uint8 grid classes; not needed when raw frames are matched.
        time_offset_s: (N,) firing minus stamp, or None.
    """

    index: int
    time_s: float
    points: np.ndarray
    labels: np.ndarray | None = None
    time_offset_s: np.ndarray | None = None


class Odometry:
    """Registers the frames of a drive one after the other."""

    def __init__(self, settings: OdometrySettings = OdometrySettings()):
        self._settings = settings
        self._target: Target = make_target(settings.method, settings.ndt, settings.thin_m, n_threads=settings.n_threads)
        self._segment = -1
        self._last_points: np.ndarray | None = None
        self._last_stamp_s = -np.inf
        self._reset()

    def _reset(self) -> None:
        """Forget the street and the motion; the next frame starts a segment."""
        self._target.clear()
        self._T_last, self._time_last_s = np.eye(4), np.nan
        # The frame the target holds (`previous`) or the frame that last went into it (`street`).
        self._T_key = np.eye(4)
        self._twist = None
        self._n_lost = 0
        self._start: tuple[np.ndarray, np.ndarray | None] | None = None

    @property
    def has_begun(self) -> bool:
        return self._segment >= 0 or np.isfinite(self._last_stamp_s)

    def add(self, frame: Frame) -> FramePose:
        """The pose of the next frame; see STATUSES for what can go wrong."""
        pose = FramePose(frame.index, float(frame.time_s), "ok", max(self._segment, 0))
        status, points, offsets = self._check(frame)
        pose.n_points = len(points)
        if status == "ok":
            if self._target.is_empty:
                self._begin(pose, points, offsets)
                return pose
            status = self._register(pose, points, offsets)
        pose.status = status
        if status == "ok":
            return pose
        # A record repeated says nothing, nor does one before there is a street; but a clock that was set back stays so.
        is_behind = status == "time_backwards"
        if status != "repeated" and (is_behind or not self._target.is_empty):
            self._n_lost += 1
            if self._n_lost >= self._settings.max_lost_frames:
                self._reset()
                if is_behind and np.isfinite(frame.time_s):
                    self._last_stamp_s = frame.time_s
                if pose.n_points >= self._settings.min_points:
                    self._begin(pose, points, offsets)
        return pose

    def _check(self, frame: Frame) -> tuple[str, np.ndarray, np.ndarray | None]:
        s = self._settings
        points, offsets = np.asarray(frame.points), frame.time_offset_s
        nothing = np.empty((0, 3))
        if not frame.time_s > self._last_stamp_s:
            return "time_backwards", nothing, None
        self._last_stamp_s = frame.time_s
        is_repeated = self._last_points is not None and len(points) > 0 and np.array_equal(points, self._last_points)
        self._last_points = points
        if is_repeated:
            return "repeated", nothing, None
        wanted = select_points(points, frame.labels, s.classes, s.max_range_m)
        if len(wanted) == 0 and not np.isfinite(points).all(axis=1).any():
            return "empty", nothing, None
        points = points[wanted].astype(np.float64)
        offsets = offsets[wanted] if offsets is not None and s.is_deskewed else None
        return ("ok" if len(points) >= s.min_points else "too_few_points"), points, offsets

    def _begin(self, pose: FramePose, points: np.ndarray, offsets: np.ndarray | None) -> None:
        self._segment += 1
        pose.status, pose.segment, pose.T_segment_lidar = "start", self._segment, np.eye(4)
        self._T_last, self._T_key, self._time_last_s = np.eye(4), np.eye(4), pose.time_s
        self._n_lost = 0
        self._target.add(points, np.eye(4))
        self._start = (points, offsets)

    def _register(self, pose: FramePose, raw: np.ndarray, offsets: np.ndarray | None) -> str:
        duration_s = pose.time_s - self._time_last_s
        points = self._deskew(raw, offsets)
        fit = self._search(points, duration_s)
        status = self._judge(fit, duration_s)
        if status == "ok" and self._start is not None:
            # Only now is the motion known that the first two frames must be freed from.
            self._take_motion(fit.T_target_source, duration_s)
            start_points, start_offsets = self._start
            self._start = None
            if start_offsets is not None:
                self._target.clear()
                self._target.add(self._deskew(start_points, start_offsets), np.eye(4))
                points = self._deskew(raw, offsets)
                fit = self._search(points, duration_s)
                status = self._judge(fit, duration_s)
        pose.overlap, pose.score, pose.n_iterations = fit.overlap, fit.score, fit.n_iterations
        if status != "ok":
            return status
        T = self._T_target @ fit.T_target_source
        pose.T_segment_lidar = T
        self._take_motion(fit.T_target_source, duration_s)
        pose.velocity_mps, pose.turn_rate_radps = self._twist[:3], self._twist[3:]
        pose.covariance = _covariance_of(fit.hessian)
        self._T_last, self._time_last_s, self._n_lost = T, pose.time_s, 0
        self._move_target(T, points)
        return "ok"

    @property
    def _T_target(self) -> np.ndarray:
        """Pose of the target's frame in the segment."""
        return self._T_key if self._settings.target == "previous" else np.eye(4)

    def _take_motion(self, T_target_lidar: np.ndarray, duration_s: float) -> None:
        self._twist = twist_of(invert(self._T_last) @ self._T_target @ T_target_lidar) / duration_s

    def _deskew(self, points: np.ndarray, offsets: np.ndarray | None) -> np.ndarray:
        if offsets is None or self._twist is None:
            return points
        return deskew(points, offsets, self._twist[:3], self._twist[3:])

    def _search(self, points: np.ndarray, duration_s: float) -> Fit:
        if not self._settings.is_predicted:
            predictions = [np.eye(4)]
        elif self._twist is not None:
            predictions = [motion_of(self._twist * duration_s)]
        else:
            predictions = [motion_of(np.array([v * duration_s, 0, 0, 0, 0, 0])) for v in self._settings.start_speeds_mps]
        T_target_last = invert(self._T_target) @ self._T_last
        fits = [self._target.fit(points, T_target_last @ motion) for motion in predictions]
        return max(fits, key=lambda f: f.score)

    def _judge(self, fit: Fit, duration_s: float) -> str:
        s = self._settings
        T_last_lidar = invert(self._T_last) @ self._T_target @ fit.T_target_source
        return judge_fit(fit, T_last_lidar, self._twist, duration_s, s)

    def _move_target(self, T: np.ndarray, points: np.ndarray) -> None:
        s = self._settings
        motion = invert(self._T_key) @ T
        if np.linalg.norm(motion[:3, 3]) < s.keyframe_m and rotation_angle(motion) < s.keyframe_rad:
            return
        self._T_key = T
        if s.target == "previous":
            self._target.clear()
            self._target.add(points, np.eye(4))
        else:
            self._target.add(points, T)
            self._target.drop_beyond(T[:3, 3], s.max_range_m)

    def state(self) -> dict[str, np.ndarray]:
        """Arrays from which `restore` continues exactly here."""
        start, offsets = self._start or (None, None)
        own = {
            "segment": np.array(self._segment),
            "last_stamp_s": np.array(self._last_stamp_s),
            "time_last_s": np.array(self._time_last_s),
            "n_lost": np.array(self._n_lost),
            "T_last": self._T_last,
            "T_key": self._T_key,
            "twist": self._twist,
            "last_points": self._last_points,
            "start": start,
            "start_offsets": offsets,
            "is_empty": np.array(self._target.is_empty),
        }
        return {k: v for k, v in own.items() if v is not None} | {f"target_{k}": v for k, v in self._target.state().items()}

    def restore(self, state: dict[str, np.ndarray]) -> None:
        """See `state`; the settings must be the same."""
        self._segment, self._n_lost = int(state["segment"]), int(state["n_lost"])
        self._last_stamp_s, self._time_last_s = float(state["last_stamp_s"]), float(state["time_last_s"])
        self._T_last, self._T_key = state["T_last"], state["T_key"]
        self._twist, self._last_points = state.get("twist"), state.get("last_points")
        self._start = (state["start"], state.get("start_offsets")) if "start" in state else None
        self._target.clear()
        if not bool(state["is_empty"]):
            self._target.restore({k.removeprefix("target_"): v for k, v in state.items() if k.startswith("target_")})


def make_odometry(settings: OdometrySettings):
    """What registers frames as the settings say: `add` a frame, and `state` and `restore` to go on later."""
    if settings.method == "kiss_icp":
        from streetscan.registration.kiss import KissOdometry

        return KissOdometry(settings)
    return Odometry(settings)


def register_frames(frames: Iterable[Frame], settings: OdometrySettings = OdometrySettings()) -> Iterator[FramePose]:
    """The poses of the frames of a drive, one row each, as they come.

    Args:
        frames: in the order of recording.
        settings: see OdometrySettings.
    Yields:
        a row per frame.
    Raises:
        BadInput: classes are wanted and a frame has no labels.
    """
    odometry = make_odometry(settings)
    for frame in frames:
        yield odometry.add(frame)


def register_drive(
    read_frames: Callable[[int, int], Iterator[Frame]],
    n_frames: int,
    work_folder: str | Path,
    settings: OdometrySettings = OdometrySettings(),
    group_frames: int = 100,
    first_frame: int = 0,
) -> tuple[list[FramePose], np.ndarray]:
    """The poses of a whole drive; a run that was stopped continues after its last finished group, to the same poses.

    Args:
        read_frames: the frames with numbers in [first, last), in order; called once per group that is not finished.
        n_frames: of the drive.
        work_folder: keeps finished groups and the state after the last one; the caller names it by what is read, and deletes it when
            the result is safe.
        settings: see OdometrySettings.
        group_frames: frames of a group.
        first_frame: frames before it are not read.
    Returns:
        a row per frame, and the seconds (n_frames,) each took, reading left out.
    """
    work_folder = Path(work_folder) / hashlib.sha256(repr((settings, group_frames, first_frame, n_frames)).encode()).hexdigest()[:16]
    _load_compiled_code(settings)
    odometry = make_odometry(settings)
    poses, durations = [], []
    previous = None
    for first in range(first_frame, n_frames, group_frames):
        path = work_folder / f"{first:06d}.npz"
        if path.exists():
            rows, seconds = _load_rows(path)
        else:
            if previous is not None and not odometry.has_begun:
                odometry.restore(dict(np.load(_state_path(previous))))
            rows, seconds = [], []
            for frame in read_frames(first, min(first + group_frames, n_frames)):
                start_s = time.perf_counter()
                rows.append(odometry.add(frame))
                seconds.append(time.perf_counter() - start_s)
            # The rows mark the group as finished, so the state comes first.
            save_npz(_state_path(path), **odometry.state())
            _save_rows(path, rows, seconds)
            if previous is not None:
                _state_path(previous).unlink(missing_ok=True)
        previous = path
        poses, durations = poses + rows, durations + seconds
    return poses, np.array(durations)


def _load_compiled_code(settings: OdometrySettings) -> None:
    """Register two frames of one wall, so that the first frames of a drive are timed like the others."""
    wall = np.stack(np.meshgrid([5.0], np.linspace(-5, 5, 50), np.linspace(-1, 3, 20)), axis=-1).reshape(-1, 3)
    odometry = make_odometry(settings)
    for i in range(2):
        labels = np.full(len(wall), settings.classes[0] if settings.classes else 0, np.uint8)
        odometry.add(Frame(i, float(i), wall + 0.01 * i, labels))


def _state_path(path: Path) -> Path:
    return path.with_suffix(".state.npz")


_ROW_ARRAYS = ("T_segment_lidar", "velocity_mps", "turn_rate_radps", "covariance")
_ROW_NUMBERS = ("index", "time_s", "segment", "n_points", "overlap", "score", "n_iterations")


def _save_rows(path: Path, rows: list[FramePose], seconds: list[float]) -> None:
    arrays = {name: np.array([getattr(r, name) for r in rows]) for name in (*_ROW_ARRAYS, *_ROW_NUMBERS)}
    save_npz(path, status=np.array([r.status for r in rows]), seconds=np.array(seconds), **arrays)


def _load_rows(path: Path) -> tuple[list[FramePose], list[float]]:
    names = ("status", "seconds", *_ROW_ARRAYS, *_ROW_NUMBERS)
    arrays = dict(zip(names, load_npz(path, names, "register_frames"), strict=True))
    rows = []
    for i, status in enumerate(arrays["status"]):
        numbers = {name: arrays[name][i].item() for name in _ROW_NUMBERS}
        rows.append(FramePose(status=str(status), **numbers, **{name: arrays[name][i] for name in _ROW_ARRAYS}))
    return rows, arrays["seconds"].tolist()


def log_chain(poses: Iterable[FramePose]) -> None:
    """Say how many frames have which status, and where the chain broke."""
    poses = list(poses)
    counts = Counter(p.status for p in poses)
    logger.info("%d frames: %s", len(poses), ", ".join(f"{n} {status}" for status, n in counts.most_common()))
    for pose in poses:
        if pose.status == "start" and pose.segment > 0:
            logger.warning("the chain broke before frame %d: segment %d starts there with its own origin", pose.index, pose.segment)


def register_pair(
    target: Frame, source: Frame, T_target_source: np.ndarray | None = None, settings: OdometrySettings = OdometrySettings()
) -> FramePose:
    """Two frames, without a chain.

    Args:
        target, source: the frames; points as they are (not de-skewed).
        T_target_source: (4, 4) prediction; when None the source frame is searched from where the target is.
        settings: see OdometrySettings; `target`, key frames and de-skewing play no role.
    Returns:
        the source's row: `T_segment_lidar` is T_target_source.
    """
    s = settings
    pose = FramePose(source.index, float(source.time_s), "ok", 0)
    duration_s = source.time_s - target.time_s
    if not duration_s > 0:
        pose.status = "time_backwards"
        return pose
    clouds = []
    for frame in (target, source):
        wanted = select_points(frame.points, frame.labels, s.classes, s.max_range_m)
        clouds.append(np.asarray(frame.points)[wanted].astype(np.float64))
        if not np.isfinite(np.asarray(frame.points)).all(axis=1).any():
            pose.status = "empty"
            return pose
        if len(wanted) < s.min_points:
            pose.status = "too_few_points"
            return pose
    pose.n_points = len(clouds[1])
    field_ = make_target(s.method, s.ndt, s.thin_m, n_threads=s.n_threads)
    field_.add(clouds[0], np.eye(4))
    prediction = np.eye(4) if T_target_source is None else np.asarray(T_target_source, np.float64)
    fit = field_.fit(clouds[1], prediction)
    twist = None if T_target_source is None else twist_of(prediction) / duration_s
    pose.status = judge_fit(fit, fit.T_target_source, twist, duration_s, s)
    pose.overlap, pose.score, pose.n_iterations = fit.overlap, fit.score, fit.n_iterations
    if pose.status == "ok":
        pose.T_segment_lidar, pose.covariance = fit.T_target_source, _covariance_of(fit.hessian)
    return pose


def select_points(points: np.ndarray, labels: np.ndarray | None, classes: tuple[int, ...], max_range_m: float) -> np.ndarray:
    """Rows (M,) int64 of the finite points within a range that belong to the wanted classes; no class means every point.

    Raises:
        BadInput: classes are wanted, and labels are missing or of another length.
    """
    points = np.asarray(points)
    if not classes:
        rows = np.arange(len(points))
    else:
        if labels is None or len(labels) != len(points):
            found = "no grid classes" if labels is None else f"{len(labels)} grid classes for {len(points)} points"
            raise BadInput("the frame", found, "run segment_frames on this drive again")
        is_wanted = np.zeros(256, np.bool_)
        is_wanted[list(classes)] = True
        rows = np.flatnonzero(is_wanted[labels])
    x, y, z = points[rows].T
    # Comparisons with NaN are false, infinity is out of range.
    return rows[(x * x + y * y <= max_range_m**2) & (np.abs(z) <= max_range_m)]


def judge_fit(fit: Fit, T_last_lidar: np.ndarray, twist: np.ndarray | None, duration_s: float, settings: OdometrySettings) -> str:
    """Status of a fit: was there enough to hold on to, does it lie well, and can a vehicle have moved so?

    Args:
        fit: what the search found.
        T_last_lidar: (4, 4) motion since the last pose.
        twist: (6,) motion before it per second, or None when unknown.
        duration_s: time since the last pose.
        settings: the limits.
    """
    s = settings
    if not np.isfinite(T_last_lidar).all():
        return "not_converged"
    if fit.overlap < s.min_overlap:
        return "low_overlap"
    if s.method == "ndt" and fit.score < s.min_fit * fit.overlap:
        return "poor_fit"
    if not fit.is_converged:
        return "not_converged"
    moved = twist_of(T_last_lidar) / duration_s
    if np.linalg.norm(moved[:3]) > s.max_speed_mps or np.linalg.norm(moved[3:]) > s.max_turn_rate_radps:
        return "implausible_motion"
    # ASSUME: 0.1 m on top of what the acceleration allows, for the noise of two poses.
    if twist is not None and np.linalg.norm(moved[:3] - twist[:3]) * duration_s > 0.1 + s.max_acceleration_mps2 * duration_s**2:
        return "implausible_motion"
    return "ok"


def twist_of(T: np.ndarray) -> np.ndarray:
    """Translation and rotation vector (6,) of a transform (4, 4)."""
    return np.concatenate([T[:3, 3], Rotation.from_matrix(T[:3, :3]).as_rotvec()])


def motion_of(twist: np.ndarray) -> np.ndarray:
    """The transform (4, 4) of a translation and a rotation vector (6,): the inverse of `twist_of`."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_rotvec(twist[3:]).as_matrix(), twist[:3]
    return T


def _covariance_of(hessian: np.ndarray) -> np.ndarray:
    """The inverse of the Hessian; directions the points do not fix get a variance of 1e6 (nothing known)."""
    scale = np.sqrt(np.maximum(np.diag(hessian), 1e-9))
    values, vectors = np.linalg.eigh(hessian / np.outer(scale, scale))
    inverse = (vectors / np.maximum(values, 1e-6)) @ vectors.T
    return inverse / np.outer(scale, scale)
