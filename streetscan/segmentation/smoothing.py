"""Class shares evened out over what hangs together: a voxel looks 1.2 m around itself, a bus is twelve metres long.

Voxels are joined in cells, ground apart from what stands on it. Log shares then spread from cell to touching cell, so that a place
holds the geometric mean of what its surroundings say along the surface, and never across a gap or between ground and object.

Not in the thesis, whose label map is each voxel's own (2.4.2); its objects are grown from it afterwards (N-025).
"""

import itertools
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy import sparse

from streetscan.classes import GROUND
from streetscan.errors import BadInput
from streetscan.voxels import find_sorted, pack_keys

# Least share that counts: a network's certainty in one voxel must not outvote all others.
_LEAST_SHARE = 1e-4
# Voxels smoothed together, beside those that reach them: bounds the memory (about 200 B a voxel).
_MAX_TOGETHER = 1_000_000


@dataclass(frozen=True)
class Smoothing:
    """How far shares spread.

    Attributes:
        cell_voxels: edge of a cell, voxels.
        n_rounds: rounds of spreading from cell to cell; a place then looks about 0.8 sqrt(n_rounds) cells around itself. 0 changes nothing.
        sharpness: shares are raised to this power afterwards: a mean over many voxels is surer than each of them.
    """

    cell_voxels: int = 2
    n_rounds: int = 0
    sharpness: float = 1.0

    def __post_init__(self):
        if self.cell_voxels < 1 or self.n_rounds < 0 or not self.sharpness > 0:
            found = f"cells of {self.cell_voxels} voxels, {self.n_rounds} rounds, sharpness {self.sharpness:g}"
            raise BadInput("label_map.smoothing", found, "give cells of at least 1 voxel, 0 rounds or more and a sharpness above 0")

    @property
    def reach_voxels(self) -> int:
        """A voxel farther away along an axis has no part in a voxel's smoothed shares."""
        return self.cell_voxels * (self.n_rounds + 1) if self.n_rounds else 0


NO_SMOOTHING = Smoothing()


def smooth_in_slices(keys: np.ndarray, shares: np.ndarray, smoothing: Smoothing) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Class shares after spreading over the surface, slice by slice of the map.

    A cell's log shares are the mean of its voxels'; a round replaces them by the mean over the cell and the 26 around it, by their numbers
    of voxels. Ground voxels (more than half of the shares) and others never mix.

    Args:
        keys: (V, 3) int32 occupied voxels, each once.
        shares: (V, 9) float32, rows sum to 1.
        smoothing: see Smoothing.
    Yields:
        rows (v,) int64 of a slice's voxels, each voxel in one slice, and their shares (v, 9) float32, which sum to 1 and are alike in all
        voxels of a cell.
    """
    if smoothing.n_rounds == 0 or len(keys) == 0:
        yield np.arange(len(keys)), shares
        return
    x = keys[:, 0]
    # Slices of about as many voxels each; the last one's end lies beyond all.
    starts = np.unique(np.quantile(x, np.arange(-(-len(keys) // _MAX_TOGETHER)) * _MAX_TOGETHER / len(keys), method="lower"))
    for low, high in itertools.pairwise([*starts.tolist(), int(x.max()) + 1]):
        near = np.flatnonzero((x >= low - smoothing.reach_voxels) & (x < high + smoothing.reach_voxels))
        own = (x[near] >= low) & (x[near] < high)
        yield near[own], _smooth_together(keys[near], shares[near], smoothing)[own]


def _smooth_together(keys: np.ndarray, shares: np.ndarray, smoothing: Smoothing) -> np.ndarray:
    cells, cell_of, n = np.unique(_name_cells(keys, shares, smoothing.cell_voxels), return_inverse=True, return_counts=True)
    members = sparse.csr_matrix((np.ones(len(keys), np.float32), (cell_of, np.arange(len(keys)))), shape=(len(cells), len(keys)))
    logs = (members @ np.log(shares + _LEAST_SHARE)) / n[:, None].astype(np.float32)
    spread = _neighbours(cells, n)
    for _ in range(smoothing.n_rounds):
        logs = spread @ logs
    smooth = np.exp(smoothing.sharpness * (logs - logs.max(axis=1, keepdims=True)))
    return (smooth / smooth.sum(axis=1, keepdims=True))[cell_of]


def _name_cells(keys: np.ndarray, shares: np.ndarray, cell_voxels: int) -> np.ndarray:
    """(V,) int64: which cell a voxel is in; in each place ground and the rest are two, of even and odd heights."""
    cells = np.floor_divide(keys, cell_voxels)
    cells[:, 2] = 2 * cells[:, 2] + (shares[:, GROUND] > 0.5)
    return pack_keys(cells)


def _neighbours(cells: np.ndarray, n: np.ndarray) -> sparse.csr_matrix:
    """(C, C) float32 rows of weights that sum to 1: each cell itself and those that touch it, by their voxels."""
    steps = np.array([-1, 0, 1])
    offsets = np.stack(np.meshgrid(steps, steps, 2 * steps, indexing="ij"), axis=-1).reshape(-1, 3)
    rows, columns = [], []
    for step in pack_keys(offsets) - pack_keys(np.zeros(3)):
        found = find_sorted(cells, cells + step)
        rows.append(np.flatnonzero(found >= 0))
        columns.append(found[found >= 0])
    rows, columns = np.concatenate(rows), np.concatenate(columns)
    weights = sparse.csr_matrix((n[columns].astype(np.float32), (rows, columns)), shape=(len(cells), len(cells)))
    return sparse.diags(1 / np.asarray(weights.sum(axis=1)).ravel()).astype(np.float32) @ weights
