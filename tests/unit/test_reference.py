"""How much of a frame lies on the map, and where the map ends."""

import numpy as np
import pytest
from street_maps import UTM_SHIFT, make_street_reference

from streetscan.geometry import transform
from streetscan.localization.reference import OccupancyGrid


def wall(x0: float, x1: float) -> np.ndarray:
    """Points (N, 3) of a wall along x, 10 cm apart."""
    x, z = np.meshgrid(np.arange(x0, x1, 0.1) + 0.05, np.arange(0, 3, 0.1) + 0.05, indexing="ij")
    return np.c_[x.ravel(), np.full(x.size, 6.05), z.ravel()]


@pytest.mark.parametrize(("shift", "expected"), [((0, 0, 0), 1.0), ((0, 0.2, 0), 0.5), ((0, 0.4, 0), 0.0), ((3.0, 0, 0), 1.0)])
def test_overlap(shift, expected):
    grid = OccupancyGrid(wall(0, 40), 0.2)
    assert grid.overlap(wall(0, 40), transform(shift)) == pytest.approx(expected, abs=0.02)


def test_points_beyond_the_map_do_not_count_unless_nearly_all_are():
    grid = OccupancyGrid(wall(0, 40), 0.2)
    assert grid.overlap(wall(0, 80), np.eye(4)) == pytest.approx(1.0, abs=0.01)
    assert grid.overlap(wall(0, 400), np.eye(4)) == pytest.approx(0.3, abs=0.01)
    assert grid.known_share(wall(0, 80), np.eye(4)) == pytest.approx(0.5, abs=0.01)
    assert grid.known_share(np.empty((0, 3)), np.eye(4)) == 0
    assert grid.overlap(wall(0, 40), transform([1000.0, 0, 0])) == 0
    assert np.isnan(grid.overlap(np.empty((0, 3)), np.eye(4)))
    assert OccupancyGrid(np.empty((0, 3)), 0.2).overlap(wall(0, 1), np.eye(4)) == 0


@pytest.fixture(scope="module")
def reference():
    return make_street_reference()


def test_the_ground_and_its_plane(reference):
    middle = (UTM_SHIFT - reference.origin)[:2]
    expected = UTM_SHIFT[2] - reference.origin[2]
    assert reference.ground_at(middle[None])[0] == pytest.approx(expected, abs=0.02)
    plane = reference.plane_at(middle)
    assert np.allclose(plane, [0, 0, expected], atol=0.02)


def test_what_lies_on_the_map(reference):
    middle = (UTM_SHIFT - reference.origin)[:2]
    assert reference.contains(middle)
    assert not reference.contains(middle + [0, 40.0])
    assert reference.contains(middle + [0, 40.0], margin_m=30)
    assert not reference.contains(middle + [1e6, 0], margin_m=30)
    assert not reference.contains(np.array([np.nan, 0.0]), margin_m=30)


def test_a_cut_holds_what_is_near(reference):
    middle = (UTM_SHIFT - reference.origin)[:2]
    near = reference.cut(middle, 10.0)
    distance = np.hypot(*(reference.static[:, :2] - middle).T)
    assert (distance < 10).sum() <= len(near) < len(reference.static)
    assert np.abs(near[:, :2] - middle).max() < 20
    assert len(reference.cut(middle + 1e5, 10.0)) == 0
