"""Whether a calibration is to be believed: the thesis' gates, a robust distance, and image edges as a check without truth.

Source: Nagy (2020), 4.4.2 (N-231 to N-234).

ASSUME: the thesis accepts a Hausdorff distance of its clouds below 5 cm. The plain one, the farthest point of all, is metres in any
street, if only for what one sensor sees alone; it is reported, and the gate is the median distance of points on matched objects.
"""

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
    "far_apart": "matched objects are too far from the camera's cloud",
    "edges_disagree": "edges in the image do not lie where the lidar sees them",
    "not_better": "the calibration in force fits at least as well",
}


@dataclass(frozen=True)
class QualitySettings:
    """Gates of a calibration.

    Attributes:
        min_objects: fewer matched objects tell nothing (thesis: more than three).
        max_distance_m: largest median distance of points on matched objects from the camera's planes.
        min_edge_margin_px: by which image edges must lie nearer to the lidar's edges than they do when the calibration is turned.
        edge_turn_deg: by so much.
        max_edge_px: an image edge farther off is none.
    """

    min_objects: int = 4
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
    """How near image edges lie to where the lidar sees depth edges; needs no truth and takes no part in any estimate."""

    def __init__(self, image: np.ndarray, points_lidar: np.ndarray, settings: QualitySettings = QualitySettings()):
        """
        Args:
            image: (H, W, 3) uint8 RGB, rectified.
            points_lidar: (N, 3) raw points of the frame.
            settings: `max_edge_px` and `edge_turn_deg`.
        """
        self._settings = settings
        grey = cv2.GaussianBlur(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), (0, 0), 1.0)
        edges = cv2.Canny(grey, 40, 100)
        self._distance = np.minimum(cv2.distanceTransform(255 - edges, cv2.DIST_L2, 5), settings.max_edge_px)
        self._points = depth_edges(points_lidar)

    @property
    def n_points(self) -> int:
        """Depth edges of the frame."""
        return len(self._points)

    def distance_px(self, projection: np.ndarray) -> float:
        """Mean distance of the lidar's depth edges from the nearest image edge under a projection (3, 4); NaN without any in view."""
        pixels = project_linear(projection, self._points)
        height, width = self._distance.shape
        with np.errstate(invalid="ignore"):
            inside = ((pixels >= 0) & (pixels <= [width - 1, height - 1])).all(axis=1)
        if not inside.any():
            return float("nan")
        u, v = pixels[inside].astype(np.float32).T
        return float(cv2.remap(self._distance, u[None], v[None], cv2.INTER_LINEAR).mean())

    def margin_px(self, projection: np.ndarray, K: np.ndarray) -> float:
        """By how much the mean distance grows when the camera is turned left, right, up and down; negative where a turn makes it smaller.

        The mean over the four turns: about a right calibration it grows in all of them.
        """
        own, angle = self.distance_px(projection), np.radians(self._settings.edge_turn_deg)
        turns = [Rotation.from_rotvec(v).as_matrix() for v in angle * np.array([(0, 1, 0), (0, -1, 0), (1, 0, 0), (-1, 0, 0)])]
        return float(np.mean([self.distance_px(K @ R @ np.linalg.inv(K) @ projection) for R in turns]) - own)


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
