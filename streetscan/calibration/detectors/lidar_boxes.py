"""Boxes around moving things in a lidar frame.

A box is x, y, z of its middle, length, width, height in metres, and the yaw of its length, counter-clockwise from x, in the frame
`lidar`; it stands upright in that frame.
"""

from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np


@dataclass
class LidarDetections:
    """The moving things of one lidar frame.

    Attributes:
        boxes: (M, 7) float32.
        labels: (M,) uint8, of `image_detections.DYNAMIC_LABELS`.
        scores: (M,) float32, 0 to 1, falling.
    """

    boxes: np.ndarray
    labels: np.ndarray
    scores: np.ndarray


class LidarDetector(Protocol):
    """Any network that finds moving things in a lidar frame."""

    def detect(self, points: np.ndarray, intensity: np.ndarray | None = None) -> LidarDetections:
        """The moving things of (n, 3) float32 points, metres, frame `lidar`; intensity (n,) float32, 1 is the source's largest value."""


def points_in_boxes(points: np.ndarray, boxes: np.ndarray, margin_m: float = 0.0, foot_m: float = 0.0) -> np.ndarray:
    """Which points lie in which boxes.

    Args:
        points: (n, >=3) metres, frame `lidar`.
        boxes: (m, 7).
        margin_m: boxes are made larger by this on every side but the lower.
        foot_m: the lowest part of a box that is left out: the road under a car is no car.
    Returns:
        (n, m) bool.
    """
    xyz, boxes = np.asarray(points)[:, :3].astype(np.float64), np.asarray(boxes, np.float64).reshape(-1, 7)
    inside = np.zeros((len(xyz), len(boxes)), bool)
    for k, (x, y, z, length, width, height, yaw) in enumerate(boxes):
        near = np.flatnonzero(np.hypot(xyz[:, 0] - x, xyz[:, 1] - y) <= np.hypot(length, width) / 2 + 2 * margin_m)
        shift = xyz[near] - (x, y, z)
        along = np.cos(yaw) * shift[:, 0] + np.sin(yaw) * shift[:, 1]
        across = -np.sin(yaw) * shift[:, 0] + np.cos(yaw) * shift[:, 1]
        is_inside = (np.abs(along) <= length / 2 + margin_m) & (np.abs(across) <= width / 2 + margin_m)
        is_inside &= (shift[:, 2] >= foot_m - height / 2) & (shift[:, 2] <= height / 2 + margin_m)
        inside[near[is_inside], k] = True
    return inside


def overlap_from_above(box: np.ndarray, others: np.ndarray) -> np.ndarray:
    """(m,) intersection over union, seen from above, of a box (7,) with (m, 7) others."""
    result = np.zeros(len(others))
    area = box[3] * box[4]
    for k, other in enumerate(others):
        if np.hypot(*(box[:2] - other[:2])) > (np.hypot(*box[3:5]) + np.hypot(*other[3:5])) / 2:
            continue
        _, corners = cv2.rotatedRectangleIntersection(_rectangle(box), _rectangle(other))
        if corners is not None:
            shared = cv2.contourArea(cv2.convexHull(corners))
            result[k] = shared / max(area + other[3] * other[4] - shared, 1e-9)
    return result


def _rectangle(box: np.ndarray) -> tuple:
    return (float(box[0]), float(box[1])), (float(box[3]), float(box[4])), float(np.degrees(box[6]))


def suppress_overlaps(boxes: np.ndarray, scores: np.ndarray, max_overlap: float) -> np.ndarray:
    """Numbers of the boxes that stay when each one, from the best on, takes those away that overlap it by more."""
    order, kept = np.argsort(-scores, kind="stable"), []
    while len(order):
        best, order = order[0], order[1:]
        kept.append(best)
        order = order[overlap_from_above(boxes[best], boxes[order]) <= max_overlap]
    return np.array(kept, int)
