"""Rates of networks on a map of ever fewer points."""

from collections.abc import Sequence

from streetscan.io.arrays import load_npy
from streetscan.io.tables import save_tables
from streetscan.logs import logged
from streetscan.segmentation.c2cnn import load_network
from streetscan.segmentation.thinning import score_thinned
from streetscan.voxels import VoxelGrid


def main(
    voxels_path: str, labels_path: str, network_paths: Sequence[str], scores_path: str, models: Sequence[str], shares: Sequence[float],
    n_per_class: int, seed: int, n_threads: int,
) -> None:  # fmt: skip
    """
    Args:
        voxels_path: the map's voxel grid.
        labels_path: its true labels, `.npy`.
        network_paths: weights and settings of each model, one after the other.
        scores_path: `.csv` to write.
        models: the networks' names.
        shares, n_per_class, seed, n_threads: see `streetscan.segmentation.thinning.score_thinned`.
    """
    grid = VoxelGrid.load(voxels_path)
    labels = load_npy(labels_path, "label_voxels", len(grid))
    networks = {m: load_network(*files) for m, *files in zip(models, network_paths[::2], network_paths[1::2], strict=True)}
    save_tables({scores_path: score_thinned(networks, grid, labels, shares, n_per_class, seed, n_threads)})


if __name__ == "__main__":
    with logged(snakemake.log[0]):
        inputs = (snakemake.input[name] for name in ("voxels", "labels", "networks"))
        main(*inputs, *snakemake.output, **snakemake.params)
