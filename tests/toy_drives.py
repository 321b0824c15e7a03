"""Tiny drives on disk for tests of the steps of registration."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from street_frames import PERIOD_S, SENSOR_HEIGHT_M

from scripts import register_frames
from streetscan.frames import LidarFrame, Mounting
from streetscan.geometry import transform
from streetscan.io.mcap import open_drive_writer

ALL_FRAMES = {"first": 0, "last": None, "every": 1}


@dataclass
class RegisteredDrive:
    """A drive of `n_frames` at 6 m/s, the fifth frame empty; `truth/`, the steps' outputs and the paths most of them take."""

    n_frames: int
    folder: Path

    @property
    def paths(self) -> dict[str, Path]:
        return {"drive_path": self.folder / "drive.mcap", "classes_path": self.folder / "classes.npz"}

    def register(self, folder: Path, frames: dict = ALL_FRAMES, **settings) -> dict[str, Path]:
        """Run register_frames into a folder; its outputs."""
        outputs = {"poses_path": folder / "poses.csv", "tum_path": folder / "poses.tum", "timings_path": folder / "timings.csv"}
        register_frames.main(**self.paths, **outputs, group_frames=3, frames=frames, settings=settings)
        return outputs


LEVEL = Mounting("vehicle", "lidar", transform([0.8, 0.0, SENSOR_HEIGHT_M]))


def write_drive(path: Path, frames: list[np.ndarray], mountings: tuple[Mounting, ...] = (LEVEL,)) -> np.ndarray:
    """Write frames, PERIOD_S apart; their stamps in ns."""
    times_ns = 1_700_000_000_000_000_000 + (np.arange(len(frames)) * PERIOD_S * 1e9).astype(np.int64)
    with open_drive_writer(path) as writer:
        for mounting in mountings:
            writer.write_mounting(mounting, int(times_ns[0]))
        for time_ns, points in zip(times_ns, frames, strict=True):
            writer.write_lidar(LidarFrame(int(time_ns), points, intensity=np.full(len(points), 0.5, np.float32)))
    return times_ns
