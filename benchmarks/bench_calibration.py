"""How long one keyframe takes from its images to a calibration, stage by stage, and how much memory; a place of the validation street."""

import json
import subprocess
import sys
import tempfile
from pathlib import Path

import pandas as pd
import yaml

from benchmarks.bench_drives import ROOT

# The drive is cut to what one keyframe needs.
DRIVE, N_FRAMES = "city_validation_keyframes", 14
STEPS = ("choose_keyframes", "detect_dynamic", "reconstruct_keyframe", "calibrate_keyframe")
N_THREADS = 2
# The thesis' whole pipeline, on a GTX 1080 Ti.
PEER = "thesis: below 180 s with a GPU"


def bench_calibration() -> list[dict]:
    """Rows of the seconds of each step, of densification alone and of all, of its points, and of the peak memory."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        facts = yaml.safe_load((ROOT / "config" / "drives" / f"{DRIVE}.yaml").read_text())
        facts["simulation"] |= {"n_frames": N_FRAMES}
        facts["simulation"]["camera"] |= {"n_keyframes": 1}
        (folder / "drives").mkdir()
        (folder / "drives" / "one.yaml").write_text(yaml.safe_dump(facts))
        config = {"drives_folder": str(folder / "drives"), "calibrated_drives": ["one"], "n_threads": N_THREADS, "run": "bench"}
        (folder / "config.yaml").write_text(json.dumps(config))
        target = "results/calibrate_keyframe/one/00/calibration.yaml"
        command = [sys.executable, "-m", "snakemake", "--snakefile", str(ROOT / "Snakefile"), "--directory", str(folder), "--cores", "2"]
        subprocess.run([*command, "--configfile", str(folder / "config.yaml"), "--", target], check=True, capture_output=True)
        costs = {}
        for step in STEPS:
            (path,) = (folder / "results" / step / "one").rglob("*.bench.tsv")
            costs[step] = pd.read_csv(path, sep="\t").iloc[0]
        made = pd.read_csv(folder / "results" / "reconstruct_keyframe" / "one" / "00" / "summary.csv").iloc[0]
    rows = [_row(f"time of {step}", cost["s"], "s") for step, cost in costs.items()]
    rows += [_row("time of a keyframe", sum(cost["s"] for cost in costs.values()), "s", PEER)]
    rows += [_row("time of densification", made["densification_s"], "s"), _row("points of the dense cloud", made["n_dense"], "")]
    return [*rows, _row("peak memory", max(cost["max_rss"] for cost in costs.values()), "MB")]


def _row(metric: str, value: float, unit: str, peer: str = "") -> dict:
    return {"benchmark": "calibration", "metric": metric, "value": float(value), "unit": unit, "peer": peer, "n": 1}
