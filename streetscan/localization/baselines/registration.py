"""NDT and generalised ICP from the GPS start: what localization stacks do once somebody has told them where they are.

Source: Magnusson (2009) through `streetscan.registration.ndt`; Segal et al. (2009) through small_gicp.
"""

import time

import numpy as np
import small_gicp

from streetscan.localization.baselines.points import Scene
from streetscan.localization.localizer import Location, Start
from streetscan.localization.reference import Reference
from streetscan.localization.refinement import covariance_of
from streetscan.registration.ndt import NdtSettings, build_fields, fit, thin_points

_THIN_M = 0.5


class GicpLocalizer:
    """Generalised ICP of the frame to the static map from the start."""

    def __init__(self, reference: Reference, max_distance_m: float = 5.0):
        """
        Args:
            reference: the map.
            max_distance_m: farthest correspondence; the start is metres off.
        """
        self._reference, self._max_distance_m = reference, max_distance_m

    def locate(self, points: np.ndarray, start: Start) -> Location:
        """See `streetscan.localization.drive.Localizer`."""
        clock = time.perf_counter()
        scene = Scene(self._reference, points, start)
        if scene.failure or len(scene.target) < 50:
            return Location(scene.failure or "off_map")
        target, tree = small_gicp.preprocess_points(scene.target, self._reference.static_m, num_neighbors=10, num_threads=1)
        source, _ = small_gicp.preprocess_points(scene.points, _THIN_M, num_neighbors=10, num_threads=1)
        limits = {"max_correspondence_distance": self._max_distance_m, "num_threads": 1, "max_iterations": 50}
        result = small_gicp.align(target, source, tree, scene.T_start, "GICP", **limits)
        T = _orthonormal(np.array(result.T_target_source))
        seconds = np.array([0.0, 0.0, time.perf_counter() - clock])
        return scene.result(T, bool(result.converged), covariance=covariance_of(result.H, T), seconds=seconds)


class NdtLocalizer:
    """Normal distributions transform of the frame to the static map from the start, coarse to fine."""

    def __init__(self, reference: Reference, settings: NdtSettings | None = None):
        """
        Args:
            reference: the map.
            settings: of the NDT; by default cubes of 4, 2 and 1 m.
        """
        self._reference, self._settings = reference, settings or NdtSettings(sizes_m=(4.0, 2.0, 1.0))

    def locate(self, points: np.ndarray, start: Start) -> Location:
        """See `streetscan.localization.drive.Localizer`."""
        clock = time.perf_counter()
        scene = Scene(self._reference, points, start)
        if scene.failure or len(scene.target) < 50:
            return Location(scene.failure or "off_map")
        found = fit(build_fields(scene.target, self._settings), thin_points(scene.points, _THIN_M), scene.T_start, self._settings)
        seconds = np.array([0.0, 0.0, time.perf_counter() - clock])
        return scene.result(found.T_target_source, found.is_converged, seconds=seconds)


def _orthonormal(T: np.ndarray) -> np.ndarray:
    u, _, vt = np.linalg.svd(T[:3, :3])
    T[:3, :3] = u @ vt
    return T
