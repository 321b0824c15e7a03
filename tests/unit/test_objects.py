import numpy as np
import pytest
from scipy import ndimage

from streetscan.classes import CAR, COLUMN, GROUND, NAMES, OBJECT_LABELS, TRAM_BUS
from streetscan.errors import BadInput
from streetscan.segmentation.ground import add_heights
from streetscan.segmentation.objects import extract_objects, grow_regions
from streetscan.segmentation.samples import vote_labels
from streetscan.voxels import VoxelGrid, pack_keys, voxelize


def grid_of(keys, origin=(650_000.0, 240_000.0, 100.0), size_m=0.5):
    """A grid of the given voxels, sorted, two points in each, and the order they were sorted by."""
    keys = np.asarray(keys, np.int32).reshape(-1, 3)
    order = np.argsort(pack_keys(keys))
    keys = keys[order]
    height = (keys[:, 2] * size_m).astype(np.float32)
    return VoxelGrid(np.array(origin), size_m, keys, np.full(len(keys), 2, np.uint32), origin[2] + height, height), order


def extract(keys, labels, names=("car", "tram_bus", "column"), min_voxels=1, confidence=None):
    grid, order = grid_of(keys)
    confidence = np.ones(len(grid)) if confidence is None else np.asarray(confidence)[order]
    return extract_objects(grid, np.asarray(labels, np.uint8)[order], confidence, names, min_voxels)


def test_regions_join_over_corners_and_part_between_classes():
    keys = np.array([[0, 0, 0], [0, 0, 2], [1, 1, 1], [2, 2, 2], [2, 2, 3], [2, 2, 5]])
    labels = np.array([CAR, CAR, CAR, CAR, COLUMN, COLUMN])
    region = grow_regions(keys, labels)
    assert len(set(region[:4])) == 1
    assert len({region[0], region[4], region[5]}) == 3


def test_regions_equal_a_flood_fill():
    rng = np.random.default_rng(3)
    dense = rng.integers(0, 3, (12, 11, 10)) * (rng.random((12, 11, 10)) < 0.35)
    keys = np.argwhere(dense) - 5
    labels = dense[dense > 0]
    expected = np.zeros_like(dense)
    for label in (1, 2):
        part, _ = ndimage.label(dense == label, structure=np.ones((3, 3, 3)))
        expected += np.where(part, part + 10_000 * label, 0)
    region, expected = grow_regions(keys, labels), expected[dense > 0]
    pairs = np.unique(np.c_[region, expected], axis=0)
    assert len(pairs) == len(np.unique(region)) == len(np.unique(expected))


def test_a_box_by_hand():
    keys = [(x, y, z) for x in range(4) for y in range(2) for z in range(1, 4)]
    (found,) = [extract(keys, [CAR] * len(keys), confidence=np.linspace(0, 1, len(keys)))]
    assert len(found) == 1
    np.testing.assert_allclose(found.centres, [[650_001.0, 240_000.5, 101.25]])
    np.testing.assert_allclose(found.sizes_m, [[2.0, 1.0, 1.5]])
    np.testing.assert_allclose(np.sin(2 * found.yaws_rad), 0, atol=1e-9)
    assert found.n_voxels[0] == 24
    assert found.n_points[0] == 48
    assert found.bases_m[0] == 0.5
    assert found.confidences[0] == pytest.approx(0.5)
    assert found.footprints[0].area == pytest.approx(2.0)


def test_yaw_of_a_turned_box():
    yaw = np.radians(-35)
    at = np.random.default_rng(0).uniform([-4, -1, 0], [4, 1, 1], (60_000, 3))
    turn = np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])
    keys = np.unique(np.floor(np.c_[at[:, :2] @ turn, at[:, 2]] / 0.1).astype(int), axis=0)
    found = extract(keys, [CAR] * len(keys))
    assert len(found) == 1
    assert found.yaws_rad[0] == pytest.approx(yaw, abs=0.02)


def test_small_regions_other_classes_and_order():
    keys = [(9, 0, 0), (0, 0, 0), (0, 0, 1), (5, 5, 5), (20, 0, 0), (20, 0, 1)]
    labels = [TRAM_BUS, COLUMN, COLUMN, CAR, GROUND, GROUND]
    found = extract(keys, labels)
    np.testing.assert_array_equal(found.labels, [TRAM_BUS, CAR, COLUMN])
    np.testing.assert_array_equal(extract(keys, labels, min_voxels=2).labels, [COLUMN])


def test_one_voxel_is_a_box_of_its_size():
    found = extract([(-3, 2, 1)], [CAR])
    np.testing.assert_allclose(found.sizes_m, [[0.5, 0.5, 0.5]])
    np.testing.assert_allclose(found.centres, [[649_998.75, 240_001.25, 100.75]])


def test_nothing_found_is_a_valid_table():
    for found in (extract([(0, 0, 0)], [GROUND]), extract(np.empty((0, 3)), [])):
        frame = found.to_frame("EPSG:23700")
        assert len(frame) == 0
        assert frame.crs.to_epsg() == 23700
        assert list(frame.columns) == list(extract([(0, 0, 0)], [CAR]).to_frame(None).columns)


def test_bad_settings_are_named():
    with pytest.raises(BadInput, match="'lorry'"):
        extract([(0, 0, 0)], [CAR], names=["lorry"])
    with pytest.raises(BadInput, match="min_voxels"):
        extract([(0, 0, 0)], [CAR], min_voxels=0)


def test_the_tiny_streets_objects_are_found(tiny_world):
    points = tiny_world.cloud.points
    grid = add_heights(voxelize([points], 0.1), cell_m=0.5, max_object_m=20.0, max_slope=0.15, step_m=0.2, min_patch_m2=4.0)
    labels = vote_labels(grid, [(points, tiny_world.labels)])
    names = [NAMES[label] for label in OBJECT_LABELS if label != 2]
    found = extract_objects(grid, labels, np.ones(len(grid)), names, 30)
    expected = [o for o in tiny_world.objects if NAMES[o.label] in names]
    assert len(found) == len(expected)
    for thing in expected:
        distance = np.linalg.norm(found.centres[:, :2] - thing.foot[:2], axis=1) + 100.0 * (found.labels != thing.label)
        i = int(np.argmin(distance))
        assert distance[i] < 0.2
        np.testing.assert_allclose(found.sizes_m[i, :2], sorted(thing.size_m[:2], reverse=True), atol=0.35)
        assert -0.1 < found.bases_m[i] < 0.4 or thing.label == 6
        if thing.size_m[0] > 2 * thing.size_m[1]:
            assert found.yaws_rad[i] == pytest.approx(thing.yaw_rad, abs=0.1)
