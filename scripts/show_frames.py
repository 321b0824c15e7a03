"""Pictures or a video of a drive in the colours of the grid (the report's display modes)."""

from collections.abc import Sequence
from pathlib import Path

from streetscan.io.frame_arrays import FrameArrays
from streetscan.logs import logged
from streetscan.registration.drive_frames import iterate_level, read_mounting
from streetscan.registration.frame_pictures import draw_drive, save_drive_pictures
from streetscan.registration.grid_classes import GridSettings


def main(
    drive_path: str | Path, classes_path: str | Path, folder: str | Path, modes: Sequence[str], grid: dict, first: int,
    last: int | None, video_rate_hz: float,
) -> None:  # fmt: skip
    """
    Args:
        drive_path, classes_path: the drive and what segment_frames made of it.
        folder: gets `<mode>.mp4`, or `<mode>_<frame>.png`.
        modes: of `streetscan.registration.frame_pictures.MODES`.
        grid: as in segment_frames.
        first, last: frame numbers shown, `last` not included; null shows all.
        video_rate_hz: pictures a second; 0 writes single pictures.
    """
    settings, labels = GridSettings(**grid), FrameArrays(classes_path, "segment_frames")
    sensor_height_m = read_mounting(drive_path)[2, 3]
    for mode in modes:
        pictures = draw_drive(iterate_level(drive_path), labels, mode, sensor_height_m, settings, first, last)
        save_drive_pictures(pictures, folder, mode, video_rate_hz)


if __name__ == "__main__":
    with logged(snakemake.log[0]):
        inputs = {"drive_path": snakemake.input.drive, "classes_path": snakemake.input.classes}
        main(**inputs, folder=snakemake.output.folder, **snakemake.params)
