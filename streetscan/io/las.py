"""Point clouds as LAS/LAZ, through laspy.

We write LAS 1.4, point format 6 (7 with colour), millimetre steps, the CRS kept, `label` and `confidence` (and any
other field the format has no place for) as extra dimensions, and the classes as LAS codes.
"""

import struct
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import laspy
import lazrs
import numpy as np
import pyproj

from streetscan.classes import las_codes
from streetscan.clouds import PointCloud, concatenate
from streetscan.errors import BadInput
from streetscan.io.arrays import load_npy
from streetscan.io.atomic import atomic_path

SCALE_M = 0.001
CHUNK_POINTS = 2_000_000
# Our name to the format's own; every other field becomes an extra dimension of its own name.
_STANDARD = {"intensity": "intensity", "time_s": "gps_time", "return_number": "return_number", "n_returns": "number_of_returns"}
# laspy and its backend let through whatever the parsing of a damaged file raises.
_READ_ERRORS = (
    *(laspy.errors.LaspyException, lazrs.LazrsError, pyproj.exceptions.CRSError, struct.error, EOFError, OSError),
    *(ValueError, IndexError, KeyError, OverflowError, MemoryError),
)
_SKIPPED = {"X", "Y", "Z", "red", "green", "blue", *_STANDARD.values()}


# What a position takes: the format keeps every field apart, and the others need not be unpacked.
_POSITIONS = laspy.DecompressionSelection.base() | laspy.DecompressionSelection.Z


def iterate_las(path: str | Path, chunk_points: int = CHUNK_POINTS, with_fields: bool = True) -> Iterator[PointCloud]:
    """A LAS/LAZ file as clouds of at most `chunk_points` points, in file order, in constant memory.

    Args:
        path: the file.
        chunk_points: points per cloud.
        with_fields: False reads the positions alone, which takes half the time.
    Yields:
        clouds with these fields: `intensity`, `time_s` (gps_time), `rgb` (N, 3) uint8, `return_number`, `n_returns` and
        `classification` where the point format has them, and the extra dimensions under their own names.
    Raises:
        BadInput: no such file, not LAS/LAZ, or truncated.
    """
    path = Path(path)
    if not path.is_file():
        raise BadInput(path, "no such file", "check the data set's file and data_root")
    n_read = 0
    has_16_bit_colour = False
    try:
        with laspy.open(path, decompression_selection=laspy.DecompressionSelection.all() if with_fields else _POSITIONS) as reader:
            crs = reader.header.parse_crs()
            crs = None if crs is None else _crs_string(crs)
            if path.stat().st_size < reader.header.offset_to_point_data:
                raise EOFError("the file ends within its header")
            for record in reader.chunk_iterator(chunk_points):
                n_read += len(record)
                # Some writers store 8-bit colours in the 16-bit fields; one value above 255 shows that this one does not.
                has_16_bit_colour = has_16_bit_colour or (with_fields and _largest_colour(record) > 255)
                yield _cloud_of_record(record, crs, has_16_bit_colour) if with_fields else PointCloud(_points_of_record(record), {}, crs)
            n_promised = reader.header.point_count
    except _READ_ERRORS as error:
        raise BadInput(path, f"not a complete LAS/LAZ file ({error})", "copy or export it again") from error
    if n_read != n_promised:
        raise BadInput(path, f"truncated: {n_read} of {n_promised} points", "copy or export it again")


def read_las(path: str | Path) -> PointCloud:
    """A whole LAS/LAZ file; see `iterate_las`. An empty file gives an empty cloud."""
    clouds = list(iterate_las(path))
    return concatenate(clouds) if clouds else PointCloud(np.empty((0, 3)))


def iterate_labelled_las(path: str | Path, labels_path: str | Path, with_fields: bool = True) -> Iterator[tuple[PointCloud, np.ndarray]]:
    """A LAS/LAZ file as clouds together with their points' labels, in constant memory.

    Args:
        path: LAS/LAZ file of N points.
        labels_path: `.npy` with (N,) uint8 labels in the file's order, 255 unlabelled.
        with_fields: see `iterate_las`.
    Yields:
        a cloud and its (n,) labels.
    Raises:
        BadInput: as `iterate_las`, or the labels are not those of this file.
    """
    labels = load_npy(labels_path, "the step that wrote it", count_points(path))
    n_read = 0
    for cloud in iterate_las(path, with_fields=with_fields):
        yield cloud, labels[n_read : n_read + len(cloud)]
        n_read += len(cloud)


def count_points(path: str | Path) -> int:
    """The number of points the header of a LAS/LAZ file promises. BadInput when it is no such file."""
    return _read_header(path).point_count


def read_crs(path: str | Path) -> str | None:
    """The coordinate reference system of a LAS/LAZ file, None when it has none. BadInput when it is no such file."""
    crs = _read_header(path).parse_crs()
    return None if crs is None else _crs_string(crs)


class LasWriter:
    """Appends clouds to an open LAZ file; made by `open_las_writer`."""

    def __init__(self, path: Path, crs: str | None):
        self._path, self._crs, self._writer, self._names, self._empty = path, crs, None, (), None

    def write(self, cloud: PointCloud) -> None:
        """Append a cloud. The first one fixes the fields of the file and its coordinate offset.

        Raises:
            ValueError: a later cloud lacks a field of the first; coordinates are NaN or infinite; an `intensity` is
                outside 0..65535 (fractions are rounded).
            BadInput: the points span more than the format's 32-bit millimetres hold (2 147 km).
        """
        if not np.isfinite(cloud.points).all():
            raise ValueError("NaN or infinite coordinates cannot be stored as LAZ")
        if self._writer is None and len(cloud) == 0:
            # It has the fields but no place for the offset; large coordinates would not fit a file opened now.
            self._empty = cloud
            return
        if self._writer is None:
            self._open(cloud)
        if missing := set(self._names) - set(cloud.fields):
            raise ValueError(f"cloud without the fields {sorted(missing)} the file was opened with")
        header = self._writer.header
        record = laspy.ScaleAwarePointRecord.zeros(len(cloud), header=header)
        try:
            record.x, record.y, record.z = cloud.points.T
        except OverflowError as error:
            span = f"{cloud.points.min(axis=0)} to {cloud.points.max(axis=0)} m"
            raise BadInput(self._path, f"points lie 2 147 km or more apart ({span})", "remove stray points or split the map") from error
        for name in self._names:
            values = cloud.fields[name]
            if name == "rgb":
                for i, channel in enumerate(("red", "green", "blue")):
                    record[channel] = values[:, i].astype(np.uint16) * 257
            else:
                record[_STANDARD.get(name, name)] = _intensities(values) if name == "intensity" else values
        if "label" in self._names:
            record["classification"] = las_codes(cloud.fields["label"])
        self._writer.write_points(record)

    def _open(self, cloud: PointCloud) -> None:
        header = laspy.LasHeader(version="1.4", point_format=7 if "rgb" in cloud.fields else 6)
        header.generating_software = "streetscan"
        header.scales = np.full(3, SCALE_M)
        # Whole kilometres keep the stored integers small and the offset the same for neighbouring files.
        header.offsets = np.floor(cloud.points.min(axis=0) / 1000) * 1000 if len(cloud) else np.zeros(3)
        if self._crs is not None:
            header.add_crs(pyproj.CRS.from_user_input(self._crs))
        self._names = tuple(cloud.fields)
        for name, values in cloud.fields.items():
            if name not in _STANDARD and name not in ("rgb", "classification"):
                header.add_extra_dim(laspy.ExtraBytesParams(name=name, type=_dimension_type(values)))
        self._writer = laspy.open(self._path, mode="w", header=header, do_compress=True, laz_backend=laspy.LazBackend.Lazrs)

    def close(self) -> None:
        """Finish the file; a file nothing or only empty clouds were written to holds no points."""
        if self._writer is None:
            self._open(PointCloud(np.empty((0, 3))) if self._empty is None else self._empty)
        self._writer.close()

    def abort(self) -> None:
        """Let go of the unfinished file; what finishing it would complain about matters no more."""
        if self._writer is not None:
            with suppress(Exception):
                self._writer.close()


@contextmanager
def open_las_writer(path: str | Path, crs: str | None = None) -> Iterator[LasWriter]:
    """A writer that streams clouds into a LAZ file; the file appears when the block ends without an error."""
    with atomic_path(path) as partial:
        writer = LasWriter(partial, crs)
        try:
            yield writer
        except BaseException:
            writer.abort()
            raise
        writer.close()


def write_las(path: str | Path, cloud: PointCloud) -> None:
    """Write one cloud as LAZ, all fields kept."""
    with open_las_writer(path, cloud.crs) as writer:
        writer.write(cloud)


def _read_header(path: str | Path) -> laspy.LasHeader:
    if not Path(path).is_file():
        raise BadInput(path, "no such file", "check the data set's file and data_root")
    try:
        with laspy.open(path) as reader:
            return reader.header
    except _READ_ERRORS as error:
        raise BadInput(path, f"not a complete LAS/LAZ file ({error})", "copy or export it again") from error


def _crs_string(crs: pyproj.CRS) -> str:
    authority = crs.to_authority()
    return ":".join(authority) if authority else crs.to_wkt()


def _intensities(values: np.ndarray) -> np.ndarray:
    """Values rounded to uint16; ValueError when one does not fit."""
    if len(values) and not (np.min(values) >= 0 and np.max(values) <= 65535):  # said so that NaN fails too
        raise ValueError(f"'intensity' must lie in 0..65535, found {np.min(values)}..{np.max(values)}")
    return np.rint(values).astype(np.uint16)


def _dimension_type(values: np.ndarray) -> str:
    """The type of an extra dimension as laspy names it: `f4`, or `3f4` for three columns. bool is stored as uint8."""
    code = "u1" if values.dtype == bool else values.dtype.str[1:]
    return f"{values.shape[1]}{code}" if values.ndim > 1 else code


def _largest_colour(record: laspy.ScaleAwarePointRecord) -> int:
    if "red" not in set(record.point_format.dimension_names) or len(record) == 0:
        return 0
    return max(int(np.max(record[channel])) for channel in ("red", "green", "blue"))


def _cloud_of_record(record: laspy.ScaleAwarePointRecord, crs: str | None, has_16_bit_colour: bool) -> PointCloud:
    names = set(record.point_format.dimension_names)
    fields = {ours: np.asarray(record[theirs]) for ours, theirs in _STANDARD.items() if theirs in names}
    if "red" in names:
        rgb = np.stack([np.asarray(record[c]) for c in ("red", "green", "blue")], axis=1)
        fields["rgb"] = (rgb >> 8 if has_16_bit_colour else rgb).astype(np.uint8)
    # In the file's order: a set's order changes from run to run, and with it the bytes of every file written from these fields.
    wanted = ["classification", *record.point_format.extra_dimension_names]
    fields |= {name: np.asarray(record[name]) for name in wanted if name not in _SKIPPED}
    return PointCloud(_points_of_record(record), fields, crs)


def _points_of_record(record: laspy.ScaleAwarePointRecord) -> np.ndarray:
    return np.stack([np.asarray(record.x), np.asarray(record.y), np.asarray(record.z)], axis=1)
