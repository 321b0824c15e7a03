"""The city's image detector: targets and votes with known answers, and that it learns."""

import numpy as np
import pytest
import torch
from toy_detections import picture

from streetscan.calibration.detectors.city import VOTE_PIXELS, CityDetector, CityNetwork, CitySettings, group_votes
from streetscan.calibration.detectors.city_training import (
    ImageSchedule,
    TrainingPicture,
    draw_cut,
    make_picture,
    make_targets,
    train_city_network,
)
from streetscan.calibration.detectors.opening import open_image_detector
from streetscan.classes import CAR, PEDESTRIAN
from streetscan.errors import BadInput
from streetscan.io.weights import save_settings, save_weights

TINY = CitySettings(width=128, channels=(8, 8, 16, 16))
SCHEDULE = ImageSchedule(n_steps=60, batch=2, cut=(96, 128), scales=(1.0, 1.3), averaging=0.8, learning_rate=1e-2)


def pictures(n=4):
    return [make_picture(*picture(k), TINY.width) for k in range(n)]


def two_cars():
    """Two cars that touch in a cut: columns 8 to 31 and 32 to 59 of rows 10 to 29."""
    labels, instances = np.zeros((64, 96), np.uint8), np.zeros((64, 96), np.uint16)
    labels[10:30, 8:60], instances[10:30, 8:32], instances[10:30, 32:60] = 3, 1, 2
    return TrainingPicture(np.zeros((64, 96, 3), np.uint8), labels, instances)


def test_targets_and_votes_are_inverse():
    labels, heat, votes, known = make_targets(two_cars())
    assert heat.max() == pytest.approx(1, abs=0.15)
    probabilities = torch.nn.functional.one_hot(torch.from_numpy(labels.astype(np.int64)), 4).permute(2, 0, 1).float()
    instances, scores = group_votes(probabilities, torch.from_numpy(heat), torch.from_numpy(votes), TINY)
    true = two_cars().instances[::2, ::2]
    assert np.array_equal(instances > 0, known)
    for k in (1, 2):
        assert len(np.unique(instances[true == k])) == 1
    assert len(scores) == 2
    row, column = 5, 4  # the pixel at the first car's corner points to its middle, 5.5 columns and 4.5 rows away
    assert votes[:, row, column] * VOTE_PIXELS == pytest.approx([5.5, 4.5])


def test_pixels_without_a_peak_are_parted_by_what_hangs_together():
    best = torch.zeros(4, 20, 30)
    best[0] = 1
    best[0, 2:8, 2:8] = best[0, 12:18, 20:26] = 0
    best[3, 2:8, 2:8] = best[3, 12:18, 20:26] = 0.9
    instances, scores = group_votes(best, torch.zeros(20, 30), torch.zeros(2, 20, 30), TINY)
    assert len(scores) == 2
    assert instances[4, 4] != instances[14, 22]
    assert scores == pytest.approx([0.9, 0.9])


def test_a_cut_keeps_image_and_truth_together():
    rng = np.random.default_rng(0)
    _, labels, instances = picture(0)
    marked = make_picture(np.repeat(np.where(labels == CAR, 255, 0)[..., None], 3, 2).astype(np.uint8), labels, instances, TINY.width)
    for _ in range(5):
        cut = draw_cut(marked, ImageSchedule(cut=(64, 64)), rng)
        assert cut.image.shape == (64, 64, 3)
        bright = cut.image.mean(axis=2) > cut.image.mean()
        if 0.05 < (cut.labels == 3).mean() < 0.95:
            assert (bright == (cut.labels == 3)).mean() > 0.97


def test_it_learns_a_car_and_a_person(tmp_path):
    network, history = train_city_network(pictures(), TINY, SCHEDULE, 1)
    assert history[-1]["loss"] < history[0]["loss"]
    save_weights(network, tmp_path / "w.safetensors")
    save_settings(TINY, tmp_path / "s.yaml")
    detector = open_image_detector("city", [str(tmp_path / "w.safetensors"), str(tmp_path / "s.yaml")], {})
    image, labels, _ = picture(2)
    found = detector.detect(np.repeat(np.repeat(image, 2, 0), 2, 1))  # any size
    assert found.classes.shape == (192, 256)
    for label in (CAR, PEDESTRIAN):
        true, mine = np.repeat(np.repeat(labels == label, 2, 0), 2, 1), found.classes == label
        assert (true & mine).sum() / (true | mine).sum() > 0.6
    assert len(found.scores) == found.instances.max() >= 2
    assert np.array_equal(found.classes > 0, found.instances > 0)
    again = detector.detect(np.repeat(np.repeat(image, 2, 0), 2, 1))
    assert np.array_equal(found.instances, again.instances)


def test_same_seed_same_numbers():
    schedule = ImageSchedule(n_steps=2, batch=1, cut=(32, 32))
    a, b = (train_city_network(pictures(1), TINY, schedule, 1)[0].state_dict() for _ in range(2))
    assert all(torch.equal(a[name], b[name]) for name in a)


def test_odd_sizes():
    detector = CityDetector(CityNetwork(TINY))
    for shape in ((37, 91, 3), (1, 1, 3), (200, 33, 3)):
        found = detector.detect(np.zeros(shape, np.uint8))
        assert found.classes.shape == found.instances.shape == shape[:2]
    with pytest.raises(BadInput, match="uint8 RGB"):
        detector.detect(np.zeros((4, 4), np.uint8))


def test_bad_settings_and_weights(tmp_path):
    with pytest.raises(BadInput, match="train again"):
        CitySettings(classes=("car",))
    with pytest.raises(BadInput, match="multiples of 16"):
        ImageSchedule(cut=(100, 100))
    with pytest.raises(BadInput, match="no picture"):
        train_city_network([], TINY, SCHEDULE, 1)
    save_weights(CityNetwork(TINY), tmp_path / "w.safetensors")
    save_settings(CitySettings(width=128, channels=(8, 8, 16, 32)), tmp_path / "s.yaml")
    with pytest.raises(BadInput, match="weights made with other settings"):
        CityDetector.load(tmp_path / "w.safetensors", tmp_path / "s.yaml")
    with pytest.raises(BadInput, match="give weights and settings"):
        open_image_detector("city", ["one"], {})
    with pytest.raises(BadInput, match="use city or one of"):
        open_image_detector("sam", ["one"], {})
