"""Training of PointPillars on lidar frames with true boxes.

Source: Lang et al. (2019), 3 (losses) and 4.3 (augmentation: mirroring, turning, scaling).
"""

import logging
import time
from dataclasses import dataclass

import numpy as np
import torch
from torch.nn.functional import cross_entropy, smooth_l1_loss

from streetscan.calibration.detectors.drive_truth import TrueBoxes
from streetscan.calibration.detectors.pointpillars import PillarSettings, PointPillars, boxes_for_network, encode_boxes, make_anchors
from streetscan.classes import LABELS
from streetscan.errors import BadInput

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class LidarSchedule:
    """How to train. Steps decide when it ends, never the clock.

    Attributes:
        n_steps: batches.
        batch: frames of a batch.
        learning_rate: the highest; it rises in the first tenth of the steps and falls to nothing.
        weight_decay: of AdamW.
        min_points: objects that fewer points lie on are not asked for.
        turn_rad, scale, height_m: largest turn about the vertical, change of size and of height of a frame.
        thinning: least share of the points that is kept.
        max_points: further points of a frame, drawn by chance, are left out.
        positive, negative: overlap from above with a true box from which an anchor is asked for it, and below which it is empty; one
            for each class. Lang et al. have 0.6 and 0.45 for cars, 0.5 and 0.35 for people. ASSUME: less for people, who are
            hardly wider than the 0.4 m between anchors, and for cars and trams, of which the city has all sizes.
        averaging: the weights that are kept are a running mean in which older ones fade by this factor a step.
        seed: of initial weights and batches.
    """

    n_steps: int = 1400
    batch: int = 3
    learning_rate: float = 3e-3
    weight_decay: float = 1e-2
    min_points: int = 5
    turn_rad: float = 0.4
    scale: float = 0.05
    height_m: float = 0.2
    thinning: float = 0.5
    max_points: int = 40_000
    positive: tuple[float, ...] = (0.35, 0.45, 0.5)
    negative: tuple[float, ...] = (0.2, 0.3, 0.35)
    averaging: float = 0.99
    seed: int = 1

    def __post_init__(self):
        for name in ("positive", "negative"):
            object.__setattr__(self, name, tuple(getattr(self, name)))
        if min(self.n_steps, self.batch) < 1:
            raise BadInput("train_lidar_detector", f"{self.n_steps} steps of {self.batch} frames", "give whole numbers of at least 1")


@dataclass
class TrainingFrame:
    """One frame and its truth.

    Attributes:
        points: (n, 4) float32 x, y, z, intensity, frame `lidar`.
        boxes: (m, 7) float32, as `lidar_boxes`.
        labels: (m,) uint8.
    """

    points: np.ndarray
    boxes: np.ndarray
    labels: np.ndarray


def make_frame(
    points: np.ndarray, intensity: np.ndarray | None, truth: TrueBoxes, settings: PillarSettings, min_points: int
) -> TrainingFrame:
    """What of a frame lies in a network's range, with room to turn it, and the boxes with enough points whose middle does."""
    low, high = np.array(settings.range_m[:3]), np.array(settings.range_m[3:])
    reach = np.hypot(high[0] - low[0], high[1] - low[1]) / 2
    near = np.hypot(*(points[:, :2] - (low + high)[:2] / 2).T) < reach
    intensity = np.zeros(len(points), np.float32) if intensity is None else intensity
    wanted = (truth.n_points >= min_points) & np.isin(truth.labels, [LABELS[name] for name in settings.classes])
    wanted &= np.hypot(*(truth.boxes[:, :2] - (low + high)[:2] / 2).T) < reach
    return TrainingFrame(np.c_[points, intensity][near].astype(np.float32), truth.boxes[wanted].astype(np.float32), truth.labels[wanted])


def train_pointpillars(
    frames: list[TrainingFrame], settings: PillarSettings, schedule: LidarSchedule, n_threads: int
) -> tuple[PointPillars, list[dict]]:
    """
    Args:
        frames: to learn from.
        settings, schedule: see there.
        n_threads: of torch; another number gives slightly other weights.
    Returns:
        the network, and the mean losses of every 50 steps.
    Raises:
        BadInput: no frames.
    """
    if not frames:
        raise BadInput("train_lidar_detector.drives", "no lidar frame", "name drives with frames")
    torch.set_num_threads(n_threads)
    torch.manual_seed(schedule.seed)
    rng = np.random.default_rng(schedule.seed)
    network, anchors = PointPillars(settings).train(), make_anchors(settings)
    mean = torch.optim.swa_utils.AveragedModel(
        network, multi_avg_fn=torch.optim.swa_utils.get_ema_multi_avg_fn(schedule.averaging), use_buffers=True
    )
    optimiser = torch.optim.AdamW(network.parameters(), schedule.learning_rate, weight_decay=schedule.weight_decay)
    rate = torch.optim.lr_scheduler.OneCycleLR(optimiser, schedule.learning_rate, schedule.n_steps, pct_start=0.1)
    history, losses, started = [], [], time.perf_counter()
    for step in range(1, schedule.n_steps + 1):
        drawn = [vary_frame(frames[rng.integers(len(frames))], schedule, rng) for _ in range(schedule.batch)]
        parts = batch_losses(network, drawn, anchors, schedule)
        optimiser.zero_grad()
        sum(parts).backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 10.0)
        optimiser.step()
        rate.step()
        mean.update_parameters(network)
        losses.append([part.item() for part in parts])
        if step % 50 == 0 or step == schedule.n_steps:
            score, box, direction = np.mean(losses, axis=0)
            history.append({"step": step, "score_loss": score, "box_loss": box, "direction_loss": direction})
            text = "step %d of %d: losses %.3f (scores), %.3f (boxes), %.3f (directions) after %.0f s"
            logger.info(text, step, schedule.n_steps, score, box, direction, time.perf_counter() - started)
            losses = []
    network.load_state_dict(mean.module.state_dict())
    return network.eval(), history


def batch_losses(network: PointPillars, frames: list[TrainingFrame], anchors: np.ndarray, schedule: LidarSchedule) -> list[torch.Tensor]:
    """Focal loss of the scores, smooth L1 of the boxes with the sine of the angle, cross-entropy of the directions, weighted 1, 2, 0.2."""
    targets = [assign_anchors(frame, network.settings, anchors, schedule) for frame in frames]
    logits, deltas, directions = network([frame.points for frame in frames])
    classes, boxes = (torch.from_numpy(np.stack(part)) for part in zip(*targets, strict=True))
    positive, counted = classes >= 0, classes >= -1
    n = positive.sum().clamp(min=1)
    wanted = torch.zeros_like(logits)
    wanted[positive] = torch.nn.functional.one_hot(classes[positive].long(), logits.shape[-1]).float()
    probability = torch.sigmoid(logits)
    miss = torch.where(wanted > 0, 1 - probability, probability)
    weight = torch.where(wanted > 0, 0.25, 0.75) * miss**2
    entropy = torch.nn.functional.binary_cross_entropy_with_logits(logits, wanted, reduction="none")
    of_scores = (weight * entropy)[counted].sum() / n
    found, true, yaw = deltas[positive], boxes[positive], torch.from_numpy(anchors[:, 6]).expand(len(frames), -1)[positive]
    # sin(a - b) is the same for a box turned by half a circle, which the direction tells apart.
    a = torch.cat([found[:, :6], torch.sin(found[:, 6:]) * torch.cos(true[:, 6:])], dim=1)
    b = torch.cat([true[:, :6], torch.cos(found[:, 6:]) * torch.sin(true[:, 6:])], dim=1)
    of_boxes = smooth_l1_loss(a, b, reduction="sum", beta=1 / 9) / n
    is_negative = (torch.sin(true[:, 6] + yaw) < 0).long()
    of_directions = cross_entropy(directions[positive], is_negative, reduction="sum") / n
    return [of_scores, 2 * of_boxes, 0.2 * of_directions]


def assign_anchors(
    frame: TrainingFrame, settings: PillarSettings, anchors: np.ndarray, schedule: LidarSchedule
) -> tuple[np.ndarray, np.ndarray]:
    """What each anchor is asked for.

    Returns:
        (A,) int8 place of the class in the settings, -1 for nothing, -2 for no matter; (A, 7) float32 deltas to its true box.
    """
    classes, deltas = np.full(len(anchors), -1, np.int8), np.zeros((len(anchors), 7), np.float32)
    boxes = boxes_for_network(frame.boxes).astype(np.float32)
    names = [LABELS[name] for name in settings.classes]
    rows, columns, n_classes = settings.shape[0] // 2, settings.shape[1] // 2, len(settings.classes)
    numbers = np.arange(len(anchors)).reshape(rows, columns, n_classes, -1)
    x, y = anchors[numbers[0, :, 0, 0], 0], anchors[numbers[:, 0, 0, 0], 1]
    best, owner = np.zeros(len(anchors), np.float32), np.full(len(anchors), -1)
    forced = {}
    for k, box in enumerate(boxes):
        number = names.index(frame.labels[k])
        reach = (np.hypot(*box[3:5]) + np.hypot(*settings.sizes_m[number][:2])) / 2
        near = numbers[np.abs(y - box[1]) < reach][:, np.abs(x - box[0]) < reach, number].ravel()
        if len(near) == 0:
            continue
        overlap = _upright_overlap(anchors[near], box[None])[:, 0]
        better = near[overlap > best[near]]
        best[better], owner[better] = overlap[overlap > best[near]], k
        # Every true box has at least the anchor that fits it best.
        if overlap.max() > 0.05:
            forced[near[overlap.argmax()]] = k
    of_class = np.arange(len(anchors)) // 2 % n_classes
    positive, negative = (np.array(limits)[of_class] for limits in (schedule.positive, schedule.negative))
    classes[best >= negative] = -2
    for anchor, k in forced.items():
        best[anchor], owner[anchor] = 1.0, k
    hit = np.flatnonzero(best >= positive)
    classes[hit] = of_class[hit]
    deltas[hit] = encode_boxes(boxes[owner[hit]], anchors[hit])
    return classes, deltas


def _upright_overlap(anchors: np.ndarray, boxes: np.ndarray) -> np.ndarray:
    """(A, M) intersection over union from above, every box turned to the nearest axis, as Lang et al. match them."""
    low_a, high_a = _upright(anchors)
    low_b, high_b = _upright(boxes)
    sides = np.minimum(high_a[:, None], high_b[None]) - np.maximum(low_a[:, None], low_b[None])
    shared = np.clip(sides, 0, None).prod(2)
    return shared / ((high_a - low_a).prod(1)[:, None] + (high_b - low_b).prod(1)[None] - shared)


def _upright(boxes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    is_across = (np.abs(np.sin(boxes[:, 6])) > np.sqrt(0.5))[:, None]
    half = np.where(is_across, boxes[:, [4, 3]], boxes[:, [3, 4]]) / 2
    return boxes[:, :2] - half, boxes[:, :2] + half


def vary_frame(frame: TrainingFrame, schedule: LidarSchedule, rng: np.random.Generator) -> TrainingFrame:
    """The frame mirrored, turned, scaled, raised and thinned by chance."""
    points, boxes = frame.points, frame.boxes.copy()
    n = min(int(len(points) * rng.uniform(schedule.thinning, 1.0)), schedule.max_points)
    points = points[rng.permutation(len(points))[:n]]
    if rng.random() < 0.5:
        points = points * np.array([1, -1, 1, 1], np.float32)
        boxes[:, 1], boxes[:, 6] = -boxes[:, 1], -boxes[:, 6]
    if rng.random() < 0.5:
        points = points * np.array([-1, 1, 1, 1], np.float32)
        boxes[:, 0], boxes[:, 6] = -boxes[:, 0], np.pi - boxes[:, 6]
    angle, factor = rng.uniform(-schedule.turn_rad, schedule.turn_rad), 1 + rng.uniform(-schedule.scale, schedule.scale)
    R = factor * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    rise = rng.uniform(-schedule.height_m, schedule.height_m)
    points = np.c_[points[:, :2] @ R.T, factor * points[:, 2] + rise, points[:, 3]].astype(np.float32)
    boxes[:, :2] = boxes[:, :2] @ R.T
    boxes[:, 2] = factor * boxes[:, 2] + rise
    boxes[:, 3:6] *= factor
    boxes[:, 6] += angle
    return TrainingFrame(points, boxes.astype(np.float32), frame.labels)
