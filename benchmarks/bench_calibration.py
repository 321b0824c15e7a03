"""How long one keyframe takes from images to a calibration, at 1288 x 964 pixels on a training street, and what it needs of memory.

The workflow itself is run on a drive of one keyframe; its steps' own records of time and memory are read.
"""

import subprocess
import sys
import tempfile
from pathlib import Path

import pandas as pd
import yaml

ROOT = Path(__file__).resolve().parents[1]
DRIVE = "one_keyframe"
N_THREADS = 2
CAMERA = {"xyz_m": [1.25, 0.08, 1.58], "rpy_deg": [0.6, 1.5, -0.8], "n_keyframes": 1}
# What is done for a keyframe alone, and what its drive needs first.
KEYFRAME_STEPS = {
    "choose_keyframes": f"choose_keyframes/{DRIVE}/keyframes",
    "detect_dynamic": f"detect_dynamic/{DRIVE}/masks",
    "reconstruct_keyframe": f"reconstruct_keyframe/{DRIVE}/00/summary",
    "calibrate_keyframe": f"calibrate_keyframe/{DRIVE}/00/calibration",
}


def bench_calibration() -> list[dict]:
    """Rows of each step's seconds and memory, of their sum, and of the densification and its points.

    Raises:
        RuntimeError: the workflow failed, or the keyframe stopped early: then what was timed is not a calibration.
    """
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        _run(folder)
        steps = {step: _record(folder / "results" / f"{path}.bench.tsv") for step, path in KEYFRAME_STEPS.items()}
        made = pd.read_csv(folder / "results" / f"{KEYFRAME_STEPS['reconstruct_keyframe']}.csv").iloc[0]
        check_went_through(folder / "results" / f"{KEYFRAME_STEPS['calibrate_keyframe']}.yaml")
    rows = [_row(f"time of {step}", record["s"], "s") for step, record in steps.items()]
    return [
        *rows,
        _row("time of a keyframe, end to end", sum(record["s"] for record in steps.values()), "s", "paper 180, with a GPU"),
        _row("peak memory of a keyframe", max(record["max_rss"] for record in steps.values()), "MiB"),
        _row("time of densification", made["densification_s"], "s"),
        _row("dense points", made["n_dense"], "points", "paper 257796"),
    ]


def _run(folder: Path) -> None:
    """Run the workflow in a folder up to the calibration of the one keyframe. RuntimeError with its last lines when it fails."""
    facts = yaml.safe_load((ROOT / "config" / "drives" / "city_train_main_road.yaml").read_text())
    facts["simulation"] |= {"n_frames": 16, "camera": CAMERA}
    (folder / "drives").mkdir()
    (folder / "drives" / f"{DRIVE}.yaml").write_text(yaml.safe_dump(facts, sort_keys=False))
    chosen = {"run": "own", "drives_folder": str(folder / "drives"), "calibrated_drives": [DRIVE], "n_threads": N_THREADS}
    (folder / "run.yaml").write_text(yaml.safe_dump(chosen))
    command = [sys.executable, "-m", "snakemake", "-s", str(ROOT / "Snakefile"), "--configfile", str(folder / "run.yaml")]
    target = f"results/{KEYFRAME_STEPS['calibrate_keyframe']}.yaml"
    options = ["--directory", str(folder), "--cores", str(N_THREADS), "--workflow-profile", "none"]
    done = subprocess.run([*command, *options, "--", target], capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError("\n".join((done.stdout + done.stderr).splitlines()[-30:]))


# Statuses of a keyframe that went through every stage and was judged at the end.
_WENT_THROUGH = {"ok", "far_apart", "uncertain", "scale_open", "no_edges", "edges_disagree", "not_better"}


def check_went_through(path: Path) -> None:
    """RuntimeError with status and reason when a keyframe stopped before its last stage, be it in the reconstruction."""
    found = yaml.safe_load(path.read_text())
    if found["status"] not in _WENT_THROUGH:
        raise RuntimeError(f"{path}: the keyframe was refused, {found['status']}: {found['reason']}. It stopped early: no time.")


def _record(path: Path) -> pd.Series:
    """Seconds `s` and highest memory `max_rss` in MiB of a step, as Snakemake measured them."""
    return pd.read_csv(path, sep="\t").iloc[0]


def _row(metric: str, value: float, unit: str, peer: str = "") -> dict:
    return {"benchmark": "calibrate_keyframe", "metric": metric, "value": float(value), "unit": unit, "peer": peer, "n": 1}
