"""Training volumes: the cubes of voxels a network looks at, by class and by density.

Source: Nagy (2020), Figs. 2.5 and 2.6 (N-018).
"""

import numpy as np
from matplotlib.figure import Figure

from streetscan.benchmarks.figures import close_ups
from streetscan.benchmarks.rendering import View, render_cloud
from streetscan.classes import CAR, CLASSES, COLUMN, N_CLASSES, PEDESTRIAN, PHANTOM, colours
from streetscan.voxels import VoxelGrid

_SHOWN = (PHANTOM, CAR, COLUMN, PEDESTRIAN)
_CENTRE_COLOUR = (255, 0, 0)
# Voxels of a class that are looked at for a telling one.
_TRIED = 200
# A class with this share of a cube's voxels counts as shown in it.
_SHOWN_SHARE = 0.05
# Nothing this near to the line of sight, in voxels, hides the centre.
_FREE_VOXELS = 2.0
_WIDTH_PX, _HEIGHT_PX = 460, 380


def choose_volumes(grid: VoxelGrid, labels: np.ndarray, k: int, seed: int = 0) -> list[int]:
    """Rows of centre voxels, one of each shown class that occurs: the cube with the most classes in it, then the most voxels.

    Args:
        grid: the map's voxels.
        labels: (V,) uint8.
        k: voxels an axis of the cube.
        seed: of the draw of those that are tried.
    """
    rng, chosen = np.random.default_rng(seed), []
    for label in _SHOWN:
        of_class = np.flatnonzero(labels == label)
        if len(of_class) == 0:
            continue
        tried = rng.choice(of_class, min(_TRIED, len(of_class)), replace=False)

        def tell(row: int) -> tuple[int, int]:
            held = np.bincount(labels[_cube(grid, row, k)], minlength=N_CLASSES)[:N_CLASSES]
            return int((held >= _SHOWN_SHARE * held.sum()).sum()), int(held.sum())

        chosen.append(int(max(tried, key=tell)))
    return chosen


def draw_volumes(grid: VoxelGrid, labels: np.ndarray, k: int) -> Figure:
    """Cubes coloured by class, their centre voxel red and free of what hides it, and by density from green (few points) to red (many)."""
    rows, position = [], k * np.array([1.15, -1.35, 0.95])
    view = View(tuple(position), (0.0, 0.0, 0.0), _WIDTH_PX, _HEIGHT_PX, field_of_view_deg=52.0)
    for row in choose_volumes(grid, labels, k):
        cube = _cube(grid, row, k)
        keys = (grid.keys[cube] - grid.keys[row]).astype(np.float64)
        is_centre = (keys == 0).all(axis=1)
        towards_eye = keys @ position / np.linalg.norm(position)
        beside = np.linalg.norm(keys - towards_eye[:, None] * position / np.linalg.norm(position), axis=1)
        shown = is_centre | (towards_eye < 0) | (beside > _FREE_VOXELS)
        by_class = np.where(is_centre[:, None], np.uint8(_CENTRE_COLOUR), colours(labels[cube]))
        pictures = [
            render_cloud(keys[shown], by_class[shown], view, 1.0),
            render_cloud(keys, density_colours(grid.counts[cube]), view, 1.0),
        ]
        rows.append((f"{CLASSES[int(labels[row])].title}: {len(cube)} of {k}³ voxels hold a point", pictures))
    return close_ups(rows, ["by class, the voxel in question red", "by density, sparse green to dense red"])


def density_colours(counts: np.ndarray) -> np.ndarray:
    """(N, 3) uint8, green for one point to red for the most, by the logarithm of the number."""
    level = np.log(counts) / max(float(np.log(counts.max())), 1e-9)
    return (255 * np.stack([np.clip(2 * level, 0, 1), np.clip(2 - 2 * level, 0, 1) * 0.8, np.zeros(len(counts))], axis=1)).astype(np.uint8)


def _cube(grid: VoxelGrid, row: int, k: int) -> np.ndarray:
    """Rows of the occupied voxels of the cube around one."""
    key, radius = grid.keys[row], k // 2
    start, stop = np.searchsorted(grid.keys[:, 0], [key[0] - radius, key[0] + radius + 1])
    return start + np.flatnonzero((np.abs(grid.keys[start:stop] - key) <= radius).all(axis=1))
