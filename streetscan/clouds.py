"""The point cloud: coordinates and named fields of equal length."""

from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

from streetscan.errors import BadInput


@dataclass
class PointCloud:
    """Points with named per-point fields.

    Attributes:
        points: (N, 3) float64, metres; frame `map` unless said otherwise.
        fields: name to array, the first axis of length N (`intensity`, `rgb` (N, 3) uint8, `label`, `time_s`, ...).
        crs: the coordinate reference system as pyproj reads it (`EPSG:23700`, WKT), or None for a local frame.
    """

    points: np.ndarray
    fields: dict[str, np.ndarray] = field(default_factory=dict)
    crs: str | None = None

    def __post_init__(self):
        self.points = np.asarray(self.points, np.float64).reshape(-1, 3)
        for name, values in self.fields.items():
            if len(values) != len(self.points):
                raise ValueError(f"field '{name}' has {len(values)} values for {len(self.points)} points")

    def __len__(self) -> int:
        return len(self.points)

    def select(self, index: np.ndarray) -> "PointCloud":
        """The points a boolean mask or an index array picks, with their fields."""
        return PointCloud(self.points[index], {k: v[index] for k, v in self.fields.items()}, self.crs)


def concatenate(clouds: Iterable[PointCloud]) -> PointCloud:
    """One cloud of many; keeps the fields all of them have. ValueError when their CRS differ or there is none."""
    clouds = list(clouds)
    if not clouds:
        raise ValueError("nothing to concatenate")
    if len({c.crs for c in clouds}) > 1:
        raise ValueError(f"clouds in different reference systems: {sorted(str(c.crs) for c in clouds)}")
    names = [n for n in clouds[0].fields if all(n in c.fields for c in clouds)]
    return PointCloud(
        np.concatenate([c.points for c in clouds]),
        {n: np.concatenate([c.fields[n] for c in clouds]) for n in names},
        clouds[0].crs,
    )


# ASSUME: a coordinate of 16 km or more in float32 has steps of 1 mm or more, and of 6 cm at UTM northings (5 000 km).
FLOAT32_LIMIT_M = 16_384.0


def check_points(points: np.ndarray, where: object, stored_as_float32: bool = False, first: int = 0) -> None:
    """Refuse coordinates no step can work with.

    Args:
        points: (N, 3), metres.
        where: the file they came from, named in the error.
        stored_as_float32: the file held 32-bit coordinates.
        first: index in the file of the first of these points, when they are one chunk of many.
    Raises:
        BadInput: no point; NaN or infinite coordinates; 32-bit coordinates so large that millimetres are lost.
    """
    if len(points) == 0:
        raise BadInput(where, "holds no point", "give a file with points or remove it from the data set's file")
    finite = np.isfinite(points).all(axis=1)
    if not finite.all():
        n_bad, first_bad = int((~finite).sum()), first + int(np.argmin(finite))
        raise BadInput(where, f"{n_bad} points have NaN or infinite coordinates (first: point {first_bad})", "remove those points")
    largest = float(np.abs(points[:, :2]).max())
    if stored_as_float32 and largest >= FLOAT32_LIMIT_M:
        step = float(np.spacing(np.float32(largest)))
        raise BadInput(
            where,
            f"stores coordinates as 32-bit floats as large as {largest:.0f} m, where they step by {step:.3f} m",
            "export it again with 64-bit coordinates or with a local origin subtracted",
        )
