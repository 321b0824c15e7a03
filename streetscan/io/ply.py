"""Point clouds as PLY, ASCII or binary of either byte order, every scalar property kept in its own type.

The header is read here and the data by numpy and pandas, because no permissively licensed reader keeps all of it: Open3D
0.20's tensor reader drops char, short, ushort and uint properties (the class ids of TerraMobilita are uint) and returns
uninitialised memory for truncated files and missing coordinates; meshio 5.3 stops at short, trimesh at empty clouds.

Source of the format: Turk, The PLY Polygon File Format (1994).
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from streetscan.clouds import PointCloud, check_points
from streetscan.errors import BadInput
from streetscan.io.xyz import iterate_rows

CHUNK_POINTS = 2_000_000
_TYPES = {
    "char": "i1",
    "uchar": "u1",
    "short": "i2",
    "ushort": "u2",
    "int": "i4",
    "uint": "u4",
    "float": "f4",
    "double": "f8",
    "int8": "i1",
    "uint8": "u1",
    "int16": "i2",
    "uint16": "u2",
    "int32": "i4",
    "uint32": "u4",
    "float32": "f4",
    "float64": "f8",
}
_BYTE_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "="}
_MAX_HEADER_LINES = 1000
_BAD_FILE = "copy or export it again"


@dataclass
class _Element:
    """One element of the header: its name, how many there are, and (name, type) of each property."""

    name: str
    n: int
    properties: list[tuple[str, str]] = field(default_factory=list)
    has_lists: bool = False


@dataclass
class _Header:
    """What a header says: the encoding, the elements, and how long the header is."""

    encoding: str
    elements: list[_Element]
    n_bytes: int
    n_lines: int


def iterate_ply(path: str | Path, chunk_points: int = CHUNK_POINTS) -> Iterator[PointCloud]:
    """The vertices of a PLY file as clouds of at most `chunk_points` points, in file order, in constant memory.

    Args:
        path: the file.
        chunk_points: points per cloud.
    Yields:
        clouds with every other scalar vertex property as a field under its own name and type. Faces are not read.
    Raises:
        BadInput: no such file, not PLY, truncated, no x, y, z, a list among the vertex properties, NaN or infinite
            coordinates, large coordinates in 32-bit floats, no point.
    """
    path = Path(path)
    if not path.is_file():
        raise BadInput(path, "no such file", "check the data set's file and data_root")
    header = _read_header(path)
    vertex, before = _find_vertex(header, path)
    is_binary = header.encoding != "ascii"
    dtype = np.dtype([(name, _BYTE_ORDERS[header.encoding] + code) for name, code in vertex.properties])
    # In ASCII the digits are there whatever type the header gives the coordinates.
    is_float32 = is_binary and any(dtype[axis] == np.float32 for axis in "xyz")
    if vertex.n == 0:
        check_points(np.empty((0, 3)), path)
    chunks = _binary_chunks if is_binary else _ascii_chunks
    n_read = 0
    for columns in chunks(path, header, vertex, before, dtype, chunk_points):
        points = np.stack([columns.pop(axis) for axis in "xyz"], axis=1).astype(np.float64)
        check_points(points, path, is_float32, first=n_read)
        n_read += len(points)
        yield PointCloud(points, columns)
    if n_read != vertex.n:
        raise BadInput(path, f"truncated: {n_read} of {vertex.n} points", _BAD_FILE)


def _read_header(path: Path) -> _Header:
    encoding, elements, n_lines = None, [], 0
    with open(path, "rb") as stream:
        if stream.readline(100).strip() != b"ply":
            raise BadInput(path, "not a PLY file (it does not begin with 'ply')", "check reader.format in the data set's file")
        for n_lines in range(2, _MAX_HEADER_LINES):
            line = stream.readline(10_000).decode("latin-1")
            words = line.split()
            if words == ["end_header"]:
                break
            if not line:
                raise BadInput(path, "truncated: the header has no end", _BAD_FILE)
            try:
                match words:
                    case ["format", name, _]:
                        encoding = name
                    case ["element", name, n]:
                        elements.append(_Element(name, int(n)))
                    case ["property", "list", _, _, _]:
                        elements[-1].has_lists = True
                    case ["property", kind, name]:
                        elements[-1].properties.append((name, _TYPES[kind]))
                    case [] | ["comment" | "obj_info", *_]:
                        pass
                    case _:
                        raise ValueError
            except (ValueError, KeyError, IndexError) as error:
                raise BadInput(path, f"line {n_lines} of the header is not PLY ('{line.strip()[:60]}')", _BAD_FILE) from error
        else:
            raise BadInput(path, f"the header has no end within {_MAX_HEADER_LINES} lines", _BAD_FILE)
        if encoding not in _BYTE_ORDERS:
            raise BadInput(path, f"unknown PLY format '{encoding}'", "export it as ascii or binary_little_endian")
        return _Header(encoding, elements, stream.tell(), n_lines)


def _find_vertex(header: _Header, path: Path) -> tuple[_Element, list[_Element]]:
    """The vertex element and the elements stored before it."""
    names = [element.name for element in header.elements]
    if "vertex" not in names:
        raise BadInput(path, "has no element 'vertex'", "export it as a point cloud")
    i = names.index("vertex")
    vertex, before = header.elements[i], header.elements[:i]
    properties = [name for name, _ in vertex.properties]
    for axis in "xyz":
        if axis not in properties:
            raise BadInput(path, f"the vertices have no property '{axis}' (they have {', '.join(properties)})", "export it with x, y, z")
    if len(set(properties)) != len(properties):
        raise BadInput(path, "two vertex properties have the same name", "export it with a name for each")
    if vertex.has_lists or any(element.has_lists for element in before):
        raise BadInput(path, "has list properties among or before its vertices", "export it as a point cloud, without faces")
    return vertex, before


def _binary_chunks(path, header, vertex, before, dtype, chunk_points) -> Iterator[dict[str, np.ndarray]]:
    with open(path, "rb") as stream:
        stream.seek(header.n_bytes + sum(e.n * sum(np.dtype(code).itemsize for _, code in e.properties) for e in before))
        n_left = vertex.n
        while n_left:
            records = np.fromfile(stream, dtype, min(chunk_points, n_left))
            if len(records) == 0:
                return
            n_left -= len(records)
            yield {name: np.ascontiguousarray(records[name], dtype[name].newbyteorder("=")) for name in dtype.names}


def _ascii_chunks(path, header, vertex, before, dtype, chunk_points) -> Iterator[dict[str, np.ndarray]]:
    n_skipped = header.n_lines + sum(element.n for element in before)
    for rows in iterate_rows(path, dtype.names, n_header_rows=n_skipped, chunk_rows=chunk_points, n_rows=vertex.n):
        # Every PLY integer fits a float64; coordinates keep all their digits.
        yield {name: rows[:, i] if name in "xyz" else _cast(rows[:, i], dtype[name], name, path) for i, name in enumerate(dtype.names)}


def _cast(values: np.ndarray, dtype: np.dtype, name: str, path: Path) -> np.ndarray:
    """Values (N,) float64 in the type the header gives them. BadInput where an integer type cannot hold one."""
    if dtype.kind in "iu":
        fits = (values >= np.iinfo(dtype).min) & (values <= np.iinfo(dtype).max)
        if not fits.all():
            found = f"property '{name}' holds {values[np.argmin(fits)]:g}, which its type {dtype.name} cannot"
            raise BadInput(path, found, "export it with a type that can")
    return values.astype(dtype)
