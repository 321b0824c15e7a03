"""PointPillars: boxes around cars and people in a lidar frame, by a 2-D convolutional network over vertical pillars.

Width, range and anchors are settings. `street_settings` is a small one for the streets around the vehicle, whose weights come with
streetscan; `KITTI` is the network as published, in the names and shapes of the public weights of zhulf0804/PointPillars
(`epoch_160.pth`), which the user brings.

Source: Lang et al. (2019), PointPillars, 2.1-2.3 and 4.2; Nagy (2020), 4.3.2.1 (N-215).
"""

import pickle
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import nn

from streetscan.calibration.detectors.image_detections import DYNAMIC_LABELS
from streetscan.calibration.detectors.lidar_boxes import LidarDetections, suppress_overlaps
from streetscan.classes import LABELS, NAMES
from streetscan.errors import BadInput
from streetscan.io.weights import fill_network, load_settings, load_weights

_N_FEATURES = 9
_YAWS = (0.0, 1.57)


@dataclass(frozen=True)
class PillarSettings:
    """Everything needed to rebuild the network; stored beside the weights.

    Attributes:
        range_m: (x, y, z of the lowest corner, x, y, z of the highest) of what is looked at, frame `lidar`, metres.
        pillar_m: edge of a pillar.
        max_points: of a pillar; further ones, in the order of the frame, are left out.
        pillar_channels: features of a pillar.
        channels, n_layers: features and layers after the first of each block of the backbone; each block halves the resolution.
        neck_channels: features each block gives to the heads, at half the resolution of the pillars.
        classes: names in `streetscan.classes` of what is found.
        sizes_m: width, length, height of each class' anchors.
        bottoms_m: z of the anchors' lower face.
        uses_intensity: whether intensities enter; else zeros.
        has_empty_places: whether a pillar that is not full holds places whose features are zeros and compete with its points, as in
            the published code.
        generator_version: of the city the network was trained on; 0 for real recordings.
    """

    range_m: tuple[float, ...]
    pillar_m: float
    max_points: int
    pillar_channels: int
    channels: tuple[int, ...]
    n_layers: tuple[int, ...]
    neck_channels: int
    classes: tuple[str, ...]
    sizes_m: tuple[tuple[float, ...], ...]
    bottoms_m: tuple[float, ...]
    uses_intensity: bool
    has_empty_places: bool
    generator_version: int = 0

    def __post_init__(self):
        for name in ("range_m", "channels", "n_layers", "classes", "bottoms_m"):
            object.__setattr__(self, name, tuple(getattr(self, name)))
        object.__setattr__(self, "sizes_m", tuple(tuple(size) for size in self.sizes_m))
        if len(self.range_m) != 6 or not all(low < high for low, high in zip(self.range_m[:3], self.range_m[3:], strict=True)):
            raise BadInput("range_m", f"{list(self.range_m)}", "give the lowest and the highest corner, such as -20, -20, -3, 20, 20, 2")
        if not self.pillar_m > 0 or any(n % 2 ** len(self.channels) for n in self.shape):
            raise BadInput("pillar_m", f"a grid of {self.shape}", f"let both sides be multiples of {2 ** len(self.channels)} pillars")
        if not len(self.classes) == len(self.sizes_m) == len(self.bottoms_m):
            raise BadInput("classes", f"{len(self.classes)} classes, {len(self.sizes_m)} sizes", "give each class a size and a height")
        if wrong := [name for name in self.classes if LABELS.get(name) not in DYNAMIC_LABELS]:
            raise BadInput("classes", f"'{wrong[0]}' cannot move", f"choose of {', '.join(NAMES[label] for label in DYNAMIC_LABELS)}")

    @property
    def shape(self) -> tuple[int, int]:
        """Pillars along y and x."""
        low, high = np.array(self.range_m[:2]), np.array(self.range_m[3:5])
        n = np.round((high - low) / self.pillar_m).astype(int)
        return int(n[1]), int(n[0])


def street_settings(generator_version: int = 0) -> PillarSettings:
    """A quarter of the width of the published network, 40 x 40 m about the vehicle."""
    # ASSUME: the thesis looks at 15 m about the sensor (N-214); 20 m hold the whole of what stands at its edge.
    # Intensities stay out: those of the simulated receiver are not those of the next sensor.
    return PillarSettings(
        range_m=(-20.0, -20.0, -3.0, 20.0, 20.0, 2.6), pillar_m=0.2, max_points=32, pillar_channels=16, channels=(16, 32, 64),
        n_layers=(3, 5, 5), neck_channels=32, classes=("pedestrian", "tram_bus", "car"),
        sizes_m=((0.6, 0.6, 1.7), (2.5, 11.0, 3.2), (1.85, 4.4, 1.55)), bottoms_m=(-1.75, -1.7, -1.75), uses_intensity=False,
        has_empty_places=False, generator_version=generator_version,
    )  # fmt: skip


# The published network for KITTI: a range ahead of the vehicle; pedestrian, cyclist, car. ASSUME: a cyclist is a person for us.
KITTI = PillarSettings(
    range_m=(0.0, -39.68, -3.0, 69.12, 39.68, 1.0), pillar_m=0.16, max_points=32, pillar_channels=64, channels=(64, 128, 256),
    n_layers=(3, 5, 5), neck_channels=128, classes=("pedestrian", "pedestrian", "car"),
    sizes_m=((0.6, 0.8, 1.73), (0.6, 1.76, 1.73), (1.6, 3.9, 1.56)), bottoms_m=(-0.6, -0.6, -1.78), uses_intensity=True,
    has_empty_places=True,
)  # fmt: skip


class PillarEncoder(nn.Module):
    """A frame's points to a picture of its pillars."""

    def __init__(self, settings: PillarSettings):
        super().__init__()
        self._settings = settings
        self.conv = nn.Conv1d(_N_FEATURES, settings.pillar_channels, 1, bias=False)
        self.bn = nn.BatchNorm1d(settings.pillar_channels, eps=1e-3)

    def forward(self, features: torch.Tensor, pillars: torch.Tensor, counts: torch.Tensor, n_frames: int) -> torch.Tensor:
        """(B, C, H, W) of the point features (N, 9), their pillar (N,) in B * H * W, and the points of each of those pillars."""
        settings = self._settings
        points = torch.relu(self.bn(self.conv(features.T[None]))[0].T)
        picture = points.new_zeros(n_frames * settings.shape[0] * settings.shape[1], settings.pillar_channels)
        picture = picture.scatter_reduce(0, pillars[:, None].expand_as(points), points, "amax")
        if settings.has_empty_places:
            of_empty = torch.relu(self.bn.bias - self.bn.running_mean * self.bn.weight / torch.sqrt(self.bn.running_var + self.bn.eps))
            is_part_full = (counts > 0) & (counts < settings.max_points)
            picture = torch.where(is_part_full[:, None], torch.maximum(picture, of_empty), picture)
        return picture.reshape(n_frames, *settings.shape, -1).permute(0, 3, 1, 2)


class Backbone(nn.Module):
    """Blocks of convolutions, each at half the resolution of the one before."""

    def __init__(self, settings: PillarSettings):
        super().__init__()
        self.multi_blocks, n_in = nn.ModuleList(), settings.pillar_channels
        for n_out, n_layers in zip(settings.channels, settings.n_layers, strict=True):
            layers = _convolution(nn.Conv2d(n_in, n_out, 3, 2, 1, bias=False))
            for _ in range(n_layers):
                layers += _convolution(nn.Conv2d(n_out, n_out, 3, 1, 1, bias=False))
            self.multi_blocks.append(nn.Sequential(*layers))
            n_in = n_out

    def forward(self, x: torch.Tensor) -> list[torch.Tensor]:
        outputs = []
        for block in self.multi_blocks:
            outputs.append(x := block(x))
        return outputs


class Neck(nn.Module):
    """The blocks' outputs brought to one resolution, side by side."""

    def __init__(self, settings: PillarSettings):
        super().__init__()
        self.decoder_blocks = nn.ModuleList()
        for k, n_in in enumerate(settings.channels):
            up = nn.ConvTranspose2d(n_in, settings.neck_channels, 2**k, stride=2**k, bias=False)
            self.decoder_blocks.append(nn.Sequential(*_convolution(up)))

    def forward(self, inputs: list[torch.Tensor]) -> torch.Tensor:
        return torch.cat([block(x) for block, x in zip(self.decoder_blocks, inputs, strict=True)], dim=1)


class Head(nn.Module):
    """Score, box and direction of every anchor."""

    def __init__(self, settings: PillarSettings):
        super().__init__()
        n_in, n_classes = settings.neck_channels * len(settings.channels), len(settings.classes)
        n_anchors = n_classes * len(_YAWS)
        self.conv_cls = nn.Conv2d(n_in, n_anchors * n_classes, 1)
        self.conv_reg = nn.Conv2d(n_in, n_anchors * 7, 1)
        self.conv_dir_cls = nn.Conv2d(n_in, n_anchors * 2, 1)
        # Nearly every anchor is empty: training starts from there (Lin et al. 2017).
        nn.init.constant_(self.conv_cls.bias, -float(np.log(99)))
        for layer in (self.conv_cls, self.conv_reg, self.conv_dir_cls):
            nn.init.normal_(layer.weight, std=0.01)

    def forward(self, x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        scores, boxes, directions = (layer(x).permute(0, 2, 3, 1) for layer in (self.conv_cls, self.conv_reg, self.conv_dir_cls))
        n = len(x)
        return scores.reshape(n, -1, scores.shape[-1] // (boxes.shape[-1] // 7)), boxes.reshape(n, -1, 7), directions.reshape(n, -1, 2)


def _convolution(layer: nn.Module) -> list[nn.Module]:
    return [layer, nn.BatchNorm2d(layer.out_channels, eps=1e-3), nn.ReLU(inplace=True)]


class PointPillars(nn.Module):
    """The network of Fig. 2."""

    def __init__(self, settings: PillarSettings):
        super().__init__()
        self.settings = settings
        self.pillar_encoder, self.backbone, self.neck, self.head = (part(settings) for part in (PillarEncoder, Backbone, Neck, Head))

    def forward(self, frames: list[np.ndarray]) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """
        Args:
            frames: B times (n, 4) float32 x, y, z, intensity, frame `lidar`.
        Returns:
            logits (B, A, C), box deltas (B, A, 7) and directions (B, A, 2) of the anchors of `make_anchors`, in its order.
        """
        n_pillars = int(np.prod(self.settings.shape))
        parts = [point_features(frame, self.settings) for frame in frames]
        features = torch.from_numpy(np.concatenate([part[0] for part in parts]))
        pillars = torch.from_numpy(np.concatenate([part[1] + k * n_pillars for k, part in enumerate(parts)]))
        counts = torch.from_numpy(np.concatenate([np.bincount(part[1], minlength=n_pillars) for part in parts]))
        x = self.pillar_encoder(features, pillars, counts, len(frames))
        # Half the bits are enough for the features while training, and faster on CPUs that have them.
        with torch.autocast("cpu", torch.bfloat16, enabled=self.training):
            outputs = self.head(self.neck(self.backbone(x)))
        return tuple(output.float() for output in outputs)


def point_features(points: np.ndarray, settings: PillarSettings) -> tuple[np.ndarray, np.ndarray]:
    """The nine features of each point, and its pillar.

    Args:
        points: (n, 4) float32 x, y, z, intensity.
        settings: range and pillars.
    Returns:
        (N, 9) float32: x, y from the middle of the pillar, z, intensity, x, y, z from the mean of the pillar's points, and x, y from its
        middle again (Lang et al. 2.1 name x, y themselves in the first place; the public weights were trained without); (N,) int64
        pillar, row by row of y. The points outside the range and beyond `max_points` are left out.
    """
    low, high = (np.array(corner, np.float32) for corner in (settings.range_m[:3], settings.range_m[3:]))
    inside = points[((points[:, :3] >= low) & (points[:, :3] < high)).all(axis=1)]
    if not settings.uses_intensity:
        inside = np.concatenate([inside[:, :3], np.zeros((len(inside), 1), np.float32)], axis=1)
    cell = np.minimum(((inside[:, :2] - low[:2]) / np.float32(settings.pillar_m)).astype(np.int64), np.array(settings.shape[::-1]) - 1)
    pillar = cell[:, 1] * settings.shape[1] + cell[:, 0]
    order = np.argsort(pillar, kind="stable")
    pillar, inside, cell = pillar[order], inside[order], cell[order]
    first = np.flatnonzero(np.append(True, pillar[1:] != pillar[:-1])) if len(pillar) else np.zeros(0, int)
    rank = np.arange(len(pillar)) - np.repeat(first, np.diff(np.append(first, len(pillar))))
    kept = rank < settings.max_points
    pillar, inside, cell = pillar[kept], inside[kept], cell[kept]
    _, which, counts = np.unique(pillar, return_inverse=True, return_counts=True)
    mean = np.stack([np.bincount(which, inside[:, k], len(counts)) / np.maximum(counts, 1) for k in range(3)], axis=1)
    off_middle = inside[:, :2] - (low[:2] + (cell + 0.5) * settings.pillar_m)
    features = np.concatenate([off_middle, inside[:, 2:4], inside[:, :3] - mean[which], off_middle], axis=1)
    return features.astype(np.float32), pillar


def make_anchors(settings: PillarSettings) -> np.ndarray:
    """(A, 7) float32 x, y, z of the lower face, width, length, height, angle; by row (y), column (x), class and angle.

    The angle is the network's own, as KITTI's `rotation_y`: see `boxes_of_network`.
    """
    rows, columns = (n // 2 for n in settings.shape)
    step = 2 * settings.pillar_m
    y, x = (settings.range_m[k] + (np.arange(n) + 0.5) * step for k, n in ((1, rows), (0, columns)))
    anchors = np.zeros((rows, columns, len(settings.classes), len(_YAWS), 7), np.float32)
    anchors[..., 0], anchors[..., 1] = x[None, :, None, None], y[:, None, None, None]
    for k, (size, bottom) in enumerate(zip(settings.sizes_m, settings.bottoms_m, strict=True)):
        anchors[:, :, k, :, 2:6] = (bottom, *size)
    anchors[..., 6] = _YAWS
    return anchors.reshape(-1, 7)


def encode_boxes(boxes: np.ndarray, anchors: np.ndarray) -> np.ndarray:
    """Deltas (K, 7) of boxes from anchors, both in the network's form (Lang et al. 2.3; Yan et al. 2018)."""
    diagonal = np.hypot(anchors[:, 3], anchors[:, 4])
    deltas = np.empty_like(boxes)
    deltas[:, :2] = (boxes[:, :2] - anchors[:, :2]) / diagonal[:, None]
    # The middle, in heights of the anchor; ASSUME as in the public weights, where the shift is that of the middles.
    deltas[:, 2] = (boxes[:, 2] + boxes[:, 5] / 2 - anchors[:, 2] - anchors[:, 5] / 2) / anchors[:, 5]
    deltas[:, 3:6] = np.log(boxes[:, 3:6] / anchors[:, 3:6])
    deltas[:, 6] = boxes[:, 6] - anchors[:, 6]
    return deltas


def decode_boxes(deltas: np.ndarray, anchors: np.ndarray) -> np.ndarray:
    """The boxes (K, 7) in the network's form; the inverse of `encode_boxes`."""
    boxes = np.empty_like(deltas)
    boxes[:, :2] = deltas[:, :2] * np.hypot(anchors[:, 3], anchors[:, 4])[:, None] + anchors[:, :2]
    boxes[:, 3:6] = np.exp(np.clip(deltas[:, 3:6], -5, 5)) * anchors[:, 3:6]
    boxes[:, 2] = deltas[:, 2] * anchors[:, 5] + anchors[:, 2] + anchors[:, 5] / 2 - boxes[:, 5] / 2
    boxes[:, 6] = deltas[:, 6] + anchors[:, 6]
    return boxes


def boxes_of_network(boxes: np.ndarray) -> np.ndarray:
    """Boxes in our form from the network's: there z is the lower face, the order is width, length, and the angle is KITTI's
    `rotation_y`, clockwise from above and 0 when the length points against y."""
    x, y, z, width, length, height, angle = np.asarray(boxes).reshape(-1, 7).T
    return np.stack([x, y, z + height / 2, length, width, height, _wrap(-angle - np.pi / 2)], axis=1)


def boxes_for_network(boxes: np.ndarray) -> np.ndarray:
    """The inverse of `boxes_of_network`."""
    x, y, z, length, width, height, yaw = np.asarray(boxes).reshape(-1, 7).T
    return np.stack([x, y, z - height / 2, width, length, height, _wrap(-yaw - np.pi / 2)], axis=1)


def _wrap(angle: np.ndarray) -> np.ndarray:
    return (angle + np.pi) % (2 * np.pi) - np.pi


@dataclass(frozen=True)
class Choice:
    """Which boxes are believed.

    Attributes:
        min_score: least score.
        max_overlap: of two boxes of a class, seen from above; the one with the lower score goes.
        n_looked_at: best anchors that are decoded.
        max_boxes: of a frame.
    """

    min_score: float = 0.25
    max_overlap: float = 0.1
    n_looked_at: int = 1000
    max_boxes: int = 100


class PillarDetector:
    """Finds boxes with a `PointPillars` network."""

    def __init__(self, network: PointPillars, choice: Choice):
        self._network, self._choice = network.eval(), choice
        self._anchors = make_anchors(network.settings)
        self._labels = np.array([LABELS[name] for name in network.settings.classes], np.uint8)

    @classmethod
    def load(cls, weights: str | Path, settings: str | Path, choice: Choice) -> "PillarDetector":
        """A network of ours. BadInput when a file is damaged or the two do not belong together."""
        network = PointPillars(load_settings(PillarSettings, settings))
        load_weights(network, weights, settings)
        return cls(network, choice)

    @classmethod
    def load_kitti(cls, path: str | Path, choice: Choice) -> "PillarDetector":
        """The published network with the public weights. BadInput when the file holds no such weights."""
        network = PointPillars(KITTI)
        remedy = "give epoch_160.pth of zhulf0804/PointPillars"
        try:
            tensors = torch.load(path, map_location="cpu", weights_only=True)
        except (OSError, EOFError, RuntimeError, ValueError, KeyError, pickle.UnpicklingError) as error:
            raise BadInput(path, f"no file of weights ({str(error).splitlines()[0]})", remedy) from error
        if not isinstance(tensors, dict) or not all(isinstance(v, torch.Tensor) for v in tensors.values()):
            raise BadInput(path, "no table of weights", remedy)
        fill_network(network, tensors, path, "the published network for KITTI")
        return cls(network, choice)

    @torch.inference_mode()
    def detect(self, points: np.ndarray, intensity: np.ndarray | None = None) -> LidarDetections:
        """See `lidar_boxes.LidarDetector`."""
        points = np.asarray(points, np.float32)
        intensity = np.zeros(len(points), np.float32) if intensity is None else np.asarray(intensity, np.float32)
        frame = np.c_[points[:, :3], intensity]
        if len(point_features(frame, self._network.settings)[0]) == 0:
            return LidarDetections(np.zeros((0, 7), np.float32), np.zeros(0, np.uint8), np.zeros(0, np.float32))
        logits, deltas, directions = (x[0] for x in self._network([frame]))
        best = logits.max(1).values.topk(min(self._choice.n_looked_at, len(logits))).indices
        scores, deltas, directions = torch.sigmoid(logits[best]).numpy(), deltas[best].numpy(), directions[best].numpy()
        boxes = decode_boxes(deltas, self._anchors[best.numpy()])
        # The angle is known up to half a turn; the direction says which.
        boxes[:, 6] = boxes[:, 6] % np.pi - np.pi * directions.argmax(1)
        boxes, found = boxes_of_network(boxes).astype(np.float32), []
        for number in range(scores.shape[1]):
            rows = np.flatnonzero(scores[:, number] >= self._choice.min_score)
            kept = rows[suppress_overlaps(boxes[rows], scores[rows, number], self._choice.max_overlap)]
            found += [(scores[row, number], self._labels[number], *boxes[row]) for row in kept]
        found = np.array(sorted(found, key=lambda row: -row[0])[: self._choice.max_boxes], np.float32).reshape(-1, 9)
        return LidarDetections(found[:, 2:], found[:, 1].astype(np.uint8), found[:, 0])
