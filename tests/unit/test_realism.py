"""Statistics of maps whose values are known."""

import numpy as np
import pytest

from streetscan.classes import CAR, FACADE, GROUND, PHANTOM, UNLABELLED
from streetscan.clouds import PointCloud
from streetscan.simulation.meshes import Surface, quads
from streetscan.simulation.raycasting import SceneCaster
from streetscan.simulation.realism import COLUMNS, density_around, describe_map, measure_return_rates
from streetscan.simulation.realism_figures import draw_realism_sheet
from streetscan.simulation.receiver import Receiver
from streetscan.simulation.scene import Scene


def value(table, statistic, group="all", x=None):
    rows = table[(table.statistic == statistic) & (table.group == group)]
    if x is not None:
        rows = rows[np.isclose(rows.x, x)]
    assert len(rows) == 1, rows
    return float(rows.value.iloc[0])


def noisy_street(sigma_m: float, n: int = 60_000, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """A road of 20 x 10 m and a wall of 20 x 10 m, as many points on each."""
    rng = np.random.default_rng(seed)
    road = np.c_[rng.uniform(0, 20, n), rng.uniform(-5, 5, n), rng.normal(0, sigma_m, n) + 0.25]
    wall = np.c_[rng.uniform(0, 20, n), rng.normal(0, sigma_m, n) + 5.25, rng.uniform(0.5, 10.5, n)]
    return np.concatenate([road, wall]) + np.array([1000, 2000, 100]), np.repeat(np.uint8([GROUND, FACADE]), n)


@pytest.mark.parametrize("sigma_m", [0.005, 0.012])
def test_residuals_of_flat_patches_are_the_noise(sigma_m):
    points, labels = noisy_street(sigma_m)
    table = describe_map([(PointCloud(points), labels)], tile_share=1.0)
    assert tuple(table.columns) == COLUMNS
    for surface in ("road", "facade"):
        assert value(table, "plane_residual_m", surface, 0.5) == pytest.approx(sigma_m, rel=0.05)


def test_residuals_of_one_pass_leave_out_the_offset_between_passes():
    points, labels = noisy_street(0.005)
    second = points + np.array([0, 0.03, 0.03])
    time_s = np.r_[np.linspace(0, 10, len(points)), np.linspace(20, 30, len(points))]
    cloud = PointCloud(np.r_[points, second], {"time_s": time_s})
    table = describe_map([(cloud, np.r_[labels, labels])], tile_share=1.0)
    assert value(table, "plane_residual_m", "road_one_pass", 0.5) == pytest.approx(0.005, rel=0.05)
    assert value(table, "plane_residual_m", "road", 0.5) == pytest.approx(np.hypot(0.005, 0.015), rel=0.05)


def test_density_is_counted_on_the_ground_at_its_distance_from_the_track():
    points, labels = noisy_street(0.001)
    table = describe_map([(PointCloud(points), labels)], track=np.array([[1000.0, 2000, 102], [1020, 2000, 102]]), tile_share=1.0)
    assert value(table, "density_per_m2", "ground", 0.0) == pytest.approx(300, rel=0.05)
    unlabelled = describe_map(
        [(PointCloud(points), None)], track=np.c_[np.arange(1000, 1020), np.full((20, 2), [2000, 102])], tile_share=1.0
    )
    assert value(unlabelled, "density_per_m2", "ground", 0.0) == pytest.approx(300, rel=0.05)


def test_density_around_one_place_counts_its_own_time_and_range():
    # 100 points on each square metre of ground within 20 m, and as many of another hour; a wall does not count.
    rng = np.random.default_rng(0)
    ground = np.c_[rng.uniform(0, 40, (160_000, 2)), np.zeros(160_000)]
    wall = np.c_[np.full(5000, 12.5), rng.uniform(0, 40, 5000), rng.uniform(0, 3, 5000)]
    points = np.r_[ground, ground, wall] + [1000.0, 2000.0, 50.0]
    times = np.r_[np.zeros(160_000), np.full(160_000, 100.0), np.zeros(5000)]
    labels = np.uint8([GROUND] * 320_000 + [FACADE] * 5000)
    clouds = [(PointCloud(points[k::2], {"time_s": times[k::2]}), labels[k::2]) for k in range(2)]
    place = np.array([1020.0, 2020.0, 50.0])
    both, one = density_around(clouds, place, 10.0), density_around(clouds, place, 10.0, (0.0, 50.0))
    assert both.x.tolist() == one.x.tolist() == [0.0, 2.0, 4.0, 6.0, 8.0]
    np.testing.assert_allclose(both.value, 200, rtol=0.1)
    np.testing.assert_allclose(one.value, 100, rtol=0.1)
    unlabelled = [(cloud, None) for cloud, _ in clouds]
    np.testing.assert_allclose(density_around(unlabelled, place, 10.0).value, 200, rtol=0.1)


def test_shares_of_classes_and_phantoms():
    labels = np.uint8([GROUND] * 6 + [PHANTOM] * 2 + [UNLABELLED] * 2)
    table = describe_map([(PointCloud(np.random.default_rng(0).uniform(0, 1, (10, 3))), labels)], tile_share=1.0)
    assert value(table, "class_share", "ground") == pytest.approx(0.6)
    assert value(table, "class_share", "unlabelled") == pytest.approx(0.2)
    assert value(table, "phantom_share", "labelled") == pytest.approx(0.25)
    unknown = describe_map([(PointCloud(np.zeros((4, 3))), None)], tile_share=1.0)
    assert "phantom_share" not in set(unknown.statistic)


def test_points_per_voxel_and_stray_points():
    # Eight points in one voxel, two in its neighbour, one far away.
    points = np.r_[np.full((8, 3), 0.05), np.full((2, 3), 0.15), [[3.05, 3.05, 3.05]]]
    labels = np.uint8([CAR] * 10 + [GROUND])
    table = describe_map([(PointCloud(points), labels)], tile_share=1.0)
    assert value(table, "points_per_voxel", "car", 0.5) == 5
    assert value(table, "points_per_voxel", "ground", 0.5) == 1
    assert value(table, "isolated_share") == pytest.approx(1 / 11)


def test_what_a_file_cannot_know_is_left_out():
    points, labels = noisy_street(0.005)
    # A LAS file has a time for every point even where all are 0, and a data set may have no class for phantoms.
    known = labels != PHANTOM
    table = describe_map([(PointCloud(points[known], {"time_s": np.zeros(known.sum())}), labels[known])], tile_share=1.0)
    assert not {"phantom_share", "mixed_share", "edge_width_m"} & set(table.statistic)
    assert not table.group.str.endswith("_one_pass").any()


@pytest.mark.parametrize("step_s", [1e-5, -1e-5])
def test_a_mixed_pixel_in_four_edges_is_found(step_s):
    line = [[x, 10.0 if (x * 10 // 25) % 2 else 11.0, 0] for x in np.arange(0, 12.5, 0.1)]
    points = np.array(line)
    jumps = np.flatnonzero(np.abs(np.diff(points[:, 1])) > 0.5)
    mixed = (points[jumps[0]] + points[jumps[0] + 1]) / 2
    points = np.insert(points, jumps[0] + 1, mixed, axis=0)
    table = describe_map([(PointCloud(points, {"time_s": np.arange(len(points)) * step_s}), None)], tile_share=1.0)
    assert len(jumps) == 4
    assert value(table, "mixed_share") == pytest.approx(1 / 4)
    assert value(table, "edge_width_m") == pytest.approx(0.1 / 4, rel=0.01)


def test_the_order_of_pieces_does_not_change_the_sample():
    points, labels = noisy_street(0.005, n=5000)
    whole = describe_map([(PointCloud(points), labels)])
    pieces = describe_map([(PointCloud(points[a : a + 1000]), labels[a : a + 1000]) for a in range(0, len(points), 1000)])
    assert whole.equals(pieces)


def test_an_empty_map_has_no_statistics():
    assert len(describe_map([(PointCloud(np.empty((0, 3))), None)])) == 0
    assert len(describe_map([])) == 0


def test_return_rate_falls_with_incidence():
    wall = quads(
        np.array([[[10, -200, -50], [10, 200, -50], [10, 200, 50], [10, -200, 50]]], float), Surface(FACADE, "cloth_dark", (9, 9, 9))
    )
    angles = np.radians(np.linspace(0, 85, 4000))
    directions = np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=1).astype(np.float32)
    table = measure_return_rates(
        SceneCaster(Scene(wall)),
        np.zeros((4000, 3)),
        directions,
        np.arange(4000) * 1e-5,
        Receiver(dark_range_m=20),
        np.random.default_rng(0),
    )
    assert value(table, "return_rate", "all", 0.0) == 1.0
    assert value(table, "return_rate", "facade", 80.0) == 0.0
    rates = table[table.group == "all"].sort_values("x").value.to_numpy()
    assert (np.diff(rates) <= 0).all()


def test_the_sheet_draws_what_is_known_and_says_what_is_not(tmp_path):
    points, labels = noisy_street(0.005)
    intensity = np.random.default_rng(1).integers(0, 3000, len(points)).astype(np.uint16)
    full = describe_map([(PointCloud(points, {"intensity": intensity, "time_s": np.arange(len(points)) * 1e-5}), labels)], tile_share=1.0)
    bare = describe_map([(PointCloud(points), None)], tile_share=1.0)
    figure = draw_realism_sheet({"full": full, "bare": bare})
    texts = [t.get_text() for axes in figure.axes for t in axes.texts]
    assert texts.count("not known for these maps") == 2  # density and return rate
    figure.savefig(tmp_path / "sheet.png", dpi=50)
    assert (tmp_path / "sheet.png").stat().st_size > 10_000
