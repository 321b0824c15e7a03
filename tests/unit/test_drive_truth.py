"""True boxes of a tiny drive whose objects are known."""

import numpy as np
import pytest
from toy_detections import CAR_AT, CAR_SIZE, CAR_YAW, SPEED_MPS

from streetscan.calibration.detectors.drive_truth import iterate_true_boxes, iterate_true_labels, iterate_true_masks
from streetscan.calibration.detectors.lidar_boxes import points_in_boxes
from streetscan.classes import CAR, PEDESTRIAN


def test_boxes_lie_where_the_beam_met_the_object(detection_drive):
    for k, (frame, truth) in enumerate(iterate_true_boxes(detection_drive.mcap, detection_drive.truth)):
        assert truth.labels.tolist() == [PEDESTRIAN, CAR]
        assert truth.n_points.tolist() == [80, 600]
        # The car was met 0.03 s before the stamp; before the first frame the vehicle's way is not known.
        at_m = SPEED_MPS * max(0.1 * k - 0.03, 0)
        assert truth.boxes[1] == pytest.approx([*(CAR_AT - [at_m, 0, 1.7]), *CAR_SIZE, CAR_YAW], abs=2e-3)
        if k > 0:
            assert points_in_boxes(frame.points[3000:3600], truth.boxes[1:], 0.01).all()
        # The person, in no table, has the box of its own points.
        assert truth.boxes[0, :2] == pytest.approx([5.0 - SPEED_MPS * (0.1 * k + 0.04), -3.0], abs=0.2)
        assert points_in_boxes(frame.points[3600:], truth.boxes[:1], 0.3).mean() > 0.95


def test_labels_and_masks(detection_drive, tmp_path):
    frames = list(iterate_true_labels(detection_drive.mcap, detection_drive.truth))
    assert [len(ids) for _, ids in frames] == [3680] * detection_drive.n_frames
    assert list(iterate_true_labels(detection_drive.mcap, tmp_path)) == []
    image, labels, instances = next(iterate_true_masks(detection_drive.mcap, detection_drive.truth))
    assert image.format == "png"
    assert np.array_equal(np.unique(instances[labels == CAR]), [1000 + CAR])
