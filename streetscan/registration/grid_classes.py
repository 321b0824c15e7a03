"""Four classes of the points of one frame, from a 2-D grid over the horizontal plane.

Source: Józsa & Benedek (2013), 5.1.1 (inventory J-08..J-13), foot of walls 7.1 (J-20), elevation map 8.3 (J-37).

A frame is in frame `lidar` with z up; heights here are above the road plane `z = -sensor_height_m` under the vehicle, so one
set of thresholds serves every mounting. The report gives them in centimetres about a sensor "at about 2 metres":

| rule   | formula                 | words                     | here                                                     |
|--------|-------------------------|---------------------------|----------------------------------------------------------|
| sparse | fewer than 4-8 points   | the same                  | `min_points`                                             |
| tall   | max < 140 or range > 310| "larger", sensor plus 120 | top > `tall_top_m` or range > `tall_extent_m`            |
| ground | range < 25, max < -50   | max below -100            | range < `ground_extent_m` and top < `ground_top_m`       |
| object | the rest                | the rest                  | the rest                                                 |

ASSUME (X-11): the `<` of formula 2 is a misprint, the words say "larger". 140 and 120 above the sensor are 3.4 and 3.2 m above the
road, -50 and -100 are 1.5 and 1.0 m. An HDL-64E looks up by 2 degrees only: nothing nearer than 30 m reaches 3.2 m, so with the
report's figures the walls beside the car are never tall. `SETTINGS_OF_THE_REPORT` keeps the words' figures; the default lowers the
two tall thresholds to what this sensor can see of a wall from 10 m away, and follows the words for the ground. On a street that
climbs by 8 % the road itself is 2.2 m "high" 28 m ahead, so the default measures heights from a ground that follows the street.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numba import njit

from streetscan.errors import BadInput

SPARSE, GROUND, SHORT_OBJECT, TALL_STRUCTURE = range(4)
NAMES = ("sparse", "ground", "short_object", "tall_structure")
COLOURS = np.array([(60, 90, 200), (150, 150, 150), (220, 60, 40), (222, 184, 135)], np.uint8)


@dataclass(frozen=True)
class GridSettings:
    """Thresholds of the grid; lengths in metres, heights above the road under the vehicle.

    Attributes:
        cell_m: edge of a cell (report: 0.5-0.8).
        min_points: a cell with fewer points is sparse (report: 4-8, larger at slower rotation).
        tall_top_m: a cell whose highest point is above this is tall structure.
        tall_extent_m: a cell whose highest and lowest points are farther apart is tall structure.
        ground_extent_m: a flatter cell may be ground (report: 0.25, 22.6 degrees at 0.6 m).
        ground_top_m: ... when its highest point is below this.
        max_range_m: half the edge of the square the grid covers; points outside are sparse.
        max_depth_m: points deeper below the road are echoes of mirrors and water, and sparse.
        max_slope: heights are measured from a ground that rises or falls by at most this (rise per metre) away from the vehicle;
            0 measures them from the plane under the vehicle, as the report does.
    """

    cell_m: float = 0.6
    min_points: int = 4
    tall_top_m: float = 2.0
    tall_extent_m: float = 2.0
    ground_extent_m: float = 0.25
    ground_top_m: float = 1.0
    max_range_m: float = 120.0
    max_depth_m: float = 6.0
    max_slope: float = 0.1

    def __post_init__(self):
        for name in ("cell_m", "min_points", "tall_extent_m", "ground_extent_m", "max_range_m"):
            if not getattr(self, name) > 0:
                raise BadInput(f"segment_frames.{name}", f"{getattr(self, name)} is not above 0", "give a positive number")
        if self.ground_top_m >= self.tall_top_m:
            raise BadInput(
                "segment_frames.ground_top_m", f"{self.ground_top_m} is not below tall_top_m", "ground must end below tall structure"
            )


SETTINGS_OF_THE_REPORT = GridSettings(tall_top_m=3.2, tall_extent_m=3.1, max_slope=0.0)
# ASSUME: the street's course in height shows at 5 m; finer patches would follow parked cars. A kerb, a sidewalk or the roll of the
# vehicle is no slope: only what the ground rises or falls beyond this is taken off.
_PATCH_M, _LEVEL_M = 5.0, 0.4


@dataclass
class GridClasses:
    """A classified frame.

    Attributes:
        labels: (N,) uint8 class of each point (SPARSE, GROUND, SHORT_OBJECT, TALL_STRUCTURE).
        cell_of_point: (N,) int32 flat index into the cells, -1 outside the grid.
        counts: (C, C) int32 points per cell, first axis x (forward), second y (left); cell (0, 0) starts at -half_m.
        z_min_m, z_max_m, z_mean_m: (C, C) float32, frame `lidar`; NaN in empty cells.
        cell_labels: (C, C) uint8.
        cell_m: edge of a cell.
        half_m: half the edge of the grid.
    """

    labels: np.ndarray
    cell_of_point: np.ndarray
    counts: np.ndarray
    z_min_m: np.ndarray
    z_max_m: np.ndarray
    z_mean_m: np.ndarray
    cell_labels: np.ndarray
    cell_m: float
    half_m: float


def classify_points(points: np.ndarray, sensor_height_m: float, settings: GridSettings = GridSettings()) -> GridClasses:
    """Classes of the points of one frame by the statistics of their cells.

    Args:
        points: (N, 3) float32 or float64, metres, frame `lidar`, z up; NaN points are sparse.
        sensor_height_m: height of the sensor above the road (KITTI 1.73, the report about 2).
        settings: thresholds.
    Returns:
        the classes and the cells they come from. An empty frame gives empty labels.
    Raises:
        BadInput: points are not (N, 3), or the sensor is not above the road.
    Source: Józsa & Benedek (2013), 5.1, 5.1.1, equations 2 and 3; order sparse, tall, ground, rest.
    """
    points = np.asarray(points)
    if points.ndim != 2 or points.shape[1] != 3:
        raise BadInput("the frame's points", f"shape {points.shape}", "give an (N, 3) array")
    if not sensor_height_m > 0:
        raise BadInput("sensor_height_m", f"{sensor_height_m} is not above 0", "give the sensor's height above the road in metres")
    n_side = int(np.ceil(2 * settings.max_range_m / settings.cell_m))
    half_m = n_side * settings.cell_m / 2
    floor_z = -sensor_height_m - settings.max_depth_m
    cell_of_point, counts, z_min, z_max, z_sum = _collect(points, half_m, settings.cell_m, n_side, floor_z)
    n_patch = max(round(_PATCH_M / settings.cell_m), 1)
    rise = follow_ground(counts, z_min, n_side, n_patch, settings.min_points, settings.max_slope, settings.cell_m, -sensor_height_m)
    cell_labels = _classify(
        counts,
        z_min,
        z_max,
        rise,
        n_side,
        n_patch,
        settings.min_points,
        np.float32(settings.tall_top_m - sensor_height_m),
        np.float32(settings.tall_extent_m),
        np.float32(settings.ground_top_m - sensor_height_m),
        np.float32(settings.ground_extent_m),
    )
    labels = _spread(cell_labels, cell_of_point)
    with np.errstate(invalid="ignore"):
        z_mean = (z_sum / counts).astype(np.float32)
    shape = (n_side, n_side)
    tables = (a.reshape(shape) for a in (counts, z_min, z_max, z_mean, cell_labels))
    return GridClasses(labels, cell_of_point, *tables, settings.cell_m, half_m)


@njit(cache=True, nogil=True)
def _collect(points, half_m, cell_m, n_side, floor_z):
    n_cells = n_side * n_side
    counts = np.zeros(n_cells, np.int32)
    z_min = np.full(n_cells, np.nan, np.float32)
    z_max = np.full(n_cells, np.nan, np.float32)
    z_sum = np.zeros(n_cells, np.float64)
    cell_of_point = np.empty(len(points), np.int32)
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        cell_of_point[i] = -1
        # Written so that NaN fails too.
        if not (x >= -half_m and x < half_m and y >= -half_m and y < half_m and z > floor_z and z < np.inf):
            continue
        column, row = int((x + half_m) / cell_m), int((y + half_m) / cell_m)
        if column >= n_side or row >= n_side:
            continue
        cell = column * n_side + row
        cell_of_point[i] = cell
        if counts[cell] == 0:
            z_min[cell] = z
            z_max[cell] = z
        elif z < z_min[cell]:
            z_min[cell] = z
        elif z > z_max[cell]:
            z_max[cell] = z
        counts[cell] += 1
        z_sum[cell] += z
    return cell_of_point, counts, z_min, z_max, z_sum


@njit(cache=True, nogil=True)
def follow_ground(counts, z_min, n_side, n_patch, min_points, max_slope, cell_m, road_z):
    """Height of the ground over the road plane per patch, walked outwards from the vehicle ring by ring."""
    n = (n_side + n_patch - 1) // n_patch
    rise = np.zeros((n, n))
    if max_slope <= 0:
        return rise
    low = np.full((n, n), np.inf)
    for c in range(n_side):
        for r in range(n_side):
            cell = c * n_side + r
            if counts[cell] >= min_points and z_min[cell] - road_z < low[c // n_patch, r // n_patch]:
                low[c // n_patch, r // n_patch] = z_min[cell] - road_z
    middle = (n_side // 2) // n_patch
    step = n_patch * cell_m
    for ring in range(1, n):
        for i in range(max(middle - ring, 0), min(middle + ring, n - 1) + 1):
            for j in range(max(middle - ring, 0), min(middle + ring, n - 1) + 1):
                if max(abs(i - middle), abs(j - middle)) != ring:
                    continue
                # The patches of the ring inside that touch this one, and how far the ground may have changed since.
                total, number, nearest = 0.0, 0, np.inf
                for a in range(max(i - 1, 0), min(i + 1, n - 1) + 1):
                    for b in range(max(j - 1, 0), min(j + 1, n - 1) + 1):
                        if max(abs(a - middle), abs(b - middle)) == ring - 1:
                            total += rise[a, b]
                            number += 1
                            nearest = min(nearest, abs(low[i, j] - rise[a, b]))
                # ASSUME: a lowest point that the slope cannot explain is no ground (a roof, an echo); the level is kept.
                rise[i, j] = low[i, j] if nearest <= max_slope * step + 0.1 else total / number
    return rise


@njit(cache=True, nogil=True)
def _classify(counts, z_min, z_max, rise, n_side, n_patch, min_points, tall_top, tall_extent, ground_top, ground_extent):
    labels = np.zeros(len(counts), np.uint8)
    for i in range(len(counts)):
        if counts[i] < min_points:
            continue
        extent = z_max[i] - z_min[i]
        ground = rise[(i // n_side) // n_patch, (i % n_side) // n_patch]
        top = z_max[i] - ground + min(max(ground, -_LEVEL_M), _LEVEL_M)
        if top > tall_top or extent > tall_extent:
            labels[i] = TALL_STRUCTURE
        elif extent < ground_extent and top < ground_top:
            labels[i] = GROUND
        else:
            labels[i] = SHORT_OBJECT
    return labels


@njit(cache=True, nogil=True)
def _spread(cell_labels, cell_of_point):
    labels = np.zeros(len(cell_of_point), np.uint8)
    for i in range(len(cell_of_point)):
        if cell_of_point[i] >= 0:
            labels[i] = cell_labels[cell_of_point[i]]
    return labels


def elevation_raster(classes: GridClasses, n_filled_cells: int = 3) -> np.ndarray:
    """Height of the ground per cell: of the ground cells, and carried on into the cells beside them.

    Args:
        classes: a classified frame.
        n_filled_cells: how many cells far a hole (under a car, at a wall) is filled from its neighbours.
    Returns:
        (C, C) float32, metres, frame `lidar`; NaN where no ground is near.
    Source: Józsa & Benedek (2013), 8.3 (J-37).
    """
    heights = np.where(classes.cell_labels == GROUND, classes.z_mean_m, np.float32(np.nan))
    return _fill(heights, n_filled_cells)


@njit(cache=True, nogil=True)
def _fill(heights, n_steps):
    n, m = heights.shape
    for _ in range(n_steps):
        before = heights.copy()
        for i in range(n):
            for j in range(m):
                if not np.isnan(before[i, j]):
                    continue
                total, number = 0.0, 0
                for a in range(max(i - 1, 0), min(i + 2, n)):
                    for b in range(max(j - 1, 0), min(j + 2, m)):
                        if not np.isnan(before[a, b]):
                            total += before[a, b]
                            number += 1
                if number:
                    heights[i, j] = total / number
    return heights


FOOT_METHODS = ("none", "cut", "reclassify")
# ASSUME: ground more than three cells (1.8 m) away is another surface.
_FOOT_REACH_CELLS = 3


def correct_feet(points: np.ndarray, classes: GridClasses, method: str = "reclassify", foot_m: float = 0.1) -> np.ndarray:
    """Labels without the patch of road that a wall's or a car's cell holds at its foot.

    Args:
        points: (N, 3) the frame.
        classes: its classes.
        method: `none`; `cut` takes the lowest `foot_m` of each object cell out (sparse), as the report did; `reclassify` gives the
            points less than `foot_m` above the ground beside the cell to the ground, as the report wished.
        foot_m: see method.
    Returns:
        (N,) uint8 labels.
    Raises:
        BadInput: no such method.
    Source: Józsa & Benedek (2013), 7.1 (J-20).
    """
    if method not in FOOT_METHODS:
        raise BadInput("segment_frames.foot_method", f"'{method}'", f"choose one of {', '.join(FOOT_METHODS)}")
    labels = classes.labels.copy()
    if method == "none" or len(labels) == 0:
        return labels
    cut = method == "cut"
    bottoms = classes.z_min_m.ravel() if cut else _ground_beside(classes.cell_labels, classes.z_mean_m, _FOOT_REACH_CELLS)
    _relabel_feet(np.asarray(points), labels, classes.cell_of_point, bottoms, foot_m, SPARSE if cut else GROUND)
    return labels


@njit(cache=True, nogil=True)
def _ground_beside(cell_labels, z_mean, reach):
    """Per object cell the mean height of the nearest ring of ground cells; NaN where there is none within reach, and elsewhere."""
    n, m = cell_labels.shape
    heights = np.full(n * m, np.nan, np.float32)
    for i in range(n):
        for j in range(m):
            if cell_labels[i, j] != SHORT_OBJECT and cell_labels[i, j] != TALL_STRUCTURE:
                continue
            for ring in range(1, reach + 1):
                total, number = 0.0, 0
                for a in range(max(i - ring, 0), min(i + ring, n - 1) + 1):
                    # Only the ring's own cells: whole rows at its ends, two cells in between.
                    step = 1 if abs(a - i) == ring else 2 * ring
                    for b in range(j - ring, j + ring + 1, step):
                        if b >= 0 and b < m and cell_labels[a, b] == GROUND:
                            total += z_mean[a, b]
                            number += 1
                if number:
                    heights[i * m + j] = total / number
                    break
    return heights


@njit(cache=True, nogil=True)
def _relabel_feet(points, labels, cell_of_point, bottoms, foot_m, label):
    for p in range(len(labels)):
        # A comparison with NaN (no ground near) is false.
        if (labels[p] == SHORT_OBJECT or labels[p] == TALL_STRUCTURE) and points[p, 2] < bottoms[cell_of_point[p]] + foot_m:
            labels[p] = label


def segment_frame(
    points: np.ndarray,
    sensor_height_m: float,
    settings: GridSettings = GridSettings(),
    foot_method: str = "reclassify",
    foot_m: float = 0.1,
    outlier_neighbours: int = 0,
) -> np.ndarray:
    """(N,) uint8 classes of a frame with the corrections: `classify_points`, then `correct_feet`; outliers (`find_outliers`) are sparse.

    Args and errors as there; `outlier_neighbours` 0 leaves outliers alone.
    """
    classes = classify_points(points, sensor_height_m, settings)
    labels = correct_feet(points, classes, foot_method, foot_m)
    if outlier_neighbours:
        finite = np.flatnonzero(np.isfinite(points).all(axis=1))
        labels[finite[find_outliers(points[finite], outlier_neighbours)]] = SPARSE
    return labels


def count_classes(labels: np.ndarray) -> np.ndarray:
    """(4,) points per class."""
    return np.bincount(labels, minlength=len(NAMES))


def classes_of_names(names: Iterable[str], where: str) -> tuple[int, ...]:
    """Class numbers of names; BadInput for a name that is none."""
    names = tuple(names)
    for name in names:
        if name not in NAMES:
            raise BadInput(where, f"'{name}'", f"choose among {', '.join(NAMES)}")
    return tuple(NAMES.index(name) for name in names)


def find_outliers(points: np.ndarray, n_neighbours: int = 20, deviation_ratio: float = 2.0) -> np.ndarray:
    """(N,) bool: points whose mean distance to their neighbours is far above the frame's average.

    Args:
        points: (N, 3) metres, without NaN.
        n_neighbours: neighbours looked at.
        deviation_ratio: in standard deviations of the mean distances.
    Source: Rusu & Cousins (2011), the statistical outlier removal of Józsa & Benedek (2013), 8.1.1 and option -o (J-30, J-32).
    """
    is_outlier = np.ones(len(points), np.bool_)
    if len(points):
        _, kept = _open3d_cloud(points).remove_statistical_outlier(n_neighbours, deviation_ratio)
        is_outlier[np.asarray(kept, np.int64)] = False
    return is_outlier


def estimate_normals(points: np.ndarray, n_neighbours: int = 20) -> np.ndarray:
    """(N, 3) float32 unit normals, towards the sensor, from the nearest neighbours (option -n, J-32); no NaN among the points."""
    import open3d as o3d

    cloud = _open3d_cloud(points)
    if len(points):
        cloud.estimate_normals(o3d.geometry.KDTreeSearchParamKNN(n_neighbours))
        cloud.orient_normals_towards_camera_location(np.zeros(3))
    return np.asarray(cloud.normals, np.float32).reshape(-1, 3)


def _open3d_cloud(points: np.ndarray):
    # Seconds to load, for options only.
    import open3d as o3d

    return o3d.geometry.PointCloud(o3d.utility.Vector3dVector(np.asarray(points, np.float64).reshape(-1, 3)))
