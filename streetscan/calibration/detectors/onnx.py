"""Image detectors from any ONNX network, run by onnxruntime: adapters for the three forms such networks answer in.

`mask_rcnn`: boxes, labels, scores and masks, of the picture's size or of each box (torchvision, ONNX model zoo). `yolo_instances`:
proposals with mask coefficients and prototype masks (the segmentation heads of YOLOv5 and YOLOv8). `boxes_and_pixels`: one network
that finds boxes (YOLOX, or a YOLO without masks) and one that gives every pixel a class; a moving pixel belongs to the box it lies in.

Source: Nagy (2020), 4.3.1 (2): Mask R-CNN (He et al. 2017); N-205.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import cv2
import numpy as np
import onnxruntime

from streetscan.calibration.detectors.image_detections import STATIC, ImageDetections, check_picture, paint_objects
from streetscan.classes import CAR, PEDESTRIAN, TRAM_BUS
from streetscan.errors import BadInput
from streetscan.io.files import check_readable

METHODS = ("mask_rcnn", "yolo_instances", "boxes_and_pixels")

# Foreign ids to our classes. ASSUME: who rides is a person, and what stands on wheels without being a bus or a tram is a car,
# bicycles and motorcycles too: they are gone on another day.
_COCO = {"person": PEDESTRIAN, "bicycle": CAR, "car": CAR, "motorcycle": CAR, "bus": TRAM_BUS, "train": TRAM_BUS, "truck": CAR}
_COCO_80 = dict(zip((0, 1, 2, 3, 5, 6, 7), _COCO.values(), strict=True))
CLASS_IDS = {
    "coco_80": _COCO_80,  # YOLO: numbered from 0
    "coco_81": {1 + number: label for number, label in _COCO_80.items()},  # 0 is background; torchvision's ids of these classes, too
    "cityscapes": {
        11: PEDESTRIAN, 12: PEDESTRIAN, 13: CAR, 14: CAR, 15: TRAM_BUS, 16: TRAM_BUS, 17: CAR, 18: CAR,
    },  # train ids: person, rider, car, truck, bus, train, motorcycle, bicycle
}  # fmt: skip


@dataclass(frozen=True)
class OnnxSettings:
    """What the networks want to see and how their answers are read.

    Attributes:
        class_ids: a key of CLASS_IDS, of what the boxes are of.
        pixel_class_ids: likewise, of the pixels of `boxes_and_pixels`.
        size: (height, width) the first network's input is brought to where it takes any; null takes the picture as it is.
        fit: `letterbox` keeps the picture's shape and fills what is left, `corner` does so with the picture at the top left, `stretch`
            does not keep it.
        fill: value of what is left.
        colours: `rgb` or `bgr`.
        factor, mean, deviation: a value enters as (factor * v - mean) / deviation, each channel with its own.
        min_score: least score of an object.
        max_overlap: of two boxes of a class; the one with the lower score goes.
        min_mask: least value of a mask's pixel that belongs to the object.
    """

    class_ids: str = "coco_80"
    pixel_class_ids: str = "cityscapes"
    size: tuple[int, int] | None = None
    fit: str = "letterbox"
    fill: float = 114.0
    colours: str = "rgb"
    factor: float = 1.0
    mean: tuple[float, ...] = (0.0, 0.0, 0.0)
    deviation: tuple[float, ...] = (1.0, 1.0, 1.0)
    min_score: float = 0.3
    max_overlap: float = 0.5
    min_mask: float = 0.5

    def __post_init__(self):
        for name in ("size", "mean", "deviation"):
            value = getattr(self, name)
            object.__setattr__(self, name, None if value is None else tuple(value))
        for name, known in (("class_ids", CLASS_IDS), ("pixel_class_ids", CLASS_IDS), ("fit", _FITS), ("colours", ("rgb", "bgr"))):
            if getattr(self, name) not in known:
                raise BadInput(f"settings.{name}", f"'{getattr(self, name)}' is unknown", f"use one of {', '.join(known)}")


_FITS = ("letterbox", "corner", "stretch")


def read_onnx_settings(values: dict) -> OnnxSettings:
    """Settings from what differs from the defaults. BadInput names an unknown key."""
    known = [f.name for f in fields(OnnxSettings)]
    if unknown := sorted(set(values) - set(known)):
        raise BadInput("settings of an ONNX detector", f"'{unknown[0]}' is unknown", f"use {', '.join(known)}")
    return OnnxSettings(**values)


@dataclass
class _Fitting:
    """Where a picture lies in a network's input: pixel = offset + scale * pixel of the picture, of (x, y)."""

    scale: np.ndarray
    offset: np.ndarray
    shape: tuple[int, int]

    def to_picture(self, boxes: np.ndarray) -> np.ndarray:
        """Boxes (n, 4) x, y, x, y of the input as boxes of the picture."""
        return (boxes - np.tile(self.offset, 2)) / np.tile(self.scale, 2)

    def map_to_picture(self, values: np.ndarray, stride: np.ndarray, interpolation: int) -> np.ndarray:
        """A map over the input, every pixel `stride` (x, y) of its pixels wide, over the picture."""
        # Middles of pixels: a pixel k of a map `stride` wide lies at (k + 0.5) * stride - 0.5 of the input.
        (height, width), step = self.shape, np.array(stride, float)
        x = (self.offset[0] + self.scale[0] * (np.arange(width) + 0.5)) / step[0] - 0.5
        y = (self.offset[1] + self.scale[1] * (np.arange(height) + 0.5)) / step[1] - 0.5
        grid = np.meshgrid(x.astype(np.float32), y.astype(np.float32))
        return cv2.remap(values, *grid, interpolation, borderMode=cv2.BORDER_REPLICATE)


class _Network:
    """An ONNX network with one picture as input."""

    def __init__(self, path: str | Path, n_threads: int):
        check_readable(Path(path))
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads, options.inter_op_num_threads = n_threads, 1
        options.log_severity_level = 3
        try:
            self._session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
        except Exception as error:  # onnxruntime has a class of its own for every kind of damage
            raise BadInput(path, f"no ONNX network ({str(error).splitlines()[0]})", "give an .onnx file") from error
        inputs = self._session.get_inputs()
        self.path, self._input = path, inputs[0]
        self._shape = [n if isinstance(n, int) and n > 0 else None for n in self._input.shape]
        if len(inputs) != 1 or len(self._shape) not in (3, 4) or self._input.type not in ("tensor(float)", "tensor(uint8)"):
            found = f"takes {len(inputs)} inputs, the first {self._input.type} {self._input.shape}"
            raise BadInput(path, found, "give a network that takes a picture")
        last_three = self._shape[-3:]
        self._is_last = last_three[2] == 3 and last_three[0] != 3

    def run(self, image: np.ndarray, settings: OnnxSettings) -> tuple[list[np.ndarray], _Fitting, tuple[int, int]]:
        """Outputs for an (H, W, 3) uint8 RGB picture, where it lay in the input, and the input's (height, width)."""
        rows, columns = self._shape[-3:-1] if self._is_last else self._shape[-2:]
        wanted = settings.size or image.shape[:2]
        size = rows or wanted[0], columns or wanted[1]
        fitted, fitting = _fit(image, size, settings)
        fitted = fitted if settings.colours == "rgb" else fitted[..., ::-1]
        if self._input.type == "tensor(uint8)":
            values = fitted
        else:
            values = ((settings.factor * fitted.astype(np.float32) - settings.mean) / settings.deviation).astype(np.float32)
        values = values if self._is_last else values.transpose(2, 0, 1)
        values = np.ascontiguousarray(values[None] if len(self._shape) == 4 else values)
        try:
            return self._session.run(None, {self._input.name: values}), fitting, size
        except Exception as error:
            found = f"does not take a picture of {values.shape} ({str(error).splitlines()[0]})"
            raise BadInput(self.path, found, "set size in the detector's settings to what it was made for") from error


def _fit(image: np.ndarray, size: tuple[int, int], settings: OnnxSettings) -> tuple[np.ndarray, _Fitting]:
    (height, width), (rows, columns) = image.shape[:2], size
    if settings.fit == "stretch" or (height, width) == size:
        scale = np.array([columns / width, rows / height])
        return _resize(image, columns, rows), _Fitting(scale, np.zeros(2), (height, width))
    factor = min(columns / width, rows / height)
    w, h = min(round(width * factor), columns), min(round(height * factor), rows)
    left, top = ((columns - w) // 2, (rows - h) // 2) if settings.fit == "letterbox" else (0, 0)
    fitted = np.full((rows, columns, 3), settings.fill, np.uint8)
    fitted[top : top + h, left : left + w] = _resize(image, w, h)
    return fitted, _Fitting(np.array([w / width, h / height]), np.array([left, top], float), (height, width))


def _resize(image: np.ndarray, width: int, height: int) -> np.ndarray:
    smaller = width < image.shape[1]
    return cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA if smaller else cv2.INTER_LINEAR)


class OnnxDetector:
    """Finds moving things with one or two ONNX networks."""

    def __init__(self, method: str, paths: Sequence[str | Path], settings: OnnxSettings, n_threads: int = 1):
        """
        Args:
            method: of METHODS.
            paths: the network, or for `boxes_and_pixels` that of the boxes and that of the pixels.
            settings: see there.
            n_threads: of onnxruntime; the printed results do not depend on it.
        Raises:
            BadInput: no such file, no ONNX network, or not as many as the method needs.
        """
        needed = 2 if method == "boxes_and_pixels" else 1
        if len(paths) != needed:
            raise BadInput("image_detectors.files", f"{len(paths)} files for method '{method}'", f"give {needed}")
        self._settings = settings
        self._networks = [_Network(path, n_threads) for path in paths]
        readers = {"mask_rcnn": self._mask_rcnn, "yolo_instances": self._yolo_instances, "boxes_and_pixels": self._boxes_and_pixels}
        self._read = readers[method]

    def detect(self, image: np.ndarray) -> ImageDetections:
        """See `image_detections.ImageDetector`. BadInput when the network's outputs are not of the method's kind."""
        check_picture(image)
        return self._read(image)

    def _mask_rcnn(self, image: np.ndarray) -> ImageDetections:
        outputs, fitting, size = self._networks[0].run(image, self._settings)
        boxes, labels, scores, masks = _sort_mask_rcnn([np.asarray(o) for o in outputs], self._networks[0].path)
        labels, kept = self._map_labels(labels, scores)
        found = []
        for k in kept:
            mask = masks[k].reshape(masks.shape[-2:]).astype(np.float32)
            if mask.shape == size:
                # As large as the input, from which it goes back into the picture.
                full = fitting.map_to_picture(mask, np.ones(2), cv2.INTER_LINEAR)
            else:
                full = _paste(mask, fitting.to_picture(boxes[k : k + 1])[0], image.shape[:2])
            found.append(full >= self._settings.min_mask)
        return paint_objects(found, labels[kept], scores[kept], image.shape[:2])

    def _yolo_instances(self, image: np.ndarray) -> ImageDetections:
        outputs, fitting, size = self._networks[0].run(image, self._settings)
        by_rank = {o.ndim: o for o in outputs if o.ndim in (3, 4)}
        if set(by_rank) != {3, 4}:
            found = f"outputs of shapes {[o.shape for o in outputs]}"
            raise BadInput(self._networks[0].path, found, "give a network with proposals and prototype masks")
        prototypes = by_rank[4][0]
        boxes, ids, scores, extra = _read_proposals(by_rank[3][0], len(prototypes), size, self._networks[0].path)
        labels, kept = self._map_labels(ids, scores)
        kept = kept[_best_of_class(boxes[kept], labels[kept], scores[kept], self._settings.max_overlap)]
        stride = np.array([size[1] / prototypes.shape[2], size[0] / prototypes.shape[1]])
        found, shape = [], image.shape[:2]
        for k in kept:
            logits = np.tensordot(extra[k], prototypes, 1).astype(np.float32)
            full = fitting.map_to_picture(logits, stride, cv2.INTER_LINEAR)
            level = np.log(self._settings.min_mask / (1 - self._settings.min_mask))
            found.append((full >= level) & _inside(fitting.to_picture(boxes[k : k + 1])[0], shape))
        return paint_objects(found, labels[kept], scores[kept], shape)

    def _boxes_and_pixels(self, image: np.ndarray) -> ImageDetections:
        outputs, fitting, size = self._networks[0].run(image, self._settings)
        boxes, ids, scores, _ = _read_proposals(outputs[0][0], 0, size, self._networks[0].path)
        labels, kept = self._map_labels(ids, scores)
        kept = kept[_best_of_class(boxes[kept], labels[kept], scores[kept], self._settings.max_overlap)]
        boxes = fitting.to_picture(boxes[kept])
        pixels = self._run_pixels(image)
        return join_boxes_and_pixels(boxes, labels[kept], scores[kept], pixels)

    def _run_pixels(self, image: np.ndarray) -> np.ndarray:
        """(H, W) uint8 classes of ours, 0 for static, by the second network.

        ASSUME: it takes RGB values of 0 to 255 and sees the picture in its own shape: stretched, a wide picture's road becomes a car.
        """
        plain = OnnxSettings(fit="letterbox", pixel_class_ids=self._settings.pixel_class_ids)
        outputs, fitting, size = self._networks[1].run(image, plain)
        found = np.squeeze(outputs[0], 0) if outputs[0].shape[0] == 1 else outputs[0]
        if found.ndim == 3:  # a value for every class, which come first or last
            found = found.argmax(0 if found.shape[0] < found.shape[2] else 2)
        if found.ndim != 2:
            raise BadInput(self._networks[1].path, f"an output of shape {outputs[0].shape}", "give a network with a class for every pixel")
        table = np.zeros(256, np.uint8)
        for foreign, label in CLASS_IDS[self._settings.pixel_class_ids].items():
            table[foreign] = label
        coarse = table[found.astype(np.int64) & 255]
        stride = np.array([size[1] / coarse.shape[1], size[0] / coarse.shape[0]])
        return fitting.map_to_picture(coarse, stride, cv2.INTER_NEAREST)

    def _map_labels(self, ids: np.ndarray, scores: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Our labels of foreign ids, and the numbers of the objects that could move and are sure enough."""
        known = CLASS_IDS[self._settings.class_ids]
        labels = np.array([known.get(int(i), STATIC) for i in ids], np.uint8)
        return labels, np.flatnonzero((labels != STATIC) & (scores >= self._settings.min_score))


def join_boxes_and_pixels(boxes: np.ndarray, labels: np.ndarray, scores: np.ndarray, pixels: np.ndarray) -> ImageDetections:
    """Objects from boxes and a class for every pixel.

    A moving pixel belongs to the best box of its class it lies in. ASSUME: both networks must agree, so a box without moving pixels of
    its class is none, and pixels without a box are static.

    Args:
        boxes: (n, 4) x, y, x, y in pixels.
        labels, scores: of the boxes.
        pixels: (H, W) uint8 classes, 0 for static.
    """
    masks, kept, left = [], [], pixels.copy()
    for k in np.argsort(-scores, kind="stable"):
        mask = (left == labels[k]) & _inside(boxes[k], pixels.shape)
        if mask.any():
            masks.append(mask)
            kept.append(k)
            left[mask] = STATIC
    return paint_objects(masks, labels[kept], scores[kept], pixels.shape)


def _sort_mask_rcnn(outputs: list[np.ndarray], path: object) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Boxes (n, 4), labels (n,), scores (n,), masks (n, 1, h, w) by what they look like: their order differs between exports."""
    boxes = [o for o in outputs if o.ndim == 2 and o.shape[1] == 4]
    labels = [o for o in outputs if o.ndim == 1 and o.dtype.kind in "iu"]
    scores = [o for o in outputs if o.ndim == 1 and o.dtype.kind == "f"]
    masks = [o for o in outputs if o.ndim >= 3]
    if not all(len(found) == 1 for found in (boxes, labels, scores, masks)):
        raise BadInput(path, f"outputs of shapes {[o.shape for o in outputs]}", "give a network with boxes, labels, scores and masks")
    return boxes[0], labels[0], scores[0], masks[0]


def _paste(mask: np.ndarray, box: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """(H, W) float32 of a mask (h, w) stretched over a box x, y, x, y."""
    size = np.maximum(box[2:] - box[:2], 1e-3)
    x = (np.arange(shape[1]) + 0.5 - box[0]) / size[0] * mask.shape[1] - 0.5
    y = (np.arange(shape[0]) + 0.5 - box[1]) / size[1] * mask.shape[0] - 0.5
    full = cv2.remap(mask, *np.meshgrid(x.astype(np.float32), y.astype(np.float32)), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.where(_inside(box, shape), full, 0.0)


def _inside(box: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """(H, W) bool, the pixels of a box x, y, x, y."""
    y, x = np.ogrid[: shape[0], : shape[1]]
    return (x >= box[0]) & (x <= box[2]) & (y >= box[1]) & (y <= box[3])


def _read_proposals(
    proposals: np.ndarray, n_extra: int, size: tuple[int, int], path: object
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Boxes (n, 4) x, y, x, y in the input, class ids, scores and the `n_extra` last columns of YOLO proposals.

    Layouts: YOLOv8 (4 + classes + extra, n), without objectness; YOLOv5 (n, 5 + classes + extra); YOLOX likewise, its boxes still
    relative to the cells of three grids, which is seen by their sizes being logarithms.
    """
    if proposals.ndim != 2 or min(proposals.shape) <= 5 + n_extra:
        raise BadInput(path, f"proposals of shape {proposals.shape}", "give a network of the YOLO kind")
    has_objectness = proposals.shape[0] > proposals.shape[1]
    rows = np.asarray(proposals if has_objectness else proposals.T, np.float64)
    end = rows.shape[1] - n_extra
    classes = rows[:, 5:end] * rows[:, 4:5] if has_objectness else rows[:, 4:end]
    centre, sides = rows[:, :2], rows[:, 2:4]
    grid = _yolox_grid(size)
    if has_objectness and len(grid) == len(rows) and np.percentile(sides, 95) < 20:
        centre, sides = (centre + grid[:, :2]) * grid[:, 2:], np.exp(np.clip(sides, -10, 10)) * grid[:, 2:]
    boxes = np.concatenate([centre - sides / 2, centre + sides / 2], axis=1)
    return boxes, classes.argmax(1), classes.max(1), rows[:, end:]


def _yolox_grid(size: tuple[int, int]) -> np.ndarray:
    """(n, 3) column, row and stride of the cells of the grids of strides 8, 16, 32."""
    parts = []
    for stride in (8, 16, 32):
        y, x = np.meshgrid(np.arange(size[0] // stride), np.arange(size[1] // stride), indexing="ij")
        parts.append(np.stack([x.ravel(), y.ravel(), np.full(x.size, stride)], axis=1))
    return np.concatenate(parts).astype(float)


def _best_of_class(boxes: np.ndarray, labels: np.ndarray, scores: np.ndarray, max_overlap: float) -> np.ndarray:
    """Numbers of the boxes left when each one takes away those of its class that overlap it too much and score less."""
    kept = []
    for k in np.argsort(-scores, kind="stable"):
        same = [j for j in kept if labels[j] == labels[k]]
        if len(same) == 0 or _overlap(boxes[k], boxes[same]).max() <= max_overlap:
            kept.append(k)
    return np.array(kept, int)


def _overlap(box: np.ndarray, others: np.ndarray) -> np.ndarray:
    sides = np.clip(np.minimum(box[2:], others[:, 2:]) - np.maximum(box[:2], others[:, :2]), 0, None)
    shared = sides.prod(1)
    return shared / np.maximum((box[2:] - box[:2]).prod() + (others[:, 2:] - others[:, :2]).prod(1) - shared, 1e-9)
