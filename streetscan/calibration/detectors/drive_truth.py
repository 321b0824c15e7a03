"""True objects of a drive, for training on drives of the training parts and for evaluation; no method reads them."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pandas as pd

from streetscan import geometry
from streetscan.calibration.detectors.image_detections import DYNAMIC_LABELS
from streetscan.calibration.detectors.lidar_boxes import points_in_boxes
from streetscan.classes import LABELS
from streetscan.frames import CameraImage, LidarFrame
from streetscan.io.arrays import load_npy, load_npz
from streetscan.io.mcap import iterate_images, iterate_lidar
from streetscan.io.trajectories import read_poses_csv

# An object that stands still is known from at least so many points.
_LEAST_POINTS = 30
_LONGEST_M, _PIECE_M = 14.0, 10.0


@dataclass
class TrueBoxes:
    """The moving things of a lidar frame that some of its points lie on.

    Attributes:
        boxes: (M, 7) float64, as `lidar_boxes`.
        labels: (M,) uint8, of DYNAMIC_LABELS.
        n_points: (M,) int64, the points on them.
    """

    boxes: np.ndarray
    labels: np.ndarray
    n_points: np.ndarray


def iterate_true_masks(drive_path: str | Path, truth_folder: str | Path) -> Iterator[tuple[CameraImage, np.ndarray, np.ndarray]]:
    """Each image of a simulated drive with its true labels (H, W) uint8 and objects (H, W) uint32."""
    for number, image in enumerate(iterate_images(drive_path)):
        yield image, *read_true_mask(truth_folder, number)


def iterate_true_labels(drive_path: str | Path, truth_folder: str | Path) -> Iterator[tuple[LidarFrame, np.ndarray]]:
    """Each lidar frame with the true label ids (N,) of its points; frames whose labels are not known are left out."""
    for number, frame in enumerate(iterate_lidar(drive_path)):
        path = Path(truth_folder) / "labels" / f"{number:06d}.npy"
        if path.is_file():
            yield frame, load_npy(path, "the drive's own step", len(frame))


def read_true_mask(truth_folder: str | Path, number: int) -> tuple[np.ndarray, np.ndarray]:
    """True labels (H, W) uint8 and objects (H, W) uint32 of a drive's image. BadInput when the file is missing or damaged."""
    return load_npz(Path(truth_folder) / "masks" / f"{number:06d}.npz", ("labels", "instances"), "simulate_drive")


def iterate_true_boxes(drive_path: str | Path, truth_folder: str | Path) -> Iterator[tuple[LidarFrame, TrueBoxes]]:
    """Each lidar frame of a simulated drive with the boxes of what could move.

    A box is where the object was when the beam passed it: in the lidar's frame at that firing, as the points are. What stands still
    throughout and is not in objects.csv has the smallest box about its points of all frames.
    """
    truth = _DriveTruth(drive_path, Path(truth_folder))
    standing = truth.find_standing()
    for number, frame in enumerate(iterate_lidar(drive_path)):
        boxes, classes, counts = [], [], []
        for key, mine, time_s in truth.seen_objects(number, frame):
            box = truth.moving_box(key, time_s) if key in truth.tracks else standing.get(key)
            if box is None:
                continue
            pieces = _cut(_into_lidar(box, truth.pose(time_s)))
            on_piece = points_in_boxes(frame.points[mine], pieces, 0.2).sum(axis=0)
            boxes.append(pieces[on_piece > 0])
            counts.append(on_piece[on_piece > 0])
            classes.append(np.full(len(boxes[-1]), truth.labels[key], np.uint8))
        yield (
            frame,
            TrueBoxes(
                np.concatenate([np.zeros((0, 7)), *boxes]),
                np.concatenate([np.zeros(0, np.uint8), *classes]),
                np.concatenate([np.zeros(0, np.int64), *counts]),
            ),
        )


class _DriveTruth:
    """What truth/ says of a drive's objects and of the lidar's way."""

    def __init__(self, drive_path: str | Path, folder: Path):
        self._drive_path, self._folder = drive_path, folder
        objects = pd.read_csv(folder / "objects.csv").sort_values("frame", kind="stable")
        self.tracks = dict(iter(objects.groupby("instance")))
        self.labels = {key: LABELS[rows["class"].iloc[0]] for key, rows in self.tracks.items()}
        _, self._times_s, self._poses = read_poses_csv(folder / "poses.csv")

    def seen_objects(self, number: int, frame: LidarFrame) -> Iterator[tuple[int, np.ndarray, float]]:
        """Objects of DYNAMIC_LABELS that points of a frame lie on: key, the points' mask, and when the beam passed them."""
        instances = load_npy(self._folder / "instances" / f"{number:06d}.npy", "simulate_drive", len(frame))
        labels = load_npy(self._folder / "labels" / f"{number:06d}.npy", "simulate_drive", len(frame))
        of_moving = np.isin(labels, DYNAMIC_LABELS)
        for key in np.unique(instances[of_moving]):
            mine = of_moving & (instances == key)
            self.labels.setdefault(key, int(np.bincount(labels[mine]).argmax()))
            offset_s = 0.0 if frame.time_offset_s is None else float(np.median(frame.time_offset_s[mine]))
            yield int(key), mine, float(np.clip(self._times_s[number] + offset_s, self._times_s[0], self._times_s[-1]))

    def pose(self, time_s: float) -> np.ndarray:
        """T_map_lidar (4, 4)."""
        return geometry.interpolate_poses(np.array([time_s - self._times_s[0]]), self._times_s - self._times_s[0], self._poses)[0]

    def moving_box(self, key: int, time_s: float) -> np.ndarray:
        """(7,) box of an object of objects.csv, in `map`."""
        track = self.tracks[key]
        foot = [np.interp(time_s, self._times_s, track[f"{axis}_m"]) for axis in "xyz"]
        yaw = np.interp(time_s, self._times_s, np.unwrap(track["yaw_rad"]))
        row = track.iloc[0]
        return np.array([foot[0], foot[1], foot[2] + row.height_m / 2, row.length_m, row.width_m, row.height_m, yaw])

    def find_standing(self) -> dict[int, np.ndarray]:
        """Objects that are not in objects.csv, with their boxes (7,) in `map`: the upright one of least area about all their points."""
        gathered: dict[int, list[np.ndarray]] = {}
        for number, frame in enumerate(iterate_lidar(self._drive_path)):
            for key, mine, time_s in self.seen_objects(number, frame):
                if key not in self.tracks:
                    T = self.pose(time_s)
                    gathered.setdefault(key, []).append(frame.points[mine] @ T[:3, :3].T + T[:3, 3])
        clouds = {key: np.concatenate(parts) for key, parts in gathered.items()}
        return {key: _box_about(points) for key, points in clouds.items() if len(points) >= _LEAST_POINTS}


def _box_about(points: np.ndarray) -> np.ndarray:
    origin = points.mean(axis=0)
    (x, y), (a, b), angle_deg = cv2.minAreaRect((points - origin)[:, :2].astype(np.float32))
    low, high = points[:, 2].min(), points[:, 2].max()
    long, short, turn = (a, b, 0.0) if a >= b else (b, a, np.pi / 2)
    middle = [x + origin[0], y + origin[1], (low + high) / 2]
    return np.array([*middle, max(long, 0.1), max(short, 0.1), high - low, np.radians(angle_deg) + turn])


def _into_lidar(box: np.ndarray, T_map_lidar: np.ndarray) -> np.ndarray:
    """A box in `map` as a box in the frame of the lidar, which stands nearly upright."""
    T_lidar_map = geometry.invert(T_map_lidar)
    heading = T_lidar_map[:3, :3] @ [np.cos(box[6]), np.sin(box[6]), 0.0]
    return np.array([*(T_lidar_map[:3, :3] @ box[:3] + T_lidar_map[:3, 3]), *box[3:6], np.arctan2(heading[1], heading[0])])


def _cut(box: np.ndarray) -> np.ndarray:
    """(k, 7) equal pieces along a box; one where it is short. ASSUME: most of a long tram lies out of a detector's range, and what is in
    it must do to find it."""
    if box[3] <= _LONGEST_M:
        return box[None]
    n = int(np.ceil(box[3] / _PIECE_M))
    pieces = np.tile(box, (n, 1))
    along = ((np.arange(n) + 0.5) / n - 0.5) * box[3]
    pieces[:, :2] += along[:, None] * [np.cos(box[6]), np.sin(box[6])]
    pieces[:, 3] /= n
    return pieces
