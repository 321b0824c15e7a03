"""Point clouds as PCD (ASCII, binary, compressed), through pypcd4."""

import struct
from pathlib import Path

import numpy as np
import pypcd4

from streetscan.clouds import PointCloud, check_points
from streetscan.errors import BadInput


def read_pcd(path: str | Path) -> PointCloud:
    """A PCD file; the format's library reads it whole.

    Args:
        path: the file.
    Returns:
        the cloud, with every field but x, y, z under its own name and type; PCL's packed `rgb` or `rgba` also as red, green, blue.
    Raises:
        BadInput: no such file, not PCD, truncated, no x, y, z, NaN or infinite coordinates (PCD's mark of a missing
            return), large coordinates in 32-bit floats, no point.
    """
    path = Path(path)
    if not path.is_file():
        raise BadInput(path, "no such file", "check the data set's file and data_root")
    try:
        cloud = pypcd4.PointCloud.from_path(path)
        records = np.atleast_1d(cloud.pc_data)
    # pypcd4 lets through whatever the parsing of a damaged file raises.
    except (ValueError, KeyError, IndexError, TypeError, AttributeError, RuntimeError, EOFError, struct.error, OSError) as error:
        raise BadInput(path, "not a complete PCD file: header and data do not fit", "copy or export it again") from error
    if len(records) != cloud.metadata.points:
        raise BadInput(path, f"truncated: {len(records)} of {cloud.metadata.points} points", "copy or export it again")
    names = records.dtype.names
    for axis in "xyz":
        if axis not in names:
            raise BadInput(path, f"has no field '{axis}' (it has {', '.join(names)})", "export it with x, y, z")
    points = np.stack([records[axis] for axis in "xyz"], axis=1).astype(np.float64)
    check_points(points, path, stored_as_float32=any(records.dtype[axis] == np.float32 for axis in "xyz"))
    # A field named `_` is padding; pypcd4 renames it with these characters.
    fields = {name: np.ascontiguousarray(records[name]) for name in names if name not in ("x", "y", "z") and "#$%&" not in name}
    for name in ("rgb", "rgba"):
        if name in fields and fields[name].ndim == 1 and fields[name].dtype.itemsize == 4 and "red" not in fields:
            # Bytes blue, green, red, alpha from the lowest; PCL stores them in a float or an integer.
            packed = fields[name].view(np.uint32)
            fields |= {colour: (packed >> shift & 255).astype(np.uint8) for colour, shift in (("red", 16), ("green", 8), ("blue", 0))}
    return PointCloud(points, fields)
