"""Scores of a chain of poses against the drive's true poses."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from streetscan.io.tables import save_tables
from streetscan.io.trajectories import read_poses_csv
from streetscan.logs import logged
from streetscan.registration.evaluation import align_trajectory, evaluate_chain, find_failed_pairs, smooth_positions
from streetscan.registration.pose_tables import read_pose_table


def main(
    truth_folder: str | Path, poses_path: str | Path, timings_paths: Sequence[str | Path], scores_path: str | Path,
    trajectory_path: str | Path, reference: dict, max_distance_m: float, max_angle_deg: float, drift_length_m: float,
) -> None:  # fmt: skip
    """
    Args:
        truth_folder: truth/ of the drive; without poses.csv there, failures are counted by status and the rest is undefined.
        poses_path, timings_paths: of register_frames; with the timings of segment_frames where its classes are matched.
        scores_path, trajectory_path: tables to write, `.csv`.
        reference: how good the true poses are: `is_planar` of `evaluate_chain` and `smoothing_s` of `smooth_positions`, where they apply.
        max_distance_m, max_angle_deg, drift_length_m: of `evaluate_chain`.
    """
    poses, truth_path = read_pose_table(poses_path), Path(truth_folder) / "poses.csv"
    is_planar, true_poses = reference.get("is_planar", False), np.full((len(poses), 4, 4), np.nan)
    if truth_path.is_file():
        _, times_s, all_poses = read_poses_csv(truth_path)
        true_poses = smooth_positions(times_s, all_poses, reference.get("smoothing_s", 0.0))[[p.index for p in poses]]
    failed = find_failed_pairs(poses, true_poses, is_planar, max_distance_m, np.radians(max_angle_deg))
    timings = pd.concat([pd.read_csv(path) for path in timings_paths]).groupby("frame")["duration_s"].sum()
    seconds = timings.reindex([p.index for p in poses]).to_numpy()
    scores = evaluate_chain(poses, true_poses, seconds, is_planar, drift_length_m, max_distance_m, max_angle_deg)
    save_tables({scores_path: scores, trajectory_path: align_trajectory(poses, true_poses, failed, is_planar)})


if __name__ == "__main__":
    with logged(snakemake.log[0]):
        i, o = snakemake.input, snakemake.output
        paths = {"truth_folder": i.truth, "poses_path": i.poses, "timings_paths": list(i.timings)}
        main(**paths, scores_path=o.scores, trajectory_path=o.trajectory, **snakemake.params)
