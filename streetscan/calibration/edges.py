"""Edges of images and of lidar frames: how near they lie to each other under a calibration, and what they say against another."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy.ndimage import uniform_filter1d
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from streetscan.calibration.linear_projection import project_linear
from streetscan.calibration.quality import QualitySettings
from streetscan.geometry import apply, invert


@dataclass(frozen=True)
class Shot:
    """An image and the lidar frame beside it, as far as edges go.

    Attributes:
        distance: (H, W) float32, pixels to the nearest edge of the image.
        edges: (M, 3) depth edges of the lidar frame, frame `lidar` at its stamp.
        T_image_stamp: (4, 4) the lidar at the frame's stamp, seen from where it was when the image was taken.
        T_keyframe_stamp: (4, 4) the same seen from where it was at the keyframe's stamp; tells which edges are of one thing.
    """

    distance: np.ndarray
    edges: np.ndarray
    T_image_stamp: np.ndarray
    T_keyframe_stamp: np.ndarray

    def turned(self, T_turned_lidar: np.ndarray) -> "Shot":
        """The shot of a lidar mounted turned (4, 4)."""
        moves = {name: T_turned_lidar @ getattr(self, name) @ invert(T_turned_lidar) for name in ("T_image_stamp", "T_keyframe_stamp")}
        return replace(self, edges=apply(T_turned_lidar, self.edges), **moves)


_HERE = np.eye(4)


def make_shot(image: np.ndarray, points_lidar: np.ndarray, T_image_stamp: np.ndarray, T_keyframe_stamp: np.ndarray = _HERE) -> Shot:
    """The shot of an image (H, W, 3) uint8 RGB, rectified, and a lidar frame's points (N, 3), raw or freed of motion; see `Shot`.

    ASSUME: a lidar's edges are the left and right sides of things, so image edges that run more across than up are left out.
    """
    grey = cv2.GaussianBlur(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), (0, 0), 1.0)
    across, down = (np.abs(cv2.Sobel(grey, cv2.CV_32F, *order)) for order in ((1, 0), (0, 1)))
    edges = np.where(across > down, cv2.Canny(grey, 40, 100), 0).astype(np.uint8)
    return Shot(cv2.distanceTransform(255 - edges, cv2.DIST_L2, 5), depth_edges(points_lidar), T_image_stamp, T_keyframe_stamp)


_DEFAULT = QualitySettings()


class EdgeCheck:
    """How near image edges lie to where the lidar sees depth edges, over the shots of a keyframe; needs no truth.

    One image has many edges that are none of the lidar's, and what they have by chance is at another place in the next, some metres on.

    The lidar's edges are split into bundles of directions from where it was at the keyframe's stamp, so that what one thing shows in
    several shots is of one bundle; every other bundle is kept for the check (`is_kept`) and takes no part in any estimate.

    Projections (3, 4) are those of the lidar's points at the stamp of the keyframe, raw or freed of motion as the shots' are.
    """

    def __init__(self, shots: Sequence[Shot], T_stamp_image: np.ndarray, settings: QualitySettings = _DEFAULT):
        """
        Args:
            shots: at least one.
            T_stamp_image: (4, 4) where the lidar was when the image was taken that projections are into, in its frame at the stamp.
            settings: `max_edge_px` and `edge_turn_deg`.
        """
        self._settings, self._shots = settings, list(shots)
        self._moves = [T_stamp_image @ s.T_image_stamp for s in self._shots]
        self._points = np.concatenate([s.edges for s in self._shots])
        self._starts = np.cumsum([0] + [len(s.edges) for s in self._shots])
        # In the keyframe's frame.
        self._places = np.concatenate([apply(s.T_keyframe_stamp, s.edges) for s in self._shots])
        self._is_kept = bundles_of(self._places) % 2 == 1

    @property
    def n_shots(self) -> int:
        """Shots that show any depth edge."""
        return sum(len(s.edges) > 0 for s in self._shots)

    @property
    def n_points(self) -> int:
        """Depth edges of all shots."""
        return len(self._points)

    def distance_px(self, projection: np.ndarray, is_kept: bool | None = None) -> float:
        """Mean distance of the lidar's depth edges from the nearest image edge under a projection (3, 4); NaN without any in view.

        `is_kept` takes those kept for the check, or the others alone.
        """
        distances = self._distances(projection)[self._chosen(is_kept)]
        return float(np.nanmean(distances)) if np.isfinite(distances).any() else float("nan")

    def _chosen(self, is_kept: bool | None) -> np.ndarray:
        return np.ones(len(self._points), bool) if is_kept is None else self._is_kept == is_kept

    def _distances(self, projection: np.ndarray) -> np.ndarray:
        """(N,) distances of the depth edges from the nearest image edge, at most `max_edge_px`; NaN out of view."""
        found = np.full(len(self._points), np.nan)
        for shot, move, first, last in zip(self._shots, self._moves, self._starts, self._starts[1:], strict=False):
            pixels, (height, width) = project_linear(projection @ move, shot.edges), shot.distance.shape
            with np.errstate(invalid="ignore"):
                inside = ((pixels >= 0) & (pixels <= [width - 1, height - 1])).all(axis=1)
            if inside.any():
                u, v = pixels[inside].astype(np.float32).T
                found[first:last][inside] = cv2.remap(shot.distance, u[None], v[None], cv2.INTER_LINEAR)[0]
        return np.minimum(found, self._settings.max_edge_px)

    def sum_bundles(
        self, projections: Sequence[np.ndarray], is_kept: bool | None, seen_by: np.ufunc = np.logical_and
    ) -> tuple[np.ndarray, np.ndarray]:
        """Sums of distances of each bundle under n projections (B, n), and the bundles' edges (B,): those in view under all of them.

        Bundles are nearly independent of each other; the edges within one are not. With `logical_or` those in view under any count, an
        edge out of view as one that has no image edge near it.
        """
        distances = np.stack([self._distances(p) for p in projections], axis=1)
        seen = self._chosen(is_kept) & seen_by.reduce(np.isfinite(distances), axis=1)
        return sum_bundles(self._places[seen], np.nan_to_num(distances[seen], nan=self._settings.max_edge_px))

    def margin_px(self, projection: np.ndarray, K: np.ndarray, is_kept: bool | None = None) -> float:
        """By how much the mean distance of edges grows when the camera is turned to the left, or to the right if that is less.

        It is negative where edges lie nearer for a turn, as they do towards the right calibration. `is_kept` as in `distance_px`.
        """
        own, angle = self.distance_px(projection, is_kept), np.radians(self._settings.edge_turn_deg)
        turns = [Rotation.from_rotvec(v).as_matrix() for v in angle * np.array([(0, 1, 0), (0, -1, 0)])]
        return float(min(self.distance_px(K @ R @ np.linalg.inv(K) @ projection, is_kept) for R in turns) - own)


# Points are split into bundles of so many degrees of azimuth.
_BUNDLE_DEG = 3.0


def bundles_of(points_lidar: np.ndarray) -> np.ndarray:
    """(N,) int64 bundle of directions of each point (N, 3)."""
    return np.floor(np.degrees(np.arctan2(points_lidar[:, 1], points_lidar[:, 0])) / _BUNDLE_DEG).astype(np.int64)


def sum_bundles(points_lidar: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Sums (B, n) of the values (N, n) of points (N, 3) by bundle of directions, and how many points each bundle has (B,)."""
    _, rows = np.unique(bundles_of(points_lidar), return_inverse=True)
    sums = np.zeros((rows.max() + 1 if len(rows) else 0, values.shape[1]))
    np.add.at(sums, rows, values)
    return sums, np.bincount(rows)


def paired_gain(sums: np.ndarray, counts: np.ndarray) -> tuple[float, float]:
    """By how much the second mean of bundles (B, 2) is smaller than the first, and its deviation over bundles; NaN with fewer than two."""
    if len(counts) < 2:
        return float("nan"), float("nan")
    gains, draws = sums[:, 0] - sums[:, 1], _draws(len(counts))
    return float(gains.sum() / counts.sum()), float(((draws @ gains) / (draws @ counts)).std())


def _draws(n: int) -> np.ndarray:
    """(D, n) how often each of n bundles is drawn, n at a time."""
    return np.random.default_rng(0).multinomial(n, np.full(n, 1 / n), _N_DRAWS)


@dataclass(frozen=True)
class Bend:
    """An error of the way of the camera.

    Attributes:
        rad: the error; 0 where nothing tells it.
        std_rad: its deviation.
    """

    rad: float
    std_rad: float


UNTOLD = Bend(0.0, np.inf)


def find_bend(check: EdgeCheck, projection_of: Callable[[float], np.ndarray], max_rad: float, step_rad: float) -> Bend:
    """The error of the way of the camera under which image edges lie nearest to the lidar's, of those not kept for the check.

    Its deviation is over samples of the bundles of edges, large where the curve has several minima; infinite without edges, or where the
    lowest is at the end of the search.

    Args:
        check: of the keyframe, freed of motion.
        projection_of: the projection (3, 4) for an error in radians.
        max_rad: largest error to either side.
        step_rad: step of the search.
    """
    errors = np.arange(-round(max_rad / step_rad), round(max_rad / step_rad) + 1) * step_rad
    sums, counts = check.sum_bundles([projection_of(e) for e in errors], False)
    if len(counts) < 2:
        return UNTOLD
    mean = sums.sum(axis=0) / counts.sum()
    if np.ptp(mean) < 1e-9:
        return UNTOLD
    # ASSUME: of errors alike, the smaller.
    prior = _HELD_PX * (errors / max_rad) ** 2
    costs = _smooth(mean) + prior
    k = int(costs.argmin())
    if not 0 < k < len(errors) - 1:
        return UNTOLD
    before, here, after = costs[k - 1 : k + 2]
    rad = float(errors[k] + step_rad * 0.5 * (before - after) / max(before - 2 * here + after, 1e-9))
    # A minimum is found to a step of the search.
    return Bend(rad, float(np.hypot(step_rad, _deviation(errors, prior, sums, counts, rad))))


def _deviation(errors: np.ndarray, prior: np.ndarray, sums: np.ndarray, counts: np.ndarray, rad: float) -> float:
    """The deviation of the minimum from where it was found, over bundles (B, n) drawn again and again."""
    draws = _draws(len(counts))
    costs = _smooth((draws @ sums) / (draws @ counts)[:, None]) + prior
    return float(np.sqrt(np.mean((errors[costs.argmin(axis=1)] - rad) ** 2)))


def _smooth(curves: np.ndarray) -> np.ndarray:
    """Means of five steps: single edges make curves (..., n) jagged."""
    return uniform_filter1d(curves, 5, axis=-1, mode="nearest")


# The largest error costs as much as edges that are so much farther off.
_HELD_PX = 0.2
# Samples of bundles that tell the deviation.
_N_DRAWS = 200


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
