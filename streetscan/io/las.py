"""Point clouds as LAS/LAZ, through laspy.

We write LAS 1.4, point format 6 (7 with colour), millimetre steps, the CRS kept, `label` and `confidence` (and any
other field the format has no place for) as extra dimensions, and the classes as LAS codes.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import laspy
import lazrs
import numpy as np
import pyproj

from streetscan.classes import las_codes
from streetscan.clouds import PointCloud, concatenate
from streetscan.errors import BadInput
from streetscan.io.atomic import atomic_path

SCALE_M = 0.001
CHUNK_POINTS = 2_000_000
# Our name to the format's own; every other field becomes an extra dimension of its own name.
_STANDARD = {"intensity": "intensity", "time_s": "gps_time", "return_number": "return_number", "n_returns": "number_of_returns"}
_SKIPPED = {"X", "Y", "Z", "red", "green", "blue", *_STANDARD.values()}


def iterate_las(path: str | Path, chunk_points: int = CHUNK_POINTS) -> Iterator[PointCloud]:
    """A LAS/LAZ file as clouds of at most `chunk_points` points, in file order, in constant memory.

    Args:
        path: the file.
        chunk_points: points per cloud.
    Yields:
        clouds with every dimension of the file as a field: `intensity`, `time_s` (gps_time), `rgb` (N, 3) uint8,
        `return_number`, `n_returns`, `classification`, and the extra dimensions under their own names.
    Raises:
        BadInput: no such file, not LAS/LAZ, or truncated.
    """
    path = Path(path)
    if not path.is_file():
        raise BadInput(path, "no such file", "check the data set's file and data_root")
    try:
        with laspy.open(path) as reader:
            crs = reader.header.parse_crs()
            crs = None if crs is None else _crs_string(crs)
            n_read = 0
            for record in reader.chunk_iterator(chunk_points):
                n_read += len(record)
                yield _cloud_of_record(record, crs)
            n_promised = reader.header.point_count
    except (laspy.errors.LaspyException, lazrs.LazrsError, ValueError, EOFError, OSError) as error:
        raise BadInput(path, f"not a complete LAS/LAZ file ({error})", "copy or export it again") from error
    if n_read != n_promised:
        raise BadInput(path, f"truncated: {n_read} of {n_promised} points", "copy or export it again")


def read_las(path: str | Path) -> PointCloud:
    """A whole LAS/LAZ file; see `iterate_las`. An empty file gives an empty cloud."""
    clouds = list(iterate_las(path))
    return concatenate(clouds) if clouds else PointCloud(np.empty((0, 3)))


def count_points(path: str | Path) -> int:
    """The number of points the header of a LAS/LAZ file promises."""
    with laspy.open(path) as reader:
        return reader.header.point_count


class LasWriter:
    """Appends clouds to an open LAZ file; made by `open_las_writer`."""

    def __init__(self, path: Path, crs: str | None):
        self._path, self._crs, self._writer, self._names = path, crs, None, ()

    def write(self, cloud: PointCloud) -> None:
        """Append a cloud. The first one fixes the fields of the file and its coordinate offset.

        Raises:
            ValueError: a later cloud lacks a field of the first.
        """
        if self._writer is None:
            self._open(cloud)
        if missing := set(self._names) - set(cloud.fields):
            raise ValueError(f"cloud without the fields {sorted(missing)} the file was opened with")
        header = self._writer.header
        record = laspy.ScaleAwarePointRecord.zeros(len(cloud), header=header)
        record.x, record.y, record.z = cloud.points.T
        for name in self._names:
            values = cloud.fields[name]
            if name == "rgb":
                for i, channel in enumerate(("red", "green", "blue")):
                    record[channel] = values[:, i].astype(np.uint16) * 257
            else:
                record[_STANDARD.get(name, name)] = values
        if "label" in self._names:
            record["classification"] = las_codes(cloud.fields["label"])
        self._writer.write_points(record)

    def _open(self, cloud: PointCloud) -> None:
        header = laspy.LasHeader(version="1.4", point_format=7 if "rgb" in cloud.fields else 6)
        header.scales = np.full(3, SCALE_M)
        # Whole kilometres keep the stored integers small and the offset the same for neighbouring files.
        header.offsets = np.floor(cloud.points.min(axis=0) / 1000) * 1000 if len(cloud) else np.zeros(3)
        if self._crs is not None:
            header.add_crs(pyproj.CRS.from_user_input(self._crs))
        self._names = tuple(cloud.fields)
        for name, values in cloud.fields.items():
            if name not in _STANDARD and name not in ("rgb", "classification"):
                header.add_extra_dim(laspy.ExtraBytesParams(name=name, type=values.dtype))
        self._writer = laspy.open(self._path, mode="w", header=header, do_compress=True, laz_backend=laspy.LazBackend.Lazrs)

    def close(self) -> None:
        """Finish the file; a file nothing was written to holds no points."""
        if self._writer is None:
            self._open(PointCloud(np.empty((0, 3))))
        self._writer.close()


@contextmanager
def open_las_writer(path: str | Path, crs: str | None = None) -> Iterator[LasWriter]:
    """A writer that streams clouds into a LAZ file; the file appears when the block ends without an error."""
    with atomic_path(path) as partial:
        writer = LasWriter(partial, crs)
        try:
            yield writer
        finally:
            writer.close()


def write_las(path: str | Path, cloud: PointCloud) -> None:
    """Write one cloud as LAZ, all fields kept."""
    with open_las_writer(path, cloud.crs) as writer:
        writer.write(cloud)


def _crs_string(crs: pyproj.CRS) -> str:
    authority = crs.to_authority()
    return ":".join(authority) if authority else crs.to_wkt()


def _cloud_of_record(record: laspy.ScaleAwarePointRecord, crs: str | None) -> PointCloud:
    names = set(record.point_format.dimension_names)
    fields = {ours: np.asarray(record[theirs]) for ours, theirs in _STANDARD.items() if theirs in names}
    if "red" in names:
        rgb = np.stack([np.asarray(record[c]) for c in ("red", "green", "blue")], axis=1)
        # Some writers store 8-bit colours in the 16-bit fields.
        fields["rgb"] = (rgb >> 8 if rgb.size and rgb.max() > 255 else rgb).astype(np.uint8)
    wanted = {"classification"} | set(record.point_format.extra_dimension_names)
    fields |= {name: np.asarray(record[name]) for name in wanted - _SKIPPED}
    points = np.stack([np.asarray(record.x), np.asarray(record.y), np.asarray(record.z)], axis=1)
    return PointCloud(points, fields, crs)
