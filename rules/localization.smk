"""Where a drive's frames are on the labelled map (Nagy 2020, chapter 3): landmarks, poses with a verdict each."""


rule cluster_landmarks:
    """Columns and furniture of a labelled map as landmarks; of a raw map everything that stands. Its ground and static points."""
    input:
        code=library("cluster_landmarks"),
        map=map_of,
        voxels="results/voxelize_map/{dataset}/{split}/voxels.npz",
        predictions=predictions_of,
        truth=lambda w: f"results/label_voxels/{w.dataset}/{w.split}/labels.npy" if w.labels == "oracle_truth" else [],
    output:
        layer="results/cluster_landmarks/{dataset}/{split}/{labels}/landmarks.gpkg",
        landmarks="results/cluster_landmarks/{dataset}/{split}/{labels}/landmarks.npz",
        reference="results/cluster_landmarks/{dataset}/{split}/{labels}/reference.npz",
    log:
        "results/cluster_landmarks/{dataset}/{split}/{labels}/landmarks.log",
    benchmark:
        "results/cluster_landmarks/{dataset}/{split}/{labels}/landmarks.bench.tsv"
    conda:
        "../envs/streetscan.yaml"
    resources:
        mem_mb=4000,
    params:
        **config["cluster_landmarks"],
    script:
        "../scripts/cluster_landmarks.py"


rule localize_frames:
    """The pose of every frame of a drive on a map, each with a verdict; the scans beside the map for Foxglove; pictures."""
    input:
        code=library("localize_frames"),
        drive=drive_file("drive.mcap"),
        landmarks=reference_file("landmarks.npz"),
        reference=reference_file("reference.npz"),
        truth=lambda w: poses_on_map(w) if config["localizers"][w.localizer]["start"] == "even" else [],
    output:
        poses="results/localize_frames/{dataset}/{drive}/{labels}/{localizer}/poses.csv",
        tum="results/localize_frames/{dataset}/{drive}/{labels}/{localizer}/poses.tum",
        view="results/localize_frames/{dataset}/{drive}/{labels}/{localizer}/view.mcap",
        pictures=directory("results/localize_frames/{dataset}/{drive}/{labels}/{localizer}/pictures"),
    log:
        "results/localize_frames/{dataset}/{drive}/{labels}/{localizer}/poses.log",
    benchmark:
        "results/localize_frames/{dataset}/{drive}/{labels}/{localizer}/poses.bench.tsv"
    conda:
        "../envs/streetscan.yaml"
    resources:
        mem_mb=2000,
    params:
        method=lambda w: config["localizers"][w.localizer]["method"],
        settings=localizer_settings,
        sequence=localizer_sequence,
        seed=config["seed"],
    script:
        "../scripts/localize_frames.py"


rule export_autoware_map:
    """A static map as Autoware reads it: tiles of 20 m as PCD and their metadata."""
    input:
        code=library("export_autoware_map"),
        static="results/clean_map/{dataset}/{split}/{model}/static.laz",
    output:
        folder=directory("results/export_autoware_map/{dataset}/{split}/{model}/pointcloud_map"),
    log:
        "results/export_autoware_map/{dataset}/{split}/{model}/pointcloud_map.log",
    conda:
        "../envs/streetscan.yaml"
    resources:
        mem_mb=2000,
    params:
        **config["export_autoware_map"],
    script:
        "../scripts/export_autoware_map.py"
