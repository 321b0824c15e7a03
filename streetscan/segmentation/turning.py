"""Copies of a training map turned about the vertical, side by side in one voxel grid.

Source: Nagy (2020), 2.4.2: "clone and randomly rotate the training samples around their vertical axis several times"
(N-021). A wall along the grid's axes and one across them look different once they are voxels, and a street to be
labelled runs in a direction no training street has. Quarter turns of a sample cannot show that; turned points can.
"""

from collections.abc import Callable, Iterable, Iterator

import numpy as np

from streetscan.segmentation.samples import vote_labels
from streetscan.voxels import VoxelGrid, find_sorted, pack_keys, voxelize

# Between copies, so that no training volume sees two of them (K = 41 at 0.5 m is 20 m).
_GAP_M = 50.0


def turn_map(
    read_points: Callable[[], Iterable[np.ndarray]], grid: VoxelGrid, labels: np.ndarray, n_yaws: int
) -> tuple[VoxelGrid, np.ndarray]:
    """One grid with `n_yaws` turned copies of a map, the first of them the map itself.

    ASSUME: the yaws divide a quarter turn evenly; the quarter turns of training give the rest of the circle.

    Args:
        read_points: gives the map's (n, 3) float64 points, metres, frame `map`, in chunks; called 2 `n_yaws` times.
        grid: the map's voxels with heights.
        labels: (V,) uint8 voxel labels, 255 unlabelled.
        n_yaws: number of copies.
    Returns:
        the grid of all copies, which lie apart along x, and its (W,) uint8 labels. A turned voxel's ground is the mean of
        the ground below its points, its label the majority of the labels their own voxels have.
    """
    if n_yaws == 1:
        return grid, labels
    low, high = grid.centres[:, :2].min(axis=0), grid.centres[:, :2].max(axis=0)
    spacing_m = np.ceil(np.linalg.norm(high - low)) + _GAP_M
    packed, ground_m = pack_keys(grid.keys), grid.mean_z_m - grid.height_m

    def copies() -> Iterator[tuple[np.ndarray, np.ndarray]]:
        for i in range(n_yaws):
            for points in read_points():
                yield points, _turn(points, (low + high) / 2, np.radians(90.0 * i / n_yaws), i * spacing_m)

    turned = voxelize((moved for _, moved in copies()), grid.size_m, grid.origin)
    turned_packed, ground_sums = pack_keys(turned.keys), np.zeros(len(turned))

    def ballots() -> Iterator[tuple[np.ndarray, np.ndarray]]:
        for points, moved in copies():
            rows = find_sorted(packed, pack_keys(grid.keys_of(points)))
            np.add.at(ground_sums, find_sorted(turned_packed, pack_keys(turned.keys_of(moved))), ground_m[rows])
            yield moved, labels[rows]

    turned_labels = vote_labels(turned, ballots())
    turned.height_m = (turned.mean_z_m - ground_sums / turned.counts).astype(np.float32)
    return turned, turned_labels


def _turn(points: np.ndarray, centre: np.ndarray, yaw_rad: float, shift_m: float) -> np.ndarray:
    """Points turned counter-clockwise about the vertical through `centre` and moved along x; not touched for yaw 0."""
    if yaw_rad == 0:
        return points
    cos, sin = np.cos(yaw_rad), np.sin(yaw_rad)
    moved = points.copy()
    moved[:, :2] = (points[:, :2] - centre) @ np.array([[cos, sin], [-sin, cos]]) + centre
    moved[:, 0] += shift_m
    return moved
