"""One calibration of a drive from its accepted keyframes, with how far to trust it, and which calibration is in force when.

Beyond the thesis, which keeps the last keyframe's (N-233). A keyframe gives the lidar at its stamp in the camera at the image's stamp; when
the stamps' clocks differ, the vehicle moved in between by that much more. Keyframes of different speeds or turns tell the offset; where all
are alike it cannot be told from a shift of the camera along the road, stays at zero, and its deviation says so.

ASSUME: the offset is a constant below 50 ms; before anything is known, 5 ms either way are likely.
ASSUME: what is wrong with a keyframe is what its clouds leave open, and errors of structure from motion that are alike in all directions
(`keyframe_m`, `keyframe_deg`). These are small: what the clouds leave open is alone 1.3 times the errors of twelve right keyframes on
training and validation streets. Few keyframes do not tell their own scatter: it is mixed with
that expectation, which counts as `n_known` keyframes.

Image edges seldom tell one keyframe surely that the way of its camera is wrong; where the lens or the images' timing makes all of a drive
wrong alike, the keyframes together do, and all are corrected by what they tell (`pool_bends`).
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import pandas as pd
from scipy.spatial.transform import Rotation

from streetscan.calibration.edges import UNTOLD, Bend
from streetscan.calibration.keyframe_calibration import evidence_distance
from streetscan.calibration.motion import LidarMotion
from streetscan.geometry import invert, moved_by, steps_between, transform_of_rotation


@dataclass(frozen=True)
class DriveCalibrationSettings:
    """How keyframes are combined.

    Attributes:
        offset_std_s: expected size of the time offset. Where keyframes of different speeds or turns tell a larger one by more than twice
            its deviation, that size is expected instead; where all are alike they cannot.
        keyframe_m, keyframe_deg: deviation of one keyframe along and about each axis, beside what its clouds leave open.
        n_known: keyframes they count as.
        n_bootstrap: samples of keyframes drawn for the bootstrap.
        max_deviation: a keyframe that is off by more deviations, on the mean of its six, is wrong, or the mounting has moved. ASSUME: 1.8;
            four in a thousand are as far off by chance, if errors are normal (chi-squared of six).
        sure_bend: deviations by which a common error of the ways of the camera must differ from none to be corrected. ASSUME: 3.
        min_gain: share by which a keyframe must lie nearer than the calibration in force to replace it.
    """

    offset_std_s: float = 0.005
    keyframe_m: float = 0.02
    keyframe_deg: float = 0.03
    n_known: float = 3.0
    n_bootstrap: int = 200
    max_deviation: float = 1.8
    sure_bend: float = 3.0
    min_gain: float = 0.02


@dataclass
class KeyframeResult:
    """What a keyframe brings in.

    Attributes:
        index, status: its number, and `ok` when it was accepted.
        T_camera_stamp: (4, 4) of its calibration, or None.
        motion: of the lidar, or None.
        evidence: (P, 9) of its calibration.
        covariance: (6, 6) of T_camera_stamp as far as its clouds and way tell: a turn and a shift in the camera's axes.
        bend: error of the way of the camera that image edges tell, and its deviation, infinite where they tell none.
        bend_made_rad: how much of it T_camera_stamp is corrected by.
        bend_response: (6,) turn and shift of T_camera_stamp in the camera's axes for each radian of such an error.
        reason: what was found, where it was refused.
    """

    index: int
    status: str
    T_camera_stamp: np.ndarray | None
    motion: LidarMotion | None
    evidence: np.ndarray
    covariance: np.ndarray = field(default_factory=lambda: np.zeros((6, 6)))
    bend: Bend = UNTOLD
    bend_made_rad: float = 0.0
    bend_response: np.ndarray = field(default_factory=lambda: np.zeros(6))
    reason: str = ""

    def T_camera_lidar(self, time_offset_s: float = 0.0) -> np.ndarray:
        """(4, 4) of the sensors as mounted, for a time offset of the images' stamps."""
        return self.T_camera_stamp if self.motion is None else self.motion.to_image(self.T_camera_stamp, time_offset_s)

    def as_stamped(self, T_camera_lidar: np.ndarray, time_offset_s: float = 0.0) -> np.ndarray:
        """The inverse: T_camera_stamp (4, 4) that a mounting would give at this keyframe."""
        if self.motion is None:
            return T_camera_lidar
        return T_camera_lidar @ invert(self.motion.at([self.motion.image_s - time_offset_s])[0])


@dataclass
class DriveCalibration:
    """The calibration of a drive.

    Attributes:
        status: `ok`; when no keyframe was accepted `kept`, if a calibration was in force before, or else `no_keyframes`.
        T_camera_lidar: (4, 4) rigid, of the sensors on the vehicle: what was found, or kept; else NaN.
        time_offset_s: what the images' stamps are ahead of the lidar's clock.
        covariance: (7, 7) of x, y, z of T_camera_lidar (m), a rotation vector about the lidar's axes (rad) and the offset (s).
        weights: (K,) of the accepted keyframes, 0 to 1.
        used: (K,) their numbers.
        bend: the error that the ways of their cameras have in common, and its deviation.
        is_straightened: whether the keyframes were corrected by it.
    """

    status: str
    T_camera_lidar: np.ndarray = field(default_factory=lambda: np.full((4, 4), np.nan))
    time_offset_s: float = np.nan
    covariance: np.ndarray = field(default_factory=lambda: np.full((7, 7), np.nan))
    weights: np.ndarray = field(default_factory=lambda: np.empty(0))
    used: np.ndarray = field(default_factory=lambda: np.empty(0, np.int64))
    bend: Bend = UNTOLD
    is_straightened: bool = False


def combine_keyframes(
    keyframes: Sequence[KeyframeResult], settings: DriveCalibrationSettings = DriveCalibrationSettings(), seed: int = 0,
    T_in_force: np.ndarray | None = None,
) -> DriveCalibration:  # fmt: skip
    """The calibration that accepted keyframes agree on; one that disagrees loses its weight.

    Args:
        keyframes: of one mounting.
        settings: see DriveCalibrationSettings.
        seed: of the bootstrap.
        T_in_force: (4, 4) T_camera_lidar before the drive, which stays where no keyframe is accepted (N-233); None where there is none.
    """
    accepted = [k for k in keyframes if k.status == "ok"]
    if not accepted:
        return DriveCalibration("no_keyframes") if T_in_force is None else DriveCalibration("kept", T_in_force)
    bend = pool_bends(accepted)
    is_straightened = abs(bend.rad) > settings.sure_bend * bend.std_rad
    if is_straightened:
        accepted = [_straightened(k, bend.rad) for k in accepted]
    inputs = _inputs(accepted, settings)
    fitted = _fit(*inputs, settings)
    covariance = fitted.covariance
    if len(accepted) > 2:
        rng = np.random.default_rng(seed)
        drawn = [rng.integers(0, len(accepted), len(accepted)) for _ in range(settings.n_bootstrap)]
        samples = np.array([_difference(_fit(*(values[rows] for values in inputs), settings), fitted) for rows in drawn])
        # The larger of both: spread knows nothing of outliers' leverage, the bootstrap nothing of what few keyframes did not meet.
        bootstrap = np.cov(samples.T)
        larger = np.sqrt(np.maximum(np.diag(bootstrap) / np.diag(covariance), 1.0))
        covariance = covariance * np.outer(larger, larger)
    numbers = np.array([k.index for k in accepted])
    return DriveCalibration("ok", fitted.T, fitted.offset_s, covariance, fitted.weights, numbers, bend, is_straightened)


def pool_bends(keyframes: Sequence[KeyframeResult]) -> Bend:
    """The error that the ways of the cameras of keyframes have in common, as their image edges tell it together.

    Its deviation is infinite unless at least two tell one: a keyframe alone has decided for itself.
    """
    telling = [k.bend for k in keyframes if np.isfinite(k.bend.std_rad)]
    if len(telling) < 2:
        return UNTOLD
    values, weights = np.array([b.rad for b in telling]), np.array([b.std_rad for b in telling]) ** -2.0
    mean = weights @ values / weights.sum()
    # Keyframes that differ by more than they say are less sure than they say.
    scatter = max(1.0, weights @ (values - mean) ** 2 / (len(values) - 1))
    return Bend(float(mean), float(np.sqrt(scatter / weights.sum())))


def _straightened(keyframe: KeyframeResult, bend_rad: float) -> KeyframeResult:
    """A keyframe corrected by an error of the way of its camera, instead of by its own."""
    more = bend_rad - keyframe.bend_made_rad
    return replace(keyframe, T_camera_stamp=moved_by(keyframe.T_camera_stamp, keyframe.bend_response * more), bend_made_rad=bend_rad)


def _inputs(accepted: Sequence[KeyframeResult], s: DriveCalibrationSettings) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Poses (K, 4, 4), by how much each keyframe's camera turns and moves for a second of offset (K, 6), covariances (K, 6, 6); all in the
    camera's axes."""
    poses = np.array([k.T_camera_lidar() for k in accepted])
    twists = np.array([np.zeros(6) if k.motion is None else k.motion.twist_at_image() for k in accepted])
    turns, shifts = (np.einsum("kij,kj->ki", poses[:, :3, :3], t) for t in (twists[:, :3], twists[:, 3:]))
    # The vehicle turns about the lidar, a turn of `steps_between` about the camera.
    ways = np.concatenate([turns, shifts + np.cross(poses[:, :3, 3], turns)], axis=1)
    common = np.diag([np.radians(s.keyframe_deg) ** 2] * 3 + [s.keyframe_m**2] * 3)
    return poses, ways, np.array([k.covariance for k in accepted]) + common


def keyframes_in_force(
    keyframes: Sequence[KeyframeResult], settings: DriveCalibrationSettings = DriveCalibrationSettings()
) -> tuple[list[KeyframeResult], np.ndarray]:
    """The accepted keyframes of the mounting that holds at the end, and (K,) by how many deviations each was off the mounting before it.

    A keyframe that is too far off is set aside; when the next accepted one is off too and agrees with it, the mounting has moved, and the
    two begin a new one. Otherwise it was a wrong keyframe.
    """
    steps = list(_follow_mounting(keyframes, settings))
    return steps[-1][0] if steps else [], np.array([deviation for _, deviation in steps])


def _follow_mounting(keyframes: Sequence[KeyframeResult], s: DriveCalibrationSettings) -> Iterator[tuple[list[KeyframeResult], float]]:
    """After each keyframe those of the mounting that then holds, and by how many deviations the keyframe was off the mounting before."""
    held: list[KeyframeResult] = []
    aside: list[KeyframeResult] = []
    for k in keyframes:
        deviation = np.nan
        if k.status == "ok":
            deviation = _deviation(k, held, s) if held else np.nan
            if not held or deviation <= s.max_deviation:
                held, aside = [*held, k], []
            elif aside and _deviation(k, aside, s) <= s.max_deviation:
                held, aside = [*aside, k], []
            else:
                aside = [k]
        yield held, deviation


def _deviation(keyframe: KeyframeResult, held: Sequence[KeyframeResult], s: DriveCalibrationSettings) -> float:
    """By how many deviations, on the mean of its six, a keyframe is off what others agree on."""
    poses, ways, covariances = _inputs([*held, keyframe], s)
    fitted = _fit(poses[:-1], ways[:-1], covariances[:-1], s)
    error = steps_between(fitted.T, poses[-1:])[0] - ways[-1] * fitted.offset_s
    back = np.linalg.inv(_to_lidar(fitted.T))
    own = covariances[-1] + (back @ fitted.covariance @ back.T)[:6, :6]
    return float(np.sqrt(error @ np.linalg.solve(own, error) / 6))


@dataclass
class _Fit:
    T: np.ndarray
    offset_s: float
    covariance: np.ndarray
    weights: np.ndarray


def _fit(poses: np.ndarray, ways: np.ndarray, covariances: np.ndarray, s: DriveCalibrationSettings) -> _Fit:
    """Weighted mean of poses (K, 4, 4) and a common offset along their ways (K, 6); Tukey's weights, from the median on.

    The offset is expected to be as large as it is found, if that is more than `offset_std_s`: it then grows to what the poses tell where
    they tell it by more than twice its deviation, and stays small elsewhere.

    `covariances` (K, 6, 6) are of a turn and a shift in the camera's axes: a keyframe counts in the directions it knows.
    """
    n, weights, offset = len(poses), np.ones(len(poses)), 0.0
    T = transform_of_rotation(Rotation.from_matrix(poses[:, :3, :3]).mean().as_matrix(), np.median(poses[:, :3, 3], axis=0))
    information = np.linalg.inv(covariances)
    # How turn, shift and offset show in a keyframe's turn and shift.
    A = np.tile(np.eye(6, 7), (n, 1, 1))
    A[:, :, 6] = ways
    for _ in range(30):
        errors = steps_between(T, poses) - A[:, :, 6] * offset
        spread = np.sqrt(_squares(errors, information))
        # A keyframe never loses all its weight: two that disagree would leave none.
        weights = np.maximum(np.clip(1 - (spread / (4.0 * max(1.0, float(np.median(spread))))) ** 2, 0, None) ** 2, 1e-3)
        AW = A.transpose(0, 2, 1) @ (information * weights[:, None, None])
        H, b = (AW @ A).sum(axis=0), (AW @ errors[:, :, None]).sum(axis=0)[:, 0]
        prior = np.diag([0] * 6 + [1 / max(s.offset_std_s, abs(offset)) ** 2])
        H += prior
        b -= prior[6] * offset
        step = np.linalg.solve(H, b)
        T, offset = moved_by(T, step[:6]), offset + float(step[6])
        if np.abs(step).max() < 1e-7:
            break
    errors = steps_between(T, poses) - A[:, :, 6] * offset
    squares = weights @ _squares(errors, information)
    # The offset's own deviation is no scatter of the keyframes.
    scatter = (s.n_known + squares) / (s.n_known + weights.sum())
    inverse = np.linalg.inv((H - prior) / scatter + prior)
    change = _to_lidar(T)
    return _Fit(T, offset, change @ inverse @ change.T, weights)


def _to_lidar(T: np.ndarray) -> np.ndarray:
    """(7, 7) from turn and shift in the camera's axes and offset to x, y, z of T, a turn about the lidar's axes and offset."""
    change = np.zeros((7, 7))
    change[:3, :3], change[:3, 3:6] = -_cross(T[:3, 3]), np.eye(3)
    change[3:6, :3] = T[:3, :3].T
    change[6, 6] = 1.0
    return change


def _squares(errors: np.ndarray, information: np.ndarray) -> np.ndarray:
    """(K,) mean squares of errors (K, 6) in their deviations."""
    return (errors[:, None] @ information @ errors[:, :, None])[:, 0, 0] / 6


def _cross(v: np.ndarray) -> np.ndarray:
    """The matrix (3, 3) that multiplies by v from the left: _cross(v) @ w = v x w."""
    return np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])


def _difference(a: _Fit, b: _Fit) -> np.ndarray:
    """(7,) shift, turn and offset from one fit to another."""
    turn = Rotation.from_matrix(b.T[:3, :3].T @ a.T[:3, :3]).as_rotvec()
    return np.array([*(a.T[:3, 3] - b.T[:3, 3]), *turn, a.offset_s - b.offset_s])


def follow_drive(keyframes: Sequence[KeyframeResult], settings: DriveCalibrationSettings = DriveCalibrationSettings()) -> pd.DataFrame:
    """Which calibration is in force after each keyframe, as in a drive that goes on (N-213, N-233).

    Within one mounting a keyframe replaces the one in force when it fits the evidence of both better, for each has chosen its own; when the
    mounting has moved, the newest of the new one does.

    Columns: `keyframe`, `status`, `reason` (why it was refused); `distance_before_m` and `distance_m` of both keyframes' evidence under the
    calibration in force and under the keyframe's own; `deviation` from the mounting that held so far (see `keyframes_in_force`);
    `is_shifted`, whether it is too large, so that the mounting must have moved or the keyframe is wrong; `action` (`kept`, `replaced`,
    `none`); `in_force`, the keyframe whose calibration is in force afterwards, or -1.
    """
    s, rows, in_force = settings, [], None
    for k, (held, deviation) in zip(keyframes, _follow_mounting(keyframes, s), strict=True):
        before = after = np.nan
        action = "none" if in_force is None else "kept"
        if k.status == "ok":
            both = [k] if in_force is None else [k, in_force]
            after = _distance_on(both, k)
            if in_force is not None:
                before = _distance_on(both, in_force)
            has_moved = in_force is None or not any(h is in_force for h in held)
            if any(h is k for h in held) and (has_moved or after < (1 - s.min_gain) * before):
                action, in_force = "replaced", k
        is_shifted = bool(deviation > s.max_deviation)
        outcome = before, after, deviation, is_shifted, action, -1 if in_force is None else in_force.index
        rows.append((f"{k.index:02d}", k.status, k.reason, *outcome))
    columns = ["keyframe", "status", "reason", "distance_before_m", "distance_m", "deviation", "is_shifted", "action", "in_force"]
    return pd.DataFrame(rows, columns=columns)


def _distance_on(keyframes: Sequence[KeyframeResult], own: KeyframeResult) -> float:
    """Mean distance in m of the evidence of some keyframes under the calibration of one."""
    return float(np.mean([evidence_distance(k.evidence, k.as_stamped(own.T_camera_lidar())) for k in keyframes]))
