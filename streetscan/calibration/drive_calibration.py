"""One calibration of a drive from its accepted keyframes, with how far to trust it, and which calibration is in force when.

Beyond the thesis, which keeps the last keyframe's (N-233). A keyframe gives the lidar at its stamp in the camera at the image's stamp; when
the stamps' clocks differ, the vehicle moved in between by that much more. Keyframes of different speeds or turns tell the offset; where all
are alike it cannot be told from a shift of the camera along the road, stays at zero, and its deviation says so.

ASSUME: the offset is a constant below 50 ms; before anything is known, 5 ms either way are likely.
ASSUME: few keyframes do not tell their own scatter; it is mixed with that of single keyframes on the training drives (`keyframe_m`,
`keyframe_deg`), which counts as `n_known` keyframes.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import pandas as pd
from scipy.spatial.transform import Rotation

from streetscan.calibration.keyframe_calibration import evidence_distance
from streetscan.calibration.motion import LidarMotion
from streetscan.geometry import invert, transform_of_rotation


@dataclass(frozen=True)
class DriveCalibrationSettings:
    """How keyframes are combined.

    Attributes:
        offset_std_s: expected size of the time offset.
        keyframe_m, keyframe_deg: deviation of one keyframe along and about each axis.
        n_known: keyframes they count as.
        n_bootstrap: samples of keyframes drawn for the bootstrap.
        max_distance_m: evidence farther than this from the planes of a keyframe says that the calibration in force is no longer right.
        min_gain: share by which a keyframe must lie nearer than the calibration in force to replace it.
    """

    offset_std_s: float = 0.005
    keyframe_m: float = 0.04
    keyframe_deg: float = 0.1
    n_known: float = 3.0
    n_bootstrap: int = 200
    max_distance_m: float = 0.08
    min_gain: float = 0.02


@dataclass
class KeyframeResult:
    """What a keyframe brings in.

    Attributes:
        index, status: its number, and `ok` when it was accepted.
        T_camera_stamp: (4, 4) of its calibration, or None.
        motion: of the lidar, or None.
        evidence: (P, 9) of its calibration.
    """

    index: int
    status: str
    T_camera_stamp: np.ndarray | None
    motion: LidarMotion | None
    evidence: np.ndarray

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
        status: `ok`, or `no_keyframes` when none was accepted.
        T_camera_lidar: (4, 4) rigid, of the sensors on the vehicle; NaN without keyframes.
        time_offset_s: what the images' stamps are ahead of the lidar's clock.
        covariance: (7, 7) of x, y, z of T_camera_lidar (m), a rotation vector about the lidar's axes (rad) and the offset (s).
        weights: (K,) of the accepted keyframes, 0 to 1.
        used: (K,) their numbers.
    """

    status: str
    T_camera_lidar: np.ndarray = field(default_factory=lambda: np.full((4, 4), np.nan))
    time_offset_s: float = np.nan
    covariance: np.ndarray = field(default_factory=lambda: np.full((7, 7), np.nan))
    weights: np.ndarray = field(default_factory=lambda: np.empty(0))
    used: np.ndarray = field(default_factory=lambda: np.empty(0, np.int64))


def combine_keyframes(
    keyframes: Sequence[KeyframeResult], settings: DriveCalibrationSettings = DriveCalibrationSettings(), seed: int = 0
) -> DriveCalibration:
    """The calibration that accepted keyframes agree on; one that disagrees loses its weight.

    Args:
        keyframes: all of the drive.
        settings: see DriveCalibrationSettings.
        seed: of the bootstrap.
    """
    accepted = [k for k in keyframes if k.status == "ok"]
    if not accepted:
        return DriveCalibration("no_keyframes")
    poses = np.array([k.T_camera_lidar() for k in accepted])
    # By how much each keyframe's camera moves for a second of offset, in the camera's axes.
    velocities = [np.zeros(3) if k.motion is None else k.motion.velocity_at_image() for k in accepted]
    ways = np.einsum("kij,kj->ki", poses[:, :3, :3], np.array(velocities))
    fitted = _fit(poses, ways, settings)
    covariance = fitted.covariance
    if len(accepted) > 2:
        rng = np.random.default_rng(seed)
        drawn = [rng.integers(0, len(accepted), len(accepted)) for _ in range(settings.n_bootstrap)]
        samples = np.array([_difference(_fit(poses[rows], ways[rows], settings), fitted) for rows in drawn])
        # The larger of both: spread knows nothing of outliers' leverage, the bootstrap nothing of what few keyframes did not meet.
        bootstrap = np.cov(samples.T)
        larger = np.sqrt(np.maximum(np.diag(bootstrap) / np.diag(covariance), 1.0))
        covariance = covariance * np.outer(larger, larger)
    numbers = np.array([k.index for k in accepted])
    return DriveCalibration("ok", fitted.T, fitted.offset_s, covariance, fitted.weights, numbers)


@dataclass
class _Fit:
    T: np.ndarray
    offset_s: float
    covariance: np.ndarray
    weights: np.ndarray


def _fit(poses: np.ndarray, ways: np.ndarray, s: DriveCalibrationSettings) -> _Fit:
    """Weighted mean of poses (K, 4, 4) and a common offset along their ways (K, 3); Tukey's weights, from the median on."""
    n, known_m, known_rad = len(poses), s.keyframe_m, np.radians(s.keyframe_deg)
    rotations = Rotation.from_matrix(poses[:, :3, :3])
    weights = np.ones(n)
    position, offset, mean = np.median(poses[:, :3, 3], axis=0), 0.0, rotations.mean()
    for iteration in range(10):
        if iteration:
            mean = rotations.mean(weights)
            A = np.concatenate([np.tile(np.eye(3), (n, 1)), ways.reshape(-1, 1)], axis=1)
            w = np.repeat(weights, 3) / known_m**2
            H = (A * w[:, None]).T @ A + np.diag([0, 0, 0, 1 / s.offset_std_s**2])
            solution = np.linalg.solve(H, (A * w[:, None]).T @ poses[:, :3, 3].ravel())
            position, offset = solution[:3], float(solution[3])
        shifts = poses[:, :3, 3] - position - ways * offset
        turns = (mean.inv() * rotations).as_rotvec()
        spread = np.sqrt((shifts / known_m) ** 2 + (turns / known_rad) ** 2).max(axis=1)
        limit = 3.0 * max(1.0, float(np.median(spread)))
        # A keyframe never loses all its weight: two that disagree would leave none.
        weights = np.maximum(np.clip(1 - (spread / limit) ** 2, 0, None) ** 2, 1e-3)
    total = weights.sum()
    mixed = [
        np.sqrt((s.n_known * known**2 + (weights[:, None] * errors**2).sum(axis=0)) / (s.n_known + total))
        for known, errors in ((known_m, shifts), (known_rad, turns))
    ]
    A = np.concatenate([np.tile(np.eye(3), (n, 1)), ways.reshape(-1, 1)], axis=1)
    w = np.repeat(weights, 3) / np.tile(mixed[0], n) ** 2
    H = (A * w[:, None]).T @ A + np.diag([0, 0, 0, 1 / s.offset_std_s**2])
    of_shift = np.linalg.inv(H)
    covariance = np.zeros((7, 7))
    rows = np.array([0, 1, 2, 6])
    covariance[np.ix_(rows, rows)] = of_shift
    covariance[3:6, 3:6] = np.diag(mixed[1] ** 2 / total)
    return _Fit(transform_of_rotation(mean.as_matrix(), position), offset, covariance, weights)


def _difference(a: _Fit, b: _Fit) -> np.ndarray:
    """(7,) shift, turn and offset from one fit to another."""
    turn = Rotation.from_matrix(b.T[:3, :3].T @ a.T[:3, :3]).as_rotvec()
    return np.array([*(a.T[:3, 3] - b.T[:3, 3]), *turn, a.offset_s - b.offset_s])


def follow_drive(keyframes: Sequence[KeyframeResult], settings: DriveCalibrationSettings = DriveCalibrationSettings()) -> pd.DataFrame:
    """Which calibration is in force after each keyframe, as in a drive that goes on (N-213, N-233).

    Columns: `keyframe`, `status`; `distance_before_m` and `distance_m` of the keyframe's evidence under the calibration in force and under
    its own; `is_shifted`, whether the one in force no longer fits, so that the mounting must have moved; `action` (`kept`, `replaced`,
    `none`); `in_force`, the keyframe whose calibration is in force afterwards, or -1.
    """
    s, rows, in_force = settings, [], None
    for k in keyframes:
        before = after = np.nan
        action = "none" if in_force is None else "kept"
        if k.status == "ok":
            after = evidence_distance(k.evidence, k.T_camera_stamp)
            if in_force is not None:
                before = evidence_distance(k.evidence, k.as_stamped(in_force.T_camera_lidar()))
            if in_force is None or after < (1 - s.min_gain) * before:
                action, in_force = "replaced", k
        is_shifted = bool(np.isfinite(before) and before > s.max_distance_m)
        rows.append((f"{k.index:02d}", k.status, before, after, is_shifted, action, -1 if in_force is None else in_force.index))
    return pd.DataFrame(rows, columns=["keyframe", "status", "distance_before_m", "distance_m", "is_shifted", "action", "in_force"])
