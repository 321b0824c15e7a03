"""How well networks label maps of ever fewer points: another scanner, or the same one on a faster vehicle.

Source: ours. The thesis says of static scans alone that its method does not suit them, for their density varies (2.5.3, N-040).
"""

import logging
from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd

from streetscan.classes import N_CLASSES
from streetscan.segmentation.c2cnn import C2CNN
from streetscan.segmentation.density import thin_grid
from streetscan.segmentation.metrics import count_confusion, draw_evenly, score_confusion
from streetscan.segmentation.sparse import open_workers
from streetscan.segmentation.training import Part, Samples, sample_logits
from streetscan.voxels import VoxelGrid

logger = logging.getLogger(__name__)

COLUMNS = ("share", "model", "class", "metric", "value", "unit", "n")
_PATCH_VOXELS = 25


def score_thinned(
    networks: Mapping[str, C2CNN],
    grid: VoxelGrid,
    labels: np.ndarray,
    shares: Sequence[float],
    n_per_class: int,
    seed: int,
    n_threads: int = 1,
) -> pd.DataFrame:
    """Rates of networks on class-even voxels of a map thinned to shares of its points.

    Only voxels that keep a point are asked for. All networks are asked for the same ones.

    Args:
        networks: by name.
        grid: the map's voxels with heights.
        labels: (V,) uint8 true labels, 255 where unknown.
        shares: of the points, above 0 to 1.
        n_per_class: the most voxels of a class.
        seed: of the thinning and the draw.
        n_threads: threads; the result does not depend on it.
    Returns:
        the columns of `COLUMNS`; classes and metrics as in `metrics.score_confusion`.
    """
    rows = []
    for share in shares:
        rng = np.random.default_rng(seed)
        thinned, kept = thin_grid(grid, share, rng)
        truth = labels[kept]
        picked = draw_evenly(truth, n_per_class, rng)
        n_voxels = np.bincount(truth, minlength=256)[:N_CLASSES]
        for name, network in networks.items():
            part = Part(thinned, Samples(thinned.keys[picked], truth[picked]), network.settings, _PATCH_VOXELS)
            with open_workers(n_threads) as workers:
                logits, classes = (tensor.numpy() for tensor in sample_logits(network, part, workers))
            confusion = count_confusion(classes, logits.argmax(axis=1))
            rows += [(share, name, *row) for row in score_confusion(confusion, n_voxels, {})]
        logger.info("%g %% of the points: %d of %d voxels, %d asked for", 100 * share, len(thinned), len(grid), len(picked))
    return pd.DataFrame(rows, columns=COLUMNS)
