"""The weights of C²CNN, or of a variant with other channels."""

import shutil
from collections.abc import Sequence as Seq

import pandas as pd

from streetscan.io.arrays import load_npy
from streetscan.io.atomic import atomic_path
from streetscan.logs import logged
from streetscan.segmentation.c2cnn import Settings, load_network, save_network
from streetscan.segmentation.devices import choose_device
from streetscan.segmentation.training import Part, Schedule, class_weights, train
from streetscan.voxels import VoxelGrid


def main(
    training: Seq, validation: Seq, labels: str, initial: Seq, outputs: Seq, network: dict, schedule: dict, n_threads: int, device: str
) -> None:  # fmt: skip
    """
    Args:
        training, validation: paths of voxel grid and samples of each part.
        labels: voxel labels of the training part, `.npy`.
        initial: weights and settings to start from; empty: random weights.
        outputs: weights.safetensors, settings.yaml, history.csv. `<weights>.resume/` keeps what an interrupted training did.
        network, schedule: see `c2cnn.Settings` (size_m is the grid's) and `training.Schedule`.
        n_threads: threads; the result does not depend on it.
        device: cpu or cuda, see `training.train`.
    """
    choose_device(device)  # before minutes of reading
    schedule, grid = Schedule(**schedule), VoxelGrid.load(training[0])
    settings = Settings(size_m=grid.size_m, **network)
    parts = [Part.load(*paths, settings, schedule.patch_voxels) for paths in (training, validation)]
    weights = class_weights(parts[0].samples.labels, load_npy(labels, "label_voxels", len(grid)), schedule.class_power)
    start, resume = load_network(*initial) if initial else None, f"{outputs[0]}.resume"
    trained, history = train(settings, schedule, *parts, weights, start, resume, n_threads, device)
    save_network(trained, *outputs[:2])
    with atomic_path(outputs[2]) as partial:
        pd.DataFrame(history).to_csv(partial, index=False)
    shutil.rmtree(resume)


if __name__ == "__main__":
    with logged(snakemake.log[0]):
        main(*(snakemake.input[name] for name in ("training", "validation", "labels", "initial")), snakemake.output, **snakemake.params)
