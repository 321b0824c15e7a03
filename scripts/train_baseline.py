"""Boosted trees on eigen-features, trained on the samples a network is trained on."""

from collections.abc import Sequence

import pandas as pd

from streetscan.io.atomic import atomic_path
from streetscan.logs import logged
from streetscan.segmentation.baselines.boosted_trees import TreeSchedule, TreeSettings, grow_trees, save_trees
from streetscan.segmentation.training import Samples
from streetscan.voxels import VoxelGrid


def main(
    training: Sequence[str], validation: Sequence[str], outputs: Sequence[str], neighbours: Sequence[int], schedule: dict, n_threads: int
) -> None:
    """
    Args:
        training, validation: paths of voxel grid and samples of each part.
        outputs: model.txt, settings.yaml and history.csv to write.
        neighbours, schedule: see `boosted_trees.TreeSettings` and `boosted_trees.TreeSchedule`.
        n_threads: threads; the result does not depend on it.
    """
    parts = []
    for voxels_path, samples_path in (training, validation):
        samples = Samples.load(samples_path)
        parts.append((VoxelGrid.load(voxels_path), samples.keys, samples.labels))
    settings = TreeSettings(parts[0][0].size_m, neighbours)
    trees, history = grow_trees(settings, TreeSchedule(**schedule), *parts, n_threads)
    save_trees(trees, *outputs[:2])
    with atomic_path(outputs[2]) as partial:
        pd.DataFrame(history).to_csv(partial, index=False)


if __name__ == "__main__":
    with logged(snakemake.log[0]):
        main(snakemake.input.training, snakemake.input.validation, snakemake.output, **snakemake.params)
