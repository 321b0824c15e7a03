"""Boxes and keypoints of objects: analytic boxes, quarter turns, empty input, UTM-size coordinates."""

import numpy as np
import pytest

from streetscan.errors import BadInput
from streetscan.geometry import apply, transform
from streetscan.localization.keypoints import describe_objects


def box_points(length: float, width: float, height: float) -> np.ndarray:
    """Points on the surface of a box about its base's middle, corners included, none on a plane between two parts."""
    a, b, c = (np.linspace(-s / 2, s / 2, 10) for s in (length, width, height))
    grid = np.stack(np.meshgrid(a, b, c + height / 2, indexing="ij"), -1).reshape(-1, 3)
    on_surface = (np.abs(grid[:, 0]) > length / 2 - 1e-9) | (np.abs(grid[:, 1]) > width / 2 - 1e-9)
    return grid[on_surface]


@pytest.mark.parametrize("turn_deg", [0, 20, 45, 75, 130])
def test_a_turned_box_keeps_its_size_and_corners(turn_deg):
    points = apply(transform([3, -2, 1], [0, 0, np.radians(turn_deg)]), box_points(1.6, 0.5, 0.8))
    found = describe_objects(points, [0, len(points)])
    assert np.allclose(np.sort(found.sizes_m[0, :2]), [0.5, 1.6], atol=1e-6)
    assert np.isclose(found.sizes_m[0, 2], 0.8)
    corners = apply(
        transform([3, -2, 1], [0, 0, np.radians(turn_deg)]), [(x, y, z) for x in (-0.8, 0.8) for y in (-0.25, 0.25) for z in (0, 0.8)]
    )
    distances = np.linalg.norm(found.corners[0].reshape(-1, 1, 3) - corners, axis=2)
    assert distances.min(axis=1).max() < 1e-6
    assert distances.min(axis=0).max() < 1e-6
    assert np.allclose(found.corners[0, 0, :, 2], 1)
    assert np.allclose(found.corners[0, 1, :, 2], 1.8)


def test_a_quarter_turn_moves_keypoints_by_one_column():
    points = box_points(1.6, 0.5, 0.8)
    turned = apply(transform(rpy_rad=(0, 0, np.radians(90))), points)
    own, other = describe_objects(points, [0, len(points)]), describe_objects(turned, [0, len(turned)])
    quarters = round((own.yaws_rad[0] + np.pi / 2 - other.yaws_rad[0]) / (np.pi / 2))
    for n in (4, 8, 16):
        moved = apply(transform(rpy_rad=(0, 0, np.radians(90))), own.keypoints(n)[0].reshape(-1, 3)).reshape(own.keypoints(n)[0].shape)
        assert np.allclose(moved, np.roll(other.keypoints(n)[0], -quarters, axis=1), atol=1e-9)


def test_sixteen_keypoints_are_the_mass_centres_of_the_parts():
    rng = np.random.default_rng(0)
    points = rng.uniform(-1, 1, (4000, 3)) * [1.0, 0.5, 1.0]
    found = describe_objects(points, [0, len(points)])
    assert found.keypoints(16).shape == (1, 4, 4, 3)
    # Over all parts with their numbers of points the centres make the whole's.
    assert np.allclose(found.parts[0].mean(axis=(0, 1)), found.centres[0], atol=0.03)
    assert (np.diff(found.parts[0, :, 0, 2]) > 0.3).all()


def test_an_empty_part_has_no_keypoint():
    points = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 2.0)])
    parts = describe_objects(points, [0, 4]).parts
    assert np.isnan(parts).any()
    assert np.isfinite(parts).any()


def test_one_point_and_a_line_are_objects_too():
    points = np.array([(5.0, 5, 5), (0, 0, 0), (1, 0, 0), (2, 0, 0)])
    found = describe_objects(points, [0, 1, 4])
    assert np.allclose(found.sizes_m, [(0, 0, 0), (2, 0, 0)])
    assert np.allclose(found.centres, [(5, 5, 5), (1, 0, 0)])


def test_large_coordinates_lose_nothing():
    points, shift = box_points(1.6, 0.5, 0.8), np.array([456_000.25, 5_428_000.5, 115.0])
    near, far = describe_objects(points, [0, len(points)]), describe_objects(points + shift, [0, len(points)])
    assert np.allclose(near.corners + shift, far.corners, atol=1e-6)
    assert np.allclose(near.parts + shift, far.parts, atol=1e-6, equal_nan=True)


def test_no_object_and_no_such_strategy():
    found = describe_objects(np.empty((0, 3)), [0])
    assert len(found) == 0
    assert found.keypoints(8).shape == (0, 2, 4, 3)
    with pytest.raises(BadInput, match="n_keypoints"):
        found.keypoints(5)
