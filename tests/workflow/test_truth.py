"""Truth stays apart: no method reads what it is scored against."""

import pytest
import yaml
from dag import HOME, Job, dry_run, snakemake

CONFIGS = sorted((HOME / "config").glob("*.yaml"))
CONFIGS = [c for c in CONFIGS if "schema" not in c.name]
# Rules that may read `truth/`, and the parts they may read it of.
READERS = {"label_voxels": {"train", "validation"}}
# Rules that may read `truth/` of drives of the part train.
TRAINERS = ("train_image_detector", "train_lidar_detector")


def is_truth(path: str) -> bool:
    return "truth" in path.split("/")


def is_allowed(job: Job) -> bool:
    """Whether a job that reads truth may do so on the way to a method's output."""
    if job.rule in TRAINERS:
        drives = [path.split("/")[2] for path in job.inputs if is_truth(path)]
        return all(yaml.safe_load((HOME / "config" / "drives" / f"{d}.yaml").read_text())["simulation"]["split"] == "train" for d in drives)
    return job.wildcards.get("split") in READERS.get(job.rule, ())


def truth_above(targets: list[str], makers: dict[str, Job]) -> list[str]:
    """The forbidden truth files some target depends on, found by walking the DAG upwards."""
    found, seen, open_paths = [], set(), list(targets)
    while open_paths:
        path = open_paths.pop()
        if path in seen:
            continue
        seen.add(path)
        job = makers.get(path)
        if job is None:
            continue
        for source in job.inputs:
            if is_truth(source) and not is_allowed(job):
                found.append(f"{job.rule} reads {source}")
            elif not is_truth(source):
                open_paths.append(source)
    return found


def makers_of(jobs: list[Job]) -> dict[str, Job]:
    return {output: job for job in jobs for output in job.outputs}


def method_outputs(jobs: list[Job]) -> list[str]:
    """Everything but scores, tables, pages and exports of a drive, and the truth files themselves."""
    scoring = ("evaluate_", "tabulate_", "all", "inspect_drive", "export_drive")
    return [
        output
        for job in jobs
        if not job.rule.startswith(scoring)
        and job.rule != "label_voxels"
        and not any(v.startswith("oracle_") for v in job.wildcards.values())
        for output in job.outputs
        if not is_truth(output)
    ]


@pytest.mark.parametrize("config", CONFIGS, ids=lambda c: c.stem)
def test_no_method_reads_truth(config, tmp_path, shared_data):
    jobs = dry_run("--configfile", str(config), "--config", f"data_root={shared_data}", directory=tmp_path)
    outputs = method_outputs(jobs)
    assert any(step in path for path in outputs for step in ("label_map", "train_segmenter", "import_drive", "register_frames"))
    assert truth_above(outputs, makers_of(jobs)) == []


def test_walk_finds_a_method_that_reads_truth():
    jobs = [
        Job("simulate_city", [], ["map.laz", "a/truth/labels.npy"]),
        Job("label_map", ["map.laz", "a/truth/labels.npy"], ["labels.laz"]),
        Job("clean_map", ["labels.laz"], ["static.laz"]),
    ]
    assert truth_above(["static.laz"], makers_of(jobs)) == ["label_map reads a/truth/labels.npy"]


def test_walk_finds_test_labels_used_for_training():
    jobs = [
        Job("label_voxels", ["a/truth/labels.npy"], ["labels.npy"], {"split": "test"}),
        Job("extract_samples", ["labels.npy"], ["samples.npz"]),
    ]
    assert truth_above(["samples.npz"], makers_of(jobs)) == ["label_voxels reads a/truth/labels.npy"]
    jobs[0].wildcards["split"] = "train"
    assert truth_above(["samples.npz"], makers_of(jobs)) == []


def test_detectors_learn_from_training_drives_alone(tmp_path):
    targets = [f"results/{rule}/weights.safetensors" for rule in TRAINERS]
    jobs = dry_run("--", *targets, directory=tmp_path)
    assert any(is_truth(path) for job in jobs if job.rule in TRAINERS for path in job.inputs)
    assert truth_above(targets, makers_of(jobs)) == []
    sneaked = [Job(TRAINERS[0], ["results/simulate_drive/city_main_road/truth"], ["weights.safetensors"])]
    assert len(truth_above(["weights.safetensors"], makers_of(sneaked))) == 1


def test_a_test_drive_is_refused_for_training(tmp_path):
    chosen = "train_image_detector={drives: [city_main_road]}"
    result = snakemake("-n", "--config", chosen, "--", "results/train_image_detector/weights.safetensors", directory=tmp_path, check=False)
    assert "'city_main_road' is no simulated drive of a part 'train'" in result.stdout + result.stderr
