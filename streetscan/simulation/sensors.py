"""Laser scanners: where their pulses go.

A mobile mapper in the manner of the Riegl VMX-450 (two rotating profile scanners whose planes cross) and a static
scanner in the manner of the VZ-400. Every pulse has its own time, so that objects in motion become phantoms by themselves.

Source: Nagy (2020), A.1.1 (550 000 measurements a second and 360 degrees for each of two scanners), Fig. 2.3.
"""

from dataclasses import dataclass

import numpy as np

from streetscan.errors import BadInput


@dataclass(frozen=True)
class ProfileScanner:
    """A scanner whose mirror sweeps a plane, mounted on a vehicle (x forward, y left, z up, origin on the road).

    Attributes:
        position_m: (x, y, z) of the mirror in the vehicle frame.
        yaw_deg: how far the plane's normal is turned from the driving direction, counter-clockwise.
        tilt_deg: how far the plane's top leans forward; its lower half then meets the road behind the vehicle.
        lines_per_s: revolutions of the mirror a second.
        pulses_per_s: pulses a second.
        start_turn: where the mirror stands at time 0, in turns.
    """

    position_m: tuple[float, float, float]
    yaw_deg: float
    tilt_deg: float
    lines_per_s: float
    pulses_per_s: float
    start_turn: float = 0.0

    def directions(self, times_s: np.ndarray) -> np.ndarray:
        """(n, 3) float32 unit vectors in the vehicle frame of pulses at (n,) times."""
        yaw, tilt = np.radians(self.yaw_deg), np.radians(self.tilt_deg)
        across = np.array([-np.sin(yaw), np.cos(yaw), 0.0])
        up = np.array([np.cos(yaw) * np.sin(tilt), np.sin(yaw) * np.sin(tilt), np.cos(tilt)])
        turns = times_s * self.lines_per_s + self.start_turn
        angles = (2 * np.pi * (turns - np.floor(turns))).astype(np.float32)
        return np.outer(np.cos(angles), -up.astype(np.float32)) + np.outer(np.sin(angles), across.astype(np.float32))


def mobile_mapper(
    lines_per_s: float = 200.0, pulses_per_s: float = 550_000.0, yaw_deg: float = 45.0, tilt_deg: float = 30.0
) -> tuple[ProfileScanner, ProfileScanner]:
    """The two scanners of a mobile mapper at the rear end of the roof, their planes crossing.

    ASSUME: planes at 45 degrees to the driving direction, tilted by 30 degrees, so that facades along and across the
    street, and poles, are met by both; mirrors 2.7 m above the road at the van's rear edge, so that the road behind is free.
    """
    rates = lines_per_s, pulses_per_s
    return (
        ProfileScanner((-2.4, 0.35, 2.7), -yaw_deg, tilt_deg, *rates),
        ProfileScanner((-2.4, -0.35, 2.7), yaw_deg, tilt_deg, *rates, start_turn=0.25),
    )


# ASSUME: the van that carries the scanners, (low, high) corners in the vehicle frame; its own roof is cut from the scans.
VEHICLE_BOX_M = ((-2.6, -0.95, 0.0), (2.4, 0.95, 1.9))


def hits_own_vehicle(position_m: tuple[float, float, float], directions: np.ndarray, box_m: tuple = VEHICLE_BOX_M) -> np.ndarray:
    """(n,) bool: rays from a mirror above the roof, (n, 3) in the vehicle frame, that end on the roof of the vehicle's box."""
    (x_low, y_low, _), (x_high, y_high, roof) = box_m
    down = np.minimum(directions[:, 2], -1e-6)
    to_roof = (roof - position_m[2]) / down
    x, y = position_m[0] + to_roof * directions[:, 0], position_m[1] + to_roof * directions[:, 1]
    return (directions[:, 2] < 0) & (x > x_low) & (x < x_high) & (y > y_low) & (y < y_high)


@dataclass(frozen=True)
class StaticScanner:
    """A scanner on a tripod that sweeps vertical lines while it turns once about the vertical.

    Attributes:
        height_m: of the mirror above the ground.
        step_deg: between neighbouring pulses, vertically and horizontally (VZ-400 panorama: 0.04).
        low_deg, high_deg: vertical field of view (VZ-400: -40 to +60).
        pulses_per_s: pulses a second.
    """

    height_m: float = 1.7
    step_deg: float = 0.04
    low_deg: float = -40.0
    high_deg: float = 60.0
    pulses_per_s: float = 122_000.0

    def __post_init__(self):
        if not -90 <= self.low_deg < self.high_deg <= 90:
            found = f"{self.low_deg:g} with high_deg {self.high_deg:g}"
            raise BadInput("simulation.static_scanner.low_deg", found, "let -90 <= low_deg < high_deg <= 90")

    @property
    def n_rows(self) -> int:
        """Pulses of one vertical line."""
        return int(np.floor((self.high_deg - self.low_deg) / self.step_deg)) + 1

    @property
    def n_columns(self) -> int:
        """Vertical lines of a full turn."""
        return round(360.0 / self.step_deg)

    @property
    def panorama_s(self) -> float:
        """Duration of a full turn."""
        return self.n_columns * self.n_rows / self.pulses_per_s

    def directions(self, first_column: int, n_columns: int) -> np.ndarray:
        """(n_columns * n_rows, 3) float32 unit vectors of some vertical lines, x towards column 0, in firing order."""
        azimuths = np.radians((first_column + np.arange(n_columns)) * self.step_deg)[:, None]
        elevations = np.radians(self.low_deg + np.arange(self.n_rows) * self.step_deg)[None]
        parts = np.cos(elevations) * np.cos(azimuths), np.cos(elevations) * np.sin(azimuths), np.sin(elevations) + 0 * azimuths
        return np.stack(parts, axis=-1).reshape(-1, 3).astype(np.float32)
