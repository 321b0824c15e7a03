"""Detectors of what could move (Nagy 2020, 4.3.1 and 4.3.2.1): trained on drives of the training parts, used on keyframes."""


rule train_image_detector:
    """Train the city's image detector on pictures of simulated training drives; its weights come with streetscan."""
    input:
        code=library("train_image_detector"),
        drives=training_files("train_image_detector", "drive.mcap"),
        truths=training_files("train_image_detector", "truth"),
    output:
        weights="results/train_image_detector/weights.safetensors",
        settings="results/train_image_detector/settings.yaml",
        history="results/train_image_detector/history.csv",
    log:
        "results/train_image_detector/weights.log",
    benchmark:
        "results/train_image_detector/weights.bench.tsv"
    conda:
        "../envs/streetscan.yaml"
    resources:
        mem_mb=3000,
    params:
        **{key: config["train_image_detector"][key] for key in ("network", "n_threads")},
        schedule=config["train_image_detector"]["schedule"] | {"seed": config["seed"]},
    script:
        "../scripts/train_image_detector.py"


rule train_lidar_detector:
    """Train the street's PointPillars on lidar frames of simulated training drives; its weights come with streetscan."""
    input:
        code=library("train_lidar_detector"),
        drives=training_files("train_lidar_detector", "drive.mcap"),
        truths=training_files("train_lidar_detector", "truth"),
    output:
        weights="results/train_lidar_detector/weights.safetensors",
        settings="results/train_lidar_detector/settings.yaml",
        history="results/train_lidar_detector/history.csv",
    log:
        "results/train_lidar_detector/weights.log",
    benchmark:
        "results/train_lidar_detector/weights.bench.tsv"
    conda:
        "../envs/streetscan.yaml"
    resources:
        mem_mb=3000,
    params:
        n_threads=config["train_lidar_detector"]["n_threads"],
        schedule=config["train_lidar_detector"]["schedule"] | {"seed": config["seed"]},
    script:
        "../scripts/train_lidar_detector.py"


rule detect_dynamic:
    """What could move, in the rectified images and the lidar frame of every keyframe; a picture of each."""
    input:
        code=library("detect_dynamic"),
        drive=drive_file("drive.mcap"),
        keyframes="results/choose_keyframes/{drive}/keyframes.csv",
        image_files=detector_files("image"),
        lidar_files=detector_files("lidar"),
    output:
        masks=directory("results/detect_dynamic/{drive}/masks"),
        lidar=directory("results/detect_dynamic/{drive}/lidar"),
        pictures=directory("results/detect_dynamic/{drive}/pictures"),
    log:
        "results/detect_dynamic/{drive}/masks.log",
    benchmark:
        "results/detect_dynamic/{drive}/masks.bench.tsv"
    conda:
        "../envs/streetscan.yaml"
    threads: config["n_threads"]
    resources:
        mem_mb=3000,
    params:
        **{key: config["detect_dynamic"][key] for key in ("margin_m", "foot_m")},
        image_detector=chosen_detector("image"),
        lidar_detector=chosen_detector("lidar"),
        n_threads=config["n_threads"],
    script:
        "../scripts/detect_dynamic.py"


rule evaluate_detections:
    """Mask IoU and instance recall of the image detector, point recall and precision of the lidar detector, on a drive with truth."""
    input:
        code=library("evaluate_detections"),
        drive=drive_file("drive.mcap"),
        truth=drive_file("truth"),
        image_files=detector_files("image"),
        lidar_files=detector_files("lidar"),
    output:
        scores="results/evaluate_detections/{drive}/scores.csv",
    log:
        "results/evaluate_detections/{drive}/scores.log",
    benchmark:
        "results/evaluate_detections/{drive}/scores.bench.tsv"
    conda:
        "../envs/streetscan.yaml"
    threads: config["n_threads"]
    resources:
        mem_mb=3000,
    params:
        **config["evaluate_detections"],
        **{key: config["detect_dynamic"][key] for key in ("margin_m", "foot_m")},
        image_detector=chosen_detector("image"),
        lidar_detector=chosen_detector("lidar"),
        n_threads=config["n_threads"],
    script:
        "../scripts/evaluate_detections.py"
