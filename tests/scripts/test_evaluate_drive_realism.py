"""evaluate_drive_realism on a drive of simulated frames."""

import numpy as np
import pandas as pd

from scripts import evaluate_drive_realism
from streetscan import geometry
from streetscan.frames import LidarFrame
from streetscan.io.mcap import open_drive_writer
from streetscan.io.trajectories import write_poses_csv


def test_frames_are_merged_at_their_true_poses(tmp_path):
    rng = np.random.default_rng(0)
    times_s = 1e9 + 0.1 * np.arange(6)
    poses = np.stack([geometry.transform((i, 0.5 * i, 1.8), (0, 0, 0.1 * i)) for i in range(6)])
    with open_drive_writer(tmp_path / "drive.mcap") as writer:
        for t, T in zip(times_s, poses, strict=True):
            # Ground with 1 cm of noise, seen from each pose.
            ground = np.c_[rng.uniform(-15, 15, (40_000, 2)), rng.normal(0.25, 0.01, 40_000)]
            points = geometry.apply(geometry.invert(T), ground)
            writer.write_lidar(LidarFrame(round(t * 1e9), points.astype(np.float32), np.full(40_000, 0.5, np.float32)))
    write_poses_csv(tmp_path / "poses.csv", np.arange(6), times_s, poses)
    evaluate_drive_realism.main(str(tmp_path / "drive.mcap"), str(tmp_path / "poses.csv"), str(tmp_path / "out.csv"), 4.0, 1.0, 20.0)
    table = pd.read_csv(tmp_path / "out.csv")
    residual = table[(table.statistic == "plane_residual_m") & (table.group == "road") & (table.x == 0.5)].value.item()
    assert 0.009 < residual < 0.011
    density = table[table.statistic == "density_per_m2"].set_index("x").value
    # 240 000 points on 900 square metres; nearer than 2.5 m a frame leaves its own out.
    assert 220 < density[8.0] < 310
    assert density[0.0] < density[8.0]
