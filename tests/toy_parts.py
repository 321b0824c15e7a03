"""A part of a map to train on: a floor, a wall and loose clutter."""

import numpy as np

from streetscan.segmentation.c2cnn import Settings
from streetscan.segmentation.training import Part, Samples
from streetscan.voxels import VoxelGrid

SETTINGS = Settings(k=9, n_hidden=32)
PATCH_VOXELS = 15


def make_part(seed: int, settings: Settings = SETTINGS, n_per_class: int = 150) -> Part:
    """Floor, wall and clutter: labels 0, 1 and 6."""
    rng = np.random.default_rng(seed)
    floor = np.c_[rng.integers(0, 80, (1500, 2)), np.zeros(1500, int)]
    wall = np.c_[rng.integers(0, 80, 1500), np.full(1500, 40), rng.integers(1, 30, 1500)]
    clutter = rng.integers([0, 50, 5], [80, 80, 25], (1500, 3))
    keys, first = np.unique(np.concatenate([floor, wall, clutter]) - 20, axis=0, return_index=True)
    labels = np.repeat([0, 1, 6], 1500)[first].astype(np.uint8)
    counts = rng.integers(1, 20, len(keys)).astype(np.uint32)
    height = (0.1 * (keys[:, 2] + 20)).astype(np.float32)
    grid = VoxelGrid(np.zeros(3), 0.1, keys.astype(np.int32), counts, height.astype(np.float64), height)
    rows = np.concatenate([rng.choice(np.flatnonzero(labels == c), n_per_class, replace=False) for c in (0, 1, 6)])
    return Part(grid, Samples(grid.keys[rows], labels[rows]), settings, PATCH_VOXELS)
