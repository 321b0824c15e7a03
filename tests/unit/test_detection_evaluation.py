"""Scores of detections whose answer is known by hand."""

import numpy as np
import pandas as pd
import pytest

from streetscan.calibration.detection_evaluation import ImageScores, PointScores, classes_of_points, tabulate_scores
from streetscan.calibration.detectors.image_detections import ImageDetections
from streetscan.calibration.dynamic_objects import DynamicPoints
from streetscan.classes import CAR, PEDESTRIAN, TRAM_BUS
from streetscan.errors import BadInput


def values(*scores) -> pd.Series:
    return tabulate_scores(scores).set_index(["class", "metric"])["value"]


class TestImages:
    labels = np.zeros((20, 40), np.uint8)
    labels[:10, :10], labels[:10, 20:30], labels[15:, :4] = CAR, CAR, PEDESTRIAN
    instances = np.zeros((20, 40), np.uint32)
    instances[:10, :10], instances[:10, 20:30], instances[15:, :4] = 7, 8, 9

    def test_truth_scores_perfectly(self):
        own = np.unique(self.instances, return_inverse=True)[1].reshape(20, 40).astype(np.uint16)
        scores = ImageScores(10)
        scores.add(ImageDetections(self.labels, own, np.ones(3, np.float32)), self.labels, self.instances)
        found = values(scores)
        assert (found.loc[["dynamic", "car", "pedestrian"]] == 100).all()
        assert found.loc["tram_bus"].isna().all()

    def test_half_a_car_called_a_tram(self):
        classes, instances = np.zeros((20, 40), np.uint8), np.zeros((20, 40), np.uint16)
        classes[:10, :6], instances[:10, :6] = CAR, 1  # 60 of 100 pixels
        classes[:10, 20:30], instances[:10, 20:30] = TRAM_BUS, 2
        scores = ImageScores(30)  # the person of 20 pixels is not asked for
        scores.add(ImageDetections(classes, instances, np.ones(2, np.float32)), self.labels, self.instances)
        found = values(scores)
        assert found["car", "mask_iou"] == pytest.approx(100 * 60 / 200)
        assert found["car", "instance_recall"] == pytest.approx(50)
        assert found["dynamic", "mask_recall"] == pytest.approx(100 * 160 / 220)
        assert found["dynamic", "mask_precision"] == pytest.approx(100)
        assert np.isnan(found["pedestrian", "instance_recall"])
        assert found["dynamic", "instance_recall"] == pytest.approx(50)


class TestPoints:
    points = np.array([[1.0, 0, 0], [2, 0, 0], [3, 0, 0], [4, 0, 0], [99, 0, 0]])

    def test_recall_and_precision_nearby(self):
        scores = PointScores(15.0, "streetscan")
        hit = np.array([True, False, True, False, True])
        found = DynamicPoints(hit, np.zeros((0, 7)), np.zeros(0), np.zeros(0))
        scores.add(self.points, found, np.array([CAR, CAR, 0, 255, CAR]))
        assert values(scores)["dynamic", "point_recall"] == pytest.approx(50)
        assert values(scores)["dynamic", "point_precision"] == pytest.approx(50)
        assert values(scores)["car", "point_recall"] == pytest.approx(50)

    def test_semantickitti(self):
        ids = np.array([10 | 5 << 16, 252, 13, 31, 40, 0, 18])
        labels, is_known = classes_of_points(ids, "semantickitti")
        assert labels.tolist() == [CAR, CAR, TRAM_BUS, PEDESTRIAN, 0, 0, CAR]
        assert is_known.tolist() == [True, True, True, True, True, False, True]
        with pytest.raises(BadInput, match="use one of semantickitti"):
            classes_of_points(ids, "waymo")


def test_nothing_to_score():
    assert tabulate_scores([]).empty
    assert values(ImageScores(1), PointScores(1.0, "streetscan")).isna().all()
