"""Write an imported drive in another format, and say what that format cannot hold."""

import logging
from pathlib import Path

from streetscan.io.exports import export_drive, format_losses
from streetscan.logs import logged


def main(mcap: str, output: str, format: str, truth: str | None = None, first: int = 0, n_frames: int | None = None) -> None:
    """Export a drive.

    Args:
        mcap: drive.mcap.
        output: folder (kitti_odometry, pcd_sequence) or file (mcap).
        format: kitti_odometry, pcd_sequence or mcap.
        truth: the drive's truth/ to write along; None: no truth.
        first, n_frames: which frames; n_frames None: all from `first` on.
    """
    frames = range(first, first + n_frames if n_frames is not None else 2**31)
    if losses := format_losses(format, export_drive(mcap, output, format, truth, frames)):
        logging.getLogger("streetscan").warning(losses)


if __name__ == "__main__":
    with logged(snakemake.log[0]):
        folder = Path(snakemake.output.folder)
        main(
            mcap=snakemake.input.mcap,
            output=folder / "drive.mcap" if snakemake.params.format == "mcap" else folder,
            truth=snakemake.input.get("truth") or None,
            **snakemake.params,
        )
