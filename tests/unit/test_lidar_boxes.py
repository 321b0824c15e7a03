"""Boxes and points whose answer is known by hand."""

import numpy as np
import pytest

from streetscan.calibration.detectors.lidar_boxes import overlap_from_above, points_in_boxes, suppress_overlaps

BOX = np.array([10.0, -4.0, 1.0, 4.0, 2.0, 1.5, np.pi / 6])


def corner(along, across, up):
    c, s = np.cos(BOX[6]), np.sin(BOX[6])
    return np.array([10 + c * along - s * across, -4 + s * along + c * across, 1 + up])


def test_points_at_the_edges_of_a_turned_box():
    points = np.array([corner(1.99, 0.99, 0.74), corner(2.01, 0, 0), corner(0, -1.01, 0), corner(0, 0, 0.76), corner(0, 0, -0.74)])
    assert points_in_boxes(points, BOX[None])[:, 0].tolist() == [True, False, False, False, True]
    assert points_in_boxes(points, BOX[None], margin_m=0.05)[:, 0].tolist() == [True] * 5
    assert points_in_boxes(points, BOX[None], foot_m=0.1)[:, 0].tolist() == [True, False, False, False, False]


def test_none():
    assert points_in_boxes(np.zeros((3, 3)), np.zeros((0, 7))).shape == (3, 0)
    assert points_in_boxes(np.zeros((0, 3)), BOX[None]).shape == (0, 1)
    assert suppress_overlaps(np.zeros((0, 7)), np.zeros(0), 0.5).tolist() == []


def test_overlap():
    a = np.array([0.0, 0, 0, 4, 2, 1, 0])
    others = [
        [0, 0, 0, 4, 2, 1, np.pi],
        [2, 0, 0, 4, 2, 1, 0],
        [0, 0, 0, 2, 4, 1, np.pi / 2],
        [50, 0, 0, 4, 2, 1, 0],
        [0, 0, 9, 2, 2, 1, 0],
    ]
    assert overlap_from_above(a, np.array(others)) == pytest.approx([1, 4 / 12, 1, 0, 0.5], abs=1e-5)


def test_the_better_of_two_stays():
    boxes = np.array([[0.0, 0, 0, 4, 2, 1, 0], [0.2, 0, 0, 4, 2, 1, 0], [9, 0, 0, 4, 2, 1, 0]])
    assert suppress_overlaps(boxes, np.array([0.5, 0.9, 0.1]), 0.3).tolist() == [1, 2]
