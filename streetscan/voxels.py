"""The sparse voxel grid: only voxels that hold a point exist.

Source: Nagy (2020), 2.4.1. Voxel of a point: `floor((p - origin) / size)`, one origin per map. Keys are packed into one
int64 so that sorting and searching are single-array operations.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from streetscan.errors import BadInput
from streetscan.io.arrays import load_npz, save_npz

# 21 bits an axis: at 0.1 m a map of 209 km by 209 km by 209 km.
_BITS = 21
_HALF = 1 << (_BITS - 1)
# What a grid's file holds.
_SAVED = ("origin", "size_m", "keys", "counts", "mean_z_m", "height_m", "spread_s")


def pack_keys(keys: np.ndarray) -> np.ndarray:
    """(V, 3) integer voxel keys to (V,) int64 that sort like (x, y, z). ValueError beyond +-2^20."""
    keys = np.asarray(keys, np.int64)
    if keys.size and (keys.min() < -_HALF or keys.max() >= _HALF):
        raise ValueError("voxel keys beyond 2^20; subtract an origin near the data")
    shifted = keys + _HALF
    return (shifted[..., 0] << (2 * _BITS)) | (shifted[..., 1] << _BITS) | shifted[..., 2]


def unpack_keys(packed: np.ndarray) -> np.ndarray:
    """The inverse of `pack_keys`: (V, 3) int32."""
    mask = (1 << _BITS) - 1
    parts = (packed >> (2 * _BITS), (packed >> _BITS) & mask, packed & mask)
    return (np.stack(parts, axis=-1) - _HALF).astype(np.int32)


@dataclass
class VoxelGrid:
    """Occupied voxels of a map, sorted by key.

    Attributes:
        origin: (3,) float64, metres, frame `map`: the corner of voxel (0, 0, 0).
        size_m: edge length.
        keys: (V, 3) int32, sorted by x, y, z.
        counts: (V,) uint32, points in the voxel (thesis channel 1, N-015).
        mean_z_m: (V,) float64, mean height of the points, frame `map`.
        height_m: (V,) float32, mean height above the local ground (channel 2, N-016); NaN before it is estimated.
        spread_s: (V,) float32, seconds between the first and the last of the points; NaN where times are unknown.
    """

    origin: np.ndarray
    size_m: float
    keys: np.ndarray
    counts: np.ndarray
    mean_z_m: np.ndarray
    height_m: np.ndarray
    spread_s: np.ndarray | None = None
    # Of `find`, made when first asked for; the keys of a grid do not change.
    _packed: np.ndarray | None = field(default=None, init=False, repr=False, compare=False)

    def __post_init__(self):
        if self.spread_s is None:
            self.spread_s = np.full(len(self.keys), np.nan, np.float32)

    def __len__(self) -> int:
        return len(self.keys)

    @property
    def centres(self) -> np.ndarray:
        """(V, 3) float64 voxel centres, metres, frame `map`."""
        return self.origin + (self.keys + 0.5) * self.size_m

    @property
    def n_dense(self) -> int:
        """Voxels of the box around the occupied ones, what a dense array would hold (the count of thesis Table 2.1)."""
        return int(np.prod(np.ptp(self.keys, axis=0).astype(np.int64) + 1)) if len(self) else 0

    def keys_of(self, points: np.ndarray) -> np.ndarray:
        """(N, 3) int64 voxel keys of (N, 3) points in frame `map`; further columns do not count."""
        return _keys_of(points, self.origin, self.size_m)

    def find(self, keys: np.ndarray) -> np.ndarray:
        """(N,) int64 row of each (N, 3) key, -1 where no such voxel exists."""
        if self._packed is None:
            self._packed = pack_keys(self.keys)
        return find_sorted(self._packed, pack_keys(keys))

    def select(self, mask: np.ndarray) -> "VoxelGrid":
        """The grid of the voxels a boolean mask keeps (sorted order stays)."""
        arrays = (self.keys, self.counts, self.mean_z_m, self.height_m, self.spread_s)
        return VoxelGrid(self.origin, self.size_m, *(a[mask] for a in arrays))

    def save(self, path: str | Path) -> None:
        """Write as `.npz` (uncompressed)."""
        save_npz(path, **{name: getattr(self, name) for name in _SAVED})

    @classmethod
    def load(cls, path: str | Path) -> "VoxelGrid":
        """Read what `save` wrote. BadInput when the file is something else."""
        origin, size_m, *arrays = load_npz(path, _SAVED, "voxelize_map")
        return cls(origin, float(size_m), *arrays)


def find_sorted(sorted_packed: np.ndarray, packed: np.ndarray) -> np.ndarray:
    """Row of each packed key in a sorted array of packed keys, -1 where absent."""
    if len(sorted_packed) == 0:
        return np.full(len(packed), -1, np.int64)
    row = np.searchsorted(sorted_packed, packed)
    row[row == len(sorted_packed)] = 0
    return np.where(sorted_packed[row] == packed, row, -1)


def voxelize(chunks: Iterable[np.ndarray], size_m: float, origin: np.ndarray | None = None) -> VoxelGrid:
    """Count points and average heights per voxel; memory grows with the voxels, not with the points.

    Args:
        chunks: (n, 3) float64 arrays, metres, frame `map`, or (n, 4) with the points' times in seconds; together the map.
        size_m: voxel edge λ.
        origin: (3,) corner of voxel (0, 0, 0); by default the first point's position rounded down to whole kilometres
            (height: to whole 100 m), so that grids of neighbouring parts share it.
    Returns:
        the grid, `height_m` still NaN.
    Raises:
        BadInput: λ is not above 0, or there is no point.
    """
    if not size_m > 0:
        raise BadInput("voxelize_map.size_m", f"{size_m} is not above 0", "give the voxel edge in metres, such as 0.1")
    # Keys, counts, sums of heights, first and last times, in parts; the first part of each column is what is merged so far.
    columns: list[list[np.ndarray]] = [[] for _ in _TOGETHER]
    for points in chunks:
        if len(points) == 0:
            continue
        if origin is None:
            steps = np.array([1000.0, 1000.0, 100.0])
            origin = np.floor(points[0, :3] / steps) * steps
        packed = pack_keys(_keys_of(points, origin, size_m))
        times_s = points[:, 3] if points.shape[1] == 4 else np.full(len(points), np.nan)
        part = _merge([[c] for c in (packed, np.ones(len(packed), np.int64), points[:, 2] - origin[2], times_s, times_s)])
        for column, values in zip(columns, part, strict=True):
            column.append(values)
        # Merging only when the parts outweigh the total keeps the sum of all merges proportional to the voxels.
        if sum(map(len, columns[0][1:])) > len(columns[0][0]):
            columns = [[merged] for merged in _merge(columns)]
    if origin is None:
        raise BadInput("the map", "holds no point", "give a map with points")
    packed, counts, sums, first_s, last_s = _merge(columns)
    mean_z, unknown = origin[2] + sums / counts, np.full(len(packed), np.nan, np.float32)
    # Many files hold one and the same time throughout, which is none.
    spread_s = (last_s - first_s).astype(np.float32) if last_s.max() > first_s.min() else unknown.copy()
    return VoxelGrid(origin, size_m, unpack_keys(packed), counts.astype(np.uint32), mean_z, unknown, spread_s)


def _keys_of(points: np.ndarray, origin: np.ndarray, size_m: float) -> np.ndarray:
    # Maps come in whole millimetres, so that many points lie on a face between voxels. The millionth of a voxel gives
    # them all to the upper one; without it the last bit decides, and the same point read from two files could differ.
    return np.floor((points[:, :3] - origin) / size_m + 1e-6).astype(np.int64)


# How the columns of voxels with one key become one: counts and heights are added, of times the first and the last is kept.
_TOGETHER = (None, np.add, np.add, np.minimum, np.maximum)


def _merge(columns: list[list[np.ndarray]]) -> list[np.ndarray]:
    """The parts of each column as one, each key once; they are taken out of the lists, so that memory holds one column twice, not all."""
    packed = np.concatenate(columns.pop(0))
    order = np.argsort(packed, kind="stable")
    packed = packed[order]
    starts = np.flatnonzero(np.r_[True, packed[1:] != packed[:-1]])
    merged = [packed[starts]]
    del packed
    for together in _TOGETHER[1:]:
        merged.append(together.reduceat(np.concatenate(columns.pop(0))[order], starts))
    return merged
