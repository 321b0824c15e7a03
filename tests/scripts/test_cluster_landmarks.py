"""cluster_landmarks on the street of boxes: labelled, raw, by truth, and in one tile or two."""

import geopandas
import numpy as np
from toy_localization import CRS, LANDMARKS

from scripts import cluster_landmarks
from streetscan.io.arrays import load_npz
from streetscan.io.label_tiles import write_label_tile
from streetscan.landmarks import Landmarks
from streetscan.localization.reference import Reference


def run(files, folder, predictions=(), truth=None):
    """Run the step into a folder; its landmarks."""
    outputs = {"layer_path": folder / "a.gpkg", "landmarks_path": folder / "landmarks.npz", "reference_path": folder / "reference.npz"}
    cluster_landmarks.main(files.map, files.voxels, list(predictions), truth, **outputs, **LANDMARKS)
    return Landmarks.load(folder / "landmarks.npz")


def test_landmarks_are_a_layer_in_the_maps_reference_system(localization_files):
    layer = geopandas.read_file(localization_files.folder / "landmarks.gpkg")
    assert layer.crs == CRS
    assert set(layer["class"]) == {"column", "furniture"}
    assert layer["id"].is_unique
    reference = Reference.load(localization_files.reference, localization_files.landmarks)
    assert reference.crs == CRS
    assert len(reference.landmarks) == len(layer)


def test_true_labels_and_equal_predictions_give_equal_landmarks(localization_files, tmp_path):
    own = Landmarks.load(localization_files.landmarks)
    by_truth = run(localization_files, tmp_path, truth=localization_files.labels)
    assert np.array_equal(own.objects.corners, by_truth.objects.corners)


def test_two_tiles_give_what_one_gives(localization_files, tmp_path):
    rows, labels, confidence = load_npz(localization_files.tile, ("rows", "labels", "confidence"), "label_map")
    halves = [tmp_path / "a.npz", tmp_path / "b.npz"]
    for path, part in zip(halves, (rows % 2 == 0, rows % 2 == 1), strict=True):
        write_label_tile(path, rows[part], labels[part], confidence[part])
    both = run(localization_files, tmp_path, halves)
    assert np.array_equal(both.objects.corners, Landmarks.load(localization_files.landmarks).objects.corners)


def test_a_raw_map_has_more_landmarks(localization_files, tmp_path):
    assert len(run(localization_files, tmp_path)) > len(Landmarks.load(localization_files.landmarks))
