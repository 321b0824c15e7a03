"""Calibration: a known temperature is found, labels stay, the classes' shares move what is undecided, and all of it is in the weights."""

import numpy as np
import pytest
import torch

from streetscan.classes import CAR, COLUMN, GROUND, N_CLASSES
from streetscan.segmentation.c2cnn import C2CNN, Settings
from streetscan.segmentation.confidence import Calibration, calibrate, fit_calibration, fold, mean_loss, sample_weights, score_samples
from streetscan.segmentation.sparse import open_workers
from streetscan.segmentation.training import sample_logits

EVEN = np.full(N_CLASSES, 100)


def draw(logits, rng):
    """Classes drawn with the probabilities the logits say."""
    shares = np.exp(logits) / np.exp(logits).sum(axis=1, keepdims=True)
    return (rng.random((len(logits), 1)) < shares.cumsum(axis=1)).argmax(axis=1)


@pytest.fixture(scope="module")
def overconfident():
    """Logits three times too large."""
    rng = np.random.default_rng(0)
    honest = rng.normal(0, 2, (20_000, N_CLASSES))
    return 3 * honest, draw(honest, rng)


def test_a_known_temperature_is_found(overconfident):
    logits, labels = overconfident
    found = fit_calibration(logits, labels, np.ones(len(labels)), EVEN, 0.0)
    assert found.temperature == pytest.approx(3, rel=0.03)
    np.testing.assert_array_equal(found.apply(logits).argmax(axis=1), logits.argmax(axis=1))


def test_calibrated_confidence_is_the_share_of_right_labels(overconfident):
    logits, labels = overconfident
    found = fit_calibration(logits, labels, np.ones(len(labels)), EVEN, 0.0)
    errors = []
    for of_stage in (logits, found.apply(logits)):
        scores, _ = score_samples(of_stage, labels, EVEN, {})
        errors.append(scores.query("protocol == 'even' and metric == 'calibration_error'")["value"].iloc[0])
    assert errors[0] > 10
    assert errors[1] < 1.5


def test_weights_make_classes_what_they_are_in_the_map():
    labels, n_voxels = np.array([0, 0, 0, 1]), np.array([900, 100, 0, 0, 0, 0, 0, 0, 0])
    weights = sample_weights(labels, n_voxels)
    assert weights.mean() == pytest.approx(1)
    np.testing.assert_allclose(weights, [1.2, 1.2, 1.2, 0.4])


def test_shares_move_what_is_undecided():
    logits = np.zeros((2, N_CLASSES))
    logits[0, [GROUND, COLUMN]] = 1.0, 1.2
    logits[1, [GROUND, COLUMN]] = 1.0, 30.0
    n_voxels = np.full(N_CLASSES, 10)
    n_voxels[GROUND] = 1000
    for power, expected in ((0.0, [COLUMN, COLUMN]), (1.0, [GROUND, COLUMN])):
        found = fit_calibration(logits, np.array(expected), np.ones(2), n_voxels, power)
        np.testing.assert_array_equal(found.apply(logits).argmax(axis=1), expected)


def test_a_class_that_never_occurs_has_a_finite_shift():
    n_voxels = np.array([50, 50, 0, 0, 0, 0, 0, 0, 0])
    found = fit_calibration(np.random.default_rng(0).normal(size=(50, 9)), np.zeros(50, int), np.ones(50), n_voxels, 1.0)
    assert np.isfinite(found.shifts).all()


def test_a_folded_network_gives_calibrated_logits():
    network = C2CNN(Settings(k=9, n_hidden=16), seed=1).eval()
    calibration = Calibration(1.7, np.linspace(-1, 1, N_CLASSES))
    cubes = torch.rand(5, 2, 9, 9, 9, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        before, after = (n(cubes).numpy() for n in (network, fold(network, calibration)))
    np.testing.assert_allclose(after, calibration.apply(before), atol=1e-6)


def test_natural_scores_weigh_samples_as_voxels():
    """One car of two is called ground; of a hundred voxels a car is one."""
    labels = np.array([GROUND, GROUND, CAR, CAR])
    logits = np.zeros((4, N_CLASSES))
    logits[[0, 1, 2, 3], [GROUND, GROUND, GROUND, CAR]] = 5
    n_voxels = np.zeros(N_CLASSES, int)
    n_voxels[[GROUND, CAR]] = 99, 1
    scores, reliability = score_samples(logits, labels, n_voxels, {"vehicle": ["car", "tram_bus"]})
    value = {(r.protocol, r["class"], r.metric): r.value for _, r in scores.iterrows()}
    assert value["even", "ground", "precision"] == pytest.approx(100 * 2 / 3)
    assert value["natural", "ground", "precision"] == pytest.approx(99.5, abs=0.01)
    assert value["natural", "overall", "accuracy"] == pytest.approx(99.5)
    assert value["natural", "group:vehicle", "recall"] == pytest.approx(50)
    assert reliability.groupby("protocol")["n"].sum().to_dict() == pytest.approx({"even": 4, "natural": 4})


def test_calibration_of_a_part(toy_part):
    network = C2CNN(toy_part.settings, seed=3).eval()
    n_voxels = np.array([1000, 800, 0, 0, 0, 0, 500, 0, 0])
    calibrated, scores, reliability = calibrate(network, toy_part, n_voxels, n_voxels, 0.0)
    assert set(scores["stage"]) == set(reliability["stage"]) == {"trained", "calibrated"}
    value = scores.set_index(["stage", "protocol", "class", "metric"])["value"]
    assert value["calibrated", "natural", "overall", "loss"] <= value["trained", "natural", "overall", "loss"]
    assert value["calibrated", "even", "overall", "f"] == value["trained", "even", "overall", "f"]
    assert value["calibrated", "natural", "part", "n_occupied"] == len(toy_part.grid) < value["calibrated", "natural", "part", "n_voxels"]
    with open_workers(1) as workers:
        logits, labels = (t.numpy() for t in sample_logits(calibrated, toy_part, workers))
    expected = value["calibrated", "natural", "overall", "loss"]
    assert mean_loss(logits, labels, sample_weights(labels, n_voxels)) == pytest.approx(expected, abs=1e-5)
