"""Distances and edges that judge a calibration."""

from dataclasses import replace

import numpy as np
import pytest

from streetscan.calibration.alignment import prepare_target
from streetscan.calibration.edges import Bend, EdgeCheck, depth_edges, find_bend, make_shot, paired_gain
from streetscan.calibration.linear_projection import linear_of
from streetscan.calibration.quality import SURE, hausdorff_distance, plane_distances
from streetscan.geometry import apply, invert, transform

K = np.array([[400.0, 0, 320], [0, 400.0, 240], [0, 0, 1]])
T_CAMERA_LIDAR = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])


def check_of(image: np.ndarray, points: np.ndarray) -> EdgeCheck:
    return EdgeCheck([make_shot(image, points, np.eye(4))], np.eye(4))


def board_and_wall() -> tuple[np.ndarray, np.ndarray]:
    """A lidar's rings on a board 8 m ahead, 2 m wide and high, before a wall at 20 m; and the image of it."""
    azimuths, elevations = np.meshgrid(np.radians(np.arange(-30, 30, 0.17)), np.radians(np.arange(-20, 20, 0.4)))
    rays = np.stack([np.ones_like(azimuths), np.tan(azimuths), np.tan(elevations) / np.cos(azimuths)], axis=-1).reshape(-1, 3)
    is_board = (np.abs(8 * rays[:, 1:]) < 1).all(axis=1)
    image = np.full((480, 640, 3), 200, np.uint8)
    image[240 - 50 : 240 + 51, 320 - 50 : 320 + 51] = 60
    return rays * np.where(is_board, 8.0, 20.0)[:, None], image


def boards_and_wall() -> tuple[np.ndarray, np.ndarray]:
    """Eleven narrow boards 8 m ahead, at no even distance, before a wall at 20 m; and the image of them."""
    azimuths, elevations = np.meshgrid(np.radians(np.arange(-35, 35, 0.17)), np.radians(np.arange(-20, 20, 0.4)))
    rays = np.stack([np.ones_like(azimuths), np.tan(azimuths), np.tan(elevations) / np.cos(azimuths)], axis=-1).reshape(-1, 3)
    places = np.arange(-5, 6) * 1.1 + np.array([0.1, -0.2, 0.3, 0, -0.3, 0.2, -0.1, 0.3, -0.2, 0, 0.1])
    is_board = (np.abs(8 * rays[:, 1, None] - places) < 0.2).any(axis=1) & (np.abs(8 * rays[:, 2]) < 1)
    image = np.full((480, 640, 3), 200, np.uint8)
    for place in places:
        left = round(320 - 50 * (place + 0.2))
        image[240 - 50 : 240 + 51, max(left, 0) : max(left + 21, 0)] = 60
    return rays * np.where(is_board, 8.0, 20.0)[:, None], image


def test_depth_edges_are_the_sides_of_what_stands_before_something():
    points, _ = board_and_wall()
    edges = depth_edges(points)
    assert len(edges) > 50
    assert (edges[:, 0] == 8).all()
    assert (np.abs(edges[:, 1]) > 0.9).all()
    assert len(depth_edges(points[points[:, 0] == 20])) == 0
    assert len(depth_edges(np.empty((0, 3)))) == 0


def test_edges_lie_on_edges_under_the_right_calibration_alone():
    points, image = board_and_wall()
    check = check_of(image, points)
    right = linear_of(T_CAMERA_LIDAR, K)
    assert check.distance_px(right) < 2
    assert check.margin_px(right, K) > 0.5
    turned = linear_of(T_CAMERA_LIDAR @ transform(rpy_rad=(0, 0, np.radians(0.5))), K)
    assert check.distance_px(turned) > check.distance_px(right) + 1
    assert check.margin_px(turned, K) < check.margin_px(right, K)
    assert check.distance_px(linear_of(T_CAMERA_LIDAR @ transform(rpy_rad=(0, 0, np.radians(3))), K)) > 5


def turned_by(angle_rad: float) -> np.ndarray:
    return linear_of(T_CAMERA_LIDAR @ transform(rpy_rad=(0, 0, angle_rad)), K)


def find(check: EdgeCheck, off_deg: float = 0.0) -> Bend:
    return find_bend(check, lambda e: turned_by(e + np.radians(off_deg)), np.radians(2), np.radians(0.05))


def test_edges_find_the_turn_that_brings_them_together():
    points, image = boards_and_wall()
    for off_deg in (-0.8, 0.4, 0.0, 0.6):
        found = find(check_of(image, points), off_deg)
        # Edges are blurred by a pixel or two.
        assert np.degrees(found.rad) == pytest.approx(-off_deg, abs=0.2)
        assert np.degrees(found.std_rad) < 0.2


def test_an_image_without_edges_tells_nothing():
    points, image = board_and_wall()
    for check in (check_of(np.full_like(image, 100), points), check_of(image, np.empty((0, 3)))):
        found = find(check)
        assert abs(found.rad) < found.std_rad


def test_edges_of_other_things_hardly_ever_tell_a_turn():
    points, _ = boards_and_wall()
    rng, n_told = np.random.default_rng(0), 0
    for _ in range(10):
        image = np.full((480, 640, 3), 200, np.uint8)
        for column in rng.integers(0, 620, 12):
            image[:, column : column + rng.integers(3, 20)] = 60
        found = find(check_of(image, points))
        n_told += abs(found.rad) > SURE * found.std_rad
    assert n_told <= 1


def test_edges_kept_for_the_check_take_no_part():
    points, image = board_and_wall()
    check, right = check_of(image, points), linear_of(T_CAMERA_LIDAR, K)
    of_all = check.distance_px(right)
    assert min(check.distance_px(right, True), check.distance_px(right, False)) <= of_all
    assert of_all <= max(check.distance_px(right, True), check.distance_px(right, False))


def test_shots_count_together_each_from_its_own_place():
    points, image = board_and_wall()
    right, move = linear_of(T_CAMERA_LIDAR, K), transform([0.8, 0.1, 0], (0, 0, 0.05))
    # The same edges in the axes of a lidar that has moved on, and an image that has not.
    own = make_shot(image, points, np.eye(4))
    moved = replace(own, edges=apply(invert(move), own.edges), T_image_stamp=move)
    check = EdgeCheck([own, moved], np.eye(4))
    assert check.n_points == 2 * len(own.edges)
    assert check.distance_px(right) == pytest.approx(check_of(image, points).distance_px(right))
    assert EdgeCheck([moved], np.eye(4)).distance_px(right) < 2
    assert EdgeCheck([moved], invert(move)).distance_px(right) > 5
    turn = transform(rpy_rad=(0.02, -0.05, 2.0))
    turned = EdgeCheck([moved.turned(turn)], np.eye(4))
    assert turned.distance_px(linear_of(T_CAMERA_LIDAR @ invert(turn), K)) == pytest.approx(
        EdgeCheck([moved], np.eye(4)).distance_px(right)
    )


def test_no_edge_in_view_is_no_number():
    points, image = board_and_wall()
    behind = linear_of(T_CAMERA_LIDAR @ transform(rpy_rad=(0, 0, np.pi)), K)
    assert np.isnan(check_of(image, points).distance_px(behind))


def test_a_gain_is_paired_over_bundles():
    counts = np.full(20, 10)
    noise = np.random.default_rng(0).normal(0, 5, 20)
    gain, std = paired_gain(np.stack([noise + 3.0, noise], axis=1), counts)
    # What both have in common is no noise of the gain.
    assert gain == pytest.approx(0.3)
    assert std < 1e-9
    _, std = paired_gain(np.stack([noise, np.zeros(20)], axis=1), counts)
    assert std == pytest.approx(np.std(noise / 10) / np.sqrt(20), rel=0.3)
    assert np.isnan(paired_gain(np.empty((0, 2)), np.empty(0, int))).all()


def test_distances_from_planes():
    rng = np.random.default_rng(0)
    target = prepare_target(np.c_[rng.uniform(-5, 5, (20_000, 2)), np.zeros(20_000)], np.array([(0.0, 0, 2), (1, 0, 2)]), 500.0)
    distances = plane_distances(np.array([(0, 0, 0.1), (1, 1, -0.2), (0, 0, 3.0)]), target, 0.5)
    np.testing.assert_allclose(distances[:2], [0.1, 0.2], atol=1e-6)
    assert np.isnan(distances[2])


def test_the_hausdorff_distance_is_that_of_the_farthest_point():
    a = np.zeros((1, 3))
    b = np.array([(0.0, 0, 0), (3, 4, 0)])
    assert hausdorff_distance(a, b) == pytest.approx(5)
    assert hausdorff_distance(b, a) == pytest.approx(5)
    assert np.isnan(hausdorff_distance(a, a[:0]))
