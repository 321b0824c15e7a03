"""The rotating lidar against scenes whose every distance is known: still and moving, level and tilted."""

import numpy as np
import pytest
import yaml

from streetscan import geometry
from streetscan.classes import CAR, COLUMN, FACADE, GROUND
from streetscan.errors import BadInput
from streetscan.simulation.meshes import Surface, box, quads, tube
from streetscan.simulation.raycasting import SceneCaster
from streetscan.simulation.receiver import Receiver
from streetscan.simulation.recording import Trajectory
from streetscan.simulation.rotating_lidar import HDL64E_RECEIVER, Beams, RotatingLidar, nominal_beams, read_beams, record_frame
from streetscan.simulation.scene import Actor, Mesh, Scene, join_meshes
from streetscan.sweeps import deskew_along

NOTHING_LOST = {"n_subrays": 0, "dropout": 0.0, "fading_db": 0.0}
EXACT = Receiver(**HDL64E_RECEIVER | NOTHING_LOST | {"range_noise_m": 0.0, "beam_divergence_mrad": 0.0, "dark_range_m": 1000.0})
HEIGHT_M = 1.73
LEVEL = geometry.transform((0.8, 0, HEIGHT_M))


def plane(x_m: float, label: int = FACADE, material: str = "plaster", half_m: float = 150.0) -> Mesh:
    """A wall across the road at x."""
    corners = [[[x_m, half_m, -20], [x_m, -half_m, -20], [x_m, -half_m, 80], [x_m, half_m, 80]]]
    return quads(np.array(corners, float), Surface(label, material, (200, 200, 200)))


def ground(half_m: float = 150.0, material: str = "plaster") -> Mesh:
    corners = [[[-half_m, -half_m, 0], [half_m, -half_m, 0], [half_m, half_m, 0], [-half_m, half_m, 0]]]
    return quads(np.array(corners, float), Surface(GROUND, material, (90, 90, 90)))


def moving(speed_mps: float = 0.0, yaw_rate_radps: float = 0.0, duration_s: float = 1.0) -> Trajectory:
    times = np.arange(0, duration_s + 0.005, 0.005)
    rotations = geometry.transform(rpy_rad=np.stack([0 * times, 0 * times, yaw_rate_radps * times], axis=1))[:, :3, :3]
    return Trajectory(0.0, np.stack([speed_mps * times, 0 * times, 0 * times], axis=1), rotations)


def lidar(receiver: Receiver = EXACT, T: np.ndarray = LEVEL, rate_hz: float = 10.0) -> RotatingLidar:
    return RotatingLidar(nominal_beams(1), rate_hz, T, receiver)


def poses_of(trajectory: Trajectory, sensor: RotatingLidar, times_s: np.ndarray) -> np.ndarray:
    positions, rotations = trajectory.at(times_s)
    return geometry.transform_of_rotation(rotations, positions) @ sensor.T_vehicle_lidar


def test_beams_stand_in_two_blocks_and_are_one_units_own():
    beams = nominal_beams(1)
    elevations = np.sort(np.degrees(beams.elevations_rad))
    assert len(beams) == 64
    assert elevations[0] == pytest.approx(-24.8, abs=0.2)
    assert elevations[-1] == pytest.approx(2.0, abs=0.2)
    steps = np.diff(elevations)
    assert steps[:31].mean() == pytest.approx(0.515, abs=0.01)
    assert steps[32:].mean() == pytest.approx(1 / 3, abs=0.01)
    assert sorted(beams.rings) == list(range(64))
    assert beams.rings[np.argmin(beams.elevations_rad)] == 0
    again, other = nominal_beams(1), nominal_beams(2)
    assert np.array_equal(beams.elevations_rad, again.elevations_rad)
    assert 0.02 < np.degrees(np.std(beams.elevations_rad - other.elevations_rad)) < 0.15


def test_firings_are_even_and_belong_to_one_revolution_each():
    sensor = lidar()
    one, two = sensor.firings(3), sensor.firings(4)
    times = np.concatenate([one[0], two[0]])
    assert np.allclose(np.diff(times), 48e-6 / 64, atol=1e-9)
    assert len(one[0]) == pytest.approx(133_333, abs=2)
    assert one[0][0] >= 0.3 - 1e-9
    assert one[0][-1] < 0.4
    assert sensor.stamp_s(3) == pytest.approx(0.35)


def test_the_head_faces_the_rear_forward_and_turns_clockwise():
    sensor = lidar()
    beam = int(np.argmin(np.abs(sensor.beams.azimuths_rad)))
    quarter = 0.025
    times = sensor.stamp_s(0) + np.array([-2 * quarter, -quarter, 0, quarter])
    _, directions = sensor.rays(0, times, np.full(4, beam))
    azimuths = np.degrees(np.arctan2(directions[:, 1], directions[:, 0]))
    assert np.abs(geometry.angle_difference(np.radians(azimuths), np.radians([180, 90, 0, -90]))).max() < np.radians(2)


@pytest.mark.parametrize("T", [LEVEL, geometry.transform((0.8, 0, HEIGHT_M), np.radians([0, -45, 0]))], ids=["level", "tilted"])
def test_a_still_sensor_measures_a_plane_to_the_millimetre(T):
    sensor = lidar(T=T)
    frame = record_frame(SceneCaster(Scene(plane(20.0))), sensor, moving(0.0), 0, 7)
    points = geometry.apply(T, frame.points)
    assert len(frame) > 10_000
    assert np.abs(points[:, 0] - 20.0).max() < 1e-3
    assert (frame.labels == FACADE).all()


@pytest.mark.parametrize("yaw_rate_radps", [0.0, 0.3])
def test_a_moving_sensor_skews_a_plane_and_its_true_poses_undo_it_to_the_millimetre(yaw_rate_radps):
    sensor, trajectory = lidar(), moving(15.0, yaw_rate_radps)
    frame = record_frame(SceneCaster(Scene(plane(30.0))), sensor, trajectory, 2, 7)
    stamp, offsets = sensor.stamp_s(2), frame.time_offset_s.astype(np.float64)
    # Every point lies on the plane from its own firing ...
    poses = poses_of(trajectory, sensor, stamp + offsets)
    assert np.abs(geometry.apply(poses, frame.points)[:, 0] - 30.0).max() < 1e-3
    # ... and, seen from the stamp, off it by the way driven in between.
    at_stamp = poses_of(trajectory, sensor, np.array([stamp]))[0]
    if not yaw_rate_radps:
        assert np.abs(geometry.apply(at_stamp, frame.points)[:, 0] - 30.0 + 15.0 * offsets).max() < 1e-3
        assert offsets.min() < -0.015
    knots = np.arange(0.15, 0.35, 0.005)
    straight = deskew_along(frame.points, frame.time_offset_s, stamp, knots, poses_of(trajectory, sensor, knots))
    assert np.abs(geometry.apply(at_stamp, straight)[:, 0] - 30.0).max() < 1e-3


def test_a_pole_is_where_it_is_seen_from_a_still_and_from_a_moving_sensor():
    radius = 0.15
    pole = tube(np.array([[12.0, 5.0, -1], [12.0, 5.0, 6]]), radius, Surface(COLUMN, "painted_metal", (80, 80, 80)), 64)
    pole.instances[:] = 9
    caster = SceneCaster(Scene(join_meshes([pole, ground()])))
    for speed in (0.0, 20.0):
        sensor, trajectory = lidar(), moving(speed)
        frame = record_frame(caster, sensor, trajectory, 1, 7)
        poses = poses_of(trajectory, sensor, sensor.stamp_s(1) + frame.time_offset_s.astype(np.float64))
        points = geometry.apply(poses, frame.points)
        on_pole = frame.instances == 9
        assert on_pole.sum() > 50
        # A polygon of 64 corners lies within 0.2 mm of its circle.
        assert np.abs(np.hypot(points[on_pole, 0] - 12, points[on_pole, 1] - 5) - radius).max() < 1e-3
        assert (frame.labels[on_pole] == COLUMN).all()
        assert np.abs(points[~on_pole, 2]).max() < 1e-3


def test_truth_is_the_object_hit_also_when_it_moves():
    car = box((-2, -0.9, 0.2), (2, 0.9, 1.5), Surface(CAR, "plastic", (200, 20, 20)))
    car.instances[:] = 41
    path = Actor(car, np.array([0.0, 10.0]), np.array([[10.0, 4.0, 0], [110.0, 4.0, 0]]), np.zeros(2))
    caster = SceneCaster(Scene(ground(), [path]), 0.0, 1.0)
    sensor = lidar()
    frame = record_frame(caster, sensor, moving(0.0), 3, 7)
    hit = frame.instances == 41
    assert hit.sum() > 100
    assert (frame.labels[hit] == CAR).all()
    assert (frame.labels[~hit] == GROUND).all()
    # In the car's own frame at each firing, all its points lie on its box.
    times = sensor.stamp_s(3) + frame.time_offset_s[hit].astype(np.float64)
    points = geometry.apply(LEVEL, frame.points[hit]) - path.pose_at(times)[0]
    inside = np.minimum.reduce([2 - np.abs(points[:, 0]), 0.9 - np.abs(points[:, 1]), points[:, 2] - 0.2, 1.5 - points[:, 2]])
    assert np.abs(inside).max() < 1e-3


def test_the_ground_below_the_car_is_hidden_and_rings_lie_where_their_beams_meet_it():
    sensor = lidar()
    frame = record_frame(SceneCaster(Scene(ground())), sensor, moving(0.0), 0, 7)
    distances = np.hypot(*frame.points[:, :2].T)
    assert distances.min() > 3.5
    beams = sensor.beams
    for beam in (20, 40, 63):
        depression = -beams.elevations_rad[beam]
        expected = (HEIGHT_M + beams.heights_m[beam] / np.cos(depression)) / np.tan(depression)
        seen = distances[frame.ring == beams.rings[beam]]
        # The origin lies 26 mm to the side.
        assert np.abs(seen - expected).max() < 0.02


def test_a_tilted_sensor_sees_the_sky_and_little_road():
    tilted = lidar(T=geometry.transform((0.8, 0, HEIGHT_M), np.radians([0, -45, 0])))
    wall = SceneCaster(Scene(join_meshes([plane(20.0), ground()])))
    level, up = (record_frame(wall, s, moving(0.0), 0, 7) for s in (lidar(), tilted))
    assert geometry.apply(tilted.T_vehicle_lidar, up.points)[:, 2].max() > 15
    assert (up.labels == GROUND).sum() < 0.5 * (level.labels == GROUND).sum()


def test_dark_things_are_seen_to_50_m_and_bright_ones_to_120():
    """Józsa & Benedek (2013), 2.3: 50 m on 10 %, so 59 m on the 14 % of asphalt, and 120 m on 80 % reflectance."""
    receiver = Receiver(**HDL64E_RECEIVER | NOTHING_LOST)

    def n_seen(material, x_m):
        caster = SceneCaster(Scene(plane(x_m + 0.8, material=material, half_m=3.0)))
        return len(record_frame(caster, lidar(receiver), moving(0.0), 0, 7))

    assert n_seen("asphalt", 58.0) > 200
    assert n_seen("asphalt", 60.0) == 0
    assert n_seen("plaster", 118.0) > 50
    assert n_seen("plaster", 121.0) == 0


def test_noise_drop_out_and_intensity_are_as_asked():
    caster = SceneCaster(Scene(plane(15.0)))
    exact = record_frame(caster, lidar(Receiver(**HDL64E_RECEIVER | {"dropout": 0.0})), moving(0.0), 0, 7)
    real = record_frame(caster, lidar(Receiver(**HDL64E_RECEIVER)), moving(0.0), 0, 7)
    assert len(real) == pytest.approx(0.98 * len(exact), rel=0.005)
    directions = real.points / np.linalg.norm(real.points, axis=1, keepdims=True)
    error = (geometry.apply(LEVEL, real.points)[:, 0] - 15.0) / directions[:, 0]
    assert 0.01 < np.std(error[directions[:, 0] > 0.9]) < 0.02
    steps = real.intensity * 255
    assert np.abs(steps - steps.round()).max() < 1e-3
    squarely = directions[:, 0] > 0.95
    assert real.intensity[squarely].mean() == pytest.approx(0.6, abs=0.08)  # plaster at 905 nm


def test_edges_make_mixed_pixels():
    post = box((10.0, -0.4, -1), (10.1, 0.4, 5), Surface(COLUMN, "plaster", (80, 80, 80)))
    caster = SceneCaster(Scene(join_meshes([post, plane(10.6)])))
    receiver = Receiver(**HDL64E_RECEIVER | {"range_noise_m": 0.0, "dropout": 0.0})
    x = geometry.apply(LEVEL, record_frame(caster, lidar(receiver), moving(0.0), 0, 7).points)[:, 0]
    between = (x > 10.15) & (x < 10.55)
    assert 20 < between.sum() < 0.02 * len(x)


def test_revolutions_repeat_whatever_else_was_recorded():
    caster = SceneCaster(Scene(join_meshes([plane(15.0), ground()])))
    sensor = lidar(Receiver(**HDL64E_RECEIVER))
    a, b, other = (record_frame(caster, sensor, moving(5.0), 3, seed) for seed in (7, 7, 8))
    assert np.array_equal(a.points, b.points)
    assert np.array_equal(a.intensity, b.intensity)
    assert len(a) != len(other) or not np.array_equal(a.points, other.points)


def test_nothing_around_gives_an_empty_frame():
    frame = record_frame(SceneCaster(Scene(plane(500.0))), lidar(), moving(0.0), 0, 7)
    assert len(frame) == 0
    assert frame.status == "empty"


def test_beams_of_a_units_calibration(tmp_path):
    lasers = [
        {
            "laser_id": i,
            "rot_correction": 0.01 * i,
            "vert_correction": -0.02 * i,
            "vert_offset_correction": 0.2,
            "horiz_offset_correction": 0.026,
        }
        for i in (1, 0)
    ]
    path = tmp_path / "unit.yaml"
    path.write_text(yaml.safe_dump({"lasers": lasers}))
    beams = read_beams(path, 1)
    assert isinstance(beams, Beams)
    assert beams.elevations_rad.tolist() == [0.0, -0.02]
    assert beams.azimuths_rad.tolist() == [0.0, 0.01]
    path.write_text("lasers: [{laser_id: 0}, {laser_id: 1}]\n")
    with pytest.raises(BadInput, match="2 lasers whose elevations are not all different"):
        read_beams(path, 1)
    path.write_text("beams: 3\n")
    with pytest.raises(BadInput, match="no calibration of a Velodyne"):
        read_beams(path, 1)
