"""From the pose of the vote to the pose of the points: generalised ICP against what stands still on the map.

Beyond the thesis, which stops at the vote (N-103). ICP always finds some minimum, so its pose is taken only when a measure it did not
minimise gets better: how well the frame lies on the normal distributions of the map, in which a point far from all surfaces
counts nothing instead of much.
"""

from dataclasses import dataclass

import numpy as np
import small_gicp

from streetscan.geometry import rotation_angle
from streetscan.localization.recovery import make_plane_map
from streetscan.localization.reference import MIN_KNOWN, OccupancyGrid, Reference
from streetscan.registration.ndt import NdtField, NdtSettings, thin_points


@dataclass(frozen=True)
class RefinementSettings:
    """How a pose is refined; lengths in metres.

    Attributes:
        thin_m: the frame's points are averaged in cubes of this edge.
        range_m: farther points of the frame are left out.
        max_distance_m: farthest correspondence.
        cube_m: edge of the cubes of the overlap.
        coarse_cube_m: ... of the overlap of poses that are not refined yet.
        max_shift_m, max_turn_deg: a pose farther from the vote's is not believed.
    """

    thin_m: float = 0.5
    range_m: float = 40.0
    max_distance_m: float = 1.0
    cube_m: float = 0.2
    coarse_cube_m: float = 0.5
    max_shift_m: float = 1.5
    max_turn_deg: float = 4.0


@dataclass
class Refined:
    """Outcome of a refinement.

    Attributes:
        T_map_lidar: (4, 4) the refined pose, or the given one when that was no worse.
        is_accepted: whether it is the refined one.
        score_before, score: of the given and of the returned pose, 0 to 1.
        covariance: (6, 6) x y z roll pitch yaw (m, rad) of the refined pose; NaN when it was not accepted.
        fit: the score of those points of the frame that lie where the map is; 0 for none.
    """

    T_map_lidar: np.ndarray
    is_accepted: bool
    score_before: float
    score: float
    covariance: np.ndarray
    fit: float = 0.0


# The map is prepared this far around a position, and anew when the vehicle has moved by half of it: a street of kilometres fits.
_CUT_M = 200.0
# Only looked up, never searched.
_SCORE_M, _SCORE = 0.8, NdtSettings(n_neighbours=1)
# Fewer points do not fix a pose.
_MIN_POINTS = 50
# ASSUME: a last step this long leaves a millimetre or two, of centimetres by which maps drift; each step costs as much as the vote.
_STEP_M = 0.003
# ASSUME: neighbouring points share their errors, so each Hessian counts this many times too much; and a map drifts, here by 2.8 cm, 1.2 cm
# in height and 0.04 degrees. Chosen on the city's train and validation streets, where errors then are as large as they are said to be.
_CORRELATED = 30.0
_FLOOR = np.array([0.028, 0.028, 0.012, *np.radians([0.04, 0.04, 0.04])])


class Refiner:
    """Refines poses against one map; keeps the part of it around the vehicle prepared.

    Attributes:
        fine, coarse: cubes near what stands still, after the first `move_to`.
        plane_map: what stands there seen from above, or None.
    """

    def __init__(self, reference: Reference, settings: RefinementSettings = RefinementSettings()):
        self._reference, self._settings = reference, settings
        self._centre = None

    @property
    def range_m(self) -> float:
        """Farther points of a frame are left out."""
        return self._settings.range_m

    def move_to(self, xy: np.ndarray) -> None:
        """Prepare the map around a position (>=2,) relative to the reference's origin; quick when it is prepared already."""
        if self._centre is not None and np.hypot(*(self._centre - xy[:2])) < _CUT_M / 2:
            return
        s = self._settings
        self._centre = np.array(xy[:2], np.float64)
        points = self._reference.cut(xy, _CUT_M)
        self.plane_map = make_plane_map(points, points[:, 2] - self._reference.ground_at(points))
        self.fine, self.coarse = OccupancyGrid(points, s.cube_m), OccupancyGrid(points, s.coarse_cube_m)
        self._field = NdtField(_SCORE_M, _SCORE)
        self._field.add(points)
        self._target = self._tree = None
        if len(points) >= _MIN_POINTS:
            self._target, self._tree = small_gicp.preprocess_points(points, self._reference.static_m, num_neighbors=10, num_threads=1)

    def refine(self, points: np.ndarray, T: np.ndarray, is_gated: bool = True) -> Refined:
        """The pose refined on points.

        Args:
            points: (N, 3) float64, metres, frame `lidar`, freed of motion, without NaN.
            T: (4, 4) T_origin_lidar, relative to the reference's origin.
            is_gated: False takes the refined pose, better or not.
        """
        s = self._settings
        self.move_to(T[:3, 3])
        nothing = np.full((6, 6), np.nan)
        thinned = thin_points(points, s.thin_m)
        before = self._score(thinned, T)
        if len(thinned) < _MIN_POINTS or self._target is None:
            return Refined(T, False, before, before, nothing, self._fit(thinned, T, before))
        source, _ = small_gicp.preprocess_points(thinned, s.thin_m, num_neighbors=10, num_threads=1)
        limits = {"max_correspondence_distance": s.max_distance_m, "translation_epsilon": _STEP_M, "max_iterations": 20}
        result = small_gicp.align(self._target, source, self._tree, T, "GICP", num_threads=1, **limits)
        T_refined = np.array(result.T_target_source)
        u, _, vt = np.linalg.svd(T_refined[:3, :3])
        T_refined[:3, :3] = u @ vt
        after = self._score(thinned, T_refined)
        change = np.linalg.inv(T) @ T_refined
        is_near = np.linalg.norm(change[:3, 3]) <= s.max_shift_m and rotation_angle(change) <= np.radians(s.max_turn_deg)
        if is_gated and not (is_near and after > before):
            return Refined(T, False, before, before, nothing, self._fit(thinned, T, before))
        return Refined(T_refined, True, before, after, covariance_of(result.H, T_refined), self._fit(thinned, T_refined, after))

    def _fit(self, points: np.ndarray, T: np.ndarray, score: float) -> float:
        """The score without the points beyond the map, which add nothing to it."""
        return score / max(self.fine.known_share(points, T), MIN_KNOWN)

    def _score(self, points: np.ndarray, T: np.ndarray) -> float:
        """Mean height of the map's distributions at the points."""
        return self._field.score(points, T)


def covariance_of(hessian: np.ndarray, T: np.ndarray) -> np.ndarray:
    """Covariance (6, 6) in x y z roll pitch yaw, map axes, of a small_gicp Hessian.

    Args:
        hessian: (6, 6) rotation first, of a change applied on the right of T (in the source's frame).
        T: (4, 4) the pose.
    """
    information = hessian / _CORRELATED
    scale = np.sqrt(np.maximum(np.diag(information), 1e-9))
    values, vectors = np.linalg.eigh(information / np.outer(scale, scale))
    covariance = (vectors / np.maximum(values, 1e-6)) @ vectors.T / np.outer(scale, scale)
    # Rotation first to translation first, and from the source's axes to the map's.
    rotation = T[:3, :3]
    turn = np.zeros((6, 6))
    turn[:3, 3:], turn[3:, :3] = rotation, rotation
    covariance = turn @ covariance @ turn.T
    # A rotation vector in the map's axes to roll, pitch, yaw about the fixed axes (R = Rz Ry Rx).
    pitch, yaw = -np.arcsin(np.clip(rotation[2, 0], -1, 1)), np.arctan2(rotation[1, 0], rotation[0, 0])
    axes = np.array([(np.cos(yaw) * np.cos(pitch), -np.sin(yaw), 0), (np.sin(yaw) * np.cos(pitch), np.cos(yaw), 0), (-np.sin(pitch), 0, 1)])
    jacobian = np.eye(6)
    jacobian[3:, 3:] = np.linalg.inv(axes)
    return jacobian @ covariance @ jacobian.T + np.diag(_FLOOR**2)
