"""From a labelled scan to the report, and what must not change when the test part's truth does."""

import re
import shutil

import numpy as np
import pandas as pd
import pytest
from dag import snakemake

from streetscan.io.las import read_las, write_las

METHODS = ("label_map", "clean_map", "extract_objects", "train_segmenter")


def run(scan, directory, *targets):
    directory.mkdir(exist_ok=True)
    arguments = ["--configfile", str(scan.config), "--cores", "2"]
    return snakemake(*arguments, *(["--", *targets] if targets else []), directory=directory)


@pytest.fixture
def finished(labelled_scan, tmp_path):
    """The scan and the directory of its finished run, with the clean map and the objects."""
    directory = tmp_path / "run"
    extra = ["results/clean_map/tiny/test/c2cnn/static.laz", "results/extract_objects/tiny/test/c2cnn/objects.gpkg"]
    run(labelled_scan, directory, "all", *extra)
    return labelled_scan, directory, extra


def method_files(directory):
    """Name to content of every file a method wrote, but logs and benchmarks."""
    paths = [p for step in METHODS for p in (directory / "results" / step).rglob("*") if p.is_file()]
    return {str(p.relative_to(directory)): p for p in paths if p.suffix in (".laz", ".npz", ".safetensors", ".csv", ".yaml", ".gpkg")}


def same(a, b) -> bool:
    """Whether two files hold the same; clock times of trainings aside."""
    if a.name == "history.csv":
        tables = [pd.read_csv(p).drop(columns="time_s") for p in (a, b)]
        return tables[0].equals(tables[1])
    return a.read_bytes() == b.read_bytes()


def test_truth_of_the_test_part_and_a_second_run_change_no_output(finished, tmp_path):
    scan, directory, extra = finished
    report = (directory / "results/tabulate_benchmarks/own/report.html").read_text()
    assert "tiny" in report
    assert not re.search(r"(src|href)=.https?:", report)

    labelled = read_las(directory / "results/label_map/tiny/test/c2cnn/map_0of2.laz")
    assert {"label", "confidence", "intensity"} <= set(labelled.fields)
    static = read_las(directory / extra[0])
    n_tiles = sum(len(read_las(p)) for p in (directory / "results/label_map/tiny/test/c2cnn").glob("*.laz"))
    assert 0 < len(static) < n_tiles == len(read_las(directory / "results/import_map/tiny/test/map.laz"))

    # The same seed, other truth of the test part: everything is made anew, and equal.
    path = scan.folder / "tiny_test.laz"
    cloud = read_las(path)
    cloud.fields["class_id"] = np.random.default_rng(5).permutation(cloud.fields["class_id"])
    write_las(path, cloud)
    second = tmp_path / "second"
    run(scan, second, "all", *extra)
    first_files, second_files = method_files(directory), method_files(second)
    assert set(first_files) == set(second_files)
    assert len(first_files) >= 9
    assert [name for name in first_files if not same(first_files[name], second_files[name])] == []
    scores = [pd.read_csv(d / "results/evaluate_labels/tiny/c2cnn/scores.csv") for d in (directory, second)]
    assert not scores[0].equals(scores[1])
    shutil.rmtree(second)


def test_own_scan_needs_neither_truth_nor_training(tiny_scan, tmp_path):
    directory = tmp_path / "own"
    run(tiny_scan, directory)
    assert not (directory / "results/train_segmenter").exists()
    assert (directory / "results/tabulate_benchmarks/own/report.html").is_file()


def test_bad_input_ends_with_one_sentence_and_leaves_nothing(tiny_scan, tmp_path):
    path = tiny_scan.folder / "tiny_all.laz"
    path.write_bytes(path.read_bytes()[:3000])
    directory = tmp_path / "bad"
    directory.mkdir()
    result = snakemake("--configfile", str(tiny_scan.config), "--cores", "1", directory=directory, check=False)
    assert result.returncode != 0
    output = result.stdout + result.stderr
    assert "error: " in output
    assert "tiny_all.laz" in output
    assert [p for p in (directory / "results").rglob("*") if p.is_file() and p.suffix not in (".log", ".tsv")] == []
    log = directory / "results/import_map/tiny/all/map.log"
    assert "Traceback" in log.read_text()
