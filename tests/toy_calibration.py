"""A toy street seen by a lidar and, as a cloud of images, by a camera on one vehicle; everything about them is known."""

from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import yaml

from scripts import calibrate_drive, calibrate_keyframe
from streetscan.calibration.keyframe_calibration import KeyframeClouds
from streetscan.calibration.keyframes import Keyframe, tabulate_keyframes
from streetscan.calibration.linear_projection import View
from streetscan.calibration.motion import LidarMotion
from streetscan.clouds import PointCloud
from streetscan.frames import CameraImage, CameraModel, LidarFrame
from streetscan.geometry import apply, invert, transform
from streetscan.io.images import encode_png
from streetscan.io.las import write_las
from streetscan.io.mcap import open_drive_writer
from streetscan.io.tables import save_tables
from streetscan.io.trajectories import write_poses_csv, write_tum
from streetscan.registration.odometry import FramePose
from streetscan.registration.pose_tables import tabulate_poses

START_NS = 1_700_000_000_000_000_000
HEIGHT_M, SPEED_MPS, WIDTH, IMAGE_HEIGHT, FOCAL_PX = 1.7, 8.0, 640, 480, 450.0
K = np.array([[FOCAL_PX, 0, 319.5], [0, FOCAL_PX, 239.5], [0, 0, 1]])
_AHEAD = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
T_CAMERA_LIDAR = _AHEAD @ invert(transform([0.4, 0.1, -0.2], np.radians([0.4, 1.2, -1.5])))
# The image is taken so much after the lidar's stamp.
IMAGE_S = 0.012


def street_points(seed: int = 0) -> np.ndarray:
    """(N, 3) surfaces of a street along x, frame `lidar` at the stamp: road, walls with recesses, posts, boxes."""
    rng = np.random.default_rng(seed)
    parts = [np.c_[rng.uniform(-15, 35, 60_000), rng.uniform(-9, 9, 60_000), np.zeros(60_000)]]
    for side in (-1, 1):
        for x in np.arange(-15, 35, 5.0):
            depth, n = 9 + rng.uniform(0, 1.5), 3000
            parts.append(np.c_[rng.uniform(x, x + 5, n), np.full(n, side * depth), rng.uniform(0, 5, n)])
            parts.append(np.c_[np.full(n, x), side * rng.uniform(8.8, depth, n), rng.uniform(0, 5, n)])
    for x, y in [(6.5, 4.6), (9.0, -4.1), (12.7, 5.2), (14.1, -5.5), (18.3, 4.4), (21.2, -4.8), (-6, 4), (-9, -5), (24.5, 5.6)]:
        angle, n = rng.uniform(-np.pi, np.pi, 900), 900
        parts.append(np.c_[x + 0.1 * np.cos(angle), y + 0.1 * np.sin(angle), rng.uniform(0, 3.5, n)])
    for x, y, width in [(8.2, 6.5, 0.8), (16.0, -6.4, 1.2), (20.0, 6.6, 0.6), (-4, 6, 1.0)]:
        corners = rng.uniform(0, 1, (1500, 3))
        face = rng.integers(0, 4, 1500)
        corners[np.arange(1500), face // 2] = face % 2
        parts.append(np.array([x, y, 0]) + corners * [width, width, 1.1])
    return np.concatenate(parts) - [0, 0, HEIGHT_M]


def is_in_front(points: np.ndarray, step_rad: float = np.radians(0.5)) -> np.ndarray:
    """(N,) bool: points that nothing hides from the origin; directions are told apart by half a degree."""
    ranges = np.linalg.norm(points, axis=1)
    cells = np.floor(np.c_[np.arctan2(points[:, 1], points[:, 0]), np.arcsin(points[:, 2] / ranges)] / step_rad).astype(int)
    _, cell_of = np.unique(cells, axis=0, return_inverse=True)
    nearest = np.full(cell_of.max() + 1, np.inf)
    np.minimum.at(nearest, cell_of.ravel(), ranges)
    return ranges < 1.03 * nearest[cell_of.ravel()] + 0.15


@dataclass
class ToyKeyframe:
    """Clouds of one keyframe, and what is true.

    `points_stamp` are those of the lidar frame freed of motion, row by row.
    """

    clouds: KeyframeClouds
    points_stamp: np.ndarray
    keyframe: Keyframe
    poses: list[FramePose]

    @property
    def true_pixels(self) -> np.ndarray:
        """(N, 2) of the lidar's points."""
        camera = apply(true_stamp(), self.points_stamp)
        return np.where(camera[:, 2:] > 0.5, camera[:, :2] / camera[:, 2:] @ K[:2, :2].T + K[:2, 2], np.nan)


def true_stamp() -> np.ndarray:
    """T_camera_stamp: the lidar at its stamp in the camera at the image's time."""
    return T_CAMERA_LIDAR @ transform([-SPEED_MPS * IMAGE_S, 0, 0])


def lidar_poses() -> list[FramePose]:
    """Straight on at SPEED_MPS, ten a second, the keyframe's frame in the middle."""
    poses = []
    for k in range(21):
        pose = FramePose(k, START_NS / 1e9 + 0.1 * k, "ok", 0)
        pose.T_segment_lidar = transform([SPEED_MPS * 0.1 * k, 0, 0])
        poses.append(pose)
    return poses


def row_of_posts(spacing_m: float) -> np.ndarray:
    """(N, 3) surfaces of a road along x with equal posts at equal distances on both sides, frame `lidar` at the stamp."""
    rng = np.random.default_rng(0)
    parts = [np.c_[rng.uniform(-20, 45, 80_000), rng.uniform(-9, 9, 80_000), np.zeros(80_000)]]
    angles, heights = rng.uniform(-np.pi, np.pi, 900), rng.uniform(0, 2.4, 900)
    parts += [np.c_[x + 0.1 * np.cos(angles), y + 0.1 * np.sin(angles), heights] for y in (-5, 5) for x in np.arange(-20, 45, spacing_m)]
    return np.concatenate(parts) - [0, 0, HEIGHT_M]


def toy_keyframe(seed: int = 0, scale: float = 1.0, posts_m: float | None = None) -> ToyKeyframe:
    """The keyframe; the camera's cloud is `scale` times as large as it should be, and the street one of posts where they are asked for."""
    rng = np.random.default_rng(seed + 1)
    surface = street_points(seed) if posts_m is None else row_of_posts(posts_m)
    ranges = np.linalg.norm(surface, axis=1)
    stamp = surface[(ranges > 2.5) & (ranges < 40) & is_in_front(surface)]
    offsets = -np.arctan2(stamp[:, 1], stamp[:, 0]) / (2 * np.pi) * 0.1
    raw = stamp - offsets[:, None] * [SPEED_MPS, 0, 0]
    camera = apply(true_stamp(), surface)
    pixels = camera[:, :2] / np.maximum(camera[:, 2:], 0.1) @ K[:2, :2].T + K[:2, 2]
    seen = (camera[:, 2] > 2) & (camera[:, 2] < 35) & ((pixels >= 0) & (pixels < [WIDTH, IMAGE_HEIGHT])).all(axis=1)
    dense = (camera[seen] + rng.normal(0, 0.005, (seen.sum(), 3))) * scale
    lidar_ns = START_NS + 1_000_000_000
    image_ns = [lidar_ns + round((IMAGE_S + 0.036 * i) * 1e9) for i in range(8)]
    way = T_CAMERA_LIDAR[:3, :3] @ [SPEED_MPS, 0, 0]
    cameras = np.array([np.zeros(3), *(way * 0.036 * i for i in range(8))])
    keyframe = Keyframe(0, "ok", "", 10, lidar_ns, list(range(8)), image_ns, [20.0] * 7, 6)
    poses = lidar_poses()
    view = View(np.eye(4), K, WIDTH, IMAGE_HEIGHT)
    clouds = KeyframeClouds(
        raw.astype(np.float32), offsets.astype(np.float32), np.ones(len(raw), bool), dense, np.zeros(len(dense), bool),
        cameras * scale, view, draw_edges(surface), LidarMotion(poses, lidar_ns, image_ns[0]),
    )  # fmt: skip
    return ToyKeyframe(clouds, stamp, keyframe, poses)


def draw_edges(surface: np.ndarray) -> np.ndarray:
    """An image (H, W, 3) uint8 of the street, the darker the farther away: steps in depth are edges."""
    camera = apply(true_stamp(), surface)
    camera = camera[camera[:, 2] > 2]
    u, v = np.rint(camera[:, :2] / camera[:, 2:] @ K[:2, :2].T + K[:2, 2]).astype(int).T
    inside = (u >= 0) & (u < WIDTH) & (v >= 0) & (v < IMAGE_HEIGHT)
    # The road is even; of all else the nearest point within two pixels is seen.
    rays = np.dstack([*np.meshgrid(np.arange(WIDTH), np.arange(IMAGE_HEIGHT)), np.ones((IMAGE_HEIGHT, WIDTH))]) @ np.linalg.inv(K).T
    down = -(rays @ T_CAMERA_LIDAR[:3, 2])
    height = HEIGHT_M + float(invert(T_CAMERA_LIDAR)[2, 3])
    depth = np.where(down > 0.01, height / np.maximum(down, 0.01), 60.0).clip(max=60.0)
    np.minimum.at(depth, (v[inside], u[inside]), camera[inside, 2])
    grey = (250 - 4 * cv2.erode(depth, np.ones((5, 5)))).astype(np.uint8)
    return np.repeat(grey[..., None], 3, axis=2)


def write_keyframe(folder: Path, toy: ToyKeyframe) -> dict[str, Path]:
    """Drive, keyframes, poses, reconstruction and truth of the toy as the steps before calibrate_keyframe write them."""
    folder.mkdir(parents=True, exist_ok=True)
    camera, c = CameraModel(WIDTH, IMAGE_HEIGHT, K, np.zeros(5), "plumb_bob", np.c_[K, np.zeros(3)]), toy.clouds
    with open_drive_writer(folder / "drive.mcap") as writer:
        writer.write_calibration(camera, START_NS)
        frame = LidarFrame(toy.keyframe.lidar_time_ns, c.points_lidar, time_offset_s=c.time_offset_s)
        writer.write_lidar(frame)
        for time_ns in toy.keyframe.image_times_ns:
            writer.write_image(CameraImage(time_ns, encode_png(c.image), "png"))
    save_tables({folder / "keyframes.csv": tabulate_keyframes([toy.keyframe]), folder / "poses.csv": tabulate_poses(toy.poses)})
    model = folder / "model"
    model.mkdir(exist_ok=True)
    n = len(c.points_sfm)
    fields = {
        "rgb": np.zeros((n, 3), np.uint8),
        "classification": np.ones(n, np.uint8),
        "is_dynamic": np.zeros(n, bool),
        "n_views": np.full(n, 4, np.uint8),
    }
    write_las(model / "dense.laz", PointCloud(c.points_sfm, fields))
    images = [
        {"time_ns": t, "T_image_camera": transform(-p).tolist()}
        for t, p in zip(toy.keyframe.image_times_ns, c.cameras_sfm[1:], strict=True)
    ]
    facts = {"image_width": WIDTH, "image_height": IMAGE_HEIGHT, "camera_matrix": K.tolist(), "reference": 0, "images": images}
    (model / "cameras.yaml").write_text(yaml.safe_dump(facts | {"projection": np.c_[K, np.zeros(3)].tolist(), "projection_error_px": 0.5}))
    (folder / "summary.csv").write_text("keyframe,status,reason,reference\n00,ok,,0\n")
    _write_truth(folder / "truth", toy)
    names = {"drive_path": "drive.mcap", "keyframes_path": "keyframes.csv", "poses_path": "poses.csv", "model_folder": "model"}
    return {key: folder / name for key, name in (names | {"model_summary_path": "summary.csv"}).items()}


def _write_truth(folder: Path, toy: ToyKeyframe) -> None:
    (folder / "instances").mkdir(parents=True, exist_ok=True)
    times_s = START_NS / 1e9 + np.arange(0, 2.0, 0.005)
    vehicle = transform(np.c_[SPEED_MPS * np.arange(0, 2.0, 0.005), np.zeros((400, 2))])
    write_tum(folder / "trajectory.tum", times_s, vehicle)
    stamps_s = np.array(toy.keyframe.image_times_ns) / 1e9
    lidar = transform(np.c_[SPEED_MPS * (stamps_s - START_NS / 1e9), np.zeros((8, 2))])
    write_poses_csv(folder / "camera_poses.csv", np.arange(8), stamps_s, lidar @ invert(T_CAMERA_LIDAR))
    np.save(folder / "instances" / "000010.npy", np.zeros(len(toy.points_stamp), np.uint32))
    (folder / "objects.csv").write_text("frame,instance,speed_mps\n10,5,3.0\n")
    truth = {
        "mountings": {"T_vehicle_lidar": np.eye(4).tolist()},
        "extrinsics": {"T_camera_lidar": T_CAMERA_LIDAR.tolist(), "time_offset_s": 0.0},
    }
    (folder / "truth.yaml").write_text(yaml.safe_dump(truth))


def changed(toy: ToyKeyframe, **values) -> KeyframeClouds:
    """The toy's clouds with other values."""
    return replace(toy.clouds, **values)


def calibrate_toy(
    folder: Path, inputs: dict[str, Path], settings: dict | None = None, dynamic_folder: Path | None = None
) -> dict[str, Path]:
    """Run calibrate_keyframe into a folder; its outputs."""
    # Outlines in the toy's picture are blurred by two pixels.
    settings = {"final": "motion", "quality": {"min_edge_margin_px": -2.0}} if settings is None else settings
    names = {"calibration_path": "calibration.yaml", "evidence_path": "evidence.npz", "summary_path": "calibrated.csv"}
    outputs = {key: folder / name for key, name in names.items()} | {"pictures_folder": folder / "pictures"}
    calibrate_keyframe.main(**inputs, dynamic_folder=dynamic_folder, keyframe=0, settings=settings, **outputs)
    return outputs


def combine_toy(folder: Path, inputs: dict[str, Path], calibrated: dict[str, Path]) -> dict[str, Path]:
    """Run calibrate_drive on the one keyframe; its outputs."""
    drive = {key: inputs[key] for key in ("drive_path", "keyframes_path", "poses_path")}
    found = {"calibration_paths": [calibrated["calibration_path"]], "evidence_paths": [calibrated["evidence_path"]]}
    outputs = {"calibration_path": folder / "drive.yaml", "history_path": folder / "history.csv"}
    calibrate_drive.main(**drive, **found, **outputs, settings={}, seed=1)
    return outputs
