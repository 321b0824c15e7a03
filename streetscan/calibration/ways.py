"""The way the vehicle goes, seen by the lidar and by the camera: what it tells about the yaw between them.

Beyond the thesis; the rotation of a hand-eye calibration, of which a drive that goes straight on tells the bearing alone. Structure from
motion knows in which direction its own images went, registration of lidar frames in which the lidar did, and a camera and a lidar on
one vehicle went the same way. Clouds need not match for it, so it tells a wrong place from the right one, and it holds the yaw where a
street has little that does. On training and validation streets both agree within 0.05 degrees.

ASSUME: bearings only. How a road tips the vehicle comes and goes within some lidar frames, and their registration follows it too late.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from streetscan.calibration.scale import NoScale, near_poses, smooth_motion
from streetscan.geometry import apply, invert, rotation_angle, transform_of_rotation
from streetscan.registration.odometry import FramePose

# Poses so long before and after an image tell where the lidar was.
_MARGIN_S = 0.5
# A shorter way tells no bearing.
MIN_WAY_M = 0.3


@dataclass(frozen=True)
class LidarWay:
    """Where the lidar was at images of a keyframe, in its own frame at the stamp.

    Attributes:
        T_stamp_first, T_stamp_last, T_stamp_image: (4, 4) at the first image, the last one, and the one that counts.
        duration_s: between the first and the last.
    """

    T_stamp_first: np.ndarray
    T_stamp_last: np.ndarray
    T_stamp_image: np.ndarray
    duration_s: float

    def of(self, point_body: np.ndarray) -> np.ndarray:
        """(3,) by how much a point (3,) fixed in the lidar's axes moved, frame `lidar` at the stamp."""
        return apply(self.T_stamp_last, point_body) - apply(self.T_stamp_first, point_body)

    @property
    def turn_rad_per_s(self) -> float:
        """How fast the lidar turned, from the first to the last image."""
        return float(rotation_angle(invert(self.T_stamp_first) @ self.T_stamp_last)) / max(self.duration_s, 1e-3)


def lidar_way(poses: list[FramePose], lidar_time_ns: int, image_times_ns: Sequence[int], image_time_ns: int) -> LidarWay | None:
    """The lidar's way during a keyframe, or None where it is not known.

    Args:
        poses: of register_frames.
        lidar_time_ns: stamp of the keyframe's lidar frame.
        image_times_ns: of images that structure from motion registered, in order.
        image_time_ns: of the one that counts.
    """
    if len(image_times_ns) < 2:
        return None
    times_s = np.array([lidar_time_ns, image_times_ns[0], image_times_ns[-1], image_time_ns]) / 1e9
    try:
        # All of one segment: others are in other frames.
        own = near_poses(poses, times_s.min(), times_s.max(), _MARGIN_S)
        stamp, *others = (_pose_at(own, t) for t in times_s)
    except NoScale:
        return None
    return LidarWay(*(invert(stamp) @ T for T in others), float(times_s[2] - times_s[1]))


def _pose_at(poses: list[FramePose], time_s: float) -> np.ndarray:
    """T_segment_lidar (4, 4) at a time, of the poses around it alone: over a longer while a cubic does not follow a turn."""
    positions, rotations = smooth_motion(near_poses(poses, time_s, time_s, _MARGIN_S), np.array([time_s]))
    return transform_of_rotation(rotations, positions)[0]


@dataclass(frozen=True)
class Way:
    """One way, as both sensors see it.

    Attributes:
        lidar: see LidarWay.
        camera_sfm: (3,) the camera at the image that counts, frame `sfm`, which has y down as that camera has.
        bearing_sfm: (3,) from the camera at the first image to that at the last.
        std_rad: deviation of the lidar's bearing.
    """

    lidar: LidarWay
    camera_sfm: np.ndarray
    bearing_sfm: np.ndarray
    std_rad: float

    def turn_off(self, T_sfm_lidar: np.ndarray) -> float:
        """By how much, in radians to the right, the lidar's way goes past the camera's where the lidar lies at T_sfm_lidar (4, 4)."""
        camera_body = apply(invert(T_sfm_lidar @ self.lidar.T_stamp_image), self.camera_sfm)
        off = _azimuth(T_sfm_lidar[:3, :3] @ self.lidar.of(camera_body)) - _azimuth(self.bearing_sfm)
        return float((off + np.pi) % (2 * np.pi) - np.pi)

    def straightened(self, bend_rad: float) -> "Way":
        """The way when the camera believes to go by so much too far to its right."""
        turn = Rotation.from_rotvec([0.0, -bend_rad, 0.0])
        return replace(self, bearing_sfm=turn.apply(self.bearing_sfm))


# How a turn (rotation vector) in the frame `sfm` changes `Way.turn_off`: all of what is about its downward axis.
TURN_OFF_PER_TURN = np.array([0.0, 1.0, 0.0])


def _azimuth(v: np.ndarray) -> float:
    return float(np.arctan2(v[0], v[2]))


def make_way(lidar: LidarWay | None, cameras_sfm: np.ndarray, std_m: float, std_s: float) -> Way | None:
    """The way of both sensors; None where it is too short, or the lidar's is not known.

    Args:
        lidar: of `lidar_way`.
        cameras_sfm: (n, 3) the camera at the image that counts, then at the first image, and so on to the last.
        std_m: deviation of where the lidar's way ends.
        std_s: of times: in a turn the bearing changes with them.
    """
    if lidar is None:
        return None
    bearing, length_m = cameras_sfm[-1] - cameras_sfm[1], float(np.linalg.norm(lidar.of(np.zeros(3))))
    if min(np.linalg.norm(bearing), length_m) < MIN_WAY_M:
        return None
    return Way(lidar, cameras_sfm[0], bearing, float(np.hypot(std_m / length_m, std_s * lidar.turn_rad_per_s)))
