"""Clouds of foreign data sets: one reader for every format, fields under our own names, class ids beside them."""

import logging
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from streetscan.clouds import PointCloud, check_points
from streetscan.errors import BadInput

logger = logging.getLogger(__name__)
FORMATS = ("las", "ply", "pcd", "text")
# Fields that get a type of their own; every other keeps the type it has in the file.
_TYPES = {"time_s": np.float64, "return_number": np.uint8, "n_returns": np.uint8}
_MAX_RETURNS = 15  # four bits in LAS
_MAX_INTENSITY = 65535
# They would put truth, or what only our own steps write, into the map, or stand in LAZ under a meaning of their own.
_RESERVED = {
    *("x", "y", "z", "red", "green", "blue", "label", "confidence", "classification", "classification_flags", "synthetic", "key_point"),
    *("withheld", "overlap", "scanner_channel", "scan_direction_flag", "edge_of_flight_line", "number_of_returns", "user_data"),
    *("scan_angle", "point_source_id", "gps_time"),
}


@dataclass(frozen=True)
class Reader:
    """How a data set stores its clouds.

    Attributes:
        format: `las` (LAZ too), `ply`, `pcd` or `text`.
        fields: fields to keep, our name to the name in the file; `rgb` to three names, or to `rgb` in LAS.
        label: the field that holds the class ids, or None.
        label_suffix: the suffix of text files beside the clouds that hold the class ids, one a line, or None.
        intensity_range: values of the file's intensity that become 0 and 65535, or None when it is in 0..65535 already.
        offset_m: added to x, y, z, in metres: what was subtracted before the file was written.
        spacing_m: how far each next file of a part is moved along x, for scans in frames of their own; 0 for one frame.
        columns: names of the columns of text.
        delimiter: what separates columns of text; None is white space.
        comment: what begins a comment in text, or None.
        n_header_rows: lines of text before the data.
    """

    format: str
    fields: dict[str, str | list[str]] = field(default_factory=dict)
    label: str | None = None
    label_suffix: str | None = None
    intensity_range: tuple[float, float] | None = None
    offset_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    spacing_m: float = 0.0
    columns: tuple[str, ...] = ()
    delimiter: str | None = None
    comment: str | None = None
    n_header_rows: int = 0

    def __post_init__(self):
        if self.format not in FORMATS:
            raise BadInput("reader.format", f"'{self.format}' is no format we read", f"use one of {', '.join(FORMATS)}")
        if self.label is not None and self.label_suffix is not None:
            raise BadInput("reader", "names both label and label_suffix", "set the one that holds the class ids and null the other")
        for name, source in self.fields.items():
            if name in _RESERVED:
                raise BadInput(f"reader.fields.{name}", "is a name the map keeps for itself", "give the field another name")
            if not re.fullmatch(r"[a-z][a-z0-9_]{0,31}", name):
                remedy = "use at most 32 small letters, digits and underscores"
                raise BadInput(f"reader.fields.{name}", "is a name LAZ cannot hold", remedy)
            if self.label is not None and self.label in ([source] if isinstance(source, str) else source):
                raise BadInput(f"reader.fields.{name}", "would put the true labels into the map", "remove it; labels go to truth/")

        if self.intensity_range is not None and not self.intensity_range[0] < self.intensity_range[1]:
            found = f"is {list(self.intensity_range)}"
            raise BadInput("reader.intensity_range", found, "give the lowest and the highest intensity, such as [0, 1]")
        if self.delimiter == "":
            raise BadInput("reader.delimiter", "is empty", 'give a character such as ",", or null for white space')

    @property
    def has_labels(self) -> bool:
        """Whether the clouds come with class ids."""
        return self.label is not None or self.label_suffix is not None


def iterate_clouds(path: str | Path, reader: Reader) -> Iterator[tuple[PointCloud, np.ndarray | None]]:
    """A foreign file as clouds in file order; only PCD is held in memory whole.

    Args:
        path: the file.
        reader: how it is stored.
    Yields:
        a cloud with the fields `reader` keeps, and its (n,) int64 class ids, None without labels.
    Raises:
        BadInput: what the format's module refuses; a field or the label is missing; class ids that are no integers, or
            not as many as points; colours outside 0..255; an intensity that does not fit its range.
    """
    labels_file = None
    if reader.label_suffix is not None:
        from streetscan.io.labels import LabelsFile, find_labels_file

        labels_file = LabelsFile(find_labels_file(path, reader.label_suffix))
    for i, cloud in enumerate(_iterate_native(path, reader)):
        if i == 0:
            _log_left_out(cloud, reader, path)
        class_ids = None
        if labels_file is not None:
            class_ids = _integers(labels_file.take(len(cloud)), path, "class id")
        elif reader.label is not None:
            class_ids = _integers(_native_field(cloud, reader.label, path), path, "class id")
        fields = {name: _own_field(name, source, cloud, reader, path) for name, source in reader.fields.items()}
        yield PointCloud(cloud.points + np.asarray(reader.offset_m), fields, cloud.crs), class_ids
    if labels_file is not None:
        labels_file.finish()


def _iterate_native(path: str | Path, reader: Reader) -> Iterator[PointCloud]:
    # Imported where needed: a job loads only the library of its own format.
    match reader.format:
        case "las":
            from streetscan.io.las import iterate_las

            n_read = 0
            for cloud in iterate_las(path):
                check_points(cloud.points, path, first=n_read)
                n_read += len(cloud)
                yield cloud
            if n_read == 0:
                check_points(np.empty((0, 3)), path)
        case "ply":
            from streetscan.io.ply import iterate_ply

            yield from iterate_ply(path)
        case "pcd":
            from streetscan.io.pcd import read_pcd

            yield read_pcd(path)
        case "text":
            from streetscan.io.xyz import iterate_xyz

            yield from iterate_xyz(path, reader.columns, reader.delimiter, reader.comment, reader.n_header_rows)


def _log_left_out(cloud: PointCloud, reader: Reader, path: str | Path) -> None:
    taken = {reader.label}.union(*([source] if isinstance(source, str) else source for source in reader.fields.values()))
    left_out = [name for name in cloud.fields if name not in taken]
    if left_out:
        logger.info("%s: the map leaves out %s; name in reader.fields what it should keep", path, ", ".join(left_out))


def _native_field(cloud: PointCloud, name: str, path: str | Path) -> np.ndarray:
    if name not in cloud.fields:
        held = ", ".join(cloud.fields) or "only x, y, z"
        raise BadInput(path, f"has no field '{name}' (it has {held})", "mend reader.label or reader.fields in the data set's file")
    return cloud.fields[name]


def _own_field(name: str, source: str | list[str], cloud: PointCloud, reader: Reader, path: str | Path) -> np.ndarray:
    """A kept field in our type."""
    if isinstance(source, str):
        values = _native_field(cloud, source, path)
    else:
        values = np.stack([_native_field(cloud, channel, path) for channel in source], axis=1)
    if name == "rgb":
        if values.ndim != 2 or values.shape[1] != 3:
            raise BadInput(path, f"'{source}' is not three colours", "name the three colour fields in reader.fields.rgb")
        return _integers(values, path, "colour", 0, 255).astype(np.uint8)
    if name == "intensity":
        return _scaled_intensity(values, reader.intensity_range, path)
    if name in ("return_number", "n_returns"):
        return _integers(values, path, name, 0, _MAX_RETURNS).astype(np.uint8)
    return values.astype(_TYPES.get(name, values.dtype))


def _scaled_intensity(values: np.ndarray, bounds: tuple[float, float] | None, path: str | Path) -> np.ndarray:
    if bounds is None:
        return _integers(values, path, "intensity", 0, _MAX_INTENSITY, "give reader.intensity_range in the data set's file").astype(
            np.uint16
        )
    low, high = bounds
    # Stray values beyond the range are clipped: intensity has no unit and no method of ours reads it as a measurement.
    scaled = (np.clip(np.nan_to_num(values.astype(np.float64), nan=low), low, high) - low) / (high - low)
    return np.rint(scaled * _MAX_INTENSITY).astype(np.uint16)


def _integers(
    values: np.ndarray,
    path: str | Path,
    what: str,
    low: int = -(2**53),
    high: int = 2**53,
    remedy: str = "mend the file, or reader.label and reader.fields in the data set's file",
) -> np.ndarray:
    """Values as int64; BadInput for the first that is no integer or lies outside low..high."""
    is_good = (values >= low) & (values <= high) & (values == np.floor(values))
    if not is_good.all():
        raise BadInput(path, f"holds the {what} {values[~is_good][0]}, which is no integer in {low}..{high}", remedy)
    return values.astype(np.int64)
