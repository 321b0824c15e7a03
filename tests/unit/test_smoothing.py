"""Class shares spread over what hangs together, and nowhere else."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from streetscan.classes import CAR, FACADE, GROUND, N_CLASSES
from streetscan.errors import BadInput
from streetscan.segmentation import smoothing as smoothing_module
from streetscan.segmentation.smoothing import Smoothing, smooth_in_slices


def smooth_shares(keys: np.ndarray, shares: np.ndarray, smoothing: Smoothing) -> np.ndarray:
    """All slices together; each voxel is in one."""
    rows, parts = zip(*smooth_in_slices(keys, shares, smoothing), strict=True)
    rows = np.concatenate(rows)
    np.testing.assert_array_equal(np.sort(rows), np.arange(len(keys)))
    return np.concatenate(parts)[np.argsort(rows)]


def shares_of(*of_voxels: dict[int, float]) -> np.ndarray:
    """Rows of shares; what is not given is shared by the other classes."""
    rows = np.zeros((len(of_voxels), N_CLASSES), np.float32)
    for row, given_shares in zip(rows, of_voxels, strict=True):
        row[:] = (1 - sum(given_shares.values())) / (N_CLASSES - len(given_shares))
        row[list(given_shares)] = list(given_shares.values())
    return rows


def test_two_voxels_that_touch_meet_at_the_geometric_mean():
    shares = shares_of({CAR: 0.8}, {CAR: 0.2, FACADE: 0.5})
    found = smooth_shares(np.array([[0, 0, 0], [1, 1, 1]], np.int32), shares, Smoothing(cell_voxels=1, n_rounds=1))
    expected = np.sqrt((shares[0] + 1e-4) * (shares[1] + 1e-4))
    np.testing.assert_allclose(found, np.tile(expected / expected.sum(), (2, 1)), rtol=1e-5)


def test_cells_weigh_as_many_voxels_as_they_hold():
    # Cells of two voxels: three voxels in the first, one in the second.
    keys = np.array([[0, 0, 0], [0, 0, 1], [1, 1, 1], [2, 0, 0]], np.int32)
    shares = shares_of({CAR: 0.9}, {CAR: 0.9}, {CAR: 0.9}, {CAR: 0.1})
    found = smooth_shares(keys, shares, Smoothing(cell_voxels=2, n_rounds=1))
    logs = (3 * np.log(shares[0] + 1e-4) + np.log(shares[3] + 1e-4)) / 4
    np.testing.assert_allclose(found, np.tile(np.exp(logs) / np.exp(logs).sum(), (4, 1)), rtol=1e-5)


def test_nothing_crosses_a_gap():
    keys = np.array([[0, 0, 0], [2, 0, 0], [3, 0, 0]], np.int32)
    shares = shares_of({CAR: 0.9}, {FACADE: 0.9}, {FACADE: 0.6})
    found = smooth_shares(keys, shares, Smoothing(cell_voxels=1, n_rounds=20))
    np.testing.assert_allclose(found[0], (shares[0] + 1e-4) / (shares[0] + 1e-4).sum(), rtol=1e-5)
    np.testing.assert_allclose(found[1], found[2], rtol=1e-5)


@pytest.mark.parametrize("cell_voxels", [1, 2, 3])
def test_ground_and_what_stands_on_it_never_mix(cell_voxels):
    keys = np.array([[x, 0, z] for x in range(6) for z in (-1, 0, 1)], np.int32)
    shares = shares_of(*({GROUND: 0.7, CAR: 0.2} if z < 0 else {GROUND: 0.4, CAR: 0.5} for _, _, z in keys))
    found = smooth_shares(keys, shares, Smoothing(cell_voxels, 10))
    np.testing.assert_allclose(found, (shares + 1e-4) / (shares + 1e-4).sum(axis=1, keepdims=True), rtol=1e-4)


def test_many_rounds_make_one_thing_one_class():
    keys = np.array([[x, y, 5] for x in range(8) for y in range(4)], np.int32)
    rng = np.random.default_rng(1)
    shares = shares_of(*({CAR: 0.5, FACADE: 0.3} if rng.random() < 0.7 else {CAR: 0.3, FACADE: 0.5} for _ in keys))
    assert (shares.argmax(axis=1) != CAR).any()
    found = smooth_shares(keys, shares, Smoothing(1, 64))
    assert (found.argmax(axis=1) == CAR).all()
    # A mean of unsure voxels is unsure; sharper shares are surer of the same class.
    sharper = smooth_shares(keys, shares, Smoothing(1, 64, sharpness=2.0))
    assert (sharper.argmax(axis=1) == CAR).all()
    assert sharper.max() > found.max()


@given(st.integers(1, 3), st.integers(0, 4), st.integers(0, 2**32 - 1))
@settings(deadline=None, max_examples=30)
def test_voxels_beyond_the_reach_have_no_part(cell_voxels, n_rounds, seed):
    rng = np.random.default_rng(seed)
    keys = np.unique(rng.integers(-15, 15, (400, 3)) * [1, 1, 0], axis=0).astype(np.int32)
    shares = rng.dirichlet(np.ones(N_CLASSES), len(keys)).astype(np.float32)
    smoothing = Smoothing(cell_voxels, n_rounds)
    whole = smooth_shares(keys, shares, smoothing)
    np.testing.assert_allclose(whole.sum(axis=1), 1, rtol=1e-5)
    own = np.abs(keys[:, 0]) < 4
    near = np.abs(keys[:, 0]) < 4 + smoothing.reach_voxels
    np.testing.assert_allclose(smooth_shares(keys[near], shares[near], smoothing)[own[near]], whole[own], rtol=1e-4)


def test_no_rounds_and_no_voxels_change_nothing():
    shares = shares_of({CAR: 0.9})
    assert next(smooth_in_slices(np.zeros((1, 3), np.int32), shares, Smoothing()))[1] is shares
    assert smooth_shares(np.empty((0, 3), np.int32), shares[:0], Smoothing(2, 5)).shape == (0, N_CLASSES)


@pytest.mark.parametrize("values", [{"cell_voxels": 0}, {"n_rounds": -1}, {"sharpness": 0.0}])
def test_settings_that_mean_nothing_are_refused(values):
    with pytest.raises(BadInput, match=r"label_map\.smoothing"):
        Smoothing(**values)


@pytest.mark.parametrize("n_together", [1, 37, 150, 399])
def test_a_map_smoothed_in_slices_equals_the_whole(n_together, monkeypatch):
    rng = np.random.default_rng(3)
    keys = np.unique(rng.integers([-90, -4, 0], [90, 4, 3], (400, 3)), axis=0).astype(np.int32)
    shares = rng.dirichlet(np.ones(N_CLASSES), len(keys)).astype(np.float32)
    whole = smooth_shares(keys, shares, Smoothing(2, 5))
    monkeypatch.setattr(smoothing_module, "_MAX_TOGETHER", n_together)
    np.testing.assert_allclose(smooth_shares(keys, shares, Smoothing(2, 5)), whole, rtol=1e-5)
