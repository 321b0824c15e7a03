"""The label map's parts, `voxels_{tiles}.npz`: rows of the voxel grid with their predicted labels and confidences."""

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from streetscan.classes import N_CLASSES, UNLABELLED
from streetscan.errors import BadInput
from streetscan.io.arrays import load_npz, save_npz


def write_label_tile(
    path: str | Path, rows: np.ndarray, labels: np.ndarray, confidence: np.ndarray, alone: np.ndarray | None = None
) -> None:
    """Write one part: (v,) rows of the voxel grid, labels 0..8, confidences 0..1; the labels before smoothing if there was any."""
    columns = {"rows": rows.astype(np.int64), "labels": labels.astype(np.uint8), "confidence": confidence.astype(np.float32)}
    save_npz(path, **columns, **({} if alone is None else {"alone": alone.astype(np.uint8)}))


def read_labels_alone(paths: Sequence[str | Path], n_voxels: int) -> np.ndarray | None:
    """Labels (V,) uint8 of each voxel by itself, before smoothing, of files `read_label_tiles` took; None where labels are not smoothed."""
    labels = np.full(n_voxels, UNLABELLED, np.uint8)
    for path in paths:
        with np.load(path) as part:
            if "alone" not in part:
                return None
            labels[part["rows"]] = part["alone"]
    return labels


def read_label_tiles(paths: Iterable[str | Path], n_voxels: int) -> tuple[np.ndarray, np.ndarray]:
    """The label map of all parts together.

    Args:
        paths: the parts; together they label every voxel once.
        n_voxels: voxels of the grid the rows point into.
    Returns:
        labels (V,) uint8 in 0..8 and confidence (V,) float32.
    Raises:
        BadInput: a part that is no such file, a row outside the grid or in two parts, a label that is no class (255 is
            none), a confidence outside 0..1, or voxels that no part labels.
    """
    labels = np.full(n_voxels, UNLABELLED, np.uint8)
    confidence = np.full(n_voxels, np.nan, np.float32)
    for path in paths:
        rows, part_labels, part_confidence = load_npz(path, ("rows", "labels", "confidence"), "label_map")
        again = "delete it and run label_map again"
        if not len(rows) == len(part_labels) == len(part_confidence):
            raise BadInput(path, f"{len(rows)} rows, {len(part_labels)} labels and {len(part_confidence)} confidences", again)
        if len(rows) and (rows.min() < 0 or rows.max() >= n_voxels):
            raise BadInput(path, f"labels voxel {int(rows.max())} of a grid of {n_voxels}", again)
        if len(np.unique(rows)) < len(rows) or (labels[rows] != UNLABELLED).any():
            raise BadInput(path, "labels a voxel that is labelled already", again)
        if len(rows) and part_labels.max() >= N_CLASSES:
            raise BadInput(path, f"predicts {int(part_labels.max())}, which is no class", again)
        if not ((part_confidence >= 0) & (part_confidence <= 1)).all():
            raise BadInput(path, "holds a confidence outside 0..1", again)
        labels[rows], confidence[rows] = part_labels, part_confidence
    n_missing = int((labels == UNLABELLED).sum())
    if n_missing:
        raise BadInput("the label map", f"{n_missing} of {n_voxels} voxels are in no part", "give all parts of label_map")
    return labels, confidence
