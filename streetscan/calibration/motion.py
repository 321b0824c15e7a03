"""What the lidar's own motion does around a keyframe: frames freed of it, and where the lidar was when the image was taken.

The motion is that of register_frames (no GPS, no IMU), smoothed as for the scale.
"""

import numpy as np
from scipy.spatial.transform import Rotation

from streetscan.calibration.scale import NoScale, near_poses, smooth_motion
from streetscan.geometry import apply, invert, transform_of_rotation
from streetscan.registration.odometry import FramePose

# Poses so long before and after take part.
_MARGIN_S = 0.5


class LidarMotion:
    """Poses of the lidar during a lidar frame and an image."""

    def __init__(self, poses: list[FramePose], lidar_time_ns: int, image_time_ns: int):
        """
        Args:
            poses: of register_frames.
            lidar_time_ns, image_time_ns: the stamps.
        Raises:
            NoScale: the frames around them were not registered as one segment.
        """
        self._zero_ns = lidar_time_ns
        image_s = (image_time_ns - lidar_time_ns) / 1e9
        zero_s = lidar_time_ns / 1e9
        self._near = near_poses(poses, zero_s + min(image_s, 0.0), zero_s + max(image_s, 0.0), _MARGIN_S)
        self.image_s = image_s

    def at(self, times_s: np.ndarray) -> np.ndarray:
        """T_stamp_lidar (n, 4, 4): the lidar at times (n,) after the stamp, in its own frame at the stamp."""
        wanted = self._zero_ns / 1e9 + np.append(0.0, np.asarray(times_s, np.float64))
        positions, rotations = smooth_motion(self._near, wanted)
        T = transform_of_rotation(rotations, positions)
        return invert(T[0]) @ T[1:]

    def deskew(self, points: np.ndarray, time_offset_s: np.ndarray) -> np.ndarray:
        """Points (N, 3) of the frame, each fired `time_offset_s` after the stamp, as measured from where the lidar was at the stamp."""
        steps, inverse = np.unique(np.round(np.asarray(time_offset_s, np.float64) * 1e5).astype(np.int64), return_inverse=True)
        return apply(self.at(steps * 1e-5)[inverse.reshape(-1)], points)

    def to_image(self, T_camera_stamp: np.ndarray, time_offset_s: float = 0.0) -> np.ndarray:
        """T_camera_lidar (4, 4) of sensors on one body, of a camera at its image's time and the lidar at its stamp.

        Args:
            T_camera_stamp: (4, 4) the lidar's frame at its stamp in the camera at the image's.
            time_offset_s: what the image's stamp is ahead of the lidar's clock.
        """
        return T_camera_stamp @ self.at([self.image_s - time_offset_s])[0]

    def twist_at_image(self, time_offset_s: float = 0.0) -> np.ndarray:
        """(6,) how the lidar turned (rotation vector, rad/s) and moved (m/s) when the image was taken, in its own axes."""
        t = self.image_s - time_offset_s
        before, here, after = self.at([t - 0.01, t, t + 0.01])
        turn = Rotation.from_matrix(before[:3, :3].T @ after[:3, :3]).as_rotvec()
        return np.append(turn, here[:3, :3].T @ (after[:3, 3] - before[:3, 3])) / 0.02


def motion_of(poses: list[FramePose], lidar_time_ns: int, image_time_ns: int) -> LidarMotion | None:
    """The motion around a keyframe, or None when it is not known."""
    try:
        return LidarMotion(poses, lidar_time_ns, image_time_ns)
    except NoScale:
        return None
