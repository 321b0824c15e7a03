"""Metres: the unit of a synthesized cloud from the way the lidar moved meanwhile.

Structure from motion has no scale of its own, and the thesis names none: its T* corrects local scaling only (N-230). We take it from the
poses `register_frames` found for the lidar, which need neither GPS nor IMU.

Camera and lidar sit on one body, so between two images the camera's way is t + (R - I) p with the lidar's way t and turn R in the
lidar's axes, and p the place of the camera in the frame `lidar`. Only lengths are compared, so the rotation between the two sensors is
not needed; p is not known before the calibration and is estimated along, held near zero by how far apart sensors on a car can be. Where
the vehicle drives straight, p has no effect and stays at zero.

What is left of the pairs' lengths tells how far to trust the scale: where chi-squared per degree of freedom is above one, the covariance
grows by it, and where cameras and lidar went ways of different shape there is no scale.

ASSUME: a pair counts by its length once more than least squares would have it: noise of the cameras' places lengthens every pair, by about
its square over the length, so that short pairs would make the scale too small.

ASSUME: within a second a vehicle moves smoothly: the lidar's poses are smoothed by a cubic in time before they are compared, since a
keyframe is short and the error of a single pose would show.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from streetscan.geometry import invert, rotation_angle
from streetscan.registration.odometry import FramePose

_DEGREE = 3


@dataclass(frozen=True)
class ScaleSettings:
    """How the scale is found.

    Attributes:
        margin_s: poses so long before the first and after the last image take part in the smoothing.
        lever_m: deviation of the camera's place from the lidar's, along each axis.
        noise_m: deviation of the smoothed lidar's way.
        min_way_m: a shorter way of the lidar tells no scale.
        max_std: largest relative deviation of the scale that is accepted.
        max_misfit: largest difference of the ways' lengths (root mean square) that is accepted, as a share of the whole way.
        max_turn_deg: cameras whose turn between two images differs by more from the lidar's are not believed, degrees.
    """

    margin_s: float = 0.5
    lever_m: float = 0.5
    noise_m: float = 0.01
    min_way_m: float = 0.5
    max_std: float = 0.05
    max_misfit: float = 0.02
    max_turn_deg: float = 1.2


@dataclass
class Scale:
    """What the lidar's motion tells.

    Attributes:
        value: metres per unit of frame `sfm`.
        std: its deviation, same unit.
        lever_m: (3,) place of the camera in the frame `lidar`, as far as turns show it.
        way_m: of the lidar from the first to the last image.
        misfit_m: root mean square by which the lengths of the ways between images differ, long ways before all.
        turn_off_deg: largest difference of the angles by which cameras and lidar turned between two images.
    """

    value: float
    std: float
    lever_m: np.ndarray
    way_m: float
    misfit_m: float = np.nan
    turn_off_deg: float = np.nan


class NoScale(Exception):
    """The lidar's motion does not tell the scale; the message says why."""


def estimate_scale(
    T_camera_sfm: np.ndarray, image_times_s: np.ndarray, lidar_poses: list[FramePose], settings: ScaleSettings = ScaleSettings()
) -> Scale:
    """The scale of a keyframe.

    Args:
        T_camera_sfm: (n, 4, 4) cameras, NaN where not registered.
        image_times_s: (n,) their times, on the clock of the lidar's up to a constant that is small against a frame.
        lidar_poses: rows of register_frames.
        settings: see ScaleSettings.
    Raises:
        NoScale: times that do not increase; too few poses around the images, in one segment; too short a way; ways of different shape;
            or too uncertain.
    """
    s, known = settings, np.isfinite(T_camera_sfm).all(axis=(1, 2))
    cameras, times = T_camera_sfm[known], np.asarray(image_times_s)[known]
    if (np.diff(times) <= 0).any():
        raise NoScale("the times of the images do not increase")
    centres = -np.einsum("nji,nj->ni", cameras[:, :3, :3], cameras[:, :3, 3])
    positions, rotations = smooth_motion(near_poses(lidar_poses, times[0], times[-1], s.margin_s), times)
    i, j = np.triu_indices(len(times), 1)
    turns = np.swapaxes(rotations[i], 1, 2) @ rotations[j]
    ways = np.einsum("nji,nj->ni", rotations[i], positions[j] - positions[i])
    lengths = np.linalg.norm(ways, axis=1)
    way_m = float(lengths.max())
    if way_m < s.min_way_m:
        raise NoScale(f"the lidar moved by {way_m:.2f} m")
    units = np.linalg.norm(centres[j] - centres[i], axis=1)
    # units * scale = |way + (R - I) p|, about length + direction (R - I) p.
    effect = np.einsum("ni,nij->nj", ways / np.maximum(lengths, 1e-9)[:, None], turns - np.eye(3))
    A, y = np.c_[units, -effect], lengths
    prior = np.diag([0.0, *np.full(3, 1 / s.lever_m**2)])
    # Of n images' pairs only n - 1 are independent; that long ones count more makes no more of them.
    trust = (len(times) - 1) / len(y) / s.noise_m**2 * lengths**2 * np.sum(lengths**2) / np.sum(lengths**4)
    weights = trust
    for _ in range(10):
        normal = (A * weights[:, None]).T @ A + prior
        solution = np.linalg.solve(normal, (A * weights[:, None]).T @ y)
        off = np.abs(A @ solution - y)
        # Where all are far off none is an outlier.
        weights = trust / np.maximum(1, off / (1.5 * max(s.noise_m, 1.5 * np.median(off))))
    misfit_m = np.sqrt(np.average(off**2, weights=lengths**2))
    # One of the n - 1 is spent on the scale.
    chi_squared = (misfit_m / s.noise_m) ** 2 * (len(times) - 1) / max(len(times) - 2, 1)
    covariance = np.linalg.inv(normal)[0, 0] * max(1.0, chi_squared)
    # Angles of turns are the same in any axes.
    angles, own = rotation_angle(turns), rotation_angle(cameras[i] @ invert(cameras[j]))
    turn_off_deg = float(np.degrees(np.abs(angles - own).max()))
    scale = Scale(float(solution[0]), float(np.sqrt(covariance)), solution[1:], way_m, float(misfit_m), turn_off_deg)
    if misfit_m > s.max_misfit * way_m:
        raise NoScale(f"ways of the cameras and of the lidar differ by {100 * misfit_m / way_m:.1f} % of the whole way")
    if not scale.value > 0 or scale.std > s.max_std * scale.value:
        raise NoScale(f"the scale is uncertain by {100 * scale.std / max(scale.value, 1e-9):.1f} %")
    return scale


def near_poses(poses: list[FramePose], first_s: float, last_s: float, margin_s: float) -> list[FramePose]:
    """The poses around the images, of one segment that covers them."""
    near = [p for p in poses if p.is_posed and first_s - margin_s <= p.time_s <= last_s + margin_s]
    for segment in sorted({p.segment for p in near}):
        own = [p for p in near if p.segment == segment]
        # The first and the last image may lie a frame's half beyond the poses.
        if len(own) > _DEGREE + 1 and own[0].time_s <= first_s + 0.1 and own[-1].time_s >= last_s - 0.1:
            return own
    raise NoScale(f"{len(near)} frames of the lidar around the images are registered, and not as one segment that covers them")


def smooth_motion(poses: list[FramePose], times_s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Positions (n, 3) and rotations (n, 3, 3) of the lidar at given times, by cubics in time."""
    middle = len(poses) // 2
    own = np.array([p.time_s for p in poses]) - poses[middle].time_s
    base = Rotation.from_matrix(poses[middle].T_segment_lidar[:3, :3])
    T = np.array([p.T_segment_lidar for p in poses])
    turns = (base.inv() * Rotation.from_matrix(T[:, :3, :3])).as_rotvec()
    wanted = np.vander(times_s - poses[middle].time_s, _DEGREE + 1)
    fitted = wanted @ np.linalg.lstsq(np.vander(own, _DEGREE + 1), np.c_[T[:, :3, 3], turns], rcond=None)[0]
    return fitted[:, :3], (base * Rotation.from_rotvec(fitted[:, 3:])).as_matrix()
