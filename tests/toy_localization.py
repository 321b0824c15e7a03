"""The street of boxes as files: a labelled map, a drive through it with GPS, and the truth of both."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from street_frames import PERIOD_S, pose, scan
from street_maps import UTM_SHIFT, sample_map, street

from scripts import cluster_landmarks
from streetscan.clouds import PointCloud
from streetscan.frames import GpsFix, LidarFrame, Mounting
from streetscan.geodesy import unproject
from streetscan.geometry import transform
from streetscan.io.label_tiles import write_label_tile
from streetscan.io.las import write_las
from streetscan.io.mcap import open_drive_writer
from streetscan.io.trajectories import write_poses_csv
from streetscan.segmentation.ground import add_heights
from streetscan.voxels import voxelize

CRS = "EPSG:32632"
START_NS = 1_700_000_000_000_000_000
LANDMARKS = {"landmarks": {}, "static_m": 0.2}


@dataclass
class LocalizationFiles:
    """Paths of a map (`map.laz`, `voxels.npz`, `tile.npz`, `labels.npy`), of its landmarks, of a drive and of its `truth/`."""

    folder: Path
    poses: np.ndarray

    def __getattr__(self, name: str) -> Path:
        if name.startswith("_"):
            raise AttributeError(name)
        files = {"map": "map.laz", "tile": "tile.npz", "labels": "labels.npy", "drive": "drive.mcap", "truth": "truth"}
        return self.folder / files.get(name, f"{name}.npz")


def write_files(folder: Path, n_frames: int = 4, speed_mps: float = 6.0) -> LocalizationFiles:
    """Write everything; GPS is 4 m off to the south-west, its heading 6 degrees."""
    points, labels = sample_map(*street())
    points = np.round(points + UTM_SHIFT, 3)
    write_las(folder / "map.laz", PointCloud(points, crs=CRS))
    grid = add_heights(voxelize([points], 0.1), cell_m=0.5, max_object_m=20.0, max_slope=0.15, step_m=0.2, min_patch_m2=4.0)
    grid.save(folder / "voxels.npz")
    voxel_labels = np.zeros(len(grid), np.uint8)
    voxel_labels[grid.find(grid.keys_of(points))] = labels
    np.save(folder / "labels.npy", voxel_labels)
    write_label_tile(folder / "tile.npz", np.arange(len(grid)), voxel_labels, np.ones(len(grid), np.float32))
    outputs = {
        "layer_path": folder / "landmarks.gpkg",
        "landmarks_path": folder / "landmarks.npz",
        "reference_path": folder / "reference.npz",
    }
    cluster_landmarks.main(folder / "map.laz", folder / "voxels.npz", [folder / "tile.npz"], None, **outputs, **LANDMARKS)

    rng, boxes = np.random.default_rng(4), street()[0]
    poses = np.array([pose(i * PERIOD_S * speed_mps) for i in range(n_frames)])
    with open_drive_writer(folder / "drive.mcap") as writer:
        writer.write_mounting(Mounting("vehicle", "lidar", transform([0.8, 0, 1.8])), START_NS)
        writer.write_mounting(Mounting("vehicle", "gps", transform([0.3, 0, 1.5])), START_NS)
        for i, T in enumerate(poses):
            time_ns = START_NS + round(i * PERIOD_S * 1e9)
            frame, offsets = scan(T, boxes, rng, n_beams=64, n_azimuths=1000, velocity_mps=np.array([speed_mps, 0, 0]))
            # One frame in the middle of the drive is empty: it must cost no other frame its pose.
            frame, offsets = (frame[:0], offsets[:0]) if i == 2 else (frame, offsets)
            writer.write_lidar(LidarFrame(time_ns, frame, time_offset_s=offsets))
            at = T[:2, 3] - [0.5, 0] + UTM_SHIFT[:2] - 2.8
            (latitude,), (longitude,) = unproject(at[None], CRS)
            writer.write_fix(GpsFix(time_ns, latitude, longitude, 0.0, heading_rad=np.pi / 2 - np.radians(6)))
    poses[:, :3, 3] += UTM_SHIFT
    (folder / "truth").mkdir()
    times_s = START_NS / 1e9 + np.arange(n_frames) * PERIOD_S
    write_poses_csv(folder / "truth" / "poses.csv", np.arange(n_frames), times_s, poses)
    return LocalizationFiles(folder, poses)
