"""Scores of a chain of poses against the drive's true poses."""

from pathlib import Path

import pandas as pd

from streetscan.io.tables import save_tables
from streetscan.io.trajectories import read_poses_csv
from streetscan.logs import logged
from streetscan.registration.evaluation import evaluate_chain
from streetscan.registration.pose_tables import read_pose_table


def main(truth_path: str | Path, poses_path: str | Path, timings_path: str | Path, scores_path: str | Path, **settings) -> None:
    """
    Args:
        truth_path: truth/poses.csv of the drive.
        poses_path, timings_path: of register_frames.
        scores_path: table to write, `.csv`.
        settings: of `streetscan.registration.evaluation.evaluate_chain`.
    """
    poses = read_pose_table(poses_path)
    _, _, reference = read_poses_csv(truth_path)
    seconds = pd.read_csv(timings_path)["duration_s"].to_numpy()
    save_tables({scores_path: evaluate_chain(poses, reference[[p.index for p in poses]], seconds, **settings)})


if __name__ == "__main__":
    with logged(snakemake.log[0]):
        inputs = {"truth_path": snakemake.input.truth, "poses_path": snakemake.input.poses, "timings_path": snakemake.input.timings}
        main(**inputs, scores_path=snakemake.output.scores, **snakemake.params)
