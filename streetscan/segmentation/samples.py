"""Voxel labels from point labels, and the voxels a network is trained on.

Source: Nagy (2020), 2.4.1 (majority vote, N-014), 2.5.1 (draw per class, N-028, N-029).
"""

import logging
from collections.abc import Iterable

import numpy as np

from streetscan.classes import LABELS, N_CLASSES, NAMES, UNLABELLED
from streetscan.errors import BadInput
from streetscan.voxels import VoxelGrid, find_sorted, pack_keys

logger = logging.getLogger(__name__)


def vote_labels(grid: VoxelGrid, chunks: Iterable[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    """Each voxel's label by the majority of its points (N-014).

    Memory grows with the voxels, not with the points. ASSUME: a tie goes to the lowest label (the thesis does not
    say); unlabelled points have no vote.

    Args:
        grid: the voxels of the map.
        chunks: pairs of (n, 3) float64 points, metres, frame `map`, and (n,) uint8 labels, 255 unlabelled; together the map.
    Returns:
        (V,) uint8 labels, 255 for a voxel without a labelled point.
    Raises:
        BadInput: a point lies in no voxel of the grid, or a label is no class.
    """
    votes = np.zeros(len(grid) * N_CLASSES, np.uint32)
    packed = pack_keys(grid.keys)
    for points, labels in chunks:
        rows = find_sorted(packed, pack_keys(grid.keys_of(points)))
        if (rows < 0).any():
            where = points[int(np.argmax(rows < 0))].round(3).tolist()
            raise BadInput("the voxel grid", f"has no voxel at the map's point {where}", "run voxelize_map again on this map")
        is_labelled = labels != UNLABELLED
        if (labels[is_labelled] >= N_CLASSES).any():
            raise BadInput("the map's labels", f"hold {int(labels[is_labelled].max())}, which is no class", "give labels 0..8 or 255")
        ballots, n = np.unique(rows[is_labelled] * N_CLASSES + labels[is_labelled], return_counts=True)
        votes[ballots] += n.astype(np.uint32)
    votes = votes.reshape(-1, N_CLASSES)
    # argmax takes the first of equal counts.
    return np.where(votes.any(axis=1), votes.argmax(axis=1), UNLABELLED).astype(np.uint8)


def draw_samples(
    labels: np.ndarray, n_per_class: int, rng: np.random.Generator, expected: Iterable[str] = ()
) -> tuple[np.ndarray, np.ndarray]:
    """Voxels for training or validation, the same number of every class where there are enough (N-028, N-029).

    Args:
        labels: (V,) uint8 voxel labels, 255 unlabelled.
        n_per_class: voxels of each class; a class with fewer gives all it has and the log says so.
        rng: the generator.
        expected: names of the classes that must occur.
    Returns:
        rows (S,) int64 into `labels` and the samples' labels (S,) uint8, grouped by class.
    Raises:
        BadInput: a setting out of range, an expected class without any voxel, or no labelled voxel at all.
    """
    if n_per_class < 1:
        raise BadInput("extract_samples.n_per_class", f"{n_per_class} is not above 0", "give the number of voxels per class")
    available = np.bincount(labels, minlength=256)[:N_CLASSES]
    for name in expected:
        if name not in NAMES:
            raise BadInput("extract_samples", f"expects '{name}', which is no class", f"use {', '.join(NAMES)}")
        if available[LABELS[name]] == 0:
            raise BadInput(f"class {name}", "has no voxel in this part", "give a part that shows it or take it out of the class map")
    if not available.any():
        raise BadInput("this part", "holds no labelled voxel", "give a part with labels")
    rows = []
    for label, n in enumerate(available):
        if n < n_per_class:
            logger.info("class %s: %d voxels of %d asked for", NAMES[label], n, n_per_class)
        rows.append(rng.choice(np.flatnonzero(labels == label), min(n, n_per_class), replace=False))
    rows = np.concatenate(rows)
    logger.info("%d samples", len(rows))
    return rows, labels[rows]
