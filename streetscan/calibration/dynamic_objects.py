"""What could move at a keyframe: masks of its images and boxes of its lidar frame, as files and as pictures.

Source: Nagy (2020), 4.3.1 (2) and 4.3.2.1, Fig. 4.3a and 4.6b; N-205, N-215.
"""

import logging
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from streetscan.calibration.detectors.image_detections import ImageDetections, ImageDetector
from streetscan.calibration.detectors.lidar_boxes import LidarDetections, LidarDetector, points_in_boxes
from streetscan.classes import CLASSES
from streetscan.errors import BadInput
from streetscan.io.arrays import load_npz, save_npz

logger = logging.getLogger(__name__)

_TOP_RANGE_M, _TOP_PIXELS_PER_M = 30.0, 14
_GREY, _RED = (150, 150, 150), (220, 20, 60)


@dataclass
class DynamicPixels:
    """The moving things of a keyframe's n images.

    Attributes:
        classes: (n, H, W) uint8, label of `streetscan.classes`; 0 stands still.
        instances: (n, H, W) uint16, 0 none; numbers go on from image to image, so that `scores[k - 1]` is that of object k.
        scores: (K,) float32.
        problem: why the keyframe's detectors could not be used; empty where they could.
    """

    classes: np.ndarray
    instances: np.ndarray
    scores: np.ndarray
    problem: str = ""

    def save(self, path: str | Path) -> None:
        """Write as .npz, compressed."""
        arrays = {"classes": self.classes, "instances": self.instances, "scores": self.scores, "problem": np.array(self.problem)}
        save_npz(path, is_packed=True, **arrays)

    @classmethod
    def load(cls, path: str | Path) -> "DynamicPixels":
        """Read what `save` wrote. BadInput when it is something else."""
        *arrays, problem = load_npz(path, ("classes", "instances", "scores", "problem"), "detect_dynamic")
        return cls(*arrays, str(problem))

    @classmethod
    def nothing(cls, problem: str = "") -> "DynamicPixels":
        """Of no images."""
        return cls(np.zeros((0, 0, 0), np.uint8), np.zeros((0, 0, 0), np.uint16), np.zeros(0, np.float32), problem)


@dataclass
class DynamicPoints:
    """The moving things of a keyframe's lidar frame.

    Attributes:
        is_dynamic: (N,) bool, of its points.
        boxes: (M, 7) float32, see `streetscan.calibration.detectors.lidar_boxes`.
        labels: (M,) uint8 of `streetscan.classes`.
        scores: (M,) float32.
    """

    is_dynamic: np.ndarray
    boxes: np.ndarray
    labels: np.ndarray
    scores: np.ndarray

    def save(self, path: str | Path) -> None:
        """Write as .npz; the labels are `classes` there."""
        save_npz(path, is_packed=True, is_dynamic=self.is_dynamic, boxes=self.boxes, classes=self.labels, scores=self.scores)

    @classmethod
    def load(cls, path: str | Path) -> "DynamicPoints":
        """Read what `save` wrote. BadInput when it is something else."""
        return cls(*load_npz(path, ("is_dynamic", "boxes", "classes", "scores"), "detect_dynamic"))


def find_dynamic_pixels(detector: ImageDetector, images: list[np.ndarray]) -> DynamicPixels:
    """The moving things of images (H, W, 3) uint8 RGB of one size; of none, arrays of length 0."""
    if not images:
        return DynamicPixels.nothing()
    found, n_before = [], 0
    for image in images:
        one = detector.detect(image)
        instances = np.where(one.instances > 0, one.instances + np.uint16(n_before), 0).astype(np.uint16)
        found.append(ImageDetections(one.classes, instances, one.scores))
        n_before += len(one.scores)
    return DynamicPixels(
        np.stack([f.classes for f in found]), np.stack([f.instances for f in found]), np.concatenate([f.scores for f in found])
    )


class KeyframeDetector:
    """Both detectors. Files of another network, or one that cannot take what it is given, become the `problem` of every keyframe.

    Args:
        open_detectors: gives the detectors of images and of lidar frames; its BadInput is the problem.
        margin_m, foot_m: as in `points_in_boxes`.
    """

    def __init__(self, open_detectors: Callable[[], tuple[ImageDetector, LidarDetector]], margin_m: float, foot_m: float):
        self._in_boxes, self._problem = (margin_m, foot_m), ""
        try:
            self._of_images, self._of_points = open_detectors()
        except BadInput as error:
            self._problem = str(error)
            logger.warning("nothing is detected: %s", error)

    def detect(self, images: list[np.ndarray], points: np.ndarray, intensity: np.ndarray | None) -> tuple[DynamicPixels, DynamicPoints]:
        """The moving things of a keyframe's images and lidar frame; none, and why, where the detectors cannot be used."""
        problem = self._problem
        try:
            if not problem:
                of_points = find_dynamic_points(self._of_points, points, intensity, *self._in_boxes)
                return find_dynamic_pixels(self._of_images, images), of_points
        except BadInput as error:
            problem = str(error)
        boxes = np.zeros((0, 7), np.float32), np.zeros(0, np.uint8), np.zeros(0, np.float32)
        return DynamicPixels.nothing(problem), DynamicPoints(np.zeros(len(points), bool), *boxes)


def find_dynamic_points(
    detector: LidarDetector, points: np.ndarray, intensity: np.ndarray | None, margin_m: float, foot_m: float
) -> DynamicPoints:
    """The points (N, 3) of a lidar frame that lie in a box; margin and foot as in `points_in_boxes`."""
    found = LidarDetections(np.zeros((0, 7), np.float32), np.zeros(0, np.uint8), np.zeros(0, np.float32))
    found = detector.detect(points, intensity) if len(points) else found
    inside = points_in_boxes(points, found.boxes, margin_m, foot_m).any(axis=1)
    return DynamicPoints(inside, found.boxes, found.labels, found.scores)


def draw_keyframe(images: list[np.ndarray], pixels: DynamicPixels, points: np.ndarray, found: DynamicPoints) -> np.ndarray:
    """(H, W, 3) uint8 RGB: the first and the last image with their moving things in the classes' colours, outlined one by one, and the
    lidar frame from above, moving points red, with its boxes; forward is up."""
    ends = sorted({0, len(images) - 1}) if images else []
    shown = [overlay(images[k], pixels.classes[k], pixels.instances[k]) if len(pixels.classes) else images[k] for k in ends]
    top = draw_from_above(points, found)
    height = top.shape[0]
    scaled = [cv2.resize(s, (round(s.shape[1] * height / 2 / s.shape[0]), height // 2), interpolation=cv2.INTER_AREA) for s in shown]
    column = np.concatenate(scaled) if scaled else np.zeros((height, 1, 3), np.uint8)
    padded = np.zeros((height, column.shape[1], 3), np.uint8)
    padded[: len(column)] = column
    return np.concatenate([padded, top], axis=1)


def overlay(image: np.ndarray, classes: np.ndarray, instances: np.ndarray) -> np.ndarray:
    """The picture (H, W, 3) with classes (H, W) in their colours and white lines between objects (H, W)."""
    colours = np.zeros((256, 3), np.float32)
    for c in CLASSES:
        colours[c.label] = c.colour
    moving = classes > 0
    out = image.astype(np.float32)
    out[moving] = 0.5 * out[moving] + 0.5 * colours[classes[moving]]
    edge = cv2.morphologyEx(instances, cv2.MORPH_GRADIENT, np.ones((3, 3), np.uint8)) > 0
    out[edge] = 255
    return out.astype(np.uint8)


def draw_from_above(points: np.ndarray, found: DynamicPoints) -> np.ndarray:
    """(S, S, 3) uint8 of a lidar frame within 30 m, forward up."""
    size = round(2 * _TOP_RANGE_M * _TOP_PIXELS_PER_M)
    picture = np.full((size, size, 3), 255, np.uint8)

    def pixels_of(xy: np.ndarray) -> np.ndarray:
        return np.stack([size / 2 - xy[:, 1] * _TOP_PIXELS_PER_M, size / 2 - xy[:, 0] * _TOP_PIXELS_PER_M], axis=1).round().astype(int)

    for mask, colour in ((~found.is_dynamic, _GREY), (found.is_dynamic, _RED)):
        column, row = pixels_of(points[mask]).T
        inside = (column >= 0) & (column < size) & (row >= 0) & (row < size)
        picture[row[inside], column[inside]] = colour
    for box, label in zip(found.boxes, found.labels, strict=True):
        corners = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1], [1, 0], [1.4, 0]]) * box[3:5] / 2
        turn = np.array([[np.cos(box[6]), -np.sin(box[6])], [np.sin(box[6]), np.cos(box[6])]])
        drawn = pixels_of(corners @ turn.T + box[:2]).astype(np.int32)
        cv2.polylines(picture, [drawn[:4]], True, CLASSES[label].colour, 2, cv2.LINE_AA)
        cv2.line(picture, drawn[4].tolist(), drawn[5].tolist(), CLASSES[label].colour, 2, cv2.LINE_AA)
    return picture
