"""When within a revolution each point was measured, and what the motion of the vehicle does to it.

A revolution starts at the rear, its stamp is the firing at azimuth 0 (forward).
"""

import numpy as np
from numba import njit
from scipy.spatial.transform import Rotation

from streetscan import geometry

# ASSUME: 3 degrees to either side hold enough firings to fit a line through, and the rotation is even over them.
_FORWARD_RAD = np.radians(3.0)


def azimuths_of(points: np.ndarray) -> np.ndarray:
    """Azimuths (N,) in radians, counter-clockwise from forward, of points (N, 3); float32 for float32 points."""
    points = np.asarray(points)
    # Columns of their own let numpy use vector instructions: five times as fast.
    return np.arctan2(np.ascontiguousarray(points[:, 1]), np.ascontiguousarray(points[:, 0]))


def azimuth_offsets(azimuths_rad: np.ndarray, start_s: float, end_s: float, direction: str = "clockwise") -> np.ndarray:
    """Firing times of the points of one revolution, from their azimuths and an even rotation to either side of forward.

    Args:
        azimuths_rad: (N,) counter-clockwise from forward, -pi to pi, frame `lidar`.
        start_s: firing at the rear at the beginning, relative to the firing at azimuth 0 (negative).
        end_s: firing at the rear at the end, likewise (positive).
        direction: how the sensor turns seen from above, `clockwise` (Velodyne) or `counterclockwise`.
    Returns:
        (N,) float32 seconds relative to the firing at azimuth 0.
    """
    turned = np.asarray(azimuths_rad, np.float32) * np.float32((-1 if direction == "clockwise" else 1) / np.pi)
    if abs(end_s + start_s) < 1e-9:
        return turned * np.float32(end_s)
    return np.where(turned < 0, turned * np.float32(-start_s), turned * np.float32(end_s))


def forward_time(points: np.ndarray, times_s: np.ndarray) -> float:
    """The firing time at azimuth 0, from the times of the points.

    Args:
        points: (N, 3) metres, frame `lidar`.
        times_s: (N,) seconds since any moment.
    Returns:
        the time at azimuth 0 of a line through the points within 3 degrees of it; without such points, what the rate of turn
        elsewhere predicts; NaN for fewer than two points.
    """
    points, times_s = np.asarray(points, np.float64), np.asarray(times_s, np.float64)
    azimuths = np.arctan2(points[:, 1], points[:, 0])
    near = np.abs(azimuths) < _FORWARD_RAD
    # A recording that starts and ends forward has firings of both ends there; the earlier pass is the stamp's.
    if near.any():
        first = times_s[near].min()
        period = np.ptp(times_s)
        near &= times_s - first <= period / 2
    if near.sum() >= 2 and np.ptp(azimuths[near]) > 1e-4:
        _, at_zero = np.polyfit(azimuths[near], times_s[near] - times_s[near][0], 1)
        return float(at_zero + times_s[near][0])
    if near.any():
        return float(np.median(times_s[near]))
    return _forward_time_of_others(azimuths, times_s)


def _forward_time_of_others(azimuths: np.ndarray, times_s: np.ndarray) -> float:
    """When a sensor that reported nothing from ahead looked there: from the mean azimuth of each millisecond and the rate of turn."""
    if len(azimuths) < 2:
        return float("nan")
    first = times_s.min()
    slots = np.round((times_s - first) * 1000).astype(np.int64)
    slot, inverse = np.unique(slots, return_inverse=True)
    inverse = inverse.reshape(-1)
    direction = np.bincount(inverse, np.cos(azimuths)) + 1j * np.bincount(inverse, np.sin(azimuths))
    mean_time = np.bincount(inverse, times_s - first) / np.bincount(inverse)
    adjacent = np.flatnonzero(np.diff(slot) == 1)
    if len(adjacent) == 0:
        return float("nan")
    steps = np.angle(direction[adjacent + 1] / direction[adjacent])
    rate = float(np.median(steps / (mean_time[adjacent + 1] - mean_time[adjacent])))
    if abs(rate) < 1e-6:
        return float("nan")
    passes = mean_time - np.angle(direction) / rate
    period, middle = abs(2 * np.pi / rate), np.ptp(times_s) / 2
    passes += period * np.round((middle - passes) / period)
    return float(first + np.median(passes))


def deskew(points: np.ndarray, time_offset_s: np.ndarray, velocity_mps: np.ndarray, turn_rate_radps: np.ndarray) -> np.ndarray:
    """Points as the sensor would have measured them had it stood still at the stamp: constant velocity over the revolution.

    Args:
        points: (N, 3) metres, frame `lidar` at each point's own firing.
        time_offset_s: (N,) firing minus stamp.
        velocity_mps: (3,) velocity of the sensor in its own frame at the stamp.
        turn_rate_radps: (3,) angular velocity in the same frame.
    Returns:
        (N, 3) float64, frame `lidar` at the stamp.
    """
    velocity, turn = (np.asarray(v, np.float64) for v in (velocity_mps, turn_rate_radps))
    return _deskew(np.asarray(points), np.asarray(time_offset_s), velocity, turn)


@njit(cache=True, nogil=True)
def _deskew(points, offsets, velocity, turn):
    rate = np.sqrt((turn * turn).sum())
    kx, ky, kz = turn / rate if rate > 0 else turn
    moved = np.empty((len(points), 3))
    for i in range(len(points)):
        t, x, y, z = offsets[i], points[i, 0], points[i, 1], points[i, 2]
        # Rodrigues' formula.
        s, c = np.sin(rate * t), 1 - np.cos(rate * t)
        along = kx * x + ky * y + kz * z
        moved[i, 0] = x + s * (ky * z - kz * y) + c * (kx * along - x) + t * velocity[0]
        moved[i, 1] = y + s * (kz * x - kx * z) + c * (ky * along - y) + t * velocity[1]
        moved[i, 2] = z + s * (kx * y - ky * x) + c * (kz * along - z) + t * velocity[2]
    return moved


def deskew_along(
    points: np.ndarray, time_offset_s: np.ndarray, time_s: float, pose_times_s: np.ndarray, T_world_lidar: np.ndarray
) -> np.ndarray:
    """Points as the sensor would have measured them had it stood still at the stamp, along a trajectory.

    Args:
        points: (N, 3) metres, frame `lidar` at each point's own firing.
        time_offset_s: (N,) firing minus stamp.
        time_s: the stamp.
        pose_times_s: (K,) increasing.
        T_world_lidar: (K, 4, 4) poses of the sensor.
    Returns:
        (N, 3) float64, frame `lidar` at the stamp; NaN for points fired outside the trajectory.
    """
    # Firings of one microsecond share a pose: the vehicle moves 0.02 mm in it.
    steps, inverse = np.unique(np.round(np.asarray(time_offset_s, np.float64) * 1e6).astype(np.int64), return_inverse=True)
    T_world_stamp = geometry.interpolate_poses(np.array([time_s]), pose_times_s, T_world_lidar)[0]
    T_world_firing = geometry.interpolate_poses(time_s + steps * 1e-6, pose_times_s, T_world_lidar)
    return geometry.apply((geometry.invert(T_world_stamp) @ T_world_firing)[inverse.reshape(-1)], points)


def velocity_between(T_world_a: np.ndarray, T_world_b: np.ndarray, duration_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Velocity (3,) and turn rate (3,), in the sensor's frame at `a`, of a constant motion between two of its poses (4, 4)."""
    T_a_b = geometry.invert(T_world_a) @ T_world_b
    return T_a_b[:3, 3] / duration_s, Rotation.from_matrix(T_a_b[:3, :3]).as_rotvec() / duration_s
