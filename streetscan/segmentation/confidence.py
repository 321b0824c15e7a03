"""Confidence that means what it says, and labels at the shares in which classes occur.

A network trained on even classes is as sure of itself as its training made it. Dividing its logits by one temperature, fitted on the
validation samples, makes its confidence the share of right labels and changes no label of one look at one voxel; turns and smoothing
average what comes of it. Where a map is scored as its classes occur, the logarithm of how much more often a class occurs than it was
trained on is added: what is rare needs more evidence. Both end in the weights of the output layer, so that whatever reads the network is
calibrated.

Source: ours (the thesis has no confidence); Guo et al. (2017), 4.2; Saerens et al. (2002), Eq. 2.4, for the shares.
"""

import copy
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
import torch
from scipy.optimize import minimize_scalar
from scipy.special import softmax

from streetscan.classes import N_CLASSES
from streetscan.segmentation.c2cnn import C2CNN
from streetscan.segmentation.metrics import COLUMNS, calibration_error, reliability_bins, score_confusion
from streetscan.segmentation.sparse import open_workers
from streetscan.segmentation.training import Part, class_weights, sample_logits

logger = logging.getLogger(__name__)

_LARGEST_TEMPERATURE = 20.0


@dataclass(frozen=True)
class Calibration:
    """What is done to logits: divided by `temperature`, then moved by the (9,) `shifts`."""

    temperature: float
    shifts: np.ndarray

    def class_shares(self, logits: np.ndarray) -> np.ndarray:
        """(S, 9) shares of the classes, the mean over the turns in which (turns, S, 9) logits were found, as label_map takes it."""
        return softmax(logits.astype(np.float64) / self.temperature + self.shifts, axis=2).mean(axis=0)


def sample_weights(labels: np.ndarray, n_voxels: np.ndarray) -> np.ndarray:
    """(S,) weights, on average 1, with which samples drawn per class stand for voxels.

    Args:
        labels: (S,) of the samples.
        n_voxels: (9,) voxels of each class; equal numbers weigh the classes alike.
    """
    n_samples = np.bincount(labels, minlength=N_CLASSES)
    weights = (np.maximum(n_voxels, 1) / np.maximum(n_samples, 1))[labels]
    return weights * len(labels) / weights.sum()


def prior_shifts(sample_labels: np.ndarray, voxel_labels: np.ndarray, class_power: float) -> np.ndarray:
    """(9,) logarithms of how much more often each class occurs than it was trained on, on average 0.

    Args:
        sample_labels: (S,) of the training samples.
        voxel_labels: (V,) uint8 of the training part, 255 unlabelled; its shares are expected of other parts.
        class_power: of the training, see `training.class_weights`.
    """
    n_samples = np.bincount(sample_labels, minlength=N_CLASSES)
    trained = class_weights(sample_labels, voxel_labels, class_power) * n_samples
    occurring = np.bincount(voxel_labels, minlength=256)[:N_CLASSES]
    # What was never seen counts as seen once on both sides.
    shifts = np.log(np.maximum(occurring, 1)) - np.log(np.maximum(trained, 1))
    return shifts - shifts.mean()


def fit_calibration(logits: np.ndarray, labels: np.ndarray, weights: np.ndarray, shifts: np.ndarray) -> Calibration:
    """The temperature of the least mean loss, given how far the logits are moved.

    Args:
        logits: (turns, S, 9) of validation samples.
        labels: (S,) their classes.
        weights: (S,) of the samples.
        shifts: (9,) added to the divided logits.
    """

    def loss(log_temperature: float) -> float:
        return mean_loss(Calibration(np.exp(log_temperature), shifts).class_shares(logits), labels, weights)

    limit = np.log(_LARGEST_TEMPERATURE)
    found = minimize_scalar(loss, bounds=(-limit, limit), method="bounded", options={"xatol": 1e-3})
    return Calibration(float(np.exp(found.x)), shifts)


def mean_loss(shares: np.ndarray, labels: np.ndarray, weights: np.ndarray) -> float:
    """Weighted mean cross-entropy of (S, 9) shares of the classes, in nats."""
    losses = -np.log(np.maximum(shares[np.arange(len(labels)), labels], np.finfo(np.float64).tiny))
    return float(np.average(losses, weights=weights))


def _reliability(shares: np.ndarray, labels: np.ndarray, weights: np.ndarray) -> pd.DataFrame:
    return reliability_bins(shares.argmax(axis=1) == labels, shares.max(axis=1), weights)


def fold(network: C2CNN, calibration: Calibration) -> C2CNN:
    """A copy of the network that gives calibrated logits."""
    folded = copy.deepcopy(network)
    with torch.no_grad():
        folded.output.weight.div_(calibration.temperature)
        folded.output.bias.div_(calibration.temperature).add_(torch.from_numpy(calibration.shifts.astype(np.float32)))
    return folded


def score_samples(
    shares: np.ndarray, labels: np.ndarray, n_voxels: np.ndarray, groups: Mapping[str, Sequence[str]]
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """How good shares of classes are on samples drawn per class, with the classes alike (`even`) and as they occur (`natural`).

    Args:
        shares: (S, 9).
        labels: (S,) true classes.
        n_voxels: (9,) voxels of each class in the part the samples are from.
        groups: group name to the names of its classes.
    Returns:
        scores with the columns of `metrics.COLUMNS` (`n` are the samples' weights), and the bins of `reliability_bins` with the protocol
        before them.
    """
    scores, reliability = [], []
    for protocol, counts in (("even", np.ones(N_CLASSES)), ("natural", n_voxels)):
        weights = sample_weights(labels, counts)
        confusion = np.zeros((N_CLASSES, N_CLASSES))
        np.add.at(confusion, (labels, shares.argmax(axis=1)), weights)
        scores += [(protocol, *row) for row in score_confusion(confusion, n_voxels, groups)]
        bins = _reliability(shares, labels, weights)
        scores.append((protocol, "overall", "calibration_error", 100 * calibration_error(bins), "%", len(labels)))
        scores.append((protocol, "overall", "loss", mean_loss(shares, labels, weights), "", len(labels)))
        reliability.append(bins.assign(protocol=protocol))
    return pd.DataFrame(scores, columns=COLUMNS), pd.concat(reliability, ignore_index=True)


def calibrate(
    network: C2CNN,
    part: Part,
    n_voxels: np.ndarray,
    shifts: np.ndarray,
    groups: Mapping[str, Sequence[str]] | None = None,
    n_turns: int = 1,
    n_threads: int = 1,
) -> tuple[C2CNN, pd.DataFrame, pd.DataFrame]:
    """A calibrated network, and what it is worth on the validation samples as trained and as calibrated.

    ASSUME: confidence is to be right for the voxels of a map as they occur, so that the samples weigh as their classes do. The temperature
    of the least loss is taken only if it lowers the calibration error as well; a network that was right already stays as it is.

    Args:
        network: as trained.
        part: the validation part with its samples.
        n_voxels: (9,) voxels of each class in it.
        shifts: (9,) what is added to the logits, `prior_shifts` or a part of them; zeros leave the labels as they are.
        groups: group name to the names of its classes.
        n_turns: quarter turns in which maps will be labelled, see `inference.label_voxels`.
        n_threads: threads; the result does not depend on it.
    Returns:
        the network; scores and reliability as in `score_samples`, with a first column `stage`: trained or calibrated. Among the scores
        are the temperature and the part's voxels, dense and occupied.
    """
    with open_workers(n_threads) as workers:
        found = [sample_logits(network, part, workers, turn) for turn in range(0, 4, 4 // n_turns)]
    logits, labels = np.stack([of_turn.numpy() for of_turn, _ in found]), found[0][1].numpy()
    weights = sample_weights(labels, n_voxels)
    candidates = Calibration(1.0, shifts), fit_calibration(logits, labels, weights, shifts)
    calibration = min(candidates, key=lambda c: calibration_error(_reliability(c.class_shares(logits), labels, weights)))
    stages = {"trained": Calibration(1.0, np.zeros(N_CLASSES)), "calibrated": calibration}
    tables = [score_samples(of_stage.class_shares(logits), labels, n_voxels, groups or {}) for of_stage in stages.values()]
    scores, reliability = (
        pd.concat(parts, keys=list(stages), names=["stage"]).reset_index("stage").reset_index(drop=True)
        for parts in zip(*tables, strict=True)
    )
    more = (
        ("calibrated", "natural", "overall", "temperature", calibration.temperature, "", len(labels)),
        ("calibrated", "natural", "part", "n_voxels", part.grid.n_dense, "", len(part.grid)),
        ("calibrated", "natural", "part", "n_occupied", len(part.grid), "", len(part.grid)),
    )
    scores = pd.concat([scores, pd.DataFrame(more, columns=list(scores))], ignore_index=True)
    errors = scores.loc[(scores["metric"] == "calibration_error") & (scores["protocol"] == "natural"), "value"]
    logger.info("temperature %.3f; calibration error %.2f %% before, %.2f %% after", calibration.temperature, *errors)
    return fold(network, calibration), scores, reliability
