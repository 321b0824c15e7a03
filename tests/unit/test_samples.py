import logging

import numpy as np
import pytest

from streetscan.classes import CAR, COLUMN, GROUND, N_CLASSES, UNLABELLED
from streetscan.errors import BadInput
from streetscan.segmentation.samples import draw_samples, vote_labels
from streetscan.voxels import voxelize


def test_votes_counted_by_hand():
    points = np.array([[0.5] * 3] * 3 + [[1.5] * 3] * 2 + [[2.5] * 3] + [[-0.5] * 3] * 3)
    #           2 of 3 cars  | tie -> lowest label | no vote | the unlabelled majority has no vote
    labels = np.array([CAR, GROUND, CAR, COLUMN, CAR, UNLABELLED, UNLABELLED, COLUMN, UNLABELLED], np.uint8)
    grid = voxelize([points], 1.0)
    np.testing.assert_array_equal(vote_labels(grid, [(points, labels)]), [COLUMN, CAR, CAR, UNLABELLED])


def test_chunks_do_not_matter(tiny_world):
    points, labels = tiny_world.cloud.points, tiny_world.labels
    grid = voxelize([points], 0.1)
    whole = vote_labels(grid, [(points, labels)])
    parts = vote_labels(grid, zip(np.array_split(points, 11), np.array_split(labels, 11), strict=True))
    np.testing.assert_array_equal(whole, parts)
    # Every voxel's label is that of a most frequent class among its points, computed the slow way for some.
    rows = grid.find(grid.keys_of(points))
    for row in range(0, len(grid), 997):
        votes = np.bincount(labels[(rows == row) & (labels != UNLABELLED)], minlength=N_CLASSES)
        assert whole[row] == (votes.argmax() if votes.any() else UNLABELLED)


def test_points_of_another_map_are_refused():
    grid = voxelize([np.zeros((1, 3))], 1.0)
    with pytest.raises(BadInput, match="voxelize_map"):
        vote_labels(grid, [(np.full((2, 3), 7.0), np.zeros(2, np.uint8))])


def test_labels_that_are_no_class_are_refused():
    grid = voxelize([np.zeros((1, 3))], 1.0)
    with pytest.raises(BadInput, match="77"):
        vote_labels(grid, [(np.zeros((1, 3)), np.array([77], np.uint8))])


LABELS = np.repeat(np.array([GROUND, CAR, COLUMN, UNLABELLED], np.uint8), [500, 100, 5, 50])


def test_as_many_of_each_class_as_there_are(caplog):
    with caplog.at_level(logging.INFO, logger="streetscan"):
        rows, labels = draw_samples(LABELS, 60, np.random.default_rng(0), ["ground", "car"])
    np.testing.assert_array_equal(np.bincount(labels), [60, 0, 0, 0, 0, 60, 0, 5])
    np.testing.assert_array_equal(LABELS[rows], labels)
    assert len(np.unique(rows)) == len(rows)
    assert "class column: 5 voxels of 60" in caplog.text
    assert "class pedestrian: 0 voxels of 60" in caplog.text
    assert labels.dtype == np.uint8


def test_the_seed_decides():
    first, again, other = (draw_samples(LABELS, 50, np.random.default_rng(seed)) for seed in (1, 1, 2))
    for a, b in zip(first, again, strict=True):
        np.testing.assert_array_equal(a, b)
    assert not np.array_equal(first[0], other[0])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"expected": ["car", "tram_bus"]}, "class tram_bus: has no voxel"),
        ({"expected": ["lorry"]}, "'lorry'"),
        ({"n_per_class": 0}, "n_per_class"),
        ({"labels": np.full(3, UNLABELLED, np.uint8)}, "no labelled voxel"),
        ({"labels": np.empty(0, np.uint8)}, "no labelled voxel"),
    ],
)
def test_bad_settings_are_named(changes, message):
    with pytest.raises(BadInput, match=message):
        draw_samples(**{"labels": LABELS, "n_per_class": 3, "rng": np.random.default_rng(0)} | changes)
