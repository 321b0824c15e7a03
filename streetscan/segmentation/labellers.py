"""Whatever labels voxels, by the files it is stored in: a network (safetensors) or boosted trees (LightGBM's text)."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path

from streetscan.segmentation.baselines.boosted_trees import TreeSettings, check_same_trees, load_trees
from streetscan.segmentation.c2cnn import Settings, check_same_settings, load_network
from streetscan.segmentation.devices import choose_device
from streetscan.segmentation.inference import VoxelLabels, label_voxels
from streetscan.segmentation.smoothing import NO_SMOOTHING, Smoothing


def load_labeller(
    paths: Sequence[str | Path],
    expected: Mapping,
    size_m: float,
    n_turns: int = 1,
    smoothing: Smoothing = NO_SMOOTHING,
    device: str = "cpu",
) -> Callable[..., VoxelLabels]:
    """The function that labels the voxels of a group of tiles: `grid, tile_m, group, n_groups, n_threads` as in `label_voxels`.

    Args:
        paths: weights.safetensors or model.txt, and settings.yaml.
        expected: the settings they must have been made with, of `c2cnn.Settings` or `boosted_trees.TreeSettings`.
        size_m: voxel edge of the map to label.
        n_turns: quarter turns in which a network looks at a voxel; trees see no direction.
        smoothing: of a network's shares; trees, the yardstick, are left as they are.
        device: cpu or cuda, for a network; trees are evaluated on the processor.
    Raises:
        BadInput: a file is damaged, or was made with other settings, or there is no such device.
    """
    if Path(paths[0]).suffix == ".txt":
        trees = load_trees(*paths)
        check_same_trees(trees.settings, TreeSettings(size_m=size_m, **expected), paths[0])
        return trees.label_voxels
    network = load_network(*paths).to(choose_device(device))
    check_same_settings(network.settings, Settings(size_m=size_m, **expected), paths[0])
    return partial(label_voxels, network, n_turns=n_turns, smoothing=smoothing)
