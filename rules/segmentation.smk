"""C²CNN (Nagy 2020, chapter 2): samples, training, the label map and what is made from it."""


rule turn_map:
    """The training map and copies of it turned about the vertical, in one voxel grid."""
    input:
        code=library("turn_map"),
        map=map_of,
        voxels="results/voxelize_map/{dataset}/{split}/voxels.npz",
        labels="results/label_voxels/{dataset}/{split}/labels.npy",
    output:
        voxels="results/turn_map/{dataset}/{split}/voxels.npz",
        labels="results/turn_map/{dataset}/{split}/labels.npy",
    log:
        "results/turn_map/{dataset}/{split}/voxels.log",
    benchmark:
        "results/turn_map/{dataset}/{split}/voxels.bench.tsv"
    wildcard_constraints:
        split="train",
    conda:
        "../envs/streetscan.yaml"
    resources:
        mem_mb=4000,
    params:
        **config["turn_map"],
    script:
        "../scripts/turn_map.py"


rule extract_samples:
    """The same number of voxels of every class to train or validate on."""
    input:
        code=library("extract_samples"),
        voxels=lambda w: f"results/{'turn_map' if w.split == 'train' else 'voxelize_map'}/{w.dataset}/{w.split}/voxels.npz",
        labels=lambda w: f"results/{'turn_map' if w.split == 'train' else 'label_voxels'}/{w.dataset}/{w.split}/labels.npy",
    output:
        samples="results/extract_samples/{dataset}/{split}/samples.npz",
    log:
        "results/extract_samples/{dataset}/{split}/samples.log",
    wildcard_constraints:
        split="train|validation",
    conda:
        "../envs/streetscan.yaml"
    resources:
        mem_mb=2000,
    params:
        n_per_class=lambda w: config["extract_samples"][f"n_per_class_{w.split}"],
        expected=lambda w: classes_of(w.dataset) if w.split == "train" else [],
        seed=config["seed"],
    script:
        "../scripts/extract_samples.py"


rule train_segmenter:
    """Train a network on one part, steered by another; an interrupted training goes on where it was."""
    input:
        code=library("train_segmenter"),
        training=["results/turn_map/{dataset}/train/voxels.npz", "results/extract_samples/{dataset}/train/samples.npz"],
        validation=["results/voxelize_map/{dataset}/validation/voxels.npz", "results/extract_samples/{dataset}/validation/samples.npz"],
        labels="results/turn_map/{dataset}/train/labels.npy",
        initial=initial_network,
    output:
        weights="results/train_segmenter/{dataset}/{model}/weights.safetensors",
        settings="results/train_segmenter/{dataset}/{model}/settings.yaml",
        history="results/train_segmenter/{dataset}/{model}/history.csv",
    log:
        "results/train_segmenter/{dataset}/{model}/weights.log",
    benchmark:
        "results/train_segmenter/{dataset}/{model}/weights.bench.tsv"
    priority: 10  # the longest jobs first, or a core idles at the end
    conda:
        "../envs/streetscan.yaml"
    threads: config["n_threads"]
    resources:
        mem_mb=4000,
    params:
        network=structure_of,
        schedule=schedule_of,
        n_threads=config["n_threads"],
        device=config["device"],
    script:
        "../scripts/train_segmenter.py"


rule calibrate_segmenter:
    """A network whose confidence is right on the validation part, and how good it is there, before and after."""
    input:
        code=library("calibrate_segmenter"),
        network=trained_network,
        training=["results/turn_map/{dataset}/train/labels.npy", "results/extract_samples/{dataset}/train/samples.npz"],
        validation=[
            "results/label_voxels/{dataset}/validation/labels.npy",
            "results/extract_samples/{dataset}/validation/samples.npz",
            "results/voxelize_map/{dataset}/validation/voxels.npz",
        ],
    output:
        weights="results/calibrate_segmenter/{dataset}/{model}/weights.safetensors",
        settings="results/calibrate_segmenter/{dataset}/{model}/settings.yaml",
        scores="results/calibrate_segmenter/{dataset}/{model}/scores.csv",
        reliability="results/calibrate_segmenter/{dataset}/{model}/reliability.csv",
    log:
        "results/calibrate_segmenter/{dataset}/{model}/weights.log",
    conda:
        "../envs/streetscan.yaml"
    threads: config["n_threads"]
    resources:
        mem_mb=3000,
    params:
        prior_power=lambda w: model_of(w.model).get("prior_power", 0.0),
        schedule=schedule_of,
        groups=lambda w: facts(w.dataset).get("groups"),
        n_turns=config["label_map"]["n_turns"],
        n_threads=config["n_threads"],
    script:
        "../scripts/calibrate_segmenter.py"


rule train_baseline:
    """Boosted trees on the eigenvalues of each voxel's surroundings: what a network has to beat."""
    input:
        code=library("train_baseline"),
        training=["results/turn_map/{dataset}/train/voxels.npz", "results/extract_samples/{dataset}/train/samples.npz"],
        validation=["results/voxelize_map/{dataset}/validation/voxels.npz", "results/extract_samples/{dataset}/validation/samples.npz"],
    output:
        model="results/train_baseline/{dataset}/{model}/model.txt",
        settings="results/train_baseline/{dataset}/{model}/settings.yaml",
        history="results/train_baseline/{dataset}/{model}/history.csv",
    log:
        "results/train_baseline/{dataset}/{model}/model.log",
    benchmark:
        "results/train_baseline/{dataset}/{model}/model.bench.tsv"
    wildcard_constraints:
        model=f"({'|'.join(BASELINES)})(_seed_[0-9]+)?",
    priority: 10  # the longest jobs first, or a core idles at the end
    conda:
        "../envs/streetscan.yaml"
    threads: config["n_threads"]
    resources:
        mem_mb=4000,
    params:
        neighbours=config["train_baseline"]["neighbours"],
        schedule=lambda w: config["train_baseline"]["schedule"] | {"seed": seed_of(w.model)},
        n_threads=config["n_threads"],
    script:
        "../scripts/train_baseline.py"


rule label_map:
    """Label and confidence of every voxel and point of a group of tiles."""
    input:
        code=library("label_map"),
        map=map_of,
        voxels="results/voxelize_map/{dataset}/{split}/voxels.npz",
        network=network_of,
    output:
        map="results/label_map/{dataset}/{split}/{model}/map_{tiles}.laz",
        voxels="results/label_map/{dataset}/{split}/{model}/voxels_{tiles}.npz",
    log:
        "results/label_map/{dataset}/{split}/{model}/map_{tiles}.log",
    benchmark:
        "results/label_map/{dataset}/{split}/{model}/map_{tiles}.bench.tsv"
    conda:
        "../envs/streetscan.yaml"
    threads: config["n_threads"]
    resources:
        mem_mb=3000,
    params:
        tile_m=config["label_map"]["tile_m"],
        n_turns=config["label_map"]["n_turns"],
        smoothing=smoothing_of,
        tiles=lambda w: w.tiles,
        expected=structure_of,
        n_threads=config["n_threads"],
        device=config["device"],
    script:
        "../scripts/label_map.py"


rule clean_map:
    """The static map: without phantoms, vehicles and people."""
    input:
        code=library("clean_map"),
        maps=label_tiles("map_{}.laz"),
    output:
        static="results/clean_map/{dataset}/{split}/{model}/static.laz",
    log:
        "results/clean_map/{dataset}/{split}/{model}/static.log",
    conda:
        "../envs/streetscan.yaml"
    resources:
        mem_mb=2000,
    params:
        **config["clean_map"],
    script:
        "../scripts/clean_map.py"


rule extract_objects:
    """Every object of the label map as a box, in a layer a GIS opens."""
    input:
        code=library("extract_objects"),
        map=map_of,
        voxels="results/voxelize_map/{dataset}/{split}/voxels.npz",
        predictions=label_tiles("voxels_{}.npz"),
    output:
        objects="results/extract_objects/{dataset}/{split}/{model}/objects.gpkg",
    log:
        "results/extract_objects/{dataset}/{split}/{model}/objects.log",
    conda:
        "../envs/streetscan.yaml"
    resources:
        mem_mb=3000,
    params:
        **config["extract_objects"],
    script:
        "../scripts/extract_objects.py"
