"""The report of a run: one HTML file that holds everything, tables and pictures, and needs nothing from outside.

Equal inputs give equal bytes: nothing here reads a clock, and no date enters unless the caller gives one as a fact.
"""

import base64
import math
import mimetypes
import os
import platform
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import jinja2
import pandas as pd
from matplotlib.figure import Figure

import streetscan
from streetscan.benchmarks import figures as draw
from streetscan.benchmarks.published import load_published, parse_number, title
from streetscan.benchmarks.scores import Evaluation
from streetscan.benchmarks.tables import DASH, Table, format_number, own_heading, split_column
from streetscan.classes import CLASSES
from streetscan.errors import BadInput
from streetscan.io.atomic import atomic_path
from streetscan.io.images import png_to_webp
from streetscan.simulation.layout import GENERATOR_VERSION
from streetscan.simulation.realism_figures import draw_density_curves, draw_realism_sheet

# A larger PNG is a view of a cloud or a photograph, not a drawing of lines.
_LARGE_BYTES = 100_000
# What evaluate_views writes into its folder, and how the report shows it.
VIEW_KINDS = {"predicted": "Predicted", "true": "True", "errors": "Errors"}
MEASURED_KINDS = {"intensity": "Intensity", "rgb": "Colour"}
VIEW_SIDES = {"street": "From eye level", "top": "From above"}
SCAN_SIDES = VIEW_SIDES | {"houses": "Towards the houses"}
# The tables a map is compared in, each with the column of the thesis' own method, which stands in for methods it lacks.
_COMPARED = {"nagy_2_3": "c2cnn f", "nagy_2_4": "c2cnn_finetuned f"}
# Differences below this print as equal.
_SAME = 0.05


@dataclass(frozen=True)
class Picture:
    """A picture in the report: `data` is its data URI."""

    data: str
    caption: str
    is_narrow: bool = False


@dataclass(frozen=True)
class Gallery:
    """Pictures of one thing, seen one at a time: (name, picture) pairs."""

    anchor: str
    pictures: list[tuple[str, Picture]]
    caption: str


@dataclass(frozen=True)
class Check:
    """What was asked of something and what was found; `verdict` is `passes`, `fails`, or empty where nothing is asked or known."""

    name: str
    asked: str
    found: str
    verdict: str


@dataclass(frozen=True)
class Part:
    """One model on one data set, or one keyframe with the checks it was judged by."""

    anchor: str
    heading: str
    text: str
    galleries: list[Gallery] = field(default_factory=list)
    figures: list[Picture] = field(default_factory=list)
    checks: list[Check] = field(default_factory=list)


@dataclass(frozen=True)
class Section:
    """One data set, or the parameter studies, or how real the simulated maps look."""

    anchor: str
    heading: str
    text: str
    figures: list[Picture] = field(default_factory=list)
    parts: list[Part] = field(default_factory=list)
    galleries: list[Gallery] = field(default_factory=list)


def embed(path: str | Path, caption: str, is_narrow: bool = False) -> Picture:
    """A picture file as a picture of the report; large PNGs as WebP, a fifth of the size. BadInput when there is no such file."""
    path = Path(path)
    if not path.is_file():
        raise BadInput(path, "no such picture", "run the step that draws it again")
    kind, content = mimetypes.guess_type(path.name)[0], path.read_bytes()
    if kind == "image/png" and len(content) > _LARGE_BYTES:
        kind, content = "image/webp", png_to_webp(content, path)
    return Picture(f"data:{kind};base64,{base64.b64encode(content).decode()}", caption, is_narrow)


def describe_machine() -> str:
    """One line about the machine this runs on: processor, cores, memory, GPU."""
    import torch

    cpu = platform.processor() or platform.machine()
    if Path("/proc/cpuinfo").is_file():
        names = [line.split(":", 1)[1].strip() for line in Path("/proc/cpuinfo").read_text().splitlines() if line.startswith("model name")]
        cpu = names[0] if names else cpu
    memory_gib = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30
    gpu = torch.cuda.get_device_name(0) if torch.cuda.is_available() else "no GPU"
    return (
        f"{cpu}, {os.cpu_count()} cores, {memory_gib:.0f} GiB memory, {gpu}; Python {platform.python_version()}, torch {torch.__version__}"
    )


def describe_run(run: str, seed: int, labelled: Sequence[tuple[str, str]], registered: Sequence[tuple[str, str]] = ()) -> dict[str, str]:
    """What the head of the report says: run, version, seed, labelled maps, registered drives and the machine."""
    drives = {"Registered drives": "; ".join(f"{d} by {methods}" for d, methods in _methods_of(registered).items())} if registered else {}
    return {
        "Run": run,
        "Version": f"streetscan {streetscan.__version__}",
        "Seed": str(seed),
        "Labelled maps": "; ".join(f"{d} by {methods}" for d, methods in _methods_of(labelled).items()) or "none",
        **drives,
        "Tables made on": describe_machine(),
    }


def _methods_of(pairs: Sequence[tuple[str, str]]) -> dict[str, str]:
    """Map or drive to the titles of its methods."""
    return {d: ", ".join(title(m) for m in dict.fromkeys(m for e, m in pairs if e == d)) for d in dict.fromkeys(d for d, _ in pairs)}


def glance(scores: pd.DataFrame) -> list[dict[str, str]]:
    """One line per scored map and model: overall F beside the paper's, phantom recall, the weakest class.

    For Table 2.4, which has no overall row, the mean of its rows' F stands in; for a method the paper lacks, its own method.
    """
    lines = []
    ours = scores[(scores["method"] != "") & scores["table"].isin(list(_COMPARED))]
    for (table, dataset, method), part in ours.groupby(["table", "dataset", "method"], sort=False):
        f = part[part["column"].map(lambda c: split_column(c)[1]) == "f"]
        reference = {row: parse_number(paper) for row, paper in _reference(scores, f).items()}
        is_overall = f["row"].str.startswith("overall")
        classes = f[~is_overall]
        if table == "nagy_2_3":
            overall = f[f["row"] == "overall"]
            found = overall["ours"].astype(float).tolist()
            value, paper = (found[0], reference.get("overall", math.nan)) if found else (math.nan, math.nan)
        else:
            value, paper = float(classes["ours"].astype(float).mean()), float(classes["row"].map(reference).mean())
        known = classes[classes["ours"].astype(float).notna()]
        weakest = known.loc[known["ours"].astype(float).idxmin()] if len(known) else None
        recall = part[(part["row"] == "phantom") & part["column"].str.endswith(" recall")]
        difference = value - paper
        lines.append(
            {
                "dataset": dataset,
                "method": title(method),
                "f": format_number(value, "%"),
                "paper": format_number(paper, "%"),
                "difference": DASH if math.isnan(difference) else f"{difference:+.1f}".replace("-", "−"),
                "verdict": "" if math.isnan(difference) or abs(difference) < _SAME else "better" if difference > 0 else "worse",
                "phantom_recall": format_number(float(recall["ours"].iloc[0]), "%") if len(recall) else DASH,
                "weakest": DASH if weakest is None else f"{title(weakest['row'])}, {format_number(weakest['ours'], '%')}",
            }
        )
    return lines


def _reference(scores: pd.DataFrame, ours: pd.DataFrame) -> dict[str, str]:
    """The paper's F for each row of one method's F-rates: of that method, or of the thesis' own where it lacks it.

    Both as printed; empty where the paper has none.
    """
    if (ours["paper"] != "").any():
        return dict(zip(ours["row"], ours["paper"], strict=True))
    table, dataset = ours["table"].iloc[0], ours["dataset"].iloc[0]
    own = scores[(scores["table"] == table) & (scores["dataset"] == dataset) & (scores["column"] == _COMPARED[table])]
    printed = dict(zip(own["row"], own["paper"], strict=True))
    return {row: printed.get(row, "") for row in ours["row"]}


def shortfalls(scores: pd.DataFrame, unscored: Sequence[tuple[str, str]] = ()) -> list[str]:
    """What a reader should know before quoting the tables, a sentence each.

    Args:
        scores: the tidy scores.
        unscored: (data set, model) pairs that were labelled and have no truth.
    Returns:
        F-rates below the paper's, classes without a voxel to score, pairs of frames that failed, maps without truth.
    """
    lines = []
    ours = scores[(scores["method"] != "") & scores["table"].isin(list(_COMPARED)) & scores["column"].str.endswith(" f")]
    for (_, dataset, method), part in ours.groupby(["table", "dataset", "method"], sort=False):
        who = f"{title(method)} on {dataset}"
        values = part["ours"].astype(float)
        papers = part["row"].map(_reference(scores, part))
        gap = values - papers.map(parse_number)
        below = [
            f"{title(r)} {format_number(v, '%')} (paper {p})"
            for r, v, p, g in zip(part["row"], values, papers, gap, strict=True)
            if g <= -_SAME
        ]
        if below:
            lines.append(f"{who}: F below the paper's for {', '.join(below)}.")
        missing = [title(r) for r, v in zip(part["row"], values, strict=True) if math.isnan(v)]
        if missing:
            lines.append(f"{who}: nothing to score for {', '.join(missing)}, since no voxel of the test part truly is one.")
    pairs = scores[(scores["table"] == "registration") & (scores["column"] == "failed_pairs")]
    lines += [f"{title(r['row'])}: {r['ours']:.0f} pairs of frames failed." for r in pairs.to_dict("records") if r["ours"] > 0]
    return lines + [f"{title(method)} on {dataset}: labelled, but without truth nothing can be scored." for dataset, method in unscored]


def notes(scores: pd.DataFrame) -> list[str]:
    """What is odd about the papers' figures in the tables shown, each oddity once."""
    lines: dict[str, list[str]] = {}
    known = set(load_published()["table"])
    for table in dict.fromkeys(scores["table"]):
        if table not in known:
            continue
        content = load_published(table)
        for r in content[content["note"] != ""].to_dict("records"):
            place = ", ".join(title(r[k]) for k in ("row", "column", "metric") if r[k])
            lines.setdefault(f"{table}: {{}}: {r['note']}", []).append(f"{place} ({r['value']})")
    return [line.format(places[0] if len(places) < 4 else f"{places[0]} and {len(places) - 1} more") for line, places in lines.items()]


def draw_sections(
    folder: str | Path,
    scores: pd.DataFrame,
    evaluations: Sequence[Evaluation],
    histories: Mapping[tuple[str, str], pd.DataFrame],
    views: Mapping[tuple[str, str], Path],
) -> list[Section]:
    """Draw a run's figures into a folder (SVG, and PDF for print) and arrange them: a section per data set, a part per model.

    Args:
        folder: for the figures; made when missing.
        scores: the tidy scores.
        evaluations: with their confusion matrices.
        histories: (data set, model) to its training history.
        views: (data set, model) to the folder evaluate_views wrote.
    Returns:
        the sections; a data set without truth or training has those parts left out and says so. Of a model with several seeds
        the first is shown.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    evaluated: dict[tuple[str, str], list[Evaluation]] = {}
    for e in evaluations:
        evaluated.setdefault((e.dataset, e.model), []).append(e)
    pairs = list(dict.fromkeys([*evaluated, *views, *histories]))
    sections = _parameter_section(folder, scores)
    for dataset in dict.fromkeys(d for d, _ in pairs):
        own = [pair for pair in pairs if pair[0] == dataset]
        parts = [_part(folder, *pair, evaluated.get(pair, []), histories.get(pair), views.get(pair)) for pair in own]
        bars = _bars(folder, scores, dataset)
        text = "" if bars else "This map has no truth: its labels can be looked at, not scored."
        scans = next((_scan_galleries(Path(views[pair]), dataset) for pair in own if pair in views), [])
        sections.append(Section(f"map-{dataset}", f"Map {dataset}", text, bars, parts, scans))
    return sections


def realism_sections(
    folder: str | Path,
    tables: Mapping[str, pd.DataFrame],
    absent: Sequence[str],
    densities: Mapping[str, pd.DataFrame],
    static_scans: Mapping[str, str],
) -> list[Section]:
    """How real the simulated maps look beside real ones, and how a static scanner would have seen their streets.

    Args:
        folder: for the figures; made when missing.
        tables: data set or drive to its statistics (evaluate_realism), the simulated ones first.
        absent: real ones that are not compared because their recordings are not there.
        densities: static data set to the table of evaluate_density.
        static_scans: static data set to the mobile one of the same streets.
    """
    folder, sections = Path(folder), []
    if tables:
        text = (
            f"Generator version {GENERATOR_VERSION}. The same statistics of the simulated maps and of real ones, whatever each of them "
            "allows: a map without labels has no class shares, one without times no edges, one without its drive no density against "
            "range, and only of a simulated one are the pulses known that nothing answered."
        )
        if absent:
            text += f" Not compared, since the recordings are not under data_root: {', '.join(title(name) for name in absent)}."
        figure = draw_realism_sheet({title(name): table for name, table in tables.items()})
        caption = "Realism sheet; bars and whiskers are the median and the span from 5 to 95 %. All figures are in tables/realism.csv."
        sections.append(Section("realism", "Realism of the simulated maps", text, [save_picture(figure, folder, "realism", caption)]))
    for static, table in densities.items():
        mobile = static_scans[static]
        figure = draw_density_curves({title(name): table[table["scanner"] == s] for name, s in ((static, "static"), (mobile, "mobile"))})
        caption = f"Points per square metre of ground against the distance from a tripod of {title(static)} (thesis Fig. 2.3)."
        text = (
            "The density of a static scan falls steeply with the distance from its tripod, that of a mobile one is lower near by and more "
            "even along the street. C²CNN reads the number of points in a voxel as evidence (of phantoms above all), so what it learned "
            "from mobile scans does not carry over to static ones, whose density says how far the tripod stood (thesis 2.3; measured in "
            "docs/realism.md)."
        )
        pictures = [save_picture(figure, folder, f"density_{static}", caption)]
        sections.append(Section(f"density-{static}", "Static and mobile scanner", text, pictures))
    return sections


# F in % on Oakland's test files of version 1's network as it was (it saw all points): later ones are not to fall below.
_OAKLAND_BEFORE = {"ground": 98.5, "facade": 52.8, "vegetation": 84.1, "vehicle": 11.0}


def yardsticks(scores: pd.DataFrame, simulated: Sequence[str]) -> list[dict[str, str]]:
    """The fixed yardsticks a simulated city's difficulty is held against, a line each.

    OG-CNN has an F of 65 to 85 and finds fewer than 60 % of the phantoms (the thesis: 75.5 and 34.7), LightGBM on eigen-features stays
    5 points below C²CNN, and the city's network for other scanners (`c2cnn_city`), not fine-tuned, does no worse on Oakland than that of
    version 1, which was trained on all points.

    Args:
        scores: the tidy scores.
        simulated: the simulated data sets of the run; without any, the lines of Oakland stand where the run scored it.
    Returns:
        `dataset`, `name`, `asked`, `found` and `verdict` (holds, fails, or empty where nothing is asked or known).
    """

    def ours(table: str, dataset: str, method: str, row: str, metric: str) -> float:
        of = scores[(scores["table"] == table) & (scores["dataset"] == dataset) & (scores["method"] == method) & (scores["row"] == row)]
        found = of.loc[of["column"].map(lambda c: split_column(c)[1]) == metric, "ours"]
        return float(found.iloc[0]) if len(found) else math.nan

    def line(dataset: str, name: str, asked: str, found: float, holds: bool | None) -> dict[str, str]:
        verdict = "" if holds is None or math.isnan(found) else "holds" if holds else "fails"
        text = "not in this run" if math.isnan(found) else format_number(found, "%")
        return {"dataset": title(dataset), "name": name, "asked": asked, "found": text, "verdict": verdict}

    lines = []
    for d in simulated:
        f = {m: ours("nagy_2_3", d, m, "overall", "f") for m in ("og_cnn", "lightgbm", "c2cnn")}
        recall, ahead = ours("nagy_2_3", d, "og_cnn", "phantom", "recall"), f["c2cnn"] - f["lightgbm"]
        lines.append(line(d, "OG-CNN, F overall", "65 to 85", f["og_cnn"], 65 <= f["og_cnn"] <= 85))
        lines.append(line(d, "OG-CNN, recall of phantoms", "below 60", recall, recall < 60))
        lines.append(line(d, "C²CNN's F above LightGBM's", "5 or more", ahead, ahead >= 5))
    on_oakland = {row: ours("nagy_2_4", "oakland", "c2cnn_city", row, "f") for row in _OAKLAND_BEFORE}
    if simulated or not all(map(math.isnan, on_oakland.values())):
        for row, before in _OAKLAND_BEFORE.items():
            found = on_oakland[row]
            name, asked = f"The city's C²CNN for other scanners as it is, F of {title(row)}", f"{before:g} or more (version 1)"
            lines.append(line("oakland", name, asked, found, found >= before))
    return lines


def yardstick_tables(scores: pd.DataFrame, simulated: Sequence[str]) -> dict[str, pd.DataFrame]:
    """`yardsticks` by data set, as tables with the generator's version: what is kept of every version."""
    lines = pd.DataFrame(yardsticks(scores, simulated), columns=["dataset", "name", "asked", "found", "verdict"])
    lines.insert(1, "generator_version", GENERATOR_VERSION)
    return {str(name): of.drop(columns="dataset") for name, of in lines.groupby("dataset", sort=False)}


def save_picture(figure: Figure, folder: Path, name: str, caption: str, is_narrow: bool = False) -> Picture:
    """A figure, written as SVG and PDF, as a picture of the report."""
    for suffix in (".pdf", ".svg"):
        draw.save_figure(figure, folder / f"{name}{suffix}")
    return embed(folder / f"{name}.svg", caption, is_narrow)


def _bars(folder: Path, scores: pd.DataFrame, dataset: str) -> list[Picture]:
    part = scores[(scores["dataset"] == dataset) & scores["table"].isin(list(_COMPARED)) & scores["column"].str.endswith(" f")]
    ours = part[part["method"] != ""]
    if ours.empty:
        return []
    rows = [r for r in dict.fromkeys(ours["row"]) if r != "overall_weighted"]
    series = {
        title(m): [float(v) for v in ours[ours["method"] == m].set_index("row")["ours"].reindex(rows)]
        for m in dict.fromkeys(ours["method"])
    }
    references = {}
    own = _COMPARED[ours["table"].iloc[0]]
    for column in dict.fromkeys([*ours.loc[ours["paper"] != "", "column"], own]):
        printed = part[part["column"] == column].set_index("row")["paper"].reindex(rows, fill_value="")
        references[f"{title(split_column(column)[0])}, paper"] = [parse_number(p) for p in printed]
    figure = draw.score_bars([title(r) for r in rows], series | references, references=list(references))
    caption = f"F per class on {dataset}; hatched bars are the paper's, measured on its own data."
    return [save_picture(figure, folder, f"f_{dataset}", caption)]


def _part(
    folder: Path, dataset: str, method: str, evaluations: Sequence[Evaluation], history: pd.DataFrame | None, views: Path | None
) -> Part:
    anchor, who = f"map-{dataset}-{method}", f"{title(method)} on {dataset}"
    galleries, pictures, text = [], [], []
    if views is not None:
        galleries = _galleries(Path(views), anchor, who)
    if history is not None and len(history):
        best = history.loc[history["validation_accuracy"].idxmax()]
        text.append(f"Trained for {len(history)} epochs; the weights of epoch {best['epoch']:.0f} were kept.")
        caption = f"Training of {who}: loss, accuracy (mean of the classes' recalls) and learning rate per epoch."
        pictures.append(save_picture(draw.training_curve(history), folder, f"training_{dataset}_{method}", caption))
    else:
        text.append("Not trained on this map: its network came with the weights given.")
    seeds = list(dict.fromkeys(e.seed for e in evaluations))
    if len(seeds) > 1:
        text.append(f"Trained with the seeds {', '.join(map(str, seeds))}; what is shown here is of seed {seeds[0]}.")
    for e in (e for e in evaluations if e.seed == seeds[0]):
        n = format_number(e.confusion.sum())
        caption = f"Confusion of {title(e.method)} on {dataset} over all {n} labelled voxels: per cent of the true class, and voxels."
        figure = draw.confusion_matrix(e.confusion, [c.title for c in CLASSES])
        pictures.append(save_picture(figure, folder, f"confusion_{dataset}_{e.method}", caption))
    if not evaluations:
        text.append("No truth, so no confusion matrix.")
    if views is not None:
        captions = {
            "class_shares.svg": (f"How often each class occurs in {dataset}, as {title(method)} labels it.", False),
            "reliability.svg": (f"Whether the confidence of {who} can be trusted: share of right labels per confidence.", True),
            "volumes.png": (f"Training volumes of {dataset} (thesis Figs. 2.5 and 2.6).", False),
            "failures.png": (f"The worst failures of {who}: the largest region of each confusion (thesis Fig. 2.12).", False),
        }
        pictures += [embed(Path(views) / name, *c) for name, c in captions.items() if (Path(views) / name).is_file()]
    return Part(anchor, title(method), " ".join(text), galleries, pictures)


def _galleries(views: Path, anchor: str, who: str) -> list[Gallery]:
    return _pictures_of(views, anchor, who, {kind: (f"{kind}_{{}}.png", name, f"{name} labels") for kind, name in VIEW_KINDS.items()})


def _scan_galleries(views: Path, dataset: str) -> list[Gallery]:
    """The scan itself, the same for every model: true classes, intensity, colour."""
    kinds = {"true": ("true_{}.png", "Class", "True classes")}
    kinds |= {kind: (f"{kind}_{{}}.jpg", name, name) for kind, name in MEASURED_KINDS.items()}
    if not any((views / file.format(side)).is_file() for side in SCAN_SIDES for file, *_ in list(kinds.values())[1:]):
        return []
    return _pictures_of(views, f"scan-{dataset}", f"the scan of {dataset}", kinds, SCAN_SIDES)


def _pictures_of(
    views: Path, anchor: str, who: str, kinds: Mapping[str, tuple[str, str, str]], sides: Mapping[str, str] = VIEW_SIDES
) -> list[Gallery]:
    """A gallery per side; `kinds` gives file pattern, name of the switch and what is seen."""
    made = []
    for side, place in sides.items():
        files = [(name, seen, views / file.format(side)) for file, name, seen in kinds.values()]
        shown = [(name, embed(path, f"{seen} of {who}, {place.lower()}")) for name, seen, path in files if path.is_file()]
        if shown:
            made.append(Gallery(f"{anchor}-{side}", shown, f"{place}: {who}."))
    return made


def _parameter_section(folder: Path, scores: pd.DataFrame) -> list[Section]:
    """Curves of Tables 2.1 and 2.2 when the scores hold runs with other voxel or cube sizes."""
    pictures = []
    for table, parameter, is_log in (("nagy_2_1", "voxel size λ [m]", True), ("nagy_2_2", "side K of the data cube", False)):
        part = scores[(scores["table"] == table) & (scores["column"] == "c2cnn f")]
        for dataset, group in part[part["method"] != ""].groupby("dataset", sort=False):
            both = part[part["dataset"] == dataset].assign(at=lambda t: t["row"].astype(float)).sort_values("at")
            series = {f"C²CNN on {dataset}": both["ours"].astype(float).tolist(), "C²CNN, paper": both["paper"].map(parse_number).tolist()}
            figure = draw.parameter_curve(both["at"].tolist(), series, parameter, references=["C²CNN, paper"], log_scale=is_log)
            caption = f"Overall F against the {parameter}; {len(group)} runs of ours, the paper's {table} dashed."
            pictures.append(save_picture(figure, folder, f"{table}_{dataset}", caption))
    return [Section("parameters", "Voxel and cube size", "", pictures)] if pictures else []


def render_report(
    facts: Mapping[str, str],
    scores: pd.DataFrame,
    tables: Sequence[Table],
    sections: Sequence[Section],
    settings: str,
    unscored: Sequence[tuple[str, str]] = (),
    simulated: Sequence[str] = (),
) -> str:
    """The report as HTML.

    Args:
        facts: what was run, by what and on what, as shown at the top; `Run` names it.
        scores: the tidy scores.
        tables: to print.
        sections: of `draw_sections`.
        settings: the resolved configuration as text.
        unscored: (data set, model) pairs that were labelled and have no truth.
        simulated: data sets held against the yardsticks.
    """
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("streetscan.benchmarks", "."), autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True
    )
    galleries = [g for s in sections for g in [*s.galleries, *(g for p in s.parts for g in p.galleries)]]
    return environment.get_template("report.html.j2").render(
        n_sheets=max((len(g.pictures) for g in galleries), default=0),
        heading=f"streetscan: run {facts['Run']}",
        facts=list(facts.items()),
        glance=glance(scores),
        shortfalls=shortfalls(scores, unscored),
        yardsticks=yardsticks(scores, simulated),
        generator_version=GENERATOR_VERSION,
        tables=tables,
        sections=sections,
        notes=notes(scores),
        settings=settings,
        column_starts=_starts_group,
        own_heading=own_heading,
    )


def _starts_group(table: Table, j: int) -> bool:
    """Whether a column is the first of its group, where a gap is printed."""
    return j == 0 or table.columns[j].group != table.columns[j - 1].group or not table.columns[j].group


def write_report(path: str | Path, html: str) -> None:
    """Write the report; it appears whole or not at all."""
    with atomic_path(path) as partial:
        partial.write_text(html, encoding="utf-8")
