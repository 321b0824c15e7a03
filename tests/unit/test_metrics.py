import numpy as np
import pytest

from streetscan.classes import CAR, FACADE, GROUND, MOVABLE_LABELS, N_CLASSES, NAMES, PHANTOM, UNLABELLED, VEGETATION
from streetscan.errors import BadInput
from streetscan.segmentation import metrics
from streetscan.segmentation.metrics import COLUMNS, evaluate_labels

GROUPS = {"vegetation": ["vegetation"], "vehicle": ["car", "tram_bus"], "pole_like": ["column"]}


def evaluate(truth, predicted, confidence=None, n_per_class=1000, seed=0, groups=GROUPS):
    truth, predicted = np.asarray(truth, np.uint8), np.asarray(predicted, np.uint8)
    confidence = np.ones(len(truth), np.float32) if confidence is None else confidence
    rng = np.random.default_rng(seed)
    return evaluate_labels(truth, predicted, confidence, n_per_class=n_per_class, rng=rng, groups=groups)


def value(scores, protocol, name, metric):
    (row,) = scores[(scores.protocol == protocol) & (scores["class"] == name) & (scores.metric == metric)].itertuples(index=False)
    return row.value


#                 predicted: ground facade phantom
CONFUSION = np.array([[6, 1, 1], [0, 4, 0], [2, 0, 0]])


def test_rates_by_hand():
    rates = metrics.rate_classes(CONFUSION)
    np.testing.assert_allclose(rates.precision, [6 / 8, 4 / 5, 0])
    np.testing.assert_allclose(rates.recall, [6 / 8, 1, 0])
    np.testing.assert_allclose(rates.f, [6 / 8, 8 / 9, 0])
    np.testing.assert_allclose(rates.iou, [6 / 10, 4 / 5, 0])
    np.testing.assert_array_equal(rates.n, [8, 4, 2])


def test_undefined_rates_are_nan():
    rates = metrics.rate_classes(np.array([[3, 1, 0], [0, 0, 0], [2, 0, 0]]))
    # Class 1 does not occur, class 2 is never predicted.
    np.testing.assert_array_equal(np.isnan(rates.precision), [False, False, True])
    np.testing.assert_array_equal(np.isnan(rates.recall), [False, True, False])
    np.testing.assert_array_equal(np.isnan(rates.f), [False, True, False])
    np.testing.assert_array_equal(np.isnan(rates.iou), [False, True, False])
    assert rates.precision[1] == 0
    assert rates.f[2] == 0


def test_overall_by_hand():
    rates = metrics.rate_classes(CONFUSION)
    plain = metrics.average_rates(rates, [0, 1, 2])
    assert plain["precision"] == pytest.approx((0.75 + 0.8) / 3)
    assert plain["recall"] == pytest.approx(1.75 / 3)
    assert plain["f"] == pytest.approx(2 / (1 / plain["precision"] + 1 / plain["recall"]))
    weighted = metrics.average_rates(rates, [0, 1], np.array([8, 4, 2]))
    assert weighted["precision"] == pytest.approx((8 * 0.75 + 4 * 0.8) / 12)
    assert weighted["recall"] == pytest.approx((8 * 0.75 + 4 * 1.0) / 12)
    assert weighted["iou"] == pytest.approx((8 * 0.6 + 4 * 0.8) / 12)


def test_overall_counts_what_was_never_predicted_and_skips_what_does_not_occur():
    rates = metrics.rate_classes(np.array([[4, 0, 0], [4, 0, 0], [0, 0, 0]]))
    assert metrics.average_rates(rates, [0, 1, 2])["precision"] == 0.25
    assert metrics.average_rates(rates, [0, 1, 2])["recall"] == 0.5
    assert all(np.isnan(v) for v in metrics.average_rates(rates, [2]).values())
    assert metrics.average_rates(rates, [1])["f"] == 0.0


def test_confusion_counts():
    confusion = metrics.count_confusion(np.array([0, 0, 8, 2], np.uint8), np.array([0, 8, 8, 0], np.uint8))
    assert confusion.sum() == 4
    assert confusion[0, 0] == confusion[0, 8] == confusion[8, 8] == confusion[2, 0] == 1


def test_even_draw():
    truth = np.repeat(np.array([GROUND, CAR, VEGETATION, UNLABELLED], np.uint8), [100, 7, 30, 50])
    rows = metrics.draw_evenly(truth, 1000, np.random.default_rng(0))
    np.testing.assert_array_equal(np.bincount(truth[rows])[[GROUND, CAR, VEGETATION]], [7, 7, 7])
    assert len(np.unique(rows)) == len(rows) == 21
    assert len(metrics.draw_evenly(truth, 5, np.random.default_rng(0))) == 15
    np.testing.assert_array_equal(rows, metrics.draw_evenly(truth, 1000, np.random.default_rng(0)))
    assert len(metrics.draw_evenly(np.full(3, UNLABELLED, np.uint8), 5, np.random.default_rng(0))) == 0


def test_cleaning_by_hand():
    truth = np.array([GROUND, GROUND, GROUND, CAR, PHANTOM, PHANTOM])
    predicted = np.array([GROUND, CAR, PHANTOM, CAR, PHANTOM, GROUND])
    assert metrics.rate_cleaning(truth, predicted, (PHANTOM,)) == pytest.approx((3 / 4, 1 / 2, np.sqrt(3 / 8)))
    assert metrics.rate_cleaning(truth, predicted, MOVABLE_LABELS) == pytest.approx((1 / 3, 2 / 3, np.sqrt(2 / 9)))
    assert np.isnan(metrics.rate_cleaning(truth[:3], predicted[:3], (PHANTOM,))[1:]).all()


def gap(is_right, confidence, weights=None, **more):
    return metrics.calibration_error(metrics.reliability_bins(is_right, confidence, weights, **more))


def test_calibration_by_hand():
    is_right = np.array([True, True, False, True])
    # Two bins: 0.4 with 1 of 1 right, 0.9 with 2 of 3 right.
    error = gap(is_right, np.array([0.4, 0.9, 0.9, 0.9]), n_bins=2)
    assert error == pytest.approx((1 * 0.6 + 3 * (0.9 - 2 / 3)) / 4)
    assert gap(np.ones(5, bool), np.ones(5)) == 0.0
    assert gap(np.zeros(2, bool), np.zeros(2)) == 0.0
    assert np.isnan(gap(np.empty(0, bool), np.empty(0)))


def test_reliability_by_hand():
    bins = metrics.reliability_bins(np.array([False, True, False, True]), np.array([0.05, 0.55, 0.55, 1.0]), n_bins=10)
    assert bins["n"].tolist() == [1, 0, 0, 0, 0, 2, 0, 0, 0, 1]
    assert bins["accuracy"][5] == 0.5
    assert np.isnan(bins["accuracy"][1])
    assert metrics.calibration_error(bins) == pytest.approx((0.05 + 2 * 0.05 + 0) / 4)


def test_weights_of_answers_are_repetitions():
    rng = np.random.default_rng(0)
    is_right, confidence, weights = rng.random(50) < 0.6, rng.random(50), rng.integers(1, 5, 50)
    repeated = gap(np.repeat(is_right, weights), np.repeat(confidence, weights))
    assert gap(is_right, confidence, weights) == pytest.approx(repeated)


def test_a_confident_guesser_is_found_out():
    rng = np.random.default_rng(0)
    confidence = rng.uniform(0, 1, 200_000)
    assert gap(rng.random(200_000) < confidence, confidence) < 0.01
    assert gap(rng.random(200_000) < confidence / 2, confidence) == pytest.approx(0.25, abs=0.01)


def test_groups_by_hand():
    confusion = np.zeros((N_CLASSES, N_CLASSES), int)
    confusion[CAR, CAR], confusion[CAR, 3], confusion[3, CAR], confusion[CAR, GROUND], confusion[GROUND, VEGETATION] = 5, 2, 1, 3, 4
    merged = metrics.merge_classes(confusion, GROUPS)
    np.testing.assert_array_equal(merged, [[0, 0, 0, 0], [0, 8, 0, 3], [0, 0, 0, 0], [4, 0, 0, 0]])


@pytest.mark.parametrize("groups", [{"a": ["lorry"]}, {"a": ["car"], "b": ["car"]}])
def test_bad_groups_are_named(groups):
    with pytest.raises(BadInput, match="group"):
        evaluate([0, 1], [0, 1], groups=groups)


def test_truth_as_prediction_is_perfect(tiny_world):
    truth = np.r_[tiny_world.labels, np.full(10, UNLABELLED, np.uint8)]
    predicted = np.where(truth == UNLABELLED, 0, truth)
    scores, confusion = evaluate(truth, predicted, groups=GROUPS | {"ground": ["ground"]})
    assert tuple(scores.columns) == COLUMNS
    rates = scores[(scores.unit == "%") & (scores.metric != "calibration_error")]
    assert len(rates) > 100
    assert (rates.value == 100.0).all()
    assert (scores[scores.metric == "calibration_error"].value == 0.0).all()
    assert value(scores, "natural", "unlabelled", "left_out") == 70
    wrong = confusion[confusion.truth != confusion.predicted]
    assert (wrong.n == 0).all()
    assert confusion[confusion.protocol == "natural"].n.sum() == len(truth) - 70


def test_wrong_labels_of_unlabelled_voxels_do_not_matter():
    truth = np.array([0, 1, 2, 255, 255], np.uint8)
    a, _ = evaluate(truth, [0, 1, 1, 0, 0])
    b, _ = evaluate(truth, [0, 1, 1, 5, 6])
    assert a.equals(b)


def test_both_protocols_by_hand():
    # Ground 8 (2 wrong as car), car 2 (1 wrong as ground): an even set has 2 of each.
    truth = np.array([GROUND] * 8 + [CAR] * 2)
    predicted = np.array([GROUND] * 6 + [CAR] * 2 + [CAR, GROUND])
    scores, _ = evaluate(truth, predicted)
    assert value(scores, "natural", "car", "precision") == pytest.approx(100 / 3)
    assert value(scores, "natural", "car", "recall") == 50.0
    assert value(scores, "natural", "overall", "accuracy") == pytest.approx(70.0)
    assert value(scores, "natural", "overall_weighted", "recall") == pytest.approx(70.0)
    assert value(scores, "natural", "objects", "recall") == 50.0
    assert value(scores, "natural", "group:vehicle", "recall") == 50.0
    assert np.isnan(value(scores, "natural", "pedestrian", "f"))
    assert np.isnan(value(scores, "natural", "pedestrian", "precision"))
    even = scores[(scores.protocol == "even") & (scores["class"].isin(["car", "ground"]))]
    assert (even.n == 2).all()
    # The weights of the even protocol are the natural shares, too.
    car, ground = (value(scores, "even", name, "recall") for name in ("car", "ground"))
    assert value(scores, "even", "overall_weighted", "recall") == pytest.approx(0.8 * ground + 0.2 * car)
    assert value(scores, "even", "overall", "recall") == pytest.approx((ground + car) / 2)


def test_objects_leave_ground_and_facade_out_of_the_average_only():
    truth = np.array([CAR, CAR, FACADE, GROUND])
    predicted = np.array([CAR, CAR, CAR, CAR])
    scores, _ = evaluate(truth, predicted)
    assert value(scores, "natural", "objects", "recall") == 100.0
    assert value(scores, "natural", "objects", "precision") == 50.0


def test_every_row_is_there_whatever_occurs():
    a, _ = evaluate([0, 1], [0, 1])
    b, _ = evaluate(np.arange(9), np.arange(9)[::-1])
    assert a[["protocol", "class", "metric", "unit"]].equals(b[["protocol", "class", "metric", "unit"]])
    assert set(NAMES) < set(a["class"])
    assert not a.duplicated(["protocol", "class", "metric"]).any()


@pytest.mark.parametrize(
    ("truth", "predicted", "message"),
    [([0, 1], [0], "1 labels for 2"), ([0], [255], "255"), ([255], [0], "no labelled voxel"), ([], [], "no labelled voxel")],
)
def test_bad_input_is_refused(truth, predicted, message):
    with pytest.raises(BadInput, match=message):
        evaluate(truth, predicted)
