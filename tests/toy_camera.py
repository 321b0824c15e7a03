"""A street of textured planes seen by a camera, with exact depths: for tests of the calibration from images."""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from streetscan.frames import CameraImage, CameraModel, LidarFrame
from streetscan.geometry import invert, transform, transform_of_rotation
from streetscan.io.images import encode_png
from streetscan.io.mcap import open_drive_writer
from streetscan.registration.odometry import FramePose

# Planes n . p = d of the frame of the first camera (x right, y down, z forward): road, slope, house fronts, the end of the street.
START_S = 1_700_000_000.0
# Rays along a pixel's side.
_FINER = 3
_PLANES = ((0, 1, 0.06, 1.6), (1, 0, 0, 5.0), (-1, 0, 0, 6.0), (0, -0.25, 1, 30.0))


@dataclass
class ToyStreet:
    """Images, poses T_first_camera (n, 4, 4) and depths along z of a drive through the street."""

    camera: CameraModel
    images: list[np.ndarray]
    poses: np.ndarray
    depths: list[np.ndarray]


def toy_camera(width: int = 400, height: int = 300, focal_px: float = 300.0) -> CameraModel:
    """Intrinsics without distortion; the principal point is off the middle."""
    K = np.array([[focal_px, 0, width / 2 + 3.3], [0, focal_px, height / 2 - 2.7], [0, 0, 1]])
    return CameraModel(width, height, K, np.zeros(0), "plumb_bob", np.c_[K, np.zeros(3)])


def forward_poses(n: int, step_m: float = 0.5) -> np.ndarray:
    """T_first_camera (n, 4, 4) of a camera that drives forward, swaying a little."""
    poses = []
    for i in range(n):
        turn = cv2.Rodrigues(np.array([0.004 * np.sin(1.3 * i), 0.006 * i, 0.003 * np.cos(i)]))[0]
        poses.append(transform_of_rotation(turn, [0.03 * np.sin(i), 0.02 * np.cos(2 * i), step_m * i]))
    return invert(poses[0]) @ np.array(poses)


def render(T_first_camera: np.ndarray, camera: CameraModel) -> tuple[np.ndarray, np.ndarray]:
    """The street's image (H, W, 3) uint8 and its depth (H, W) along z."""
    v, u = np.mgrid[: camera.height * _FINER, : camera.width * _FINER] / _FINER + (0.5 / _FINER - 0.5)
    value, depth = _shade(u, v, T_first_camera, camera)
    blurred = cv2.GaussianBlur(value, None, 0.6 * _FINER)
    image = cv2.resize(blurred, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    # With three rays to a pixel's side, the middle one goes through its centre.
    return np.repeat(np.rint(np.clip(image, 0, 255)).astype(np.uint8)[..., None], 3, axis=2), depth[
        _FINER // 2 :: _FINER, _FINER // 2 :: _FINER
    ]


def toy_images(n: int, camera: CameraModel, step_m: float = 0.5) -> tuple[list[np.ndarray], np.ndarray, list[np.ndarray]]:
    """n images of a drive, their poses and their depths."""
    poses = forward_poses(n, step_m)
    shown = [render(T, camera) for T in poses]
    return [image for image, _ in shown], poses, [depth for _, depth in shown]


def camera_images(images: list[np.ndarray], times_ns: list[int]) -> list[CameraImage]:
    """Images as a drive holds them."""
    return [CameraImage(int(t), encode_png(image), "png") for image, t in zip(images, times_ns, strict=True)]


def lidar_poses(n_images: int) -> list[FramePose]:
    """Poses of a lidar that sits at the camera, at 10 Hz, as many frames before and after the images as they last."""
    poses = []
    for i in range(-n_images, 2 * n_images):
        # As the camera of `forward_poses` turns, about the lidar's z instead of the camera's y.
        T = transform([0.5 * i, 0, 0], [0, 0, -0.006 * i])
        poses.append(FramePose(i + n_images, START_S + 0.1 * i, "ok", 0, T_segment_lidar=T))
    return poses


def write_camera_drive(path: Path, n_images: int) -> Path:
    """Write a drive of images at 10 Hz with a few lidar points beside each; its path."""
    camera = toy_camera()
    images = toy_images(n_images, camera)[0]
    times_ns = [round(START_S * 1e9) + i * 100_000_000 for i in range(n_images)]
    with open_drive_writer(path) as writer:
        writer.write_calibration(camera, times_ns[0])
        for time_ns in times_ns:
            writer.write_lidar(LidarFrame(time_ns, np.ones((3, 3), np.float32)))
        for image in camera_images(images, times_ns):
            writer.write_image(image)
    return path


def _shade(u, v, T, camera: CameraModel) -> tuple[np.ndarray, np.ndarray]:
    rays = np.stack([(u - camera.K[0, 2]) / camera.K[0, 0], (v - camera.K[1, 2]) / camera.K[1, 1], np.ones_like(u)], axis=-1)
    directions, origin = rays @ T[:3, :3].T, T[:3, 3]
    depth, value = np.full(u.shape, np.inf), np.zeros(u.shape)
    for number, (*normal, offset) in enumerate(_PLANES):
        with np.errstate(divide="ignore", invalid="ignore"):
            t = (offset - origin @ np.array(normal)) / (directions @ np.array(normal))
        nearer = (t > 0) & (t < depth)
        depth[nearer] = t[nearer]
        points = origin + directions[nearer] * t[nearer][:, None]
        a, b = [axis for axis in range(3) if axis != int(np.argmax(np.abs(normal)))]
        value[nearer] = _texture(points[:, a], points[:, b], t[nearer] / camera.K[0, 0], number)
    return value, depth


def _texture(a: np.ndarray, b: np.ndarray, pixel_m: np.ndarray, seed: int) -> np.ndarray:
    """Grey levels at places (a, b) in metres: tiles of three sizes, whose corners can be found; tiles finer than a pixel are grey."""
    grey = np.full(len(a), 120.0)
    for octave, size_m in enumerate((1.3, 0.47)):
        tiles = np.random.default_rng(100 * seed + octave).uniform(-45, 45, (64, 64))
        value = tiles[np.floor(b / size_m).astype(int) % 64, np.floor(a / size_m).astype(int) % 64]
        grey += value * np.clip(size_m / (2 * pixel_m) - 0.5, 0, 1)
    return grey
