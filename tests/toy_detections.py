"""A tiny drive with a camera, a lidar, one car and a person, and all their truth, as simulate_drive writes it."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
import yaml

from streetscan.classes import CAR, PEDESTRIAN
from streetscan.frames import CameraImage, CameraModel, LidarFrame
from streetscan.geometry import transform
from streetscan.io.images import encode_png
from streetscan.io.mcap import open_drive_writer
from streetscan.io.trajectories import write_poses_csv

START_NS = 1_700_000_000_000_000_000
WIDTH, HEIGHT, SPEED_MPS = 128, 96, 5.0
CAR_AT, CAR_SIZE, CAR_YAW = np.array([8.0, 4.0, 0.8]), np.array([4.4, 1.8, 1.5]), 0.3
CAMERA = CameraModel(
    WIDTH, HEIGHT, np.array([[100.0, 0, 63.5], [0, 100.0, 47.5], [0, 0, 1]]), np.array([-0.1, 0.02, 0, 0, 0]), "plumb_bob", np.zeros((3, 4))
)


@dataclass
class DetectionDrive:
    """The drive's files."""

    folder: Path
    n_frames: int

    @property
    def mcap(self) -> str:
        return str(self.folder / "drive.mcap")

    @property
    def truth(self) -> str:
        return str(self.folder / "truth")


def picture(number: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Image, labels and objects: a red car on the left, a blue person on the right, both in front of grey noise."""
    rng = np.random.default_rng(number)
    image = rng.integers(90, 130, (HEIGHT, WIDTH, 3)).astype(np.uint8)
    labels, instances = np.ones((HEIGHT, WIDTH), np.uint8), np.zeros((HEIGHT, WIDTH), np.uint32)
    for rows, columns, label, colour in (
        (slice(50, 78), slice(14 + number, 58 + number), CAR, (200, 30, 30)),
        (slice(40, 80), slice(90 - number, 104 - number), PEDESTRIAN, (30, 40, 210)),
    ):
        image[rows, columns] = colour + rng.integers(-20, 20, (rows.stop - rows.start, columns.stop - columns.start, 3))
        labels[rows, columns], instances[rows, columns] = label, 1000 + label
    return image, labels, instances


def car_points(rng: np.random.Generator, n: int = 600) -> np.ndarray:
    """Points on the sides and the roof of the car, in `map`."""
    unit = rng.uniform(-0.5, 0.5, (n, 3))
    face = rng.integers(0, 3, n)
    unit[np.arange(n), face] = np.where(rng.random(n) < 0.5, -0.5, 0.5)
    unit[face == 2, 2] = 0.5
    turned = transform(CAR_AT, (0.0, 0.0, CAR_YAW))
    return (unit * CAR_SIZE) @ turned[:3, :3].T + turned[:3, 3]


def write_detection_drive(folder: Path, n_frames: int = 4) -> DetectionDrive:
    """The vehicle drives along x through `map`, the lidar 1.7 m above the road z = 0; the car stands, and is in objects.csv; the person is
    not, as people who stand are."""
    truth, poses = folder / "truth", np.stack([transform((0.1 * SPEED_MPS * k, 0.0, 1.7)) for k in range(n_frames)])
    for name in ("labels", "instances", "masks"):
        (truth / name).mkdir(parents=True)
    times_ns = START_NS + 100_000_000 * np.arange(n_frames)
    with open_drive_writer(folder / "drive.mcap") as writer:
        writer.write_calibration(CAMERA, START_NS)
        for k in range(n_frames):
            rng = np.random.default_rng([7, k])
            ground = np.c_[rng.uniform(-18, 18, (3000, 2)), rng.normal(0, 0.02, 3000)]
            person = np.c_[rng.normal((5.0, -3.0), 0.12, (80, 2)), rng.uniform(0, 1.7, 80)]
            offsets = np.repeat([0.02, -0.03, 0.04], (3000, 600, 80)).astype(np.float32)
            points = np.concatenate([ground, car_points(rng), person])
            origin = np.c_[0.1 * SPEED_MPS * k + SPEED_MPS * offsets, np.zeros(len(offsets)), np.full(len(offsets), 1.7)]
            labels = np.repeat([0, CAR, PEDESTRIAN], (3000, 600, 80)).astype(np.uint32)
            writer.write_lidar(LidarFrame(int(times_ns[k]), (points - origin).astype(np.float32), time_offset_s=offsets))
            np.save(truth / "labels" / f"{k:06d}.npy", labels)
            np.save(truth / "instances" / f"{k:06d}.npy", labels * 100)
            image, of_pixels, instances = picture(k)
            writer.write_image(CameraImage(int(times_ns[k]), encode_png(image), "png"))
            np.savez(truth / "masks" / f"{k:06d}.npz", labels=of_pixels, instances=instances)
    write_poses_csv(truth / "poses.csv", np.arange(n_frames), times_ns / 1e9, poses)
    car = {"instance": 100 * CAR, "class": "car", "x_m": CAR_AT[0], "y_m": CAR_AT[1], "z_m": CAR_AT[2] - CAR_SIZE[2] / 2}
    car |= {"yaw_rad": CAR_YAW, "speed_mps": 0.0} | dict(zip(("length_m", "width_m", "height_m"), CAR_SIZE, strict=True))
    rows = [{"frame": k, "time_s": f"{t / 1e9:.9f}"} | car for k, t in enumerate(times_ns)]
    pd.DataFrame(rows).to_csv(truth / "objects.csv", index=False)
    (truth / "truth.yaml").write_text(yaml.safe_dump({"labels": {"ids": "streetscan"}, "masks": {"type": "as simulate_drive"}}))
    return DetectionDrive(folder, n_frames)
