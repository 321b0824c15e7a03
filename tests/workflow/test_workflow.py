"""The workflow as a whole: lint, diagram, rules with logs and resources, re-runs after edits."""

import json
import re
import shlex
import shutil
import subprocess
import sys

import pytest
from dag import HOME, dry_run, snakemake


def rules_text() -> dict[str, str]:
    """The text of every rule by name."""
    text = "\n".join(path.read_text() for path in sorted((HOME / "rules").glob("*.smk")))
    parts = re.split(r"^rule (\w+):", text, flags=re.MULTILINE)[1:]
    return dict(zip(parts[::2], parts[1::2], strict=True))


def test_lint_is_clean(tmp_path):
    result = snakemake("--configfile", str(HOME / "config" / "test.yaml"), "--lint", directory=tmp_path, check=False)
    assert result.returncode == 0, result.stdout + result.stderr


@pytest.mark.parametrize("part", ['"""', "code=library(", "log:", "resources:", "output:", "conda:"])
def test_every_rule_has(part):
    assert [name for name, text in rules_text().items() if part not in text] == []


def test_diagram_in_readme_is_up_to_date():
    result = subprocess.run([sys.executable, "docs/update_diagram.py", "--check"], cwd=HOME, capture_output=True, text=True)
    assert result.returncode == 0, result.stderr


def test_plain_snakemake_runs_from_any_directory(tmp_path):
    assert snakemake("--dry-run", "--cores", "1", directory=tmp_path).returncode == 0


def test_the_page_on_own_drives_computes_what_it_says(tmp_path):
    """Each command of the page, for a ready-made drive: two jobs, and no simulated city on the way."""
    text = (HOME / "docs" / "your_own_drive.md").read_text().replace("\\\n", " ")
    commands = re.findall(r"^ *\.venv/bin/snakemake (.*)$", text, re.MULTILINE)
    rules = []
    for command in commands:
        words = shlex.split(command.replace("<name>", "hdl32_capture").replace("<folder>", str(tmp_path)))
        rules.append({job.rule for job in dry_run(*words, directory=tmp_path)})
    assert rules == [
        {"import_drive", "inspect_drive"},
        {"import_drive", "segment_frames", "register_frames", "merge_frames"},
        {"import_drive", "export_drive"},
    ]


def test_edit_of_the_deepest_import_runs_a_rule_again(tmp_path, tiny_scan):
    """errors.py is imported by clouds.py, that by las.py, that by the rule's module."""
    copy = tmp_path / "copy"
    for name in ("Snakefile", "rules", "scripts", "config", "envs", "streetscan", "weights"):
        source = HOME / name
        shutil.copytree(source, copy / name) if source.is_dir() else (copy.mkdir(exist_ok=True), shutil.copy(source, copy / name))
    target = f"results/voxelize_map/{tiny_scan.name}/all/voxels.npz"
    command = [sys.executable, "-m", "snakemake", "--cores", "1", "--configfile", str(tiny_scan.config), "--", target]
    subprocess.run(command, cwd=copy, check=True, capture_output=True)
    command.insert(3, "--dry-run")
    assert "Nothing to be done" in subprocess.run(command, cwd=copy, check=True, capture_output=True, text=True).stdout
    with open(copy / "streetscan" / "errors.py", "a") as stream:
        stream.write("# edited\n")
    assert "voxelize_map" in subprocess.run(command, cwd=copy, check=True, capture_output=True, text=True).stdout


def test_a_drive_becomes_a_map_in_one_workflow(tmp_path, shared_data):
    """From a recording to the labels of its street: the merged tiles are what import_map reads."""
    arguments = [f"data_root={shared_data}", 'labelled_maps=["kitti_0001_street/c2cnn_shipped"]']
    jobs = {job.rule: job for job in dry_run("--config", *arguments, directory=tmp_path)}
    assert {"import_drive", "segment_frames", "register_frames", "merge_frames", "import_map", "label_map"} <= set(jobs)
    tiles = "results/merge_frames/kitti_0001/ndt_street/tiles"
    assert tiles in jobs["merge_frames"].outputs
    assert tiles in jobs["import_map"].inputs


def test_city_drives_are_simulated_and_scored(tmp_path):
    jobs = dry_run("--config", "labelled_maps=[]", 'registered_drives=["city_tiny_main_road/ndt_tall"]', directory=tmp_path)
    rules = {job.rule for job in jobs}
    assert {"simulate_drive", "segment_frames", "evaluate_frames", "register_frames", "evaluate_registration", "show_frames"} <= rules
    assert not rules & {"import_drive", "merge_frames", "label_map"}


def test_compared_networks_are_trained_and_no_map_is_labelled(tmp_path):
    """Maps are simulated once, however many voxel sizes they are seen in."""
    jobs = dry_run("--configfile", str(HOME / "config" / "parameters.yaml"), directory=tmp_path)
    rules = [job.rule for job in jobs]
    assert rules.count("train_segmenter") == rules.count("calibrate_segmenter") == 17
    assert rules.count("voxelize_map") == 14
    assert rules.count("simulate_city") == 2
    assert not set(rules) & {"label_map", "clean_map", "evaluate_labels"}


def test_networks_label_fewer_points_of_the_validation_and_test_parts(tmp_path):
    jobs = dry_run("--configfile", str(HOME / "config" / "density.yaml"), directory=tmp_path)
    thinned = [job for job in jobs if job.rule == "evaluate_thinning"]
    assert sorted(job.wildcards["split"] for job in thinned) == ["test", "validation"]
    for model in ("c2cnn_raw", "c2cnn", "c2cnn_thinned", "c2cnn_local", "og_cnn"):
        assert all(f"results/calibrate_segmenter/city/{model}/weights.safetensors" in job.inputs for job in thinned)
    (tables,) = (job for job in jobs if job.rule == "tabulate_benchmarks")
    assert "results/evaluate_thinning/city/test/scores.csv" in tables.inputs
    assert not {job.rule for job in jobs} & {"label_map", "evaluate_labels", "evaluate_views"}


def test_turns_and_smoothing_are_compared_on_the_validation_part(tmp_path):
    """Of networks that share a training, and no map of the test part is made."""
    jobs = dry_run("--configfile", str(HOME / "config" / "refinement.yaml"), directory=tmp_path)
    rules = [job.rule for job in jobs]
    assert rules.count("train_segmenter") == 1
    assert sorted(job.wildcards["model"] for job in jobs if job.rule == "evaluate_refinements") == ["c2cnn", "c2cnn_natural"]
    assert not any("/test/" in path for job in jobs for path in job.outputs)


def test_a_seed_after_a_models_name_trains_it_again_on_the_same_streets(tmp_path):
    jobs = dry_run("--configfile", str(HOME / "config" / "seeds.yaml"), directory=tmp_path)
    models = ["c2cnn", "c2cnn_seed_2", "c2cnn_seed_3"]
    for rule in ("train_segmenter", "calibrate_segmenter", "label_map", "evaluate_labels"):
        assert sorted(job.wildcards["model"] for job in jobs if job.rule == rule) == models
    assert [job.rule for job in jobs].count("turn_map") == 1
    for rule in ("evaluate_views", "clean_map", "extract_objects"):
        assert [job.wildcards["model"] for job in jobs if job.rule == rule] == ["c2cnn"]
    (tables,) = (job for job in jobs if job.rule == "tabulate_benchmarks")
    assert {f"results/evaluate_labels/city/{m}/scores.csv" for m in models} <= set(tables.inputs)


def test_a_seed_goes_through_to_what_a_model_takes_and_starts_from(tmp_path, shared_data):
    chosen = ["oakland/c2cnn_city_seed_2", "oakland/c2cnn_from_city_seed_2", "oakland/lightgbm_seed_2"]
    jobs = dry_run("--config", f"data_root={shared_data}", f"labelled_maps={json.dumps(chosen)}", directory=tmp_path)
    trained = {job.wildcards["dataset"] + "/" + job.wildcards["model"]: job for job in jobs if job.rule.startswith("train_")}
    assert sorted(trained) == [
        "city/c2cnn_seed_2",
        "city/c2cnn_thinned_seed_2",
        "oakland/c2cnn_from_city_seed_2",
        "oakland/lightgbm_seed_2",
    ]
    initial = "results/train_segmenter/city/c2cnn_seed_2/weights.safetensors"
    assert initial in trained["oakland/c2cnn_from_city_seed_2"].inputs


def test_a_model_may_be_calibrated_for_the_shares_of_another_map(tmp_path, shared_data):
    """It shares the training of the network whose weights it takes."""
    config = str(HOME / "config" / "oakland.yaml")
    jobs = dry_run("--configfile", config, "--config", f"data_root={shared_data}", directory=tmp_path)
    made = {output: job for job in jobs for output in job.outputs}
    natural = made["results/calibrate_segmenter/oakland/c2cnn_natural/weights.safetensors"]
    assert "results/train_segmenter/oakland/c2cnn/weights.safetensors" in natural.inputs
    labelled = made["results/label_map/oakland/test/c2cnn_natural/map_0of2.laz"]
    assert "results/calibrate_segmenter/oakland/c2cnn_natural/weights.safetensors" in labelled.inputs
    assert "results/train_segmenter/oakland/c2cnn_natural/weights.safetensors" not in made
