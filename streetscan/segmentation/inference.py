"""A map's voxels and points with the labels a network gives them.

The map is cut into square tiles; a tile's voxels are labelled with the voxels within half a cube around it. Tiles are
the same however many groups they are dealt to, so groups change nothing but who works.

Source: Nagy (2020), 2.4.2 (sliding volume, N-024), 2.5.5 (N-047, N-049).
"""

import logging
import re
from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np
import torch

from streetscan.classes import N_CLASSES
from streetscan.clouds import PointCloud
from streetscan.errors import BadInput
from streetscan.segmentation.c2cnn import C2CNN, grid_channels, turn_keys
from streetscan.segmentation.smoothing import NO_SMOOTHING, Smoothing, smooth_in_slices
from streetscan.segmentation.sparse import open_workers, sparse_logits
from streetscan.voxels import VoxelGrid

logger = logging.getLogger(__name__)

# Voxels evaluated together: bounds the memory (about 20 KB a voxel where voxels lie loosely, as in a tree).
_MAX_WANTED = 32_768
# Largest extent of voxels evaluated together, in voxels: a stray point far above the street would make their space a tower.
_MAX_EXTENT = 512


class VoxelLabels(NamedTuple):
    """Labels of some voxels of a grid.

    Attributes:
        rows: (v,) int64 into the grid, increasing.
        labels: (v,) uint8 in 0..8.
        confidence: (v,) float32, the share of the label.
        alone: (v,) uint8 what each voxel is by its own surroundings alone, where labels are smoothed; None where they are not.
    """

    rows: np.ndarray
    labels: np.ndarray
    confidence: np.ndarray
    alone: np.ndarray | None = None


def parse_tiles(tiles: str) -> tuple[int, int]:
    """Group number and number of groups of a name such as `0of9`. BadInput when it is none."""
    match = re.fullmatch(r"(\d+)of(\d+)", tiles)
    if not match or not int(match[1]) < int(match[2]):
        raise BadInput("tiles", f"'{tiles}' is no group of tiles", "give k of n from 0, such as 0of9")
    return int(match[1]), int(match[2])


def assign_tiles(grid: VoxelGrid, tile_m: float, n_groups: int) -> tuple[np.ndarray, np.ndarray]:
    """Deal the tiles of a grid to groups of about as many voxels, each a run of neighbouring tiles.

    Args:
        grid: occupied voxels.
        tile_m: edge of a tile, horizontally; rounded to whole voxels.
        n_groups: number of groups.
    Returns:
        (V,) int64 tile of each voxel, numbered from 0 by position, and (T,) int64 group of each tile.
    Raises:
        BadInput: a tile is smaller than a voxel.
    """
    side = round(tile_m / grid.size_m)
    if side < 1:
        raise BadInput("label_map.tile_m", f"{tile_m} is less than a voxel of {grid.size_m} m", "give metres, such as 12.8")
    # Tiles count from the map's own corner; without it a map's tiles would depend on its origin.
    tile_xy = (grid.keys[:, :2] - grid.keys[:, :2].min(axis=0)) // side
    _, tile = np.unique(tile_xy[:, 0].astype(np.int64) << 32 | tile_xy[:, 1], return_inverse=True)
    n_voxels = np.bincount(tile)
    middle = np.cumsum(n_voxels) - n_voxels / 2
    return tile, (middle * n_groups // len(grid)).astype(np.int64)


def label_voxels(
    network: C2CNN, grid: VoxelGrid, tile_m: float, group: int = 0, n_groups: int = 1, n_threads: int = 1, n_turns: int = 1,
    smoothing: Smoothing = NO_SMOOTHING,
) -> VoxelLabels:  # fmt: skip
    """Labels of the occupied voxels of one group of tiles.

    Args:
        network: trained network, on the device that does the work.
        grid: the whole map's voxels, with heights.
        tile_m: edge of a tile.
        group, n_groups: which group of how many.
        n_threads: threads, a tile each; the result does not depend on it.
        n_turns: quarter turns (1, 2 or 4) in which every voxel's surroundings are looked at, for as many times the work; its shares are the
            mean. ASSUME: a street has no preferred direction, as the turned samples of training say (N-021).
        smoothing: how far shares spread over the surface; voxels of other groups that they reach are evaluated, too.
    Raises:
        BadInput: voxels of another size than the network was trained on, a height is unknown, or another number of turns.
    """
    settings = network.settings
    if n_turns not in (1, 2, 4):
        raise BadInput("label_map.n_turns", str(n_turns), "give 1, 2 or 4 quarter turns")
    if not np.isclose(grid.size_m, settings.size_m, rtol=1e-9):
        found = f"voxels of {grid.size_m} m for weights made with {settings.size_m} m"
        raise BadInput(
            "the weights", f"weights made with other settings: {found}", "voxelize with the weights' size_m or use other weights"
        )
    tile, group_of_tile = assign_tiles(grid, tile_m, n_groups)
    is_own = group_of_tile[tile] == group
    looked_at = np.flatnonzero(is_own | _is_near(grid, tile, np.flatnonzero(group_of_tile == group), smoothing.reach_voxels))
    shares = _shares_by_tile(network, grid, looked_at, tile, n_threads, n_turns)
    own, n_tiles = is_own[looked_at], np.count_nonzero(group_of_tile == group)
    alone = _best_class(shares)[own] if smoothing.n_rounds else None
    # Of millions of voxels labels are kept, the smoothed shares are not, and the keys are not copied without need.
    del tile, is_own
    keys = grid.keys if len(looked_at) == len(grid) else grid.keys[looked_at]
    labels, confidence = np.empty(len(looked_at), np.uint8), np.empty(len(looked_at), np.float32)
    for rows, smoothed in smooth_in_slices(keys, shares, smoothing):
        labels[rows], confidence[rows] = _best_class(smoothed), smoothed.max(axis=1)
    logger.info("%d voxels in %d tiles labelled", np.count_nonzero(own), n_tiles)
    return VoxelLabels(looked_at[own], labels[own], confidence[own], alone)


def _shares_by_tile(network: C2CNN, grid: VoxelGrid, looked_at: np.ndarray, tile: np.ndarray, n_threads: int, n_turns: int) -> np.ndarray:
    """(v, 9) float32 class shares of the voxels in rows `looked_at` (v,), increasing, a tile a thread; `tile` (V,) is of every voxel."""
    channels = grid_channels(grid, network.settings)
    by_tile = looked_at[np.argsort(tile[looked_at], kind="stable")]
    bounds = np.append(0, np.cumsum(np.bincount(tile[looked_at])))
    shares = np.zeros((len(looked_at), N_CLASSES), np.float32)

    def look_at_tile(i):
        rows = by_tile[bounds[i] : bounds[i + 1]]
        nearby = _rows_near(grid, rows, network.settings.radius)
        for part in _split(grid.keys, rows):
            found = _class_shares(network, channels[nearby], grid.keys[nearby], grid.keys[part], n_turns)
            shares[np.searchsorted(looked_at, part)] = found

    with open_workers(n_threads) as workers:
        # The list passes on a tile's error.
        list(workers.map(look_at_tile, np.flatnonzero(np.diff(bounds))))
    return shares


def _best_class(shares: np.ndarray) -> np.ndarray:
    """(v,) uint8 the class with the largest of the shares (v, 9)."""
    return shares.argmax(axis=1).astype(np.uint8)


def _is_near(grid: VoxelGrid, tile: np.ndarray, tiles: np.ndarray, reach: int) -> np.ndarray:
    """(V,) bool: voxels at most `reach` beyond the bounding box of one of some tiles' voxels."""
    is_near = np.zeros(len(grid), bool)
    if reach and len(tiles) < tile.max(initial=-1) + 1:
        for i in tiles:
            is_near[_rows_near(grid, np.flatnonzero(tile == i), reach)] = True
    return is_near


def _class_shares(network: C2CNN, channels: np.ndarray, keys: np.ndarray, wanted: np.ndarray, n_turns: int) -> np.ndarray:
    """(q, 9) float32 softmax at wanted voxels, the mean over quarter turns of all voxels about the vertical."""
    with torch.inference_mode():
        turns = range(0, 4, 4 // n_turns)
        logits = (sparse_logits(network, channels, turn_keys(keys, turn), turn_keys(wanted, turn)) for turn in turns)
        return (sum(torch.softmax(of_turn, 1) for of_turn in logits) / n_turns).cpu().numpy()


def _rows_near(grid: VoxelGrid, rows: np.ndarray, radius: int) -> np.ndarray:
    """Rows of the voxels at most `radius` beyond the bounding box of some, by slices of x."""
    low, high = grid.keys[rows].min(axis=0) - radius, grid.keys[rows].max(axis=0) + radius
    start, stop = np.searchsorted(grid.keys[:, 0], [low[0], high[0] + 1])
    keys = grid.keys[start:stop, 1:]
    return start + np.flatnonzero(((keys >= low[1:]) & (keys <= high[1:])).all(axis=1))


def _split(keys: np.ndarray, rows: np.ndarray) -> Iterator[np.ndarray]:
    """Halve rows of voxels along their longest extent until each part is small enough to evaluate at once: its space, then its number."""
    low, high = keys[rows].min(axis=0), keys[rows].max(axis=0)
    axis = int(np.argmax(high - low))
    along, is_wide = keys[rows, axis], high[axis] - low[axis] >= _MAX_EXTENT
    if len(rows) <= _MAX_WANTED and not is_wide:
        yield rows
        return
    order = np.argsort(along, kind="stable")
    half = int(np.count_nonzero(along <= (int(low[axis]) + int(high[axis])) // 2)) if is_wide else len(rows) // 2
    for part in (order[:half], order[half:]):
        yield from _split(keys, rows[part])


def label_points(
    clouds: Iterable[PointCloud], grid: VoxelGrid, rows: np.ndarray, labels: np.ndarray, confidence: np.ndarray
) -> Iterator[PointCloud]:
    """The points in labelled voxels, cloud by cloud, with fields `label` uint8 and `confidence` float32 added.

    Args:
        clouds: the map in pieces.
        grid: its voxels.
        rows, labels, confidence: of `label_voxels`.
    Yields:
        clouds without the points of other voxels; an empty cloud is left out unless it is the only one.
    Raises:
        BadInput: a point lies in no voxel of the grid.
    """
    place = np.full(len(grid), -1, np.int64)
    place[rows] = np.arange(len(rows))
    empty, has_points = None, False
    for cloud in clouds:
        row = grid.find(grid.keys_of(cloud.points))
        if (row < 0).any():
            where = cloud.points[int(np.argmax(row < 0))].round(3).tolist()
            raise BadInput("the voxel grid", f"has no voxel at the map's point {where}", "run voxelize_map again on this map")
        at = place[row]
        picked = cloud.select(at >= 0)
        at = at[at >= 0]
        picked.fields |= {"label": labels[at], "confidence": confidence[at]}
        if len(picked):
            has_points = True
            yield picked
        else:
            empty = picked
    if not has_points and empty is not None:
        yield empty
