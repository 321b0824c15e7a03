"""Drives whose map is known: smears of moving things, truth beside the map, repetition, parts."""

import itertools

import numpy as np
import pytest

from streetscan.classes import CAR, FACADE, GROUND, PHANTOM
from streetscan.errors import BadInput
from streetscan.io.las import read_las
from streetscan.simulation import realism
from streetscan.simulation.colouring import Cameras
from streetscan.simulation.layout import build_street
from streetscan.simulation.meshes import Surface, box, quads
from streetscan.simulation.raycasting import SceneCaster
from streetscan.simulation.receiver import Receiver
from streetscan.simulation.recording import (
    Errors,
    Record,
    caster_of_drive,
    drive_road,
    plan_passes,
    record_map,
    record_static,
    record_static_street,
    seed_of_recording,
    tripod_positions,
    write_map,
)
from streetscan.simulation.scene import Actor, Mesh, Scene, join_meshes
from streetscan.simulation.sensors import ProfileScanner, StaticScanner, mobile_mapper

NO_ERRORS = Errors(drift_m=0.0, pass_offset_m=(0.0, 0.0), attitude_deg=0.0, boresight_deg=0.0)
EXACT = Receiver(range_noise_m=0.0, n_subrays=0)  # every pulse one ray


def road(length_m: float = 30.0) -> np.ndarray:
    return np.array([[0.0, 0, 0], [length_m, 0, 0]])


def ground_mesh(length_m: float = 30.0) -> Mesh:
    corners = [[[-60, -12, 0], [length_m + 60, -12, 0], [length_m + 60, 12, 0], [-60, 12, 0]]]
    return quads(np.array(corners), Surface(GROUND, "concrete", (90, 90, 90)))


def car_mesh(instance: int = 41) -> Mesh:
    mesh = box((-2, -0.9, 0.2), (2, 0.9, 1.5), Surface(CAR, "plastic", (200, 20, 20)))
    mesh.instances[:] = instance
    return mesh


def street(actors=(), length_m: float = 30.0, offset=(0.0, 0.0, 0.0), crs=None) -> Scene:
    wall = box((-60, 10, 0), (length_m + 60, 10.5, 12), Surface(FACADE, "plaster", (220, 200, 160)))
    wall.instances[:] = 5
    parked = car_mesh(6)
    parked.vertices = parked.vertices + np.array([12.0, -6.0, 0])
    static = join_meshes([ground_mesh(length_m), wall, parked])
    static.vertices = static.vertices + np.asarray(offset)
    moved = [Actor(a.mesh, a.times_s, a.positions + np.asarray(offset), a.yaws_rad) for a in actors]
    return Scene(static, moved, [road(length_m) + np.asarray(offset)], [36.0], 1.75, crs)


def passing_car(speed_mps: float, start_x_m: float, y_m: float = 5.0) -> Actor:
    times = np.array([0.0, 60.0])
    positions = np.array([[start_x_m, y_m, 0], [start_x_m + 60 * speed_mps, y_m, 0]])
    return Actor(car_mesh(), times, positions, np.zeros(2))


def gather(records) -> Record:
    records = list(records)
    points = np.concatenate([r.cloud.points for r in records])
    cloud = type(records[0].cloud)(points, {k: np.concatenate([r.cloud.fields[k] for r in records]) for k in records[0].cloud.fields})
    return Record(cloud, np.concatenate([r.labels for r in records]), np.concatenate([r.instances for r in records]))


def record(scene: Scene, scanners=None, receiver=EXACT, errors=NO_ERRORS, seed=1, **more) -> Record:
    scanners = scanners or mobile_mapper(50, 20_000)
    return gather(record_map([scene], scanners, receiver, Cameras(), errors, seed, **more))


def test_a_drive_keeps_its_lane_and_its_mean_speed():
    line = np.array([[0.0, 0, 0], [100, 0, 2], [100, 80, 2]])
    path = drive_road(line, 36.0, 1.75, 7.0, np.random.default_rng(0))
    assert path.start_s == 7.0
    assert path.end_s - path.start_s == pytest.approx(18, rel=0.05)
    steps = np.linalg.norm(np.diff(path.positions, axis=0), axis=1) * 200
    assert steps.min() > 8
    assert steps.max() < 12.5
    middle = np.abs(path.positions[:, 0] - 50).argmin()
    assert path.positions[middle, 1] == pytest.approx(-1.75, abs=0.12)  # right of a line that runs east
    assert path.positions[middle, 2] == pytest.approx(1.0, abs=0.05)
    # The nose points where the van goes.
    moved = np.diff(path.positions, axis=0)
    moved /= np.linalg.norm(moved, axis=1, keepdims=True)
    assert np.einsum("ij,ij->i", moved, path.rotations[:-1, :, 0]).min() > 0.998


def test_a_road_without_length_is_refused():
    with pytest.raises(ValueError, match="two different points"):
        drive_road(np.zeros((2, 3)), 40, 1.75, 0, np.random.default_rng(0))


def test_passes_run_both_ways_one_after_the_other():
    passes = plan_passes(street(), NO_ERRORS, seed=1, n_rounds=2)
    assert len(passes) == 4
    assert all(a.truth.end_s < b.truth.start_s for a, b in itertools.pairwise(passes))
    ahead = [p.truth.positions[-1, 0] - p.truth.positions[0, 0] for p in passes]
    assert np.sign(ahead).tolist() == [1, -1, 1, -1]
    sides = [np.sign(p.truth.positions[:, 1].mean()) for p in passes]
    assert sides == [-1, 1, -1, 1]


def test_navigation_errors_are_as_large_as_asked_and_smooth():
    long = Scene(ground_mesh(), [], [np.array([[0.0, 0, 0], [3000, 0, 0]])], [36.0])
    first, second = plan_passes(long, Errors(0.03, (0.05, 0.05), 0.0), seed=4)
    drift = first.believed.positions - first.truth.positions
    np.testing.assert_allclose(drift.std(axis=0), 0.03, rtol=0.35)
    assert np.abs(np.diff(drift, axis=0)).max() * 200 < 0.1  # no faster than 10 cm a second
    offset = (second.believed.positions - second.truth.positions).mean(axis=0)
    assert np.linalg.norm(offset[:2]) == pytest.approx(0.05, abs=0.02)


def test_streets_of_a_city_share_no_error_of_navigation():
    seeds = {seed_of_recording(split, 1) for split in ("train", "validation", "test")}
    assert len(seeds) == 3
    assert seed_of_recording("train", 1) in seeds
    drifts = []
    for seed in seeds:
        first, _ = plan_passes(street(length_m=300.0), Errors(0.03, (0.05, 0.05), 0.0), seed)
        drifts.append((first.believed.positions - first.truth.positions)[:1000])
    for a, b in itertools.combinations(drifts, 2):
        assert np.abs(a - b).mean() > 0.005


def test_each_scanner_is_mounted_a_little_otherwise_than_believed():
    errors = Errors(0.0, (0.0, 0.0), 0.0, boresight_deg=0.05)
    exact, wrong = (record(street(), errors=e) for e in (NO_ERRORS, errors))
    np.testing.assert_array_equal(exact.labels, wrong.labels)
    shifts = np.linalg.norm(exact.cloud.points - wrong.cloud.points, axis=1)
    # The error is an angle: it grows with the range, and stays within what angles of some 0.05 degrees do at 30 m.
    assert 1e-3 < np.median(shifts) < np.radians(0.2) * 30
    far = np.abs(exact.cloud.points[:, 1]) > 8
    assert np.median(shifts[far]) > np.median(shifts[~far])


def test_the_points_of_an_exact_recording_lie_on_the_surfaces():
    whole = record(street())
    points, labels = whole.cloud.points, whole.labels
    assert set(labels) == {GROUND, FACADE, CAR}
    assert np.abs(points[labels == GROUND, 2]).max() < 2e-3
    wall = points[labels == FACADE]
    assert np.abs(wall[:, 1] - 10).max() < 5e-3
    parked = points[labels == CAR] - [12, -6, 0]
    assert np.abs(np.abs(parked / [2, 0.9, 1]).max(axis=1)).max() < 1.51
    assert set(whole.instances[labels == CAR]) == {6}
    assert set(whole.instances[labels == GROUND]) == {0}


def test_truth_of_every_point_is_the_object_it_lies_on():
    whole = record(street([passing_car(3.0, -5.0)]))
    above = whole.cloud.points[:, 2] > 0.05
    on_wall = np.abs(whole.cloud.points[:, 1] - 10) < 0.01
    np.testing.assert_array_equal(on_wall[above], whole.labels[above] == FACADE)
    # The moving car keeps y between 4.1 and 5.9; nothing else stands there but the ground.
    lane = (np.abs(whole.cloud.points[:, 1] - 5) < 0.92) & (whole.cloud.points[:, 2] > 0.05)
    np.testing.assert_array_equal(lane, whole.labels == PHANTOM)
    assert set(whole.instances[lane]) == {41}


@pytest.mark.parametrize("speed_mps", [5.0, -4.0])
def test_a_smear_is_as_long_as_the_relative_speed_makes_it(speed_mps):
    """A plane across the street that moves at v crosses a car of length L moving at u during L / |v - u|; it covers v times that."""
    v, length = 10.0, 4.0
    still = drive_road(road(60), 3.6 * v, 1.75, 0, np.random.default_rng(0))
    scanner = ProfileScanner((0.0, 0.0, 2.6), 0.0, 0.0, 200.0, 100_000.0)
    whole = record(street([passing_car(speed_mps, 25.0 if speed_mps < 0 else 5.0)], 60.0), (scanner,))
    first_pass = whole.cloud.fields["time_s"] < still.end_s
    smear = whole.cloud.points[first_pass & (whole.labels == PHANTOM)]
    times = whole.cloud.fields["time_s"][first_pass & (whole.labels == PHANTOM)]
    # The van's speed swings by 12 %; take what it was while it passed.
    passes = plan_passes(street([], 60.0), NO_ERRORS, 1)
    there = passes[0].truth.at(np.array([times.min(), times.max()]))[0]
    v_there = (there[1, 0] - there[0, 0]) / np.ptp(times)
    expected = v_there * length / abs(v_there - speed_mps)
    assert np.ptp(smear[:, 0]) == pytest.approx(expected, rel=0.03)
    assert expected > 1.3 * length if speed_mps > 0 else expected < length


def test_a_moving_car_casts_a_shadow_of_missing_points():
    with_car, without = record(street([passing_car(3.0, 0.0)])), record(street())
    assert (without.labels == FACADE).sum() - (with_car.labels == FACADE).sum() > 100


def test_traffic_that_would_run_into_the_van_is_left_out():
    # It stands in the van's lane, yet "moves" so slowly that it is still there when the van comes.
    blocking = passing_car(0.4, 10.0, y_m=-1.75)
    assert PHANTOM not in set(record(street([blocking])).labels[:20_000])


def test_seeds_repeat_and_differ():
    scene = street([passing_car(3.0, -5.0)])
    runs = [record(scene, receiver=Receiver(), errors=Errors(), seed=s) for s in (1, 1, 2)]
    np.testing.assert_array_equal(runs[0].cloud.points, runs[1].cloud.points)
    np.testing.assert_array_equal(runs[0].cloud.fields["rgb"], runs[1].cloud.fields["rgb"])
    assert len(runs[2].labels) != len(runs[0].labels) or not np.array_equal(runs[0].cloud.points, runs[2].cloud.points)


def test_a_block_has_the_same_map_whatever_was_recorded_before_it():
    first, other, second = street([passing_car(3.0, -5.0)]), street(length_m=50.0), street([passing_car(-4.0, 20.0)], offset=(40, 0, 0))
    scanners = mobile_mapper(50, 20_000)
    whole = list(record_map([first, second], scanners, Receiver(), Cameras(), Errors(), 1))
    n_first = len(list(record_map([first], scanners, Receiver(), Cameras(), Errors(), 1)))
    beside = list(record_map([other, second], scanners, Receiver(), Cameras(), Errors(), 1))
    n_other = len(list(record_map([other], scanners, Receiver(), Cameras(), Errors(), 1)))
    alone, again = gather(whole[n_first:]), gather(beside[n_other:])
    np.testing.assert_array_equal(alone.cloud.points, again.cloud.points)
    np.testing.assert_array_equal(alone.cloud.fields["rgb"], again.cloud.fields["rgb"])
    np.testing.assert_array_equal(alone.labels, again.labels)
    later = np.diff([part.cloud.fields["time_s"].min() for part in (gather(whole[:n_first]), alone)])
    assert later > 60


def test_whoever_the_vehicle_would_run_into_is_not_there():
    drive = plan_passes(street(), NO_ERRORS, 1)[0]
    towards = drive.truth.positions[len(drive.truth.positions) // 2]
    blocking = Actor(car_mesh(), np.array([0.0, 60.0]), np.array([towards, towards]), np.zeros(2))
    scene = street([blocking])
    eye, ahead = (towards + [-10, 0, 1.0])[None].astype(np.float32), np.array([[1.0, 0, 0]], np.float32)
    times = np.array([drive.truth.start_s + 1.0])
    assert SceneCaster(scene, drive.truth.start_s, drive.truth.end_s).cast(eye, ahead, times).distances_m[0] < 11
    assert not caster_of_drive(scene, drive).cast(eye, ahead, times).distances_m[0] < 11


def test_the_return_rate_is_of_the_world_that_is_scanned(monkeypatch):
    """A car in the vehicle's way is taken out of the recording; no pulse may meet it here either."""
    against = np.array([[35.0, -1.75, 0], [-95.0, -1.75, 0]])
    oncoming = Actor(car_mesh(), np.array([0.0, 13.0]), against, np.zeros(2))
    monkeypatch.setattr(realism, "build_street", lambda **_: street([oncoming]))
    settings = {"street": {}, "scanners": {"lines_per_s": 50, "pulses_per_s": 20_000}, "receiver": {}, "errors": {}, "n_rounds": 1}
    _, table = realism.probe_street("test", 1, 120.0, settings, 100_000)
    assert {"ground", "facade"} <= set(table["group"])
    assert "phantom" not in set(table["group"])


@pytest.mark.parametrize(
    ("make", "key"),
    [
        (lambda: Errors(pass_offset_m=(0.1, 0.02)), "pass_offset_m"),
        (lambda: Receiver(min_range_m=300.0), "min_range_m"),
        (lambda: Receiver(resolution_m=0.0), "resolution_m"),
        (lambda: StaticScanner(low_deg=30.0, high_deg=-30.0), "low_deg"),
    ],
)
def test_settings_that_contradict_each_other_are_named(make, key):
    with pytest.raises(BadInput, match=key):
        make()


def test_a_scanner_that_hears_nothing_leaves_no_file(tmp_path):
    deaf = Receiver(min_range_m=150.0, max_range_m=151.0)
    records = record_static(street(), np.array([[5.0, 0, 0]]), StaticScanner(step_deg=5.0), deaf, 1)
    with pytest.raises(BadInput, match="hit nothing"):
        write_map(records, *(tmp_path / name for name in ("map.laz", "labels.npy", "instances.npy")))
    assert not list(tmp_path.iterdir())


def test_times_are_each_pulses_own():
    whole = record(street(), (mobile_mapper(50, 20_000)[0],))
    times = whole.cloud.fields["time_s"][whole.cloud.fields["return_number"] == 1]
    assert (np.diff(times) > 0).all()


def test_colours_behind_a_moving_car_are_wrong_where_the_camera_saw_the_car():
    whole = record(street([passing_car(9.0, -4.0, y_m=4.0)]))
    wall = whole.cloud.fields["rgb"][whole.labels == FACADE].astype(int)
    is_red = wall[:, 0] > 2 * wall[:, 1]
    assert 0 < is_red.mean() < 0.3


def test_a_map_file_holds_no_truth_and_truth_has_its_order(tmp_path):
    scene = street([passing_car(3.0, -5.0)], offset=(650_000.0, 240_000.0, 105.0), crs="EPSG:23700")
    files = tmp_path / "map.laz", tmp_path / "truth/labels.npy", tmp_path / "truth/instances.npy"
    records = list(record_map([scene], mobile_mapper(50, 20_000), Receiver(), Cameras(), Errors(), 1))
    n = write_map(iter(records), *files)
    cloud, labels, instances = read_las(files[0]), np.load(files[1]), np.load(files[2])
    expected = gather(records)
    assert n == len(cloud) == len(labels) == len(instances)
    assert set(cloud.fields) == {"intensity", "time_s", "rgb", "return_number", "n_returns", "classification"}
    assert set(cloud.fields["classification"]) == {0}
    assert cloud.crs == "EPSG:23700"
    np.testing.assert_allclose(cloud.points, expected.cloud.points, atol=6e-4)
    np.testing.assert_array_equal(cloud.fields["time_s"], expected.cloud.fields["time_s"])
    np.testing.assert_array_equal(labels, expected.labels)
    np.testing.assert_array_equal(instances, expected.instances)
    assert (labels.dtype, instances.dtype) == (np.uint8, np.uint32)


def test_nothing_is_left_when_there_is_nothing_to_record(tmp_path):
    far = street()
    far.static.vertices = far.static.vertices + np.array([0, 5000.0, 0])
    files = tmp_path / "map.laz", tmp_path / "truth/labels.npy", tmp_path / "truth/instances.npy"
    with pytest.raises(BadInput, match="hit nothing"):
        write_map(record_map([far], mobile_mapper(50, 20_000), Receiver(), Cameras(), NO_ERRORS, 1), *files)
    assert [p for p in tmp_path.rglob("*") if p.is_file()] == []


def test_density_of_a_static_scanner_falls_steeply_with_the_range():
    scanner = StaticScanner(step_deg=0.2)
    whole = gather(record_static(street(), np.array([[10.0, 0, 0]]), scanner, EXACT, seed=1))
    ground = whole.cloud.points[whole.labels == GROUND]
    distance = np.hypot(ground[:, 0] - 10, ground[:, 1])
    counts = [((distance > r) & (distance < r + 0.5)).sum() / (np.pi * ((r + 0.5) ** 2 - r**2)) for r in (3.0, 6.0)]
    # Pulses per steradian 1 / (step^2 cos(elevation)), steradians per area h / R^3: n = h / (step^2 R^2 d).
    expected = (1.7**2 + 6.25**2) * 6.25 / ((1.7**2 + 3.25**2) * 3.25)
    assert counts[0] / counts[1] == pytest.approx(expected, rel=0.1)
    assert "rgb" not in whole.cloud.fields


def test_a_tripod_stands_on_the_sidewalk_where_nothing_else_does():
    settings = {"length_m": 60.0, "traffic_density": 0.2, "n_pedestrians": 4.0}
    scene = build_street(split="test", seed=1, block=0, time_span_s=(0.0, 1.0), **settings)
    places = tripod_positions(scene, settings, 0, 20.0)
    axis = scene.roads[0][:, :2]
    assert np.abs([np.linalg.norm(axis - p[:2], axis=1).min() - 12.3 for p in places]).max() < 0.2
    solid = scene.static.vertices[np.unique(scene.static.triangles[scene.static.labels != GROUND])]
    ground = scene.static.vertices[np.unique(scene.static.triangles[scene.static.labels == GROUND])]
    for place in places:
        above = solid[:, 2] - place[2]
        near = (np.linalg.norm(solid[:, :2] - place[:2], axis=1) < 0.7) & (above > 0.3) & (above < 2.2)
        assert not near.any()
        assert abs(ground[np.linalg.norm(ground[:, :2] - place[:2], axis=1).argmin(), 2] - place[2]) < 0.25


def test_a_static_street_is_recorded_panorama_after_panorama():
    settings = {"length_m": 40.0, "traffic_density": 0.2, "n_pedestrians": 4.0}
    scanner = StaticScanner(step_deg=0.6)
    records = [gather(record_static_street("test", seed, settings, scanner, Receiver(), 20.0)) for seed in (1, 1, 2)]
    times = records[0].cloud.fields["time_s"]
    assert set((times // scanner.panorama_s).astype(int)) == {0, 1}
    assert (np.diff(times) >= 0).all()
    np.testing.assert_array_equal(records[0].cloud.points, records[1].cloud.points)
    assert len(records[0].labels) != len(records[2].labels)
    assert {GROUND, FACADE} <= set(records[0].labels)


def test_streets_recorded_one_after_the_other_share_one_clock():
    scenes = [street(), street(offset=(500.0, 0, 0))]
    scanners = mobile_mapper(50, 20_000)
    first, second = (record(s, scanners) for s in scenes)
    both = gather(record_map(iter(scenes), scanners, EXACT, Cameras(), NO_ERRORS, 1))
    n = len(first.labels)
    np.testing.assert_array_equal(both.cloud.points[:n], first.cloud.points)
    assert both.cloud.points[n:, 0].mean() == pytest.approx(second.cloud.points[:, 0].mean(), abs=2)
    assert both.cloud.fields["time_s"][:n].max() < both.cloud.fields["time_s"][n:].min()
