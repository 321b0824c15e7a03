"""Objects of one sparse frame: blobs of cells above the ground.

Source: Nagy (2020), 3.3.2.2 (N-110, N-111): region growing on the 2-D cells, empty cells stop it; the blobs get no class.

ASSUME: a blob is described up to a height that a sensor on a car sees at every distance; landmarks are cut at the same height. Uncut,
the crown of a tree would join the blobs below it, and the top of a post would be wherever the sensor's view ends.

ASSUME: regions do not grow through cells that hold nothing but low points: kerbs and grass would join what stands on them.
"""

from dataclasses import dataclass

import numpy as np
from numba import njit

from streetscan.errors import BadInput
from streetscan.localization.ground import FrameGround
from streetscan.localization.keypoints import ObjectSet, describe_objects


@dataclass(frozen=True)
class ObjectSettings:
    """Which blobs are objects; lengths in metres.

    Attributes:
        above_m: points lower above the ground are ground (thesis: 0.1).
        max_height_m: points higher above the ground are left out, here and in landmarks.
        min_top_m: a cell takes part when its highest point is above this.
        min_points: smaller blobs are noise.
        max_size_m: longer blobs are walls and hedges, which hold no landmark.
    """

    above_m: float = 0.1
    max_height_m: float = 2.5
    min_top_m: float = 0.3
    min_points: int = 8
    max_size_m: float = 8.0

    def __post_init__(self):
        if not 0 < self.above_m < self.min_top_m < self.max_height_m:
            found = f"above_m {self.above_m}, min_top_m {self.min_top_m}, max_height_m {self.max_height_m}"
            raise BadInput("objects", found, "let 0 < above_m < min_top_m < max_height_m")


@dataclass
class FrameObjects:
    """Blobs of a frame.

    Attributes:
        objects: boxes and keypoints of M blobs, frame `lidar` unless turned.
        points: (N, 3) float64 their points, grouped by blob.
        starts: (M + 1,) int64 first row of each blob, and N.
        rows: (N,) int64 rows of the points in the frame.
    """

    objects: ObjectSet
    points: np.ndarray
    starts: np.ndarray
    rows: np.ndarray

    def __len__(self) -> int:
        return len(self.objects)


def find_objects(ground: FrameGround, settings: ObjectSettings = ObjectSettings(), T_level_lidar: np.ndarray | None = None) -> FrameObjects:
    """The blobs of a frame.

    Args:
        ground: of `find_ground`.
        settings: see ObjectSettings.
        T_level_lidar: (4, 4) describe them in this frame instead of `lidar`.
    """
    s = settings
    region, n_regions = _grow(ground.cell_of_point, ground.heights_m, ground.n_side, s.above_m, s.max_height_m, s.min_top_m)
    order, starts = _group(region, ground.points, n_regions, s.min_points, s.max_size_m)
    points = ground.points[order].astype(np.float64)
    if T_level_lidar is not None:
        points = points @ T_level_lidar[:3, :3].T + T_level_lidar[:3, 3]
    return FrameObjects(describe_objects(points, starts), points, starts, ground.rows[order])


@njit(cache=True, nogil=True)
def _grow(cell_of_point, heights, n_side, above_m, max_height, min_top):
    """Region number of each point, -1 outside; regions are sets of touching cells (8 neighbours)."""
    n_cells = n_side * n_side
    top = np.zeros(n_cells, np.float32)
    for i in range(len(heights)):
        if heights[i] > above_m and heights[i] < max_height and heights[i] > top[cell_of_point[i]]:
            top[cell_of_point[i]] = heights[i]
    number = np.full(n_cells, -1, np.int32)
    stack = np.empty(n_cells, np.int32)
    n_regions = 0
    for seed in range(n_cells):
        if top[seed] < min_top or number[seed] >= 0:
            continue
        number[seed] = n_regions
        stack[0], n_stack = seed, 1
        while n_stack:
            n_stack -= 1
            i, j = stack[n_stack] // n_side, stack[n_stack] % n_side
            for a in range(max(i - 1, 0), min(i + 2, n_side)):
                for b in range(max(j - 1, 0), min(j + 2, n_side)):
                    cell = a * n_side + b
                    if top[cell] >= min_top and number[cell] < 0:
                        number[cell] = n_regions
                        stack[n_stack] = cell
                        n_stack += 1
        n_regions += 1
    region = np.full(len(heights), -1, np.int32)
    for i in range(len(heights)):
        if heights[i] > above_m and heights[i] < max_height:
            region[i] = number[cell_of_point[i]]
    return region, n_regions


@njit(cache=True, nogil=True)
def _group(region, points, n_regions, min_points, max_size):
    """Rows of the points of the regions that are objects, grouped, and where each begins."""
    counts, bounds = np.zeros(n_regions, np.int64), np.empty((n_regions, 4), np.float32)
    bounds[:, :2], bounds[:, 2:] = np.inf, -np.inf
    for i in range(len(region)):
        r = region[i]
        if r < 0:
            continue
        counts[r] += 1
        for a in range(2):
            bounds[r, a], bounds[r, 2 + a] = min(bounds[r, a], points[i, a]), max(bounds[r, 2 + a], points[i, a])
    next_row, n_kept, n = np.full(n_regions, -1, np.int64), 0, 0
    starts = np.empty(n_regions + 1, np.int64)
    for r in range(n_regions):
        if counts[r] >= min_points and np.hypot(bounds[r, 2] - bounds[r, 0], bounds[r, 3] - bounds[r, 1]) <= max_size:
            starts[n_kept], next_row[r] = n, n
            n_kept += 1
            n += counts[r]
    starts[n_kept] = n
    order = np.empty(n, np.int64)
    for i in range(len(region)):
        r = region[i]
        if r >= 0 and next_row[r] >= 0:
            order[next_row[r]] = i
            next_row[r] += 1
    return order, starts[: n_kept + 1].copy()
