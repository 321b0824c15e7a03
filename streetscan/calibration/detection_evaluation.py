"""How right the detectors are, against true masks of images and true labels of lidar points.

Two questions. What a calibration needs to know: which pixels and points could move (class `dynamic`). And what a detector is usually
asked: each class by itself.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np
import pandas as pd

from streetscan.calibration.detectors.image_detections import DYNAMIC_LABELS, ImageDetections
from streetscan.calibration.dynamic_objects import DynamicPoints
from streetscan.classes import CAR, NAMES, PEDESTRIAN, TRAM_BUS
from streetscan.errors import BadInput

# Foreign label ids of points to what could move. SemanticKITTI's, moving ones too: car; bicycle, motorcycle, truck and other vehicle count
# as cars; bus, on rails; person and riders. As in `onnx.CLASS_IDS`.
POINT_CLASSES: Mapping[str, Mapping[int, int]] = {
    "semantickitti": dict.fromkeys((10, 11, 15, 18, 20, 252, 258, 259), CAR)
    | dict.fromkeys((13, 16, 256, 257), TRAM_BUS)
    | dict.fromkeys((30, 31, 32, 253, 254, 255), PEDESTRIAN),
    "streetscan": {label: label for label in DYNAMIC_LABELS},
}
# Points that stand for no thing: SemanticKITTI's unlabelled and outliers.
_IGNORED = {"semantickitti": (0, 1), "streetscan": (255,)}
MATCH_IOU = 0.5
_ROWS = {"dynamic": DYNAMIC_LABELS} | {NAMES[label]: (label,) for label in DYNAMIC_LABELS}


def classes_of_points(ids: np.ndarray, kind: str) -> tuple[np.ndarray, np.ndarray]:
    """True classes of a frame's points.

    Args:
        ids: (N,) uint32 labels of the recording; SemanticKITTI keeps the number of the instance in the upper half.
        kind: whose ids they are, a key of POINT_CLASSES.
    Returns:
        (N,) uint8 of DYNAMIC_LABELS, 0 for static; (N,) bool where the truth says something.
    Raises:
        BadInput: nobody wrote down what these ids mean.
    """
    if kind not in POINT_CLASSES:
        raise BadInput(f"truth.labels.ids '{kind}'", "is no list of labels we know", f"use one of {', '.join(POINT_CLASSES)}")
    low = np.asarray(ids) & 0xFFFF
    found = np.zeros(len(low), np.uint8)
    for foreign, label in POINT_CLASSES[kind].items():
        found[low == foreign] = label
    return found, ~np.isin(low, _IGNORED[kind])


@dataclass
class PixelCounts:
    """Pixels and objects of one class, summed over images."""

    n_both: int = 0
    n_true: int = 0
    n_found: int = 0
    n_objects: int = 0
    n_recalled: int = 0


@dataclass
class ImageScores:
    """Collects what a detector finds in images.

    Attributes:
        min_pixels: a true object of which fewer pixels show is not asked for.
    """

    min_pixels: int
    counts: dict[str, PixelCounts] = field(default_factory=lambda: {name: PixelCounts() for name in _ROWS})
    n_images: int = 0

    def add(self, found: ImageDetections, labels: np.ndarray, instances: np.ndarray) -> None:
        """One image: true labels (H, W) of `streetscan.classes` and objects (H, W)."""
        self.n_images += 1
        for name, wanted in _ROWS.items():
            true, mine = np.isin(labels, wanted), np.isin(found.classes, wanted)
            counts = self.counts[name]
            counts.n_both += int((true & mine).sum())
            counts.n_true += int(true.sum())
            counts.n_found += int(mine.sum())
            if len(wanted) == 1:
                self._add_objects(counts, np.where(mine, found.instances, 0), np.where(true, instances, 0))
        total = self.counts["dynamic"]
        total.n_objects = sum(c.n_objects for name, c in self.counts.items() if name != "dynamic")
        total.n_recalled = sum(c.n_recalled for name, c in self.counts.items() if name != "dynamic")

    def _add_objects(self, counts: PixelCounts, found: np.ndarray, true: np.ndarray) -> None:
        """An object is recalled when a found one of its class covers more than half of both together (IoU above 0.5)."""
        sizes = dict(zip(*np.unique(found, return_counts=True), strict=True))
        for key, size in zip(*np.unique(true, return_counts=True), strict=True):
            if key == 0 or size < self.min_pixels:
                continue
            counts.n_objects += 1
            inside, shared = np.unique(found[true == key], return_counts=True)
            overlaps = [s / (size + sizes[i] - s) for i, s in zip(inside, shared, strict=True) if i != 0]
            counts.n_recalled += bool(overlaps) and max(overlaps) > MATCH_IOU

    def tabulate(self) -> list[dict]:
        """Rows `sensor`, `class`, `metric`, `value` in per cent, `unit`, `n`."""
        rows = []
        for name, c in self.counts.items():
            union = c.n_true + c.n_found - c.n_both
            rows += [
                _row("image", name, "mask_iou", c.n_both, union if c.n_true else 0, c.n_true),
                _row("image", name, "mask_recall", c.n_both, c.n_true, c.n_true),
                _row("image", name, "mask_precision", c.n_both, c.n_found, c.n_found),
                _row("image", name, "instance_recall", c.n_recalled, c.n_objects, c.n_objects),
            ]
        return rows


@dataclass
class PointScores:
    """Collects what a detector finds in lidar frames, within a distance from the sensor.

    Attributes:
        range_m: farther points are left out; thesis 4.3.2 (N-214): 15 m.
        kind: whose label ids the truth has.
    """

    range_m: float
    kind: str
    n_true: dict[str, int] = field(default_factory=lambda: dict.fromkeys(_ROWS, 0))
    n_hit: dict[str, int] = field(default_factory=lambda: dict.fromkeys(_ROWS, 0))
    n_found: int = 0

    def add(self, points: np.ndarray, found: DynamicPoints, ids: np.ndarray) -> None:
        """One frame: its points (N, 3), what was found, and the true ids (N,)."""
        labels, is_known = classes_of_points(ids, self.kind)
        near = is_known & (np.hypot(points[:, 0], points[:, 1]) <= self.range_m)
        for name, wanted in _ROWS.items():
            true = near & np.isin(labels, wanted)
            self.n_true[name] += int(true.sum())
            self.n_hit[name] += int((true & found.is_dynamic).sum())
        self.n_found += int((near & found.is_dynamic).sum())

    def tabulate(self) -> list[dict]:
        """Rows as `ImageScores.tabulate`; a point in any box is found, whatever the box is called."""
        rows = [_row("lidar", name, "point_recall", self.n_hit[name], self.n_true[name], self.n_true[name]) for name in _ROWS]
        return [*rows, _row("lidar", "dynamic", "point_precision", self.n_hit["dynamic"], self.n_found, self.n_found)]


def _row(sensor: str, name: str, metric: str, part: int, whole: int, n: int) -> dict:
    value = 100 * part / whole if whole else float("nan")
    return {"sensor": sensor, "class": name, "metric": metric, "value": value, "unit": "%", "n": n}


def tabulate_scores(scores: Iterable[ImageScores | PointScores]) -> pd.DataFrame:
    """One table of all scores."""
    rows = [row for one in scores for row in one.tabulate()]
    return pd.DataFrame(rows, columns=["sensor", "class", "metric", "value", "unit", "n"])
