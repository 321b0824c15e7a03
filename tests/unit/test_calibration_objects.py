"""Objects of hand-made clouds: ground, components, splitting along the height, shape categories."""

import numpy as np
import pytest

from streetscan.calibration.objects import (
    FLAT,
    LINEAR,
    SCATTERED,
    UNSHAPED,
    ObjectSettings,
    classify_shapes,
    connect,
    count_columns,
    find_level,
    find_objects,
    majority_shape,
    points_of_cloud,
    shape_voxels,
    voxelize,
)
from streetscan.errors import BadInput
from streetscan.geometry import apply, invert, transform

HEIGHT_M = 1.7


def road(n: int = 40_000) -> np.ndarray:
    rng = np.random.default_rng(0)
    return np.c_[rng.uniform(-14, 14, (n, 2)), np.full(n, -HEIGHT_M)]


def post(x: float, y: float, top_m: float = 2.2, n: int = 600, seed: int = 1) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.c_[x + rng.uniform(-0.05, 0.05, n), y + rng.uniform(-0.05, 0.05, n), rng.uniform(0, top_m, n) - HEIGHT_M]


def board(x: float, y: float, seed: int = 2) -> np.ndarray:
    """A metre and a half wide, two high, facing the sensor."""
    rng = np.random.default_rng(seed)
    return np.c_[np.full(2000, x), y + rng.uniform(-0.75, 0.75, 2000), rng.uniform(0, 2, 2000) - HEIGHT_M]


def bush(x: float, y: float, seed: int = 3) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.array([x, y, 0.6 - HEIGHT_M]) + rng.uniform(-0.6, 0.6, (4000, 3))


def test_objects_and_their_shapes():
    cloud = np.concatenate([road(), post(6, 3), board(9, -4), bush(-7, 5)])
    level = find_level(cloud, np.eye(4))
    found = find_objects(cloud, level)
    assert len(found) == 3
    by_place = {tuple(np.sign(c[:2]).astype(int)): s for c, s in zip(found.objects.centres, found.shapes, strict=True)}
    assert by_place == {(1, 1): LINEAR, (1, -1): FLAT, (-1, 1): SCATTERED}
    np.testing.assert_allclose(found.objects.centres[found.shapes == LINEAR][0, :2], [6, 3], atol=0.02)
    assert count_columns(found.objects) == 1


def test_a_tilted_cloud_is_laid_level():
    T = transform([0, 0, 0], np.radians([3.0, -4.0, 20.0]))
    cloud = apply(T, np.concatenate([road(), post(6, 3), board(9, -4)]))
    level = find_level(cloud, np.eye(4))
    normal = invert(level)[:3, 2]
    assert np.degrees(np.arccos(normal @ T[:3, 2])) < 0.1
    assert np.abs(apply(level, apply(T, road()))[:, 2]).max() < 0.1
    found = find_objects(cloud, level)
    assert len(found) == 2
    np.testing.assert_allclose(apply(level, points_of_cloud(found)), found.points, atol=1e-9)


def test_what_hangs_above_is_split_off():
    crown = np.array([6, 3, 1.95 - HEIGHT_M]) + np.random.default_rng(5).uniform(-0.35, 0.35, (3000, 3))
    cloud = np.concatenate([road(), post(6, 3, top_m=1.1), crown])
    level = find_level(cloud, np.eye(4))
    assert len(find_objects(cloud, level, ObjectSettings(min_height_m=0.3))) == 2
    assert len(find_objects(cloud, level, ObjectSettings(min_height_m=0.3, is_split=False))) == 1


def test_walls_and_what_is_far_off_are_no_objects():
    wall = np.c_[np.random.default_rng(6).uniform(-12, 12, 20_000), np.full(20_000, 8.0), np.random.default_rng(7).uniform(-1.7, 2, 20_000)]
    cloud = np.concatenate([road(), wall, post(6, 3), post(60, 0)])
    assert len(find_objects(cloud, find_level(cloud, np.eye(4)))) == 1


def test_without_ground_nothing_is_level():
    assert np.isnan(find_level(post(6, 3), np.eye(4))).all()
    assert np.isnan(find_level(np.empty((0, 3)), np.eye(4))).all()


def test_an_empty_street_has_no_object():
    found = find_objects(road(), find_level(road(), np.eye(4)))
    assert len(found) == 0
    assert count_columns(found.objects) == 0


@pytest.mark.parametrize(
    ("keys", "components"),
    [
        ([(0, 0, 0), (1, 1, 1), (3, 1, 1)], [0, 0, 1]),
        ([(-1, 0, 0), (0, 0, 0), (0, 0, 2)], [0, 0, 1]),
        ([(5, 5, 5)], [0]),
    ],
)
def test_touching_voxels_belong_together(keys, components):
    np.testing.assert_array_equal(connect(np.array(keys)), components)


def test_negative_coordinates_fall_into_their_own_voxels():
    keys, voxel_of = voxelize(np.array([(-0.1, 0.1, 0.0), (0.1, 0.1, 0.0), (-0.3, 0.1, 0)]), 0.2)
    assert len(keys) == 3
    np.testing.assert_array_equal(keys[voxel_of], [(-1, 0, 0), (0, 0, 0), (-2, 0, 0)])
    assert len(connect(np.empty((0, 3), np.int32))) == 0


def test_categories_of_eigenvalues():
    shares = np.array([(0.8, 0.15, 0.05), (0.5, 0.45, 0.05), (0.4, 0.35, 0.25)])
    np.testing.assert_array_equal(classify_shapes(shares), [LINEAR, FLAT, SCATTERED])


def test_few_points_have_no_shape():
    points = np.array([(0.05, 0.05, 0.05), (0.06, 0.05, 0.05)])
    np.testing.assert_array_equal(shape_voxels(points, *voxelize(points, 0.2)), [UNSHAPED])
    assert majority_shape(np.array([UNSHAPED, UNSHAPED, FLAT])) == FLAT
    assert majority_shape(np.array([UNSHAPED])) == UNSHAPED


def test_settings_are_checked():
    with pytest.raises(BadInput, match="voxel_m"):
        ObjectSettings(voxel_m=0.0)
    with pytest.raises(BadInput, match="above_m"):
        ObjectSettings(above_m=3.0)
