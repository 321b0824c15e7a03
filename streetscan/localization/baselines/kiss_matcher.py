"""KISS-Matcher (Lim et al. 2025): features, graph-theoretic pruning and a robust solver; needs no start but the map around it."""

import time

import kiss_matcher
import numpy as np

from streetscan.localization.baselines.points import Scene
from streetscan.localization.localizer import Location, Start
from streetscan.localization.reference import Reference

# Fewer inliers are, in the words of its authors' example, likely a failure.
_MIN_INLIERS = 5


class KissMatcherLocalizer:
    """KISS-Matcher of the frame to the static map around the start."""

    def __init__(self, reference: Reference, voxel_m: float = 0.5):
        """
        Args:
            reference: the map.
            voxel_m: its only setting.
        """
        self._reference, self._voxel_m = reference, voxel_m

    def locate(self, points: np.ndarray, start: Start) -> Location:
        """See `streetscan.localization.drive.Localizer`."""
        clock = time.perf_counter()
        scene = Scene(self._reference, points, start)
        if scene.failure or len(scene.target) < 50:
            return Location(scene.failure or "off_map")
        # Float32 inside: both clouds about the start.
        centre = scene.T_start[:3, 3]
        matcher = kiss_matcher.KISSMatcher(self._voxel_m)
        solution = matcher.estimate(scene.points.astype(np.float32), (scene.target - centre).astype(np.float32))
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = solution.rotation, np.asarray(solution.translation) + centre
        is_believed = bool(solution.valid) and matcher.get_num_final_inliers() >= _MIN_INLIERS
        seconds = np.array([0.0, 0.0, time.perf_counter() - clock])
        if not np.isfinite(T).all():
            return Location("ambiguous", seconds=seconds)
        return scene.result(T, is_believed, n_inliers=int(matcher.get_num_final_inliers()), seconds=seconds)
