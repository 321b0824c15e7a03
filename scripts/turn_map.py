"""The training map and copies of it turned about the vertical, in one voxel grid."""

import logging

from streetscan.io.arrays import load_npy, save_npy
from streetscan.io.las import iterate_las
from streetscan.logs import logged
from streetscan.segmentation.turning import turn_map
from streetscan.voxels import VoxelGrid

logger = logging.getLogger("streetscan.turn_map")


def main(map_path: str, voxels_path: str, labels_path: str, turned_voxels_path: str, turned_labels_path: str, **settings) -> None:
    """
    Args:
        map_path: LAZ file.
        voxels_path: its voxel grid.
        labels_path: the voxels' labels, `.npy`.
        turned_voxels_path, turned_labels_path: grid (`.npz`) and labels (`.npy`) of all copies, to write.
        settings: `n_yaws`, `tile_m`, `margin_m` of `streetscan.segmentation.turning.turn_map`.
    """
    grid = VoxelGrid.load(voxels_path)
    labels = load_npy(labels_path, "label_voxels", len(grid))
    turned, turned_labels = turn_map(lambda: (cloud.points for cloud in iterate_las(map_path, with_fields=False)), grid, labels, **settings)
    logger.info("%d voxels in %d copies of a map of %d", len(turned), settings["n_yaws"], len(grid))
    turned.save(turned_voxels_path)
    save_npy(turned_labels_path, turned_labels)


if __name__ == "__main__":
    with logged(snakemake.log[0]):
        main(
            map_path=snakemake.input.map,
            voxels_path=snakemake.input.voxels,
            labels_path=snakemake.input.labels,
            turned_voxels_path=snakemake.output.voxels,
            turned_labels_path=snakemake.output.labels,
            **snakemake.params,
        )
