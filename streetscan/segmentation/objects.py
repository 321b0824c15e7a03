"""Objects of a labelled voxel map by region growing, as boxes.

Source: Nagy (2020), 2.4.2 (N-025): the label map is smooth enough for "object or object group extraction with
conventional region growing algorithms".
"""

import logging
from collections.abc import Iterable
from dataclasses import dataclass

import geopandas
import numpy as np
import shapely
from scipy import sparse

from streetscan.classes import LABELS, NAMES
from streetscan.errors import BadInput
from streetscan.voxels import VoxelGrid, find_sorted, pack_keys

logger = logging.getLogger(__name__)

# One of each pair of opposite neighbours among the 26.
_HALF_NEIGHBOURS = np.array([(x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1) if (x, y, z) > (0, 0, 0)], np.int64)


@dataclass
class Objects:
    """Boxes about the connected regions of a labelled voxel map, M of them, ordered by class and then by place.

    Attributes:
        labels: (M,) uint8 class.
        n_voxels: (M,) int64.
        n_points: (M,) int64.
        centres: (M, 3) float64 box centres, metres, frame `map`.
        sizes_m: (M, 3) float64: the longer and the shorter side of the footprint, and the height.
        yaws_rad: (M,) float64 direction of the longer side, in [-pi/2, pi/2), counter-clockwise from easting; which end is
            the front cannot be told.
        bases_m: (M,) float64 height of the lowest voxel above the local ground, metres.
        confidences: (M,) float64 mean confidence of the voxels' labels.
        footprints: (M,) shapely polygons, the boxes seen from above, frame `map`.
    """

    labels: np.ndarray
    n_voxels: np.ndarray
    n_points: np.ndarray
    centres: np.ndarray
    sizes_m: np.ndarray
    yaws_rad: np.ndarray
    bases_m: np.ndarray
    confidences: np.ndarray
    footprints: np.ndarray

    def __len__(self) -> int:
        return len(self.labels)

    def to_frame(self, crs: str | None) -> geopandas.GeoDataFrame:
        """A table with one row per object and its footprint as geometry, in the map's reference system."""
        columns = {
            "id": np.arange(1, len(self) + 1),
            "class": np.array(NAMES, object)[self.labels],
            "n_voxels": self.n_voxels,
            "n_points": self.n_points,
            **{f"{axis}_m": self.centres[:, i] for i, axis in enumerate("xyz")},
            **{f"{side}_m": self.sizes_m[:, i] for i, side in enumerate(("length", "width", "height"))},
            "yaw_rad": self.yaws_rad,
            "base_m": self.bases_m,
            "confidence": self.confidences,
        }
        return geopandas.GeoDataFrame(columns, geometry=geopandas.array.GeometryArray(self.footprints), crs=crs)


def grow_regions(keys: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """Connected regions of equal label among voxels, each with its 26 neighbours; linear in the voxels.

    Args:
        keys: (V, 3) integer voxel keys, sorted by x, y, z, none twice.
        labels: (V,) class of each.
    Returns:
        (V,) int64 region numbers 0..R-1.
    """
    packed = pack_keys(keys)
    steps = pack_keys(_HALF_NEIGHBOURS) - pack_keys(np.zeros((1, 3), np.int64))
    first, second = [np.empty(0, np.int32)], [np.empty(0, np.int32)]
    for step in steps:
        neighbour = find_sorted(packed, packed + step)
        joined = np.flatnonzero((neighbour >= 0) & (labels[neighbour] == labels))
        first.append(joined.astype(np.int32))
        second.append(neighbour[joined].astype(np.int32))
    first, second = np.concatenate(first), np.concatenate(second)
    graph = sparse.coo_array((np.ones(len(first), bool), (first, second)), shape=(len(keys), len(keys)))
    return sparse.csgraph.connected_components(graph, directed=False)[1].astype(np.int64)


def extract_objects(grid: VoxelGrid, labels: np.ndarray, confidence: np.ndarray, class_names: Iterable[str], min_voxels: int) -> Objects:
    """Every connected region of the given classes as a box.

    Args:
        grid: the voxels, with `height_m`.
        labels: (V,) uint8 predicted class of each.
        confidence: (V,) float32 of the prediction.
        class_names: the classes whose objects are wanted.
        min_voxels: smaller regions are dropped as noise.
    Returns:
        the objects; none is a valid result.
    Raises:
        BadInput: a name that is no class, or `min_voxels` below 1.
    """
    class_names = list(class_names)
    for name in class_names:
        if name not in NAMES:
            raise BadInput("extract_objects.class_names", f"'{name}' is no class", f"use {', '.join(NAMES)}")
    if min_voxels < 1:
        raise BadInput("extract_objects.min_voxels", f"{min_voxels} is below 1", "give the smallest number of voxels of an object")
    wanted = np.flatnonzero(np.isin(labels, [LABELS[name] for name in class_names]))
    region = grow_regions(grid.keys[wanted], labels[wanted])
    is_large = np.bincount(region)[region] >= min_voxels if len(region) else np.zeros(0, bool)
    wanted, region = wanted[is_large], region[is_large]
    # Objects ordered by class and then by their first voxel; voxels ordered by object.
    _, first, region = np.unique(region, return_index=True, return_inverse=True)
    rank = np.empty(len(first), np.int64)
    rank[np.lexsort((first, labels[wanted[first]]))] = np.arange(len(first))
    region = rank[region]
    order = np.argsort(region, kind="stable")
    wanted, region = wanted[order], region[order]
    start = np.flatnonzero(np.diff(region, prepend=-1))
    if len(start) == 0:
        none = np.empty(0)
        return Objects(
            none.astype(np.uint8), *[none.astype(np.int64)] * 2, np.empty((0, 3)), np.empty((0, 3)), none, none, none, none.astype(object)
        )

    n_voxels = np.diff(start, append=len(wanted))
    logger.info("%d objects in %d voxels", len(start), len(wanted))
    keys = grid.keys[wanted]
    corners, sides, yaws = _boxes(keys, start, grid.size_m)
    corners += grid.origin[:2]
    low, high = np.minimum.reduceat(keys[:, 2], start), np.maximum.reduceat(keys[:, 2], start) + 1
    z = grid.origin[2] + (low + high) / 2 * grid.size_m
    return Objects(
        labels=labels[wanted[start]],
        n_voxels=n_voxels,
        n_points=np.add.reduceat(grid.counts[wanted].astype(np.int64), start),
        centres=np.c_[corners.mean(axis=1), z],
        sizes_m=np.c_[sides, (high - low) * grid.size_m],
        yaws_rad=yaws,
        bases_m=np.minimum.reduceat(grid.height_m[wanted].astype(np.float64), start),
        confidences=np.add.reduceat(confidence[wanted].astype(np.float64), start) / n_voxels,
        footprints=shapely.polygons(corners),
    )


def _boxes(keys: np.ndarray, start: np.ndarray, size_m: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rectangles seen from above about regions of voxels, relative to the grid's origin.

    Args:
        keys: (V, 3) voxels, grouped by region and sorted in it.
        start: (M,) first row of each region.
        size_m: voxel edge.
    Returns:
        corners (M, 4, 2) in metres, counter-clockwise; sides (M, 2), the longer first; yaws (M,) of the longer side.
    """
    region = np.repeat(np.arange(len(start)), np.diff(start, append=len(keys)))
    # The direction comes from the smallest rectangle about the voxels' corners, which even a single voxel has.
    # Voxels of a column follow one another.
    is_new = np.diff(np.c_[region, keys[:, :2]], axis=0, prepend=-(2**31)).any(axis=1)
    corners = (keys[is_new, None, :2] + np.array([(0, 0), (0, 1), (1, 0), (1, 1)])).reshape(-1, 2) * size_m
    rectangles = shapely.oriented_envelope(shapely.multipoints(shapely.points(corners), indices=np.repeat(region[is_new], 4)))
    ring = shapely.get_coordinates(shapely.get_exterior_ring(rectangles)).reshape(-1, 5, 2)
    a, b = ring[:, 1] - ring[:, 0], ring[:, 2] - ring[:, 1]
    along = np.where((np.linalg.norm(a, axis=1) >= np.linalg.norm(b, axis=1))[:, None], a, b)
    yaws = np.mod(np.arctan2(along[:, 1], along[:, 0]) + np.pi / 2, np.pi) - np.pi / 2
    # Its extent from the centres and half a voxel around: corners of voxels stick out of a turned object.
    axes = np.stack([np.stack([np.cos(yaws), np.sin(yaws)], -1), np.stack([-np.sin(yaws), np.cos(yaws)], -1)], axis=1)
    at = np.einsum("vij,vj->vi", axes[region], (keys[:, :2] + 0.5) * size_m)
    low, high = np.minimum.reduceat(at, start) - size_m / 2, np.maximum.reduceat(at, start) + size_m / 2
    is_swapped = (high - low)[:, 0] < (high - low)[:, 1]
    ends = np.stack([low, high], axis=1)
    corners = np.stack([ends[:, (0, 1, 1, 0), 0], ends[:, (0, 0, 1, 1), 1]], axis=-1)
    yaws = np.where(is_swapped, np.mod(yaws + np.pi, np.pi) - np.pi / 2, yaws)
    return corners @ axes, -np.sort(low - high, axis=1), yaws
