"""The search by points: a known place in a plane of walls, no place for nothing."""

import numpy as np
import pytest

from streetscan.localization.recovery import make_plane_map, search_plane
from streetscan.localization.voting import Window


def yard(rng: np.random.Generator) -> np.ndarray:
    """Points (N, 2) of walls and corners no two of which are alike."""
    parts = []
    for _ in range(14):
        a, yaw, length = rng.uniform(-35, 35, 2), rng.uniform(0, np.pi), rng.uniform(3, 14)
        along = np.arange(0, length, 0.1)[:, None]
        parts.append(a + along * [np.cos(yaw), np.sin(yaw)])
    return np.concatenate(parts)


@pytest.fixture(scope="module")
def plane():
    points = yard(np.random.default_rng(4))
    at_height = np.c_[points, np.full(len(points), 1.5)]
    return points, make_plane_map(at_height, at_height[:, 2])


def seen_from(points: np.ndarray, xy: np.ndarray, yaw: float) -> np.ndarray:
    c, s = np.cos(yaw), np.sin(yaw)
    local = (points - xy) @ np.array([(c, -s), (s, c)])
    return local[np.hypot(*local.T) < 25]


@pytest.mark.parametrize(
    ("window", "shift", "turn_deg"),
    [(Window(), (7.3, -4.1), 31.0), (Window(turn_deg=180, shift_m=60), (-33.0, 24.0), -160.0)],
    ids=["the thesis' window", "the full circle"],
)
def test_a_known_place_is_found(plane, window, shift, turn_deg):
    points, plane_map = plane
    xy, yaw = np.array([3.0, -2.0]), 0.4
    start_xy, start_yaw = xy - shift, yaw - np.radians(turn_deg)
    found = search_plane(plane_map, seen_from(points, xy, yaw), start_xy, start_yaw, window)
    best_shift, best_turn, share = found[0]
    assert np.allclose(best_shift, shift, atol=0.4)
    assert abs((best_turn - np.radians(turn_deg) + np.pi) % (2 * np.pi) - np.pi) < np.radians(0.8)
    assert share > 0.75
    assert found[1][2] < 0.9 * share


@pytest.mark.parametrize("seed", range(4))
def test_leaving_out_poor_places_changes_nothing_about_the_good_ones(plane, seed):
    points, plane_map = plane
    rng = np.random.default_rng(seed)
    seen = seen_from(points, rng.uniform(-5, 5, 2), rng.uniform(-0.5, 0.5))
    whole = search_plane(plane_map, seen, np.zeros(2), 0.0, Window(), n_peaks=8)
    best = whole[0][2]
    for least in (0.5, 0.9):
        part = search_plane(plane_map, seen, np.zeros(2), 0.0, Window(), n_peaks=8, least=least)
        expected = [p for p in whole if p[2] >= least * best]
        assert len(part) >= len(expected)
        for a, b in zip(expected, part, strict=False):
            assert np.array_equal(a[0], b[0])
            assert a[1:] == b[1:]


def test_a_long_bare_wall_has_no_lead():
    x = np.arange(-80, 80, 0.1)
    points = np.concatenate([np.c_[x, np.full(len(x), s * 6.0)] for s in (-1, 1)])
    plane_map = make_plane_map(np.c_[points, np.ones(len(points))], np.ones(len(points)))
    found = search_plane(plane_map, seen_from(points, np.zeros(2), 0.0), np.array([1.0, 0.5]), 0.02, Window())
    assert 1 - found[1][2] / found[0][2] < 0.05


def test_nothing_stands():
    assert make_plane_map(np.array([[0.0, 0, 0]]), np.array([0.0])) is None
    plane_map = make_plane_map(np.array([[0.0, 0, 1]]), np.array([1.0]))
    assert search_plane(plane_map, np.empty((0, 2)), np.zeros(2), 0.0, Window()) == []
