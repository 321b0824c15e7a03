"""Maps as Autoware loads them: square PCD tiles, a YAML that says where each lies, and the frame they are in.

Source: Autoware's map loader, pages `pointcloud_map_metadata.yaml` and `map_projector_info.yaml`: tiles parallel to the axes, all of one
size, without overlap, about 20 m wide; each entry is the tile's lower corner.
"""

import shutil
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import yaml

from streetscan.clouds import PointCloud
from streetscan.errors import BadInput
from streetscan.io.atomic import atomic_folder

# x, y, z and intensity, float32.
_POINT = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4")])


def write_autoware_map(folder: str | Path, clouds: Iterable[PointCloud], tile_m: float, where: object) -> int:
    """Write a map as tiles `<i>_<j>.pcd`, `pointcloud_map_metadata.yaml` and `map_projector_info.yaml`; memory is that of one cloud.

    PCD holds float32, which steps by decimetres at UTM coordinates. So the tiles are relative to the first point's place, rounded down to
    whole kilometres (height: 100 m), and `origin.yaml` says which place that is.

    Args:
        folder: the map; it replaces what is there.
        clouds: the points, frame `map`; intensity is written where they have it.
        tile_m: edge of a tile.
        where: the map, named in errors.
    Returns:
        the number of tiles.
    Raises:
        BadInput: the edge is not above 0, or there is no point.
    """
    if not tile_m > 0:
        raise BadInput("export_autoware_map.tile_m", f"{tile_m} is not above 0", "give the edge of a tile in metres, such as 20")
    origin, crs, counts = None, None, {}
    with atomic_folder(folder) as partial:
        spool = partial / "spool"
        spool.mkdir()
        for cloud in clouds:
            if len(cloud) == 0:
                continue
            if origin is None:
                origin, crs = np.floor(cloud.points[0] / [1000.0, 1000.0, 100.0]) * [1000.0, 1000.0, 100.0], cloud.crs
            local = cloud.points - origin
            packed = np.zeros(len(cloud), _POINT)
            for axis, name in enumerate("xyz"):
                packed[name] = local[:, axis]
            packed["intensity"] = cloud.fields.get("intensity", packed["intensity"])
            tiles = np.floor(local[:, :2] / tile_m).astype(np.int64)
            names, inverse = np.unique(tiles, axis=0, return_inverse=True)
            for k, name in enumerate(map(tuple, names)):
                part = packed[inverse.reshape(-1) == k]
                counts[name] = counts.get(name, 0) + len(part)
                with (spool / f"{name[0]}_{name[1]}.bin").open("ab") as stream:
                    stream.write(part.tobytes())
        if origin is None:
            raise BadInput(where, "holds no point", "give a map with points")
        metadata = {"x_resolution": float(tile_m), "y_resolution": float(tile_m)}
        for name in sorted(counts):
            file = f"{name[0]}_{name[1]}"
            with (partial / f"{file}.pcd").open("wb") as stream, (spool / f"{file}.bin").open("rb") as points:
                stream.write(_header(counts[name]).encode())
                shutil.copyfileobj(points, stream)
            metadata[f"{file}.pcd"] = [float(n * tile_m) for n in name]
        shutil.rmtree(spool)
        _write_yaml(partial / "pointcloud_map_metadata.yaml", metadata)
        _write_yaml(partial / "map_projector_info.yaml", {"projector_type": "Local"})
        _write_yaml(partial / "origin.yaml", {"crs": crs, "x_m": float(origin[0]), "y_m": float(origin[1]), "z_m": float(origin[2])})
    return len(counts)


def _header(n: int) -> str:
    return (
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS x y z intensity\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 1\n"
        f"WIDTH {n}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {n}\nDATA binary\n"
    )


def _write_yaml(path: Path, values: dict) -> None:
    path.write_text(yaml.safe_dump(values, sort_keys=False, default_flow_style=None))
