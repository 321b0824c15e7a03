"""The worst failures: the largest region of each confusion, with what sets it apart, and pictures of it."""

import numpy as np
import pytest

from streetscan.benchmarks.failures import describe_failures, draw_failures, find_failures
from streetscan.classes import CAR, COLUMN, FACADE, GROUND, PHANTOM, UNLABELLED
from streetscan.voxels import VoxelGrid


def block(low, high):
    return np.stack(np.meshgrid(*(np.arange(a, b) for a, b in zip(low, high, strict=True)), indexing="ij"), axis=-1).reshape(-1, 3)


@pytest.fixture
def scene():
    """A floor of 200 by 60, a wall, two cars of which the larger one is sparse, and a post; labels true and predicted."""
    things = [
        (block((0, 0, 0), (200, 60, 1)), GROUND, 10),
        (block((0, 59, 1), (200, 60, 30)), FACADE, 10),
        (block((20, 10, 1), (60, 28, 12)), CAR, 3),
        (block((120, 10, 1), (140, 28, 12)), CAR, 30),
        (block((90, 57, 1), (92, 59, 20)), COLUMN, 10),
    ]
    keys = np.concatenate([k for k, _, _ in things]).astype(np.int32)
    true = np.repeat([c for _, c, _ in things], [len(k) for k, _, _ in things]).astype(np.uint8)
    counts = np.repeat([n for *_, n in things], [len(k) for k, _, _ in things]).astype(np.uint32)
    order = np.lexsort(keys.T[::-1])
    keys, true, counts = keys[order], true[order], counts[order]
    height = (0.1 * keys[:, 2] + 0.05).astype(np.float32)
    return VoxelGrid(np.array([1000.0, 2000, 100]), 0.1, keys, counts, height + 100.0, height), true


def test_the_largest_region_of_each_confusion_is_found(scene):
    grid, true = scene
    predicted = true.copy()
    cars = true == CAR
    predicted[cars & (grid.keys[:, 0] < 100)] = PHANTOM
    predicted[cars & (grid.keys[:, 0] >= 130)] = PHANTOM
    predicted[true == COLUMN] = FACADE
    unknown = true.copy()
    unknown[0] = UNLABELLED
    failures = find_failures(grid, predicted, unknown, 6)
    assert [(f.true, f.predicted, len(f.rows)) for f in failures] == [(CAR, PHANTOM, 40 * 18 * 11), (COLUMN, FACADE, 2 * 2 * 19)]
    assert (grid.keys[failures[0].rows, 0] < 100).all()
    assert find_failures(grid, predicted, unknown, 1)[0].true == CAR
    assert find_failures(grid, true, true, 6) == []


def test_reasons_say_what_sets_a_failure_apart(scene):
    grid, true = scene
    predicted = true.copy()
    predicted[true == COLUMN] = FACADE
    # Of cars most voxels are dense here: the sparse one is the exception.
    dense = (true == CAR) & (grid.keys[:, 0] >= 100)
    predicted[dense] = PHANTOM
    reasons = {f.true: f.reason for f in find_failures(grid, predicted, true, 6)}
    assert "around it is Facade" in reasons[COLUMN]
    assert reasons[CAR].startswith("30 points a voxel, where Car has 3")


@pytest.mark.parametrize(("of_phantoms", "is_reason"), [(20, True), (1, False)])
def test_a_density_farther_from_the_called_class_is_no_reason(scene, of_phantoms, is_reason):
    """Of 30 points a voxel: phantoms of 20 explain what is called one, phantoms of 1 are farther off than cars of 3."""
    grid, true = scene
    predicted = true.copy()
    predicted[(true == CAR) & (grid.keys[:, 0] >= 100)] = PHANTOM
    post = true == COLUMN
    true[post] = predicted[post] = PHANTOM
    grid.counts[post] = of_phantoms
    (failure,) = find_failures(grid, predicted, true, 1)
    assert failure.reason.startswith("30 points a voxel, where Car has 3 and Phantom 20" if is_reason else "neither density")


def test_failures_are_described_and_drawn(scene):
    grid, true = scene
    predicted = np.where((true == CAR) & (grid.keys[:, 0] < 100), PHANTOM, true)
    failures = find_failures(grid, predicted, true, 3)
    (row,) = describe_failures(grid, failures).to_dict("records")
    assert (row["true"], row["predicted"], row["n_voxels"]) == ("car", "phantom", 40 * 18 * 11)
    assert row["n_points"] == 3 * row["n_voxels"]
    assert (row["x_m"], row["y_m"]) == pytest.approx((1004.0, 2001.9), abs=0.01)
    assert row["lowest_m"] == pytest.approx(0.15)
    figure = draw_failures(grid, predicted, true, failures)
    labelled, real = (axes.images[0].get_array() for axes in figure.axes if axes.images)
    assert (np.asarray(labelled) != np.asarray(real)).any()


def test_heights_may_be_unknown(scene):
    grid, true = scene
    grid.height_m[:] = np.nan
    predicted = np.where(true == COLUMN, FACADE, true)
    assert np.isnan(describe_failures(grid, find_failures(grid, predicted, true, 3))["lowest_m"]).all()
