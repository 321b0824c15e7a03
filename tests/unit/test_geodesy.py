import numpy as np
import pyproj
import pytest

from streetscan import geodesy, geometry
from streetscan.errors import BadInput

LATITUDE, LONGITUDE = 49.015, 8.4343


def test_projection_equals_the_tables_of_utm():
    # On the central meridian the easting is 500 km, and the northing the length of the meridian times 0.9996.
    easting, northing = geodesy.project(np.array([0.0]), np.array([9.0]), "EPSG:32632")[0]
    assert (easting, northing) == pytest.approx((500_000, 0), abs=1e-6)


def test_yaw_is_turned_to_grid_north():
    turn = geodesy.grid_turn(np.array([LATITUDE]), np.array([LONGITUDE]), "EPSG:32632")[0]
    convergence = pyproj.Proj("EPSG:32632").get_factors(LONGITUDE, LATITUDE).meridian_convergence
    # West of the central meridian true north lies east of grid north: the turn is clockwise, by the meridian convergence.
    assert turn == pytest.approx(np.radians(convergence), abs=1e-7)
    assert turn == pytest.approx(np.radians((LONGITUDE - 9.0) * np.sin(np.radians(LATITUDE))), abs=1e-5)


def test_a_drive_to_the_true_east_points_along_its_track():
    longitudes = LONGITUDE + np.array([0.0, 1e-4])
    poses = geodesy.grid_poses(np.full(2, LATITUDE), longitudes, np.zeros(2), np.zeros((2, 3)), "EPSG:32632")
    track = poses[1, :2, 3] - poses[0, :2, 3]
    yaw = geometry.rpy_of_transform(poses)[0, 2]
    assert yaw == pytest.approx(np.arctan2(track[1], track[0]), abs=1e-5)


@pytest.mark.parametrize("crs", ["EPSG:4326", "EPSG:999999", "nonsense", "EPSG:2263"])
def test_only_projected_systems_in_metres(crs):
    with pytest.raises(BadInput, match="somewhere"):
        geodesy.projected_crs(crs, "somewhere")
