"""Boxes and keypoints of objects, alike for blobs of a frame and landmarks of the map.

Source: Nagy (2020), 3.3.3.1 and Fig. 3.5 (N-116): one keypoint (mass centre), four or eight (corners of the box), sixteen (mass centres of
the points in 2 x 2 x 4 equal parts of the box).

ASSUME (X-07): a keypoint is matched to its counterpart alone, not to all of the other object. A box aligned with the axes would be
another box after every turn, so boxes follow the object's own direction (smallest rectangle seen from above), which is known up to
quarter turns; the counterpart of a corner is the one it comes nearest to when the boxes are brought into line.

ASSUME: the four keypoints are the corners of the base. They are what a sensor on a car sees of any object.

Every strategy but the first has four columns of keypoints, one per quarter of the footprint, so a quarter turn moves them by one column.
"""

from dataclasses import dataclass

import numpy as np
from numba import njit

from streetscan.errors import BadInput
from streetscan.geometry import apply

STRATEGIES = (1, 4, 8, 16)
# Directions tried for the smallest rectangle, over a quarter turn.
_N_DIRECTIONS = 18


@dataclass
class ObjectSet:
    """M objects; coordinates in metres, in whatever frame their points were.

    Attributes:
        n_points: (M,) int64.
        centres: (M, 3) float64 mass centres.
        sizes_m: (M, 3) float64 length and width of the footprint (either may be longer), and height.
        yaws_rad: (M,) float64 direction of the length, counter-clockwise from x.
        corners: (M, 2, 4, 3) float64 corners of the box: base and top, counter-clockwise.
        parts: (M, 4, 4, 3) float64 mass centres of the 2 x 2 x 4 parts, by layer and quarter; NaN where a part is empty.
    """

    n_points: np.ndarray
    centres: np.ndarray
    sizes_m: np.ndarray
    yaws_rad: np.ndarray
    corners: np.ndarray
    parts: np.ndarray

    def __len__(self) -> int:
        return len(self.n_points)

    @property
    def volumes_m3(self) -> np.ndarray:
        return self.sizes_m.prod(axis=1)

    def select(self, rows: np.ndarray) -> "ObjectSet":
        """The objects a mask or an index picks."""
        return ObjectSet(**{name: values[rows] for name, values in vars(self).items()})

    def transformed(self, T: np.ndarray) -> "ObjectSet":
        """The objects in another frame, T (4, 4) being nearly a turn about the vertical: boxes stay upright."""
        turn = np.arctan2(T[1, 0], T[0, 0])
        centres, corners, parts = (apply(T, a.reshape(-1, 3)).reshape(a.shape) for a in (self.centres, self.corners, self.parts))
        return ObjectSet(self.n_points, centres, self.sizes_m, self.yaws_rad + turn, corners, parts)

    def keypoints(self, n_keypoints: int) -> np.ndarray:
        """Keypoints (M, L, 4, 3) of a strategy, L layers of four; for one keypoint (M, 1, 1, 3). NaN marks one that does not exist.

        Raises:
            BadInput: no such strategy.
        """
        if n_keypoints == 1:
            return self.centres[:, None, None]
        if n_keypoints == 4:
            return self.corners[:, :1]
        if n_keypoints == 8:
            return self.corners
        if n_keypoints == 16:
            return self.parts
        raise BadInput("n_keypoints", f"{n_keypoints}", f"choose one of {', '.join(map(str, STRATEGIES))}")


def describe_objects(points: np.ndarray, starts: np.ndarray) -> ObjectSet:
    """Boxes and keypoints of objects.

    Args:
        points: (N, 3) float, metres, grouped by object; no NaN. ASSUME: all are boundary points, for a lidar sees nothing but surfaces.
        starts: (M + 1,) first row of each object, and N; no object is empty.
    """
    arrays = _describe(np.ascontiguousarray(points, np.float64), np.asarray(starts, np.int64))
    return ObjectSet(np.diff(starts).astype(np.int64), *arrays)


@njit(cache=True, nogil=True)
def _describe(points, starts):
    n = len(starts) - 1
    centres, sizes, yaws = np.zeros((n, 3)), np.empty((n, 3)), np.empty(n)
    corners, parts, counts = np.empty((n, 2, 4, 3)), np.zeros((n, 4, 4, 3)), np.zeros((4, 4), np.int64)
    for m in range(n):
        first, last = starts[m], starts[m + 1]
        # Sums about the first point: coordinates may be of UTM size.
        x0, y0, z0 = points[first]
        sx, sy, sz, z_low, z_high = 0.0, 0.0, 0.0, np.inf, -np.inf
        for i in range(first, last):
            sx += points[i, 0] - x0
            sy += points[i, 1] - y0
            sz += points[i, 2] - z0
            z_low, z_high = min(z_low, points[i, 2]), max(z_high, points[i, 2])
        number = last - first
        centres[m, 0], centres[m, 1], centres[m, 2] = x0 + sx / number, y0 + sy / number, z0 + sz / number
        best, best_area = 0, np.inf
        extent = np.empty((_N_DIRECTIONS, 4))
        for k in range(_N_DIRECTIONS):
            c, s = np.cos(k * np.pi / 2 / _N_DIRECTIONS), np.sin(k * np.pi / 2 / _N_DIRECTIONS)
            u_low, u_high, v_low, v_high = np.inf, -np.inf, np.inf, -np.inf
            for i in range(first, last):
                dx, dy = points[i, 0] - x0, points[i, 1] - y0
                u, v = c * dx + s * dy, c * dy - s * dx
                u_low, u_high, v_low, v_high = min(u_low, u), max(u_high, u), min(v_low, v), max(v_high, v)
            extent[k, 0], extent[k, 1], extent[k, 2], extent[k, 3] = u_low, u_high, v_low, v_high
            # A line has no area in one direction; a centimetre of width keeps its length in the comparison.
            area = (u_high - u_low + 0.01) * (v_high - v_low + 0.01)
            if area < best_area:
                best, best_area = k, area
        yaws[m] = best * np.pi / 2 / _N_DIRECTIONS
        c, s = np.cos(yaws[m]), np.sin(yaws[m])
        u_low, u_high, v_low, v_high = extent[best]
        sizes[m, 0], sizes[m, 1], sizes[m, 2] = u_high - u_low, v_high - v_low, z_high - z_low
        for q in range(4):
            u = u_high if q == 1 or q == 2 else u_low
            v = v_high if q >= 2 else v_low
            for layer in range(2):
                corners[m, layer, q, 0], corners[m, layer, q, 1] = x0 + c * u - s * v, y0 + s * u + c * v
                corners[m, layer, q, 2] = z_high if layer else z_low
        counts[:] = 0
        u_middle, v_middle, step = (u_low + u_high) / 2, (v_low + v_high) / 2, max((z_high - z_low) / 4, 1e-9)
        for i in range(first, last):
            dx, dy = points[i, 0] - x0, points[i, 1] - y0
            is_right, is_upper = c * dx + s * dy > u_middle, c * dy - s * dx > v_middle
            q = (2 if is_right else 3) if is_upper else (1 if is_right else 0)
            layer = min(int((points[i, 2] - z_low) / step), 3)
            counts[layer, q] += 1
            parts[m, layer, q, 0] += dx
            parts[m, layer, q, 1] += dy
            parts[m, layer, q, 2] += points[i, 2] - z0
        for layer in range(4):
            for q in range(4):
                number = counts[layer, q]
                for a in range(3):
                    offset = (x0, y0, z0)[a]
                    parts[m, layer, q, a] = offset + parts[m, layer, q, a] / number if number else np.nan
    return centres, sizes, yaws, corners, parts
