"""A network whose confidence is calibrated on the validation part, and its scores there."""

from collections.abc import Mapping, Sequence

import numpy as np

from streetscan.classes import N_CLASSES
from streetscan.io.arrays import load_npy
from streetscan.io.tables import save_tables
from streetscan.logs import logged
from streetscan.segmentation.c2cnn import load_network, save_network
from streetscan.segmentation.confidence import calibrate
from streetscan.segmentation.training import Part


def main(
    network_paths: Sequence[str], validation: Sequence[str], label_paths: Sequence[str], outputs: Sequence[str], prior_power: float,
    patch_voxels: int, n_threads: int, groups: Mapping[str, Sequence[str]] | None = None,
) -> None:  # fmt: skip
    """
    Args:
        network_paths: weights and settings as trained.
        validation: voxel grid and samples of the validation part.
        label_paths: voxel labels of the validation and of the training part, `.npy`.
        outputs: weights.safetensors, settings.yaml, scores.csv, reliability.csv.
        prior_power, groups, n_threads: see `streetscan.segmentation.confidence.calibrate`.
        patch_voxels: side of a patch whose samples share work.
    """
    network = load_network(*network_paths)
    part = Part.load(*validation, network.settings, patch_voxels)
    n_voxels = [np.bincount(load_npy(path, "label_voxels"), minlength=256)[:N_CLASSES] for path in label_paths]
    calibrated, *tables = calibrate(network, part, *n_voxels, prior_power, groups, n_threads)
    save_network(calibrated, *outputs[:2])
    save_tables(dict(zip(outputs[2:], tables, strict=True)))


if __name__ == "__main__":
    with logged(snakemake.log[0]):
        main(*(snakemake.input[name] for name in ("network", "validation", "labels")), snakemake.output, **snakemake.params)
