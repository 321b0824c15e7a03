"""True voxel labels by the majority of their points."""

import logging

import numpy as np

from streetscan.classes import NAMES, UNLABELLED
from streetscan.io.arrays import save_npy
from streetscan.io.las import iterate_labelled_las
from streetscan.logs import logged
from streetscan.segmentation.samples import vote_labels
from streetscan.voxels import VoxelGrid

logger = logging.getLogger("streetscan.label_voxels")


def main(map_path: str, truth_path: str, voxels_path: str, labels_path: str) -> None:
    """
    Args:
        map_path: LAZ file.
        truth_path: its points' labels, `.npy`.
        voxels_path: its voxel grid.
        labels_path: the voxels' labels to write, `.npy`.
    """
    chunks = ((cloud.points, labels) for cloud, labels in iterate_labelled_las(map_path, truth_path, with_fields=False))
    labels = vote_labels(VoxelGrid.load(voxels_path), chunks)
    n = np.bincount(labels, minlength=UNLABELLED + 1)
    logger.info("voxels: %s, unlabelled %d", ", ".join(f"{name} {k}" for name, k in zip(NAMES, n, strict=False)), n[UNLABELLED])
    save_npy(labels_path, labels)


if __name__ == "__main__":
    with logged(snakemake.log[0]):
        main(
            map_path=snakemake.input.map,
            truth_path=snakemake.input.truth,
            voxels_path=snakemake.input.voxels,
            labels_path=snakemake.output.labels,
        )
