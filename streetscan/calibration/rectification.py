"""Images without lens distortion: the pinhole camera that everything after it assumes.

Source: Nagy (2020), 4.3.1 (1), N-204.
"""

from functools import lru_cache

import cv2
import numpy as np

from streetscan.errors import BadInput
from streetscan.frames import CameraModel, camera_model


def rectify_image(image: np.ndarray, camera: CameraModel | None, where: object = "camera") -> np.ndarray:
    """The image as a pinhole camera with the same K and size would have taken it.

    ASSUME: the same K, not `camera.P`; a drive's P may shift or scale the picture, and the extrinsics we look for belong to K.
    Pixels the lens did not see are black.

    Args:
        image: (H, W) or (H, W, 3) uint8, pixel centres at integers.
        camera: its intrinsics, as `streetscan.io.mcap.read_camera_model` gives them.
        where: the drive or image, named in errors.
    Returns:
        An array of the same shape and dtype; bilinear between pixels.
    Raises:
        BadInput: no intrinsics, a focal length that is not above zero, a distortion model we do not know, or another size than the image.
    """
    checked = check_camera(camera, where)
    if image.shape[:2] != (checked.height, checked.width):
        found = f"an image of {image.shape[1]} x {image.shape[0]} pixels for intrinsics of {checked.width} x {checked.height}"
        raise BadInput(where, found, "give the intrinsics of these images")
    if not checked.D.any():
        return image
    maps = _maps(checked.width, checked.height, tuple(checked.K.ravel()), tuple(checked.D), checked.distortion_model)
    return cv2.remap(image, *maps, interpolation=cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=0)


def check_camera(camera: CameraModel | None, where: object) -> CameraModel:
    """The intrinsics, sure to be usable. BadInput as in `rectify_image`."""
    if camera is None:
        raise BadInput(where, "holds no intrinsics of a camera", "add calibration to the camera of the drive's file")
    if camera.width < 1 or camera.height < 1:
        raise BadInput(where, f"intrinsics of {camera.width} x {camera.height} pixels", "give the size of the images")
    return camera_model(camera.width, camera.height, camera.K, camera.D, camera.distortion_model, camera.P, where)


@lru_cache(maxsize=4)
def _maps(width: int, height: int, K: tuple, D: tuple, distortion_model: str) -> tuple[np.ndarray, np.ndarray]:
    """Where each rectified pixel lies in the distorted image, (H, W) float32 each."""
    K, D = np.array(K).reshape(3, 3), np.array(D)
    if distortion_model == "kannala_brandt":
        return cv2.fisheye.initUndistortRectifyMap(K, D, np.eye(3), K, (width, height), cv2.CV_32FC1)
    return cv2.initUndistortRectifyMap(K, D, np.eye(3), K, (width, height), cv2.CV_32FC1)
