import numpy as np
import pytest

from streetscan.classes import CAR, GROUND, PHANTOM, UNLABELLED
from streetscan.clouds import PointCloud
from streetscan.errors import BadInput
from streetscan.segmentation.cleaning import keep_classes


def cloud(*labels):
    n = len(labels)
    return PointCloud(np.arange(3.0 * n).reshape(n, 3), {"label": np.array(labels, np.uint8), "id": np.arange(n)})


def test_only_kept_classes_stay_with_their_fields():
    parts = list(keep_classes([cloud(GROUND, PHANTOM, UNLABELLED, GROUND), cloud(CAR), cloud()], ["ground"]))
    assert [len(p) for p in parts] == [2, 0, 0]
    np.testing.assert_array_equal(parts[0].fields["id"], [0, 3])
    np.testing.assert_array_equal(parts[0].points, [[0, 1, 2], [9, 10, 11]])


def test_unlabelled_points_can_be_kept():
    (part,) = keep_classes([cloud(GROUND, UNLABELLED)], ["unlabelled"])
    np.testing.assert_array_equal(part.fields["label"], [UNLABELLED])


def test_unknown_names_and_unlabelled_maps_are_refused():
    with pytest.raises(BadInput, match="'house'"):
        list(keep_classes([cloud(GROUND)], ["house"]))
    with pytest.raises(BadInput, match="label"):
        list(keep_classes([PointCloud(np.zeros((1, 3)))], ["ground"]))
