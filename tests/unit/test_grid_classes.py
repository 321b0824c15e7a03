"""Grid classes against hand-computed cells, a slope, and point labels of real scans."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from streetscan.errors import BadInput
from streetscan.io.files import read_bytes
from streetscan.registration.grid_classes import (
    GROUND,
    NAMES,
    SETTINGS_OF_THE_REPORT,
    SHORT_OBJECT,
    SPARSE,
    TALL_STRUCTURE,
    GridSettings,
    classes_of_names,
    classify_points,
    correct_feet,
    count_classes,
    elevation_raster,
    estimate_normals,
    find_outliers,
    segment_frame,
)
from streetscan.registration.grid_evaluation import count_confusion, find_mapping, score_grid

FLAT = GridSettings(max_slope=0.0)


def cell_points(x, y, heights_m, sensor_height_m=2.0):
    """Points of one cell at heights above the road, in frame `lidar`."""
    z = np.asarray(heights_m, float) - sensor_height_m
    return np.c_[np.full(len(z), x), np.full(len(z), y), z]


def labels_of(heights_m, grid=FLAT, x=5.1, y=-7.1):
    return set(classify_points(cell_points(x, y, heights_m), 2.0, grid).labels.tolist())


@pytest.mark.parametrize(
    ("heights_m", "expected"),
    [
        ([0, 0.1, 0.2], SPARSE),
        ([0, 0.1, 0.1, 0.2], GROUND),
        ([0, 0.1, 0.1, 0.26], SHORT_OBJECT),
        ([1.1, 1.1, 1.1, 1.1], SHORT_OBJECT),
        ([0.9, 0.9, 0.9, 0.9], GROUND),
        ([0, 0.5, 1.0, 1.5], SHORT_OBJECT),
        ([0, 0.5, 1.0, 2.01], TALL_STRUCTURE),
        ([2.2, 2.2, 2.2, 2.2], TALL_STRUCTURE),
        ([-1.0, 0, 0.5, 1.05], TALL_STRUCTURE),
    ],
)
def test_rules_in_their_order(heights_m, expected):
    assert labels_of(heights_m) == {expected}


def test_thresholds_of_the_report():
    # Words: sensor (2 m) plus 1.2 m, range 3.1 m.
    assert labels_of([3.0, 3.1, 3.19, 3.0], SETTINGS_OF_THE_REPORT) == {SHORT_OBJECT}
    assert labels_of([3.0, 3.1, 3.21, 3.0], SETTINGS_OF_THE_REPORT) == {TALL_STRUCTURE}
    assert labels_of([-0.2, 1, 2, 2.95], SETTINGS_OF_THE_REPORT) == {TALL_STRUCTURE}


def test_cells_are_floors_also_left_of_the_sensor():
    points = np.concatenate([cell_points(x, 0.3, [0, 0, 0, 0]) for x in (-0.01, 0.01)])
    classes = classify_points(points, 2.0, FLAT)
    assert len(set(classes.cell_of_point.tolist())) == 2
    assert (classes.counts.ravel()[classes.cell_of_point] == 4).all()
    cell = classes.cell_of_point[0]
    assert classes.z_mean_m.ravel()[cell] == pytest.approx(-2.0)


def test_outside_nan_and_deep_points_are_sparse():
    inside = cell_points(1, 1, [0] * 5)
    odd = np.array([[500, 0, -2], [np.nan, 0, -2], [1, 1, np.nan], [1, 1, np.inf], [1, 1, -30]], float)
    classes = classify_points(np.concatenate([inside, odd]), 2.0, FLAT)
    assert classes.labels[:5].tolist() == [GROUND] * 5
    assert classes.labels[5:].tolist() == [SPARSE] * 5
    assert (classes.cell_of_point[5:] == -1).all()


def test_empty_and_single_point():
    assert classify_points(np.empty((0, 3)), 2.0).labels.shape == (0,)
    assert segment_frame(np.empty((0, 3)), 2.0).shape == (0,)
    assert classify_points(np.array([[1.0, 1, -2]]), 2.0).labels.tolist() == [SPARSE]


@pytest.mark.parametrize(
    "call",
    [
        lambda: classify_points(np.zeros((4, 2)), 2.0),
        lambda: classify_points(np.zeros((4, 3)), 0.0),
        lambda: GridSettings(cell_m=0),
        lambda: GridSettings(ground_top_m=3.0),
        lambda: classes_of_names(["wall"], "key"),
        lambda: correct_feet(np.zeros((1, 3)), classify_points(np.zeros((1, 3)), 2.0), "shave"),
    ],
)
def test_bad_input(call):
    with pytest.raises(BadInput):
        call()


def test_names_and_counts():
    assert classes_of_names(["ground", "tall_structure"], "key") == (GROUND, TALL_STRUCTURE)
    assert count_classes(np.array([1, 1, 3], np.uint8)).tolist() == [0, 2, 0, 1]
    assert len(NAMES) == 4


def slope_points(slope, rng, reach_m=45.0):
    """A road that climbs ahead of the vehicle, and walls beside it."""
    x = rng.uniform(-reach_m, reach_m, 60_000)
    y = rng.uniform(-8, 8, len(x))
    road = np.c_[x, y, slope * x]
    wall = np.c_[x[:20_000], np.full(20_000, 9.0), slope * x[:20_000] + rng.uniform(0, 4, 20_000)]
    truth = np.r_[np.full(len(road), GROUND), np.full(len(wall), TALL_STRUCTURE)]
    return np.concatenate([road, wall]) - [0, 0, 1.8], truth


def test_ground_follows_a_slope():
    points, truth = slope_points(0.08, np.random.default_rng(0))
    following = classify_points(points, 1.8).labels
    flat = classify_points(points, 1.8, FLAT).labels
    assert (following == truth).mean() > 0.97
    # From the plane under the vehicle the road itself becomes tall 25 m ahead.
    assert (flat[truth == GROUND] == TALL_STRUCTURE).mean() > 0.15


def test_feet():
    rng = np.random.default_rng(0)
    road = np.c_[rng.uniform(0, 6, (4000, 2)), rng.normal(0, 0.01, 4000)]
    wall = np.c_[rng.uniform(0, 6, 2000), np.full(2000, 3.2), rng.uniform(0, 4, 2000)]
    points = np.concatenate([road, wall]) - [0, 0, 2.0]
    classes = classify_points(points, 2.0, FLAT)
    is_foot = (classes.labels[: len(road)] == TALL_STRUCTURE).sum()
    assert is_foot > 100
    fixed = correct_feet(points, classes, "reclassify", 0.1)
    assert (fixed[: len(road)] == GROUND).mean() > 0.99
    assert (fixed[len(road) :][points[len(road) :, 2] > -1.85] == TALL_STRUCTURE).all()
    cut = correct_feet(points, classes, "cut", 0.05)
    assert (cut[: len(road)] == TALL_STRUCTURE).sum() < 5
    assert (cut == SPARSE).sum() > 100
    assert (correct_feet(points, classes, "none") == classes.labels).all()


def test_elevation_is_filled_beside_the_ground_only():
    points = np.concatenate([cell_points(1.5, 1.5, [0.1] * 5), cell_points(2.1, 1.5, [0, 1, 2, 3, 4])])
    classes = classify_points(points, 2.0, FLAT)
    raster = elevation_raster(classes, 1)
    assert raster.ravel()[classes.cell_of_point[0]] == pytest.approx(-1.9)
    assert raster.ravel()[classes.cell_of_point[5]] == pytest.approx(-1.9)
    assert np.isfinite(raster).sum() == 9


def test_outliers_and_normals():
    rng = np.random.default_rng(0)
    plane = np.c_[rng.uniform(-2, 2, (2000, 2)), np.full(2000, -2.0)]
    points = np.concatenate([plane, [[0, 0, 3.0]]])
    outlier = find_outliers(points)
    assert outlier[-1]
    assert outlier[:-1].mean() < 0.05
    normals = estimate_normals(plane)
    assert np.allclose(np.abs(normals[:, 2]), 1, atol=1e-3)
    assert (normals[:, 2] > 0).all()
    assert not find_outliers(np.empty((0, 3))).any()
    assert estimate_normals(np.empty((0, 3))).shape == (0, 3)
    assert segment_frame(np.concatenate([points, [[np.nan] * 3]]), 2.0, outlier_neighbours=20)[-2:].tolist() == [SPARSE, SPARSE]


@settings(max_examples=40, deadline=None)
@given(hnp.arrays(np.float32, st.tuples(st.integers(0, 60), st.just(3)), elements=st.floats(-200, 200, width=32)), st.randoms())
def test_order_of_points_does_not_matter(points, random):
    labels = classify_points(points, 1.8).labels
    order = np.array(random.sample(range(len(points)), len(points)), int)
    assert (classify_points(points[order], 1.8).labels == labels[order]).all()


def test_precision_and_recall_by_hand():
    found = np.array([GROUND, GROUND, TALL_STRUCTURE, SPARSE, SHORT_OBJECT, GROUND], np.uint8)
    ids = np.array([40, 48, 40, 40, 10, 70])  # the last one is vegetation and counts nowhere
    table = score_grid(count_confusion([(found, ids)], find_mapping("semantickitti"))).set_index(["class", "metric"])["value"]
    assert table["ground", "precision"] == 100
    assert table["ground", "recall"] == 50
    assert table["short_object", "recall"] == 100
    assert table["tall_structure", "precision"] == 0
    assert np.isnan(table["tall_structure", "recall"])
    with pytest.raises(BadInput, match="cityscapes"):
        find_mapping("cityscapes")


def test_precision_and_recall_on_semantickitti(shared_data):
    root, frames = shared_data / "semantickitti", []
    for path in sorted(root.glob("0[0125]/velodyne/*.bin.xz")):
        points = np.frombuffer(read_bytes(path), np.float32).reshape(-1, 4)[:, :3]
        ids = np.frombuffer(read_bytes(path.parent.parent / "labels" / path.name.replace(".bin", ".label")), np.uint32) & 0xFFFF
        frames.append((segment_frame(points, 1.73, foot_method="none"), ids))
    table = score_grid(count_confusion(frames, find_mapping("semantickitti"))).set_index(["class", "metric"])["value"]
    assert table["ground", "precision"] > 97
    assert table["ground", "recall"] > 88
    assert table["tall_structure", "precision"] > 88
    assert table["tall_structure", "recall"] > 90
