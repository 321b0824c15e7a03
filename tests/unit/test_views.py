"""Views of a map: where the eye stands, what the colours say, what is left out without truth."""

import numpy as np
import pytest

from streetscan.benchmarks import figures, views
from streetscan.classes import CAR, FACADE, GROUND, UNLABELLED
from streetscan.clouds import PointCloud
from streetscan.voxels import VoxelGrid, voxelize


@pytest.fixture(scope="module")
def street(tiny_world):
    grid = voxelize([tiny_world.cloud.points], 0.2)
    rows = grid.find(grid.keys_of(tiny_world.cloud.points))
    true = np.full(len(grid), UNLABELLED, np.uint8)
    true[rows] = tiny_world.labels
    return grid, true


def test_the_eye_stands_on_the_ground_and_looks_along_the_street(street, tiny_world):
    grid, true = street
    place = views.choose_viewpoint(grid.centres, true)
    above = place.position[2] - tiny_world.ground_z_m(place.position[None])[0]
    assert above == pytest.approx(views.EYE_HEIGHT_M, abs=0.4)
    ahead = grid.centres[:, :2] - place.position[:2]
    seen = ahead @ [np.cos(place.yaw_rad), np.sin(place.yaw_rad)] > 0.87 * np.hypot(*ahead.T)
    assert len(set(true[seen].tolist()) - {UNLABELLED}) >= 7


def test_the_eye_finds_the_cars():
    """A long road with cars at one end only."""
    x, y = (a.ravel() for a in np.meshgrid(np.arange(0, 80, 0.5), np.arange(0, 8, 0.5)))
    road = np.c_[x, y, np.zeros(len(x))]
    cars = road[(x > 70) & (y > 2) & (y < 6)] + [0, 0, 1]
    labels = np.r_[np.full(len(road), GROUND), np.full(len(cars), CAR)].astype(np.uint8)
    place = views.choose_viewpoint(np.concatenate([road, cars]), labels)
    to_cars = np.array([75, 4]) - place.position[:2]
    assert np.hypot(*to_cars) < 35
    assert np.cos(place.yaw_rad - np.arctan2(to_cars[1], to_cars[0])) > np.cos(np.radians(30))


def test_the_eye_looks_for_what_is_wanted_within_reach():
    """A long road with cars at one end and a house beside the other."""
    x, y = (a.ravel() for a in np.meshgrid(np.arange(0, 80, 0.5), np.arange(0, 8, 0.5)))
    road = np.c_[x, y, np.zeros(len(x))]
    cars = road[(x > 70) & (y > 2) & (y < 6)] + [0, 0, 1]
    along, up = (a.ravel() for a in np.meshgrid(np.arange(0, 20, 0.5), np.arange(0, 9, 0.5)))
    house = np.c_[along, np.full(len(along), 14.0), up]
    labels = np.repeat(np.uint8([GROUND, CAR, FACADE]), [len(road), len(cars), len(house)])
    place = views.choose_viewpoint(np.concatenate([road, cars, house]), labels, None, [FACADE], 16.0)
    assert np.hypot(*(place.position[:2] - [10, 14])) < 20
    assert np.sin(place.yaw_rad) > 0.3


def test_houses_are_drawn_where_there_are_facades(street, tiny_world):
    grid, true = street
    drawn = set(views.draw_views(grid, true, true, [tiny_world.cloud], width_px=100))
    assert {"true_houses"} <= drawn
    assert "predicted_houses" not in drawn
    ground = np.full_like(true, GROUND)
    assert not [name for name in views.draw_views(grid, ground, ground, [], width_px=100) if name.endswith("houses")]


@pytest.mark.parametrize("label", [GROUND, CAR, UNLABELLED])
def test_one_voxel_is_enough(label):
    place = views.choose_viewpoint(np.array([[5.0, -3.0, 7.0]]), np.array([label], np.uint8))
    assert place.position[2] == pytest.approx(7.0 + views.EYE_HEIGHT_M)


def test_error_colours():
    colours = views.error_colours(np.array([1, 2, 3], np.uint8), np.array([1, 3, UNLABELLED], np.uint8))
    assert colours.tolist() == [list(figures.CORRECT_COLOUR), list(figures.WRONG_COLOUR), list(figures.UNKNOWN_COLOUR)]


@pytest.mark.parametrize("yaw_deg", [0, 30, -60, 89])
def test_the_long_side_lies_across(yaw_deg):
    x, y = (a.ravel() for a in np.meshgrid(np.arange(0, 60, 0.5), np.arange(0, 12, 0.5)))
    points = views._turn(np.c_[x, y, x], np.radians(yaw_deg)) + np.array([1000.0, -500.0, 0])
    assert np.degrees(views._principal_yaw(points)) == pytest.approx(yaw_deg, abs=1.5)
    straight = views._turn(points, -views._principal_yaw(points))
    assert np.ptp(straight[:, 0]) > 4 * np.ptp(straight[:, 1])


def test_all_views_of_a_map_with_truth(street, tiny_world):
    grid, true = street
    predicted = np.where(true == UNLABELLED, GROUND, true).astype(np.uint8)
    predicted[::10] = CAR
    drawn = views.draw_views(grid, predicted, true, [tiny_world.cloud], width_px=200, reach_m=50)
    kinds = ("predicted", "true", "errors", "intensity", "rgb")
    names = {f"{kind}_{side}" for kind in kinds for side in ("top", "street")}
    assert set(drawn) == names | {"true_houses", "intensity_houses", "rgb_houses"}
    known = true != UNLABELLED
    wrong = 100 * np.mean(predicted[known] != true[known])
    heading = drawn["errors_top"].texts[0].get_text()
    assert heading.startswith(f"Errors: {wrong:.1f} % of")
    image = drawn["predicted_street"].axes[0].images[0].get_array()
    assert image.shape == (100, 200, 3)
    # Both ground and cars are seen.
    assert len(np.unique(image.reshape(-1, 3), axis=0)) > 10


@pytest.mark.parametrize("unknown", [None, "all"])
def test_without_truth_there_is_only_the_prediction(street, tiny_world, unknown):
    grid, true = street
    nothing = None if unknown is None else np.full_like(true, UNLABELLED)
    drawn = views.draw_views(grid, np.zeros(len(grid), np.uint8), nothing, [tiny_world.cloud], width_px=100)
    assert {name for name in drawn if not name.startswith(("intensity", "rgb"))} == {"predicted_top", "predicted_street"}
    assert set(views.draw_statistics(np.zeros(4, np.uint8), np.ones(4), nothing if nothing is None else nothing[:4])) == {"class_shares"}


def test_intensity_and_colour_are_those_of_the_points():
    points = np.array([[x, y, 0.05] for x in np.arange(0.05, 4, 0.1) for y in np.arange(0.05, 2, 0.1)])
    left = points[:, 0] < 2
    fields = {"intensity": np.where(left, 100, 900).astype(np.uint16), "rgb": np.where(left[:, None], [255, 0, 0], [0, 0, 255])}
    grid = voxelize([points], 0.1)
    labels = np.zeros(len(grid), np.uint8)
    # In two pieces, so that means are of all pieces.
    clouds = [PointCloud(points[k::2], {n: v[k::2] for n, v in fields.items()}) for k in range(2)]
    drawn = views.draw_views(grid, labels, None, clouds, width_px=200)
    seen = {tuple(c) for c in drawn["rgb_top"].axes[0].images[0].get_array().reshape(-1, 3).tolist()}
    assert seen == {(255, 0, 0), (0, 0, 255), (255, 255, 255)}
    greys = {c[0] for c in drawn["intensity_top"].axes[0].images[0].get_array().reshape(-1, 3).tolist()}
    assert greys == {0, 255}
    # One that was left empty is not drawn, nor one that only some pieces have.
    clouds[0].fields["intensity"][:], clouds[1].fields["intensity"][:] = 7, 7
    del clouds[1].fields["rgb"]
    assert set(views.draw_views(grid, labels, None, clouds, width_px=100)) == {"predicted_top", "predicted_street"}


def test_statistics_count_labelled_voxels_alone():
    true = np.array([GROUND, CAR, UNLABELLED], np.uint8)
    drawn = views.draw_statistics(np.array([GROUND, GROUND, CAR], np.uint8), np.array([0.9, 0.6, 0.5]), true)
    assert set(drawn) == {"class_shares", "reliability"}
    bars = [round(p.get_width(), 3) for p in drawn["class_shares"].axes[0].patches if p.get_width() > 0]
    assert bars == [50.0, 50.0, 100.0]


def test_a_map_of_one_voxel_is_drawn():
    grid = VoxelGrid(np.zeros(3), 0.1, np.zeros((1, 3), np.int32), np.ones(1, np.uint32), np.zeros(1), np.zeros(1, np.float32))
    drawn = views.draw_views(grid, np.zeros(1, np.uint8), None, [PointCloud(np.full((1, 3), 0.05))], width_px=50)
    assert len(drawn) == 2


def test_the_eye_avoids_the_badly_scanned_side():
    """Two equal roads with cars; the scanner passed along one of them."""
    x, y = (a.ravel() for a in np.meshgrid(np.arange(0, 40, 0.5), np.arange(0, 8, 0.5)))
    road = np.c_[x, y, np.zeros(len(x))]
    cars = road[(x > 30) & (y > 2) & (y < 6)] + [0, 0, 1]
    one = np.concatenate([road, cars])
    labels = np.tile(np.r_[np.full(len(road), GROUND), np.full(len(cars), CAR)].astype(np.uint8), 2)
    place = views.choose_viewpoint(np.concatenate([one, one + [0, 100, 0]]), labels, np.repeat([1, 9], len(one)))
    assert place.position[1] > 50
