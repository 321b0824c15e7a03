"""What further looks at a voxel and smoothed labels gain, and what they cost.

Source: ours; the thesis looks at every voxel once and keeps its label (2.4.2).
"""

import logging
import time

import numpy as np
import pandas as pd

from streetscan.segmentation.c2cnn import C2CNN
from streetscan.segmentation.inference import label_voxels
from streetscan.segmentation.metrics import COLUMNS, evaluate_labels
from streetscan.segmentation.smoothing import NO_SMOOTHING, Smoothing
from streetscan.voxels import VoxelGrid

logger = logging.getLogger(__name__)

N_TURNS = (1, 4)


def score_refinements(
    network: C2CNN,
    grid: VoxelGrid,
    truth: np.ndarray,
    smoothing: Smoothing,
    tile_m: float,
    n_per_class: int,
    seed: int,
    n_threads: int = 1,
) -> pd.DataFrame:
    """Scores of a map labelled in one and in four quarter turns, each voxel alone and smoothed.

    Args:
        network: a calibrated network.
        grid: the map's voxels with heights.
        truth: (V,) uint8 true labels, 255 where unknown.
        smoothing, tile_m, n_threads: of `inference.label_voxels`.
        n_per_class, seed: of the class-even set, see `metrics.evaluate_labels`; the same voxels each time.
    Returns:
        `n_turns`, `is_smoothed`, and the columns of `metrics.evaluate_labels`; beside its metrics the `time` of labelling (`part`).
    """
    tables = []
    for n_turns in N_TURNS:
        for used in (NO_SMOOTHING, smoothing):
            started = time.perf_counter()
            found = label_voxels(network, grid, tile_m, n_threads=n_threads, n_turns=n_turns, smoothing=used)
            cost = ("natural", "part", "time", time.perf_counter() - started, "s", len(found.rows))
            rng = np.random.default_rng(seed)
            scores, _ = evaluate_labels(truth[found.rows], found.labels, found.confidence, n_per_class=n_per_class, rng=rng)
            scores.loc[len(scores)] = cost
            tables.append(scores.assign(n_turns=n_turns, is_smoothed=used is smoothing))
            logger.info("%d turns, %s: %.0f s", n_turns, "smoothed" if used is smoothing else "each voxel alone", cost[3])
    return pd.concat(tables, ignore_index=True)[["n_turns", "is_smoothed", *COLUMNS]]
