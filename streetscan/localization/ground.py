"""Ground of one sparse frame, in cells.

Source: Nagy (2020), 3.3.2 and 3.3.2.1 (N-106..N-109): 30 m around the sensor, 0.2 m cells, ground candidates where the heights in a cell
differ by less than 0.1 m, their mean heights, a median filter against flat car roofs, interpolation elsewhere, 0.1 m above it is no ground.

ASSUME: a car roof fills more cells than a median of neighbours can outvote, and far away a wall is hit by a single ring, which makes its
cells flat. So a coarse ground, a plane around the vehicle and how the street departs from it, is followed outwards first, and
candidates away from it are dropped before the median.
"""

from dataclasses import dataclass

import numpy as np
from numba import njit

from streetscan.errors import BadInput
from streetscan.registration.grid_classes import follow_ground


@dataclass(frozen=True)
class GroundSettings:
    """How the ground of a frame is found; lengths in metres.

    Attributes:
        range_m: horizontal distance within which points are used (thesis: 30).
        min_range_m: nearer points are the vehicle's own.
        cell_m: edge of a cell (thesis: 0.2).
        flat_m: a cell whose heights differ by less is a ground candidate (thesis: 0.1).
        above_m: a point this much above the ground is no ground (thesis: tau = 0.1).
        max_slope: by which the street may depart from the plane around the vehicle, rise over run.
        max_deviation_m: a candidate farther from the coarse ground is none.
    """

    range_m: float = 30.0
    min_range_m: float = 2.0
    cell_m: float = 0.2
    flat_m: float = 0.1
    above_m: float = 0.1
    max_slope: float = 0.15
    max_deviation_m: float = 0.3

    def __post_init__(self):
        if not 0 <= self.min_range_m < self.range_m:
            raise BadInput("ground.min_range_m", f"{self.min_range_m} is not below range_m", "give a distance below range_m")
        for name in ("cell_m", "flat_m", "above_m", "max_slope", "max_deviation_m"):
            if not getattr(self, name) > 0:
                raise BadInput(f"ground.{name}", f"{getattr(self, name)} is not above 0", "give a positive number")


# Edge of a patch of the coarse ground, in cells: 2 m hold several rings and no whole car.
_PATCH_CELLS = 10
# The road is looked for within this distance first.
_ROAD_RANGE_M = 12.0
# The plane under the vehicle is fitted to the ground within this distance.
_PLANE_RANGE_M = 15.0
# Fewer ground cells do not make a plane.
_MIN_PLANE_CELLS = 50


@dataclass
class FrameGround:
    """The points of a frame within range, and the ground below them.

    Attributes:
        points: (N, 3) float32, metres, frame `lidar`.
        rows: (N,) int64 their rows in the frame.
        cell_of_point: (N,) int32 flat index of the cell, row by row of x.
        heights_m: (N,) float32 above the ground.
        n_side: cells along an edge.
        elevation_m: (n_side, n_side) float32 height of the ground, frame `lidar`; defined everywhere.
        is_ground_cell: (n_side, n_side) bool, where it was measured.
        plane: (3,) float64: z = a x + b y + c of the ground around the vehicle; NaN without ground.
        n_plane_cells: cells the plane was fitted to.
    """

    points: np.ndarray
    rows: np.ndarray
    cell_of_point: np.ndarray
    heights_m: np.ndarray
    n_side: int
    elevation_m: np.ndarray
    is_ground_cell: np.ndarray
    plane: np.ndarray
    n_plane_cells: int

    @property
    def has_plane(self) -> bool:
        return bool(np.isfinite(self.plane).all())


def find_ground(points: np.ndarray, settings: GroundSettings = GroundSettings()) -> FrameGround:
    """The ground of a frame.

    Args:
        points: (N, 3) float, metres, frame `lidar`, z about upwards; NaN points are left out.
        settings: see GroundSettings.
    Returns:
        points within range with their height above the ground; without a single one, empty arrays and a NaN plane.
    Raises:
        BadInput: not (N, 3).
    """
    points = np.asarray(points, np.float32)
    if points.ndim != 2 or points.shape[1] != 3:
        raise BadInput("the frame's points", f"shape {points.shape}", "give an (N, 3) array")
    s = settings
    n_side = 2 * int(np.ceil(s.range_m / s.cell_m))
    rows, cells, counts, low, high, total = _collect(points, s.min_range_m, s.range_m, s.cell_m, n_side)
    near = points[rows]
    road = _road_plane(counts, low, high, total, s.flat_m, n_side, s.cell_m)
    if not np.isfinite(road).all():
        nothing = np.zeros((n_side, n_side), np.float32)
        heights = np.full(len(near), np.nan, np.float32)
        return FrameGround(near, rows, cells, heights, n_side, nothing, nothing > 0, np.full(3, np.nan), 0)
    over_road = _subtract_plane(low, road, n_side, s.cell_m)
    rise = follow_ground(counts, over_road, n_side, _PATCH_CELLS, 1, s.max_slope, s.cell_m, road[2])
    elevation, is_ground = _elevate(counts, low, high, total, rise, road, n_side, s.cell_m, s.flat_m, s.max_deviation_m)
    plane, n_plane = _fit_plane(elevation, is_ground, n_side, s.cell_m)
    heights = near[:, 2] - elevation[cells]
    shape = (n_side, n_side)
    return FrameGround(near, rows, cells, heights, n_side, elevation.reshape(shape), is_ground.reshape(shape), plane, n_plane)


@njit(cache=True, nogil=True)
def has_finite(points: np.ndarray) -> bool:
    """Whether any of the points (N, 3) has finite coordinates; stops at the first."""
    i = 0
    while i < len(points) and not (np.isfinite(points[i, 0]) and np.isfinite(points[i, 1]) and np.isfinite(points[i, 2])):
        i += 1
    return i < len(points)


@njit(cache=True, nogil=True)
def _collect(points, min_range, max_range, cell_m, n_side):
    n_cells = n_side * n_side
    counts = np.zeros(n_cells, np.int32)
    low, high, total = np.full(n_cells, np.inf, np.float32), np.full(n_cells, -np.inf, np.float32), np.zeros(n_cells, np.float32)
    rows, cells = np.empty(len(points), np.int64), np.empty(len(points), np.int32)
    half, n = n_side * cell_m / 2, 0
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        r2 = x * x + y * y
        # Written so that NaN fails.
        if not (r2 >= min_range * min_range and r2 < max_range * max_range and abs(z) < 100.0):
            continue
        cell = int((x + half) / cell_m) * n_side + int((y + half) / cell_m)
        rows[n], cells[n] = i, cell
        n += 1
        counts[cell] += 1
        low[cell], high[cell] = min(low[cell], z), max(high[cell], z)
        total[cell] += z
    return rows[:n].copy(), cells[:n].copy(), counts, low, high, total


@njit(cache=True, nogil=True)
def _road_plane(counts, low, high, total, flat_m, n_side, cell_m):
    """Plane (3,) z = a x + b y + c of the road around the vehicle, from the low end of the flat cells of each patch; NaN without any."""
    n = int(2 * _ROAD_RANGE_M / cell_m / _PATCH_CELLS)
    first = n_side // 2 - n * _PATCH_CELLS // 2
    x, y, z = np.empty(n * n), np.empty(n * n), np.empty(n * n)
    heights = np.empty(_PATCH_CELLS * _PATCH_CELLS, np.float32)
    n_patches, n_flat = 0, 0
    for p in range(n):
        for q in range(n):
            k = 0
            for i in range(max(first + p * _PATCH_CELLS, 0), min(first + (p + 1) * _PATCH_CELLS, n_side)):
                for j in range(max(first + q * _PATCH_CELLS, 0), min(first + (q + 1) * _PATCH_CELLS, n_side)):
                    cell = i * n_side + j
                    if counts[cell] >= 2 and high[cell] - low[cell] < flat_m:
                        heights[k] = total[cell] / counts[cell]
                        k += 1
            n_flat += k
            if k >= 3:
                x[n_patches] = (first + (p + 0.5) * _PATCH_CELLS - n_side / 2) * cell_m
                y[n_patches] = (first + (q + 0.5) * _PATCH_CELLS - n_side / 2) * cell_m
                z[n_patches] = np.sort(heights[:k])[k // 4]
                n_patches += 1
    plane = np.full(3, np.nan)
    if n_patches < 3 or n_flat < 20:
        return plane
    # ASSUME: the road is the lowest large thing around. Patches above the plane lose their weight from fit to fit (cars, beds), as do
    # those far below it (false echoes).
    weights = np.ones(n_patches)
    for iteration in range(10):
        normal, right = 1e-9 * np.eye(3), np.zeros(3)
        for k in range(n_patches):
            row = np.array([x[k], y[k], 1.0])
            for a in range(3):
                right[a] += weights[k] * row[a] * z[k]
                for b in range(3):
                    normal[a, b] += weights[k] * row[a] * row[b]
        # A road is no wall: the slope is held back, a little when there are many patches and wholly when there are none.
        normal[0, 0] += 20.0
        normal[1, 1] += 20.0
        plane = np.linalg.solve(normal, right)
        scale = 0.4 if iteration < 3 else 0.12
        for k in range(n_patches):
            above = z[k] - plane[0] * x[k] - plane[1] * y[k] - plane[2]
            weights[k] = 1 / (1 + (above / scale) ** 2) if above > 0 else 1 / (1 + (above / (3 * scale)) ** 4)
    return plane


@njit(cache=True, nogil=True)
def _subtract_plane(low, plane, n_side, cell_m):
    """Lowest heights over the plane's slope: what `follow_ground` has to follow is only how the street departs from it."""
    left = np.empty_like(low)
    for i in range(n_side):
        for j in range(n_side):
            slope = plane[0] * (i + 0.5 - n_side / 2) * cell_m + plane[1] * (j + 0.5 - n_side / 2) * cell_m
            left[i * n_side + j] = low[i * n_side + j] - slope
    return left


@njit(cache=True, nogil=True)
def _elevate(counts, low, high, total, rise, road, n_side, cell_m, flat_m, max_deviation):
    """Height of the ground per cell, and where it was measured."""
    n_cells = n_side * n_side
    n_patches = rise.shape[0]
    mean, is_ground = np.empty(n_cells, np.float32), np.zeros(n_cells, np.bool_)
    for cell in range(n_cells):
        if counts[cell] > 0 and high[cell] - low[cell] < flat_m:
            level = total[cell] / counts[cell]
            i, j = cell // n_side, cell % n_side
            expected = road[2] + rise[i // _PATCH_CELLS, j // _PATCH_CELLS]
            expected += road[0] * (i + 0.5 - n_side / 2) * cell_m + road[1] * (j + 0.5 - n_side / 2) * cell_m
            if abs(level - expected) < max_deviation:
                mean[cell], is_ground[cell] = level, True
    # Median over the candidates among 5 x 5 cells.
    elevation = np.full(n_cells, np.nan, np.float32)
    window = np.empty(25, np.float32)
    patch_sum, patch_number = np.zeros((n_patches, n_patches)), np.zeros((n_patches, n_patches))
    for i in range(n_side):
        for j in range(n_side):
            cell = i * n_side + j
            if not is_ground[cell]:
                continue
            n = 0
            for a in range(max(i - 2, 0), min(i + 3, n_side)):
                for b in range(max(j - 2, 0), min(j + 3, n_side)):
                    if is_ground[a * n_side + b]:
                        # Insertion sort: the window is tiny and nearly sorted.
                        value, k = mean[a * n_side + b], n
                        while k > 0 and window[k - 1] > value:
                            window[k] = window[k - 1]
                            k -= 1
                        window[k] = value
                        n += 1
            elevation[cell] = window[n // 2]
            patch_sum[i // _PATCH_CELLS, j // _PATCH_CELLS] += elevation[cell]
            patch_number[i // _PATCH_CELLS, j // _PATCH_CELLS] += 1
    # Elsewhere: between the means of the patches around; a patch without ground takes the coarse one.
    level = np.empty((n_patches, n_patches))
    for p in range(n_patches):
        for q in range(n_patches):
            if patch_number[p, q] > 0:
                level[p, q] = patch_sum[p, q] / patch_number[p, q]
            else:
                x, y = ((p + 0.5) * _PATCH_CELLS - n_side / 2) * cell_m, ((q + 0.5) * _PATCH_CELLS - n_side / 2) * cell_m
                level[p, q] = road[2] + rise[p, q] + road[0] * x + road[1] * y
    for i in range(n_side):
        for j in range(n_side):
            cell = i * n_side + j
            if is_ground[cell]:
                continue
            u = min(max((i + 0.5) / _PATCH_CELLS - 0.5, 0.0), n_patches - 1.0)
            v = min(max((j + 0.5) / _PATCH_CELLS - 0.5, 0.0), n_patches - 1.0)
            p, q = min(int(u), n_patches - 2), min(int(v), n_patches - 2)
            u, v = u - p, v - q
            elevation[cell] = (1 - u) * ((1 - v) * level[p, q] + v * level[p, q + 1]) + u * (
                (1 - v) * level[p + 1, q] + v * level[p + 1, q + 1]
            )
    return elevation, is_ground


@njit(cache=True, nogil=True)
def _fit_plane(elevation, is_ground, n_side, cell_m):
    """Plane through the ground cells near the vehicle, fitted twice: kerbs and stray cells are left out the second time."""
    reach = int(_PLANE_RANGE_M / cell_m)
    middle, plane, n = n_side // 2, np.zeros(3), 0
    for trial in range(3):
        normal, right, n = np.zeros((3, 3)), np.zeros(3), 0
        for i in range(max(middle - reach, 0), min(middle + reach, n_side)):
            for j in range(max(middle - reach, 0), min(middle + reach, n_side)):
                if not is_ground[i * n_side + j]:
                    continue
                x, y, z = (i + 0.5 - middle) * cell_m, (j + 0.5 - middle) * cell_m, elevation[i * n_side + j]
                if trial > 0 and abs(z - plane[0] * x - plane[1] * y - plane[2]) > 0.15:
                    continue
                row = np.array([x, y, 1.0])
                for a in range(3):
                    right[a] += row[a] * z
                    for b in range(3):
                        normal[a, b] += row[a] * row[b]
                n += 1
        if n < _MIN_PLANE_CELLS or np.linalg.det(normal / n) < 1e-6:
            return np.full(3, np.nan), n
        plane = np.linalg.solve(normal, right)
    return plane, n
