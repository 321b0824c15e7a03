"""Calibration: a known temperature is found, labels stay, the classes' shares move what is undecided, and all of it is in the weights."""

import numpy as np
import pytest
import torch
from scipy.special import softmax

from streetscan.classes import CAR, COLUMN, GROUND, N_CLASSES
from streetscan.segmentation import confidence
from streetscan.segmentation.c2cnn import C2CNN, Settings
from streetscan.segmentation.confidence import (
    Calibration,
    calibrate,
    fit_calibration,
    fold,
    mean_loss,
    prior_shifts,
    sample_weights,
    score_samples,
)
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
    return 3 * honest[None], draw(honest, rng)


def test_a_known_temperature_is_found(overconfident):
    logits, labels = overconfident
    found = fit_calibration(logits, labels, np.ones(len(labels)), np.zeros(N_CLASSES))
    assert found.temperature == pytest.approx(3, rel=0.03)
    np.testing.assert_array_equal(found.class_shares(logits).argmax(axis=1), logits[0].argmax(axis=1))


def test_calibrated_confidence_is_the_share_of_right_labels(overconfident):
    logits, labels = overconfident
    found = fit_calibration(logits, labels, np.ones(len(labels)), np.zeros(N_CLASSES))
    errors = []
    for of_stage in (Calibration(1.0, np.zeros(N_CLASSES)), found):
        scores, _ = score_samples(of_stage.class_shares(logits), labels, EVEN, {})
        errors.append(scores.query("protocol == 'even' and metric == 'calibration_error'")["value"].iloc[0])
    assert errors[0] > 10
    assert errors[1] < 1.5


def test_weights_make_classes_what_they_are_in_the_map():
    labels, n_voxels = np.array([0, 0, 0, 1]), np.array([900, 100, 0, 0, 0, 0, 0, 0, 0])
    weights = sample_weights(labels, n_voxels)
    assert weights.mean() == pytest.approx(1)
    np.testing.assert_allclose(weights, [1.2, 1.2, 1.2, 0.4])


def test_shifts_are_what_occurs_over_what_was_trained():
    """Of ground there are ten times the voxels, of both as many samples: ground is expected ten times as often as it was trained."""
    samples = np.repeat([GROUND, COLUMN], 50)
    voxels = np.repeat(np.array([GROUND, COLUMN, 255], np.uint8), [10_000, 1000, 77])
    shifts = prior_shifts(samples, voxels, 0.0)
    assert shifts[GROUND] - shifts[COLUMN] == pytest.approx(np.log(10))
    assert shifts.mean() == pytest.approx(0)
    assert np.isfinite(shifts).all()
    # A training that weighed classes as they occur needs no shift.
    as_they_occur = prior_shifts(samples, voxels, 1.0)
    assert as_they_occur[GROUND] == pytest.approx(as_they_occur[COLUMN], abs=1e-6)


def test_shifts_move_what_is_undecided():
    logits = np.zeros((2, N_CLASSES))
    logits[0, [GROUND, COLUMN]] = 1.0, 1.2
    logits[1, [GROUND, COLUMN]] = 1.0, 30.0
    shifts = np.zeros(N_CLASSES)
    shifts[GROUND] = 4.0
    for power, expected in ((0.0, [COLUMN, COLUMN]), (1.0, [GROUND, COLUMN])):
        found = fit_calibration(logits[None], np.array(expected), np.ones(2), power * shifts)
        np.testing.assert_array_equal(found.class_shares(logits[None]).argmax(axis=1), expected)


def test_a_folded_network_gives_calibrated_logits():
    network = C2CNN(Settings(k=9, n_hidden=16), seed=1).eval()
    calibration = Calibration(1.7, np.linspace(-1, 1, N_CLASSES))
    cubes = torch.rand(5, 2, 9, 9, 9, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        before, after = (n(cubes).numpy() for n in (network, fold(network, calibration)))
    np.testing.assert_allclose(softmax(after, axis=1), calibration.class_shares(before[None]), atol=1e-6)


def test_natural_scores_weigh_samples_as_voxels():
    """One car of two is called ground; of a hundred voxels a car is one."""
    labels = np.array([GROUND, GROUND, CAR, CAR])
    logits = np.zeros((4, N_CLASSES))
    logits[[0, 1, 2, 3], [GROUND, GROUND, GROUND, CAR]] = 5
    n_voxels = np.zeros(N_CLASSES, int)
    n_voxels[[GROUND, CAR]] = 99, 1
    scores, reliability = score_samples(softmax(logits, axis=1), labels, n_voxels, {"vehicle": ["car", "tram_bus"]})
    value = {(r.protocol, r["class"], r.metric): r.value for _, r in scores.iterrows()}
    assert value["even", "ground", "precision"] == pytest.approx(100 * 2 / 3)
    assert value["natural", "ground", "precision"] == pytest.approx(99.5, abs=0.01)
    assert value["natural", "overall", "accuracy"] == pytest.approx(99.5)
    assert value["natural", "group:vehicle", "recall"] == pytest.approx(50)
    assert reliability.groupby("protocol")["n"].sum().to_dict() == pytest.approx({"even": 4, "natural": 4})


@pytest.mark.parametrize("n_turns", [1, 2])
def test_calibration_of_a_part(toy_part, n_turns):
    network = C2CNN(toy_part.settings, seed=3).eval()
    n_voxels = np.array([1000, 800, 0, 0, 0, 0, 500, 0, 0])
    calibrated, scores, reliability = calibrate(network, toy_part, n_voxels, np.zeros(N_CLASSES), n_turns=n_turns)
    assert set(scores["stage"]) == set(reliability["stage"]) == {"trained", "calibrated"}
    value = scores.set_index(["stage", "protocol", "class", "metric"])["value"]
    for metric in ("loss", "calibration_error"):
        assert value["calibrated", "natural", "overall", metric] <= value["trained", "natural", "overall", metric]
    assert value["calibrated", "natural", "part", "n_occupied"] == len(toy_part.grid) < value["calibrated", "natural", "part", "n_voxels"]
    with open_workers(1) as workers:
        turned = [sample_logits(calibrated, toy_part, workers, turn) for turn in range(0, 4, 4 // n_turns)]
    shares = np.mean([softmax(logits.numpy(), axis=1) for logits, _ in turned], axis=0)
    labels = turned[0][1].numpy()
    expected = value["calibrated", "natural", "overall", "loss"]
    assert mean_loss(shares, labels, sample_weights(labels, n_voxels)) == pytest.approx(expected, abs=1e-5)


def test_a_network_that_is_right_already_stays_as_it_is(toy_part, monkeypatch):
    """A temperature that only lowers the loss is not taken, and not a bit of the weights changes."""
    network = C2CNN(toy_part.settings, seed=3).eval()
    worse = Calibration(0.05, np.zeros(N_CLASSES))
    monkeypatch.setattr(confidence, "fit_calibration", lambda *_: worse)
    n_voxels = np.array([1000, 800, 0, 0, 0, 0, 500, 0, 0])
    kept, scores, _ = calibrate(network, toy_part, n_voxels, np.zeros(N_CLASSES))
    assert scores.loc[scores["metric"] == "temperature", "value"].tolist() == [1.0]
    assert all(torch.equal(a, b) for a, b in zip(kept.state_dict().values(), network.state_dict().values(), strict=True))
