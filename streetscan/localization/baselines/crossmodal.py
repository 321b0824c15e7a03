"""Cross-modal alignment: centres of objects seen from above, no classes, then NDT on points.

Source: reference [12] of Nagy (2020), as described in 3.2 and 3.4: object patches in both clouds, a coarse alignment "purely based on the
estimated object centers" from a top view in Hough space, then NDT. ASSUME: its objects are found as ours are, and on the map all
landmarks count, whatever their class; its window and cells are those of the vote.
"""

import time
from dataclasses import replace

import numpy as np

from streetscan.geometry import invert, transform
from streetscan.localization.ground import find_ground, has_finite
from streetscan.localization.keypoints import ObjectSet
from streetscan.localization.localizer import Location, Start, level_of, place_start
from streetscan.localization.objects import find_objects
from streetscan.localization.reference import Reference
from streetscan.localization.voting import Window, vote
from streetscan.registration.ndt import NdtSettings, build_fields, fit, thin_points

_RANGE_M, _THIN_M = 30.0, 0.5
# Of the coarse alignment the NDT starts within a metre: its cubes.
_NDT = NdtSettings(sizes_m=(2.0, 1.0))


class CrossmodalLocalizer:
    """The thesis' reference method on one map."""

    def __init__(self, reference: Reference, window: Window | None = None):
        """
        Args:
            reference: the map.
            window: of the vote; by default the thesis'.
        """
        self._reference, self._window = reference, window or Window()

    def locate(self, points: np.ndarray, start: Start) -> Location:
        """See `streetscan.localization.drive.Localizer`."""
        clock = [time.perf_counter()]
        reference = self._reference
        xy = np.asarray(start.xy_m, np.float64)[:2] - reference.origin[:2]
        if not has_finite(points):
            return Location("no_points")
        if not reference.contains(xy, self._window.shift_m):
            return Location("off_map")
        ground = find_ground(points)
        if not ground.has_plane:
            return Location("no_ground")
        T_level_lidar = level_of(ground)
        observed = find_objects(ground, T_level_lidar=T_level_lidar).objects
        clock.append(time.perf_counter())
        window = self._window if np.isfinite(start.yaw_rad) else replace(self._window, turn_deg=180.0)
        T_start = place_start(reference, xy, float(np.nan_to_num(start.yaw_rad)), -ground.plane[2])
        rows = reference.landmarks.near(xy, _RANGE_M + window.shift_m * np.sqrt(2))
        landmarks = reference.landmarks.objects.select(rows).transformed(invert(T_start))
        pairs = np.stack(np.meshgrid(np.arange(len(observed)), np.arange(len(landmarks)), indexing="ij"), -1).reshape(-1, 2)
        peaks = vote(flattened(observed), flattened(landmarks), pairs, 1, window, n_peaks=1)
        clock.append(time.perf_counter())
        if not peaks:
            return Location("too_few_objects", n_landmarks=len(rows))
        T = T_start @ transform(peaks[0].shift_m, (0, 0, peaks[0].turn_rad)) @ T_level_lidar
        fields = build_fields(reference.cut(T[:2, 3], _RANGE_M), _NDT)
        found = fit(fields, thin_points(ground.points.astype(np.float64), _THIN_M), T, _NDT)
        clock.append(time.perf_counter())
        poses = [p + _moved(reference.origin) for p in (found.T_target_source, T)]
        status = "ok" if found.is_converged and found.overlap > 0 else "ambiguous"
        return Location(status, *poses, n_objects=len(observed), n_landmarks=len(rows), source="objects", seconds=np.diff(clock))


def flattened(objects: ObjectSet) -> ObjectSet:
    """The objects with their mass centres seen from above, at height 0."""
    return replace(objects, centres=objects.centres * [1.0, 1.0, 0.0])


def _moved(shift: np.ndarray) -> np.ndarray:
    T = np.zeros((4, 4))
    T[:3, 3] = shift
    return T
