"""How good a label map is, voxel by voxel.

Source: Nagy (2020), 2.5.1 and 2.5.3 (N-030, N-034 to N-036). Two protocols: `even`, the thesis's test set in which the
classes are represented evenly, and `natural`, every voxel of the test part. Rates are in percent; what is undefined is
NaN. Voxels without a true label are left out and counted.
"""

import logging
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import pandas as pd

from streetscan.classes import FACADE, GROUND, LABELS, MOVABLE_LABELS, N_CLASSES, NAMES, PHANTOM, UNLABELLED
from streetscan.errors import BadInput

logger = logging.getLogger(__name__)

COLUMNS = ("protocol", "class", "metric", "value", "unit", "n")
# The thesis leaves ground and facade out of Table 2.3, since they are easy (N-035).
TABLE_LABELS = tuple(label for label in range(N_CLASSES) if label not in (GROUND, FACADE))
N_CALIBRATION_BINS = 15


class Rates(NamedTuple):
    """Per class, as fractions, NaN where undefined: (C,) float64 each; `n` (C,) int64 counts the true members.

    Precision is undefined for a class never predicted; recall, F and IoU for a class that does not occur.
    """

    precision: np.ndarray
    recall: np.ndarray
    f: np.ndarray
    iou: np.ndarray
    n: np.ndarray


def count_confusion(truth: np.ndarray, predicted: np.ndarray, n_classes: int = N_CLASSES) -> np.ndarray:
    """(C, C) int64: how many members of the class of the row were predicted as the class of the column."""
    pairs = truth.astype(np.int64) * n_classes + predicted
    return np.bincount(pairs, minlength=n_classes**2).reshape(n_classes, n_classes)


def rate_classes(confusion: np.ndarray) -> Rates:
    """Precision, recall, F and IoU of each class of a (C, C) confusion matrix with the truth in its rows."""
    hits, n_true, n_predicted = np.diag(confusion), confusion.sum(axis=1), confusion.sum(axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        precision, recall = hits / n_predicted, hits / n_true
        f = np.where(n_true > 0, 2 * hits / (n_true + n_predicted), np.nan)
        iou = np.where(n_true > 0, hits / (n_true + n_predicted - hits), np.nan)
    return Rates(precision, recall, f, iou, n_true)


def average_rates(rates: Rates, labels: Sequence[int], weights: np.ndarray | None = None) -> dict[str, float]:
    """Overall precision, recall, F and IoU of the chosen classes that occur.

    ASSUME: a class that occurs but was never predicted enters the overall precision with 0, or missing it would pay.

    Args:
        rates: of all classes.
        labels: the classes to average.
        weights: (C,) one weight per class; None for the plain mean.
    Returns:
        `precision`, `recall`, `f` (their harmonic mean, N-036) and `iou` as fractions; NaN when none of the classes occurs.
    """
    chosen = np.array([label for label in labels if rates.n[label] > 0], np.int64)
    w = np.ones(len(chosen)) if weights is None else np.asarray(weights, np.float64)[chosen]
    if w.sum() == 0:
        return dict.fromkeys(("precision", "recall", "f", "iou"), np.nan)
    # Divided last: perfect rates give exactly 1.
    precision, recall, iou = ((w * np.nan_to_num(v[chosen])).sum() / w.sum() for v in (rates.precision, rates.recall, rates.iou))
    f = 2 * precision * recall / (precision + recall) if precision + recall > 0 else 0.0
    return {"precision": precision, "recall": recall, "f": f, "iou": iou}


def draw_evenly(truth: np.ndarray, n_per_class: int, rng: np.random.Generator) -> np.ndarray:
    """Rows of a test set with every class that occurs equally often (N-030).

    Args:
        truth: (V,) uint8 true labels, 255 left out.
        n_per_class: the most voxels per class; there are as many as the rarest class has where that is fewer.
        rng: the generator.
    Returns:
        (S,) int64 rows, sorted.
    """
    counts = np.bincount(truth, minlength=256)[:N_CLASSES]
    occurring = np.flatnonzero(counts)
    if len(occurring) == 0:
        return np.empty(0, np.int64)
    n = min(n_per_class, int(counts[occurring].min()))
    return np.sort(np.concatenate([rng.choice(np.flatnonzero(truth == label), n, replace=False) for label in occurring]))


def rate_cleaning(truth: np.ndarray, predicted: np.ndarray, removed_labels: Sequence[int]) -> tuple[float, float, float]:
    """How well a map is cleaned of some classes: the figures of the dynamic-map benchmark of KTH, here per voxel.

    Args:
        truth, predicted: (V,) labels 0..8.
        removed_labels: the classes whose true members are dynamic and whose predicted members are removed.
    Returns:
        static kept (SA), dynamic removed (DA) and their geometric mean (AA) as fractions; NaN where there is no such voxel.
    """
    is_dynamic, is_removed = np.isin(truth, removed_labels), np.isin(predicted, removed_labels)
    kept = np.mean(~is_removed[~is_dynamic]) if (~is_dynamic).any() else np.nan
    removed = np.mean(is_removed[is_dynamic]) if is_dynamic.any() else np.nan
    return float(kept), float(removed), float(np.sqrt(kept * removed))


def reliability_bins(
    is_right: np.ndarray, confidence: np.ndarray, weights: np.ndarray | None = None, n_bins: int = N_CALIBRATION_BINS
) -> pd.DataFrame:
    """Mean confidence and share of right answers per bin of confidence.

    Args:
        is_right: (V,) bool.
        confidence: (V,) in 0..1.
        weights: (V,) of the answers; one each where not given.
        n_bins: bins of equal width; the upper edge belongs to a bin.
    Returns:
        `confidence`, `accuracy` (NaN in empty bins) and `n`, the sum of weights, per bin.
    """
    weights = np.ones(len(confidence)) if weights is None else np.asarray(weights, np.float64)
    bins = np.clip(np.ceil(np.asarray(confidence, np.float64) * n_bins).astype(np.int64) - 1, 0, n_bins - 1)
    n = np.bincount(bins, weights, minlength=n_bins)
    sums = np.bincount(bins, weights * confidence, n_bins), np.bincount(bins, weights * is_right, n_bins)
    means = [np.divide(s, n, out=np.full(n_bins, np.nan), where=n > 0) for s in sums]
    return pd.DataFrame({"confidence": means[0], "accuracy": means[1], "n": n})


def calibration_error(bins: pd.DataFrame) -> float:
    """Expected calibration error: mean distance between confidence and share of right answers, bin by bin, as a fraction.

    Args:
        bins: of `reliability_bins`.
    Returns:
        the mean over all answers; NaN without any.
    Source: Guo et al. (2017), Eq. 3.
    """
    used = bins[bins["n"] > 0]
    if used.empty:
        return np.nan
    return float(((used["confidence"] - used["accuracy"]).abs() * used["n"]).sum() / used["n"].sum())


def merge_classes(confusion: np.ndarray, groups: Mapping[str, Sequence[str]]) -> np.ndarray:
    """The confusion matrix of groups of classes; one more row and column hold the classes in no group.

    Args:
        confusion: (C, C), truth in its rows.
        groups: group name to the names of its classes.
    Returns:
        (G + 1, G + 1) of the same dtype in the order of the groups.
    Raises:
        BadInput: a name that is no class, or a class in two groups.
    """
    group_of = np.full(N_CLASSES, len(groups))
    for i, (group, names) in enumerate(groups.items()):
        for name in names:
            if name not in NAMES:
                raise BadInput(f"group {group}", f"holds '{name}', which is no class", f"use {', '.join(NAMES)}")
            if group_of[LABELS[name]] != len(groups):
                raise BadInput(f"group {group}", f"holds {name}, which is in another group already", "give each class one group")
            group_of[LABELS[name]] = i
    merged = np.zeros((len(groups) + 1, len(groups) + 1), confusion.dtype)
    np.add.at(merged, (group_of[:, None], group_of[None, :]), confusion)
    return merged


def evaluate_labels(
    truth: np.ndarray,
    predicted: np.ndarray,
    confidence: np.ndarray | None,
    *,
    n_per_class: int,
    rng: np.random.Generator,
    groups: Mapping[str, Sequence[str]] | None = None,
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """All figures of a label map.

    Rows of `class`: the nine classes; `overall`, `overall_weighted` over all classes and `objects`, `objects_weighted`
    without ground and facade (Table 2.3); `group:<name>` for groups of classes (Table 2.4); `cleaning:phantom` and
    `cleaning:movable` for removing those from the map; `unlabelled` for voxels left out.
    ASSUME: the weights are the classes' shares of the whole test part, in both protocols. The thesis says "class
    significance" in one place and "occurrence" in another (N-036), and in an even test set occurrence alone would be the
    plain mean, which its overall figures are not.
    ASSUME: leaving ground and facade out leaves their rows out of the average; objects labelled as ground, and ground labelled
    as an object, stay errors.

    Args:
        truth: (V,) uint8 true labels, 255 where unknown.
        predicted: (V,) uint8 predicted labels in 0..8.
        confidence: (V,) float32 in 0..1; None leaves its error out.
        n_per_class: the most voxels per class of the even test set.
        rng: draws the even test set.
        groups: group name to the names of its classes.
    Returns:
        scores with the columns of `COLUMNS` (`n`: voxels of the class or test set), and the confusion counts with the
        columns protocol, truth, predicted, n.
    Raises:
        BadInput: arrays of different lengths, a prediction that is no class, no voxel with a true label, or bad groups.
    """
    if not len(truth) == len(predicted) or (confidence is not None and len(confidence) != len(truth)):
        raise BadInput("the label map", f"{len(predicted)} labels for {len(truth)} voxels of truth", "give the label map of the same part")
    if len(predicted) and predicted.max() >= N_CLASSES:
        raise BadInput("the label map", f"predicts {int(predicted.max())}, which is no class", "run label_map again")
    is_known = truth != UNLABELLED
    if not is_known.any():
        raise BadInput("the truth", "holds no labelled voxel", "evaluate a part with labels")
    natural = np.flatnonzero(is_known)
    shares = np.bincount(truth[natural], minlength=N_CLASSES)
    scores, confusions = [], []
    test_sets = {"even": draw_evenly(truth, n_per_class, rng), "natural": natural}
    for protocol, rows in test_sets.items():
        t, p = truth[rows], predicted[rows]
        confusion = count_confusion(t, p)
        scores += [(protocol, *row) for row in score_confusion(confusion, shares, groups or {})]
        if confidence is not None:
            error = calibration_error(reliability_bins(t == p, confidence[rows]))
            scores.append((protocol, "overall", "calibration_error", 100 * error, "%", len(rows)))
        for name, labels in (("phantom", (PHANTOM,)), ("movable", MOVABLE_LABELS)):
            rates = zip(("static_kept", "dynamic_removed", "geometric_mean"), rate_cleaning(t, p, labels), strict=True)
            scores += [(protocol, f"cleaning:{name}", metric, 100 * value, "%", len(rows)) for metric, value in rates]
        confusions += [(protocol, NAMES[i], NAMES[j], int(confusion[i, j])) for i in range(N_CLASSES) for j in range(N_CLASSES)]
    n_left_out = len(truth) - len(natural)
    n_even = len(test_sets["even"])
    logger.info("%d voxels scored, %d in the even test set, %d without truth left out", len(natural), n_even, n_left_out)
    scores.append(("natural", "unlabelled", "left_out", float(n_left_out), "voxels", len(truth)))
    return pd.DataFrame(scores, columns=COLUMNS), pd.DataFrame(confusions, columns=("protocol", "truth", "predicted", "n"))


def score_confusion(confusion: np.ndarray, shares: np.ndarray, groups: Mapping[str, Sequence[str]]) -> list[tuple]:
    """Rows (class, metric, value, unit, n) of a confusion matrix, (C, C) counts or weights; `shares` weigh the overall figures."""
    rates, total = rate_classes(confusion), float(confusion.sum())
    rows = [row for label, name in enumerate(NAMES) for row in _rate_rows(rates, label, name)]
    for name, labels in (("overall", tuple(range(N_CLASSES))), ("objects", TABLE_LABELS)):
        n = round(float(rates.n[list(labels)].sum()))
        for suffix, weights in (("", None), ("_weighted", shares)):
            rows += [(name + suffix, metric, 100 * value, "%", n) for metric, value in average_rates(rates, labels, weights).items()]
    rows.append(("overall", "accuracy", 100 * float(np.trace(confusion)) / total, "%", round(total)))
    group_rates = rate_classes(merge_classes(confusion, groups))
    return rows + [row for i, group in enumerate(groups) for row in _rate_rows(group_rates, i, f"group:{group}")]


def _rate_rows(rates: Rates, i: int, name: str) -> list[tuple]:
    return [
        (name, metric, 100 * getattr(rates, metric)[i], "%", round(float(rates.n[i]))) for metric in ("precision", "recall", "f", "iou")
    ]
