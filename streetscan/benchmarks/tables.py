"""Tables for print: a pivot of the tidy scores, ours beside the paper's, as CSV, Markdown and LaTeX.

A cell reads `ours / paper`; a column only the paper has is marked `(paper)`; what is undefined is a dash.
"""

import csv
import io
import math
from dataclasses import dataclass, replace
from pathlib import Path

import pandas as pd

from streetscan.benchmarks.published import caption as find_caption
from streetscan.benchmarks.published import load_published, parse_number, title
from streetscan.io.atomic import atomic_path

DASH = "–"
# Digits after the point, per unit; other units get three significant digits.
_DIGITS = {"%": 1, "fraction": 3, "m": 2, "deg": 2, "px": 2, "fps": 1, "MB": 0, "year": 0}
_SYMBOLS = {"fraction": "", "year": "", "deg": "°"}
_HIGHER_IS_BETTER = {"precision", "recall", "f", "iou", "accuracy", "frame_rate", "static_kept", "dynamic_removed", "geometric_mean"}
_LOWER_IS_BETTER = {"time", "translation_error", "rotation_error", "x_mean", "x_deviation", "y_mean", "y_deviation", "device_memory"}
_LATEX = {
    "\\": r"\textbackslash{}", "&": r"\&", "%": r"\%", "$": r"\$", "#": r"\#", "_": r"\_", "{": r"\{", "}": r"\}",
    "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "<": r"\textless{}", ">": r"\textgreater{}",
    "²": r"\textsuperscript{2}", "³": r"\textsuperscript{3}", "°": r"\textdegree{}", "λ": r"$\lambda$", "±": r"$\pm$",
    "√": r"$\surd$", "·": r"$\cdot$", "≈": r"$\approx$", "–": "--", "\u202f": r"\,", "×": r"$\times$",
}  # fmt: skip


def split_column(column: str) -> tuple[str, str]:
    """A score's column as (group, metric): `c2cnn f` is the F of C²CNN, `n_scans` a metric without a group."""
    group, _, metric = column.rpartition(" ")
    return group, metric


def format_number(value: object, unit: str = "") -> str:
    """A figure for print: digits by unit, counts grouped by thousands, NaN as a dash, text as it is."""
    if isinstance(value, str):
        return value.replace("~", "≈") if value else DASH
    if value is None or math.isnan(value):
        return DASH
    if unit == "year":
        return f"{value:.0f}"
    if unit in _DIGITS:
        return f"{value:.{_DIGITS[unit]}f}"
    if math.isfinite(value) and float(value).is_integer() and abs(value) < 1e15:
        return _group(f"{value:.0f}")
    if abs(value) >= 100:
        return _group(f"{value:.0f}")
    return f"{value:.3g}"


def _group(digits: str) -> str:
    # Four digits stay together, as in most journals' rules.
    return f"{int(digits):,}".replace(",", "\u202f") if len(digits.lstrip("-")) > 4 else digits


def format_unit(unit: str) -> str:
    """The unit as printed in brackets, empty for plain counts and fractions."""
    return _SYMBOLS.get(unit, unit)


@dataclass(frozen=True)
class Cell:
    """One cell: what we measured and what the paper printed, formatted; `is_best` among ours of its row."""

    ours: str
    paper: str
    is_best: bool = False


@dataclass(frozen=True)
class Column:
    """One column: `group` (a method, may be empty), `heading` with its unit, and which of `ours`, `paper` it holds.

    `name` is the score's column; text is set flush left.
    """

    group: str
    heading: str
    has_ours: bool
    has_paper: bool
    name: str
    is_text: bool = False


@dataclass(frozen=True)
class Table:
    """A table ready for print.

    Attributes:
        name: the table's id, with the data set's when each data set has its own.
        caption: one paragraph: what, source, data set, n, how to read it.
        row_heading: heading of the first column.
        columns: the columns after it.
        rows: the rows' titles.
        row_holds: per row, whether we measured it and whether the paper has it.
        cells: rows x columns.
        n: samples behind each row, formatted; empty when they are equal (then the caption says so) or unknown.
        raw: the unrounded pivot for the CSV file.
    """

    name: str
    caption: str
    row_heading: str
    columns: list[Column]
    rows: list[str]
    row_holds: list[tuple[bool, bool]]
    cells: list[list[Cell]]
    n: list[str]
    raw: pd.DataFrame

    def shown(self, i: int, j: int) -> tuple[str, str]:
        """What a cell shows of ours and of the paper's; one is empty where its row or column has none of that kind."""
        column, cell = self.columns[j], self.cells[i][j]
        row_has_ours, row_has_paper = self.row_holds[i]
        ours = cell.ours if column.has_ours and (row_has_ours or not column.has_paper) else ""
        paper = cell.paper if column.has_paper and (row_has_paper or not column.has_ours) else ""
        if {ours, paper} <= {"", DASH}:
            return ("", DASH) if not column.has_ours else (DASH, "")
        return ours, paper

    def text(self, i: int, j: int) -> str:
        """The text of a cell: `ours / paper`, or the one it shows."""
        return " / ".join(t for t in self.shown(i, j) if t)

    @property
    def groups(self) -> list[tuple[str, int]]:
        """The headings over the columns: (text, number of columns)."""
        out: list[tuple[str, int]] = []
        for column in self.columns:
            heading = _group_heading(column)
            if out and out[-1][0] == heading:
                out[-1] = (heading, out[-1][1] + 1)
            else:
                out.append((heading, 1))
        return out


def _group_heading(column: Column) -> str:
    return f"{column.group} (paper)" if column.group and not column.has_ours else column.group


def pivot(scores: pd.DataFrame, table: str, dataset: str | None = None, mark_best: bool = True) -> Table:
    """One table out of the tidy scores.

    Args:
        scores: as `streetscan.benchmarks.scores.read_scores` gives them.
        table: its id.
        dataset: the data set, for tables that are made per data set; None takes all rows.
        mark_best: mark our best method of each row when two or more of ours stand beside each other.
    Returns:
        the table; rows in the paper's order, then ours; columns in the order of the scores, those of the paper alone last.
    Raises:
        KeyError: the scores hold no such table.
    """
    part = scores[scores["table"] == table]
    if dataset is not None:
        part = part[part["dataset"] == dataset]
    if part.empty:
        raise KeyError(f"no scores of table '{table}'" + (f" and data set '{dataset}'" if dataset else ""))
    facts = find_caption(table)
    row_ids = _ordered_rows(part, table)
    by_key = {(r["row"], r["column"]): r for r in part.to_dict("records")}
    names = _ordered_columns(part, set(facts["reference_metrics"].split()))
    units = {c: sorted({by_key[k]["unit"] for k in by_key if k[1] == c}) for c in names}
    common = {u for us in units.values() for u in us}
    common_unit = format_unit(next(iter(common))) if len(common) == 1 else ""
    columns = [_column(c, units[c] if not common_unit else [], [v for k, v in by_key.items() if k[1] == c]) for c in names]
    if len({split_column(c)[1] for c in names}) == 1 and all(c.group for c in columns):
        # One metric in all columns is told by the caption; the methods are the headings.
        columns = [replace(c, group="", heading=c.group) for c in columns]
    cells = [[_cell(by_key.get((r, c)), units[c]) for c in names] for r in row_ids]
    if mark_best and not facts["scope"]:
        cells = [_mark_best(row, [by_key.get((r, c)) for c in names], names) for r, row in zip(row_ids, cells, strict=True)]
    holds = [_holds([v for k, v in by_key.items() if k[0] == r]) for r in row_ids]
    any_ours = any(c.has_ours for c in columns)
    n_of = {r: _common_n([v for k, v in by_key.items() if k[0] == r]) for r in row_ids}
    known = {n for n in n_of.values() if n is not None}
    n = [format_number(math.nan if n_of[r] is None else n_of[r]) for r in row_ids] if len(known) > 1 else []
    return Table(
        name=f"{table}_{dataset}" if dataset else table,
        caption=_caption(facts, dataset, known, columns, part, common_unit),
        row_heading=facts["row_heading"],
        columns=columns,
        rows=[title(r) + (" (paper)" if any_ours and not has_ours else "") for r, (has_ours, _) in zip(row_ids, holds, strict=True)],
        row_holds=holds,
        cells=cells,
        n=n,
        raw=_raw(row_ids, names, columns, by_key, n_of),
    )


def list_figures(scores: pd.DataFrame, table: str) -> Table:
    """A table of single figures, which share no columns: one line each, what the figure is and on what data beside its value.

    Args:
        scores: as `streetscan.benchmarks.scores.read_scores` gives them.
        table: its id.
    Returns:
        the table; what we measured first, then figures of the paper alone, both in the paper's order.
    """
    part = scores[scores["table"] == table]
    order = _ordered_rows(part, table)
    records = sorted(part.to_dict("records"), key=lambda r: (r["method"] == "", order.index(r["row"])))
    columns = [Column("", name, True, False, name.lower(), is_text=True) for name in ("Figure", "Data set")]
    columns.append(Column("", "Value", True, True, "value"))
    held = [_holds([r]) for r in records]
    texts = [(_name_figure(r["column"]), title(r["dataset"]) if r["dataset"] else DASH) for r in records]
    cells = [[*(Cell(t, DASH) for t in of), _cell(r, ["", r["unit"]])] for of, r in zip(texts, records, strict=True)]
    facts = find_caption(table)
    return Table(
        name=table,
        caption=_caption(facts, None, set(), columns, part, ""),
        row_heading=facts["row_heading"],
        columns=columns,
        rows=[title(r["row"]) + ("" if has_ours else " (paper)") for r, (has_ours, _) in zip(records, held, strict=True)],
        row_holds=held,
        cells=cells,
        n=[format_number(r["n"]) for r in records],
        raw=pd.DataFrame(records)[["row", "column", "dataset", "unit", "ours", "paper", "n"]],
    )


def _name_figure(column: str) -> str:
    group, metric = split_column(column)
    return f"{title(group)}: {title(metric)}" if group else title(metric)


def _ordered_rows(part: pd.DataFrame, table: str) -> list[str]:
    seen = list(dict.fromkeys(part["row"]))
    if table not in set(load_published()["table"]):
        return seen
    order = {r: i for i, r in enumerate(dict.fromkeys(load_published(table)["row"]))}
    return sorted(seen, key=lambda r: order.get(r, len(order)))


def _ordered_columns(part: pd.DataFrame, reference_metrics: set[str]) -> list[str]:
    ours = list(dict.fromkeys(part.loc[part["method"] != "", "column"]))
    # A group we measured keeps its columns together, those we lack included.
    ours_groups = {split_column(c)[0] for c in ours}
    rest = [c for c in dict.fromkeys(part["column"]) if c not in ours]
    groups = list(dict.fromkeys(split_column(c)[0] for c in [*ours, *rest]))
    kept = [c for c in rest if split_column(c)[0] in ours_groups or not reference_metrics or split_column(c)[1] in reference_metrics]
    return sorted([*ours, *kept], key=lambda c: groups.index(split_column(c)[0]))


def _column(name: str, units: list[str], records: list[dict]) -> Column:
    group, metric = split_column(name)
    unit = format_unit(units[0]) if len(units) == 1 else ""
    has_ours, has_paper = _holds(records)
    is_text = all((r["paper"] != "" and math.isnan(parse_number(r["paper"]))) or isinstance(r["ours"], str) for r in records)
    return Column(title(group) if group else "", title(metric) + (f" [{unit}]" if unit else ""), has_ours, has_paper, name, is_text)


def _holds(records: list[dict]) -> tuple[bool, bool]:
    """Whether any of the records is ours, and whether any has a figure of the paper's."""
    return any(r["method"] != "" for r in records), any(r["paper"] != "" for r in records)


def _cell(record: dict | None, units: list[str]) -> Cell:
    if record is None:
        return Cell(DASH, DASH)
    suffix = f" {format_unit(record['unit'])}" if len(units) > 1 and format_unit(record["unit"]) else ""
    ours = format_number(record["ours"], record["unit"])
    if isinstance(record["spread"], float) and not math.isnan(record["spread"]) and ours != DASH:
        ours += f" ± {format_number(record['spread'], record['unit'])}"
    paper = format_number(record["paper"])
    return Cell(ours + suffix * (ours != DASH), paper + suffix * (paper != DASH))


def _mark_best(cells: list[Cell], records: list[dict | None], names: list[str]) -> list[Cell]:
    marked = list(cells)
    metrics = [split_column(n)[1] for n in names]
    for metric in dict.fromkeys(metrics):
        if metric not in _HIGHER_IS_BETTER | _LOWER_IS_BETTER:
            continue
        at = [j for j, m in enumerate(metrics) if m == metric and records[j] is not None and _is_number(records[j]["ours"])]
        if len(at) < 2:
            continue
        # What is printed equal is equally good.
        shown = [float(format_number(records[j]["ours"], records[j]["unit"]).replace("\u202f", "")) for j in at]
        best = max(shown) if metric in _HIGHER_IS_BETTER else min(shown)
        for j, value in zip(at, shown, strict=True):
            if value == best and len(set(shown)) > 1:
                marked[j] = Cell(cells[j].ours, cells[j].paper, is_best=True)
    return marked


def _is_number(value: object) -> bool:
    return not isinstance(value, str) and not math.isnan(value)


def _common_n(records: list[dict]) -> float | None:
    known = sorted({r["n"] for r in records if _is_number(r["n"])})
    return known[0] if known else None


def _caption(facts: dict[str, str], dataset: str | None, known_n: set[float], columns: list[Column], part: pd.DataFrame, unit: str) -> str:
    sentences = [f"{facts['caption']}{f', in {unit}' if unit else ''} ({facts['source']})"]
    where = [f"data set {dataset}"] if dataset else []
    if len(known_n) == 1:
        where.append(f"n = {format_number(next(iter(known_n)))}")
    seeds = sorted({str(s) for s in part["seed"] if str(s) != ""})
    if seeds and max(len(s.split(";")) for s in seeds) > 1:
        where.append(f"mean ± standard deviation over the seeds {', '.join(max(seeds, key=len).split(';'))}")
    if where:
        sentences.append("Ours: " + "; ".join(where))
    if any(c.has_paper for c in columns):
        on = f", measured on {facts['paper_data']}" if facts["paper_data"] else ""
        if any(c.has_ours and c.has_paper for c in columns):
            how = "Cells read ours / paper"
        else:
            how = "Columns marked (paper) are the paper's" if any(c.has_ours for c in columns) else "Figures are the paper's"
        sentences.append(how + on)
    text = ". ".join(sentences) + "."
    return f"{text} {facts['note']}" if facts["note"] else text


def _raw(rows: list[str], names: list[str], columns: list[Column], by_key: dict, n_of: dict[str, float | None]) -> pd.DataFrame:
    out: dict[str, list] = {"row": rows}
    for name, column in zip(names, columns, strict=True):
        records = [by_key.get((r, name)) for r in rows]
        if column.has_ours:
            out[name] = [math.nan if r is None else r["ours"] for r in records]
            spread = [math.nan if r is None else r["spread"] for r in records]
            if any(_is_number(s) for s in spread):
                out[f"{name} (spread)"] = spread
        if column.has_paper:
            out[f"{name} (paper)"] = ["" if r is None else r["paper"] for r in records]
    out["n"] = [math.nan if n_of[r] is None else n_of[r] for r in rows]
    return pd.DataFrame(out)


def to_csv(table: Table) -> str:
    """The table as CSV: row and column ids, unrounded values, ours and the paper's in columns of their own."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(table.raw.columns)
    for record in table.raw.itertuples(index=False):
        writer.writerow([_csv_cell(v) for v in record])
    return stream.getvalue()


def _csv_cell(value: object) -> str:
    if isinstance(value, str):
        return value
    return "" if math.isnan(value) else f"{value:.10g}"


def to_markdown(table: Table) -> str:
    """The table as GitHub Markdown, its caption below in italics."""
    heading = [table.row_heading, *(_markdown_heading(c) for c in table.columns), *(["n"] if table.n else [])]
    lines = [heading, ["---", *("---" if c.is_text else "---:" for c in table.columns), *(["---:"] if table.n else [])]]
    for i, row in enumerate(table.rows):
        texts = []
        for j, cell in enumerate(table.cells[i]):
            text = table.text(i, j)
            texts.append(text.replace(cell.ours, f"**{cell.ours}**", 1) if cell.is_best else text)
        lines.append([row, *texts, *(table.n[i : i + 1])])
    body = "\n".join("| " + " | ".join(t.replace("|", "\\|") for t in line) + " |" for line in lines)
    return f"{body}\n\n*{table.caption}*\n"


def _markdown_heading(column: Column) -> str:
    return f"{column.group} {own_heading(column)}{' (paper)' if column.group and not column.has_ours else ''}".strip()


def to_latex(table: Table) -> str:
    """The table as LaTeX with booktabs rules."""
    alignment = "l" + "".join("l" if c.is_text else "r" for c in table.columns) + "r" * bool(table.n)
    lines = [
        "% needs \\usepackage{booktabs}",
        "\\begin{table}",
        "\\centering",
        f"\\caption{{{escape_latex(table.caption)}}}",
        f"\\label{{tab:{table.name}}}",
        f"\\begin{{tabular}}{{{alignment}}}",
        "\\toprule",
    ]
    if any(g for g, _ in table.groups):
        lines += _latex_groups(table)
    headings = [table.row_heading, *(own_heading(c) for c in table.columns), *(["n"] if table.n else [])]
    lines += [_latex_row([escape_latex(h) for h in headings]), "\\midrule"]
    for i, row in enumerate(table.rows):
        texts = []
        for j, cell in enumerate(table.cells[i]):
            text, ours = escape_latex(table.text(i, j)), escape_latex(cell.ours)
            texts.append(text.replace(ours, f"\\textbf{{{ours}}}", 1) if cell.is_best else text)
        lines.append(_latex_row([escape_latex(row), *texts, *(escape_latex(t) for t in table.n[i : i + 1])]))
    return "\n".join([*lines, "\\bottomrule", "\\end{tabular}", "\\end{table}"]) + "\n"


def own_heading(column: Column) -> str:
    """A column's heading below its group's; marked when it has no group and only the paper has it."""
    return column.heading if column.has_ours or column.group else f"{column.heading} (paper)"


def _latex_groups(table: Table) -> list[str]:
    spans, rules, start = [], [], 2
    for heading, n in table.groups:
        spans.append(f"\\multicolumn{{{n}}}{{c}}{{{escape_latex(heading)}}}")
        if heading:
            rules.append(f"\\cmidrule(lr){{{start}-{start + n - 1}}}")
        start += n
    return [_latex_row(["", *spans, *([""] if table.n else [])]), " ".join(rules)]


def _latex_row(texts: list[str]) -> str:
    return " & ".join(texts) + r" \\"


def escape_latex(text: str) -> str:
    """Text with LaTeX's special characters and our few symbols written for any engine."""
    return "".join(_LATEX.get(c, c) for c in text)


def make_tables(scores: pd.DataFrame) -> list[Table]:
    """Every table the scores hold, in their order: one per data set, or one for all where rows are data sets or single figures."""
    made = []
    for table in dict.fromkeys(scores["table"]):
        scope = find_caption(table)["scope"]
        if scope:
            made.append(list_figures(scores, table) if scope == "list" else pivot(scores, table))
        else:
            datasets = dict.fromkeys(scores.loc[scores["table"] == table, "dataset"])
            made += [pivot(scores, table, dataset) for dataset in datasets]
    return made


def write_tables(folder: str | Path, tables: list[Table]) -> None:
    """Write each table as `<name>.csv`, `<name>.md` and `<name>.tex` into a folder, which is made."""
    Path(folder).mkdir(parents=True, exist_ok=True)
    for table in tables:
        for suffix, write in ((".csv", to_csv), (".md", to_markdown), (".tex", to_latex)):
            with atomic_path(Path(folder) / f"{table.name}{suffix}") as partial:
                partial.write_text(write(table), encoding="utf-8")
