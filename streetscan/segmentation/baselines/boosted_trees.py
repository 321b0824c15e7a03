"""Gradient-boosted trees on eigen-features: the yardstick a network has to beat.

Source: ours; the classical recipe for street scans (hand-made features and an ensemble of trees, thesis 2.2 and [50]).
"""

import logging
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import lightgbm
import numpy as np
import yaml

from streetscan.classes import N_CLASSES, NAMES
from streetscan.errors import BadInput
from streetscan.io.atomic import atomic_path
from streetscan.segmentation.baselines.eigen_features import NeighbourTree, eigen_features, feature_names
from streetscan.segmentation.inference import VoxelLabels, assign_tiles
from streetscan.voxels import VoxelGrid

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class TreeSettings:
    """What a voxel is described by; stored beside the trees.

    Attributes:
        size_m: voxel edge the trees were made for.
        neighbours: numbers of nearest voxels, see `eigen_features`.
    """

    size_m: float = 0.1
    neighbours: tuple[int, ...] = (10, 30, 80)

    def __post_init__(self):
        object.__setattr__(self, "neighbours", tuple(int(k) for k in self.neighbours))


@dataclass(frozen=True)
class TreeSchedule:
    """How the trees are grown.

    Attributes:
        n_rounds: rounds at most; each grows a tree for every class.
        n_leaves: leaves of a tree at most.
        learning_rate: share of a tree that is taken.
        min_leaf: samples of a leaf at least.
        patience: rounds without a lower validation loss that are waited for.
        seed: of everything random.
    """

    n_rounds: int = 200
    n_leaves: int = 63
    learning_rate: float = 0.1
    min_leaf: int = 50
    patience: int = 10
    seed: int = 1


@dataclass
class BoostedTrees:
    """Trees and what they ask about a voxel."""

    settings: TreeSettings
    booster: lightgbm.Booster

    def label_voxels(self, grid: VoxelGrid, tile_m: float, group: int = 0, n_groups: int = 1, n_threads: int = 1) -> VoxelLabels:
        """Labels of the voxels of one group of tiles, as `streetscan.segmentation.inference.label_voxels` gives a network's."""
        tile, group_of_tile = assign_tiles(grid, tile_m, n_groups)
        rows = np.flatnonzero(group_of_tile[tile] == group)
        features = eigen_features(NeighbourTree(grid), rows, self.settings.neighbours, n_threads)
        shares = np.asarray(self.booster.predict(features, num_threads=n_threads)) if len(rows) else np.empty((0, N_CLASSES))
        logger.info("%d voxels labelled", len(rows))
        return VoxelLabels(rows, shares.argmax(axis=1).astype(np.uint8), shares.max(axis=1).astype(np.float32))


def grow_trees(
    settings: TreeSettings,
    schedule: TreeSchedule,
    training: tuple[VoxelGrid, np.ndarray, np.ndarray],
    validation: tuple[VoxelGrid, np.ndarray, np.ndarray],
    n_threads: int = 1,
) -> tuple[BoostedTrees, list[dict]]:
    """Trees trained on one part; a second part says when to stop.

    Args:
        settings, schedule: see there.
        training, validation: a grid with heights, (s, 3) keys of sample voxels and their (s,) uint8 labels, each.
        n_threads: threads; the result does not depend on it.
    Returns:
        the trees of the round with the lowest validation loss, and per round: epoch, train_loss, train_accuracy, validation_loss,
        validation_accuracy (mean of the classes' recalls), learning_rate, time_s.
    Raises:
        BadInput: a sample is no voxel of its grid, or the voxel size is another.
    """
    sets = [_describe(grid, keys, labels, settings, n_threads) for grid, keys, labels in (training, validation)]
    parameters = {
        "objective": "multiclass",
        "num_class": N_CLASSES,
        "metric": "multi_logloss",
        "num_leaves": schedule.n_leaves,
        "learning_rate": schedule.learning_rate,
        "min_data_in_leaf": schedule.min_leaf,
        "num_threads": n_threads,
        "seed": schedule.seed,
        "deterministic": True,
        "force_row_wise": True,
        "verbosity": -1,
    }
    results, clock = {}, [time.perf_counter()]
    booster = lightgbm.train(
        parameters,
        sets[0],
        schedule.n_rounds,
        valid_sets=sets,
        valid_names=["train", "validation"],
        feval=_mean_recall,
        callbacks=[
            lightgbm.record_evaluation(results),
            lambda _: clock.append(time.perf_counter()),
            lightgbm.early_stopping(schedule.patience, first_metric_only=True, verbose=False),
        ],
    )
    history = [
        {
            "epoch": i + 1,
            "train_loss": results["train"]["multi_logloss"][i],
            "train_accuracy": results["train"]["mean_recall"][i],
            "validation_loss": results["validation"]["multi_logloss"][i],
            "validation_accuracy": results["validation"]["mean_recall"][i],
            "learning_rate": schedule.learning_rate,
            "time_s": clock[i + 1] - clock[i],
        }
        for i in range(len(results["train"]["multi_logloss"]))
    ]
    best = history[booster.best_iteration - 1]
    logger.info("%d rounds; validation accuracy %.3f in round %d", len(history), best["validation_accuracy"], best["epoch"])
    return BoostedTrees(settings, booster), history


def save_trees(trees: BoostedTrees, model: str | Path, settings: str | Path) -> None:
    """Write the trees of the best round (LightGBM's text) and the settings (YAML)."""
    with atomic_path(settings) as partial:
        content = {k: list(v) if isinstance(v, tuple) else v for k, v in asdict(trees.settings).items()} | {"classes": list(NAMES)}
        partial.write_text(yaml.safe_dump(content, sort_keys=False))
    with atomic_path(model) as partial:
        trees.booster.save_model(partial, num_iteration=trees.booster.best_iteration)


def load_trees(model: str | Path, settings: str | Path) -> BoostedTrees:
    """Read what `save_trees` wrote. BadInput when a file is damaged or the two do not belong together."""
    try:
        content = yaml.safe_load(Path(settings).read_text())
        classes, chosen = content.pop("classes"), TreeSettings(**content)
    except (OSError, yaml.YAMLError, AttributeError, KeyError, TypeError, ValueError) as error:
        raise BadInput(settings, f"not the settings of trees ({error})", "run train_baseline again") from error
    try:
        booster = lightgbm.Booster(model_file=str(model))
    except lightgbm.basic.LightGBMError as error:
        raise BadInput(model, f"not a model of LightGBM ({error})", "run train_baseline again") from error
    if tuple(classes) != NAMES or booster.feature_name() != feature_names(chosen.neighbours):
        raise BadInput(model, f"made with other classes or features than {settings} says", "give model and settings of one training")
    return BoostedTrees(chosen, booster)


def check_same_trees(found: TreeSettings, wanted: TreeSettings, where: object) -> None:
    """Refuse trees that were made with other settings."""
    for name, value in asdict(wanted).items():
        if getattr(found, name) != value:
            raise BadInput(where, f"trees made with {name} {getattr(found, name)}, not {value}", "run train_baseline again")


def _describe(grid: VoxelGrid, keys: np.ndarray, labels: np.ndarray, settings: TreeSettings, n_threads: int) -> lightgbm.Dataset:
    if not np.isclose(grid.size_m, settings.size_m, rtol=1e-9):
        raise BadInput("the voxels", f"are {grid.size_m} m wide, not {settings.size_m} m", "run voxelize_map again")
    rows = grid.find(keys)
    if (rows < 0).any():
        raise BadInput("the samples", "name voxels the grid does not have", "run extract_samples again on this grid")
    features = eigen_features(NeighbourTree(grid), rows, settings.neighbours, n_threads)
    names = feature_names(settings.neighbours)
    return lightgbm.Dataset(features, np.asarray(labels, np.int32), feature_name=names, params={"verbosity": -1}, free_raw_data=True)


def _mean_recall(shares: np.ndarray, data: lightgbm.Dataset) -> tuple[str, float, bool]:
    """Mean recall of the classes that occur."""
    labels = data.get_label().astype(np.int64)
    hits = np.bincount(labels[shares.argmax(axis=1) == labels], minlength=N_CLASSES)
    counts = np.bincount(labels, minlength=N_CLASSES)
    return "mean_recall", float((hits[counts > 0] / counts[counts > 0]).mean()), True
