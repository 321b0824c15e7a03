"""One linear projection for the lidar frame, from points whose pixels are known through T1.

Source: Nagy (2020), 4.3.4, Fig. 4.10, Eq. 4.1 (N-228, N-229).

ASSUME (X-09): EPnP finds the start and Levenberg-Marquardt (OpenCV's solvePnP) the end, so both statements of the thesis hold.
ASSUME: the thesis prints a 4x3 matrix; ours is the usual 3x4 that acts on columns.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from streetscan.calibration.projection import project_pinhole
from streetscan.geometry import apply, compose, transform_of_rotation


@dataclass(frozen=True)
class View:
    """The rectified image of a keyframe that counts, in the frame `sfm`.

    Attributes:
        T_camera_sfm: (4, 4) rigid, T1 without the intrinsics.
        K: (3, 3) camera matrix, pixel centres at integers.
        width, height: pixels.
    """

    T_camera_sfm: np.ndarray
    K: np.ndarray
    width: int
    height: int

    def project(self, points_sfm: np.ndarray) -> np.ndarray:
        """Pixels (N, 2) of points (N, 3) in the frame `sfm`; NaN behind the camera."""
        return project_pinhole(points_sfm, self.K, self.T_camera_sfm)

    def sees(self, points_sfm: np.ndarray) -> np.ndarray:
        """(N,) bool: which points fall into the picture, hidden or not."""
        return self.contains(self.project(points_sfm))

    def contains(self, pixels: np.ndarray) -> np.ndarray:
        """(N,) bool: which pixels (N, 2) lie in the picture."""
        with np.errstate(invalid="ignore"):
            return ((pixels >= -0.5) & (pixels < np.array([self.width, self.height]) - 0.5)).all(axis=1)


def project_linear(projection: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Pixels (N, 2) of points (N, 3) by a 3x4 matrix whose third row gives the depth (K [R | t]); NaN behind the camera."""
    homogeneous = apply(np.vstack([projection, [0, 0, 0, 1]]), points)
    depth = np.where(homogeneous[:, 2] > 0, homogeneous[:, 2], np.nan)
    return homogeneous[:, :2] / depth[:, None]


@dataclass
class LinearProjection:
    """A linear projection of the raw lidar frame.

    Attributes:
        projection: (3, 4) K [R | t].
        T_camera_lidar: (4, 4) [R | t], of the raw frame as it is: it holds the motion between image and lidar frame too.
        residuals_px: (N, 2) of the correspondences it was fitted to.
    """

    projection: np.ndarray
    T_camera_lidar: np.ndarray
    residuals_px: np.ndarray


def fit_projection(points_lidar: np.ndarray, pixels: np.ndarray, K: np.ndarray, max_error_px: float = 8.0) -> LinearProjection | None:
    """The projection that brings lidar points closest to their pixels: EPnP, then Levenberg-Marquardt; None when there is none.

    Args:
        points_lidar: (N, 3) metres, frame `lidar`, N >= 4.
        pixels: (N, 2).
        K: (3, 3).
        max_error_px: correspondences farther off than this and than three times the median are left out, fit by fit.
    """
    chosen = np.isfinite(pixels).all(axis=1)
    if chosen.sum() < 4 or not _is_spread(points_lidar[chosen]):
        return None
    found = None
    for _ in range(4):
        objects, image = np.ascontiguousarray(points_lidar[chosen], np.float64), np.ascontiguousarray(pixels[chosen], np.float64)
        if found is None:
            is_found, *found = cv2.solvePnP(objects, image, K, None, flags=cv2.SOLVEPNP_EPNP)
            if not is_found:
                return None
        found = cv2.solvePnPRefineLM(objects, image, K, None, *found)
        T = transform_of_rotation(cv2.Rodrigues(found[0])[0], found[1].ravel())
        residuals = project_pinhole(points_lidar, K, T) - pixels
        lengths = np.hypot(*np.nan_to_num(residuals, nan=np.inf).T)
        closer = lengths <= max(max_error_px, 3 * float(np.median(lengths[chosen])))
        if np.array_equal(closer, chosen) or closer.sum() < max(4, chosen.sum() // 2) or not _is_spread(points_lidar[closer]):
            break
        chosen = closer
    return LinearProjection(linear_of(T, K), T, residuals[chosen])


def linear_of(T_camera_lidar: np.ndarray, K: np.ndarray) -> np.ndarray:
    """K [R | t] (3, 4) of a transform (4, 4) into the camera; a similarity is made rigid, which changes no pixel."""
    scale = np.cbrt(np.linalg.det(T_camera_lidar[:3, :3]))
    return K @ (T_camera_lidar[:3] / scale)


def rigid_of(T: np.ndarray) -> np.ndarray:
    """The rigid transform (4, 4) with the same pixels as a similarity into a camera: its scale taken out of rotation and translation."""
    rigid = np.eye(4)
    rigid[:3] = T[:3] / np.cbrt(np.linalg.det(T[:3, :3]))
    return rigid


def camera_of(view: View, T_sfm_lidar: np.ndarray) -> np.ndarray:
    """T_camera_lidar (4, 4), rigid, of a lidar frame that lies in `sfm` by a similarity."""
    return rigid_of(compose(view.T_camera_sfm, T_sfm_lidar))


def _is_spread(points: np.ndarray) -> bool:
    """Whether points are more than a line: their second principal deviation is above 5 cm."""
    return len(points) >= 4 and np.linalg.svd(points - points.mean(axis=0), compute_uv=False)[1] / np.sqrt(len(points)) > 0.05
