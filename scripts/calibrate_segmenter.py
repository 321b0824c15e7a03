"""A network whose confidence is calibrated on the validation part, and its scores there."""

from collections.abc import Mapping, Sequence

import numpy as np

from streetscan.classes import N_CLASSES
from streetscan.io.arrays import load_npy
from streetscan.io.tables import save_tables
from streetscan.logs import logged
from streetscan.segmentation.c2cnn import load_network, save_network
from streetscan.segmentation.confidence import calibrate, prior_shifts
from streetscan.segmentation.training import Part, Samples


def main(
    network_paths: Sequence[str], training: Sequence[str], validation: Sequence[str], outputs: Sequence[str], prior_power: float,
    schedule: Mapping, n_turns: int, n_threads: int, groups: Mapping[str, Sequence[str]] | None = None,
) -> None:  # fmt: skip
    """
    Args:
        network_paths: weights and settings as trained.
        training: voxel labels and samples of the training part.
        validation: voxel labels, samples and voxel grid of the validation part.
        outputs: weights.safetensors, settings.yaml, scores.csv, reliability.csv.
        prior_power: share of `streetscan.segmentation.confidence.prior_shifts` that is added to the logits.
        schedule: of the training, see `training.Schedule`.
        groups, n_turns, n_threads: see `streetscan.segmentation.confidence.calibrate`.
    """
    network = load_network(*network_paths)
    part = Part.load(validation[2], validation[1], network.settings, schedule["patch_voxels"])
    labels, training_labels = (load_npy(paths[0], "label_voxels") for paths in (validation, training))
    shifts = prior_power * prior_shifts(Samples.load(training[1]).labels, training_labels, schedule["class_power"])
    n_voxels = np.bincount(labels, minlength=256)[:N_CLASSES]
    calibrated, *tables = calibrate(network, part, n_voxels, shifts, groups, n_turns, n_threads)
    save_network(calibrated, *outputs[:2])
    save_tables(dict(zip(outputs[2:], tables, strict=True)))


if __name__ == "__main__":
    with logged(snakemake.log[0]):
        main(*(snakemake.input[name] for name in ("network", "training", "validation")), snakemake.output, **snakemake.params)
