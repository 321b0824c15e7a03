"""Pictures whose pixels are known."""

import numpy as np
import pytest

from streetscan.benchmarks.rendering import View, grey_levels, render_cloud, render_top

RED, BLUE = np.uint8([[255, 0, 0]]), np.uint8([[0, 0, 255]])
VIEW = View((0, 0, 0), (10, 0, 0), 101, 61, 90.0)


def test_a_point_ahead_is_in_the_middle_and_left_is_left():
    points = np.array([[10.0, 0, 0], [10, 5, 0], [10, 0, 3]])
    image = render_cloud(points, np.repeat(RED, 3, axis=0), VIEW, point_size_m=0.0, edge_shading=0)
    rows, columns = np.nonzero((image == RED[0]).all(axis=2))
    # 90 degrees across 101 pixels: 50.5 pixels focal length.
    assert sorted(zip(rows.tolist(), columns.tolist(), strict=True)) == [(15, 50), (30, 25), (30, 50)]


def test_the_nearer_point_hides_the_farther_one_whatever_their_order():
    points, paint = np.array([[5.0, 0, 0], [10, 0, 0]]), np.concatenate([RED, BLUE])
    for order in ([0, 1], [1, 0]):
        image = render_cloud(points[order], paint[order], VIEW, edge_shading=0)
        assert (image[30, 50] == RED[0]).all()


def test_points_grow_as_they_come_nearer_and_none_behind_shows():
    sizes = []
    for x in (2.0, 8.0, -2.0):
        image = render_cloud(np.array([[x, 0, 0]]), RED, VIEW, point_size_m=0.4, edge_shading=0)
        sizes.append(int((image == RED[0]).all(axis=2).sum()))
    assert sizes[0] > sizes[1] >= 1
    assert sizes[2] == 0


def test_shading_darkens_what_lies_behind_an_edge_only():
    y, z = np.meshgrid(np.linspace(-8, 8, 400), np.linspace(-5, 5, 300))
    x = np.where(y > 0, 8.0, 10.0)
    points = np.stack([x.ravel(), y.ravel(), z.ravel()], axis=1)
    image = render_cloud(points, np.full((len(points), 3), 200, np.uint8), VIEW, point_size_m=0.3)
    assert image[30, 10, 0] > 190
    assert image[30, 45:56, 0].min() < 160


def test_from_above_north_is_up_and_the_highest_point_wins():
    points = np.array([[0.5, 0.5, 0], [0.5, 0.5, 5], [2.5, 1.5, 1]])
    paint = np.concatenate([RED, BLUE, RED])
    image = render_top(points, paint, pixel_m=1.0, bounds_m=(0, 0, 4, 3))
    assert image.shape == (3, 4, 3)
    assert (image[2, 0] == BLUE[0]).all()
    assert (image[1, 2] == RED[0]).all()
    assert (image[0] == 255).all()


def test_no_points_give_an_empty_picture():
    empty = np.empty((0, 3)), np.empty((0, 3), np.uint8)
    assert (render_cloud(*empty, VIEW, background=(1, 2, 3)) == (1, 2, 3)).all()
    assert (render_top(*empty) == 255).all()


def test_grey_levels_span_the_percentiles():
    grey = grey_levels(np.arange(101.0), 0, 100)
    assert grey[[0, 50, 100], 0].tolist() == [0, 127, 255]
    assert grey_levels(np.full(5, 3.0)).tolist() == [[0, 0, 0]] * 5
    assert grey_levels(np.empty(0)).shape == (0, 3)


@pytest.mark.parametrize("target", [(0, 0, -5), (0, 0, 5)])
def test_looking_straight_up_or_down_works(target):
    image = render_cloud(np.array([target], float), RED, View((0, 0, 0), target, 51, 51), edge_shading=0)
    assert (image[25, 25] == RED[0]).all()
