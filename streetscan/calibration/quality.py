"""Whether a calibration is to be believed: the thesis' gates, a robust distance, and image edges as a check without truth.

Source: Nagy (2020), 4.4.2 (N-231 to N-234).

ASSUME: the thesis accepts a Hausdorff distance of its clouds below 5 cm. The plain one, the farthest point of all, is metres in any
street, if only for what one sensor sees alone; it is reported, and the gate is the median distance of points on matched objects.
"""

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from streetscan.calibration.alignment import PlaneTarget
from streetscan.calibration.linear_projection import project_linear

# What can be the matter with a keyframe's calibration, beside the statuses of its reconstruction.
STATUSES = {
    "ok": "accepted",
    "no_clouds": "the keyframe has no cloud in metres",
    "no_ground": "one of the clouds shows no ground to lay level",
    "too_few_objects": "too few objects in one of the clouds",
    "no_match": "the clouds lie on each other nowhere",
    "ambiguous": "the clouds lie on each other at two places about as well",
    "not_converged": "ICP does not settle, or wants another scale than the clouds can have",
    "no_projection": "too few points to fit a projection to",
    "uncertain": "the clouds leave open where the lidar is",
    "far_apart": "matched objects are too far from the camera's cloud",
    "edges_disagree": "edges in the image do not lie where the lidar sees them",
    "not_better": "the calibration in force fits at least as well",
}


@dataclass(frozen=True)
class QualitySettings:
    """Gates of a calibration.

    Attributes:
        min_objects: fewer matched objects tell nothing. ASSUME: one, for the distance to be measured on; the thesis' more than three are
            of the scene, and asked before. On the training street keyframes with one and two were right.
        max_sigma_px: largest deviation across the image, on the mean of the points in view, that the clouds leave open.
        max_distance_m: largest median distance of points on matched objects from the camera's planes.
        min_edge_margin_px: by which image edges must lie nearer to the lidar's edges than they do when the calibration is turned.
        edge_turn_deg: by so much.
        max_edge_px: an image edge farther off is none.
    """

    min_objects: int = 1
    max_sigma_px: float = 8.0
    max_distance_m: float = 0.06
    min_edge_margin_px: float = 0.0
    edge_turn_deg: float = 0.5
    max_edge_px: float = 12.0


def plane_distances(points_sfm: np.ndarray, target: PlaneTarget, reach_m: float) -> np.ndarray:
    """Distances (N,) of points from the nearest plane of the camera's cloud; NaN where none is within reach."""
    distances, rows = target.tree.query(points_sfm, distance_upper_bound=reach_m)
    is_found = np.isfinite(distances)
    result = np.full(len(points_sfm), np.nan)
    rows = rows[is_found]
    result[is_found] = np.abs(np.einsum("ij,ij->i", points_sfm[is_found] - target.points[rows], target.normals[rows]))
    return result


def hausdorff_distance(a: np.ndarray, b: np.ndarray) -> float:
    """The plain Hausdorff distance of two clouds (N, 3) and (M, 3); NaN when one is empty."""
    if len(a) == 0 or len(b) == 0:
        return float("nan")
    return float(max(cKDTree(b).query(a)[0].max(), cKDTree(a).query(b)[0].max()))


class EdgeCheck:
    """How near image edges lie to where the lidar sees depth edges; needs no truth.

    The lidar's edges are split into bundles of directions, every other of which is kept for the check (`is_kept`) and takes no part in
    any estimate.

    ASSUME: a lidar's edges are the left and right sides of things, so image edges that run more across than up are left out.
    """

    def __init__(self, image: np.ndarray, points_lidar: np.ndarray, settings: QualitySettings = QualitySettings()):
        """
        Args:
            image: (H, W, 3) uint8 RGB, rectified.
            points_lidar: (N, 3) points of the frame, raw or freed of motion, as the projections that are asked about take them.
            settings: `max_edge_px` and `edge_turn_deg`.
        """
        self._settings = settings
        grey = cv2.GaussianBlur(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), (0, 0), 1.0)
        across, down = (np.abs(cv2.Sobel(grey, cv2.CV_32F, *order)) for order in ((1, 0), (0, 1)))
        edges = np.where(across > down, cv2.Canny(grey, 40, 100), 0).astype(np.uint8)
        self._distance = np.minimum(cv2.distanceTransform(255 - edges, cv2.DIST_L2, 5), settings.max_edge_px)
        self._points = depth_edges(points_lidar)
        bundles = np.floor(np.degrees(np.arctan2(self._points[:, 1], self._points[:, 0])) / _BUNDLE_DEG)
        self._is_kept = bundles % 2 == 1

    @property
    def n_points(self) -> int:
        """Depth edges of the frame."""
        return len(self._points)

    def distance_px(self, projection: np.ndarray, is_kept: bool | None = None) -> float:
        """Mean distance of the lidar's depth edges from the nearest image edge under a projection (3, 4); NaN without any in view.

        `is_kept` takes those kept for the check, or the others alone.
        """
        points = self._points if is_kept is None else self._points[self._is_kept == is_kept]
        pixels = project_linear(projection, points)
        height, width = self._distance.shape
        with np.errstate(invalid="ignore"):
            inside = ((pixels >= 0) & (pixels <= [width - 1, height - 1])).all(axis=1)
        if not inside.any():
            return float("nan")
        u, v = pixels[inside].astype(np.float32).T
        return float(cv2.remap(self._distance, u[None], v[None], cv2.INTER_LINEAR).mean())

    def margin_px(self, projection: np.ndarray, K: np.ndarray) -> float:
        """By how much the mean distance of the kept edges grows when the camera is turned left and right; negative where it shrinks."""
        own, angle = self.distance_px(projection, True), np.radians(self._settings.edge_turn_deg)
        turns = [Rotation.from_rotvec(v).as_matrix() for v in angle * np.array([(0, 1, 0), (0, -1, 0)])]
        return float(np.mean([self.distance_px(K @ R @ np.linalg.inv(K) @ projection, True) for R in turns]) - own)


# Edges are split into bundles of so many degrees of azimuth.
_BUNDLE_DEG = 3.0


def find_bend(check: EdgeCheck, projection_of: Callable[[float], np.ndarray], max_rad: float, step_rad: float) -> float:
    """The error of the way of the camera under which image edges lie nearest to the lidar's, of those not kept for the check.

    Args:
        check: of the frame, freed of motion.
        projection_of: the projection (3, 4) for an error in radians.
        max_rad: largest error to either side.
        step_rad: step of the search.
    Returns:
        the error; 0 where no edge is in view, or edges lie hardly nearer anywhere else.
    """
    errors = np.arange(-round(max_rad / step_rad), round(max_rad / step_rad) + 1) * step_rad
    distances = np.array([check.distance_px(projection_of(e), False) for e in errors])
    if not np.isfinite(distances).all():
        return 0.0
    # ASSUME: of errors alike, the smaller; the mean of five steps, since single edges make the curve jagged.
    smooth = np.convolve(np.pad(distances, 2, mode="edge"), np.full(5, 0.2), mode="valid") + _HELD_PX * (errors / max_rad) ** 2
    k = int(smooth.argmin())
    if smooth[len(errors) // 2] - smooth[k] < _LEAST_GAIN_PX:
        return 0.0
    if not 0 < k < len(errors) - 1:
        return float(errors[k])
    before, here, after = smooth[k - 1 : k + 2]
    return float(errors[k] + step_rad * 0.5 * (before - after) / max(before - 2 * here + after, 1e-9))


# The largest error costs as much as edges that are so much farther off; a smaller gain is none.
_HELD_PX, _LEAST_GAIN_PX = 0.2, 0.1


def depth_edges(points_lidar: np.ndarray, max_range_m: float = 40.0, step_m: float = 0.5) -> np.ndarray:
    """Points (M, 3) on the near side of a step in depth.

    Args:
        points_lidar: (N, 3) of one frame, seen from its origin.
        max_range_m: farther ones are left out.
        step_m: a neighbour in direction that is farther by this and a twentieth of the distance is behind a step.

    ASSUME: neighbours are points to the left and right, within 0.4 degrees of azimuth (columns of a lidar are 0.17 degrees apart) and a
    tenth of a degree of elevation: across the rings of a lidar a road far ahead has steps, too.
    """
    ranges = np.linalg.norm(points_lidar, axis=1)
    seen = ranges > 2.0
    points, ranges = points_lidar[seen], ranges[seen]
    if len(points) == 0:
        return np.empty((0, 3))
    elevations = np.arcsin(points[:, 2] / ranges)
    directions = np.stack([np.arctan2(points[:, 1], points[:, 0]) * np.cos(elevations), 4 * elevations], axis=1)
    near = ranges < max_range_m
    _, rows = cKDTree(directions).query(directions[near], k=9, distance_upper_bound=np.radians(0.4))
    behind = np.append(ranges, 0.0)[rows]
    return points[near][(behind > (1.05 * ranges[near] + step_m)[:, None]).any(axis=1)]
