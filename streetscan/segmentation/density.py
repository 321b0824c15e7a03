"""Point density: counts relative to what surrounds them, and maps thinned as another scanner or a faster vehicle would have seen them.

Source: ours. The thesis' first channel is the number of points itself (N-015), which doubles when the vehicle halves its speed.
"""

import numpy as np

from streetscan.voxels import VoxelGrid

# Rows of columns whose sums are held at once: bounds the memory on large maps.
_SLAB = 512


def mean_counts_around(keys: np.ndarray, counts: np.ndarray, reach: int, share: float = 1.0) -> np.ndarray:
    """Mean number of points of the occupied voxels around each voxel, in a square of columns of all heights.

    Args:
        keys: (V, 3) integer voxel keys, in any order.
        counts: (V,) points in each, at least 1.
        reach: voxels from the middle of the square to its side, the middle left out.
        share: probability with which each point is kept; the mean is that of the expected points and voxels that are left.
    Returns:
        (V,) float32.
    """
    around = np.empty(len(keys), np.float32)
    if len(keys) == 0:
        return around
    points, voxels = share * counts, 1 - (1 - share) ** counts.astype(np.float64)
    x, y = keys[:, 0].astype(np.int64), keys[:, 1].astype(np.int64)
    y = y - y.min() + reach
    width = int(y.max()) + reach + 2
    for start in range(int(x.min()), int(x.max()) + 1, _SLAB):
        seen = np.flatnonzero((x >= start - reach) & (x < start + _SLAB + reach))
        # Row and column 0 stay empty: sums up to and including a column, so that differences give the sum of a square.
        row, column = x[seen] - start + reach + 1, y[seen] + 1
        inner = (row > reach) & (row <= reach + _SLAB)
        low_r, high_r = row[inner] - reach - 1, row[inner] + reach
        low_c, high_c = column[inner] - reach - 1, column[inner] + reach
        shape = _SLAB + 2 * reach + 2, width
        sums = []
        for values in (points[seen], voxels[seen]):
            upto = np.bincount(row * width + column, values, minlength=shape[0] * width).reshape(shape).cumsum(axis=0).cumsum(axis=1)
            sums.append(upto[high_r, high_c] - upto[low_r, high_c] - upto[high_r, low_c] + upto[low_r, low_c])
        around[seen[inner]] = sums[0] / sums[1]
    return around


def thin_grid(grid: VoxelGrid, share: float, rng: np.random.Generator) -> tuple[VoxelGrid, np.ndarray]:
    """The voxels of a map of whose points each is kept with a probability.

    ASSUME: the heights of the voxels and of the ground, and the seconds between a voxel's points, stay those of all points, which a
    share of them estimates.

    Args:
        grid: the map's voxels.
        share: probability of a point to be kept, above 0 to 1.
        rng: the generator.
    Returns:
        the grid, and the rows of its voxels in the map's.
    """
    counts = rng.binomial(grid.counts, share).astype(np.uint32)
    rows = np.flatnonzero(counts)
    thinned = grid.select(rows)
    thinned.counts = counts[rows]
    return thinned, rows
