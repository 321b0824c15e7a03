"""Errors and scores of localized frames against the drive's true poses."""

from pathlib import Path

import numpy as np

from streetscan.io.arrays import load_npy
from streetscan.io.mcap import iterate_lidar
from streetscan.io.tables import save_tables
from streetscan.localization.evaluation import PhantomMap, evaluate_drive, summarize
from streetscan.localization.localizer import LocalizerSettings
from streetscan.localization.location_tables import read_locations
from streetscan.localization.reference import Reference
from streetscan.localization.settings import build
from streetscan.localization.starts import read_poses_on_map
from streetscan.logs import logged
from streetscan.voxels import VoxelGrid


def main(
    drive_path: str | Path, truth_path: str | Path, poses_path: str | Path, reference_path: str | Path, landmarks_path: str | Path,
    voxels_path: str | Path | None, labels_path: str | Path | None, errors_path: str | Path, scores_path: str | Path,
    settings: dict, with_floor: bool,
) -> None:  # fmt: skip
    """
    Args:
        drive_path: drive.mcap.
        truth_path: truth/ of the drive, or poses.csv of register_frames for a map merged of its frames.
        poses_path: of localize_frames.
        reference_path, landmarks_path: the map it used.
        voxels_path, labels_path: the map's voxels and their true labels, or None where nobody knows them.
        errors_path, scores_path: `.csv` to write: a row per frame; the drive's figures.
        settings: keys of LocalizerSettings, as localize_frames had them.
        with_floor: refine the true poses too, to know what no method can pass.
    """
    reference, rows = Reference.load(reference_path, landmarks_path), read_locations(poses_path)
    times_s, truth = read_poses_on_map(truth_path)
    phantoms = None
    if voxels_path is not None:
        grid = VoxelGrid.load(voxels_path)
        phantoms = PhantomMap(grid, np.asarray(load_npy(labels_path, "label_voxels", len(grid))))
    chosen = build(LocalizerSettings, settings, "localize_frames.settings")
    errors = evaluate_drive(rows, enumerate(iterate_lidar(drive_path)), times_s, truth, reference, phantoms, chosen, with_floor)
    save_tables({errors_path: errors, scores_path: summarize(errors)})


if __name__ == "__main__":
    with logged(snakemake.log[0]):
        i, o = snakemake.input, snakemake.output
        inputs = {"drive_path": i.drive, "truth_path": i.truth, "poses_path": i.poses, "reference_path": i.reference}
        inputs |= {"landmarks_path": i.landmarks, "voxels_path": i.voxels or None, "labels_path": i.labels or None}
        main(**inputs, errors_path=o.errors, scores_path=o.scores, **snakemake.params)
