"""What the chapters' files share: facts of the data sets, paths, wildcards, and the library code each step runs."""

import ast
import functools
import re
import sys
from pathlib import Path

import yaml

HOME = Path(workflow.basedir)
sys.path.insert(0, str(HOME))

from streetscan.classes import NAMES
from streetscan.datasets import check_facts, load_dataset
from streetscan.errors import StreetscanError
from streetscan.io.files import read_yaml


wildcard_constraints:
    dataset=r"[a-z0-9_]+",
    split="train|validation|test|all",
    tiles=r"\d+of\d+",
    model=r"[a-z0-9_]+",
    drive=r"[a-z0-9_]+",
    registrar=r"[a-z0-9_]+",
    labels=r"[a-z0-9_]+",
    localizer=r"[a-z0-9_]+",
    keyframe=r"\d\d",
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


def as_workflow_error(function):
    """The function, its one-sentence errors shown as Snakemake shows its own: without a traceback."""

    @functools.wraps(function)
    def wrapped(*arguments):
        try:
            return function(*arguments)
        except StreetscanError as error:
            raise WorkflowError(str(error)) from None

    return wrapped


@as_workflow_error
def check_config():
    """Refuse unknown keys and impossible values of the config in one sentence."""
    check_facts(dict(config), yaml.safe_load((HOME / "config" / "schema.yaml").read_text()), "the config")


check_config()

SELECTIONS = (
    "labelled_maps",
    "tuned_models",
    "refined_models",
    "thinned_models",
    "drives",
    "registered_drives",
    "merged_drives",
    "calibrated_drives",
    "localized_drives",
)
if not any(config[key] for key in (*SELECTIONS, "datasets_folder", "drives_folder")):
    config.update(config["first_run"])
elif config["run"] == "default":
    config["run"] = "own"  # a selection without a name must not write over the first run's report

DATASETS = Path(config["datasets_folder"] or HOME / "config" / "datasets")
DRIVES = Path(config["drives_folder"] or HOME / "config" / "drives")


def map_name(name):
    """The data set whose map a data set has: itself, or in `voxel_variants` the one that is seen in voxels of another size."""
    return config["voxel_variants"].get(name, {}).get("dataset", name)


def voxel_size(name):
    """Voxel edge of a data set, m."""
    return config["voxel_variants"].get(name, config["voxelize_map"])["size_m"]


@functools.cache
@as_workflow_error
def dataset(name):
    """A data set's file, checked."""
    return load_dataset(DATASETS / f"{map_name(name)}.yaml", HOME / "config" / "dataset.schema.yaml")


@functools.cache
def facts(name):
    """The content of a data set's file, checked."""
    dataset(name)
    return yaml.safe_load((DATASETS / f"{map_name(name)}.yaml").read_text())


@functools.cache
@as_workflow_error
def drive_facts(name):
    """The content of a drive's file, its keys checked; the step that makes the drive checks what they say together."""
    path = DRIVES / f"{name}.yaml"
    if not path.is_file():
        raise WorkflowError(f"{path}: no such drive; write its file or correct its name in the config.")
    content = read_yaml(path)
    check_facts(content, read_yaml(HOME / "config" / "drive.schema.yaml"), path)
    return content


def step_of_drive(drive):
    """The step that makes a drive's files."""
    return "simulate_drive" if drive_facts(drive)["reader"] == "simulate" else "import_drive"


def drive_file(name, drive=None):
    """An input function: drive.mcap, frames.csv or truth of a drive, simulated or imported; of the wildcard's by default."""

    def path(wildcards):
        chosen = drive or wildcards.drive
        return f"results/{step_of_drive(chosen)}/{chosen}/{name}"

    return path


def lidar_height(drive):
    """Height of a drive's lidar above the road in m, as its file gives it."""
    heights = [m["xyz_m"][2] for m in drive_facts(drive).get("mounting", []) if (m["parent"], m["child"]) == ("vehicle", "lidar")]
    if not heights:
        raise WorkflowError(f"{DRIVES / drive}.yaml: no mounting of the lidar on the vehicle; add it to the drive's file.")
    return heights[0]


def street_of(wildcards):
    """The street a simulated drive goes through, as the map of its data set was made with."""
    simulation, where = drive_facts(wildcards.drive)["simulation"], f"{DRIVES / wildcards.drive}.yaml"
    known = facts(simulation["dataset"])
    found = f"{simulation['dataset']}/{simulation['split']}"
    if known["source"] != "simulate" or simulation["split"] not in known["parts"]:
        raise WorkflowError(f"{where}: {found} is no simulated street; name a data set of source simulate and its part.")
    street = known["simulation"]["street"] | {"length_m": known["parts"][simulation["split"]]["length_m"], "crs": known["crs"]}
    if simulation["place"] != "mapping":
        return street
    if "n_rounds" not in known["simulation"]:
        raise WorkflowError(f"{where}: {found} is not mapped from a vehicle; name a data set with scanners, or another place.")
    return street | {"n_rounds": known["simulation"]["n_rounds"]}


def step_of_map(dataset):
    """The step that makes a data set's map."""
    return {"simulate": "simulate_city", "import": "import_map", "merge": "import_map"}[facts(dataset)["source"]]


def map_of(wildcards):
    """The map of a part."""
    return f"results/{step_of_map(wildcards.dataset)}/{map_name(wildcards.dataset)}/{wildcards.split}/map.laz"


def truth_of(wildcards):
    """The true labels of a part's points."""
    return f"results/{step_of_map(wildcards.dataset)}/{map_name(wildcards.dataset)}/{wildcards.split}/truth/labels.npy"


@as_workflow_error
def list_files(name, part):
    """The files of a part of an imported data set, or the tiles of a drive; one that is missing is an error of one sentence."""
    if facts(name)["source"] == "merge":
        drive, registrar = (facts(name)["merge"][key] for key in ("drive", "registrar"))
        check_registrar(drive, registrar, f"data set '{name}'")
        return [f"results/merge_frames/{drive}/{registrar}/tiles"]
    return [str(path) for path in dataset(name).files(part, config["data_root"])]


def files_of(wildcards):
    """An input function: the files of a part."""
    return list_files(wildcards.dataset, wildcards.split)


def labelled_part(name):
    """The part a model labels: `test`, or the whole of a scan that has no parts."""
    return "test" if "test" in facts(name)["parts"] else "all"


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


def is_shipped(source):
    """Whether a network is one of those that come with streetscan: `shipped` or `shipped_<variant>`."""
    return source is not None and re.fullmatch(r"shipped(_[a-z0-9]+)?", source) is not None


def network_files(source, step="calibrate_segmenter"):
    """Weights and settings of a network: those in weights/c2cnn<_variant>/, or what a step made of `<data set>/<model>`."""
    shipped = HOME / "weights" / f"c2cnn{source.removeprefix('shipped')}"
    folder = shipped if is_shipped(source) else f"results/{step}/{source}"
    return [f"{folder}/weights.safetensors", f"{folder}/settings.yaml"]


# Reference methods that are no networks; they are trained on the data set they label.
BASELINES = ("lightgbm",)


def split_seed(model):
    """A model's name without the seed it may end in, and that seed: `c2cnn_seed_2` is c2cnn trained with seed 2; None without."""
    base, mark, seed = model.rpartition("_seed_")
    if mark and not seed.isdigit():
        raise WorkflowError(f"model '{model}': what follows _seed_ is no whole number; write {base}_seed_2 to train {base} with seed 2.")
    return (base, int(seed)) if mark else (model, None)


def base_of(model):
    """The method a model is, whatever the seed of its training."""
    return split_seed(model)[0]


def is_baseline(model):
    """Whether a model is a reference method that is no network."""
    return base_of(model) in BASELINES


def model_of(name):
    """A network as the config describes it. A seed in its name is that of its training, and of the networks it takes or starts from."""
    base, seed = split_seed(name)
    model = config["models"][base]
    if seed is None:
        return model
    named = {key: model[key] for key in ("weights", "initial") if model[key] not in ("own", None) and not is_shipped(model[key])}
    sources = {key: source for key, source in named.items() if "_seed_" not in source}
    return model | {key: f"{source}_seed_{seed}" for key, source in sources.items()} | {"schedule": model["schedule"] | {"seed": seed}}


def seed_of(model):
    """The seed a model is trained with."""
    seed = split_seed(model)[1]
    schedule = {} if is_baseline(model) else model_of(model)["schedule"]
    return schedule.get("seed", config["seed"]) if seed is None else seed


def training_of(dataset, model):
    """The folder of a model's training."""
    return f"results/{'train_baseline' if is_baseline(model) else 'train_segmenter'}/{dataset}/{model}"


def is_calibrated(model):
    """Whether a model's confidence is calibrated on the data set it labels: it was trained there, or asks for it by its `prior_power`."""
    return model_of(model)["weights"] == "own" or "prior_power" in model_of(model)


def files_of_model(dataset, model):
    """What a model labels a data set with: a network of the data set's own training, another one's, or shipped; or a baseline's trees."""
    if is_baseline(model):
        return [f"{training_of(dataset, model)}/{name}" for name in ("model.txt", "settings.yaml")]
    return network_files(f"{dataset}/{model}" if is_calibrated(model) else model_of(model)["weights"])


def network_of(wildcards):
    """An input function: what the wildcards' model labels their data set with."""
    return files_of_model(wildcards.dataset, wildcards.model)


def trained_network(wildcards):
    """The network, as trained, that is calibrated for a data set."""
    source = model_of(wildcards.model)["weights"]
    return network_files(f"{wildcards.dataset}/{wildcards.model}" if source == "own" else source, "train_segmenter")


def initial_network(wildcards):
    """The network a training starts from; none starts from random weights."""
    source = model_of(wildcards.model)["initial"]
    return network_files(source, "train_segmenter") if source else []


def schedule_of(wildcards):
    """`train_segmenter.schedule` with what the model changes in it."""
    return config["train_segmenter"]["schedule"] | {"seed": config["seed"]} | model_of(wildcards.model)["schedule"]


def smoothing_of(wildcards):
    """`label_map.smoothing` for a model whose labels are smoothed, else None."""
    is_smoothed = not is_baseline(wildcards.model) and model_of(wildcards.model).get("is_smoothed")
    return config["label_map"]["smoothing"] if is_smoothed else None


def structure_of(wildcards):
    """`train_segmenter.network` with what the model changes in it and its channels, or what a baseline looks at."""
    if is_baseline(wildcards.model):
        return {"neighbours": config["train_baseline"]["neighbours"]}
    model = model_of(wildcards.model)
    return config["train_segmenter"]["network"] | model.get("network", {}) | {"channels": model["channels"]}


def classes_of(dataset):
    """The classes a data set promises: those its class map names, or all."""
    names = set(facts(dataset).get("class_map", {}).values()) or set(NAMES)
    return sorted(names - {"unlabelled"})


def pairs(names):
    """The names' parts, such as data set and model of `dataset/model`."""
    return [tuple(name.split("/")) for name in names]


def check_pair(name, model, needs_map=True, after=()):
    """Refuse a (data set, model) pair that cannot be made, in one sentence that says why; `after` are the pairs that start from it."""
    if (name, model) in after:
        raise WorkflowError(f"models: '{name}/{model}' starts from itself; set its weights or initial to another network.")
    known, (base, seed) = [*config["models"], *BASELINES], split_seed(model)
    if base not in known:
        raise WorkflowError(f"labelled_maps: model '{base}' is not in the config; use one of {', '.join(known)}.")
    described = {"weights": "own", "initial": None} if is_baseline(model) else model_of(model)
    parts, truth, source = set(facts(name)["parts"]), facts(name)["truth"], described["weights"]
    if seed is not None and is_shipped(source):
        raise WorkflowError(f"labelled_maps: model '{model}': the shipped network is not trained again; use {base}.")
    is_own = source == "own" or "prior_power" in described
    if needs_map and not parts & {"test", "all"}:
        raise WorkflowError(f"labelled_maps: data set '{name}' has no part 'test' or 'all' to label; add one to its file.")
    if is_own and (truth != "labels" or not {"train", "validation"} <= parts):
        raise WorkflowError(
            f"labelled_maps: model '{model}' trains on data set '{name}', which lacks labels or a part 'train' or 'validation'; "
            "use c2cnn_shipped, or add them to its file."
        )
    for other in {source, described["initial"]} - {"own", None}:
        if is_shipped(other):
            check_shipped(name, model, other)
            continue
        check_pair(*other.split("/"), needs_map=False, after=(*after, (name, model)))


def check_shipped(name, model, source):
    """Refuse a network that does not come with streetscan, or whose voxels are not the data set's, in one sentence."""
    path = network_files(source)[1]
    if not Path(path).is_file():
        known = sorted(f"shipped{p.name.removeprefix('c2cnn')}" for p in (HOME / "weights").glob("c2cnn*"))
        raise WorkflowError(f"models: '{model}' takes '{source}', which does not come with streetscan; use {' or '.join(known)}.")
    size_m = read_yaml(path)["size_m"]
    if abs(size_m - voxel_size(name)) > 1e-9 * size_m:
        raise WorkflowError(
            f"labelled_maps: '{name}/{model}': the network '{source}' is for voxels of {size_m} m, the map's have {voxel_size(name)} m; "
            "set voxelize_map.size_m, or use another model."
        )


def has_labels(drive):
    """Whether the true labels of a drive's points are known."""
    return drive_facts(drive)["reader"] == "simulate" or "labels" in drive_facts(drive).get("truth", {})


def registration_settings(wildcards):
    """`register_frames.settings` with what the registrar is and changes."""
    registrar, settings = config["registrars"][wildcards.registrar], config["register_frames"]["settings"]
    changed = settings | registrar["settings"] | {"ndt": settings["ndt"] | registrar["settings"].get("ndt", {})}
    return changed | {key: registrar[key] for key in ("method", "target", "classes")} | {"n_threads": config["n_threads"]}


def timings_of(wildcards):
    """What a registrar's frames took: the registration, and the grid where its classes are matched."""
    paths = [f"results/register_frames/{wildcards.drive}/{wildcards.registrar}/timings.csv"]
    uses_grid = config["registrars"][wildcards.registrar]["classes"]
    return paths + [f"results/segment_frames/{wildcards.drive}/timings.csv"] * bool(uses_grid)


def reference_facts(wildcards):
    """How good a drive's true poses are: `is_planar` and `smoothing_s`."""
    poses = drive_facts(wildcards.drive).get("truth", {}).get("poses", {})
    return {key: poses[key] for key in ("is_planar", "smoothing_s") if key in poses}


def check_registrar(drive, registrar, where):
    """Refuse a drive without a file and a registrar that is not in the config."""
    drive_facts(drive)
    if registrar not in config["registrars"]:
        raise WorkflowError(f"{where}: registrar '{registrar}' is not in the config; use one of {', '.join(config['registrars'])}.")


def with_seeds(selected):
    """(data set, method, seed) of (data set, model) pairs."""
    return [(d, base_of(m), seed_of(m)) for d, m in selected]


def methods_of(selected):
    """(data set, method) of (data set, model) pairs, whatever the seeds."""
    return [(d, base_of(m)) for d, m in selected]


def check_seeds(selected, where):
    """Refuse a training that is named twice, with its seed and without."""
    trainings = with_seeds(selected)
    for i, (name, base, seed) in enumerate(trainings):
        if (name, base, seed) in trainings[:i]:
            raise WorkflowError(f"{where}: '{name}/{base}' is named twice with seed {seed}; drop one, or give it another seed.")


LABELLED, TUNED, REFINED = (pairs(config[key]) for key in ("labelled_maps", "tuned_models", "refined_models"))
for name in config["voxel_variants"]:
    if (DATASETS / f"{name}.yaml").is_file():
        raise WorkflowError(f"voxel_variants: '{name}' has a data set file of its own; give the variant another name.")
for name, model in LABELLED + TUNED + REFINED:
    check_pair(name, model, needs_map=(name, model) in LABELLED)
    for part in facts(name)["parts"]:
        list_files(name, part)  # now rather than in the middle of the DAG
for key, selected in (("tuned_models", TUNED), ("refined_models", REFINED)):
    check_seeds(selected, key)
    for name, model in selected:
        if is_baseline(model) or not is_calibrated(model):
            raise WorkflowError(f"{key}: '{name}/{model}' is no network trained on that data set; name one whose weights are own.")
check_seeds(LABELLED, "labelled_maps")
THINNED = pairs(config["thinned_models"])
check_seeds(THINNED, "thinned_models")
for name, model in THINNED:
    check_pair(name, model, needs_map=False)
    if is_baseline(model) or facts(name)["truth"] != "labels":
        raise WorkflowError(f"thinned_models: '{name}/{model}' is no network on a data set with labels; name one that is.")
THINNED_PARTS = [
    f"{d}/{part}" for d in dict.fromkeys(d for d, _ in THINNED) for part in ("validation", "test") if part in facts(d)["parts"]
]
EVALUATED = [(d, m) for d, m in LABELLED if facts(d)["truth"] == "labels" and "test" in facts(d)["parts"]]
# Pictures and products are of one of a method's seeds, the first that is named; its scores are of all.
SHOWN = [(d, m) for i, (d, m) in enumerate(LABELLED) if (d, base_of(m)) not in methods_of(LABELLED[:i])]
TRAINED = [(d, m) for d, m in SHOWN if is_baseline(m) or model_of(m)["weights"] == "own"]
NETWORKS = list(dict.fromkeys([(d, m) for d, m in LABELLED if not is_baseline(m) and is_calibrated(m)] + TUNED + REFINED))


def thinned_on(name):
    """The models whose labels of ever fewer points of a data set are scored."""
    if models := [m for d, m in THINNED if d == name]:
        return models
    raise WorkflowError(f"thinned_models: none of data set '{name}'; name '{name}/c2cnn' there, or another network.")


def network_facts(dataset, model):
    """What the tables say of a network."""
    of_model = config["models"][base_of(model)]
    network, changed = config["train_segmenter"]["network"], of_model.get("network", {})
    is_plain = (
        of_model["channels"] == ["count", "height"]
        and of_model["weights"] == "own"
        and not of_model["initial"]
        and not of_model["schedule"]
    )
    return {
        "dataset": dataset,
        "method": base_of(model),
        "seed": seed_of(model),
        "map": map_name(dataset),
        "size_m": voxel_size(dataset),
        "k": (network | changed)["k"],
        "is_labelled": (dataset, model) in LABELLED,
        "is_tuned": (dataset, model) in TUNED,
        "is_refined": (dataset, model) in REFINED,
        "is_point": is_plain and set(changed) <= {"k", "is_padded"} and not of_model.get("prior_power"),
    }


def for_pairs(path, selected):
    """A path's instances for (data set, model) pairs."""
    return [path.format(dataset=d, split=labelled_part(d), model=m) for d, m in selected]


def is_complete(folder, patterns):
    """Whether a folder of real recordings holds something for every pattern."""
    return all(any(Path(config["data_root"], folder).glob(pattern)) for pattern in patterns)


def find_compared():
    """Real maps and drives the simulated ones are put beside, and the names of those whose files or recordings are not there."""
    maps, drives, absent = [], [], []
    for name, part in pairs(config["evaluate_realism"]["compared_maps"]):
        there = (DATASETS / f"{name}.yaml").is_file() and is_complete(".", dataset(name).parts[part].files)
        (maps if there else absent).append((name, part) if there else name)
    for name in config["evaluate_realism"]["compared_drives"]:
        file = DRIVES / f"{name}.yaml"
        there = file.is_file() and is_complete(yaml.safe_load(file.read_text())["root"], ["*"])
        (drives if there else absent).append(name)
    return maps, drives, absent


def find_static_scans():
    """Data sets of a static scanner whose streets a mobile map of this run shows."""
    wanted = [d for d in config["evaluate_density"]["static_scans"] if SIMULATED and (DATASETS / f"{d}.yaml").is_file()]
    return [d for d in wanted if (facts(d)["same_streets_as"], "test") in SIMULATED]


def moves_on_a_van(name):
    """Whether a data set is simulated and scanned by a mobile mapper."""
    return facts(name)["source"] == "simulate" and "same_streets_as" not in facts(name)


SIMULATED = list(dict.fromkeys((map_name(d), labelled_part(d)) for d, _ in LABELLED if moves_on_a_van(d)))
COMPARED_MAPS, COMPARED_DRIVES, NOT_COMPARED = find_compared() if SIMULATED else ([], [], [])
STATIC_SCANS = find_static_scans()


def realism_tables():
    """Name of each map or drive to the table of its statistics: the simulated ones first."""
    tables = {d: f"results/evaluate_realism/{d}/{part}/realism.csv" for d, part in SIMULATED + COMPARED_MAPS}
    return tables | {d: f"results/evaluate_drive_realism/{d}/realism.csv" for d in COMPARED_DRIVES}


def map_and_truth(name):
    """A simulated data set's test map and its points' labels."""
    return [f"results/simulate_city/{name}/test/{file}" for file in ("map.laz", "truth/labels.npy")]


for drive in config["drives"] + config["evaluate_sensor"]["drives"]:
    drive_facts(drive)
REGISTERED, MERGED = pairs(config["registered_drives"]), pairs(config["merged_drives"])
for drive, registrar in REGISTERED + MERGED:
    check_registrar(drive, registrar, "registered_drives and merged_drives")
LABELLED_DRIVES = [(d, r) for d, r in REGISTERED if has_labels(d)]


def for_drives(path, selected):
    """A path's instances for (drive, registrar) pairs."""
    return list(dict.fromkeys(path.format(drive=d, registrar=r) for d, r in selected))


def localizations():
    """The (data set, drive, labels, localizer) tuples of `localized_drives`, each checked."""
    found = pairs(config["localized_drives"])
    for dataset_, drive, labels, localizer in found:
        where = f"localized_drives: {dataset_}/{drive}/{labels}/{localizer}"
        if localizer not in config["localizers"]:
            raise WorkflowError(f"{where}: localizer '{localizer}' is not in the config; use one of {', '.join(config['localizers'])}.")
        if (config["localizers"][localizer]["start"] == "even") != localizer.startswith("oracle_"):
            raise WorkflowError(
                f"{where}: a localizer whose starts are made from true poses, and no other, has a name that begins with oracle_."
            )
        mapped_split(dataset_, drive)
        if labels == "oracle_truth" and facts(dataset_)["truth"] != "labels":
            raise WorkflowError(f"{where}: the data set has no true labels; use raw or a model.")
        if labels not in ("raw", "oracle_truth"):
            check_pair(dataset_, labels)
    return found


def mapped_split(dataset, drive):
    """The part of a data set a drive goes through: a simulated drive says it, a real one has the part that is labelled."""
    simulation = drive_facts(drive).get("simulation")
    if simulation is None:
        return labelled_part(dataset)
    if simulation["dataset"] != dataset:
        raise WorkflowError(f"drive '{drive}' goes through data set '{simulation['dataset']}', not '{dataset}'.")
    return simulation["split"]


def predictions_of(wildcards):
    """The label map whose classes make landmarks; none for a raw map and for the true classes."""
    if wildcards.labels in ("raw", "oracle_truth"):
        return []
    folder = f"results/label_map/{wildcards.dataset}/{wildcards.split}/{wildcards.labels}"
    return [f"{folder}/voxels_{tiles}.npz" for tiles in tiles_of(wildcards.dataset, wildcards.split)]


def reference_file(name):
    """An input function: a file of cluster_landmarks for the part of the map a drive goes through."""

    def path(wildcards):
        split = mapped_split(wildcards.dataset, wildcards.drive)
        return f"results/cluster_landmarks/{wildcards.dataset}/{split}/{wildcards.labels}/{name}"

    return path


def localizer_settings(wildcards):
    """`localize_frames.settings` with what the localizer changes, section by section."""
    settings, changed = config["localize_frames"]["settings"], config["localizers"][wildcards.localizer]["settings"]
    return {k: (v | changed[k] if isinstance(v, dict) else changed[k]) if k in changed else v for k, v in settings.items()}


def localizer_sequence(wildcards):
    """`localize_frames.sequence` with which frames the localizer takes and where it starts."""
    localizer = config["localizers"][wildcards.localizer]
    chosen = {"mode": localizer["start"]} | {key: localizer[key] for key in ("first", "every", "n_frames") if key in localizer}
    return config["localize_frames"]["sequence"] | chosen


def is_own_street(dataset, drive):
    """Whether a map is merged from the frames of a drive itself."""
    return facts(dataset)["source"] == "merge" and facts(dataset)["merge"]["drive"] == drive


def poses_on_map(wildcards):
    """The poses a drive's frames have on a map: the true ones; on the street merged of its own frames, those they were registered at."""
    if is_own_street(wildcards.dataset, wildcards.drive):
        return f"results/register_frames/{wildcards.drive}/{facts(wildcards.dataset)['merge']['registrar']}/poses.csv"
    return drive_file("truth")(wildcards)


def mapped_truth(name):
    """An input function: a file of the true classes of the map's voxels, where they are known; for scoring."""

    def path(wildcards):
        split = mapped_split(wildcards.dataset, wildcards.drive)
        known = facts(wildcards.dataset)["truth"] == "labels"
        return f"results/{name.format(dataset=wildcards.dataset, split=split)}" if known else []

    return path


def n_keyframes(drive):
    """How many keyframes a drive has, as its file says."""
    camera = (drive_facts(drive).get("simulation") or drive_facts(drive)).get("camera")
    if camera is None:
        raise WorkflowError(f"calibrated_drives: drive '{drive}' has no section camera; leave it out, or add the camera to its file.")
    n = camera.get("n_keyframes", 2 if step_of_drive(drive) == "simulate_drive" else 1)
    if n == 0:
        raise WorkflowError(f"calibrated_drives: drive '{drive}' has 0 keyframes; leave it out, or raise n_keyframes in its file.")
    return n


def for_keyframes(path, drives):
    """A path's instances for every keyframe of drives."""
    return [path.format(drive=d, keyframe=f"{k:02d}") for d in drives for k in range(n_keyframes(d))]


def keyframe_poses(wildcards):
    """An input function: the lidar's poses that keyframes take their unit and motion from."""
    return f"results/register_frames/{wildcards.drive}/{config['reconstruct_keyframe']['registrar']}/poses.csv"


CALIBRATED = config["calibrated_drives"]
for drive in CALIBRATED:
    n_keyframes(drive)
    check_registrar(drive, config["reconstruct_keyframe"]["registrar"], "reconstruct_keyframe")


def place_of(drive):
    """What a simulated drive goes along (main_road, narrow_road, crossroads, ...), or nothing."""
    return drive_facts(drive).get("simulation", {}).get("place", "")


def has_poses(drive):
    """Whether the true poses of a drive are known."""
    return drive_facts(drive)["reader"] == "simulate" or "poses" in drive_facts(drive).get("truth", {})


def has_poses_on(dataset, drive):
    """Whether the poses of a drive on a map are known."""
    return is_own_street(dataset, drive) or (has_poses(drive) and facts(dataset)["crs"] is not None)


SCORED_CALIBRATIONS = [
    d for d in CALIBRATED if has_poses(d) and (step_of_drive(d) == "simulate_drive" or "extrinsics" in drive_facts(d)["truth"])
]
RECALIBRATED = config["evaluate_recalibration"]["drives"]
for drive in RECALIBRATED:
    if drive not in CALIBRATED or step_of_drive(drive) != "simulate_drive":
        raise WorkflowError(f"evaluate_recalibration.drives: '{drive}' is no simulated drive of calibrated_drives; name one that is.")
SCORED_DETECTIONS = [d for d in CALIBRATED if has_labels(d)]
LOCALIZED = localizations()
SCORED_LOCALIZATIONS = [(*names, place_of(names[1])) for names in LOCALIZED if has_poses_on(*names[:2])]


def for_localizations(path, selected):
    """A path's instances for (data set, drive, labels, localizer) tuples."""
    return [path.format(dataset=d, drive=r, labels=m, localizer=n) for d, r, m, n, *_ in selected]


def training_files(step, name):
    """An input function: a file of each drive a detector learns from; drives of other parts than train are refused."""

    def paths(wildcards):
        drives = config[step]["drives"]
        for drive in drives:
            if drive_facts(drive).get("simulation", {}).get("split") != "train":
                raise WorkflowError(f"{step}.drives: '{drive}' is no simulated drive of a part 'train'; name one that is.")
        return [f"results/simulate_drive/{drive}/{name}" for drive in drives]

    return paths


def chosen_detector(kind):
    """The detector of images or of lidar frames that detect_dynamic uses, as the config describes it."""
    name, known = config["detect_dynamic"][f"{kind}_detector"], config[f"{kind}_detectors"]
    if name not in known:
        raise WorkflowError(f"detect_dynamic.{kind}_detector: '{name}' is not in the config; use one of {', '.join(known)}.")
    return known[name]


def detector_files(kind):
    """The weights of that detector: those in weights/ (`shipped`), or the files it names, relative to data_root."""
    files = chosen_detector(kind)["files"]
    folder = HOME / "weights" / f"{kind}_detector"
    if files == ["shipped"]:
        return [f"{folder}/{name}" for name in ("weights.safetensors", "settings.yaml")]
    return [str(Path(config["data_root"], name)) for name in files]
