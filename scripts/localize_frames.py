"""Poses of a drive's frames on a map, with a verdict each."""

from pathlib import Path

from streetscan.io.mcap import iterate_lidar
from streetscan.io.tables import save_tables
from streetscan.localization.drive import localize_drive, log_verdicts
from streetscan.localization.location_tables import tabulate_locations, write_tum_of
from streetscan.localization.reference import Reference
from streetscan.localization.settings import make_drive_settings, make_localizer
from streetscan.localization.starts import read_starts
from streetscan.localization.views import write_pictures, write_view
from streetscan.logs import logged


def main(
    drive_path: str | Path, reference_path: str | Path, landmarks_path: str | Path, truth_path: str | Path | None,
    poses_path: str | Path, tum_path: str | Path, view_path: str | Path, pictures_folder: str | Path,
    method: str, settings: dict, sequence: dict, seed: int,
) -> None:  # fmt: skip
    """
    Args:
        drive_path: drive.mcap.
        reference_path, landmarks_path: of cluster_landmarks.
        truth_path: folder truth/ of the drive, or poses.csv of register_frames for a map merged of its frames, for starts that are spread
            around true poses; None for all others.
        poses_path, tum_path, view_path, pictures_folder: to write: a row per frame, believed poses, aligned scans beside the map, PNG.
        method: of `streetscan.localization.settings.METHODS`.
        settings: keys of LocalizerSettings.
        sequence: keys of DriveSettings.
        seed: of the spread starts.
    """
    reference, follow = Reference.load(reference_path, landmarks_path), make_drive_settings(sequence)
    starts = read_starts(drive_path, reference.crs, reference_path, truth_path, follow.mode, seed)
    localizer = make_localizer(method, reference, settings)
    rows = list(localize_drive(enumerate(iterate_lidar(drive_path)), starts, localizer, follow))
    log_verdicts(rows)
    save_tables({poses_path: tabulate_locations(rows)})
    write_tum_of(tum_path, rows)
    write_view(view_path, drive_path, rows, reference)
    write_pictures(pictures_folder, drive_path, rows, reference)


if __name__ == "__main__":
    with logged(snakemake.log[0]):
        i, o = snakemake.input, snakemake.output
        inputs = {"drive_path": i.drive, "reference_path": i.reference, "landmarks_path": i.landmarks}
        outputs = {"poses_path": o.poses, "tum_path": o.tum, "view_path": o.view, "pictures_folder": o.pictures}
        main(**inputs, truth_path=i.truth or None, **outputs, **snakemake.params)
