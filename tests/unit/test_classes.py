import numpy as np
import pytest

from streetscan import classes
from streetscan.errors import BadInput

ALL = np.array([*range(classes.N_CLASSES), classes.UNLABELLED], np.uint8)


def test_labels_are_the_positions_of_the_table():
    assert [c.label for c in classes.CLASSES] == list(range(9))
    assert classes.NAMES[classes.TRAM_BUS] == "tram_bus"
    assert classes.LABELS["furniture"] == classes.FURNITURE == 8


def test_codes_colours_and_names_are_distinct():
    assert len(np.unique(classes.las_codes(ALL))) == 10
    assert len(np.unique(classes.colours(ALL), axis=0)) == 10
    assert len(set(classes.NAMES)) == 9


def test_las_codes_come_back():
    codes = classes.las_codes(ALL)
    np.testing.assert_array_equal(codes, [2, 6, 64, 65, 66, 67, 5, 68, 69, 1])
    np.testing.assert_array_equal(classes.labels_of_las_codes(codes), ALL)
    # Low vegetation and never-classified points are none of ours.
    np.testing.assert_array_equal(classes.labels_of_las_codes(np.array([0, 3, 255], np.uint8)), [255, 255, 255])


def test_movable_classes():
    assert {classes.NAMES[label] for label in classes.MOVABLE_LABELS} == {"phantom", "tram_bus", "pedestrian", "car"}
    assert {classes.GROUND, classes.FACADE}.isdisjoint(classes.OBJECT_LABELS)


def test_foreign_ids_are_mapped():
    mapped = classes.map_labels(np.array([1200, 1100, 1200, 0]), {1200: "ground", 1100: "column", 0: "unlabelled", 7: "car"}, "f")
    np.testing.assert_array_equal(mapped, [0, 7, 0, 255])
    assert mapped.dtype == np.uint8
    assert len(classes.map_labels(np.empty(0, int), {}, "f")) == 0


def test_foreign_ids_without_an_entry_or_with_an_unknown_class_are_named():
    with pytest.raises(BadInput, match="class id 1300"):
        classes.map_labels(np.array([1200, 1300]), {1200: "ground"}, "oakland.yaml")
    with pytest.raises(BadInput, match="'lorry'"):
        classes.map_labels(np.array([1]), {1: "lorry"}, "oakland.yaml")


def test_an_error_survives_pickling():
    import pickle

    error = pickle.loads(pickle.dumps(BadInput("map.laz", "holds no point", "give another")))
    assert str(error) == "map.laz: holds no point; give another."
