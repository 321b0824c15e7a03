"""Frames beside frames: figures of made-up sweeps whose answers are known."""

import numpy as np
import pytest

from streetscan.errors import BadInput
from streetscan.frames import LidarFrame
from streetscan.simulation.lidar_realism import compare_figures, describe_frames, draw_comparison, rings_of_order

N_STEPS = 1000


def sweep(range_m=10.0, drop_ring=None, with_rings=True, number=0, height_m=2.0):
    """64 rings of 1000 points from the highest beam down, each from azimuth 0 counter-clockwise; the lowest 32 end on the road."""
    elevations = np.radians(np.linspace(2.0, -24.8, 64))
    points, rings = [], []
    for k, elevation in enumerate(elevations):
        ring = 63 - k
        n = N_STEPS // 2 if ring == drop_ring else N_STEPS
        azimuths = 2 * np.pi * (np.arange(n) + 0.5) / n
        distance = min(range_m, height_m / np.sin(-elevation)) if elevation < 0 else range_m
        level = distance * np.cos(elevation)
        points.append(np.stack([level * np.cos(azimuths), level * np.sin(azimuths), np.full(n, distance * np.sin(elevation))], axis=1))
        rings.append(np.full(n, ring, np.uint16))
    return LidarFrame(number * 100_000_000, np.concatenate(points).astype(np.float32), ring=np.concatenate(rings) if with_rings else None)


def describe(n=3, **settings):
    return describe_frames([sweep(number=k, **settings) for k in range(n)], 2.0, 1.0, 80.0)


def test_rings_tell_themselves_by_the_order_of_the_points():
    frame = sweep()
    assert np.array_equal(rings_of_order(frame.points), frame.ring)
    by_order, by_ring = (describe(with_rings=w) for w in (False, True))
    assert np.array_equal(by_order.returns_per_ring, by_ring.returns_per_ring)


def test_figures_of_a_known_sweep():
    figures = describe()
    assert figures.n_frames == 3
    assert figures.points_per_frame == 64_000
    assert figures.no_return_share == pytest.approx(1 - 64_000 / 133_333.3, abs=1e-4)
    assert (figures.returns_per_ring == N_STEPS).all()
    assert figures.range_shares.sum() == pytest.approx(1)
    lowest = 2.0 / np.tan(np.radians(24.8))
    assert figures.road_radius_m[0] == pytest.approx(lowest, abs=1e-3)
    assert np.isnan(figures.road_radius_m[63])


def test_a_drive_compared_with_itself_is_equal_and_a_lost_ring_shows():
    same = compare_figures(describe(), describe())
    single = same[same["x"] == ""].set_index("statistic")
    assert single.loc["points_per_frame", "ratio"] == 1
    assert single.loc["range_overlap", "drive"] == pytest.approx(1)
    assert single.loc["rings_within_25_percent", "drive"] == 1
    assert single.loc["road_ring_spacing_m", "ratio"] == 1
    lost = compare_figures(describe(drop_ring=40), describe())
    rings = lost[lost["statistic"] == "returns_per_firing_of_ring"].set_index("x")["ratio"]
    assert rings[40] == pytest.approx(0.5)
    assert rings.drop(40).to_numpy() == pytest.approx(np.ones(63))
    assert lost.set_index("statistic").loc["rings_within_25_percent", "drive"] == pytest.approx(63 / 64)
    far = compare_figures(describe(range_m=30.0), describe())
    assert far.set_index("statistic").loc["range_overlap", "drive"] < 0.8
    figure = draw_comparison(lost, "a", "b")
    assert len(figure.axes) == 3


def test_what_cannot_be_compared_is_refused():
    with pytest.raises(BadInput, match="1 of them"):
        describe(n=1)
    few = LidarFrame(0, np.ones((5, 3), np.float32), ring=np.zeros(5, np.uint16))
    with pytest.raises(BadInput, match="1 rings in frame 0"):
        describe_frames([few], 2.0, 1.0, 80.0)
