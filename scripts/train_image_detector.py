"""The weights of the city's image detector, from pictures of simulated drives and their exact masks."""

from collections.abc import Sequence

import pandas as pd

from streetscan.calibration.detectors.city import CitySettings
from streetscan.calibration.detectors.city_training import ImageSchedule, make_picture, train_city_network
from streetscan.calibration.detectors.drive_truth import iterate_true_masks
from streetscan.io.images import decode_image
from streetscan.io.tables import save_tables
from streetscan.io.weights import save_settings, save_weights
from streetscan.logs import logged
from streetscan.simulation.layout import GENERATOR_VERSION


def main(drives: Sequence[str], truths: Sequence[str], outputs: Sequence[str], network: dict, schedule: dict, n_threads: int) -> None:
    """
    Args:
        drives, truths: drive.mcap and truth/ of each drive to learn from.
        outputs: weights.safetensors, settings.yaml, history.csv.
        network, schedule: see `city.CitySettings` and `city_training.ImageSchedule`.
        n_threads: of torch; another number gives slightly other weights.
    """
    settings = CitySettings(**network, generator_version=GENERATOR_VERSION)
    pictures = [
        make_picture(decode_image(image), labels, instances, settings.width)
        for paths in zip(drives, truths, strict=True)
        for image, labels, instances in iterate_true_masks(*paths)
    ]
    trained, history = train_city_network(pictures, settings, ImageSchedule(**schedule), n_threads)
    save_weights(trained, outputs[0])
    save_settings(settings, outputs[1])
    save_tables({outputs[2]: pd.DataFrame(history)})


if __name__ == "__main__":
    with logged(snakemake.log[0]):
        main(snakemake.input.drives, snakemake.input.truths, snakemake.output, **snakemake.params)
