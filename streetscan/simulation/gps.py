"""A GPS receiver in a street canyon: positions that wander, are pulled across the street, and now and then stop coming.

Source: Nagy (2020), chapter 1: in Budapest "GPS position error can be larger than 10 meters"; 3.4.1 and Fig. 3.9: a start that
is 7 m and 8.5 degrees off.
"""

from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter

from streetscan import geodesy
from streetscan.frames import GpsFix
from streetscan.simulation.raycasting import SceneCaster
from streetscan.simulation.recording import Trajectory

_SKY_AZIMUTHS, _SKY_ELEVATIONS_DEG = 24, (15.0, 30.0, 45.0, 60.0)
# The errors are simulated this often, so that they do not depend on how often they are looked at.
_STEP_S = 0.1
# ASSUME: a receiver smooths over this share of the memory.
_SMOOTHING = 0.1


@dataclass(frozen=True)
class Gps:
    """A receiver and its errors.

    Attributes:
        position_m: of the antenna, frame `vehicle`.
        rate_hz: fixes a second.
        wander_m: standard deviation, per axis, of the slowly varying error under the open sky.
        canyon_m: the same, across the street, of what is added where houses hide the sky on both sides.
        memory_s: after which the slow errors have changed.
        noise_m: standard deviation, per axis, from fix to fix.
        limit_m: the horizontal error stays below this.
        heading_deg, heading_limit_deg: standard deviation and limit of the heading's slowly varying error.
        outages_per_min, outage_s: how often fixes stop, and for how long on average.

    ASSUME: Gauss-Markov errors; the figures put nine of ten fixes of a canyon between 1 and 9 m from the truth.
    """

    position_m: tuple[float, float, float] = (0.3, 0.0, 1.55)
    rate_hz: float = 5.0
    wander_m: float = 2.5
    canyon_m: float = 5.0
    memory_s: float = 20.0
    noise_m: float = 0.25
    limit_m: float = 10.0
    heading_deg: float = 6.0
    heading_limit_deg: float = 15.0
    outages_per_min: float = 2.0
    outage_s: float = 2.0


def record_fixes(
    caster: SceneCaster, gps: Gps, trajectory: Trajectory, crs: str, end_s: float, rng: np.random.Generator, start_ns: int = 0
) -> list[GpsFix]:
    """The fixes of a drive.

    Args:
        caster: the scene, which hides parts of the sky.
        gps: the receiver.
        trajectory: of the vehicle, from time 0.
        crs: of the scene.
        end_s: when the drive is over.
        rng: draws the errors.
        start_ns: the time of 0, nanoseconds since 1970.
    Returns:
        fixes in order of time, their covariance as the receiver believes it: that under the open sky, which a canyon exceeds.
    """
    steps_s = np.arange(0.0, end_s + _STEP_S, _STEP_S)
    positions, rotations = trajectory.at(steps_s)
    antenna = positions + rotations @ np.asarray(gps.position_m)
    error_m = position_errors(np.stack([sky_canyon(caster, p, t) for p, t in zip(antenna, steps_s, strict=True)]), gps, rng)
    yaws = np.unwrap(np.arctan2(rotations[:, 1, 0], rotations[:, 0, 0]))
    turn = soft_limit(np.radians(gps.heading_deg) * _wander(len(steps_s), 1, gps.memory_s, rng), np.radians(gps.heading_limit_deg))[:, 0]
    is_heard = _availability(len(steps_s), gps, rng)

    times_s = np.arange(0.0, end_s, 1 / gps.rate_hz)
    times_s = times_s[is_heard[np.minimum((times_s / _STEP_S).astype(int), len(steps_s) - 1)]]
    columns = np.column_stack([antenna + error_m, yaws + turn])
    east, north, up, yaw = (np.interp(times_s, steps_s, c) for c in columns.T)
    noise = rng.normal(0, gps.noise_m, (len(times_s), 3))
    noise[:, :2] = soft_limit(noise[:, :2], 0.1 * gps.limit_m)
    latitude, longitude = geodesy.unproject(np.stack([east + noise[:, 0], north + noise[:, 1]], axis=1), crs)
    heading = np.pi / 2 - (yaw - geodesy.grid_turn(latitude, longitude, crs))
    covariance = np.diag([1.0, 1.0, 4.0]) * (gps.wander_m**2 + gps.noise_m**2)
    return [
        GpsFix(start_ns + round(t * 1e9), float(a), float(b), float(h), covariance, float(c % (2 * np.pi)))
        for t, a, b, h, c in zip(times_s, latitude, longitude, up + 2 * noise[:, 2], heading, strict=True)
    ]


def sky_canyon(caster: SceneCaster, position: np.ndarray, time_s: float) -> np.ndarray:
    """How much of the sky is hidden, by direction: (2, 2) symmetric, the mean over azimuths of `hidden * u u^T` times 2.

    0 under the open sky, the identity in a pit; a street between high houses has 1 across and 0 along itself.
    """
    azimuths = 2 * np.pi * (np.arange(_SKY_AZIMUTHS) + 0.5) / _SKY_AZIMUTHS
    elevations = np.radians(_SKY_ELEVATIONS_DEG)
    around = np.stack([np.cos(azimuths), np.sin(azimuths)], axis=1)
    rays = np.concatenate([np.column_stack([np.cos(e) * around, np.full(len(around), np.sin(e))]) for e in elevations])
    hits = caster.cast(np.tile(position, (len(rays), 1)), rays.astype(np.float32), np.full(len(rays), time_s))
    hidden = (hits.faces >= 0).reshape(len(elevations), -1).mean(axis=0)
    return 2 * np.einsum("n,ni,nj->ij", hidden, around, around) / len(around)


def position_errors(canyons: np.ndarray, gps: Gps, rng: np.random.Generator) -> np.ndarray:
    """Slowly varying errors (n, 3) in metres: east, north, up, `_STEP_S` apart.

    Args:
        canyons: (n, 2, 2) of `sky_canyon`.
        gps: the receiver.
        rng: draws them.
    """
    open_sky, hidden = (_wander(len(canyons), 3, gps.memory_s, rng) for _ in range(2))
    error = gps.wander_m * open_sky
    error[:, :2] += gps.canyon_m * np.einsum("nij,nj->ni", canyons, hidden[:, :2])
    # What is left of the limit is the noise's.
    error[:, :2] = soft_limit(error[:, :2], 0.9 * gps.limit_m)
    error[:, 2] *= 2.0
    return error


def soft_limit(vectors: np.ndarray, limit: float) -> np.ndarray:
    """Vectors (n, d), the long ones shortened so that none reaches the limit; short ones hardly change."""
    lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
    return vectors * (limit * np.tanh(lengths / limit) / np.maximum(lengths, 1e-12))


def _wander(n: int, n_axes: int, memory_s: float, rng: np.random.Generator) -> np.ndarray:
    """(n, n_axes) stationary Gauss-Markov noise of unit standard deviation, as a receiver's filter smooths it."""
    slow, fast = np.exp(-_STEP_S / memory_s), np.exp(-_STEP_S / (_SMOOTHING * memory_s))
    n_before = int(np.ceil(10 * memory_s / _STEP_S))
    draws = rng.standard_normal((n_before + n, n_axes))
    noise = lfilter([np.sqrt(1 - slow**2)], [1, -slow], draws, axis=0)
    variance = (1 - fast) / (1 + fast) * (1 + slow * fast) / (1 - slow * fast)
    return lfilter([1 - fast], [1, -fast], noise, axis=0)[n_before:] / np.sqrt(variance)


def _availability(n: int, gps: Gps, rng: np.random.Generator) -> np.ndarray:
    """(n,) bool: whether fixes come; outages begin at random and last as long as chance will have it."""
    is_heard = np.ones(n, bool)
    if gps.outages_per_min <= 0:
        return is_heard
    at_s = rng.exponential(60 / gps.outages_per_min)
    while at_s < n * _STEP_S:
        length_s = rng.exponential(gps.outage_s)
        is_heard[round(at_s / _STEP_S) : round((at_s + length_s) / _STEP_S)] = False
        at_s += length_s + rng.exponential(60 / gps.outages_per_min)
    return is_heard
