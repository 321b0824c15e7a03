"""Poses of a drive's lidar frames by registering each to the ones before it."""

import shutil
from pathlib import Path

import pandas as pd

from streetscan.io.tables import save_tables
from streetscan.logs import logged
from streetscan.registration.drive_frames import DriveFrames
from streetscan.registration.odometry import log_chain, make_settings, register_drive
from streetscan.registration.pose_tables import tabulate_poses, write_tum_segment


def main(
    drive_path: str | Path, classes_path: str | Path, poses_path: str | Path, tum_path: str | Path, timings_path: str | Path,
    group_frames: int, frames: dict, settings: dict,
) -> None:  # fmt: skip
    """
    Args:
        drive_path, classes_path: the drive and what segment_frames made of it.
        poses_path, tum_path, timings_path: to write: one row per frame, the longest segment as TUM, and the seconds per frame.
        group_frames: frames after which a stopped run can continue.
        frames: `first`, `last` and `every` of DriveFrames.
        settings: keys of OdometrySettings (`ndt`: of NdtSettings; `classes`: names).
    """
    read, work_folder = DriveFrames(drive_path, classes_path, **frames), Path(f"{poses_path}.resume")
    poses, seconds = register_drive(
        read.frames, read.last, work_folder / read.digest, make_settings(settings), group_frames, first_frame=read.first
    )
    log_chain(poses)
    poses = read.poses_of_lidar(poses)
    timings = pd.DataFrame({"frame": [p.index for p in poses], "duration_s": seconds})
    save_tables({poses_path: tabulate_poses(poses), timings_path: timings})
    write_tum_segment(tum_path, poses)
    shutil.rmtree(work_folder, ignore_errors=True)


if __name__ == "__main__":
    with logged(snakemake.log[0]):
        o = snakemake.output
        paths = {"poses_path": o.poses, "tum_path": o.tum, "timings_path": o.timings}
        main(drive_path=snakemake.input.drive, classes_path=snakemake.input.classes, **paths, **snakemake.params)
