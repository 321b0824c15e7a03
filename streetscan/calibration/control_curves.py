"""Control curves: what is left of local distortion after the rigid alignment, moved bin by bin (T*).

Source: Nagy (2020), 4.3.3, Figs. 4.8 and 4.9 (N-226, N-227). The centroids of the matched objects are the control points of two NURBS
curves, one per cloud. Between neighbouring control points each curve is cut into equal bins; a lidar point belongs to the nearest bin of
the lidar's curve and moves by the way from there to the same bin of the camera's curve.

ASSUME: control points are taken in the order of their azimuth around the lidar, which the thesis leaves open; a curve along the street
would jump from side to side.
ASSUME: a segment lies between the Greville abscissae of its control points, where a B-spline is nearest to them.
ASSUME: weights are those of the control points, so an object with few points bends the curve less.
"""

from dataclasses import dataclass

import numpy as np
from geomdl import NURBS, knotvector
from scipy.spatial import cKDTree


@dataclass
class ControlCurves:
    """Two curves with corresponding bins.

    Attributes:
        control_lidar, control_sfm: (C, 3) control points, frame `sfm`, in the order of the curve.
        bins_lidar, bins_sfm: (B, 3) points of the curves.
    """

    control_lidar: np.ndarray
    control_sfm: np.ndarray
    bins_lidar: np.ndarray
    bins_sfm: np.ndarray

    @property
    def shifts(self) -> np.ndarray:
        """(B, 3) from each lidar bin to its counterpart."""
        return self.bins_sfm - self.bins_lidar

    def move(self, points_sfm: np.ndarray) -> np.ndarray:
        """T*: lidar points (N, 3), already in the frame `sfm`, each moved with its nearest bin."""
        if len(points_sfm) == 0:
            return np.empty((0, 3))
        return points_sfm + self.shifts[cKDTree(self.bins_lidar).query(points_sfm)[1]]


def fit_curves(
    control_lidar: np.ndarray, control_sfm: np.ndarray, weights: np.ndarray, origin_sfm: np.ndarray, up_sfm: np.ndarray, n_bins: int = 10
) -> ControlCurves | None:
    """Curves through matched control points; None with fewer than two.

    Args:
        control_lidar: (C, 3) centroids of lidar objects, moved into the frame `sfm`.
        control_sfm: (C, 3) centroids of their counterparts.
        weights: (C,) positive.
        origin_sfm: (3,) the lidar.
        up_sfm: (3,) upwards, about which azimuths are measured.
        n_bins: of a segment.
    """
    if len(control_lidar) < 2:
        return None
    order = np.argsort(_azimuths(control_lidar - origin_sfm, up_sfm), kind="stable")
    own, theirs, weights = control_lidar[order], control_sfm[order], np.asarray(weights, float)[order]
    parameters = bin_parameters(len(own), n_bins)
    bins = [_evaluate(points, weights / weights.max(), parameters) for points in (own, theirs)]
    return ControlCurves(own, theirs, *bins)


def bin_parameters(n_control: int, n_bins: int) -> np.ndarray:
    """Parameters of the bins' middles: `n_bins` for each of the n_control - 1 segments."""
    degree = _degree(n_control)
    knots = np.array(knotvector.generate(degree, n_control))
    greville = np.array([knots[i + 1 : i + degree + 1].mean() for i in range(n_control)])
    shares = (np.arange(n_bins) + 0.5) / n_bins
    return (greville[:-1, None] + np.diff(greville)[:, None] * shares).ravel()


def _degree(n_control: int) -> int:
    return min(3, n_control - 1)


def _evaluate(control: np.ndarray, weights: np.ndarray, parameters: np.ndarray) -> np.ndarray:
    """Points (B, 3) of the clamped NURBS curve with these control points."""
    curve = NURBS.Curve()
    curve.degree = _degree(len(control))
    # About their mean: coordinates of a rational curve are multiplied by weights and divided again.
    mean = control.mean(axis=0)
    curve.ctrlptsw = np.concatenate([(control - mean) * weights[:, None], weights[:, None]], axis=1).tolist()
    curve.knotvector = knotvector.generate(curve.degree, len(control))
    return np.array(curve.evaluate_list(parameters.tolist())) + mean


def _azimuths(points: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Angles (C,) about an axis, increasing through the widest gap's other side, so that the curve does not close over what is empty."""
    up = up / np.linalg.norm(up)
    first = np.cross(up, np.eye(3)[np.abs(up).argmin()])
    first /= np.linalg.norm(first)
    angles = np.arctan2(points @ np.cross(up, first), points @ first)
    ordered = np.sort(angles)
    gaps = np.diff(np.append(ordered, ordered[0] + 2 * np.pi))
    start = ordered[(gaps.argmax() + 1) % len(ordered)]
    return (angles - start + 1e-12) % (2 * np.pi)
