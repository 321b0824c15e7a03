"""Maps and drives come in, simulated or imported; maps become voxels, drives one file in one form."""


rule simulate_city:
    """One street of the simulated city, scanned by a mobile mapper; truth apart."""
    input:
        code=library("simulate_city"),
    output:
        map="results/simulate_city/{dataset}/{split}/map.laz",
        labels="results/simulate_city/{dataset}/{split}/truth/labels.npy",
        instances="results/simulate_city/{dataset}/{split}/truth/instances.npy",
    log:
        "results/simulate_city/{dataset}/{split}/map.log",
    benchmark:
        "results/simulate_city/{dataset}/{split}/map.bench.tsv"
    conda:
        "../envs/streetscan.yaml"
    threads: config["n_threads"]
    resources:
        mem_mb=4000,
    params:
        settings=lambda w: facts(w.dataset)["simulation"],
        split=lambda w: w.split,
        part=lambda w: facts(w.dataset)["parts"][w.split],
        seed=config["seed"],
    script:
        "../scripts/simulate_city.py"


rule import_map:
    """A part of a real map as LAZ, its labels apart and in the nine classes."""
    input:
        code=library("import_map"),
        files=files_of,
    output:
        map="results/import_map/{dataset}/{split}/map.laz",
        labels="results/import_map/{dataset}/{split}/truth/labels.npy",
    log:
        "results/import_map/{dataset}/{split}/map.log",
    benchmark:
        "results/import_map/{dataset}/{split}/map.bench.tsv"
    conda:
        "../envs/streetscan.yaml"
    resources:
        mem_mb=2000,
    params:
        facts=lambda w: facts(w.dataset),
        stretch=lambda w: dataset(w.dataset).part(w.split).stretch,
    script:
        "../scripts/import_map.py"


rule voxelize_map:
    """Occupied voxels of a map: number of points and mean height above the local ground."""
    input:
        code=library("voxelize_map"),
        map=map_of,
    output:
        voxels="results/voxelize_map/{dataset}/{split}/voxels.npz",
    log:
        "results/voxelize_map/{dataset}/{split}/voxels.log",
    benchmark:
        "results/voxelize_map/{dataset}/{split}/voxels.bench.tsv"
    conda:
        "../envs/streetscan.yaml"
    resources:
        mem_mb=3000,
    params:
        size_m=lambda w: voxel_size(w.dataset),
        ground=config["voxelize_map"]["ground"],
    script:
        "../scripts/voxelize_map.py"


rule label_voxels:
    """The true label of each voxel: the majority of its points."""
    input:
        code=library("label_voxels"),
        map=map_of,
        truth=truth_of,
        voxels="results/voxelize_map/{dataset}/{split}/voxels.npz",
    output:
        labels="results/label_voxels/{dataset}/{split}/labels.npy",
    log:
        "results/label_voxels/{dataset}/{split}/labels.log",
    conda:
        "../envs/streetscan.yaml"
    resources:
        mem_mb=3000,
    script:
        "../scripts/label_voxels.py"


rule import_drive:
    """A recording, in whatever format it has, as one MCAP file with Foxglove schemas; its truth apart."""
    input:
        code=library("import_drive"),
        facts=f"{DRIVES}/{{drive}}.yaml",
        schema=f"{HOME}/config/drive.schema.yaml",
    output:
        mcap="results/import_drive/{drive}/drive.mcap",
        frames="results/import_drive/{drive}/frames.csv",
        truth=directory("results/import_drive/{drive}/truth"),
    log:
        "results/import_drive/{drive}/drive.log",
    benchmark:
        "results/import_drive/{drive}/drive.bench.tsv"
    conda:
        "../envs/streetscan.yaml"
    resources:
        mem_mb=1000,
    params:
        data_root=config["data_root"],
        drive=lambda w: w.drive,
    script:
        "../scripts/import_drive.py"


rule simulate_drive:
    """A drive through a simulated street on another day as MCAP, recorded by a rotating lidar and GPS; its truth apart."""
    input:
        code=library("simulate_drive"),
        facts=f"{DRIVES}/{{drive}}.yaml",
        schema=f"{HOME}/config/drive.schema.yaml",
    output:
        mcap="results/simulate_drive/{drive}/drive.mcap",
        frames="results/simulate_drive/{drive}/frames.csv",
        truth=directory("results/simulate_drive/{drive}/truth"),
    log:
        "results/simulate_drive/{drive}/drive.log",
    benchmark:
        "results/simulate_drive/{drive}/drive.bench.tsv"
    conda:
        "../envs/streetscan.yaml"
    threads: config["n_threads"]
    resources:
        mem_mb=4000,
    params:
        data_root=config["data_root"],
        drive=lambda w: w.drive,
        street=street_of,
        seed=config["seed"],
        n_threads=config["n_threads"],
    script:
        "../scripts/simulate_drive.py"


rule inspect_drive:
    """One page per drive: track, gaps, points per frame, frames and images, lidar in the image."""
    input:
        code=library("inspect_drive"),
        facts=f"{DRIVES}/{{drive}}.yaml",
        schema=f"{HOME}/config/drive.schema.yaml",
        mcap=drive_file("drive.mcap"),
        frames=drive_file("frames.csv"),
        truth=drive_file("truth"),
    output:
        sheet="results/inspect_drive/{drive}/sheet.html",
    log:
        "results/inspect_drive/{drive}/sheet.log",
    conda:
        "../envs/streetscan.yaml"
    resources:
        mem_mb=1500,
    params:
        **config["inspect_drive"],
        drive=lambda w: w.drive,
    script:
        "../scripts/inspect_drive.py"


rule export_drive:
    """A drive in a common format; what the format cannot hold is said."""
    input:
        code=library("export_drive"),
        mcap=drive_file("drive.mcap"),
        truth=drive_file("truth") if config["export_drive"]["with_truth"] else [],
    output:
        folder=directory("results/export_drive/{drive}/exported"),
    log:
        "results/export_drive/{drive}/exported.log",
    conda:
        "../envs/streetscan.yaml"
    resources:
        mem_mb=1000,
    params:
        **{key: config["export_drive"][key] for key in ("format", "first", "n_frames")},
    script:
        "../scripts/export_drive.py"
