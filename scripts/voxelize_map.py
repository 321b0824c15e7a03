"""The sparse voxel grid of a map with heights above the local ground."""

import logging

import numpy as np

from streetscan.io.las import iterate_las
from streetscan.logs import logged
from streetscan.segmentation.ground import add_heights
from streetscan.voxels import voxelize

logger = logging.getLogger("streetscan.voxelize_map")


def main(map_path: str, voxels_path: str, size_m: float, ground: dict) -> None:
    """
    Args:
        map_path: LAZ file.
        voxels_path: the grid to write, `.npz`.
        size_m: voxel edge.
        ground: settings of `streetscan.segmentation.ground.add_heights`.
    """
    grid = voxelize((cloud.points for cloud in iterate_las(map_path, with_fields=False)), size_m)
    grid = add_heights(grid, **ground)
    low, high = np.percentile(grid.height_m, [1, 99])
    logger.info("%d points in %d voxels, %.2f to %.2f m above ground (1 %% and 99 %%)", grid.counts.sum(), len(grid), low, high)
    grid.save(voxels_path)


if __name__ == "__main__":
    with logged(snakemake.log[0]):
        main(map_path=snakemake.input.map, voxels_path=snakemake.output.voxels, **snakemake.params)
