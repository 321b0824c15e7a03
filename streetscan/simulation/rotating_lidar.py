"""A rotating multi-beam lidar in the manner of the Velodyne HDL-64E: where and when each of its beams fires, and what comes back.

The head turns clockwise seen from above; a revolution starts and ends at the rear, its stamp is the moment the head faces
forward. The beams fire one after the other, every firing at its own time and from its own pose of the vehicle.

Source: Nagy (2020), 3.1.2 and A.1.2; Józsa & Benedek (2013), 2.3.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from streetscan.errors import BadInput
from streetscan.frames import LidarFrame
from streetscan.io.files import read_yaml
from streetscan.simulation.raycasting import SceneCaster
from streetscan.simulation.receiver import Receiver, measure
from streetscan.simulation.recording import Trajectory
from streetscan.simulation.sensors import hits_own_vehicle

# 64 beams every 48 microseconds. Source: Józsa & Benedek (2013), 2.3: more than 1.333 million points a second.
_FIRINGS_PER_S = 64 / 48e-6
# ASSUME: the car below the sensor: its body up to the bonnet, and the crown of its roof between the rails that carry the sensor;
# corners as in sensors.VEHICLE_BOX_M, origin on the road below the rear axle.
CAR_BOXES_M = (((-1.0, -0.9, 0.0), (3.5, 0.9, 0.95)), ((-0.25, -0.4, 0.0), (1.6, 0.4, 1.5)))
N_BEAMS = 64

# 50 m on 10 % and 120 m on 80 % reflectance, 1-2 cm (Józsa & Benedek 2013, 2.3). ASSUME: the strongest echo is the one reported, the
# beam opens by 2 mrad, returns below 0.9 m are suppressed, echoes within a pulse's 5 ns (0.75 m) merge, and 2 % are lost unexplained.
HDL64E_RECEIVER = {
    "min_range_m": 0.9,
    "max_range_m": 120.0,
    "dark_range_m": 50.0,
    "range_noise_m": 0.012,
    "beam_divergence_mrad": 2.0,
    "n_subrays": 4,
    "resolution_m": 0.75,
    "max_returns": 1,
    "saturation_db": 60.0,
    "wavelength_nm": 905,
    "keeps": "strongest",
    "dropout": 0.02,
}


@dataclass(frozen=True)
class Beams:
    """The beams of a lidar in the order they fire; all arrays (B,).

    Attributes:
        elevations_rad: above the horizon of the sensor.
        azimuths_rad: counter-clockwise from where the head faces.
        heights_m, sides_m: of each beam's origin: up, and to the left, both across the beam.
        gains: what the beam reports as intensity over what it should.
    """

    elevations_rad: np.ndarray
    azimuths_rad: np.ndarray
    heights_m: np.ndarray
    sides_m: np.ndarray
    gains: np.ndarray

    def __len__(self) -> int:
        return len(self.elevations_rad)

    @property
    def rings(self) -> np.ndarray:
        """(B,) uint16: each beam's place counted from the lowest."""
        return np.argsort(np.argsort(self.elevations_rad, kind="stable"), kind="stable").astype(np.uint16)


def nominal_beams(seed: int, spread_deg: float = 0.05) -> Beams:
    """The HDL-64E's two blocks of 32 beams, +2 to -8.33 and -8.83 to -24.8 degrees, with the offsets of one unit.

    Args:
        seed: of the unit.
        spread_deg: standard deviation of each beam's elevation and azimuth about its nominal one.

    ASSUME: the beams of a block look from four columns that are 2.2 (upper) and 3.4 degrees (lower block) apart, from lenses 0.21 and
    0.15 m above the sensor's foot, 26 mm to either side, as calibrations of such units have them; gains differ by 8 %.
    """
    rng = np.random.default_rng([seed, 60])
    upper, lower = np.linspace(2.0, -8.33, 32), np.linspace(-8.83, -24.8, 32)
    column = np.tile([-1.5, -0.5, 0.5, 1.5], 8)
    elevations = np.concatenate([upper, lower]) + rng.normal(0, spread_deg, 64)
    azimuths = np.concatenate([2.2 * column, 3.4 * column]) + rng.normal(0, spread_deg, 64)
    heights = np.repeat([0.21, 0.15], 32)
    return Beams(np.radians(elevations), np.radians(azimuths), heights, np.tile([0.026, -0.026], 32), rng.normal(1, 0.08, 64))


def read_beams(path: str | Path, seed: int) -> Beams:
    """The beams of a unit from its calibration (YAML as ROS and velodyne-decoder write it).

    Args:
        path: the file; `lasers` with rot_correction, vert_correction (rad), vert_offset_correction and horiz_offset_correction (m).
        seed: of the gains, which the file does not tell.
    Raises:
        BadInput: no such file, or none of that kind.
    """
    content = read_yaml(path)
    try:
        lasers = sorted(content["lasers"], key=lambda laser: laser["laser_id"])
        names = "vert_correction", "rot_correction", "vert_offset_correction", "horiz_offset_correction"
        columns = [np.array([float(laser.get(name, 0.0)) for laser in lasers]) for name in names]
    except (TypeError, KeyError, ValueError) as error:
        raise BadInput(path, f"is no calibration of a Velodyne ({error!r})", "give the unit's YAML with its list of lasers") from error
    if not lasers or not np.isfinite(columns).all() or len(np.unique(columns[0])) < len(lasers):
        raise BadInput(path, f"{len(lasers)} lasers whose elevations are not all different", "give the unit's own calibration")
    return Beams(*columns, np.random.default_rng([seed, 61]).normal(1, 0.08, len(lasers)))


@dataclass(frozen=True)
class RotatingLidar:
    """A lidar on a vehicle.

    Attributes:
        beams: of the unit.
        rate_hz: revolutions a second.
        T_vehicle_lidar: (4, 4) where it sits; frame `vehicle` has its origin on the road below the rear axle.
        receiver: the receiving side.
        firings_per_s: of all beams together.
        vehicle_boxes_m: (low, high) corners, frame `vehicle`, of what the vehicle hides below the sensor.
    """

    beams: Beams
    rate_hz: float
    T_vehicle_lidar: np.ndarray
    receiver: Receiver
    firings_per_s: float = _FIRINGS_PER_S
    vehicle_boxes_m: tuple = CAR_BOXES_M

    def stamp_s(self, number: int) -> float:
        """When the head faces forward in revolution `number`; revolution 0 begins at time 0."""
        return (number + 0.5) / self.rate_hz

    def firings(self, number: int) -> tuple[np.ndarray, np.ndarray]:
        """Times (n,) float64 of a revolution's firings, seconds, and which beam fires (n,)."""
        first, last = (int(np.ceil(k / self.rate_hz * self.firings_per_s - 1e-9)) for k in (number, number + 1))
        counts = np.arange(first, last)
        return counts / self.firings_per_s, counts % len(self.beams)

    def rays(self, number: int, times_s: np.ndarray, beams: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Origins (n, 3) float64 and directions (n, 3) float64 of firings, frame `lidar` at each firing."""
        b = self.beams
        azimuths = b.azimuths_rad[beams] - 2 * np.pi * self.rate_hz * (times_s - self.stamp_s(number))
        cos, sin, zero = np.cos(azimuths), np.sin(azimuths), np.zeros(len(times_s))
        out, left = np.stack([cos, sin, zero], axis=1), np.stack([-sin, cos, zero], axis=1)
        rise, level = np.sin(b.elevations_rad)[beams, None], np.cos(b.elevations_rad)[beams, None]
        up = np.array([0.0, 0.0, 1.0])
        origins = b.heights_m[beams, None] * (level * up - rise * out) + b.sides_m[beams, None] * left
        return origins, level * out + rise * up


def record_frame(caster: SceneCaster, lidar: RotatingLidar, trajectory: Trajectory, number: int, seed: int) -> LidarFrame:
    """One revolution, with its truth in `labels` and `instances`.

    Args:
        caster: the scene.
        lidar: the sensor.
        trajectory: of the vehicle; its clock is the scene's.
        number: of the revolution.
        seed: of the drive; revolutions draw from generators of their own.
    Returns:
        LidarFrame with stamp `stamp_s` in nanoseconds, the points in the order they were fired, intensity in 1/255. Labels are
        classes as the object has them when it stands; whether it moves is a matter of its instance.

    ASSUME: intensity is the apparent reflectance, the echo's strength with the loss over distance taken out, as the unit's own
    calibration does it; what is brighter than a white wall hit squarely reads 1.
    """
    rng = np.random.default_rng([seed, 62, number])
    times_s, beams = lidar.firings(number)
    # Beam after beam: neighbours then look along one cone, 3 mrad apart, and an edge shows between them.
    order = np.argsort(beams, kind="stable")
    times_s, beams = times_s[order], beams[order]
    origins, directions = lidar.rays(number, times_s, beams)
    T = lidar.T_vehicle_lidar
    body = directions @ T[:3, :3].T
    is_free = ~np.any(
        [hits_own_vehicle(T[:3, 3] + [0, 0, lidar.beams.heights_m.mean()], body, box) for box in lidar.vehicle_boxes_m], axis=0
    )
    times_s, beams, order, origins, directions, body = (v[is_free] for v in (times_s, beams, order, origins, directions, body))

    positions, rotations = trajectory.at(times_s)
    feet = origins @ T[:3, :3].T + T[:3, 3]
    origins_map = positions + np.einsum("nij,nj->ni", rotations, feet)
    directions_map = np.einsum("nij,nj->ni", rotations, body)
    directions_map /= np.linalg.norm(directions_map, axis=1, keepdims=True)
    returns = measure(caster, origins_map, directions_map.astype(np.float32), times_s, lidar.receiver, rng)

    in_order = np.argsort(order[returns.pulses], kind="stable")
    rows, faces = returns.pulses[in_order], returns.faces[in_order]
    ranges = returns.ranges_m[in_order].astype(np.float64)
    energies = 10 ** (returns.intensities[in_order] / 1000)
    reflectance = energies * 0.1 * (ranges / lidar.receiver.dark_range_m) ** 2 * lidar.beams.gains[beams[rows]]
    return LidarFrame(
        round(lidar.stamp_s(number) * 1e9),
        (origins[rows] + ranges[:, None] * directions[rows]).astype(np.float32),
        (np.round(np.clip(reflectance, 0, 1) * 255) / 255).astype(np.float32),
        lidar.beams.rings[beams[rows]],
        (times_s[rows] - lidar.stamp_s(number)).astype(np.float32),
        "ok" if len(rows) else "empty",
        number,
        labels=caster.labels[faces].astype(np.uint32),
        instances=caster.instances[faces].astype(np.uint32),
    )
