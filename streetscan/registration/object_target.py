"""Registration by objects: blobs of a frame are aligned with the blobs before it by voting, then NDT on the blobs' points alone.

Source: Nagy (2020), 3.4.2 (N-130): the object-based alignment registers consecutive frames "up to 0.5 m registration error", which the NDT
"can already" handle; "to keep low the computational cost", NDT sees only the points of the objects.

ASSUME: two blobs are compatible when both are slim or their volumes are alike, as a blob and a landmark of the map are.
"""

import numpy as np

from streetscan.classes import COLUMN, FURNITURE
from streetscan.geometry import apply, transform
from streetscan.localization.ground import GroundSettings, find_ground
from streetscan.localization.keypoints import describe_objects
from streetscan.localization.objects import ObjectSettings, find_objects
from streetscan.localization.voting import Compatibility, Window, find_compatible, refine_peaks, vote
from streetscan.registration.ndt import Fit, NdtSettings, build_fields, fit, thin_points

# Of consecutive frames: a vehicle brakes and turns no more than this between them.
_WINDOW = Window(turn_deg=10.0, shift_m=4.0, rise_m=1.0)
_N_KEYPOINTS = 8
# Two sparse frames see more of each other than 30 m; walls in blobs, too, are of use here.
_GROUND, _OBJECTS = GroundSettings(range_m=40.0), ObjectSettings(max_size_m=20.0)


class ObjectTarget:
    """A target of registration made of objects; see `streetscan.registration.targets.Target`.

    Attributes:
        T_coarse: (4, 4) what the last vote found, before the NDT.
    """

    def __init__(self, settings: NdtSettings, thin_m: float):
        self._settings, self._thin_m = settings, thin_m
        self.T_coarse = np.eye(4)
        self.clear()

    def clear(self) -> None:
        self._points, self._starts = np.empty((0, 3)), np.zeros(1, np.int64)
        self._describe()

    def _describe(self) -> None:
        self._objects = describe_objects(self._points, self._starts)
        slim = self._objects.sizes_m[:, 2] >= Compatibility().column_ratio * self._objects.sizes_m[:, :2].max(axis=1, initial=0)
        self._kinds = np.where(slim, COLUMN, FURNITURE).astype(np.uint8)
        self._fields = build_fields(self._points, self._settings)
        self.is_empty = len(self._objects) == 0

    def add(self, points: np.ndarray, T_target_points: np.ndarray) -> None:
        found = find_objects(find_ground(points, _GROUND), _OBJECTS)
        self._starts = np.concatenate([self._starts, len(self._points) + found.starts[1:]])
        self._points = np.concatenate([self._points, apply(T_target_points, found.points)])
        self._describe()

    def fit(self, points: np.ndarray, T_target_source: np.ndarray) -> Fit:
        found = find_objects(find_ground(points, _GROUND), _OBJECTS)
        observed = found.objects.transformed(T_target_source)
        # The vote turns about the vehicle, so both sides are moved to where it is thought to be.
        T_here = np.eye(4)
        T_here[:3, 3] = -T_target_source[:3, 3]
        observed, landmarks = observed.transformed(T_here), self._objects.transformed(T_here)
        pairs = find_compatible(observed, landmarks, self._kinds)
        peaks = refine_peaks(vote(observed, landmarks, pairs, _N_KEYPOINTS, _WINDOW), observed, landmarks, pairs, _N_KEYPOINTS)
        moved = transform(peaks[0].shift_m, (0, 0, peaks[0].turn_rad)) if peaks else np.eye(4)
        self.T_coarse = np.linalg.inv(T_here) @ moved @ T_here @ T_target_source
        return fit(self._fields, thin_points(found.points, self._thin_m), self.T_coarse, self._settings)

    def drop_beyond(self, centre: np.ndarray, distance_m: float) -> None:
        counts, near = np.diff(self._starts), np.linalg.norm((self._objects.centres - centre)[:, :2], axis=1) <= distance_m
        if not near.all():
            self._points = self._points[np.repeat(near, counts)]
            self._starts = np.concatenate([[0], np.cumsum(counts[near])]).astype(np.int64)
            self._describe()

    def state(self) -> dict[str, np.ndarray]:
        return {"points": self._points, "starts": self._starts}

    def restore(self, state: dict[str, np.ndarray]) -> None:
        self._points, self._starts = state["points"], state["starts"]
        self._describe()
