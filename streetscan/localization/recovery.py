"""The whole window searched by points seen from above, for frames whose objects do not tell where they are.

Beyond the thesis. A street without landmarks still has walls. What stands between knee and head is projected onto the road, in the
frame and on the map, and the shift and turn are sought under which most of the frame falls on the map: coarse to fine, a coarse cell
being judged by the best its fine ones could reach (Olson 2009, 3; Hess et al. 2016, IV), with the most promising kept at every level.
"""

from dataclasses import dataclass

import numpy as np
from numba import njit

from streetscan.geometry import angle_difference
from streetscan.localization.voting import Window

# Edge of the finest cell, and how often it is doubled for the coarsest.
_CELL_M, _LEVELS = 0.25, 5
# Step of the turn: a third of a metre at 25 m.
_TURN_STEP_RAD = np.radians(0.75)
# Heights above the ground that take part, m.
LOW_M, HIGH_M = 0.5, 2.5
# Nodes kept at each level, and cells of the frame that are compared.
_BEAM, _NARROW_BEAM, _MAX_CELLS = 3000, 100, 500


@dataclass
class PlaneMap:
    """What stands on the map seen from above, and for each level the best within reach of a cell.

    Attributes:
        corner: (2,) corner of cell (0, 0).
        levels: (L, nx, ny) uint8, 2 occupied, 1 beside; level k holds the largest of the 2^k x 2^k cells from there on.
    """

    corner: np.ndarray
    levels: np.ndarray


def make_plane_map(points: np.ndarray, heights_m: np.ndarray) -> PlaneMap | None:
    """
    Args:
        points: (S, 3) static points of the map, metres.
        heights_m: (S,) above the ground.
    Returns:
        the map; None when nothing stands there.
    """
    standing = points[(heights_m > LOW_M) & (heights_m < HIGH_M), :2]
    if len(standing) == 0:
        return None
    margin = 2**_LEVELS + 2
    corner = (np.floor(standing.min(axis=0) / _CELL_M) - margin) * _CELL_M
    ij = np.floor((standing - corner) / _CELL_M).astype(np.int64)
    field = np.zeros(ij.max(axis=0) + margin + 1, np.uint8)
    for a in (-1, 0, 1):
        for b in (-1, 0, 1):
            field[ij[:, 0] + a, ij[:, 1] + b] = 1
    field[ij[:, 0], ij[:, 1]] = 2
    levels = [field]
    for k in range(_LEVELS):
        last, reach = levels[-1], 2**k
        padded = np.pad(last, ((0, reach), (0, reach)))
        n, m = last.shape
        wide = np.maximum(padded[:n, :m], padded[reach:, :m])
        levels.append(np.maximum(wide, np.maximum(padded[:n, reach:], padded[reach:, reach:])))
    return PlaneMap(corner, np.stack(levels))


def search_plane(
    plane_map: PlaneMap, points: np.ndarray, xy: np.ndarray, yaw_rad: float, window: Window, n_peaks: int = 4, least: float = 0.0
) -> list[tuple[np.ndarray, float, float]]:
    """Shifts and turns under which most of the frame falls on the map.

    Args:
        plane_map: the map.
        points: (N, >=2) what stands in the frame, about the sensor, level.
        xy, yaw_rad: the start, in the map's axes.
        window: what is searched.
        n_peaks: at most so many results, 1.5 m or 5 degrees apart.
        least: results below this share of the best are of no interest, which saves most of the search.
    Returns:
        (shift (2,) about the start in the map's axes, turn, share of the frame on the map) each, best first.
    """
    cells = _cells_of(points)
    if len(cells) == 0:
        return []
    n_turns = int(np.ceil(np.radians(window.turn_deg) / _TURN_STEP_RAD))
    turns = np.arange(-n_turns, n_turns + (0 if window.turn_deg == 180 else 1)) * _TURN_STEP_RAD
    start = (np.asarray(xy)[:2] - plane_map.corner) / _CELL_M
    rotated = np.empty((len(turns), len(cells), 2), np.int32)
    for t, turn in enumerate(turns + yaw_rad):
        c, s = np.cos(turn), np.sin(turn)
        rotated[t] = np.floor(cells @ np.array([(c, s), (-s, c)]) / _CELL_M + start)
    step = 2**_LEVELS
    n = int(np.ceil(window.shift_m / _CELL_M / step))
    shifts = np.arange(-n, n) * step
    nodes = np.stack(np.meshgrid(np.arange(len(turns)), shifts, shifts, indexing="ij"), -1).reshape(-1, 3).astype(np.int32)
    if least > 0:
        # What a narrow search reaches, the best reaches too; only the wide beam sees all that comes near it.
        reached, highest = _descend(plane_map, rotated, nodes, _NARROW_BEAM, 0)
        others, scores = _descend(plane_map, rotated, nodes, _BEAM, int(np.ceil(least * highest[0])))
        nodes, scores = np.concatenate([reached[:1], others]), np.concatenate([highest[:1], scores])
        order = np.argsort(-scores, kind="stable")
        nodes, scores = nodes[order], scores[order]
    else:
        nodes, scores = _descend(plane_map, rotated, nodes, _BEAM, 0)
    found: list[tuple[np.ndarray, float, float]] = []
    is_apart = np.ones(len(nodes), bool)
    while is_apart.any() and len(found) < n_peaks:
        best = int(np.argmax(is_apart))
        found.append((nodes[best, 1:] * _CELL_M, float(turns[nodes[best, 0]]), float(scores[best]) / (2 * len(cells))))
        turned = np.abs(angle_difference(turns[nodes[:, 0]], found[-1][1]))
        is_apart &= (np.hypot(*(nodes[:, 1:] * _CELL_M - found[-1][0]).T) > 1.5) | (turned > np.radians(5))
    return found


def _descend(plane_map: PlaneMap, rotated: np.ndarray, nodes: np.ndarray, beam: int, least: int) -> tuple[np.ndarray, np.ndarray]:
    """The best cells (turn, x, y) of the finest level under coarse ones and their scores, best first.

    Args:
        plane_map: the map.
        rotated: (A, K, 2) the frame's cells by turn.
        nodes: (N, 3) cells of the coarsest level.
        beam: so many are followed from level to level.
        least: cells that can reach no such score are left.
    """
    for level in range(_LEVELS, -1, -1):
        scores = _score(plane_map.levels[level], rotated, nodes, least)
        kept = np.argsort(-scores, kind="stable")[:beam]
        kept = kept[scores[kept] >= least]
        nodes, scores = nodes[kept], scores[kept]
        if level:
            half = 2 ** (level - 1)
            children = np.array([(0, 0, 0), (0, half, 0), (0, 0, half), (0, half, half)], np.int32)
            nodes = (nodes[:, None] + children).reshape(-1, 3)
    return nodes, scores


def _cells_of(points: np.ndarray) -> np.ndarray:
    """Middles (K, 2) of the cells that hold points, evenly thinned."""
    keys = np.unique(np.floor(np.asarray(points)[:, :2] / _CELL_M).astype(np.int64), axis=0)
    return (keys[:: max(1, -(-len(keys) // _MAX_CELLS))] + 0.5) * _CELL_M


@njit(cache=True, nogil=True)
def _score(field, rotated, nodes, least):
    """Twice the cells of the frame that fall on the map, per node; less than `least` as soon as it cannot be reached."""
    scores = np.zeros(len(nodes), np.int32)
    n_x, n_y = field.shape
    for k in range(len(nodes)):
        t, dx, dy, total = nodes[k, 0], nodes[k, 1], nodes[k, 2], 0
        for p in range(rotated.shape[1]):
            if p % 32 == 0 and total + 2 * (rotated.shape[1] - p) < least:
                break
            i, j = rotated[t, p, 0] + dx, rotated[t, p, 1] + dy
            if i >= 0 and i < n_x and j >= 0 and j < n_y:
                total += field[i, j]
        scores[k] = total
    return scores
