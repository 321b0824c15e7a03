"""A toy street seen by a lidar and, as a cloud of images, by a camera on one vehicle; everything about them is known."""

from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import yaml

from scripts import calibrate_drive, calibrate_keyframe
from streetscan.calibration.keyframe_calibration import KeyframeClouds
from streetscan.calibration.keyframes import Keyframe, tabulate_keyframes
from streetscan.calibration.linear_projection import View
from streetscan.calibration.motion import LidarMotion
from streetscan.calibration.ways import lidar_way
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


@dataclass(frozen=True)
class Street:
    """What stands on an even road, seen from above, frame `lidar` at the stamp.

    Attributes:
        sides: (n, 5) x and y of both ends, and height above the road, of upright faces.
        posts: (m, 4) x, y, radius and height.
    """

    sides: np.ndarray
    posts: np.ndarray

    def cast(self, origin: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """How often rays (N, 3) must be taken from an origin (3,) to what they hit, infinite for the sky, and its number; 0 is the road."""
        with np.errstate(divide="ignore"):
            times = np.where(rays[:, 2] < 0, -(HEIGHT_M + origin[2]) / rays[:, 2], np.inf)
        numbers, (x, y) = np.zeros(len(rays), int), rays[:, :2].T
        hits = []
        for x0, y0, x1, y1, height in self.sides - [*origin[:2], *origin[:2], 0]:
            with np.errstate(divide="ignore", invalid="ignore"):
                across = x * (y1 - y0) - y * (x1 - x0)
                share = (x0 * y - y0 * x) / across
                hits.append((np.where((share >= 0) & (share <= 1), (x0 * (y1 - y0) - y0 * (x1 - x0)) / across, -1), height))
        for px, py, radius, height in self.posts - [*origin[:2], 0, 0]:
            squares, along = x**2 + y**2, x * px + y * py
            root = along**2 - squares * (px**2 + py**2 - radius**2)
            hits.append((np.where(root > 0, (along - np.sqrt(np.maximum(root, 0))) / squares, -1), height))
        for number, (t, height) in enumerate(hits, 1):
            z = HEIGHT_M + origin[2] + rays[:, 2] * t
            is_nearer = (t > 0) & (t < times) & (z >= 0) & (z <= height)
            times, numbers = np.where(is_nearer, t, times), np.where(is_nearer, number, numbers)
        return times, numbers


def street(seed: int = 0) -> Street:
    """Walls with recesses along x, posts and boxes."""
    rng = np.random.default_rng(seed)
    sides = []
    for side in (-1, 1):
        for x in np.arange(-15, 35, 5.0):
            depth = side * (9 + rng.uniform(0, 1.5))
            sides += [(x, depth, x + 5, depth, 5), (x, side * 8.8, x, depth, 5)]
    for x, y, width in [(8.2, 6.5, 0.8), (16.0, -6.4, 1.2), (20.0, 6.6, 0.6), (-4, 6, 1.0)]:
        corners = [(x, y), (x + width, y), (x + width, y + width), (x, y + width), (x, y)]
        sides += [(*a, *b, 1.1) for a, b in pairwise(corners)]
    places = [(6.5, 4.6), (9.0, -4.1), (12.7, 5.2), (14.1, -5.5), (18.3, 4.4), (21.2, -4.8), (-6, 4), (-9, -5), (24.5, 5.6)]
    return Street(np.array(sides), np.array([(x, y, 0.1, 3.5) for x, y in places]))


def row_of_posts(spacing_m: float) -> Street:
    """Nothing but equal posts at equal distances on both sides."""
    return Street(np.empty((0, 5)), np.array([(x, y, 0.1, 2.4) for y in (-5, 5) for x in np.arange(-20, 45, spacing_m)]))


def scan(seen: Street) -> np.ndarray:
    """(N, 3) points of a lidar's rings, frame `lidar` at the stamp."""
    azimuths, elevations = np.meshgrid(np.radians(np.arange(-180, 180, 0.2)), np.radians(np.arange(-25, 15, 0.8)))
    rays = np.stack([np.cos(elevations) * np.cos(azimuths), np.cos(elevations) * np.sin(azimuths), np.sin(elevations)], axis=-1)
    times, _ = seen.cast(np.zeros(3), rays.reshape(-1, 3))
    return (rays.reshape(-1, 3) * times[:, None])[(times > 2.5) & (times < 40)]


def look(seen: Street, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What the camera has at pixels (N, 2): points (N, 3) in its frame, infinitely far for the sky, and their number (N,)."""
    T_stamp_camera, rays = invert(true_stamp()), np.c_[pixels, np.ones(len(pixels))] @ np.linalg.inv(K).T
    depths, numbers = seen.cast(T_stamp_camera[:3, 3], rays @ T_stamp_camera[:3, :3].T)
    return np.where(np.isfinite(depths), depths, 1e6)[:, None] * rays, numbers


def take_picture(seen: Street) -> np.ndarray:
    """The image (H, W, 3) uint8: each thing has a grey of its own."""
    points, numbers = look(seen, np.dstack(np.meshgrid(np.arange(WIDTH), np.arange(IMAGE_HEIGHT))).reshape(-1, 2))
    greys = np.where(points[:, 2] < 1e5, 40 + 160 * (numbers * 0.618 % 1), 250).astype(np.uint8)
    return np.repeat(greys.reshape(IMAGE_HEIGHT, WIDTH, 1), 3, axis=2)


def reconstruct(seen: Street) -> np.ndarray:
    """(N, 3) points of the camera's cloud; near the horizon rows are closer, so that the road has no gaps."""
    rows = np.r_[0:IMAGE_HEIGHT:2, IMAGE_HEIGHT / 2 - 20 : IMAGE_HEIGHT / 2 + 60 : 0.25]
    points, _ = look(seen, np.dstack(np.meshgrid(np.arange(0, WIDTH, 2), rows)).reshape(-1, 2))
    return points[(points[:, 2] > 2) & (points[:, 2] < 35)]


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


def toy_keyframe(seed: int = 0, scale: float = 1.0, posts_m: float | None = None) -> ToyKeyframe:
    """The keyframe; the camera's cloud is `scale` times as large as it should be, and the street one of posts where they are asked for."""
    rng = np.random.default_rng(seed + 1)
    seen = street(seed) if posts_m is None else row_of_posts(posts_m)
    stamp, camera = scan(seen), reconstruct(seen)
    offsets = -np.arctan2(stamp[:, 1], stamp[:, 0]) / (2 * np.pi) * 0.1
    raw = stamp - offsets[:, None] * [SPEED_MPS, 0, 0]
    dense = (camera + rng.normal(0, 0.005, camera.shape)) * scale
    lidar_ns = START_NS + 1_000_000_000
    image_ns = [lidar_ns + round((IMAGE_S + 0.036 * i) * 1e9) for i in range(8)]
    way = T_CAMERA_LIDAR[:3, :3] @ [SPEED_MPS, 0, 0]
    cameras = np.array([np.zeros(3), *(way * 0.036 * i for i in range(8))])
    keyframe = Keyframe(0, "ok", "", 10, lidar_ns, list(range(8)), image_ns, [20.0] * 7, 6)
    poses = lidar_poses()
    view = View(np.eye(4), K, WIDTH, IMAGE_HEIGHT)
    clouds = KeyframeClouds(
        raw.astype(np.float32), offsets.astype(np.float32), np.ones(len(raw), bool), dense, np.zeros(len(dense), bool),
        cameras * scale, view, take_picture(seen), LidarMotion(poses, lidar_ns, image_ns[0]),
        image_times_ns=tuple(image_ns), way=lidar_way(poses, lidar_ns, image_ns, image_ns[0]),
    )  # fmt: skip
    return ToyKeyframe(clouds, stamp, keyframe, poses)


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
    settings = {"final": "motion"} if settings is None else settings
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
