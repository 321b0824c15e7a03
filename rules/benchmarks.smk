"""Scores against truth, tables beside the papers' figures, the report."""


rule evaluate_labels:
    """Precision, recall and F of a label map per class, on a class-even test set and on all voxels; confusion matrix."""
    input:
        code=library("evaluate_labels"),
        truth="results/label_voxels/{dataset}/test/labels.npy",
        predictions=label_tiles("voxels_{}.npz", "test"),
    output:
        scores="results/evaluate_labels/{dataset}/{model}/scores.csv",
        confusion="results/evaluate_labels/{dataset}/{model}/confusion.csv",
    log:
        "results/evaluate_labels/{dataset}/{model}/scores.log",
    conda:
        "../envs/streetscan.yaml"
    resources:
        mem_mb=3000,
    params:
        **config["evaluate_labels"],
        groups=lambda w: facts(w.dataset).get("groups"),
        seed=config["seed"],
    script:
        "../scripts/evaluate_labels.py"


rule evaluate_thinning:
    """F of networks on a map of ever fewer points: another scanner, or the same one on a faster vehicle."""
    input:
        code=library("evaluate_thinning"),
        voxels="results/voxelize_map/{dataset}/{split}/voxels.npz",
        labels="results/label_voxels/{dataset}/{split}/labels.npy",
        networks=lambda w: [file for model in thinned_on(w.dataset) for file in files_of_model(w.dataset, model)],
    output:
        scores="results/evaluate_thinning/{dataset}/{split}/scores.csv",
    log:
        "results/evaluate_thinning/{dataset}/{split}/scores.log",
    conda:
        "../envs/streetscan.yaml"
    threads: config["n_threads"]
    resources:
        mem_mb=3000,
    params:
        **config["evaluate_thinning"],
        models=lambda w: thinned_on(w.dataset),
        seed=config["seed"],
        n_threads=config["n_threads"],
    script:
        "../scripts/evaluate_thinning.py"


rule evaluate_refinements:
    """What four quarter turns and smoothed labels gain on the validation part, and the time they cost."""
    input:
        code=library("evaluate_refinements"),
        voxels="results/voxelize_map/{dataset}/validation/voxels.npz",
        labels="results/label_voxels/{dataset}/validation/labels.npy",
        network=network_of,
    output:
        scores="results/evaluate_refinements/{dataset}/{model}/scores.csv",
    log:
        "results/evaluate_refinements/{dataset}/{model}/scores.log",
    conda:
        "../envs/streetscan.yaml"
    threads: config["n_threads"]
    resources:
        mem_mb=3000,
    params:
        smoothing=config["label_map"]["smoothing"],
        tile_m=config["label_map"]["tile_m"],
        n_per_class=config["evaluate_labels"]["n_per_class"],
        seed=config["seed"],
        n_threads=config["n_threads"],
    script:
        "../scripts/evaluate_refinements.py"


rule evaluate_views:
    """Pictures of a labelled map from above and from eye level: predicted and, with truth, true and wrong labels."""
    input:
        code=library("evaluate_views"),
        map=map_of,
        voxels="results/voxelize_map/{dataset}/{split}/voxels.npz",
        predictions=label_tiles("voxels_{}.npz"),
        truth=lambda w: f"results/label_voxels/{w.dataset}/{w.split}/labels.npy" if (w.dataset, w.model) in EVALUATED else [],
    output:
        folder=directory("results/evaluate_views/{dataset}/{split}/{model}/views"),
    log:
        "results/evaluate_views/{dataset}/{split}/{model}/views.log",
    conda:
        "../envs/streetscan.yaml"
    resources:
        mem_mb=3000,
    params:
        **config["evaluate_views"],
        k=lambda w: structure_of(w).get("k", config["train_segmenter"]["network"]["k"]),
    script:
        "../scripts/evaluate_views.py"


rule evaluate_realism:
    """Statistics of a map, simulated or real: density, residuals, edges, intensities, shares, and of a simulated one the return rate."""
    input:
        code=library("evaluate_realism"),
        map=map_of,
        truth=lambda w: truth_of(w) if facts(w.dataset)["truth"] == "labels" else [],
    output:
        table="results/evaluate_realism/{dataset}/{split}/realism.csv",
    log:
        "results/evaluate_realism/{dataset}/{split}/realism.log",
    benchmark:
        "results/evaluate_realism/{dataset}/{split}/realism.bench.tsv"
    conda:
        "../envs/streetscan.yaml"
    resources:
        mem_mb=3000,
    params:
        **{key: config["evaluate_realism"][key] for key in ("tile_m", "tile_share", "max_range_m", "n_pulses")},
        simulation=lambda w: facts(w.dataset).get("simulation"),
        split=lambda w: w.split,
        length_m=lambda w: facts(w.dataset)["parts"][w.split].get("length_m"),
        seed=config["seed"],
    script:
        "../scripts/evaluate_realism.py"


rule evaluate_drive_realism:
    """The same statistics of a drive's frames merged at their true poses."""
    input:
        code=library("evaluate_drive_realism"),
        drive=drive_file("drive.mcap"),
        truth=drive_file("truth"),
    output:
        table="results/evaluate_drive_realism/{drive}/realism.csv",
    log:
        "results/evaluate_drive_realism/{drive}/realism.log",
    conda:
        "../envs/streetscan.yaml"
    resources:
        mem_mb=3000,
    params:
        **{key: config["evaluate_realism"][key] for key in ("tile_m", "tile_share", "max_range_m")},
    script:
        "../scripts/evaluate_drive_realism.py"


rule evaluate_density:
    """Point density against the distance from a tripod, of a static and of a mobile scan of the same street: Fig. 2.3."""
    input:
        code=library("evaluate_density"),
        static=lambda w: map_and_truth(w.dataset),
        mobile=lambda w: map_and_truth(facts(w.dataset)["same_streets_as"]),
    output:
        table="results/evaluate_density/{dataset}/density.csv",
    log:
        "results/evaluate_density/{dataset}/density.log",
    conda:
        "../envs/streetscan.yaml"
    resources:
        mem_mb=3000,
    params:
        max_range_m=config["evaluate_density"]["max_range_m"],
        simulation=lambda w: facts(w.dataset)["simulation"],
        split="test",
        length_m=lambda w: facts(w.dataset)["parts"]["test"]["length_m"],
        seed=config["seed"],
    script:
        "../scripts/evaluate_density.py"


rule evaluate_sensor:
    """The frames of a simulated drive beside those of a real sensor: returns per beam, distances, rings on the road."""
    input:
        code=library("evaluate_sensor"),
        drive=drive_file("drive.mcap"),
        reference=drive_file("drive.mcap", config["evaluate_sensor"]["reference"]),
    output:
        scores="results/evaluate_sensor/{drive}/scores.csv",
        picture="results/evaluate_sensor/{drive}/comparison.png",
    log:
        "results/evaluate_sensor/{drive}/scores.log",
    conda:
        "../envs/streetscan.yaml"
    resources:
        mem_mb=1000,
    params:
        **{key: config["evaluate_sensor"][key] for key in ("min_range_m", "max_range_m")},
        names=lambda w: [w.drive, config["evaluate_sensor"]["reference"]],
        sensor_heights_m=lambda w: [lidar_height(d) for d in (w.drive, config["evaluate_sensor"]["reference"])],
    script:
        "../scripts/evaluate_sensor.py"


rule evaluate_frames:
    """Precision and recall of the grid's classes against the true labels of a drive's points."""
    input:
        code=library("evaluate_frames"),
        truth=drive_file("truth"),
        classes="results/segment_frames/{drive}/classes.npz",
    output:
        scores="results/evaluate_frames/{drive}/scores.csv",
    log:
        "results/evaluate_frames/{drive}/scores.log",
    conda:
        "../envs/streetscan.yaml"
    resources:
        mem_mb=1000,
    script:
        "../scripts/evaluate_frames.py"


rule evaluate_registration:
    """Failed pairs, absolute and relative errors, drift and time of a drive's poses; its path beside the true one."""
    input:
        code=library("evaluate_registration"),
        truth=drive_file("truth"),
        poses="results/register_frames/{drive}/{registrar}/poses.csv",
        timings=timings_of,
    output:
        scores="results/evaluate_registration/{drive}/{registrar}/scores.csv",
        trajectory="results/evaluate_registration/{drive}/{registrar}/trajectory.csv",
    log:
        "results/evaluate_registration/{drive}/{registrar}/scores.log",
    conda:
        "../envs/streetscan.yaml"
    resources:
        mem_mb=1000,
    params:
        **config["evaluate_registration"],
        reference=reference_facts,
    script:
        "../scripts/evaluate_registration.py"


rule evaluate_localization:
    """Errors, verdicts, the thesis' keypoint distance and the floor of a drive's poses on a map."""
    input:
        code=library("evaluate_localization"),
        drive=drive_file("drive.mcap"),
        truth=poses_on_map,
        poses="results/localize_frames/{dataset}/{drive}/{labels}/{localizer}/poses.csv",
        landmarks=reference_file("landmarks.npz"),
        reference=reference_file("reference.npz"),
        voxels=mapped_truth("voxelize_map/{dataset}/{split}/voxels.npz"),
        labels=mapped_truth("label_voxels/{dataset}/{split}/labels.npy"),
    output:
        errors="results/evaluate_localization/{dataset}/{drive}/{labels}/{localizer}/errors.csv",
        scores="results/evaluate_localization/{dataset}/{drive}/{labels}/{localizer}/scores.csv",
    log:
        "results/evaluate_localization/{dataset}/{drive}/{labels}/{localizer}/scores.log",
    conda:
        "../envs/streetscan.yaml"
    resources:
        mem_mb=3000,
    params:
        **config["evaluate_localization"],
        settings=localizer_settings,
    script:
        "../scripts/evaluate_localization.py"


rule evaluate_reconstruction:
    """Reconstructed keyframes of a drive against its truth: scale, turns, ranges of the dense cloud."""
    input:
        code=library("evaluate_reconstruction"),
        facts=f"{DRIVES}/{{drive}}.yaml",
        schema=f"{HOME}/config/drive.schema.yaml",
        truth=drive_file("truth"),
        summaries=lambda w: for_keyframes("results/reconstruct_keyframe/{drive}/{keyframe}/summary.csv", [w.drive]),
        models=lambda w: for_keyframes("results/reconstruct_keyframe/{drive}/{keyframe}/model", [w.drive]),
    output:
        keyframes="results/evaluate_reconstruction/{drive}/keyframes.csv",
        scores="results/evaluate_reconstruction/{drive}/scores.csv",
    log:
        "results/evaluate_reconstruction/{drive}/scores.log",
    conda:
        "../envs/streetscan.yaml"
    resources:
        mem_mb=4000,
    params:
        **config["evaluate_reconstruction"],
        drive=lambda w: w.drive,
        street=lambda w: street_of(w) if step_of_drive(w.drive) == "simulate_drive" else None,
        data_root=config["data_root"],
        seed=config["seed"],
        n_threads=config["n_threads"],
    script:
        "../scripts/evaluate_reconstruction.py"


rule evaluate_calibration:
    """Pixel errors of a drive's calibrated keyframes stage by stage, and errors of their transforms, against its truth."""
    input:
        code=library("evaluate_calibration"),
        drive=drive_file("drive.mcap"),
        truth=drive_file("truth"),
        keyframes="results/choose_keyframes/{drive}/keyframes.csv",
        calibrations=lambda w: for_keyframes("results/calibrate_keyframe/{drive}/{keyframe}/calibration.yaml", [w.drive]),
        drive_calibration="results/calibrate_drive/{drive}/calibration.yaml",
        history="results/calibrate_drive/{drive}/history.csv",
    output:
        errors="results/evaluate_calibration/{drive}/errors.csv",
        transforms="results/evaluate_calibration/{drive}/transforms.csv",
        scores="results/evaluate_calibration/{drive}/scores.csv",
    log:
        "results/evaluate_calibration/{drive}/scores.log",
    conda:
        "../envs/streetscan.yaml"
    resources:
        mem_mb=1000,
    script:
        "../scripts/evaluate_calibration.py"


rule evaluate_recalibration:
    """A simulated drive's keyframes calibrated again and again with other lidar frames and starts, and with other bins of the vote."""
    input:
        code=library("evaluate_recalibration"),
        drive=drive_file("drive.mcap"),
        truth=drive_file("truth"),
        keyframes="results/choose_keyframes/{drive}/keyframes.csv",
        poses=keyframe_poses,
        models=lambda w: for_keyframes("results/reconstruct_keyframe/{drive}/{keyframe}/model", [w.drive]),
        lidar_files=detector_files("lidar"),
    output:
        trials="results/evaluate_recalibration/{drive}/trials.csv",
        sizes="results/evaluate_recalibration/{drive}/bins.csv",
        scores="results/evaluate_recalibration/{drive}/scores.csv",
        figure="results/evaluate_recalibration/{drive}/trials.png",
    log:
        "results/evaluate_recalibration/{drive}/scores.log",
    benchmark:
        "results/evaluate_recalibration/{drive}/scores.bench.tsv"
    conda:
        "../envs/streetscan.yaml"
    threads: config["n_threads"]
    resources:
        mem_mb=3000,
    params:
        **{key: value for key, value in config["evaluate_recalibration"].items() if key != "drives"},
        **{key: config["detect_dynamic"][key] for key in ("margin_m", "foot_m")},
        settings=config["calibrate_keyframe"]["settings"],
        lidar_detector=chosen_detector("lidar"),
        seed=config["seed"],
        n_threads=config["n_threads"],
    script:
        "../scripts/evaluate_recalibration.py"


rule tabulate_benchmarks:
    """The papers' tables with ours beside theirs, as CSV, Markdown and LaTeX, and one report of the run."""
    input:
        code=library("tabulate_benchmarks"),
        evaluations=for_pairs("results/evaluate_labels/{dataset}/{model}/scores.csv", EVALUATED),
        confusions=for_pairs("results/evaluate_labels/{dataset}/{model}/confusion.csv", EVALUATED),
        histories=[f"{training_of(d, m)}/history.csv" for d, m in TRAINED],
        network_scores=for_pairs("results/calibrate_segmenter/{dataset}/{model}/scores.csv", NETWORKS),
        network_reliabilities=for_pairs("results/calibrate_segmenter/{dataset}/{model}/reliability.csv", NETWORKS),
        refinements=for_pairs("results/evaluate_refinements/{dataset}/{model}/scores.csv", [p for p in NETWORKS if p in REFINED]),
        thinnings=[f"results/evaluate_thinning/{name}/scores.csv" for name in THINNED_PARTS],
        views=for_pairs("results/evaluate_views/{dataset}/{split}/{model}/views", SHOWN),
        realism=list(realism_tables().values()),
        densities=expand("results/evaluate_density/{dataset}/density.csv", dataset=STATIC_SCANS),
        registrations=for_drives("results/evaluate_registration/{drive}/{registrar}/scores.csv", REGISTERED),
        trajectories=for_drives("results/evaluate_registration/{drive}/{registrar}/trajectory.csv", REGISTERED),
        grids=for_drives("results/evaluate_frames/{drive}/scores.csv", LABELLED_DRIVES),
        streets=for_drives("results/merge_frames/{drive}/{registrar}/street.png", MERGED),
        frames=for_drives("results/show_frames/{drive}/pictures", REGISTERED + MERGED),
        localizations=for_localizations(
            "results/evaluate_localization/{dataset}/{drive}/{labels}/{localizer}/errors.csv", SCORED_LOCALIZATIONS
        ),
        localization_pictures=for_localizations(
            "results/localize_frames/{dataset}/{drive}/{labels}/{localizer}/pictures", SCORED_LOCALIZATIONS
        ),
        reconstructions=expand("results/evaluate_reconstruction/{drive}/scores.csv", drive=SCORED_CALIBRATIONS),
        detections=expand("results/evaluate_detections/{drive}/scores.csv", drive=SCORED_DETECTIONS),
        models=for_keyframes("results/reconstruct_keyframe/{drive}/{keyframe}/model", CALIBRATED),
        model_summaries=for_keyframes("results/reconstruct_keyframe/{drive}/{keyframe}/summary.csv", CALIBRATED),
        calibrations=expand("results/evaluate_calibration/{drive}/scores.csv", drive=SCORED_CALIBRATIONS),
        calibration_errors=expand("results/evaluate_calibration/{drive}/errors.csv", drive=SCORED_CALIBRATIONS),
        calibration_transforms=expand("results/evaluate_calibration/{drive}/transforms.csv", drive=SCORED_CALIBRATIONS),
        recalibrations=expand("results/evaluate_recalibration/{drive}/scores.csv", drive=RECALIBRATED),
        recalibration_figures=expand("results/evaluate_recalibration/{drive}/trials.png", drive=RECALIBRATED),
        recalibration_trials=expand("results/evaluate_recalibration/{drive}/trials.csv", drive=RECALIBRATED),
        calibrated=for_keyframes("results/calibrate_keyframe/{drive}/{keyframe}/pictures", CALIBRATED),
        verdicts=for_keyframes("results/calibrate_keyframe/{drive}/{keyframe}/summary.csv", CALIBRATED),
        detected=expand("results/detect_dynamic/{drive}/pictures", drive=CALIBRATED),
    output:
        scores="results/tabulate_benchmarks/{run}/scores.csv",
        report="results/tabulate_benchmarks/{run}/report.html",
        tables=directory("results/tabulate_benchmarks/{run}/tables"),
        figures=directory("results/tabulate_benchmarks/{run}/figures"),
    log:
        "results/tabulate_benchmarks/{run}/report.log",
    conda:
        "../envs/streetscan.yaml"
    resources:
        mem_mb=2000,
    params:
        evaluated=with_seeds(EVALUATED),
        trained=methods_of(TRAINED),
        known=[network_facts(*pair) for pair in NETWORKS],
        thinned={"parts": THINNED_PARTS, "names": {m: (base_of(m), seed_of(m)) for _, m in THINNED}},
        viewed=methods_of(SHOWN),
        registered=REGISTERED,
        merged=MERGED,
        localized=SCORED_LOCALIZATIONS,
        facts={map_name(d): facts(d)["published"] for d, _ in LABELLED if "published" in facts(d)},
        realism={
            "simulated": [d for d, _ in SIMULATED],
            "compared": list(realism_tables()),
            "not_compared": NOT_COMPARED,
            "static_scans": {d: facts(d)["same_streets_as"] for d in STATIC_SCANS},
        },
        config=config,
    script:
        "../scripts/tabulate_benchmarks.py"
