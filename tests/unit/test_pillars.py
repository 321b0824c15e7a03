"""How much of a pillar is filled, by hand."""

import numpy as np

from streetscan.segmentation.pillars import filled_shares


def column(x, low_m, high_m, size_m=0.1):
    z = np.arange(round(low_m / size_m), round(high_m / size_m))
    return np.column_stack([np.full(len(z), x), np.zeros(len(z)), z]).astype(int)


def shares_of(*columns, size_m=0.1):
    keys = np.concatenate(columns)
    return np.split(filled_shares(keys, (keys[:, 2] + 0.5) * size_m, size_m), np.cumsum([len(c) for c in columns])[:-1])


def test_a_wall_fills_its_pillar_and_a_bus_the_lower_part_of_its_own():
    wall, bus, kerb = shares_of(column(0, 0, 14), column(10, 0.3, 3.2), column(20, 0, 0.1))
    np.testing.assert_allclose(wall, 1)
    np.testing.assert_allclose(bus, 7 / 24)
    np.testing.assert_allclose(kerb, 1 / 24)


def test_what_is_in_one_pillar_counts_together_and_the_next_is_another():
    low, wire, beside = shares_of(column(0, 0, 0.5), column(4, 6.0, 6.1), column(5, 0, 0.5))
    np.testing.assert_allclose(np.concatenate([low, wire]), 2 / 24)
    np.testing.assert_allclose(beside, 1 / 24)


def test_what_lies_below_the_ground_or_too_high_fills_nothing():
    below, above = shares_of(column(0, -1, 0), column(10, 12.5, 13))
    assert not below.any()
    assert not above.any()


def test_neither_order_nor_whole_pillars_of_shift_matter():
    rng = np.random.default_rng(0)
    keys = np.unique(rng.integers(0, 40, (500, 3)), axis=0)
    heights = keys[:, 2] * 0.1
    found = filled_shares(keys, heights, 0.1)
    order = rng.permutation(len(keys))
    np.testing.assert_array_equal(filled_shares(keys[order], heights[order], 0.1), found[order])
    np.testing.assert_array_equal(filled_shares(keys - [15, -20, 0], heights, 0.1), found)


def test_voxels_wider_than_a_pillar_are_pillars():
    wall, low = shares_of(column(0, 0, 12, 1.0), column(1, 0, 1, 1.0), size_m=1.0)
    np.testing.assert_allclose(wall, 12 / 24)
    np.testing.assert_allclose(low, 1 / 24)


def test_no_voxels():
    assert filled_shares(np.empty((0, 3), np.int32), np.empty(0), 0.1).shape == (0,)
