"""The project's own image detector: a small network that gives every pixel a class, and a vote for the middle of its object.

An encoder-decoder with skips (Ronneberger et al. 2015); objects are pixels that vote for one middle (Cheng et al. 2020,
Panoptic-DeepLab). It is trained on the simulated city alone and small enough
for a laptop: the workflow needs no download to find what moves. It is no Mask R-CNN; `streetscan.calibration.detectors.onnx` runs one.
"""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import nn
from torch.nn.functional import interpolate, max_pool2d

from streetscan.calibration.detectors.image_detections import DYNAMIC_LABELS, STATIC, ImageDetections, check_picture
from streetscan.classes import NAMES
from streetscan.errors import BadInput
from streetscan.io.weights import load_settings, load_weights

# The picture is seen at this reduction by the finest features, and by the coarsest.
STRIDE, _COARSEST = 2, 16
_OUTPUTS = tuple(NAMES[label] for label in DYNAMIC_LABELS)
_MEAN, _DEVIATION = 110.0, 60.0


@dataclass(frozen=True)
class CitySettings:
    """Everything needed to rebuild the network and its input; stored beside the weights.

    Attributes:
        width: pixels a picture is reduced to before the network sees it.
        channels: of the features at 1/2, 1/4, 1/8 and 1/16 of that.
        min_centre: least height of a peak among the votes that is the middle of an object.
        min_pixels: an object with fewer pixels of the network's output is none.
        centre_reach: pixels of the output around a peak within which there is no other.
        classes: names of the outputs after the first, which is what stands still.
        generator_version: of the city the network was trained on.
    """

    width: int = 448
    channels: tuple[int, ...] = (16, 32, 64, 96)
    min_centre: float = 0.2
    min_pixels: int = 8
    centre_reach: int = 3
    classes: tuple[str, ...] = _OUTPUTS
    generator_version: int = 0

    def __post_init__(self):
        for name in ("channels", "classes"):
            object.__setattr__(self, name, tuple(getattr(self, name)))
        if len(self.channels) != 4 or min(self.channels) < 1:
            raise BadInput("channels", f"{list(self.channels)}", "give four numbers of features, such as 16, 32, 64, 96")
        if self.classes != _OUTPUTS:
            raise BadInput("the weights' settings", f"the classes are {', '.join(self.classes)}", f"train again for {', '.join(_OUTPUTS)}")
        if self.width < 2 * _COARSEST:
            raise BadInput("width", f"{self.width} pixels", f"give {2 * _COARSEST} or more")


def _layer(n_in: int, n_out: int, stride: int = 1, spread: int = 1) -> nn.Sequential:
    return nn.Sequential(nn.Conv2d(n_in, n_out, 3, stride, spread, spread, bias=False), nn.BatchNorm2d(n_out), nn.ReLU())


class CityNetwork(nn.Module):
    """Class, middle and vote of every second pixel."""

    def __init__(self, settings: CitySettings):
        super().__init__()
        self.settings = settings
        a, b, c, d = settings.channels
        self.stem = nn.Sequential(_layer(3, a, STRIDE), _layer(a, a))
        self.encoders = nn.ModuleList([
            nn.Sequential(_layer(a, b, 2), _layer(b, b)),
            nn.Sequential(_layer(b, c, 2), _layer(c, c), _layer(c, c)),
            # A car nearby fills half the picture: the coarsest features look far around.
            nn.Sequential(_layer(c, d, 2), *(_layer(d, d, spread=s) for s in (1, 2, 4))),
        ])  # fmt: skip
        self.decoders = nn.ModuleList([_layer(d + c, c), _layer(c + b, b), _layer(b + a, 2 * a)])
        self.heads = nn.Conv2d(2 * a, 1 + len(settings.classes) + 3, 1)
        # Rows of pixels with all their features together are what the CPU is fastest with.
        self.to(memory_format=torch.channels_last)

    def forward(self, images: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """
        Args:
            images: (B, 3, H, W) float32, of `as_input`; H and W multiples of 16.
        Returns:
            logits (B, 4, H/2, W/2) of static and DYNAMIC_LABELS; heat (B, H/2, W/2), 1 at the middle of an object; votes
            (B, 2, H/2, W/2), right and down from a pixel to its object's middle, in 1/16 of the output's pixels.
        """
        features = [self.stem(images)]
        for encoder in self.encoders:
            features.append(encoder(features[-1]))
        x = features.pop()
        for decoder in self.decoders:
            x = decoder(torch.cat([interpolate(x, scale_factor=2, mode="nearest"), features.pop()], dim=1))
        out = self.heads(x)
        n = 1 + len(self.settings.classes)
        return out[:, :n], out[:, n], out[:, n + 1 :]


VOTE_PIXELS = 16.0


def as_input(images: np.ndarray) -> torch.Tensor:
    """(B, H, W, 3) uint8 RGB to the network's input (B, 3, H, W) float32."""
    values = (torch.from_numpy(np.ascontiguousarray(images)).permute(0, 3, 1, 2).float() - _MEAN) / _DEVIATION
    return values.contiguous(memory_format=torch.channels_last)


class CityDetector:
    """Finds trams and buses, pedestrians and cars with a `CityNetwork`."""

    def __init__(self, network: CityNetwork):
        self._network = network.eval()

    @classmethod
    def load(cls, weights: str | Path, settings: str | Path) -> "CityDetector":
        """BadInput when a file is damaged or the two do not belong together."""
        network = CityNetwork(load_settings(CitySettings, settings))
        load_weights(network, weights, settings)
        return cls(network)

    @torch.inference_mode()
    def detect(self, image: np.ndarray) -> ImageDetections:
        """The moving things of an (H, W, 3) uint8 RGB picture, seen at the network's width."""
        check_picture(image)
        settings, (height, width) = self._network.settings, image.shape[:2]
        seen_height = max(round(height * settings.width / width), 1)
        small = cv2.resize(image, (settings.width, seen_height), interpolation=cv2.INTER_AREA)
        below, right = -seen_height % _COARSEST, -settings.width % _COARSEST
        small = cv2.copyMakeBorder(small, 0, below, 0, right, cv2.BORDER_REPLICATE)
        logits, heat, votes = (x[0] for x in self._network(as_input(small[None])))
        rows, columns = -(-seen_height // STRIDE), -(-settings.width // STRIDE)
        logits, heat, votes = logits[:, :rows, :columns], heat[:rows, :columns], votes[:, :rows, :columns]
        labels = np.array([STATIC, *DYNAMIC_LABELS], np.uint8)
        probabilities = logits.softmax(0)
        instances, scores = group_votes(probabilities, heat, votes, settings)
        # Edges are drawn between the output's pixels; which object a pixel is of changes in steps.
        fine = interpolate(logits[None], (height, width), mode="bilinear", align_corners=False)[0]
        classes = labels[fine.argmax(0).numpy()]
        return _at_full_size(classes, labels[logits.argmax(0).numpy()], instances, scores)


def group_votes(
    probabilities: torch.Tensor, heat: torch.Tensor, votes: torch.Tensor, settings: CitySettings
) -> tuple[np.ndarray, np.ndarray]:
    """Objects of the output's pixels: each moving pixel goes to the peak of its own class nearest to where its vote points.

    Args:
        probabilities: (1 + C, h, w).
        heat, votes: of `CityNetwork.forward`.
        settings: of the network.
    Returns:
        (h, w) uint16 objects from 1, 0 for none; (K,) float32 scores, the mean probability of an object's pixels.
    """
    confidence, best = (x.numpy() for x in probabilities.max(0))
    reach = 2 * settings.centre_reach + 1
    is_peak = (heat == max_pool2d(heat[None, None], reach, 1, settings.centre_reach)[0, 0]) & (heat > settings.min_centre)
    peaks = is_peak.numpy() & (best > 0)
    instances = np.zeros(best.shape, np.uint16)
    scores: list[float] = []
    for number in range(1, len(probabilities)):
        rows, columns = np.nonzero(best == number)
        if len(rows) == 0:
            continue
        centres = np.argwhere(peaks & (best == number))
        if len(centres):
            shift = votes[:, rows, columns].numpy() * VOTE_PIXELS
            target = np.stack([rows + shift[1], columns + shift[0]], axis=1)
            owner = ((target[:, None] - centres[None]) ** 2).sum(2).argmin(1)
        else:  # too faint for a peak: what hangs together is one
            owner = cv2.connectedComponents((best == number).astype(np.uint8))[1][rows, columns] - 1
        for k in np.unique(owner):
            mine = owner == k
            if mine.sum() >= settings.min_pixels:
                scores.append(float(confidence[rows[mine], columns[mine]].mean()))
                instances[rows[mine], columns[mine]] = len(scores)
    return instances, np.array(scores, np.float32)


def _at_full_size(classes: np.ndarray, coarse: np.ndarray, instances: np.ndarray, scores: np.ndarray) -> ImageDetections:
    """Objects of the output's pixels as objects of the picture's; moving pixels without an object are too few to be one.

    Args:
        classes: (H, W) of the picture.
        coarse: (h, w) classes of the output's pixels.
        instances: (h, w) of the output's pixels.
        scores: of the objects.
    """
    height, width = classes.shape
    found = np.zeros((height, width), np.uint16)
    for label in DYNAMIC_LABELS:
        mine = np.where(coarse == label, instances, 0).astype(np.uint16)
        if not mine.any():
            continue
        # A pixel of the picture beyond the output's edge of its class belongs to the nearest object of that class.
        _, nearest = cv2.distanceTransformWithLabels((mine == 0).astype(np.uint8), cv2.DIST_L2, 3, labelType=cv2.DIST_LABEL_PIXEL)
        of_label = np.zeros(nearest.max() + 1, np.uint16)
        of_label[nearest[mine > 0]] = mine[mine > 0]
        near = cv2.dilate((mine > 0).astype(np.uint8), np.ones((3, 3), np.uint8))
        full = cv2.resize(np.where(near > 0, of_label[nearest], 0).astype(np.uint16), (width, height), interpolation=cv2.INTER_NEAREST)
        found = np.where(classes == label, full, found)
    seen = np.unique(found)
    seen = seen[seen > 0]
    renumbered = np.zeros(len(scores) + 1, np.uint16)
    renumbered[seen] = np.arange(1, len(seen) + 1)
    return ImageDetections(np.where(found > 0, classes, STATIC).astype(np.uint8), renumbered[found], scores[seen.astype(int) - 1])
