"""The weights of the street's PointPillars, from lidar frames of simulated drives and their true boxes."""

from collections.abc import Sequence

import pandas as pd

from streetscan.calibration.detectors.drive_truth import iterate_true_boxes
from streetscan.calibration.detectors.pointpillars import street_settings
from streetscan.calibration.detectors.pointpillars_training import LidarSchedule, make_frame, train_pointpillars
from streetscan.io.tables import save_tables
from streetscan.io.weights import save_settings, save_weights
from streetscan.logs import logged
from streetscan.simulation.layout import GENERATOR_VERSION


def main(drives: Sequence[str], truths: Sequence[str], outputs: Sequence[str], schedule: dict, n_threads: int) -> None:
    """
    Args:
        drives, truths: drive.mcap and truth/ of each drive to learn from.
        outputs: weights.safetensors, settings.yaml, history.csv.
        schedule: see `pointpillars_training.LidarSchedule`.
        n_threads: of torch; another number gives slightly other weights.
    """
    settings, plan = street_settings(GENERATOR_VERSION), LidarSchedule(**schedule)
    frames = [
        make_frame(frame.points, frame.intensity, truth, settings, plan.min_points)
        for paths in zip(drives, truths, strict=True)
        for frame, truth in iterate_true_boxes(*paths)
    ]
    trained, history = train_pointpillars(frames, settings, plan, n_threads)
    save_weights(trained, outputs[0])
    save_settings(settings, outputs[1])
    save_tables({outputs[2]: pd.DataFrame(history)})


if __name__ == "__main__":
    with logged(snakemake.log[0]):
        main(snakemake.input.drives, snakemake.input.truths, snakemake.output, **snakemake.params)
