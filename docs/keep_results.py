"""Keep what a run and `make bench` measured in docs/results/: scores, tables, report, command, commit, hardware."""

import argparse
import base64
import os
import platform
import re
import shutil
import subprocess
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
import yaml

from streetscan.benchmarks.scores import label_scores, read_evaluations
from streetscan.benchmarks.speed import renew_rows
from streetscan.io.tables import save_tables
from streetscan.simulation.layout import GENERATOR_VERSION

HOME = Path(__file__).resolve().parent.parent
KEPT = HOME / "docs" / "results"
MAX_BYTES = 5_000_000
# Pictures of a kept report are no wider than this, and coarser than those of the report itself.
WIDTH_PX, QUALITY = 640, 45


def describe_hardware() -> str:
    """Processor, cores and memory of this machine."""
    cpu = re.search(r"model name\s*:\s*(.*)", Path("/proc/cpuinfo").read_text())
    memory_kb = int(re.search(r"MemTotal:\s*(\d+)", Path("/proc/meminfo").read_text())[1])
    return f"{cpu[1] if cpu else platform.machine()}, {os.cpu_count()} cores, {memory_kb / 2**20:.0f} GiB, no GPU used"


def is_simulated(scores: Path, run: str) -> bool:
    """Whether every data set and drive of a run's table of scores is simulated: pictures of real recordings stay out of the repository."""
    config = HOME / "config" / f"{run}.yaml"
    variants = yaml.safe_load(config.read_text()).get("voxel_variants", {}) if config.is_file() else {}
    for found in pd.read_csv(scores)["dataset"].dropna().unique():
        name = variants.get(found, {}).get("dataset", found)
        files = [HOME / "config" / kind / f"{name}.yaml" for kind in ("datasets", "drives")]
        facts = [yaml.safe_load(path.read_text()) for path in files if path.is_file()]
        if not any("simulate" in (known.get("source"), known.get("reader")) for known in facts):
            return False
    return True


def shrink_report(html: str) -> str:
    """A report with its photographs and views as small WebP, so that the repository can hold it; drawings of lines stay."""

    def smaller(found: re.Match) -> str:
        pixels = cv2.imdecode(np.frombuffer(base64.b64decode(found[1]), np.uint8), cv2.IMREAD_COLOR)
        height, width = pixels.shape[:2]
        if width > WIDTH_PX:
            pixels = cv2.resize(pixels, (WIDTH_PX, round(height * WIDTH_PX / width)), interpolation=cv2.INTER_AREA)
        content = cv2.imencode(".webp", pixels, [cv2.IMWRITE_WEBP_QUALITY, QUALITY])[1].tobytes()
        return f"data:image/webp;base64,{base64.b64encode(content).decode()}" if len(content) < len(found[1]) * 3 / 4 else found[0]

    return re.sub(r"data:image/(?:png|jpeg|webp);base64,([A-Za-z0-9+/=]+)", smaller, html)


def hide_folders(html: str) -> str:
    """A report whose settings name no folder of this machine: absolute data_root, datasets_folder and drives_folder are left out."""
    return re.sub(r"^(data_root|datasets_folder|drives_folder): /[^\n<]*", r"\1: (a folder)", html, flags=re.MULTILINE)


def ship_weights(name: str, run: str, commit: str, target: Path) -> None:
    """Copy a trained network into weights/, with where it comes from and how good it is.

    Args:
        name: `<data set>/<model>`, a network of this checkout's results/.
        run: a run whose tables score it.
        commit: of this checkout.
        target: folder to fill.
    """
    dataset, model = name.split("/")
    target.mkdir(parents=True, exist_ok=True)
    for file in ("weights.safetensors", "settings.yaml"):
        shutil.copy(HOME / "results/calibrate_segmenter" / name / file, target / file)
    # The tables of a run may hold means over seeds; these are the network's own.
    tables = [HOME / "results/evaluate_labels" / name / f"{table}.csv" for table in ("scores", "confusion")]
    own = [r for r in label_scores(read_evaluations(*tables, dataset, model, 0)[0]) if r["column"].endswith(" f")]
    scores = pd.read_csv(HOME / "results/tabulate_benchmarks" / run / "scores.csv", dtype={"seed": str})
    method, _, seed = model.partition("_seed_")
    seeds = scores.loc[(scores["dataset"] == dataset) & (scores["method"] == method), "seed"].iloc[0].split(";")
    origin = {
        "network": name, "run": run, "commit": commit, "generator_version": GENERATOR_VERSION, "seed": seed or seeds[0],
        "f_even_percent": {r["row"]: round(float(r["ours"]), 1) for r in own},
    }  # fmt: skip
    (target / "origin.yaml").write_text(yaml.safe_dump(origin, sort_keys=False))


def keep_benchmarks(measured: Path, target: Path, commit: str) -> None:
    """Put a table of benchmarks into the kept one; what was not run again stays, and the kept text says which rows are of which commit."""
    table = pd.read_csv(measured, keep_default_na=False)
    renewed = renew_rows(target / "bench.csv", table)
    text = target / "bench.txt"
    before = text.read_text() if len(renewed) > len(table) else ""
    rows = f" (rows {', '.join(dict.fromkeys(table['benchmark']))})" if before else ""
    save_tables({target / "bench.csv": renewed})
    text.write_text(f"{before}command: python -m benchmarks{rows}\ncommit: {commit}\nhardware: {describe_hardware()}\n")


def main() -> None:
    """Copy the runs named on the command line (all finished ones by default), and bench.csv where there is one."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("runs", nargs="*")
    parser.add_argument("--command", help="what was typed, where it was not `make run CONFIG=config/<run>.yaml`")
    parser.add_argument("--ship", metavar="DATASET/MODEL", help="make this network of the first run named one that comes along")
    parser.add_argument("--ship-as", metavar="FOLDER", default="c2cnn", help="in weights/; c2cnn where not given")
    arguments = parser.parse_args()
    finished = sorted(p.parent.name for p in (HOME / "results/tabulate_benchmarks").glob("*/report.html"))
    commit = subprocess.run(["git", "rev-parse", "HEAD"], cwd=HOME, check=True, capture_output=True, text=True).stdout.strip()
    for run in arguments.runs or finished:
        source, target = HOME / "results/tabulate_benchmarks" / run, KEPT / run
        shutil.rmtree(target, ignore_errors=True)
        target.mkdir(parents=True)
        shutil.copy(source / "scores.csv", target)
        shutil.copytree(source / "tables", target / "tables", ignore=shutil.ignore_patterns(".*"))
        report = shrink_report(hide_folders((source / "report.html").read_text()))
        if is_simulated(source / "scores.csv", run) and len(report.encode()) < MAX_BYTES:
            (target / "report.html").write_text(report)
        lines = [
            f"command: {arguments.command or f'make run CONFIG=config/{run}.yaml'}",
            f"commit: {commit}",
            f"hardware: {describe_hardware()}",
        ]
        (target / "run.txt").write_text("\n".join(lines) + "\n")
        print(f"kept run {run}")
    if arguments.ship:
        ship_weights(arguments.ship, (arguments.runs or finished)[0], commit, HOME / "weights" / arguments.ship_as)
    if (HOME / "results/bench.csv").is_file():
        keep_benchmarks(HOME / "results/bench.csv", KEPT, commit)


if __name__ == "__main__":
    main()
