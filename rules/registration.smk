"""Frames of a rotating lidar registered into one street (Józsa & Benedek 2013): grid classes, poses, the merged street."""


rule segment_frames:
    """Grid classes of every point of a drive: sparse, ground, short object, tall structure."""
    input:
        code=library("segment_frames"),
        drive=drive_file("drive.mcap"),
    output:
        classes="results/segment_frames/{drive}/classes.npz",
        summary="results/segment_frames/{drive}/classes.csv",
        timings="results/segment_frames/{drive}/timings.csv",
    log:
        "results/segment_frames/{drive}/classes.log",
    benchmark:
        "results/segment_frames/{drive}/classes.bench.tsv"
    conda:
        "../envs/streetscan.yaml"
    resources:
        mem_mb=1000,
    params:
        **config["segment_frames"],
    script:
        "../scripts/segment_frames.py"


rule show_frames:
    """Pictures or videos of a drive in the colours of the grid: classes, mean height, density, height range."""
    input:
        code=library("show_frames"),
        drive=drive_file("drive.mcap"),
        classes="results/segment_frames/{drive}/classes.npz",
    output:
        folder=directory("results/show_frames/{drive}/pictures"),
    log:
        "results/show_frames/{drive}/pictures.log",
    conda:
        "../envs/streetscan.yaml"
    resources:
        mem_mb=1500,
    params:
        **config["show_frames"],
        grid=config["segment_frames"]["grid"],
    script:
        "../scripts/show_frames.py"


rule register_frames:
    """Poses of a drive's frames, each registered to the one before it or to the street so far; no GPS, no IMU."""
    input:
        code=library("register_frames"),
        drive=drive_file("drive.mcap"),
        classes="results/segment_frames/{drive}/classes.npz",
    output:
        poses="results/register_frames/{drive}/{registrar}/poses.csv",
        tum="results/register_frames/{drive}/{registrar}/poses.tum",
        timings="results/register_frames/{drive}/{registrar}/timings.csv",
    log:
        "results/register_frames/{drive}/{registrar}/poses.log",
    benchmark:
        "results/register_frames/{drive}/{registrar}/poses.bench.tsv"
    conda:
        "../envs/streetscan.yaml"
    threads: config["n_threads"]
    resources:
        mem_mb=2000,
    params:
        group_frames=config["register_frames"]["group_frames"],
        frames=lambda w: config["registrars"][w.registrar]["frames"],
        settings=registration_settings,
    script:
        "../scripts/register_frames.py"


rule merge_frames:
    """Registered frames as one cloud in LAZ tiles, with class, frame, time and motion per point; elevation map and picture."""
    input:
        code=library("merge_frames"),
        drive=drive_file("drive.mcap"),
        classes="results/segment_frames/{drive}/classes.npz",
        poses="results/register_frames/{drive}/{registrar}/poses.csv",
    output:
        tiles=directory("results/merge_frames/{drive}/{registrar}/tiles"),
        elevation="results/merge_frames/{drive}/{registrar}/elevation.asc",
        picture="results/merge_frames/{drive}/{registrar}/street.png",
    log:
        "results/merge_frames/{drive}/{registrar}/street.log",
    benchmark:
        "results/merge_frames/{drive}/{registrar}/street.bench.tsv"
    conda:
        "../envs/streetscan.yaml"
    resources:
        mem_mb=3000,
    params:
        **config["merge_frames"],
        left_out=lambda w: config["registrars"][w.registrar].get("left_out"),
    script:
        "../scripts/merge_frames.py"
