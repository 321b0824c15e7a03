"""Landmarks of a map: classes, cuts, tile borders, the raw map, files."""

import numpy as np
import pytest
from street_maps import UTM_SHIFT, make_street_reference, sample_map, street

from streetscan.classes import COLUMN, FURNITURE
from streetscan.errors import BadInput
from streetscan.io.geopackage import write_layer
from streetscan.landmarks import Landmarks, LandmarkSettings, cluster_landmarks, mean_points
from streetscan.localization.reference import Reference
from streetscan.voxels import voxelize


@pytest.fixture(scope="module")
def street_points():
    boxes, labels = street()
    return boxes, labels, *sample_map(boxes, labels)


@pytest.fixture(scope="module")
def landmarks(street_points) -> Landmarks:
    _, _, points, labels = street_points
    return cluster_landmarks(points, points[:, 2], labels)


def test_every_column_and_bench_is_one_landmark(street_points, landmarks):
    boxes, labels, *_ = street_points
    for kind in (COLUMN, FURNITURE):
        own, wanted = landmarks.objects.centres[landmarks.kinds == kind, :2], boxes[labels == kind]
        middles = (wanted[:, :2] + wanted[:, 3:5]) / 2
        assert len(own) == len(middles)
        assert np.linalg.norm(own[:, None] - middles, axis=2).min(axis=1).max() < 0.05


def test_landmarks_are_cut_where_objects_of_frames_are(landmarks):
    columns = landmarks.select(landmarks.kinds == COLUMN)
    assert (columns.objects.corners[:, 1, :, 2] < 2.53).all()
    assert (columns.tops_m > 4.9).all()


def test_a_raw_map_makes_landmarks_of_cars_too(street_points, landmarks):
    _, _, points, _ = street_points
    raw = cluster_landmarks(points, points[:, 2], None)
    assert len(raw) > len(landmarks)
    assert set(raw.kinds) == {COLUMN, FURNITURE}


def test_the_order_of_the_points_and_their_tiles_change_nothing(street_points, landmarks):
    _, _, points, labels = street_points
    order = np.random.default_rng(0).permutation(len(points))
    again = cluster_landmarks(points[order], points[order, 2], labels[order])
    assert np.allclose(again.objects.corners, landmarks.objects.corners)
    assert (again.kinds == landmarks.kinds).all()


def test_a_column_that_hangs_is_none():
    rng = np.random.default_rng(0)
    lamp = rng.uniform(-0.1, 0.1, (200, 3)) * [1, 1, 5] + [0, 0, 4]
    assert len(cluster_landmarks(lamp, lamp[:, 2], np.full(200, COLUMN, np.uint8))) == 0


@pytest.mark.parametrize("labels", [None, np.empty(0, np.uint8)])
def test_an_empty_map_has_no_landmarks(labels):
    found = cluster_landmarks(np.empty((0, 3)), np.empty(0), labels)
    assert len(found) == 0
    assert len(found.near(np.zeros(2), 100)) == 0
    assert len(found.to_frame(None)) == 0


def test_mean_points_are_the_same_in_one_chunk_and_many():
    rng = np.random.default_rng(3)
    points = rng.uniform(0, 3, (5000, 3)) + UTM_SHIFT
    grid = voxelize([points], 0.1)
    whole, parts = mean_points(grid, [points]), mean_points(grid, np.array_split(points, 7))
    assert np.allclose(whole, parts, atol=1e-6)
    row = grid.find(grid.keys_of(points[:1]))[0]
    alike = (grid.find(grid.keys_of(points)) == row).nonzero()[0]
    assert np.allclose(whole[row], points[alike].mean(axis=0), atol=1e-6)


def test_landmarks_and_reference_survive_their_files(tmp_path):
    reference = make_street_reference()
    reference.save(tmp_path / "reference.npz")
    placed = reference.landmarks.moved(reference.origin)
    placed.save(tmp_path / "landmarks.npz")
    again = Reference.load(tmp_path / "reference.npz", tmp_path / "landmarks.npz")
    assert again.crs == "EPSG:32632"
    assert np.allclose(again.landmarks.objects.corners, reference.landmarks.objects.corners, atol=1e-6)
    assert np.array_equal(again.cut(np.array([0.0, 0.0]), 40), reference.cut(np.array([0.0, 0.0]), 40))
    frame = placed.to_frame("EPSG:32632")
    assert np.allclose(frame.geometry.centroid.x, placed.objects.corners[:, 0, :, 0].mean(axis=1), atol=0.1)
    write_layer(tmp_path / "landmarks.gpkg", frame, "landmarks")


def test_landmarks_of_another_map_are_refused(tmp_path):
    reference = make_street_reference()
    reference.save(tmp_path / "reference.npz")
    # A kilometre off, and of a street that begins where this one ends.
    for shift_m in (1000.0, 90.0):
        reference.landmarks.moved(reference.origin + [shift_m, 0, 0]).save(tmp_path / "landmarks.npz")
        with pytest.raises(BadInput, match="of them on the map"):
            Reference.load(tmp_path / "reference.npz", tmp_path / "landmarks.npz")
    (tmp_path / "text.npz").write_text("no archive")
    with pytest.raises(BadInput, match="cluster_landmarks"):
        Landmarks.load(tmp_path / "text.npz")


def test_settings_that_cannot_be_are_refused():
    with pytest.raises(BadInput, match="distance_m"):
        LandmarkSettings(distance_m=0)
