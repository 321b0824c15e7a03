"""The tables of docs/results/README.md against the scores they are of."""

import re
from pathlib import Path

import pandas as pd
import pytest

RESULTS = Path(__file__).parents[2] / "docs/results"
CLASSES = ["phantom", "pedestrian", "car", "vegetation", "column", "tram_bus", "furniture", "overall", "overall_weighted"]
# Beginning of a line to the kept runs (of several the mean over their seeds) and the method it is of; a line that begins with `its labels`
# is of the network above, smoothed.
LABELS = {
    "`city_paper`, real rates: **C²CNN, wide": (["paper_wide"], "c2cnn_wide"),
    "`city_paper`, real rates: C²CNN, 24 epochs": (["paper", "paper_seed_3"], "c2cnn"),
    "`city`, a quarter of the rates: C²CNN": (["default"], "c2cnn"),
    "OG-CNN, ours": (["default"], "og_cnn"),
    "LightGBM on eigen-features, ours": (["default"], "lightgbm"),
}


def table_after(heading: str) -> list[list[str]]:
    """The rows of the table whose first line begins so, as texts."""
    lines = (RESULTS / "README.md").read_text(encoding="utf-8").splitlines()
    start = next(i for i, line in enumerate(lines) if line.startswith(f"| {heading}"))
    rows = []
    for line in lines[start + 2 :]:
        if not line.startswith("|"):
            break
        rows.append([text.strip() for text in line.strip("|").split("|")])
    return rows


def read_f(runs: list[str], method: str) -> dict[str, float]:
    own = pd.concat([pd.read_csv(RESULTS / run / "scores.csv", dtype={"seed": str}) for run in runs])
    own = own[(own["table"] == "nagy_2_3") & (own["column"] == f"{method} f")]
    n_seeds = own["seed"].fillna("1").str.split(";").str.len()
    total = (own["ours"].astype(float) * n_seeds).groupby(own["row"]).sum()
    return (total / n_seeds.groupby(own["row"]).sum()).to_dict()


def test_figures_of_labels_are_those_of_the_kept_runs():
    found, above = 0, None
    for first, *texts in table_after("F in %, class-even test voxels"):
        if first.startswith("its labels"):
            runs, method = above[0], f"{above[1]}_smoothed"
        elif any(first.startswith(begin) for begin in LABELS):
            runs, method = above = next(of for begin, of in LABELS.items() if first.startswith(begin))
        else:
            continue
        f = read_f(runs, method)
        printed = [float(re.match(r"[\d.]+", text).group()) for text in texts]
        assert printed == [pytest.approx(f[name], abs=0.051) for name in CLASSES], first
        found += 1
    # A network and its smoothed labels three times, OG-CNN and the trees.
    assert found == 8
