"""What the point-based reference methods share: the frame's points, the map around the start, the start as a pose."""

import numpy as np

from streetscan.localization.ground import GroundSettings, find_ground
from streetscan.localization.localizer import Location, Start, level_of, place_start
from streetscan.localization.reference import OccupancyGrid, Reference
from streetscan.registration.ndt import thin_points

# The thesis' range, for the frame; the map is cut wider by the start's largest error.
RANGE_M, MAP_RANGE_M = 30.0, 50.0
# ASSUME: the sensor's height where the frame shows no ground.
_HEIGHT_M = 1.8


class Scene:
    """A frame and its surroundings on the map.

    Attributes:
        points: (N, 3) float64 finite points within range, frame `lidar`.
        heights_m: (N,) above the frame's own ground, NaN without ground.
        target: (K, 3) float64 static points of the map about the start, relative to the reference's origin.
        T_start: (4, 4) T_origin_lidar of the start; a start without heading looks east.
    """

    def __init__(self, reference: Reference, points: np.ndarray, start: Start):
        """BadInput never; see `failure` for a frame that cannot be used."""
        self._reference = reference
        xy = np.asarray(start.xy_m, np.float64)[:2] - reference.origin[:2]
        ground = find_ground(points, GroundSettings(range_m=RANGE_M))
        self.points, self.heights_m = ground.points.astype(np.float64), ground.heights_m
        self.failure = ""
        if len(self.points) == 0:
            self.failure = "no_points"
        elif not reference.contains(xy, MAP_RANGE_M - RANGE_M):
            self.failure = "off_map"
        self.target = np.empty((0, 3)) if self.failure else reference.cut(xy, MAP_RANGE_M)
        yaw = 0.0 if np.isnan(start.yaw_rad) else start.yaw_rad
        height, level = (-ground.plane[2], level_of(ground)) if ground.has_plane else (_HEIGHT_M, np.eye(4))
        self.T_start = np.eye(4) if self.failure else place_start(reference, xy, yaw, height) @ level

    def result(self, T: np.ndarray, is_believed: bool, **fields) -> Location:
        """A location of a pose relative to the reference's origin; a method that is not sure of itself gives `ambiguous`."""
        standing = thin_points(self.points[self.heights_m > 0.3], 0.4)
        overlap = OccupancyGrid(self.target, 0.2).overlap(standing, T)
        T_map = T.copy()
        T_map[:3, 3] += self._reference.origin
        return Location("ok" if is_believed else "ambiguous", T_map, T_map.copy(), overlap=overlap, source="points", **fields)
