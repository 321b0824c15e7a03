"""streetscan: from street recordings to a labelled map and the papers' tables. `snakemake --list-rules` names the steps."""

from snakemake.utils import min_version

min_version("9.27")


configfile: workflow.source_path("config/default.yaml")


include: "rules/common.smk"
include: "rules/data.smk"
include: "rules/segmentation.smk"
include: "rules/registration.smk"
include: "rules/localization.smk"
include: "rules/calibration.smk"
include: "rules/detection.smk"
include: "rules/benchmarks.smk"


rule all:
    """Tables and report of the run, the products of every labelled map (of the first of a method's seeds), poses and streets of registered drives, poses on maps, clouds of keyframes, calibrations, and a page for every drive."""
    default_target: True
    input:
        [f"results/tabulate_benchmarks/{config['run']}/report.html"]
        if LABELLED or TUNED or REFINED or THINNED or REGISTERED or SCORED_LOCALIZATIONS or SCORED_CALIBRATIONS
        else [],
        for_pairs("results/clean_map/{dataset}/{split}/{model}/static.laz", SHOWN),
        for_pairs("results/extract_objects/{dataset}/{split}/{model}/objects.gpkg", SHOWN),
        for_drives("results/register_frames/{drive}/{registrar}/poses.tum", REGISTERED),
        for_drives("results/merge_frames/{drive}/{registrar}/tiles", MERGED),
        for_keyframes("results/reconstruct_keyframe/{drive}/{keyframe}/summary.csv", CALIBRATED),
        expand("results/calibrate_drive/{drive}/calibration.yaml", drive=CALIBRATED),
        for_localizations("results/localize_frames/{dataset}/{drive}/{labels}/{localizer}/poses.csv", LOCALIZED),
        expand("results/inspect_drive/{drive}/sheet.html", drive=config["drives"]),
        expand("results/evaluate_sensor/{drive}/scores.csv", drive=config["evaluate_sensor"]["drives"]),
