"""Counts relative to their surroundings, and thinned maps."""

import numpy as np
import pytest

from streetscan.segmentation import density
from streetscan.segmentation.c2cnn import Settings, grid_channels, turn_keys
from streetscan.segmentation.density import mean_counts_around, thin_grid


def by_hand(keys, counts, reach):
    near = (np.abs(keys[:, None, :2] - keys[None, :, :2]) <= reach).all(axis=2)
    return (near * counts).sum(axis=1) / near.sum(axis=1)


@pytest.fixture
def scene():
    rng = np.random.default_rng(0)
    keys = np.unique(rng.integers([-40, -9, 0], [40, 9, 12], (600, 3)), axis=0)
    return keys, rng.integers(1, 30, len(keys))


@pytest.mark.parametrize("reach", [0, 2, 11])
@pytest.mark.parametrize("slab", [7, 512])
def test_means_are_those_of_the_square_of_columns(scene, reach, slab, monkeypatch):
    monkeypatch.setattr(density, "_SLAB", slab)
    order = np.random.default_rng(1).permutation(len(scene[0]))
    keys, counts = (a[order] for a in scene)
    np.testing.assert_allclose(mean_counts_around(keys, counts, reach), by_hand(keys, counts, reach), rtol=1e-5)


def test_the_expected_mean_is_that_of_many_thinnings(scene):
    keys, counts = scene
    rng, share, around = np.random.default_rng(2), 0.2, []
    for _ in range(300):
        kept = rng.binomial(counts, share)
        left = np.flatnonzero(kept)
        means = np.full(len(keys), np.nan)
        means[left] = mean_counts_around(keys[left], kept[left], 11)
        around.append(means)
    np.testing.assert_allclose(np.nanmean(around, axis=0), mean_counts_around(keys, counts, 11, share), rtol=0.1)


def test_turning_a_map_turns_its_means(scene):
    keys, counts = scene
    np.testing.assert_allclose(mean_counts_around(turn_keys(keys, 1), counts, 3), mean_counts_around(keys, counts, 3), rtol=1e-6)


def test_nothing_around_nothing():
    assert mean_counts_around(np.empty((0, 3), int), np.empty(0, int), 3).shape == (0,)


def test_a_denser_scan_has_the_same_local_counts(toy_part):
    settings = Settings(k=9, count_scale="local")
    denser = toy_part.grid.select(np.arange(len(toy_part.grid)))
    denser.counts = toy_part.grid.counts * 7
    np.testing.assert_allclose(grid_channels(denser, settings), grid_channels(toy_part.grid, settings), rtol=1e-5)


def test_thinned_maps_keep_their_share_of_points(toy_part):
    grid, rows = thin_grid(toy_part.grid, 0.25, np.random.default_rng(0))
    assert grid.counts.sum() == pytest.approx(0.25 * toy_part.grid.counts.sum(), rel=0.05)
    assert (grid.counts > 0).all()
    np.testing.assert_array_equal(grid.keys, toy_part.grid.keys[rows])
    np.testing.assert_array_equal(grid.height_m, toy_part.grid.height_m[rows])
    whole, rows = thin_grid(toy_part.grid, 1.0, np.random.default_rng(0))
    np.testing.assert_array_equal(whole.counts, toy_part.grid.counts)
