"""Registered frames as one cloud in LAZ tiles: a map that import_map takes."""

import logging
import shutil
from pathlib import Path

from streetscan.logs import logged
from streetscan.registration.drive_frames import DriveFrames
from streetscan.registration.frame_pictures import draw_merged, write_picture
from streetscan.registration.merging import choose_segment, leave_out, make_merge_settings, merge_frames
from streetscan.registration.pose_tables import read_pose_table

logger = logging.getLogger("streetscan.merge_frames")


def main(
    drive_path: str | Path, classes_path: str | Path, poses_path: str | Path, tiles_folder: str | Path, elevation_path: str | Path,
    picture_path: str | Path, left_out: dict | None = None, **settings,
) -> None:  # fmt: skip
    """
    Args:
        drive_path, classes_path, poses_path: the drive, its grid classes and its poses.
        tiles_folder: gets the tiles `<x>_<y>.laz`.
        elevation_path, picture_path: get the height of the ground, ESRI ASCII grid, and a view of the street, PNG.
        left_out: `first` and `every` of the frames that are not merged; None merges all.
        settings: keys of MergeSettings (`classes`: names).
    """
    chosen = make_merge_settings(settings)
    frames = DriveFrames(drive_path, classes_path)
    poses = choose_segment(frames.poses_of_level(read_pose_table(poses_path)), chosen.segment)
    poses = leave_out(poses, **left_out) if left_out else poses
    work_folder = Path(f"{tiles_folder}.resume")
    counts = merge_frames(frames.merge_frames, poses, tiles_folder, work_folder / frames.digest, chosen, elevation_path=elevation_path)
    shutil.rmtree(work_folder, ignore_errors=True)
    write_picture(picture_path, draw_merged(tiles_folder, poses))
    logger.info("%s", ", ".join(f"{n} {name.replace('_', ' ')}" for name, n in counts.items()))


if __name__ == "__main__":
    with logged(snakemake.log[0]):
        inputs = {"drive_path": snakemake.input.drive, "classes_path": snakemake.input.classes, "poses_path": snakemake.input.poses}
        o = snakemake.output
        main(**inputs, tiles_folder=o.tiles, elevation_path=o.elevation, picture_path=o.picture, **snakemake.params)
