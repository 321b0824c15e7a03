"""What an image detector finds: a class and an object for every pixel."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from streetscan.classes import CAR, PEDESTRIAN, TRAM_BUS
from streetscan.errors import BadInput

# What could move, in the order of the networks' outputs. A phantom is the trace a moving thing leaves in a map; no single picture has one.
DYNAMIC_LABELS = (TRAM_BUS, PEDESTRIAN, CAR)
STATIC = 0


@dataclass
class ImageDetections:
    """The moving things of one picture.

    Attributes:
        classes: (H, W) uint8, a label of DYNAMIC_LABELS, or 0 for what stands still.
        instances: (H, W) uint16, 0 for none, k for the object of `scores[k - 1]`.
        scores: (K,) float32, 0 to 1.
    """

    classes: np.ndarray
    instances: np.ndarray
    scores: np.ndarray


class ImageDetector(Protocol):
    """Any network that finds moving things in a picture."""

    def detect(self, image: np.ndarray) -> ImageDetections:
        """The moving things of an (H, W, 3) uint8 RGB picture."""


def check_picture(image: np.ndarray) -> None:
    """BadInput unless an image is (H, W, 3) uint8 with at least a pixel."""
    if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8 or image.size == 0:
        raise BadInput("the image", f"shape {image.shape} of {image.dtype}", "give an (H, W, 3) uint8 RGB picture")


def paint_objects(masks: list[np.ndarray], labels: np.ndarray, scores: np.ndarray, shape: tuple[int, int]) -> ImageDetections:
    """One picture of classes and objects from masks that may overlap; where they do, the higher score lies on top.

    Args:
        masks: K times (H, W) bool.
        labels: (K,) classes.
        scores: (K,).
        shape: (H, W).
    Returns:
        Detections without objects of which nothing shows, in the order of falling scores.
    """
    classes, instances = np.zeros(shape, np.uint8), np.zeros(shape, np.uint16)
    order = np.argsort(-np.asarray(scores), kind="stable")
    for rank, k in reversed(list(enumerate(order))):
        instances[masks[k]] = rank + 1
        classes[masks[k]] = labels[k]
    seen, packed = np.unique(instances, return_inverse=True)
    shown = seen[seen > 0].astype(int)
    instances = (packed.reshape(shape) + (0 if seen[0] == 0 else 1)).astype(np.uint16)
    return ImageDetections(classes, instances, np.asarray(scores, np.float32)[order][shown - 1])
