"""Grid classes of every point of a drive: sparse, ground, short object, tall structure."""

from pathlib import Path

import pandas as pd

from streetscan.io.frame_arrays import open_frame_arrays_writer
from streetscan.io.mcap import iterate_lidar
from streetscan.io.tables import save_tables
from streetscan.logs import logged
from streetscan.registration.grid_classes import NAMES, GridSettings, count_classes, segment_frame


def main(
    drive_path: str | Path, classes_path: str | Path, summary_path: str | Path, sensor_height_m: float,
    grid: dict, foot_method: str, foot_m: float, outlier_neighbours: int,
) -> None:  # fmt: skip
    """
    Args:
        drive_path: drive.mcap.
        classes_path, summary_path: to write: the classes, one array per frame, and the counts per frame, `.csv`.
        sensor_height_m: of the sensor above the road.
        grid: keys of GridSettings.
        foot_method, foot_m: see `correct_feet`.
        outlier_neighbours: neighbours of the statistical outlier removal, 0 for none.
    """
    settings, rows = GridSettings(**grid), []
    with open_frame_arrays_writer(classes_path) as writer:
        for index, frame in enumerate(iterate_lidar(drive_path)):
            labels = segment_frame(frame.points, sensor_height_m, settings, foot_method, foot_m, outlier_neighbours)
            writer.write(index, labels)
            rows.append((index, frame.time_ns / 1e9, *count_classes(labels)))
    save_tables({summary_path: pd.DataFrame(rows, columns=("frame", "time_s", *(f"n_{name}" for name in NAMES)))})


if __name__ == "__main__":
    with logged(snakemake.log[0]):
        outputs = {"classes_path": snakemake.output.classes, "summary_path": snakemake.output.summary}
        main(drive_path=snakemake.input.drive, **outputs, **snakemake.params)
