"""Landmarks of a labelled map: its tall columns and street furniture, one object each.

Source: Nagy (2020), 3.3.1 (N-104, N-105): objects are separated by Euclidean clustering in the regions of a class, offline; what moves,
what changes with the season (vegetation) and what is large (ground, facade) is no landmark. Case study 3.4.1 (N-126): a raw map
has no classes, so everything above its ground becomes a landmark, phantoms, cars and all.

Clustering works on the mean points of the map's voxels, from all tiles together, so an object on the border of two tiles is one.
"""

import logging
from collections.abc import Iterable
from dataclasses import dataclass

import geopandas
import numpy as np
import shapely
from scipy import sparse
from scipy.spatial import cKDTree

from streetscan.classes import COLUMN, FURNITURE, NAMES
from streetscan.errors import BadInput
from streetscan.io.arrays import load_npz, save_npz
from streetscan.localization.keypoints import ObjectSet, describe_objects
from streetscan.voxels import VoxelGrid

logger = logging.getLogger(__name__)
_FIELDS = ("n_points", "centres", "sizes_m", "yaws_rad", "corners", "parts")


@dataclass(frozen=True)
class LandmarkSettings:
    """What becomes a landmark; lengths in metres.

    Attributes:
        distance_m: points nearer to each other than this are of one object (Euclidean clustering).
        max_height_m: landmarks are described up to this height above the ground, like the objects of a frame.
        max_base_m: what begins higher above the ground hangs, and does not stand.
        min_column_m, min_furniture_m: lower columns and furniture are left out.
        max_size_m: longer objects are left out.
        min_voxels: smaller clusters are noise.
        above_m: of a raw map, points higher above the ground than this are clustered.
        column_ratio: of a raw map, an object at least this many times as high as wide and deep is a column.
    """

    distance_m: float = 0.25
    max_height_m: float = 2.5
    max_base_m: float = 0.6
    min_column_m: float = 1.0
    min_furniture_m: float = 0.3
    max_size_m: float = 8.0
    min_voxels: int = 12
    above_m: float = 0.1
    column_ratio: float = 2.0

    def __post_init__(self):
        for name in ("distance_m", "max_height_m", "max_size_m", "min_voxels", "above_m", "column_ratio"):
            if not getattr(self, name) > 0:
                raise BadInput(f"cluster_landmarks.{name}", f"{getattr(self, name)} is not above 0", "give a positive number")


@dataclass
class Landmarks:
    """M landmarks, ordered by kind and then by place.

    Attributes:
        kinds: (M,) uint8, COLUMN or FURNITURE.
        objects: boxes and keypoints, frame `map`, float64.
        tops_m: (M,) float64 height of the whole object above the ground, beyond the cut too.
    """

    kinds: np.ndarray
    objects: ObjectSet
    tops_m: np.ndarray

    def __len__(self) -> int:
        return len(self.kinds)

    def select(self, rows: np.ndarray) -> "Landmarks":
        """The landmarks a mask or an index picks."""
        return Landmarks(self.kinds[rows], self.objects.select(rows), self.tops_m[rows])

    def moved(self, shift_m: np.ndarray) -> "Landmarks":
        """The same landmarks, shifted by (3,) metres."""
        o = self.objects
        moved = ObjectSet(o.n_points, o.centres + shift_m, o.sizes_m, o.yaws_rad, o.corners + shift_m, o.parts + shift_m)
        return Landmarks(self.kinds, moved, self.tops_m)

    def near(self, position: np.ndarray, range_m: float) -> np.ndarray:
        """(K,) rows of the landmarks within a horizontal distance of a position (>=2,)."""
        return np.flatnonzero(((self.objects.centres[:, :2] - position[:2]) ** 2).sum(axis=1) <= range_m**2)

    def to_frame(self, crs: str | None) -> geopandas.GeoDataFrame:
        """A table with one row per landmark and its footprint as geometry, in the map's reference system."""
        o = self.objects
        columns = {
            "id": np.arange(1, len(self) + 1),
            "class": np.array(NAMES, object)[self.kinds],
            "n_points": o.n_points,
            **{f"{axis}_m": o.centres[:, i] for i, axis in enumerate("xyz")},
            **{f"{side}_m": o.sizes_m[:, i] for i, side in enumerate(("length", "width", "height"))},
            "yaw_rad": o.yaws_rad,
            "top_m": self.tops_m,
        }
        footprints = shapely.polygons(o.corners[:, 0, :, :2]) if len(self) else np.empty(0, object)
        return geopandas.GeoDataFrame(columns, geometry=geopandas.array.GeometryArray(footprints), crs=crs)

    def save(self, path) -> None:
        """Write as `.npz`: kinds, heights, boxes and keypoints."""
        save_npz(path, kinds=self.kinds, tops_m=self.tops_m, **{name: getattr(self.objects, name) for name in _FIELDS})

    @classmethod
    def load(cls, path) -> "Landmarks":
        """Read what `save` wrote. BadInput when the file is something else."""
        kinds, tops, *arrays = load_npz(path, ("kinds", "tops_m", *_FIELDS), "cluster_landmarks")
        return cls(kinds, ObjectSet(**dict(zip(_FIELDS, arrays, strict=True))), tops)


def mean_points(grid: VoxelGrid, chunks: Iterable[np.ndarray]) -> np.ndarray:
    """The mean of the points in each voxel.

    Args:
        grid: the voxels of the map.
        chunks: (n, 3) float64 arrays, metres, frame `map`; together the map the grid was made of.
    Returns:
        (V, 3) float64, frame `map`; the centre of a voxel no point fell into.
    """
    sums, counts = np.zeros((len(grid), 3)), np.zeros(len(grid), np.int64)
    for points in chunks:
        rows = grid.find(grid.keys_of(points))
        known = rows >= 0
        rows, offsets = rows[known], points[known] - grid.origin
        counts += np.bincount(rows, minlength=len(grid))
        for axis in range(3):
            sums[:, axis] += np.bincount(rows, offsets[:, axis], len(grid))
    means = grid.centres
    seen = counts > 0
    means[seen] = grid.origin + sums[seen] / counts[seen, None]
    return means


def cluster_landmarks(
    points: np.ndarray, heights_m: np.ndarray, labels: np.ndarray | None, settings: LandmarkSettings = LandmarkSettings()
) -> Landmarks:
    """The landmarks of a map.

    Args:
        points: (V, 3) float64, metres, frame `map`, mean points of its voxels.
        heights_m: (V,) above the ground.
        labels: (V,) uint8 class of each, or None for a raw map.
        settings: see LandmarkSettings.
    Returns:
        the landmarks; none is a valid result.
    Source: Nagy (2020), 3.3.1.
    """
    s = settings
    if len(points) == 0:
        return _describe([], [], [], s)
    kinds, parts, tops = [], [], []
    candidates = [(None, (heights_m > s.above_m))] if labels is None else [(k, labels == k) for k in (COLUMN, FURNITURE)]
    for kind, wanted in candidates:
        rows = np.flatnonzero(wanted)
        # Of a raw map only the part that is described is clustered: above it crowns and wires would join everything.
        if labels is None:
            rows = rows[heights_m[rows] < s.max_height_m]
        for cluster in euclidean_clusters(points[rows], s.distance_m, s.min_voxels):
            members = rows[cluster]
            heights = heights_m[members]
            # ASSUME: a whole map's ground is known to a few centimetres, so the cut at `above_m` leaves the foot's soil out.
            kept = (heights < s.max_height_m) & (heights > s.above_m)
            if heights.min() > s.max_base_m or kept.sum() < s.min_voxels:
                continue
            kinds.append(kind)
            parts.append(points[members[kept]])
            tops.append(heights.max())
    return _describe(kinds, parts, tops, s)


def euclidean_clusters(points: np.ndarray, distance_m: float, min_points: int) -> list[np.ndarray]:
    """Rows of each set of points that are chained by distances below a limit, found with a kd-tree (thesis, [68]); by their first row.

    Args:
        points: (N, 3) metres.
        distance_m: the limit.
        min_points: smaller sets are left out.
    """
    if len(points) == 0:
        return []
    pairs = cKDTree(points - points[0]).query_pairs(distance_m, output_type="ndarray")
    graph = sparse.coo_array((np.ones(len(pairs), np.bool_), (pairs[:, 0], pairs[:, 1])), shape=(len(points),) * 2)
    number = sparse.csgraph.connected_components(graph, directed=False)[1]
    order = np.argsort(number, kind="stable")
    groups = np.split(order, np.flatnonzero(np.diff(number[order])) + 1)
    return sorted((g for g in groups if len(g) >= min_points), key=lambda g: g[0])


def _describe(kinds: list, parts: list, tops: list, s: LandmarkSettings) -> Landmarks:
    starts = np.concatenate([[0], np.cumsum([len(p) for p in parts])]).astype(np.int64)
    points = np.concatenate([np.empty((0, 3)), *parts])
    objects = describe_objects(points, starts)
    tall = objects.sizes_m[:, 2] >= s.column_ratio * objects.sizes_m[:, :2].max(axis=1, initial=0)
    kinds = np.array([(COLUMN if is_tall else FURNITURE) if k is None else k for k, is_tall in zip(kinds, tall, strict=True)], np.uint8)
    least = np.where(kinds == COLUMN, s.min_column_m, s.min_furniture_m)
    tops = np.array(tops, np.float64)
    kept = (tops >= least) & (objects.sizes_m[:, :2].max(axis=1, initial=0) <= s.max_size_m)
    landmarks = Landmarks(kinds, objects, tops).select(kept)
    order = np.lexsort((landmarks.objects.centres[:, 1], landmarks.objects.centres[:, 0], landmarks.kinds))
    landmarks = landmarks.select(order)
    n_columns = int((landmarks.kinds == COLUMN).sum())
    logger.info("%d columns and %d pieces of furniture among %d clusters", n_columns, len(landmarks) - n_columns, len(parts))
    return landmarks
