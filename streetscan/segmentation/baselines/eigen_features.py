"""Local shape of a voxel's surroundings in numbers: eigenvalues of its nearest occupied voxels at several scales.

Source: Weinmann, Jutzi, Hinz, Mallet (2015), Semantic point cloud interpretation based on optimal neighborhoods, relevant
features and efficient classifiers, Section 3.2 (the features); Hackel, Wegner, Schindler (2016), the thesis' [50] (several scales).
ASSUME: three scales of 10, 30 and 80 voxels: a spot, a limb or sign, a small object at 0.1 m.
"""

import numpy as np
from numba import njit
from scipy.spatial import cKDTree

from streetscan.errors import BadInput
from streetscan.voxels import VoxelGrid

SCALE_FEATURES = (
    "linearity",
    "planarity",
    "scattering",
    "omnivariance",
    "eigenentropy",
    "curvature",
    "verticality",
    "steepness",
    "radius_m",
    "height_range_m",
    "height_above_lowest_m",
)
_OWN_FEATURES = ("height_above_ground_m", "log_count")
_BATCH = 20_000


def feature_names(neighbours: tuple[int, ...]) -> list[str]:
    """Names of the columns `eigen_features` returns."""
    return [*_OWN_FEATURES, *(f"{name}_{k}" for k in neighbours for name in SCALE_FEATURES)]


class NeighbourTree:
    """The occupied voxels of a map, ready to be asked for neighbours. A voxel stands at its centre in plan, at its points' mean height."""

    def __init__(self, grid: VoxelGrid):
        self.grid = grid
        self.points = np.column_stack([grid.centres[:, :2], grid.mean_z_m]) - grid.origin
        self._tree = cKDTree(self.points)

    def nearest(self, rows: np.ndarray, k: int, n_threads: int) -> np.ndarray:
        """(n, k) int64 rows of the k nearest voxels, the voxel itself first; the farthest repeats where the map has fewer."""
        k_found = min(k, len(self.points))
        found = self._tree.query(self.points[rows], np.arange(1, k_found + 1), workers=n_threads)[1]
        return np.pad(found, ((0, 0), (0, k - k_found)), mode="edge")


def eigen_features(tree: NeighbourTree, rows: np.ndarray, neighbours: tuple[int, ...], n_threads: int = 1) -> np.ndarray:
    """Features of voxels.

    Args:
        tree: of the whole map, so that the cut into tiles changes nothing.
        rows: (n,) rows of the grid.
        neighbours: increasing numbers of nearest voxels, the voxel itself counted.
        n_threads: of the search; the result does not depend on it.
    Returns:
        (n, F) float32, columns as `feature_names` says: height above ground and ln(1 + points) of the voxel itself; per scale, with
        eigenvalues l1 >= l2 >= l3 of the neighbours' covariance (divided by their sum where it says so), (l1 - l2) / l1,
        (l2 - l3) / l1, l3 / l1, (l1 l2 l3)^(1/3), -sum(l ln l), l3 / sum, how far the normal leans from the vertical (1 - |n_z|), how
        steep the main axis is (|e_z|), distance to the farthest, their range of heights, the voxel's height above the lowest.
    Raises:
        BadInput: a height above ground is unknown, or the numbers of neighbours do not increase from 3.
    """
    if list(neighbours) != sorted(set(neighbours)) or not neighbours or neighbours[0] < 3:
        raise BadInput("train_baseline.neighbours", f"{list(neighbours)}", "give increasing numbers of at least 3, such as 10, 30, 80")
    grid = tree.grid
    if not np.isfinite(grid.height_m[rows]).all():
        raise BadInput("the voxels", "some have no height above ground", "run voxelize_map again")
    features = np.empty((len(rows), len(feature_names(neighbours))), np.float32)
    features[:, 0], features[:, 1] = grid.height_m[rows], np.log1p(grid.counts[rows])
    scales = np.array(neighbours, np.int64)
    for first in range(0, len(rows), _BATCH):
        batch = rows[first : first + _BATCH]
        found = tree.nearest(batch, neighbours[-1], n_threads)
        covariances, spans = _moments(tree.points, batch, found, scales)
        features[first : first + _BATCH, len(_OWN_FEATURES) :] = _shapes(covariances, spans).reshape(len(batch), -1)
    return features


@njit(cache=True)
def _moments(points, rows, found, scales):
    """Covariances (n, S, 3, 3) of the nearest voxels and (n, S, 3) their radius, height range and the voxel's height in it."""
    covariances = np.empty((len(rows), len(scales), 3, 3))
    spans = np.empty((len(rows), len(scales), 3))
    for i in range(len(rows)):
        centre = points[rows[i]]
        total, products = np.zeros(3), np.zeros((3, 3))
        low, high, scale = 0.0, 0.0, 0
        for j in range(found.shape[1]):
            offset = points[found[i, j]] - centre
            for a in range(3):
                total[a] += offset[a]
                for b in range(3):
                    products[a, b] += offset[a] * offset[b]
            low, high = min(low, offset[2]), max(high, offset[2])
            if j + 1 == scales[scale]:
                n = j + 1
                for a in range(3):
                    for b in range(3):
                        covariances[i, scale, a, b] = products[a, b] / n - total[a] / n * total[b] / n
                spans[i, scale, 0] = np.sqrt((offset**2).sum())
                spans[i, scale, 1], spans[i, scale, 2] = high - low, -low
                scale += 1
    return covariances, spans


def _shapes(covariances: np.ndarray, spans: np.ndarray) -> np.ndarray:
    """(n, S, 11) float64: the features of one scale each, in the order of SCALE_FEATURES."""
    values, vectors = np.linalg.eigh(covariances)
    l3, l2, l1 = np.moveaxis(np.maximum(values, 0), -1, 0)
    # Neighbours in one place have no shape.
    total = np.maximum(l1 + l2 + l3, 1e-12)
    largest = np.maximum(l1, 1e-12)
    shares = np.maximum(np.stack([l1, l2, l3]) / total, 1e-12)
    return np.stack(
        [
            (l1 - l2) / largest,
            (l2 - l3) / largest,
            l3 / largest,
            np.cbrt(shares.prod(axis=0)),
            -(shares * np.log(shares)).sum(axis=0),
            l3 / total,
            1 - np.abs(vectors[..., 2, 0]),
            np.abs(vectors[..., 2, 2]),
            *np.moveaxis(spans, -1, 0),
        ],
        axis=-1,
    )
