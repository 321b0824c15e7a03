"""Networks on ever fewer points: F against the share of points that is kept, as tables and figures.

Source: ours. The thesis gives its network the number of points itself (2.4.1, N-015), which another scanner or another speed changes.
"""

from collections.abc import Mapping
from pathlib import Path

import pandas as pd

from streetscan.benchmarks.figures import parameter_curve
from streetscan.benchmarks.published import title
from streetscan.benchmarks.report import Section, save_picture
from streetscan.benchmarks.scores import make_score
from streetscan.benchmarks.tables import split_column

_TEXT = (
    "Every point of the map is kept with the same probability, as a scanner with fewer pulses or a faster vehicle would leave it. Only "
    "voxels that keep a point are asked for, equally many of each class and the same for every network. Networks are chosen on the "
    "validation part. All classes' figures are in tables/thinning.csv."
)


def thinning_scores(tables: Mapping[str, pd.DataFrame], names: Mapping[str, tuple[str, int]]) -> list[dict]:
    """Rows of the tables `thinning_validation` and `thinning_test`: F of the object classes by share of points.

    Args:
        tables: `<data set>/<part>` to what evaluate_thinning found there.
        names: model to its method and seed.
    """
    rows = []
    for map_name, table in tables.items():
        dataset, part = map_name.split("/")
        for r in table[(table["class"] == "objects") & (table["metric"] == "f")].to_dict("records"):
            method, seed = names[r["model"]]
            share = f"{100 * r['share']:g}"
            rows.append(make_score(f"thinning_{part}", share, method, "f", r["value"], "%", r["n"], dataset, method, seed))
    return rows


def draw_thinning(folder: str | Path, scores: pd.DataFrame) -> list[Section]:
    """A section with a curve for every map of the tidy scores' thinning tables, drawn into a folder (SVG and PDF)."""
    pictures = []
    of_thinning = scores[scores["table"].str.startswith("thinning_")]
    for (table, dataset), part in of_thinning.groupby(["table", "dataset"], sort=False):
        f = part.astype({"ours": float}).pivot(index="row", columns="column", values="ours")
        f = f.set_index(f.index.astype(float)).sort_index()
        curves = {title(split_column(column)[0]): f[column].tolist() for column in dict.fromkeys(part["column"])}
        caption = f"F of the object classes on fewer points of {dataset}, part {table.removeprefix('thinning_')}."
        figure = parameter_curve(f.index.tolist(), curves, "points kept [%]", log_scale=True)
        figure.axes[0].legend(loc="lower center", bbox_to_anchor=(0.5, 1), ncols=2, frameon=False, fontsize="small")  # above the curves
        pictures.append(save_picture(figure, Path(folder), f"{table}_{dataset}", caption))
    return [Section("thinning", "Fewer points", _TEXT, pictures)] if pictures else []
