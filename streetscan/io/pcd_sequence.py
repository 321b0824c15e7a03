"""Lidar frames as a sequence of PCD files, one per revolution (Józsa and Benedek 2013, 2.4)."""

import struct
from pathlib import Path

import numpy as np
import pypcd4

from streetscan.frames import BadRecord, LidarFrame

_DTYPES = {"x": np.float32, "y": np.float32, "z": np.float32, "intensity": np.float32, "ring": np.uint16, "time_offset_s": np.float32}


def read_pcd_columns(path: str | Path) -> dict[str, np.ndarray]:
    """The fields of a PCD file by name; points without a return keep their NaN.

    Raises:
        BadRecord: `truncated` when points are missing, `unreadable` when it is no PCD.
    """
    try:
        cloud = pypcd4.PointCloud.from_path(path)
        records = np.atleast_1d(cloud.pc_data)
        n_promised = cloud.metadata.points
    # pypcd4 lets through whatever the parsing of a damaged file raises.
    except Exception as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        status = "truncated" if isinstance(error, (EOFError, struct.error)) or "buffer" in reason else "unreadable"
        raise BadRecord(status, f"{path}: {reason}") from error
    if len(records) != n_promised:
        raise BadRecord("truncated", f"{path}: {len(records)} of {n_promised} points")
    return {name: records[name] for name in records.dtype.names if "#$%&" not in name}


def write_pcd_frame(path: str | Path, frame: LidarFrame) -> None:
    """One frame as binary PCD with x, y, z and, as the frame has them, intensity, ring and time_offset_s."""
    columns = {"x": frame.points[:, 0], "y": frame.points[:, 1], "z": frame.points[:, 2]}
    columns |= {n: getattr(frame, n) for n in ("intensity", "ring", "time_offset_s") if getattr(frame, n) is not None}
    types = [_DTYPES[name] for name in columns]
    values = [np.ascontiguousarray(v, t) for v, t in zip(columns.values(), types, strict=True)]
    cloud = pypcd4.PointCloud.from_points(values, list(columns), types)
    cloud.save(str(path), pypcd4.Encoding.BINARY)
