import numpy as np
import pytest

from streetscan.errors import BadInput
from streetscan.io.label_tiles import read_label_tiles, write_label_tile


def write(path, rows, labels=None, confidence=None):
    n = len(rows)
    labels = np.zeros(n, np.uint8) if labels is None else np.asarray(labels)
    write_label_tile(path, np.asarray(rows), labels, np.ones(n) if confidence is None else np.asarray(confidence))
    return path


def test_parts_make_the_whole(tmp_path):
    paths = [write(tmp_path / "0.npz", [3, 0], [5, 8], [0.25, 1]), write(tmp_path / "1.npz", []), write(tmp_path / "2.npz", [1, 2], [7, 0])]
    labels, confidence = read_label_tiles(paths, 4)
    np.testing.assert_array_equal(labels, [8, 7, 0, 5])
    np.testing.assert_array_equal(confidence, np.array([1, 1, 1, 0.25], np.float32))
    assert labels.dtype == np.uint8
    assert confidence.dtype == np.float32


@pytest.mark.parametrize(
    ("tiles", "message"),
    [
        ([{"rows": [0, 1]}], "1 of 3 voxels are in no part"),
        ([{"rows": [0, 1, 2]}, {"rows": [1]}], "labelled already"),
        ([{"rows": [0, 1, 1]}], "labelled already"),
        ([{"rows": [0, 1, 3]}], "voxel 3 of a grid of 3"),
        ([{"rows": [0, 1, -1]}], "of a grid of 3"),
        ([{"rows": [0, 1, 2], "labels": [0, 1, 255]}], "255, which is no class"),
        ([{"rows": [0, 1, 2], "labels": [0, 1]}], "2 labels"),
        ([{"rows": [0, 1, 2], "confidence": [0, 1, 1.5]}], "confidence"),
        ([{"rows": [0, 1, 2], "confidence": [0, 1, np.nan]}], "confidence"),
    ],
)
def test_bad_parts_are_refused(tmp_path, tiles, message):
    paths = [write(tmp_path / f"{i}.npz", **tile) for i, tile in enumerate(tiles)]
    with pytest.raises(BadInput, match=message):
        read_label_tiles(paths, 3)
