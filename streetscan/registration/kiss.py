"""KISS-ICP (Vizzo et al. 2023) as a peer behind the same call, with its own prediction, de-skewing, threshold and map."""

import numpy as np
from kiss_icp.config import KISSConfig
from kiss_icp.kiss_icp import KissICP

from streetscan.registration.odometry import Frame, FramePose, OdometrySettings, motion_of, select_points, twist_of


class KissOdometry:
    """KISS-ICP with its own defaults at 100 m range; of our settings it takes the classes, ranges, threads and `is_deskewed`."""

    def __init__(self, settings: OdometrySettings):
        self._settings = settings
        config = KISSConfig()
        config.data.max_range = settings.max_range_m
        # Its own choice where none is given.
        config.mapping.voxel_size = settings.max_range_m / 100
        config.data.deskew = settings.is_deskewed
        config.registration.max_num_threads = settings.n_threads
        self._kiss = KissICP(config)
        self._deviations: list[np.ndarray] = []
        self._last_stamp_s = -np.inf

    @property
    def has_begun(self) -> bool:
        return bool(np.isfinite(self._last_stamp_s))

    def add(self, frame: Frame) -> FramePose:
        """The pose of the next frame. KISS-ICP does not judge itself: every frame with enough points and a later stamp is ok."""
        pose = FramePose(frame.index, float(frame.time_s), "ok", 0)
        if not frame.time_s > self._last_stamp_s:
            pose.status = "time_backwards"
            return pose
        wanted = select_points(frame.points, frame.labels, self._settings.classes, self._settings.max_range_m)
        pose.n_points = len(wanted)
        if len(wanted) < self._settings.min_points:
            pose.status = "too_few_points" if np.isfinite(frame.points).all(axis=1).any() else "empty"
            self._last_stamp_s = frame.time_s
            return pose
        pose.status = "ok" if self._deviations else "start"
        points = np.asarray(frame.points)[wanted].astype(np.float64)
        offsets = np.zeros(0) if frame.time_offset_s is None else frame.time_offset_s[wanted].astype(np.float64)
        prediction = self._kiss.last_pose @ self._kiss.last_delta
        self._kiss.register_frame(points, offsets)
        self._deviations.append(np.linalg.inv(prediction) @ self._kiss.last_pose)
        pose.T_segment_lidar = self._at_stamp(offsets)
        self._last_stamp_s = frame.time_s
        return pose

    def _at_stamp(self, offsets: np.ndarray) -> np.ndarray:
        """The pose at the frame's stamp: KISS-ICP gives that of the last firing, which with us is half a revolution later."""
        T = self._kiss.last_pose
        if len(offsets) == 0 or not self._settings.is_deskewed or not np.ptp(offsets) > 0:
            return T.copy()
        # Its constant motion lasts from the first firing to the last one.
        return T @ motion_of(-twist_of(self._kiss.last_delta) * offsets.max() / np.ptp(offsets))

    def state(self) -> dict[str, np.ndarray]:
        """Arrays from which `restore` continues here."""
        return {
            "last_pose": self._kiss.last_pose,
            "last_delta": self._kiss.last_delta,
            "map": self._kiss.local_map.point_cloud().reshape(-1, 3),
            "deviations": np.array(self._deviations).reshape(-1, 4, 4),
            "last_stamp_s": np.array(self._last_stamp_s),
        }

    def restore(self, state: dict[str, np.ndarray]) -> None:
        """See `state`; the settings must be the same."""
        self._kiss.last_pose, self._kiss.last_delta = state["last_pose"], state["last_delta"]
        self._kiss.local_map.clear()
        self._kiss.local_map.add_points(state["map"])
        self._deviations = list(state["deviations"])
        # Its threshold can only be led to where it was.
        for deviation in self._deviations:
            self._kiss.adaptive_threshold.update_model_deviation(deviation)
        self._last_stamp_s = float(state["last_stamp_s"])
