"""Camera and lidar of a drive (Nagy 2020, chapter 4): keyframes, and what their images say about the street."""


rule choose_keyframes:
    """Places of a drive for one calibration each: images that moved, the lidar frame beside them, columns around."""
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
        poses=keyframe_poses,
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


rule calibrate_keyframe:
    """Camera and lidar calibrated at one keyframe: objects, vote, ICP, control curves, projection, verdict, pictures."""
    input:
        code=library("calibrate_keyframe"),
        drive=drive_file("drive.mcap"),
        keyframes="results/choose_keyframes/{drive}/keyframes.csv",
        poses=keyframe_poses,
        model="results/reconstruct_keyframe/{drive}/{keyframe}/model",
        model_summary="results/reconstruct_keyframe/{drive}/{keyframe}/summary.csv",
        dynamic="results/detect_dynamic/{drive}/lidar",
    output:
        calibration="results/calibrate_keyframe/{drive}/{keyframe}/calibration.yaml",
        evidence="results/calibrate_keyframe/{drive}/{keyframe}/evidence.npz",
        summary="results/calibrate_keyframe/{drive}/{keyframe}/summary.csv",
        pictures=directory("results/calibrate_keyframe/{drive}/{keyframe}/pictures"),
    log:
        "results/calibrate_keyframe/{drive}/{keyframe}/calibration.log",
    benchmark:
        "results/calibrate_keyframe/{drive}/{keyframe}/calibration.bench.tsv"
    conda:
        "../envs/streetscan.yaml"
    resources:
        mem_mb=2000,
    params:
        settings=config["calibrate_keyframe"]["settings"],
        keyframe=lambda w: int(w.keyframe),
    script:
        "../scripts/calibrate_keyframe.py"


rule calibrate_drive:
    """One calibration of a drive from its accepted keyframes, with covariance and time offset; which keyframe's is in force when."""
    input:
        code=library("calibrate_drive"),
        drive=drive_file("drive.mcap"),
        keyframes="results/choose_keyframes/{drive}/keyframes.csv",
        poses=keyframe_poses,
        calibrations=lambda w: for_keyframes("results/calibrate_keyframe/{drive}/{keyframe}/calibration.yaml", [w.drive]),
        evidences=lambda w: for_keyframes("results/calibrate_keyframe/{drive}/{keyframe}/evidence.npz", [w.drive]),
    output:
        calibration="results/calibrate_drive/{drive}/calibration.yaml",
        history="results/calibrate_drive/{drive}/history.csv",
    log:
        "results/calibrate_drive/{drive}/calibration.log",
    conda:
        "../envs/streetscan.yaml"
    resources:
        mem_mb=1000,
    params:
        settings=config["calibrate_drive"],
        seed=config["seed"],
    script:
        "../scripts/calibrate_drive.py"
