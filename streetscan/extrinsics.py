"""Where a camera truly sits on its vehicle, as the truth.yaml of a drive tells it: a knock in mid-drive leaves it elsewhere."""

from typing import Any

import numpy as np


def is_after_shift(place: dict[str, Any], image_time_ns: float) -> bool:
    """Whether a camera had been moved when it took an image; see `extrinsics_at`."""
    return "shift" in place and image_time_ns >= place["shift"]["from_image_time_ns"]


def extrinsics_at(place: dict[str, Any], image_time_ns: float) -> np.ndarray:
    """T_camera_lidar (4, 4) that held at an image: p_camera = T_camera_lidar @ p_lidar, metres.

    Args:
        place: `T_camera_lidar` from the start on; of a camera that was moved `shift` too, with `from_image_time_ns`, the stamp of images
            from which on its own `T_camera_lidar` holds.
        image_time_ns: stamp of the image; inf is the end of the drive.
    """
    return np.array((place["shift"] if is_after_shift(place, image_time_ns) else place)["T_camera_lidar"])
