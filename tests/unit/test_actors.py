import numpy as np
import pytest

from streetscan import classes
from streetscan.simulation import actors, shapes, terrain
from streetscan.simulation.actors import Lane, Signal, crossing_walkers, follow, lane_actors

TIMES = np.arange(0, 60, 0.1)


@pytest.fixture(scope="module")
def axis():
    return terrain.draw_axis(200.0, 0.08, 20.0, (650_000.0, 240_000.0, 110.0), np.random.default_rng(0))


def test_signal_is_green_for_its_share_of_the_cycle():
    signal = Signal(40.0, 18.0, 5.0)
    red = np.array([signal.is_red(t) for t in np.arange(0, 400, 0.1)])
    assert not signal.is_red(5.1)
    assert signal.is_red(23.5)
    assert signal.is_red(4.9)
    assert abs(red.mean() - 22 / 40) < 0.01


def test_a_single_vehicle_drives_at_its_speed():
    path = follow(np.array([4.0]), np.array([0.0]), np.array([10.0]), TIMES)
    assert path[-1, 0] == pytest.approx(599, abs=2)


def test_followers_never_overlap_nor_reverse_and_stop_at_red():
    rng = np.random.default_rng(0)
    n = 12
    lengths = rng.uniform(1, 15, n)
    fronts = -np.cumsum(np.append(0, lengths[:-1] + rng.uniform(1, 20, n - 1)))
    always_red = Signal(1000.0, 1.0, 500.0)
    path = follow(lengths, fronts, rng.uniform(5, 14, n), TIMES, ((60.0, always_red),))
    assert (np.diff(path, axis=0) >= 0).all()
    assert (path[:, :-1] - lengths[:-1] - path[:, 1:] >= 0.25).all()
    assert path[-1].max() <= 60.5
    assert path[-1, 0] > 57
    # The queue stands at the end.
    assert np.abs(path[-1] - path[-20]).max() < 0.2


def test_green_lets_the_queue_go():
    signal = Signal(1000.0, 500.0, 20.0)
    path = follow(np.array([4.0, 4.0]), np.array([0.0, -8.0]), np.array([10.0, 10.0]), TIMES, ((50.0, signal),))
    assert (path[TIMES < 20] <= 50.5).all()
    assert (path[-1] > 200).all()


def test_a_stop_holds_for_its_dwell_time_only_those_who_dwell():
    lengths, fronts, speeds = np.array([12.0]), np.array([0.0]), np.array([9.0])
    without = follow(lengths, fronts, speeds, TIMES)
    path = follow(lengths, fronts, speeds, TIMES, stop_m=80.0, dwells_s=np.array([10.0]))
    standing = np.isclose(np.diff(path[:, 0]), 0, atol=0.02) & (np.abs(path[:-1, 0] - 80) < 2)
    assert 8 < standing.sum() * 0.1 < 14
    assert path[-1, 0] < without[-1, 0] - 60
    assert np.array_equal(follow(lengths, fronts, speeds, TIMES, stop_m=80.0, dwells_s=np.zeros(1)), without)


def test_half_lengths_bound_every_design():
    for name in (*shapes.BASE_SHAPES["car"], *shapes.BASE_SHAPES["tram_bus"], *shapes.WALKERS, *shapes.RIDERS):
        for design in range(6):
            mesh = shapes.make_object(name, design, np.random.default_rng(design))
            assert np.abs(mesh.vertices[:, 0]).max() <= actors.half_length_m(name) + 0.05, name


def straight(d):
    return d, np.full_like(d, -5.0), np.zeros_like(d)


def lane(**changes):
    settings = {
        "place": straight,
        "start_m": -20.0,
        "end_m": 220.0,
        "names": {"sedan": 0.7, "city_bus": 0.3},
        "speed_mps": (7.0, 12.0),
        "spacing_m": 10.0,
        "lights": ((100.0, Signal(40.0, 18.0, 0.0)),),
    }
    return Lane(**settings | changes)


def test_lane_is_filled_during_the_whole_time_span_and_actors_stay_on_the_ground(axis):
    found = lane_actors(lane(), axis, "train", (0.0, 60.0), (-20.0, 220.0), np.random.default_rng(1), 7000)
    for time_s in (0.0, 20.0, 40.0, 60.0):
        places = np.array([a.pose_at(np.array([time_s]))[0][0] for a in found])
        inside = np.linalg.norm(places[:, :2] - axis.to_map(100.0, -5.0)[0, :2], axis=1) < 100
        assert inside.sum() >= 5
    for actor in found:
        s, t, _ = straight(np.linspace(-100, 300, 4001))
        line = axis.to_map(s, t)
        near = [np.linalg.norm(line - p, axis=1).min() for p in actor.positions if -90 < np.dot(p[:2] - line[1000, :2], np.ones(2)) < 90]
        assert max(near, default=0) < 0.1
        assert (np.diff(actor.times_s) > 0).all()
        assert actor.mesh.labels[0] in (classes.CAR, classes.TRAM_BUS)
        assert np.abs(np.diff(actor.yaws_rad)).max() < 0.5
    ids = [set(np.unique(a.mesh.instances)) for a in found]
    assert sum(map(len, ids)) == len(set.union(*ids))


def test_the_same_object_is_moving_at_one_time_and_standing_at_another(axis):
    found = lane_actors(lane(), axis, "train", (0.0, 60.0), (-20.0, 220.0), np.random.default_rng(1), 0)
    speeds = np.array([a.speed_at(np.arange(0, 60, 1.0)) for a in found])
    assert ((speeds.max(axis=1) > 2) & (speeds.min(axis=1) < 0.05)).sum() >= 3


def test_vehicles_lie_on_the_slope(axis):
    steep = lane_actors(lane(lights=()), axis, "train", (0.0, 5.0), (-20.0, 220.0), np.random.default_rng(1), 0)
    for actor in steep[:5]:
        wheels = actor.mesh.vertices[actor.mesh.vertices[:, 2] < np.quantile(actor.mesh.vertices[:, 2], 0.1)]
        slope = np.polyfit(wheels[:, 0], wheels[:, 2], 1)[0]
        assert abs(slope) < 0.1
    assert any(abs(np.ptp(a.mesh.vertices[:, 0])) > 3 for a in steep)


def test_same_seed_same_traffic_other_seed_other_traffic(axis):
    a, b, c = (lane_actors(lane(), axis, "train", (0.0, 20.0), (-20.0, 220.0), np.random.default_rng(s), 0) for s in (1, 1, 2))
    assert len(a) == len(b)
    assert all(np.array_equal(x.positions, y.positions) for x, y in zip(a, b, strict=True))
    assert len(a) != len(c) or not np.array_equal(a[0].positions, c[0].positions)


def test_walkers_cross_only_while_the_street_has_red(axis):
    signal = Signal(40.0, 18.0, 0.0)
    found = crossing_walkers(axis, 50.0, signal, 5, "train", (0.0, 80.0), np.random.default_rng(0), 100)
    assert len(found) == 5
    for actor in found:
        assert actor.mesh.labels[0] == classes.PEDESTRIAN
        middle = axis.to_map(np.full(1, 50.0), np.zeros(1))[0]
        for time_s in np.arange(0, 80, 0.5):
            place = actor.pose_at(np.array([time_s]))[0][0]
            if np.linalg.norm((place - middle)[:2]) < 6.5:
                assert signal.is_red(time_s)
        ends = np.linalg.norm((actor.positions[[0, -1]] - middle)[:, :2], axis=1)
        assert (ends > terrain.KERB_M).all()


def test_nobody_is_there_when_the_window_is_elsewhere(axis):
    assert actors.lane_actors(lane(), axis, "train", (0.0, 2.0), (900.0, 901.0), np.random.default_rng(0), 0) == []
