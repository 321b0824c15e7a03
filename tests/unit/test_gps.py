"""GPS of a street canyon: as wrong as asked, in the directions a canyon has, and deaf now and then."""

import numpy as np
import pytest

from streetscan import geodesy, geometry
from streetscan.classes import FACADE, GROUND
from streetscan.simulation.gps import Gps, position_errors, record_fixes, sky_canyon, soft_limit
from streetscan.simulation.meshes import Surface, box, quads
from streetscan.simulation.raycasting import SceneCaster
from streetscan.simulation.recording import Trajectory
from streetscan.simulation.scene import Scene, join_meshes

CRS = "EPSG:23700"
ORIGIN = np.array([850_000.0, 240_000.0, 110.0])
WALL = Surface(FACADE, "plaster", (200, 200, 200))


def scene(with_houses: bool) -> SceneCaster:
    """A street along easting, with or without houses of 25 m on both sides."""
    corners = [[[-500, -500, 0], [2500, -500, 0], [2500, 500, 0], [-500, 500, 0]]]
    parts = [quads(np.array(corners, float), Surface(GROUND, "asphalt", (90, 90, 90)))]
    if with_houses:
        parts += [box((-500, y, 0), (2500, y + 10, 25), WALL) for y in (12.0, -22.0)]
    mesh = join_meshes(parts)
    mesh.vertices = mesh.vertices + ORIGIN
    return SceneCaster(Scene(mesh, crs=CRS))


def straight(duration_s: float, speed_mps: float = 5.0) -> Trajectory:
    times = np.arange(0, duration_s + 0.005, 0.005)
    positions = ORIGIN + np.stack([speed_mps * times, 0 * times, 0 * times], axis=1)
    return Trajectory(0.0, positions, np.tile(np.eye(3), (len(times), 1, 1)))


def errors_of(fixes, trajectory, gps):
    xy = geodesy.project(np.array([f.latitude_deg for f in fixes]), np.array([f.longitude_deg for f in fixes]), CRS)
    positions, rotations = trajectory.at(np.array([f.time_ns / 1e9 for f in fixes]))
    return xy - (positions + rotations @ np.asarray(gps.position_m))[:, :2]


def test_the_sky_over_a_street_is_hidden_across_it():
    open_sky, street = (sky_canyon(scene(houses), ORIGIN + [500, 0, 1.5], 0.0) for houses in (False, True))
    assert np.allclose(open_sky, 0)
    assert street[1, 1] > 0.5
    assert street[0, 0] < 0.6 * street[1, 1]
    assert abs(street[0, 1]) < 0.05


def test_without_errors_fixes_are_the_antenna_and_its_heading():
    gps = Gps(wander_m=0, canyon_m=0, noise_m=0, heading_deg=0, outages_per_min=0, rate_hz=2.0)
    trajectory = straight(10.0)
    fixes = record_fixes(scene(True), gps, trajectory, CRS, 10.0, np.random.default_rng(0), 1_000_000_000)
    assert [f.time_ns for f in fixes] == [1_000_000_000 + round(k * 5e8) for k in range(20)]
    for f in fixes:
        f.time_ns -= 1_000_000_000
    # Positions between the steps of the errors are interpolated, and the way there and back through pyproj is good to a millimetre.
    assert np.abs(errors_of(fixes, trajectory, gps)).max() < 2e-3
    turn = geodesy.grid_turn(np.array([fixes[0].latitude_deg]), np.array([fixes[0].longitude_deg]), CRS)[0]
    assert geometry.angle_difference(np.pi / 2 - fixes[0].heading_rad + turn, 0.0) == pytest.approx(0.0, abs=1e-6)
    assert abs(np.degrees(turn)) > 0.05  # the grid is turned here, and that is not forgotten


@pytest.mark.parametrize("houses", [False, True])
def test_errors_are_as_large_as_asked_and_larger_across_a_canyon(houses):
    gps, rng = Gps(memory_s=5.0), np.random.default_rng(1)
    canyon = sky_canyon(scene(houses), ORIGIN + [500, 0, 1.5], 0.0)
    error = position_errors(np.broadcast_to(canyon, (60_000, 2, 2)), gps, rng)
    along, across = error[:, 0].std(), error[:, 1].std()
    if houses:
        assert across > 1.25 * along > 1.25 * 2.5
    else:
        assert [along, across] == pytest.approx([2.4, 2.4], rel=0.1)
    assert np.linalg.norm(error[:, :2], axis=1).max() < gps.limit_m
    # It wanders: a tenth of a second changes little, five times its memory all.
    assert np.abs(np.diff(error[:, 1])).max() < 2.0
    lagged = np.corrcoef(error[:-250, 1], error[250:, 1])[0, 1]
    assert abs(lagged) < 0.15
    assert np.corrcoef(error[:-1, 1], error[1:, 1])[0, 1] > 0.97


def test_fixes_of_a_long_canyon_stay_below_ten_metres_and_fifteen_degrees():
    gps, trajectory = Gps(rate_hz=1.0, outages_per_min=0), straight(400.0)
    fixes = record_fixes(scene(True), gps, trajectory, CRS, 400.0, np.random.default_rng(3))
    distances = np.linalg.norm(errors_of(fixes, trajectory, gps), axis=1)
    assert len(fixes) == 400
    assert 1.5 < np.median(distances) < 6.0
    assert 6.0 < distances.max() < 10.0
    turn = geodesy.grid_turn(np.array([f.latitude_deg for f in fixes]), np.array([f.longitude_deg for f in fixes]), CRS)
    headings = np.array([np.pi / 2 - f.heading_rad for f in fixes]) + turn
    wrong = np.degrees(np.abs(geometry.angle_difference(headings, 0.0)))
    assert 2.0 < wrong.mean() < 8.0
    assert wrong.max() < 15.0


def test_fixes_stop_and_come_again():
    gps, trajectory = Gps(rate_hz=10.0, outages_per_min=6.0, outage_s=2.0), straight(300.0)
    fixes = record_fixes(scene(False), gps, trajectory, CRS, 300.0, np.random.default_rng(4))
    gaps = np.diff([f.time_ns for f in fixes]) / 1e9
    assert 0.6 < len(fixes) / 3000 < 0.95
    assert 10 < (gaps > 0.15).sum() < 50
    assert np.isclose(gaps[gaps < 0.15], 0.1).all()


def test_fixes_repeat_with_their_seed():
    a, b, c = (record_fixes(scene(True), Gps(), straight(5.0), CRS, 5.0, np.random.default_rng(s)) for s in (1, 1, 2))
    assert [f.latitude_deg for f in a] == [f.latitude_deg for f in b] != [f.latitude_deg for f in c]


def test_short_vectors_hardly_change_and_long_ones_stay_below_the_limit():
    limited = soft_limit(np.array([[0.1, 0.0], [30.0, 40.0]]), 10.0)
    assert limited[0, 0] == pytest.approx(0.1, rel=1e-3)
    assert np.linalg.norm(limited[1]) == pytest.approx(10.0, rel=1e-3)
    assert limited[1, 1] / limited[1, 0] == pytest.approx(4 / 3)
