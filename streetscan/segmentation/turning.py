"""Copies of a training map turned about the vertical, side by side in one voxel grid.

Source: Nagy (2020), 2.4.2: "clone and randomly rotate the training samples around their vertical axis several times"
(N-021). A wall along the grid's axes and one across them look different once they are voxels, and a street to be
labelled runs in a direction no training street has. Quarter turns of a sample cannot show that; turned points can.
"""

from collections.abc import Callable, Iterable, Iterator

import numpy as np
from numba import njit

from streetscan.classes import UNLABELLED
from streetscan.segmentation.samples import vote_labels
from streetscan.voxels import VoxelGrid, find_sorted, pack_keys, voxelize

# Between copies, so that no training volume sees two of them (K = 41 at 0.5 m is 20 m).
_GAP_M = 50.0


def turn_map(
    read_points: Callable[[], Iterable[np.ndarray]],
    grid: VoxelGrid,
    labels: np.ndarray,
    n_yaws: int,
    tile_m: float | None = None,
    margin_m: float = 0.0,
) -> tuple[VoxelGrid, np.ndarray]:
    """One grid with `n_yaws` turned copies of a map, the first of them not turned.

    ASSUME: the yaws divide a quarter turn evenly; the quarter turns of training give the rest of the circle.

    Args:
        read_points: gives the map's (n, 3) float64 points, metres, frame `map`, in chunks; called twice.
        grid: the map's voxels with heights.
        labels: (V,) uint8 voxel labels, 255 unlabelled.
        n_yaws: number of copies.
        tile_m: None copies the whole map each time. Otherwise a square tile of this edge, m, goes into one copy only, its neighbours into
            others: a street that shows everything many times is seen from all sides without growing.
        margin_m: what lies this far around a tile is copied with it, so that its voxels see what surrounds them, but has no label, m.
    Returns:
        the grid of all copies, which lie apart along x, and its (W,) uint8 labels. A turned voxel's ground is the mean of
        the ground below its points, its label the majority of the labels their own voxels have.
    """
    if n_yaws == 1:
        return grid, labels
    low, high = grid.centres[:, :2].min(axis=0), grid.centres[:, :2].max(axis=0)
    spacing_m = np.ceil(np.linalg.norm(high - low)) + _GAP_M
    packed, ground_m = pack_keys(grid.keys), grid.mean_z_m - grid.height_m

    def copies() -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        """Points of each copy as they are and turned, and whether they are more than a tile's surroundings."""
        for points in read_points():
            if tile_m is None:
                is_copied = is_own = np.ones((n_yaws, len(points)), bool)
            else:
                is_copied, is_own = _share_out(points[:, :2], n_yaws, tile_m, margin_m)
            for i in range(n_yaws):
                own = points[is_copied[i]]
                yield own, _turn(own, (low + high) / 2, np.radians(90.0 * i / n_yaws), i * spacing_m), is_own[i][is_copied[i]]

    turned = voxelize((moved for _, moved, _ in copies()), grid.size_m, grid.origin)
    turned_packed, ground_sums = pack_keys(turned.keys), np.zeros(len(turned))

    def ballots() -> Iterator[tuple[np.ndarray, np.ndarray]]:
        for points, moved, is_own in copies():
            rows = find_sorted(packed, pack_keys(grid.keys_of(points)))
            np.add.at(ground_sums, find_sorted(turned_packed, pack_keys(turned.keys_of(moved))), ground_m[rows])
            yield moved, np.where(is_own, labels[rows], UNLABELLED)

    turned_labels = vote_labels(turned, ballots())
    turned.height_m = (turned.mean_z_m - ground_sums / turned.counts).astype(np.float32)
    return turned, turned_labels


@njit(cache=True)
def _share_out(xy: np.ndarray, n_yaws: int, tile_m: float, margin_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Twice (n_yaws, n) bool: the copies each of (n, 2) points goes into, and the one its own tile goes into."""
    is_copied, is_own = np.zeros((n_yaws, len(xy)), np.bool_), np.zeros((n_yaws, len(xy)), np.bool_)
    for i in range(len(xy)):
        for dx in range(-1, 2):
            for dy in range(-1, 2):
                column = int(np.floor((xy[i, 0] + dx * margin_m) / tile_m))
                row = int(np.floor((xy[i, 1] + dy * margin_m) / tile_m))
                # Neither the tile beside nor the one before it goes into the same copy.
                copy = (column + 2 * row) % n_yaws
                is_copied[copy, i] = True
                if dx == 0 and dy == 0:
                    is_own[copy, i] = True
    return is_copied, is_own


def _turn(points: np.ndarray, centre: np.ndarray, yaw_rad: float, shift_m: float) -> np.ndarray:
    """Points turned counter-clockwise about the vertical through `centre` and moved along x; not touched for yaw 0."""
    if yaw_rad == 0:
        return points
    cos, sin = np.cos(yaw_rad), np.sin(yaw_rad)
    moved = points.copy()
    moved[:, :2] = (points[:, :2] - centre) @ np.array([[cos, sin], [-sin, cos]]) + centre
    moved[:, 0] += shift_m
    return moved
