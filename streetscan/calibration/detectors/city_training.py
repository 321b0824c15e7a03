"""Training of the city's image detector on rendered pictures and their exact masks.

Pictures are cut, scaled, mirrored and changed in brightness, contrast, colour, noise and sharpness, so that the network learns
outlines rather than the renderer.
"""

import logging
import time
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from torch.nn.functional import cross_entropy

from streetscan.calibration.detectors.city import STRIDE, VOTE_PIXELS, CityNetwork, CitySettings, as_input
from streetscan.calibration.detectors.image_detections import DYNAMIC_LABELS
from streetscan.errors import BadInput

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class ImageSchedule:
    """How to train. Steps decide when it ends, never the clock.

    Attributes:
        n_steps: batches.
        batch: cuts of a batch.
        cut: (height, width) of a cut in pixels of the network's input, multiples of 16.
        learning_rate: the highest; it rises in the first tenth of the steps and falls to nothing (Smith & Topin 2018).
        weight_decay: of AdamW.
        scales: smallest and largest magnification of a cut.
        averaging: the weights that are kept are a running mean in which older ones fade by this factor a step.
        class_weights: of static, tram_bus, pedestrian and car in the loss.
        seed: of initial weights and cuts.
    """

    n_steps: int = 2000
    batch: int = 4
    cut: tuple[int, int] = (192, 256)
    learning_rate: float = 2e-3
    weight_decay: float = 1e-3
    scales: tuple[float, float] = (0.75, 1.6)
    averaging: float = 0.99
    class_weights: tuple[float, ...] = (1.0, 2.0, 4.0, 1.5)
    seed: int = 1

    def __post_init__(self):
        for name in ("cut", "scales", "class_weights"):
            object.__setattr__(self, name, tuple(getattr(self, name)))
        if min(self.n_steps, self.batch) < 1 or any(side < 16 or side % 16 for side in self.cut):
            raise BadInput("train_image_detector", f"{self.n_steps} steps of {self.batch} cuts of {self.cut}", "give multiples of 16")
        if len(self.class_weights) != 1 + len(DYNAMIC_LABELS):
            raise BadInput("class_weights", f"{len(self.class_weights)} weights", "give one for static, tram_bus, pedestrian and car each")


@dataclass
class TrainingPicture:
    """One picture and its truth, at the network's width.

    Attributes:
        image: (H, W, 3) uint8 RGB.
        labels: (H, W) uint8, 0 for static, else 1 + the place in DYNAMIC_LABELS.
        instances: (H, W) uint16, the picture's own numbers of its moving things, 0 for none.
    """

    image: np.ndarray
    labels: np.ndarray
    instances: np.ndarray


def make_picture(image: np.ndarray, labels: np.ndarray, instances: np.ndarray, width: int) -> TrainingPicture:
    """A picture of any size with true labels (H, W) of `streetscan.classes` and true objects (H, W), brought to a width."""
    size = width, round(image.shape[0] * width / image.shape[1])
    numbers = np.zeros(256, np.uint8)
    numbers[list(DYNAMIC_LABELS)] = 1 + np.arange(len(DYNAMIC_LABELS))
    moving = numbers[labels]
    _, own = np.unique(np.where(moving > 0, instances, 0), return_inverse=True)
    own = own.reshape(labels.shape).astype(np.uint16)
    own = own if (moving == 0).any() else own + 1
    nearest = {"dsize": size, "interpolation": cv2.INTER_NEAREST}
    return TrainingPicture(cv2.resize(image, size, interpolation=cv2.INTER_AREA), cv2.resize(moving, **nearest), cv2.resize(own, **nearest))


def train_city_network(
    pictures: list[TrainingPicture], settings: CitySettings, schedule: ImageSchedule, n_threads: int
) -> tuple[CityNetwork, list[dict]]:
    """
    Args:
        pictures: to learn from.
        settings, schedule: see there.
        n_threads: of torch; another number gives slightly other weights.
    Returns:
        the network, and the mean loss of every 50 steps.
    Raises:
        BadInput: no pictures, or one smaller than a cut at the smallest magnification.
    """
    if not pictures:
        raise BadInput("train_image_detector.drives", "no picture", "name drives with a camera")
    torch.set_num_threads(n_threads)
    torch.manual_seed(schedule.seed)
    rng = np.random.default_rng(schedule.seed)
    network = CityNetwork(settings).train()
    mean = torch.optim.swa_utils.AveragedModel(
        network, multi_avg_fn=torch.optim.swa_utils.get_ema_multi_avg_fn(schedule.averaging), use_buffers=True
    )
    optimiser = torch.optim.AdamW(network.parameters(), schedule.learning_rate, weight_decay=schedule.weight_decay)
    rate = torch.optim.lr_scheduler.OneCycleLR(optimiser, schedule.learning_rate, schedule.n_steps, pct_start=0.1)
    weights, history, losses, started = torch.tensor(schedule.class_weights, dtype=torch.float32), [], [], time.perf_counter()
    for step in range(1, schedule.n_steps + 1):
        cuts = [draw_cut(pictures[rng.integers(len(pictures))], schedule, rng) for _ in range(schedule.batch)]
        loss = batch_loss(network, cuts, weights)
        optimiser.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 5.0)
        optimiser.step()
        rate.step()
        mean.update_parameters(network)
        losses.append(loss.item())
        if step % 50 == 0 or step == schedule.n_steps:
            history.append({"step": step, "loss": float(np.mean(losses))})
            logger.info("step %d of %d: loss %.4f after %.0f s", step, schedule.n_steps, history[-1]["loss"], time.perf_counter() - started)
            losses = []
    network.load_state_dict(mean.module.state_dict())
    return network.eval(), history


def batch_loss(network: CityNetwork, cuts: list[TrainingPicture], weights: torch.Tensor) -> torch.Tensor:
    """Cross-entropy of the classes, squared error of the middles, error of the votes (Cheng et al. 2020, eq. 1)."""
    targets = [make_targets(cut) for cut in cuts]
    labels, heat, votes, known = (torch.from_numpy(np.stack(part)) for part in zip(*targets, strict=True))
    # Half the bits are enough for the features while training, and twice as fast on CPUs that have them.
    with torch.autocast("cpu", torch.bfloat16):
        outputs = network(as_input(np.stack([cut.image for cut in cuts])))
    logits, found_heat, found_votes = (output.float() for output in outputs)
    of_classes = cross_entropy(logits, labels.long(), weights)
    of_heat = ((found_heat - heat) ** 2 * (1 + 20 * heat)).mean()
    moving = known.float()
    of_votes = ((found_votes - votes).abs().sum(1) * moving).sum() / moving.sum().clamp(min=1)
    return of_classes + of_heat + 0.1 * of_votes


def make_targets(cut: TrainingPicture) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """What the network shall say of a cut.

    Returns:
        labels (h, w) uint8; heat (h, w) float32, a Gaussian about the mean pixel of each object, as wide as the object is large;
        votes (2, h, w) float32 as `CityNetwork.forward`; (h, w) bool where an object is.
    """
    labels, instances = cut.labels[::STRIDE, ::STRIDE], cut.instances[::STRIDE, ::STRIDE]
    shape = labels.shape
    heat, votes = np.zeros(shape, np.float32), np.zeros((2, *shape), np.float32)
    rows, columns = np.nonzero(instances)
    if len(rows):
        owners, which, counts = np.unique(instances[rows, columns], return_inverse=True, return_counts=True)
        middle = np.stack([np.bincount(which, x) / counts for x in (columns, rows)])
        votes[:, rows, columns] = (middle[:, which] - np.stack([columns, rows])) / VOTE_PIXELS
        for k in range(len(owners)):
            deviation = np.clip(np.sqrt(counts[k]) / 8, 1.0, 6.0)
            reach = int(3 * deviation) + 1
            (x, y), (h, w) = middle[:, k], shape
            ys = np.arange(max(int(y) - reach, 0), min(int(y) + reach + 1, h))
            xs = np.arange(max(int(x) - reach, 0), min(int(x) + reach + 1, w))
            bump = np.exp(-((ys[:, None] - y) ** 2 + (xs[None] - x) ** 2) / (2 * deviation**2)).astype(np.float32)
            part = np.s_[ys[0] : ys[-1] + 1, xs[0] : xs[-1] + 1]
            heat[part] = np.maximum(heat[part], bump)
    return labels, heat, votes, instances > 0


def draw_cut(picture: TrainingPicture, schedule: ImageSchedule, rng: np.random.Generator) -> TrainingPicture:
    """A random part of a picture at a random size, mirrored every second time, in other light and other weather of the sensor."""
    height, width = schedule.cut
    scale = np.exp(rng.uniform(*np.log(schedule.scales)))
    rows = min(round(height / scale), picture.image.shape[0])
    columns = min(round(width / scale), picture.image.shape[1])
    top = rng.integers(picture.image.shape[0] - rows + 1)
    left = rng.integers(picture.image.shape[1] - columns + 1)
    part = np.s_[top : top + rows, left : left + columns]
    size = {"dsize": (width, height)}
    image = cv2.resize(picture.image[part], interpolation=cv2.INTER_LINEAR, **size)
    labels, instances = (cv2.resize(x[part], interpolation=cv2.INTER_NEAREST, **size) for x in (picture.labels, picture.instances))
    if rng.random() < 0.5:
        image, labels, instances = image[:, ::-1], labels[:, ::-1], instances[:, ::-1]
    return TrainingPicture(_vary(image, rng), labels, instances)


def _vary(image: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """The picture in other light: brightness, contrast, white balance, saturation, gamma, blur and noise."""
    x = image.astype(np.float32)
    grey = x.mean(axis=2, keepdims=True)
    x = grey + (x - grey) * rng.uniform(0.4, 1.4)
    x = 255 * (np.clip(x, 0, 255) / 255) ** np.exp(rng.uniform(-0.4, 0.4))
    x = (x - 110) * rng.uniform(0.7, 1.3) + 110 + rng.uniform(-35, 35)
    x = x * rng.uniform(0.9, 1.1, 3).astype(np.float32)
    if rng.random() < 0.3:
        x = cv2.GaussianBlur(x, (0, 0), rng.uniform(0.4, 1.2))
    x = x + rng.normal(0, rng.uniform(0, 8), image.shape).astype(np.float32)
    return np.clip(x, 0, 255).astype(np.uint8)
