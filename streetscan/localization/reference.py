"""What a frame is localized against: the map's landmarks, its ground, and the points of what stands still.

Source: Nagy (2020), 3.3.3 (N-113, N-114): the map is cut around the start; the road's normal comes from the map.
"""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numba import njit

from streetscan.classes import LABELS
from streetscan.errors import BadInput
from streetscan.io.arrays import load_npz, save_npz
from streetscan.landmarks import Landmarks
from streetscan.registration.ndt import EMPTY, find_slot, pack_cell, thin_points
from streetscan.segmentation.ground import fill_holes
from streetscan.voxels import VoxelGrid, pack_keys

STATIC_CLASSES = ("ground", "facade", "vegetation", "column", "furniture")
# Edge of a cell of the ground, and of the tiles the static points are sorted by.
_GROUND_M, _TILE_M = 0.5, 10.0
# Static points higher above the ground are out of a car's sensor's sight.
_MAX_HEIGHT_M = 8.0
# Distance around the vehicle within which the road's plane is fitted.
_PLANE_RANGE_M = 15.0
# Squares of this edge are mapped when anything in them is. ASSUME: wide enough to hold the unseen inside of a house beside its front, so
# that a frame pushed into houses is still found to lie beside the map.
_MAPPED_M = 8.0
# A frame of which less is where the map is counts as if so much were.
MIN_KNOWN = 1 / 3


@dataclass
class Reference:
    """A map to be localized on.

    Attributes:
        crs: the map's reference system, None for a local frame.
        origin: (3,) float64, metres, frame `map`; everything below is relative to it.
        landmarks: relative to the origin.
        ground_corner: (2,) corner of cell (0, 0) of the ground.
        ground_m: (nx, ny) float32 heights of the ground, filled where it was not seen.
        is_ground: (nx, ny) bool, cells with map points.
        static: (S, 3) float32 points of what stands still, one per `static_m` cube, sorted by tile.
        static_m: edge of the cubes.
    """

    crs: str | None
    origin: np.ndarray
    landmarks: Landmarks
    ground_corner: np.ndarray
    ground_m: np.ndarray
    is_ground: np.ndarray
    static: np.ndarray
    static_m: float
    _tiles: dict = field(default_factory=dict, repr=False)

    def __post_init__(self):
        tiles = np.floor(self.static[:, :2] / _TILE_M).astype(np.int64)
        if len(tiles):
            starts = np.flatnonzero(np.any(np.diff(tiles, axis=0, prepend=tiles[:1] - 1), axis=1))
            ends = np.append(starts[1:], len(tiles))
            self._tiles = {tuple(tiles[a]): (a, b) for a, b in zip(starts, ends, strict=True)}

    def contains(self, xy: np.ndarray, margin_m: float = 0.0) -> bool:
        """Whether a position (>=2,), relative to the origin, lies on the map, or at most a distance beside it."""
        at = (np.asarray(xy, np.float64)[:2] - self.ground_corner) / _GROUND_M
        # Said so that NaN fails.
        if not np.abs(at).max() < 1 << 24:
            return False
        i, j = at.astype(np.int64)
        n = int(np.ceil(margin_m / _GROUND_M))
        return bool(self.is_ground[max(i - n, 0) : max(i + n + 1, 0), max(j - n, 0) : max(j + n + 1, 0)].any())

    def ground_at(self, xy: np.ndarray) -> np.ndarray:
        """(N,) heights of the ground at positions (N, >=2), relative to the origin; constant beyond the map."""
        ij = ((np.asarray(xy)[:, :2] - self.ground_corner) / _GROUND_M).astype(np.int64)
        i, j = np.clip(ij[:, 0], 0, self.ground_m.shape[0] - 1), np.clip(ij[:, 1], 0, self.ground_m.shape[1] - 1)
        return self.ground_m[i, j].astype(np.float64)

    def plane_at(self, xy: np.ndarray) -> np.ndarray:
        """(3,) plane z = a dx + b dy + c of the ground about a position (2,), dx and dy counted from there; level without map."""
        n = int(_PLANE_RANGE_M / _GROUND_M)
        i, j = ((np.asarray(xy)[:2] - self.ground_corner) / _GROUND_M).astype(np.int64)
        i0, j0 = max(i - n, 0), max(j - n, 0)
        seen = np.argwhere(self.is_ground[i0 : max(i + n + 1, 0), j0 : max(j + n + 1, 0)])
        if len(seen) < 30:
            return np.array([0.0, 0.0, float(self.ground_at(np.asarray(xy)[None, :2])[0])])
        cells = seen + (i0, j0)
        dxy = self.ground_corner + (cells + 0.5) * _GROUND_M - np.asarray(xy)[:2]
        z = self.ground_m[cells[:, 0], cells[:, 1]].astype(np.float64)
        a = np.c_[dxy, np.ones(len(dxy))]
        plane = np.linalg.lstsq(a, z, rcond=None)[0]
        for _ in range(2):
            near = np.abs(a @ plane - z) < 0.3
            if near.sum() < 30:
                break
            plane = np.linalg.lstsq(a[near], z[near], rcond=None)[0]
        return plane

    def cut(self, xy: np.ndarray, range_m: float) -> np.ndarray:
        """(K, 3) float64 static points in the tiles within a distance of a position, relative to the origin."""
        low, high = np.floor((np.asarray(xy)[:2] - range_m) / _TILE_M), np.floor((np.asarray(xy)[:2] + range_m) / _TILE_M)
        parts = [np.empty((0, 3), np.float32)]
        for i in range(int(low[0]), int(high[0]) + 1):
            for j in range(int(low[1]), int(high[1]) + 1):
                a, b = self._tiles.get((i, j), (0, 0))
                parts.append(self.static[a:b])
        return np.concatenate(parts).astype(np.float64)

    def save(self, path: str | Path) -> None:
        """Write all but the landmarks as `.npz`."""
        crs = "" if self.crs is None else self.crs
        arrays = {n: getattr(self, n) for n in ("origin", "ground_corner", "ground_m", "is_ground", "static")}
        save_npz(path, crs=np.array(crs), static_m=np.array(self.static_m), **arrays)

    @classmethod
    def load(cls, path: str | Path, landmarks_path: str | Path) -> "Reference":
        """Read what `save` wrote, and the landmarks of the same map.

        Raises:
            BadInput: a file is something else, or the landmarks are of another map.
        """
        names = ("crs", "origin", "ground_corner", "ground_m", "is_ground", "static", "static_m")
        crs, origin, corner, ground, is_ground, static, static_m = load_npz(path, names, "cluster_landmarks")
        landmarks = Landmarks.load(landmarks_path)
        reference = cls(str(crs) or None, origin, landmarks.moved(-origin), corner, ground, is_ground, static, float(static_m))
        centres = reference.landmarks.objects.centres
        n_on_map = sum(reference.contains(c, 5.0) for c in centres)
        # Those of a neighbouring map may overlap with this one at its end.
        if n_on_map < len(centres) / 2:
            found = f"holds {len(centres)} landmarks, {n_on_map} of them on the map of {path}"
            raise BadInput(landmarks_path, found, "run cluster_landmarks again, for both at once")
        return reference


def make_reference(
    grid: VoxelGrid, means: np.ndarray, labels: np.ndarray | None, landmarks: Landmarks, crs: str | None, static_m: float = 0.2
) -> Reference:
    """What localization needs of a map.

    Args:
        grid: its voxels with heights above the ground.
        means: (V, 3) float64 mean points of the voxels.
        labels: (V,) uint8, or None for a raw map, of which every point counts as standing still.
        landmarks: of the map, frame `map`.
        crs: the map's reference system.
        static_m: edge of the cubes the static points are averaged in.
    """
    origin = grid.origin.astype(np.float64)
    points = means - origin
    ground_z = grid.mean_z_m - origin[2] - grid.height_m
    corner = np.floor(points[:, :2].min(axis=0) / _GROUND_M) * _GROUND_M
    ij = np.floor((points[:, :2] - corner) / _GROUND_M).astype(np.int64)
    shape = tuple(ij.max(axis=0) + 1)
    cell = np.ravel_multi_index(tuple(ij.T), shape)
    counts = np.bincount(cell, minlength=shape[0] * shape[1])
    with np.errstate(invalid="ignore"):
        ground = (np.bincount(cell, ground_z, len(counts)) / counts).reshape(shape)
    is_static = np.ones(len(points), bool) if labels is None else np.isin(labels, [LABELS[name] for name in STATIC_CLASSES])
    static = thin_points(points[is_static & (grid.height_m < _MAX_HEIGHT_M)], static_m).astype(np.float32)
    tiles = np.floor(static[:, :2] / _TILE_M).astype(np.int64)
    static = static[np.lexsort((tiles[:, 1], tiles[:, 0]))]
    is_ground = (counts > 0).reshape(shape)
    return Reference(crs, origin, landmarks.moved(-origin), corner, fill_holes(ground).astype(np.float32), is_ground, static, static_m)


class OccupancyGrid:
    """Cubes near the static points, to ask quickly how much of a frame lies on the map."""

    def __init__(self, points: np.ndarray, size_m: float = 0.3):
        """
        Args:
            points: (S, 3), metres.
            size_m: edge of the cubes; a point within a cube of a static point, or beside one, counts.
        """
        self._size_m = size_m
        self._mapped = _make_table(np.c_[np.floor(points[:, :2] / _MAPPED_M), np.zeros(len(points))])
        self._table = _make_table(np.floor(points / size_m))

    def overlap(self, points: np.ndarray, T: np.ndarray) -> float:
        """Share of points (N, 3) that lie on the map once turned and moved by T (4, 4): 1 in a cube with static points, 0.5 beside one.

        Where the map ends nothing is known, so points beyond it do not count, as long as a MIN_KNOWN share of the frame is left. NaN
        without points.
        """
        if len(points) == 0:
            return float("nan")
        return self._look_up(points, T)[0]

    def known_share(self, points: np.ndarray, T: np.ndarray) -> float:
        """Share of points (N, 3) that lie where the map is once turned and moved by T (4, 4), on it or not; 0 without points."""
        return self._look_up(points, T)[1] if len(points) else 0.0

    def _look_up(self, points: np.ndarray, T: np.ndarray) -> tuple[float, float]:
        return _overlap(
            self._table, self._mapped, np.ascontiguousarray(points, np.float64), T[:3, :3].copy(), T[:3, 3].copy(), self._size_m
        )


def _make_table(cells: np.ndarray) -> np.ndarray:
    """Hash table of the cells (N, 3) that occur."""
    keys = np.unique(pack_keys(cells.astype(np.int64))) if len(cells) else np.empty(0, np.int64)
    return _fill_table(keys, np.full(1 << int(np.ceil(np.log2(4 * len(keys) + 4))), EMPTY))


@njit(cache=True, nogil=True)
def _fill_table(keys, table):
    for key in keys:
        table[find_slot(table, key)] = key
    return table


@njit(cache=True, nogil=True)
def _overlap(table, mapped, points, rotation, translation, size):
    total, n_mapped = 0.0, 0
    at = np.empty(3, np.int64)
    per_column = _MAPPED_M / size
    for p in range(len(points)):
        for a in range(3):
            place = translation[a]
            for b in range(3):
                place += rotation[a, b] * points[p, b]
            at[a] = int(np.floor(place / size))
        column = pack_cell(int(np.floor((at[0] + 0.5) / per_column)), int(np.floor((at[1] + 0.5) / per_column)), 0)
        if mapped[find_slot(mapped, column)] == EMPTY:
            continue
        n_mapped += 1
        if table[find_slot(table, pack_cell(at[0], at[1], at[2]))] != EMPTY:
            total += 1.0
            continue
        is_beside = False
        for a in range(3):
            for step in (-1, 1):
                at[a] += step
                is_beside = is_beside or table[find_slot(table, pack_cell(at[0], at[1], at[2]))] != EMPTY
                at[a] -= step
        total += 0.5 if is_beside else 0.0
    return total / max(n_mapped, MIN_KNOWN * len(points)), n_mapped / len(points)
