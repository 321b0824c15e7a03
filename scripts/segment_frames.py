"""Grid classes of every point of a drive: sparse, ground, short object, tall structure."""

import time
from pathlib import Path

import numpy as np
import pandas as pd

from streetscan.io.frame_arrays import open_frame_arrays_writer
from streetscan.io.tables import save_tables
from streetscan.logs import logged
from streetscan.registration.drive_frames import iterate_level, read_mounting
from streetscan.registration.grid_classes import NAMES, GridSettings, count_classes, segment_frame


def main(
    drive_path: str | Path, classes_path: str | Path, summary_path: str | Path, timings_path: str | Path, grid: dict,
    foot_method: str, foot_m: float, outlier_neighbours: int,
) -> None:  # fmt: skip
    """
    Args:
        drive_path: drive.mcap.
        classes_path, summary_path, timings_path: to write: the classes, one array per frame, their counts and the seconds per frame.
        grid: keys of GridSettings.
        foot_method, foot_m: see `correct_feet`.
        outlier_neighbours: neighbours of the statistical outlier removal, 0 for none.
    """
    settings, sensor_height_m, rows, seconds = GridSettings(**grid), read_mounting(drive_path)[2, 3], [], []
    # Compiled code is loaded before the clock starts.
    segment_frame(np.zeros((1, 3), np.float32), sensor_height_m, settings, foot_method, foot_m)
    with open_frame_arrays_writer(classes_path) as writer:
        for index, frame in enumerate(iterate_level(drive_path)):
            start_s = time.perf_counter()
            labels = segment_frame(frame.points, sensor_height_m, settings, foot_method, foot_m, outlier_neighbours)
            seconds.append((index, time.perf_counter() - start_s))
            writer.write(index, labels)
            rows.append((index, frame.time_ns / 1e9, *count_classes(labels)))
    summary = pd.DataFrame(rows, columns=("frame", "time_s", *(f"n_{name}" for name in NAMES)))
    save_tables({summary_path: summary, timings_path: pd.DataFrame(seconds, columns=("frame", "duration_s"))})


if __name__ == "__main__":
    with logged(snakemake.log[0]):
        o = snakemake.output
        outputs = {"classes_path": o.classes, "summary_path": o.summary, "timings_path": o.timings}
        main(drive_path=snakemake.input.drive, **outputs, **snakemake.params)
