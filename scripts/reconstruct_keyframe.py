"""Sparse and dense cloud of one keyframe in metres, and the projection into its reference image."""

from pathlib import Path

from streetscan.calibration.keyframes import read_camera, read_keyframe_images, read_keyframes
from streetscan.calibration.model_files import summarize, write_model
from streetscan.calibration.model_pictures import write_pictures
from streetscan.calibration.reconstruction import begin, make_reconstruction_settings, read_masks, reconstruct_keyframe
from streetscan.io.atomic import atomic_folder
from streetscan.io.tables import save_tables
from streetscan.logs import logged
from streetscan.registration.pose_tables import read_pose_table


def main(
    drive_path: str | Path, keyframes_path: str | Path, poses_path: str | Path, masks_folder: str | Path | None, model_folder: str | Path,
    summary_path: str | Path, keyframe: int, settings: dict, seed: int, n_threads: int,
) -> None:  # fmt: skip
    """
    Args:
        drive_path, keyframes_path, poses_path: the drive, and what choose_keyframes and register_frames made of it.
        masks_folder: of detect_dynamic; None marks nothing as moving.
        model_folder, summary_path: to write: clouds, cameras and pictures; status, reason and numbers in one row.
        keyframe: its number.
        settings: keys of ReconstructionSettings.
        seed, n_threads: of `reconstruct_keyframe`.
    """
    chosen = read_keyframes(keyframes_path)[keyframe]
    with atomic_folder(model_folder) as partial:
        made = begin(chosen, masks_folder)
        if made.status == "ok":
            camera = read_camera(drive_path)
            images, masks = read_keyframe_images(drive_path, chosen), read_masks(masks_folder, keyframe)
            times = chosen.image_times_ns, chosen.lidar_time_ns
            inputs = images, *times, camera, read_pose_table(poses_path), masks
            made = reconstruct_keyframe(*inputs, make_reconstruction_settings(settings), seed, n_threads)
            write_model(partial, made, camera, chosen.image_times_ns)
            write_pictures(partial, made, images, masks, camera)
        save_tables({summary_path: summarize(made, keyframe, len(chosen.images))})


if __name__ == "__main__":
    with logged(snakemake.log[0]):
        i, o = snakemake.input, snakemake.output
        inputs = {"drive_path": i.drive, "keyframes_path": i.keyframes, "poses_path": i.poses, "masks_folder": i.masks or None}
        main(**inputs, model_folder=o.model, summary_path=o.summary, **snakemake.params)
