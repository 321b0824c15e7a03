"""Range images of KIT's HDL-64E recordings: 16-bit PNG, one row per beam, one column per azimuth."""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np

from streetscan.errors import BadInput
from streetscan.frames import BadRecord
from streetscan.io.files import read_text


@dataclass(frozen=True)
class RangeImageLayout:
    """How pixels map to directions.

    Attributes:
        units_per_m: a pixel's value divided by this is metres; 0 is no return.
        azimuths_rad: (columns,) azimuth of each column's middle, counter-clockwise from forward.
        elevations_rad: (rows,) elevation of each row, up positive.
    """

    units_per_m: float
    azimuths_rad: np.ndarray
    elevations_rad: np.ndarray

    @property
    def shape(self) -> tuple[int, int]:
        return len(self.elevations_rad), len(self.azimuths_rad)

    @cached_property
    def directions(self) -> np.ndarray:
        """Unit vectors (3, rows * columns) float32 of the pixels, row by row; each coordinate lies together, quick to pick from."""
        elevations, azimuths = self.elevations_rad[:, None], self.azimuths_rad[None]
        xyz = np.cos(elevations) * np.cos(azimuths), np.cos(elevations) * np.sin(azimuths), np.sin(elevations) + 0 * azimuths
        return np.stack([np.ravel(coordinate) for coordinate in xyz]).astype(np.float32)

    @cached_property
    def rings(self) -> np.ndarray:
        """Beams (rows * columns,) uint16 of the pixels, row by row."""
        return np.repeat(np.arange(self.shape[0], dtype=np.uint16), self.shape[1])

    @cached_property
    def azimuths_of_pixels_rad(self) -> np.ndarray:
        """Azimuths (rows * columns,) float32 of the pixels, row by row."""
        return np.tile(self.azimuths_rad.astype(np.float32), self.shape[0])


def read_layout(path: str | Path) -> RangeImageLayout:
    """The layout a `velodyne_config.txt` describes.

    One line: multiplier, columns, rows, azimuth of the left and the right border in degrees, then either the first and last
    pitch or one pitch per row in degrees, downwards positive. Lines starting with `#` are comments.

    Raises:
        BadInput: missing, or another number of entries.
    """
    lines = [line.split() for line in read_text(path).splitlines() if line.strip() and not line.lstrip().startswith("#")]
    remedy = "write multiplier, columns, rows, two azimuths and the pitches in one line"
    try:
        entries = [float(word) for word in lines[0]]
        units_per_m, n_columns, n_rows, start_deg, stop_deg = entries[0], int(entries[1]), int(entries[2]), *entries[3:5]
    except (IndexError, ValueError, OverflowError, TypeError) as error:
        raise BadInput(path, "no line that describes a range image", remedy) from error
    if not (units_per_m > 0 and 0 < n_columns < 100_000 and 0 < n_rows < 10_000) or not np.isfinite(entries).all():
        raise BadInput(path, f"{n_columns} columns, {n_rows} rows and multiplier {units_per_m}", remedy)
    pitches_deg = np.array(entries[5:])
    step_deg = (stop_deg - start_deg) / n_columns
    azimuths_deg = start_deg + step_deg * (np.arange(n_columns) + 0.5)
    if len(pitches_deg) == 2 != n_rows:
        step = (pitches_deg[1] - pitches_deg[0]) / n_rows
        pitches_deg = pitches_deg[0] + step * (np.arange(n_rows) + 0.5)
    if len(pitches_deg) != n_rows:
        raise BadInput(path, f"{len(pitches_deg)} pitches for {n_rows} rows", remedy)
    return RangeImageLayout(units_per_m, np.radians(azimuths_deg), -np.radians(pitches_deg))


def read_range_image(path: str | Path, layout: RangeImageLayout) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """The returns of a range image, row by row.

    Returns:
        points (N, 3) float32, metres, frame `lidar`; beams (N,) uint16, row 0 is the highest; azimuths (N,) float32, radians;
        and the share of the columns that hold a return, which is below 1 when packets were lost.

    Raises:
        BadRecord: `unreadable` when it is no picture, not 16-bit grey, or of another size than the layout.
    """
    try:
        data = np.fromfile(path, np.uint8)
        image = cv2.imdecode(data, cv2.IMREAD_UNCHANGED) if len(data) else None
    except (OSError, cv2.error) as error:
        raise BadRecord("unreadable", f"{path}: {error}") from error
    if image is None:
        raise BadRecord("unreadable", f"{path} is no whole picture")
    if image.dtype != np.uint16 or image.shape != layout.shape:
        raise BadRecord("unreadable", f"{path} is {image.dtype} of shape {image.shape}, not uint16 of shape {layout.shape}")
    values = image.ravel()
    pixels = np.flatnonzero(values > 0)
    ranges_m = values.take(pixels).astype(np.float32) / np.float32(layout.units_per_m)
    points = np.empty((len(pixels), 3), np.float32)
    for axis, coordinate in enumerate(layout.directions):
        np.multiply(coordinate.take(pixels), ranges_m, out=points[:, axis])
    return points, layout.rings.take(pixels), layout.azimuths_of_pixels_rad.take(pixels), float(image.any(axis=0).mean())
