"""Keyframes of a drive: images that moved, the lidar frame beside them, columns around."""

from pathlib import Path

from streetscan.calibration.keyframes import KeyframeSettings, choose_keyframes, tabulate_keyframes
from streetscan.io.tables import save_tables
from streetscan.logs import logged


def main(drive_path: str | Path, keyframes_path: str | Path, n_keyframes: int, settings: dict) -> None:
    """
    Args:
        drive_path: drive.mcap.
        keyframes_path: table to write, a row per keyframe.
        n_keyframes: places of the drive.
        settings: keys of KeyframeSettings.
    """
    keyframes = choose_keyframes(drive_path, n_keyframes, KeyframeSettings(**settings))
    save_tables({keyframes_path: tabulate_keyframes(keyframes)})


if __name__ == "__main__":
    with logged(snakemake.log[0]):
        main(drive_path=snakemake.input.drive, keyframes_path=snakemake.output.keyframes, **snakemake.params)
