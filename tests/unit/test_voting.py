"""The vote: any constellation's transform is found, a shift of UTM size changes nothing, memory stays small."""

import tracemalloc

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from streetscan.classes import COLUMN, FURNITURE
from streetscan.errors import BadInput
from streetscan.geometry import apply, invert, transform
from streetscan.landmarks import Landmarks
from streetscan.localization.keypoints import ObjectSet, describe_objects
from streetscan.localization.voting import Compatibility, Window, count_pairs, find_compatible, refine_peaks, vote


def constellation(n: int, rng: np.random.Generator) -> tuple[ObjectSet, np.ndarray]:
    """n objects within 28 m, at least 2.5 m apart: posts and boxes of many sizes."""
    places, parts, kinds = [], [], []
    while len(places) < n:
        place = rng.uniform(-28, 28, 2)
        if all(np.hypot(*(place - p)) > 2.5 for p in places):
            places.append(place)
            is_post = rng.random() < 0.5
            size = (0.2, 0.2, rng.uniform(1.2, 2.4)) if is_post else (*rng.uniform(0.6, 2.0, 2), rng.uniform(0.4, 0.9))
            parts.append(
                apply(transform([*place, 0], (0, 0, rng.uniform(0, np.pi))), rng.uniform(-0.5, 0.5, (60, 3)) * size + [0, 0, size[2] / 2])
            )
            kinds.append(COLUMN if is_post else FURNITURE)
    starts = np.cumsum([0, *(len(p) for p in parts)])
    return describe_objects(np.concatenate(parts), starts), np.array(kinds, np.uint8)


def search(observed, landmarks, kinds, n_keypoints=8, window=None):
    window = window or Window()
    pairs = find_compatible(observed, landmarks, kinds)
    return refine_peaks(vote(observed, landmarks, pairs, n_keypoints, window), observed, landmarks, pairs, n_keypoints), pairs


@settings(max_examples=25, deadline=None)
@example(n=5, seed=2798, turn_deg=0.0, shift=(0.0, 0.0, 0.0), n_keypoints=16)
@given(
    n=st.integers(4, 15),
    seed=st.integers(0, 10_000),
    turn_deg=st.floats(-44, 44),
    shift=st.tuples(st.floats(-11.5, 11.5), st.floats(-11.5, 11.5), st.floats(-1.8, 1.8)),
    n_keypoints=st.sampled_from([1, 4, 8, 16]),
)
def test_the_transform_of_any_constellation_is_found(n, seed, turn_deg, shift, n_keypoints):
    landmarks, kinds = constellation(n, np.random.default_rng(seed))
    T = transform(shift, (0, 0, np.radians(turn_deg)))
    peaks, _ = search(landmarks.transformed(invert(T)), landmarks, kinds, n_keypoints)
    assert np.allclose(peaks[0].shift_m, shift, atol=0.02)
    assert np.isclose(peaks[0].turn_rad, np.radians(turn_deg), atol=0.002)
    # A part of an object that holds no point has no keypoint, and that does not agree.
    is_there = np.isfinite(landmarks.keypoints(n_keypoints)).all(axis=-1)
    assert peaks[0].consensus > 0.95 * n * is_there.mean()


@settings(max_examples=25, deadline=None)
@given(
    n=st.integers(4, 15),
    seed=st.integers(0, 10_000),
    origin=st.tuples(st.floats(-800_000, 800_000), st.floats(0, 10_000_000), st.floats(-400, 4000)),
    n_keypoints=st.sampled_from([1, 4, 8, 16]),
)
def test_a_common_shift_of_utm_size_changes_nothing(n, seed, origin, n_keypoints):
    landmarks, kinds = constellation(n, np.random.default_rng(seed))
    T = transform((3.0, -5.0, 0.5), (0, 0, 0.3))
    observed, start = landmarks.transformed(invert(T)), transform(origin)
    far = Landmarks(kinds, landmarks, np.zeros(n)).moved(np.array(origin)).objects
    (near_peak, *_), _ = search(observed, landmarks, kinds, n_keypoints)
    (far_peak, *_), _ = search(observed, far.transformed(invert(start)), kinds, n_keypoints)
    assert np.allclose(far_peak.shift_m, near_peak.shift_m, atol=1e-4)
    assert np.isclose(far_peak.turn_rad, near_peak.turn_rad, atol=1e-5)
    assert np.isclose(far_peak.consensus, near_peak.consensus, atol=1e-3)


@pytest.mark.parametrize("n_keypoints", [1, 4, 8, 16])
def test_most_objects_may_be_wrong(n_keypoints):
    rng = np.random.default_rng(3)
    landmarks, kinds = constellation(25, rng)
    strangers, _ = constellation(20, rng)
    T = transform([4.3, -7.1, 0.4], (0, 0, np.radians(-13.3)))
    # Nine of 29 objects are on the map: the thesis expects 20 to 40 %.
    own = landmarks.select(np.arange(9)).transformed(invert(T))
    observed = ObjectSet(**{k: np.concatenate([v, getattr(strangers, k)]) for k, v in vars(own).items()})
    peaks, _ = search(observed, landmarks, kinds, n_keypoints)
    assert np.allclose(peaks[0].shift_m, T[:3, 3], atol=0.1)
    assert np.isclose(peaks[0].turn_rad, np.radians(-13.3), atol=0.01)
    assert peaks[0].consensus > peaks[1].consensus


def test_the_full_circle_is_searched_within_little_memory():
    landmarks, kinds = constellation(15, np.random.default_rng(8))
    T = transform([-41.0, 33.0, 0.2], (0, 0, np.radians(171)))
    window = Window(turn_deg=180, shift_m=60, turn_step_deg=0.5)
    search(landmarks, landmarks, kinds)  # compile
    tracemalloc.start()
    peaks, _ = search(landmarks.transformed(invert(T)), landmarks, kinds, window=window)
    peak_bytes = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert np.allclose(peaks[0].shift_m, T[:3, 3], atol=0.02)
    assert np.isclose(abs(peaks[0].turn_rad), np.radians(171), atol=0.002)
    assert peak_bytes < 300 * 2**20


def test_a_tall_column_goes_with_slim_blobs_and_furniture_with_blobs_of_its_volume():
    rng = np.random.default_rng(0)

    def boxes(*sizes):
        parts = [np.array([(x, y, z) for x in (0, s[0]) for y in (0, s[1]) for z in (0, s[2])]) for s in sizes]
        return describe_objects(np.concatenate(parts) + rng.normal(0, 1e-9, (8 * len(sizes), 3)), np.arange(len(sizes) + 1) * 8)

    observed = boxes((0.5, 0.4, 1.1), (0.6, 0.4, 1.1), (1.0, 1.0, 0.7), (1.0, 1.0, 1.3))
    landmarks = boxes((0.3, 0.3, 2.0), (1.0, 1.0, 1.0), (0.2, 0.2, 1.0))
    kinds = np.array([COLUMN, FURNITURE, FURNITURE], np.uint8)
    strict = find_compatible(observed, landmarks, kinds, Compatibility(is_slim_furniture_tall=False))
    assert strict.tolist() == [[0, 0]]
    assert find_compatible(observed, landmarks, kinds).tolist() == [[0, 0], [0, 2]]
    wide = Compatibility(min_volume_ratio=0.65, max_volume_ratio=1.35, is_slim_furniture_tall=False)
    assert find_compatible(observed, landmarks, kinds, wide).tolist() == [[0, 0], [2, 1], [3, 1]]
    assert count_pairs(strict) == 1


def test_nothing_to_vote_with():
    none = describe_objects(np.empty((0, 3)), [0])
    landmarks, kinds = constellation(4, np.random.default_rng(0))
    for observed, own, k in ((none, landmarks, kinds), (landmarks, none, np.empty(0, np.uint8)), (none, none, np.empty(0, np.uint8))):
        pairs = find_compatible(observed, own, k)
        assert vote(observed, own, pairs, 8) == []
        assert count_pairs(pairs) == 0


def test_a_row_of_equal_poles_has_no_lead():
    post = np.random.default_rng(1).uniform(-0.1, 0.1, (40, 3)) * [1, 1, 10] + [0, 0, 1]
    points = np.concatenate([post + [4.0 * i, 6, 0] for i in range(-10, 11)])
    row = describe_objects(points, np.arange(22) * 40)
    seen = row.select(np.arange(7, 14))
    peaks, _ = search(seen, row, np.full(21, COLUMN, np.uint8))
    assert 1 - peaks[1].consensus / peaks[0].consensus < 0.05


def test_the_covariance_is_that_of_many_votes():
    rng = np.random.default_rng(2)
    landmarks, kinds = constellation(12, rng)
    T = transform([1.0, 2.0, 0.1], (0, 0, 0.1))
    errors, covariances = [], []
    for _ in range(60):
        moved = landmarks.transformed(invert(T))
        jitter = rng.normal(0, 0.08, (len(moved), 3))
        moved = ObjectSet(
            moved.n_points, moved.centres + jitter, moved.sizes_m, moved.yaws_rad, moved.corners + jitter[:, None, None], moved.parts
        )
        peak = search(moved, landmarks, kinds)[0][0]
        errors.append([*(peak.shift_m - T[:3, 3]), peak.turn_rad - 0.1])
        covariances.append(peak.covariance)
    nees = [e @ np.linalg.solve(c, e) for e, c in zip(np.array(errors), covariances, strict=True)]
    # Four degrees of freedom; Tukey's weights cost some efficiency.
    assert 2 < np.mean(nees) < 8


def test_window_refuses_what_cannot_be():
    assert Window().shape == (121, 121, 21)
    assert len(Window().turns_rad) == 361
    assert len(Window(turn_deg=180).turns_rad) == 1440
    with pytest.raises(BadInput, match="turn_deg"):
        Window(turn_deg=200)
    with pytest.raises(BadInput, match="step_m"):
        Window(step_m=0)
