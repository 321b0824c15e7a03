"""What further looks at a voxel and smoothed labels gain on the validation part, and what they cost."""

from collections.abc import Mapping, Sequence

from streetscan.io.arrays import load_npy
from streetscan.io.tables import save_tables
from streetscan.logs import logged
from streetscan.segmentation.c2cnn import load_network
from streetscan.segmentation.refinements import score_refinements
from streetscan.segmentation.smoothing import Smoothing
from streetscan.voxels import VoxelGrid


def main(voxels_path: str, labels_path: str, network_paths: Sequence[str], scores_path: str, smoothing: Mapping, **settings) -> None:
    """
    Args:
        voxels_path: the map's voxel grid.
        labels_path: its true labels, `.npy`.
        network_paths: weights and settings.
        scores_path: `.csv` to write.
        smoothing: of `streetscan.segmentation.smoothing.Smoothing`.
        settings: of `streetscan.segmentation.refinements.score_refinements`.
    """
    grid = VoxelGrid.load(voxels_path)
    labels = load_npy(labels_path, "label_voxels", len(grid))
    save_tables({scores_path: score_refinements(load_network(*network_paths), grid, labels, Smoothing(**smoothing), **settings)})


if __name__ == "__main__":
    with logged(snakemake.log[0]):
        inputs = (snakemake.input[name] for name in ("voxels", "labels", "network"))
        main(*inputs, *snakemake.output, **snakemake.params)
