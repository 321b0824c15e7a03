"""What the chapters' files share: facts of the data sets, paths, wildcards, and the library code each step runs."""

import ast
import functools
import sys
from pathlib import Path

import yaml

HOME = Path(workflow.basedir)
sys.path.insert(0, str(HOME))

from streetscan.classes import NAMES
from streetscan.datasets import load_dataset
from streetscan.errors import StreetscanError

DATASETS = Path(config["datasets_folder"] or HOME / "config" / "datasets")
DRIVES = Path(config["drives_folder"] or HOME / "config" / "drives")


wildcard_constraints:
    dataset=r"[a-z0-9_]+",
    split="train|validation|test|all",
    tiles=r"\d+of\d+",
    model=r"[a-z0-9_]+",
    drive=r"[a-z0-9_]+",
    run=r"[a-z0-9_]+",


@functools.cache
def library(step):
    """The modules of streetscan a step's script imports, however deep: Snakemake itself does not notice their edits."""
    seen, open_files = set(), [HOME / "scripts" / f"{step}.py"]
    while open_files:
        for name in imported_names(open_files.pop()):
            stem = HOME / name.replace(".", "/")
            for path in (stem.with_suffix(".py"), stem / "__init__.py"):
                if path.is_file() and path not in seen:
                    seen.add(path)
                    open_files.append(path)
    return sorted(str(path) for path in seen)


def imported_names(path):
    """Dotted names of ours that a Python file may import: modules, their parents, and names that may be modules."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            names |= {node.module} | {f"{node.module}.{alias.name}" for alias in node.names}
    ours = {name for name in names if name.split(".")[0] == "streetscan"}
    return {name.rsplit(".", i)[0] for name in ours for i in range(name.count(".") + 1)}


@functools.cache
def facts(dataset):
    """The content of a data set's file, checked."""
    path = DATASETS / f"{dataset}.yaml"
    if not path.is_file():
        raise WorkflowError(f"{path}: no such file; give data set '{dataset}' a file there or mend labelled_maps in the config.")
    try:
        load_dataset(path, HOME / "config" / "dataset.schema.yaml")
    except StreetscanError as error:
        raise WorkflowError(str(error)) from None
    return yaml.safe_load(path.read_text())


def step_of_map(dataset):
    """The step that makes a data set's map."""
    return {"simulate": "simulate_city", "import": "import_map"}[facts(dataset)["source"]]


def map_of(wildcards):
    """The map of a part."""
    return f"results/{step_of_map(wildcards.dataset)}/{wildcards.dataset}/{wildcards.split}/map.laz"


def truth_of(wildcards):
    """The true labels of a part's points."""
    return f"results/{step_of_map(wildcards.dataset)}/{wildcards.dataset}/{wildcards.split}/truth/labels.npy"


def files_of(wildcards):
    """The files of a part, relative to `data_root`."""
    return [str(Path(config["data_root"]) / name) for name in facts(wildcards.dataset)["parts"][wildcards.split]["files"]]


def labelled_part(dataset):
    """The part a model labels: `test` where there is truth, else the whole scan."""
    return "test" if "test" in facts(dataset)["parts"] else "all"


def tiles_of(dataset, split):
    """The names of the tile groups of a part."""
    n_tiles = facts(dataset)["parts"][split]["n_tiles"]
    return [f"{k}of{n_tiles}" for k in range(n_tiles)]


def label_tiles(name, split=None):
    """An input function: the labelled tile groups of a part, `map_{}.laz` or `voxels_{}.npz`."""

    def paths(wildcards):
        part = split or wildcards.split
        folder = f"results/label_map/{wildcards.dataset}/{part}/{wildcards.model}"
        return [f"{folder}/{name.format(tiles)}" for tiles in tiles_of(wildcards.dataset, part)]

    return paths


def network_files(source):
    """Weights and settings of a network: those in weights/ (`shipped`), or what a training, `<data set>/<model>`, wrote."""
    folder = HOME / "weights" / "c2cnn" if source == "shipped" else f"results/train_segmenter/{source}"
    return [f"{folder}/weights.safetensors", f"{folder}/settings.yaml"]


def network_of(wildcards):
    """The network a model labels a data set with: of the data set's own training, another one's, or shipped."""
    source = config["models"][wildcards.model]["weights"]
    return network_files(f"{wildcards.dataset}/{wildcards.model}" if source == "own" else source)


def initial_network(wildcards):
    """The network a training starts from; none starts from random weights."""
    source = config["models"][wildcards.model]["initial"]
    return network_files(source) if source else []


def schedule_of(wildcards):
    """`train_segmenter.schedule` with what the model changes in it."""
    return config["train_segmenter"]["schedule"] | {"seed": config["seed"]} | config["models"][wildcards.model]["schedule"]


def structure_of(wildcards):
    """`train_segmenter.network` with the model's channels."""
    return config["train_segmenter"]["network"] | {"channels": config["models"][wildcards.model]["channels"]}


def classes_of(dataset):
    """The classes a data set promises: those its class map names, or all."""
    names = set(facts(dataset).get("class_map", {}).values()) or set(NAMES)
    return sorted(names - {"unlabelled"})


def pairs(key):
    """The (data set, model) pairs of a list of `dataset/model` names in the config."""
    return [tuple(name.split("/")) for name in config[key]]


LABELLED = pairs("labelled_maps")
EVALUATED = [(d, m) for d, m in LABELLED if facts(d)["truth"] == "labels"]
TRAINED = [(d, m) for d, m in EVALUATED if config["models"][m]["weights"] == "own"]


def for_pairs(path, selected):
    """A path's instances for (data set, model) pairs."""
    return [path.format(dataset=d, split=labelled_part(d), model=m) for d, m in selected]
