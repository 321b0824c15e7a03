"""Turned copies of a map: the first is the map, the others what turning the points by hand gives."""

import numpy as np
import pytest

from streetscan.classes import UNLABELLED
from streetscan.segmentation.turning import _share_out, turn_map
from streetscan.voxels import voxelize


def make_map(seed: int = 0):
    """A wall of label 1 along x over ground of label 0 on a slope; the grid has true heights."""
    rng = np.random.default_rng(seed)
    ground = np.c_[rng.uniform(0, 8, (4000, 2)), np.zeros(4000)]
    wall = np.c_[rng.uniform(0, 8, 3000), np.full(3000, 4.03), rng.uniform(0.2, 3, 3000)]
    points = np.concatenate([ground, wall]) + [650_000.0, 240_000.0, 100.0]
    slope = 0.05 * (points[:, 0] - 650_000.0)
    points[:, 2] += slope
    grid = voxelize([points], 0.1)
    grid.height_m = (grid.mean_z_m - 100.0 - 0.05 * (grid.centres[:, 0] - 650_000.0)).astype(np.float32)
    labels = (grid.height_m > 0.15).astype(np.uint8)
    return points, grid, labels


def test_one_yaw_is_the_map():
    points, grid, labels = make_map()
    turned, turned_labels = turn_map(lambda: [points], grid, labels, 1)
    assert turned is grid
    assert turned_labels is labels


@pytest.mark.parametrize("n_yaws", [2, 4])
def test_first_copy_is_the_map_and_all_have_its_points(n_yaws):
    points, grid, labels = make_map()
    turned, turned_labels = turn_map(lambda: np.array_split(points, 3), grid, labels, n_yaws)
    first = turned.keys[:, 0] <= grid.keys[:, 0].max()
    np.testing.assert_array_equal(turned.keys[first], grid.keys)
    np.testing.assert_array_equal(turned_labels[first], labels)
    np.testing.assert_allclose(turned.height_m[first], grid.height_m, atol=1e-6)
    assert turned.counts.sum() == n_yaws * len(points)


def test_turned_copy_has_the_walls_direction_heights_and_labels():
    points, grid, labels = make_map()
    turned, turned_labels = turn_map(lambda: [points], grid, labels, 2)
    second = turned.keys[:, 0] > grid.keys[:, 0].max()
    wall = turned.centres[second & (turned_labels == 1)][:, :2]
    along = np.linalg.svd(wall - wall.mean(axis=0), full_matrices=False)[2][0]
    assert abs(along[0]) == pytest.approx(np.cos(np.pi / 4), abs=0.01)
    # Turning does not change what is above ground by how much.
    for label in (0, 1):
        here = grid.height_m[labels == label]
        there = turned.height_m[second & (turned_labels == label)]
        assert there.mean() == pytest.approx(here.mean(), abs=0.08)


def test_copies_lie_apart_and_unlabelled_stays_unlabelled():
    points, grid, labels = make_map()
    labels[:] = UNLABELLED
    turned, turned_labels = turn_map(lambda: [points], grid, labels, 3)
    x = np.unique(turned.keys[:, 0])
    assert (np.diff(x) > 400).sum() == 2
    assert (turned_labels == UNLABELLED).all()


def test_tiles_are_shared_out_among_copies_with_all_that_surrounds_them():
    points, grid, labels = make_map()
    whole, whole_labels = turn_map(lambda: [points], grid, labels, 4)
    shared, shared_labels = turn_map(lambda: np.array_split(points, 3), grid, labels, 4, tile_m=2.0, margin_m=0.4)
    # Every place is labelled in one copy, give or take the voxels that a tile's edge cuts.
    n_labelled = (shared_labels != UNLABELLED).sum()
    assert n_labelled == pytest.approx((whole_labels != UNLABELLED).sum() / 4, rel=0.12)
    assert shared.counts.sum() < 0.6 * whole.counts.sum()
    # A shared voxel is one of the whole copies, and well within a tile it is the same to the last point.
    rows = whole.find(shared.keys)
    assert (rows >= 0).all()
    labelled = np.flatnonzero(shared_labels != UNLABELLED)
    reach = np.abs(whole.keys[:, None] - shared.keys[labelled[::97]]).max(axis=2) <= 2  # 0.3 m in all directions, within the margin
    around = [np.flatnonzero(column) for column in reach.T]
    assert all((shared.find(whole.keys[near]) >= 0).all() for near in around)
    equal = shared.counts[labelled] == whole.counts[rows[labelled]]
    assert equal.all()
    assert (shared_labels[labelled] == whole_labels[rows[labelled]]).mean() > 0.99


def test_a_tiles_edge_splits_no_point_and_gives_none_twice_to_its_own_copy():
    points = np.random.default_rng(1).uniform(-50, 50, (5000, 3))
    is_copied, is_own = _share_out(points[:, :2], 4, 10.0, 1.0)
    assert (is_own.sum(axis=0) == 1).all()
    assert (is_copied >= is_own).all()
    alone = np.all((points[:, :2] % 10.0 > 1.0) & (points[:, :2] % 10.0 < 9.0), axis=1)
    assert (is_copied[:, alone].sum(axis=0) == 1).all()
    assert (is_copied[:, ~alone].sum(axis=0) > 1).all()
