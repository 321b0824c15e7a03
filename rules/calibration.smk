"""Camera and lidar of a drive (Nagy 2020, chapter 4): keyframes, and what their images say about the street."""


rule choose_keyframes:
    """Places of a drive for one calibration each: images that moved, the lidar frame beside them, columns in view."""
    input:
        code=library("choose_keyframes"),
        drive=drive_file("drive.mcap"),
    output:
        keyframes="results/choose_keyframes/{drive}/keyframes.csv",
    log:
        "results/choose_keyframes/{drive}/keyframes.log",
    benchmark:
        "results/choose_keyframes/{drive}/keyframes.bench.tsv"
    conda:
        "../envs/streetscan.yaml"
    resources:
        mem_mb=1000,
    params:
        **config["choose_keyframes"],
        n_keyframes=lambda w: n_keyframes(w.drive),
    script:
        "../scripts/choose_keyframes.py"


rule reconstruct_keyframe:
    """Sparse and dense cloud of a keyframe's images in metres, its cameras, and the projection into the image beside the lidar frame."""
    input:
        code=library("reconstruct_keyframe"),
        drive=drive_file("drive.mcap"),
        keyframes="results/choose_keyframes/{drive}/keyframes.csv",
        poses=lambda w: f"results/register_frames/{w.drive}/{config['reconstruct_keyframe']['registrar']}/poses.csv",
        masks="results/detect_dynamic/{drive}/masks",
    output:
        model=directory("results/reconstruct_keyframe/{drive}/{keyframe}/model"),
        summary="results/reconstruct_keyframe/{drive}/{keyframe}/summary.csv",
    log:
        "results/reconstruct_keyframe/{drive}/{keyframe}/summary.log",
    benchmark:
        "results/reconstruct_keyframe/{drive}/{keyframe}/summary.bench.tsv"
    conda:
        "../envs/streetscan.yaml"
    threads: config["n_threads"]
    resources:
        mem_mb=3000,
    params:
        settings=config["reconstruct_keyframe"]["settings"],
        keyframe=lambda w: int(w.keyframe),
        seed=config["seed"],
        n_threads=config["n_threads"],
    script:
        "../scripts/reconstruct_keyframe.py"
