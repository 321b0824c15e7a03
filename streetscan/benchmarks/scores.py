"""The tidy scores: one row per figure we measured, the paper's beside it. Every table is a pivot of them.

Columns: `table, row, column, ours, spread, paper, unit, n, dataset, method, seed`. `column` is the paper's column and the
metric (`c2cnn f`), or the metric alone where the table has one column. `paper` is text, as printed. A row without `method`
is the paper's alone. Units are those of the paper's table.
"""

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from streetscan.benchmarks.published import caption, find_published, load_published
from streetscan.classes import N_CLASSES, NAMES, OBJECT_LABELS
from streetscan.errors import BadInput
from streetscan.io.atomic import atomic_path
from streetscan.io.tables import save_tables

SCORE_COLUMNS = ("table", "row", "column", "ours", "spread", "paper", "unit", "n", "dataset", "method", "seed")
_NUMBERS = ("spread", "n")
# Rows of evaluate_labels and what they are called in the tables; Table 2.3 leaves ground and facade out (N-035).
# ASSUME: the thesis weights its overall figures "with class significance" in one place and "with the occurrence" in another
# (N-036). Beside them stands the plain mean of the seven classes, the harder one; the weighted mean has a row of its own.
_OVERALL = {"objects": "overall", "objects_weighted": "overall_weighted"}
_OVERALL_ALL = _OVERALL | {"overall": "all_classes", "overall_weighted": "all_classes_weighted"}
_GROUP, _CLEANING = "group:", "cleaning:"
# Ends the name of a method whose labels were smoothed afterwards; the thesis' are not.
_SMOOTHED = "_smoothed"
# The thesis' C²CNN of Table 2.4 is pre-trained elsewhere and fine-tuned on Oakland (2.5.3); so is this model of ours.
_NAGY_2_4_COLUMNS = {"c2cnn_from_city": "c2cnn_finetuned"}


@dataclass(frozen=True)
class Evaluation:
    """What evaluate_labels found for one model on one data set.

    Attributes:
        dataset, method, seed: whose, and the seed of its training; `<model>_smoothed` where the labels are those of a smoothed map.
        scores: `protocol` (even or natural), `class`, `metric`, `value`, `unit` (percent), `n`.
        confusion: (9, 9) int64 over all labelled voxels, rows true, columns predicted.
    """

    dataset: str
    method: str
    seed: int
    scores: pd.DataFrame
    confusion: np.ndarray

    @property
    def model(self) -> str:
        """Who labelled the map."""
        return self.method.removesuffix(_SMOOTHED)


def make_score(
    table: str,
    row: str,
    column: str,
    metric: str,
    ours: float | str,
    unit: str,
    n: float = math.nan,
    dataset: str = "",
    method: str = "",
    seed: int | str = "",
) -> dict:
    """One row of the tidy scores with the paper's figure looked up.

    Raises:
        ValueError: the paper's table has another unit there.
    """
    found = find_published(table, row, column, metric)
    if found is not None and found[1] != unit:
        raise ValueError(f"{table} {row} {column} {metric}: ours in '{unit}', the paper's in '{found[1]}'")
    return {
        "table": table,
        "row": row,
        "column": f"{column} {metric}".strip(),
        "ours": ours,
        "spread": math.nan,
        "paper": found[0] if found else "",
        "unit": unit,
        "n": n,
        "dataset": dataset,
        "method": method,
        "seed": str(seed),
    }


def label_scores(evaluation: Evaluation) -> list[dict]:
    """Precision, recall and F of the seven object classes and overall on the class-even test set: Table 2.3."""
    rows = {NAMES[label]: NAMES[label] for label in OBJECT_LABELS} | _OVERALL
    return _rows("nagy_2_3", evaluation, "even", rows, ("precision", "recall", "f"), evaluation.method)


def natural_scores(evaluation: Evaluation) -> list[dict]:
    """Precision, recall, F and IoU of all nine classes and overall, over all labelled voxels."""
    rows = {name: name for name in NAMES} | _OVERALL_ALL
    return _rows("nagy_2_3_natural", evaluation, "natural", rows, ("precision", "recall", "f", "iou"), evaluation.method)


def grouped_scores(evaluation: Evaluation) -> list[dict]:
    """F of groups of classes over all labelled voxels: Table 2.4. `Street furniture` is its row `street_furniture`."""
    names = [name for name in dict.fromkeys(evaluation.scores["class"]) if name.startswith(_GROUP)]
    rows = {name: re.sub(r"\W+", "_", name.removeprefix(_GROUP).lower()) for name in names}
    column = _NAGY_2_4_COLUMNS.get(evaluation.method, evaluation.method)
    return _rows("nagy_2_4", evaluation, "natural", rows, ("f",), column)


def cleaning_scores(evaluation: Evaluation) -> list[dict]:
    """How clean the map becomes when phantoms, or all movable things, are taken out: a row of the table `map_cleaning`."""
    part = evaluation.scores[(evaluation.scores["protocol"] == "natural") & evaluation.scores["class"].str.startswith(_CLEANING)]
    e = evaluation
    return [
        make_score(
            "map_cleaning", f"{e.dataset}/{e.method}", f"{r['class'].removeprefix(_CLEANING)}_out", r["metric"],
            r["value"], r["unit"], r["n"], e.dataset, e.method, e.seed,
        )
        for r in part.to_dict("records")
    ]  # fmt: skip


def _rows(table: str, e: Evaluation, protocol: str, rows: Mapping[str, str], metrics: Sequence[str], column: str) -> list[dict]:
    """The evaluation's figures of one protocol as rows of a table; `rows` gives its classes' names there."""
    part = e.scores[(e.scores["protocol"] == protocol) & e.scores["class"].isin(rows) & e.scores["metric"].isin(metrics)]
    return [
        make_score(table, rows[r["class"]], column, r["metric"], r["value"], r["unit"], r["n"], e.dataset, e.method, e.seed)
        for r in part.to_dict("records")
    ]


def dataset_scores(name: str, facts: Mapping[str, float | str]) -> list[dict]:
    """What a data set is, as a row of Table 1.2.

    Args:
        name: the data set.
        facts: any of `annotation`, `n_classes`, `n_points`, `fields`, `sensor`, `year`, `organisation`; None is unknown.
    """
    order = list(dict.fromkeys(load_published("nagy_1_2")["metric"]))
    return [
        make_score("nagy_1_2", name, "", metric, facts[metric], "year" if metric == "year" else "", dataset=name, method="data")
        for metric in order
        if facts.get(metric) is not None
    ]


def average_seeds(scores: pd.DataFrame) -> pd.DataFrame:
    """One row per figure: the mean over seeds, the sample standard deviation as `spread`, the seeds joined by `;`.

    Text and single runs stay as they are; `n` is the smallest of the runs'.
    """
    keys = ["table", "row", "column", "dataset", "method"]
    out = []
    for _, group in scores.groupby(keys, sort=False):
        record = group.iloc[0].to_dict()
        if len(group) > 1:
            if any(isinstance(v, str) for v in group["ours"]) or group["seed"].duplicated().any():
                raise ValueError(f"two scores for {[record[k] for k in keys]}")
            values = group["ours"].to_numpy(np.float64)
            record |= {"ours": float(values.mean()), "spread": float(values.std(ddof=1)), "n": float(group["n"].min())}
            record["seed"] = ";".join(group["seed"])
        out.append(record)
    return pd.DataFrame(out, columns=list(SCORE_COLUMNS))


def add_paper_rows(scores: pd.DataFrame) -> pd.DataFrame:
    """The scores with a row for every figure of their tables that only the paper has, for each data set."""
    added = []
    for (table, dataset), part in _paper_tables(scores):
        present = set(zip(part["row"], part["column"], strict=True))
        for record in load_published(table).to_dict("records"):
            column = f"{record['column']} {record['metric']}".strip()
            if (record["row"], column) not in present:
                row = make_score(table, record["row"], record["column"], record["metric"], math.nan, record["unit"], dataset=dataset)
                added.append(row)
    return pd.concat([scores, pd.DataFrame(added, columns=list(SCORE_COLUMNS))], ignore_index=True) if added else scores


def _paper_tables(scores: pd.DataFrame):
    """((table, data set), its rows) for each published table; one whose rows are data sets, drives or single figures is one for all."""
    known = set(load_published()["table"])
    across = scores["table"].map(lambda table: bool(caption(table)["scope"])).astype(bool)
    keys = scores["dataset"].where(~across, "")
    for (table, dataset), part in scores.groupby([scores["table"], keys], sort=False):
        if table in known:
            yield (table, dataset), part


def collect_scores(
    evaluations: Sequence[Evaluation], facts: Mapping[str, Mapping[str, float | str | None]], more_rows: Sequence[dict] = ()
) -> pd.DataFrame:
    """The tidy scores of a run.

    Args:
        evaluations: one per (data set, model, seed).
        facts: data set to its facts for Table 1.2.
        more_rows: rows of `make_score` of other tables.
    Returns:
        the scores with the columns of `SCORE_COLUMNS`: Table 1.2; 2.4 for maps scored in groups of classes and 2.3 for all
        others; the rates over all voxels; the cleaning of the maps. Averaged over seeds, the papers' own figures at the end.
    """
    rows = [row for name, values in facts.items() for row in dataset_scores(name, values)]
    for evaluation in evaluations:
        rows += grouped_scores(evaluation) or label_scores(evaluation)
    for more in (natural_scores, cleaning_scores):
        rows += [row for evaluation in evaluations for row in more(evaluation)]
    rows += more_rows
    return add_paper_rows(average_seeds(pd.DataFrame(rows, columns=list(SCORE_COLUMNS))))


def write_scores(path: str | Path, scores: pd.DataFrame) -> None:
    """Write tidy scores as CSV."""
    with atomic_path(path) as partial:
        scores.to_csv(partial, index=False, columns=list(SCORE_COLUMNS), float_format="%.10g", lineterminator="\n")


def read_scores(path: str | Path) -> pd.DataFrame:
    """Read what `write_scores` wrote: `ours` a number where it is one and text elsewhere; `paper` and all ids text.

    Raises:
        BadInput: the file is missing or lacks a column.
    """
    scores = _read_csv(path, SCORE_COLUMNS, "tabulate_benchmarks")
    scores["ours"] = [_number_or_text(v) for v in scores["ours"]]
    for name in _NUMBERS:
        scores[name] = pd.to_numeric(scores[name])
    return scores


def read_evaluations(scores_path: str | Path, confusion_path: str | Path, dataset: str, model: str, seed: int) -> list[Evaluation]:
    """What evaluate_labels wrote for one model on one data set: of its map and, where that is smoothed, first of each voxel alone.

    Raises:
        BadInput: a file is missing, lacks a column, is in another unit or names other classes.
    """
    scores = _read_csv(scores_path, ("labels", "protocol", "class", "metric", "value", "unit", "n"), "evaluate_labels")
    for name in ("value", "n"):
        scores[name] = pd.to_numeric(scores[name])
    is_smoothed = "alone" in set(scores["labels"])
    methods = {"alone": model, "map": model + _SMOOTHED} if is_smoothed else {"map": model}
    return [
        Evaluation(dataset, method, seed, scores[scores["labels"] == labels], read_confusion(confusion_path, labels))
        for labels, method in methods.items()
    ]


def read_all_evaluations(inputs: Mapping[str, Sequence[str]], evaluated: Sequence[tuple[str, str, int]]) -> list[Evaluation]:
    """The evaluations of a run: files `evaluations` and `confusions` of `inputs`, one per (data set, model, seed)."""
    files = zip(inputs["evaluations"], inputs["confusions"], evaluated, strict=True)
    return [e for *paths, name in files for e in read_evaluations(*paths, *name)]


def read_confusion(path: str | Path, labels: str = "map") -> np.ndarray:
    """The confusion matrix over all labelled voxels, (9, 9) int64, rows true, out of evaluate_labels' tidy table."""
    content = _read_csv(path, ("labels", "protocol", "truth", "predicted", "n"), "evaluate_labels")
    content = content[(content["protocol"] == "natural") & (content["labels"] == labels)]
    if unknown := sorted((set(content["truth"]) | set(content["predicted"])) - set(NAMES)):
        raise BadInput(path, f"names '{unknown[0]}', which is no class", "delete it and run evaluate_labels again")
    counts = np.zeros((N_CLASSES, N_CLASSES), np.int64)
    index = ([NAMES.index(n) for n in content[k]] for k in ("truth", "predicted"))
    np.add.at(counts, tuple(index), content["n"].astype(np.int64).to_numpy())
    return counts


def read_named(paths: Sequence[str | Path], names: Iterable[str]) -> dict[str, pd.DataFrame]:
    """The tables of several maps by the maps' names, in their order."""
    return {name: pd.read_csv(path) for name, path in zip(names, paths, strict=True)}


def write_named(folder: str | Path, **kinds: Mapping[str, pd.DataFrame]) -> None:
    """Write `<kind>.csv` for each kind of table there is any of: those of all maps joined, the map's name in the first column `map`."""
    joined = {}
    for kind, tables in kinds.items():
        if tables:
            parts = [table.assign(map=name)[["map", *table]] for name, table in tables.items()]
            joined[Path(folder) / f"{kind}.csv"] = pd.concat(parts, ignore_index=True)
    save_tables(joined)


def _read_csv(path: str | Path, columns: Sequence[str], step: str) -> pd.DataFrame:
    again = f"delete it and run {step} again"
    try:
        content = pd.read_csv(path, dtype=str, keep_default_na=False)
    except (OSError, ValueError) as error:
        raise BadInput(path, f"not a CSV table ({error})", again) from error
    if missing := [c for c in columns if c not in content]:
        raise BadInput(path, f"lacks the column '{missing[0]}'", again)
    return content


def _number_or_text(text: str) -> float | str:
    try:
        return float(text) if text else math.nan
    except ValueError:
        return text
