"""GPS positions and headings in the axes of a map's projected coordinate reference system, through pyproj."""

import numpy as np
import pyproj

from streetscan import geometry
from streetscan.errors import BadInput


def project(latitude_deg: np.ndarray, longitude_deg: np.ndarray, crs: str, where: object = "crs") -> np.ndarray:
    """Easting and northing (N, 2) in metres of WGS 84 positions (N,).

    Raises:
        BadInput: pyproj does not know the CRS, or it is not a projected one in metres.
    """
    system = projected_crs(crs, where)
    to_grid = pyproj.Transformer.from_crs("EPSG:4326", system, always_xy=True)
    return np.stack(to_grid.transform(np.asarray(longitude_deg, np.float64), np.asarray(latitude_deg, np.float64)), axis=-1)


def unproject(positions: np.ndarray, crs: str, where: object = "crs") -> tuple[np.ndarray, np.ndarray]:
    """Latitudes and longitudes (N,) in WGS 84 degrees of eastings and northings (N, 2) in metres; BadInput like project."""
    to_degrees = pyproj.Transformer.from_crs(projected_crs(crs, where), "EPSG:4326", always_xy=True)
    longitude_deg, latitude_deg = to_degrees.transform(*np.asarray(positions, np.float64).T)
    return latitude_deg, longitude_deg


def grid_poses(
    latitude_deg: np.ndarray, longitude_deg: np.ndarray, height_m: np.ndarray, rpy_rad: np.ndarray, crs: str, where: object = "crs"
) -> np.ndarray:
    """Poses of a body in the map's axes from a GNSS/INS.

    Args:
        latitude_deg, longitude_deg: (N,) WGS 84.
        height_m: (N,) height, taken as the map's z.
        rpy_rad: (N, 3) roll, pitch and yaw of the body (x forward, y left, z up) in east, north, up; yaw counter-clockwise from true east.
        crs: the map's projected CRS.
    Returns:
        T_map_body (N, 4, 4): positions in the grid, attitudes turned from true to grid north.
    """
    # ASSUME: the grid's scale stays in the positions (0.4 m/km in UTM), as it is in every map in that CRS.
    positions = np.column_stack([project(latitude_deg, longitude_deg, crs, where), height_m])
    rpy_rad = np.array(rpy_rad, np.float64)
    T = geometry.transform(positions, rpy_rad)
    turn = geometry.transform(rpy_rad=np.column_stack([0 * T[:, 0, 3], 0 * T[:, 0, 3], grid_turn(latitude_deg, longitude_deg, crs)]))
    T[:, :3, :3] = turn[:, :3, :3] @ T[:, :3, :3]
    return T


def grid_turn(latitude_deg: np.ndarray, longitude_deg: np.ndarray, crs: str) -> np.ndarray:
    """Angle (N,) in radians, counter-clockwise, to add to a yaw against true east to have it against the grid's easting.

    Taken from where a metre to the true north arrives in the grid, so that no sign convention is trusted.
    """
    latitude_deg = np.asarray(latitude_deg, np.float64)
    step = project(latitude_deg + 1e-5, longitude_deg, crs) - project(latitude_deg - 1e-5, longitude_deg, crs)
    return np.arctan2(step[..., 1], step[..., 0]) - np.pi / 2


def projected_crs(crs: str, where: object = "crs") -> pyproj.CRS:
    """The CRS, checked to be projected and in metres."""
    try:
        system = pyproj.CRS.from_user_input(crs)
    except pyproj.exceptions.CRSError as error:
        raise BadInput(where, f"'{crs}' is no coordinate reference system", "write it like EPSG:32632") from error
    if not system.is_projected or {axis.unit_name for axis in system.axis_info[:2]} != {"metre"}:
        raise BadInput(where, f"'{crs}' is not a projected system in metres", "choose the UTM zone or the national grid of the place")
    return system
