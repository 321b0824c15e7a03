"""T1: the projection of the synthesized cloud into one image, by EPnP on a few static points.

Source: Nagy (2020), 4.3.1 (5) (M = 45 points, chosen by point density, labels not dynamic; N-209, N-211) and 4.4.2 (N-231).

ASSUME: the density of a point is the number of other static points observed within `radius_px` of it in the same image. The M densest
(`density`, the thesis to the letter) all lie in one spot, and the rest of the image is pixels off; so ours are the densest that are no
nearer to each other than that (`spaced`). Points spread over the image (`spread`: each the one farthest from those taken) are a third way.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial import cKDTree

from streetscan.errors import BadInput

SELECTIONS = ("density", "spaced", "spread")


@dataclass(frozen=True)
class ProjectionSettings:
    """How T1 is found.

    Attributes:
        n_points: M of the thesis (45).
        selection: `density` (thesis), `spaced` or `spread`.
        radius_px: within which neighbours are counted.
        max_error_px: a larger mean reprojection error refuses the keyframe (thesis: 2).
    """

    n_points: int = 45
    selection: str = "spaced"
    radius_px: float = 50.0
    max_error_px: float = 2.0

    def __post_init__(self):
        if self.selection not in SELECTIONS:
            raise BadInput("reconstruct_keyframe.projection.selection", f"'{self.selection}'", f"choose one of {', '.join(SELECTIONS)}")
        if self.n_points < 4:
            raise BadInput("reconstruct_keyframe.projection.n_points", f"{self.n_points}", "EPnP needs four or more")


@dataclass
class Projection:
    """T1 of one image.

    Attributes:
        T_camera_sfm: (4, 4) found by EPnP.
        chosen: (m,) int64 rows of the given points that were used.
        errors_px: (n,) float64 reprojection error of every given point.
    """

    T_camera_sfm: np.ndarray
    chosen: np.ndarray
    errors_px: np.ndarray

    @property
    def mean_error_px(self) -> float:
        return float(self.errors_px.mean())

    def matrix(self, K: np.ndarray) -> np.ndarray:
        """T1 (3, 4): pixel (homogeneous, centres at integers) = T1 @ (point, 1)."""
        return K @ self.T_camera_sfm[:3]


def estimate_projection(
    points: np.ndarray, pixels: np.ndarray, K: np.ndarray, settings: ProjectionSettings = ProjectionSettings()
) -> Projection:
    """T1 from static points and where one image observes them.

    Args:
        points: (n, 3) float64, frame `sfm`.
        pixels: (n, 2) float64, centres at integers.
        K: (3, 3).
        settings: see ProjectionSettings.
    Raises:
        ValueError: fewer than four points, or EPnP finds nothing.
    """
    if len(points) < 4:
        raise ValueError(f"{len(points)} static points in the image; four or more are needed")
    choose = {"density": choose_dense, "spaced": choose_spaced, "spread": choose_spread}[settings.selection]
    chosen = choose(pixels, settings.n_points, settings.radius_px)
    # EPnP is better conditioned around the points' own middle.
    middle = points[chosen].mean(axis=0)
    found, turn, shift = cv2.solvePnP(points[chosen] - middle, pixels[chosen], K, None, flags=cv2.SOLVEPNP_EPNP)
    if not found or not np.isfinite(turn).all():
        raise ValueError("EPnP finds no pose")
    T = np.eye(4)
    T[:3, :3] = cv2.Rodrigues(turn)[0]
    T[:3, 3] = shift.ravel() - T[:3, :3] @ middle
    return Projection(T, chosen, np.linalg.norm(project_pinhole(points, K, T) - pixels, axis=1))


def project_pinhole(points: np.ndarray, K: np.ndarray, T_camera_frame: np.ndarray) -> np.ndarray:
    """Pixels (n, 2) float64 of points (n, 3), centres at integers; NaN behind the camera."""
    seen = points @ T_camera_frame[:3, :3].T + T_camera_frame[:3, 3]
    seen = np.where(seen[:, 2:] > 0, seen, np.nan) @ K.T
    return seen[:, :2] / seen[:, 2:]


def choose_dense(pixels: np.ndarray, n_points: int, radius_px: float) -> np.ndarray:
    """Rows of the points with the most others within a radius, densest first, the earlier row where they are alike."""
    return _by_density(pixels, radius_px)[0][:n_points]


def choose_spaced(pixels: np.ndarray, n_points: int, radius_px: float) -> np.ndarray:
    """Rows of the densest points as in `choose_dense`, of the denser half none within the radius of one taken before.

    The rest fills up what is missing.
    """
    order, near, n_near = _by_density(pixels, radius_px)
    chosen, is_near = [], n_near < np.median(n_near)
    for row in order:
        if not is_near[row]:
            chosen.append(row)
            is_near[near[row]] = True
    return np.array([*chosen, *order[~np.isin(order, chosen)]], np.int64)[:n_points]


def choose_spread(pixels: np.ndarray, n_points: int, radius_px: float = 0.0) -> np.ndarray:
    """Rows of points spread over the image: the first is nearest to the middle of all, each further one farthest from those taken.

    A radius plays no part.
    """
    chosen = [int(np.argmin(np.linalg.norm(pixels - pixels.mean(axis=0), axis=1)))]
    distance = np.linalg.norm(pixels - pixels[chosen[0]], axis=1)
    while len(chosen) < min(n_points, len(pixels)):
        chosen.append(int(np.argmax(distance)))
        distance = np.minimum(distance, np.linalg.norm(pixels - pixels[chosen[-1]], axis=1))
    return np.array(chosen)


def _by_density(pixels: np.ndarray, radius_px: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows of the points (n, 2) from the densest on, the rows near each point, and their number."""
    near = cKDTree(pixels).query_ball_point(pixels, radius_px)
    n_near = np.array([len(rows) for rows in near])
    return np.lexsort((np.arange(len(pixels)), -n_near)), near, n_near
