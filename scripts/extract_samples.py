"""Voxels to train or validate on, the same number of every class."""

from collections.abc import Sequence

import numpy as np

from streetscan.io.arrays import load_npy, save_npz
from streetscan.logs import logged
from streetscan.segmentation.samples import draw_samples
from streetscan.voxels import VoxelGrid


def main(voxels_path: str, labels_path: str, samples_path: str, n_per_class: int, seed: int, expected: Sequence[str] = ()) -> None:
    """
    Args:
        voxels_path: voxel grid.
        labels_path: its labels, `.npy`.
        samples_path: the samples to write, `.npz` with keys and labels.
        n_per_class, expected: see `streetscan.segmentation.samples.draw_samples`.
        seed: of the draw.
    """
    grid = VoxelGrid.load(voxels_path)
    voxel_labels = load_npy(labels_path, "label_voxels", len(grid))
    rows, labels = draw_samples(voxel_labels, n_per_class, np.random.default_rng(seed), expected)
    save_npz(samples_path, keys=grid.keys[rows], labels=labels)


if __name__ == "__main__":
    with logged(snakemake.log[0]):
        main(
            voxels_path=snakemake.input.voxels,
            labels_path=snakemake.input.labels,
            samples_path=snakemake.output.samples,
            **snakemake.params,
        )
