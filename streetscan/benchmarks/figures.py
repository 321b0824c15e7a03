"""Figures: numbers in, a matplotlib figure out; `save_figure` writes equal bytes for equal numbers.

Colours: classes keep their palette (`streetscan.classes`); everything else uses the Okabe-Ito palette, and no figure
relies on hue alone (bars are labelled, lines have markers of their own).
"""

import functools
import itertools
import textwrap
from collections.abc import Callable, Sequence
from pathlib import Path

import matplotlib
import numpy as np
import pandas as pd
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Patch, Rectangle
from PIL import Image

from streetscan.classes import CLASSES, UNLABELLED, UNLABELLED_COLOUR
from streetscan.io.atomic import atomic_path
from streetscan.segmentation.metrics import calibration_error

OURS, PAPER, THIRD, FOURTH, ALARM = "#0072B2", "#E69F00", "#009E73", "#CC79A7", "#D55E00"
INK, QUIET, FAINT = "#222222", "#666666", "#DDDDDD"
WIDTH_IN = 7.2
CORRECT_COLOUR, WRONG_COLOUR, UNKNOWN_COLOUR = (205, 205, 205), (213, 94, 0), (150, 160, 175)

_STYLE = {
    "font.family": "DejaVu Sans",
    "font.size": 9,
    "axes.titlesize": 10,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.labelsize": 9,
    "axes.labelcolor": INK,
    "axes.edgecolor": QUIET,
    "axes.linewidth": 0.8,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": FAINT,
    "grid.linewidth": 0.6,
    "xtick.color": QUIET,
    "ytick.color": QUIET,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "xtick.labelsize": 8.5,
    "ytick.labelsize": 8.5,
    "legend.frameon": False,
    "legend.fontsize": 8.5,
    "lines.linewidth": 1.8,
    "lines.markersize": 4.5,
    "svg.fonttype": "path",
    "svg.hashsalt": "streetscan",
}


def _styled(draw: Callable[..., Figure]) -> Callable[..., Figure]:
    @functools.wraps(draw)
    def wrapped(*args, **kwargs) -> Figure:
        with matplotlib.rc_context(_STYLE):
            return draw(*args, **kwargs)

    return wrapped


def _figure(height_in: float, width_in: float = WIDTH_IN) -> Figure:
    figure = Figure(figsize=(width_in, height_in), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def save_figure(figure: Figure, path: str | Path, dpi: float = 200) -> None:
    """Write a figure as its suffix says (`.svg`, `.pdf`, `.png`, `.jpg`), without date or version, so that equal figures are equal files.

    A `.png` keeps every colour, a class' above all; a `.jpg` is for the noise of intensities and photographs.
    """
    path = Path(path)
    metadata = {".svg": {"Date": None, "Creator": None}, ".pdf": {"CreationDate": None, "Creator": None, "Producer": None}}
    with atomic_path(path) as partial, matplotlib.rc_context(_STYLE):
        if path.suffix in (".png", ".jpg"):
            figure.set_dpi(dpi)
            figure.canvas.draw()
            picture = Image.fromarray(np.asarray(figure.canvas.buffer_rgba())[..., :3])
            if path.suffix == ".jpg":
                picture.save(partial, "JPEG", quality=80, optimize=True)
            else:
                picture.save(partial, "PNG")
        else:
            figure.savefig(partial, format=path.suffix[1:], metadata=metadata[path.suffix])


@_styled
def training_curve(history: pd.DataFrame) -> Figure:
    """Loss, accuracy and learning rate per epoch.

    Args:
        history: one row per epoch: `epoch`, and any of `train_loss`, `validation_loss`, `train_accuracy`,
            `validation_accuracy` (0..1) and `learning_rate`. A missing column leaves its line away.
    """
    panels = [
        ("Loss", [("train_loss", "training", OURS, "o"), ("validation_loss", "validation", PAPER, "s")]),
        ("Accuracy [%]", [("train_accuracy", "training", OURS, "o"), ("validation_accuracy", "validation", PAPER, "s")]),
        ("Learning rate", [("learning_rate", "", INK, None)]),
    ]
    panels = [(t, [line for line in lines if line[0] in history]) for t, lines in panels]
    panels = [(t, lines) for t, lines in panels if lines]
    figure = _figure(2.5)
    for axes, (name, lines) in zip(np.atleast_1d(figure.subplots(1, max(1, len(panels)))), panels, strict=False):
        for column, label, colour, marker in lines:
            values = history[column] * (100 if "accuracy" in column else 1)
            step = {"drawstyle": "steps-mid"} if column == "learning_rate" else {}
            shown_marker = marker if len(history) <= 40 else None
            axes.plot(history["epoch"], values, color=colour, marker=shown_marker, label=label, clip_on=False, **step)
        axes.set_title(name)
        axes.set_xlabel("epoch")
        axes.xaxis.get_major_locator().set_params(integer=True)
        if lines[0][0] == "learning_rate":
            axes.set_yscale("log")
            rates = np.unique(history["learning_rate"].to_numpy(float))
            shown_rates = rates[:: -(-len(rates) // 5)]
            axes.minorticks_off()
            axes.set_yticks(shown_rates, [f"{r:.2g}" for r in shown_rates])
        else:
            axes.legend()
        best = "validation_accuracy"
        if name.startswith("Accuracy") and best in history and history[best].notna().any():
            row = history.loc[history[best].idxmax()]
            axes.annotate(
                f"{100 * row[best]:.1f} %",
                (row["epoch"], 100 * row[best]),
                xytext=(0, -12),
                textcoords="offset points",
                ha="center",
                va="top",
                fontsize=8,
                color=INK,
                arrowprops={"arrowstyle": "-", "color": QUIET, "linewidth": 0.6},
            )
    return figure


@_styled
def confusion_matrix(counts: np.ndarray, names: Sequence[str]) -> Figure:
    """A confusion matrix: colour and upper number are the share of the true class, the lower number is the count.

    Args:
        counts: (C, C) integers, rows true, columns predicted.
        names: the C classes' titles.
    """
    counts = np.asarray(counts)
    totals = counts.sum(axis=1, keepdims=True)
    shares = np.divide(counts, totals, out=np.full(counts.shape, np.nan), where=totals > 0)
    n = len(names)
    figure = _figure(0.62 * n + 1.2, 0.66 * n + 1.5)
    axes = figure.subplots()
    axes.grid(False)
    palette = matplotlib.colormaps["Blues"].with_extremes(bad="#F2F2F2")
    # The square root lets confusions of a few per cent be seen beside a diagonal near one.
    image = axes.imshow(np.sqrt(shares), cmap=palette, vmin=0, vmax=1)
    for i in range(n):
        for j in range(n):
            if totals[i, 0] == 0 or counts[i, j] == 0:
                continue
            colour = "white" if np.sqrt(shares[i, j]) > 0.6 else INK
            weight = "bold" if i == j else "normal"
            share = 100 * shares[i, j]
            axes.text(
                j, i - 0.12, "<0.1" if share < 0.05 else f"{share:.1f}", ha="center", va="center", color=colour, weight=weight, fontsize=8.5
            )
            axes.text(j, i + 0.24, short_count(counts[i, j]), ha="center", va="center", color=colour, fontsize=6.5)
    axes.set_xticks(range(n), names, rotation=35, ha="left", rotation_mode="anchor")
    axes.set_yticks(range(n), [f"{name}\nn = {short_count(t)}" for name, t in zip(names, totals[:, 0], strict=True)])
    axes.tick_params(length=0, top=False, bottom=False, labeltop=True, labelbottom=False)
    axes.set_xlabel("predicted")
    axes.set_ylabel("true")
    axes.spines[:].set_visible(False)
    axes.set_xticks(np.arange(n + 1) - 0.5, minor=True)
    axes.set_yticks(np.arange(n + 1) - 0.5, minor=True)
    axes.grid(which="minor", color="white", linewidth=1.5)
    axes.tick_params(which="minor", length=0, top=False, bottom=False, left=False)
    ticks = np.array([0, 0.01, 0.05, 0.2, 0.5, 1.0])
    bar = figure.colorbar(image, ax=axes, fraction=0.035, pad=0.02, ticks=np.sqrt(ticks))
    bar.ax.set_yticklabels([f"{100 * t:.0f}" for t in ticks])
    bar.set_label("share of the true class [%]")
    bar.outline.set_visible(False)
    return figure


def short_count(n: int) -> str:
    """A count in at most four characters or so: 950, 12.3k, 1.75M, 2.1G."""
    value, suffix = float(n), ""
    for unit in ("", "k", "M", "G"):
        suffix = unit
        # From 999.5 on, three digits would print as 1000.
        if abs(value) < 999.5 or unit == "G":
            break
        value /= 1000
    return f"{n}" if not suffix else f"{value:.3g}{suffix}"


@_styled
def score_bars(names: Sequence[str], series: dict[str, Sequence[float]], heading: str = "F [%]", references: Sequence[str] = ()) -> Figure:
    """Bars per class, one colour per series; NaN leaves a gap marked with a dash.

    Args:
        names: the classes' titles, left to right.
        series: title to one value per class, percent.
        heading: label of the vertical axis.
        references: the series from the papers, drawn hatched.
    """
    figure = _figure(3.1)
    axes = figure.subplots()
    colours = _series_colours(series, references)
    width = 0.8 / max(1, len(series))
    values = np.array([list(v) for v in series.values()], float).reshape(len(series), len(names))
    for k, (name, heights) in enumerate(zip(series, values, strict=True)):
        x = np.arange(len(names)) + (k - (len(series) - 1) / 2) * width
        known = np.isfinite(heights)
        hatch = {"hatch": "////", "edgecolor": "white", "linewidth": 0} if name in references else {}
        axes.bar(x, np.where(known, heights, 0), width * 0.92, color=colours[name], label=name, **hatch)
        # Beside more than one neighbour a number fits only upright.
        turn = {"rotation": 90} if len(series) > 2 else {}
        for xi, height in zip(x, heights, strict=True):
            at, text = (height, f"{height:.1f}") if np.isfinite(height) else (0.0, "–")
            axes.annotate(
                text, (xi, at), xytext=(0, 2), textcoords="offset points", ha="center", va="bottom", fontsize=7, color=INK, **turn
            )
    axes.set_xticks(range(len(names)), names)
    axes.tick_params(axis="x", length=0)
    axes.set_ylabel(heading)
    axes.set_ylim(0, 114 if len(series) > 2 else 107)
    axes.set_yticks(range(0, 101, 20))
    axes.grid(axis="x", visible=False)
    figure.legend(loc="outside upper left", ncols=4)
    return figure


def _series_colours(names: Sequence[str], references: Sequence[str]) -> dict[str, str]:
    ours = iter([OURS, THIRD, FOURTH, "#56B4E9", INK] * (1 + len(names)))
    theirs = iter([PAPER, "#999999", ALARM, "#F0E442"] * (1 + len(names)))
    return {name: next(theirs if name in references else ours) for name in names}


@_styled
def parameter_curve(
    values: Sequence[float],
    series: dict[str, Sequence[float]],
    parameter: str,
    heading: str = "F [%]",
    references: Sequence[str] = (),
    log_scale: bool = False,
) -> Figure:
    """A score against a parameter, as in the thesis' Tables 2.1 and 2.2: ours with full lines, the paper's dashed.

    Args:
        values: the parameter's values.
        series: title to one score per value, percent; NaN leaves a gap.
        parameter: label of the horizontal axis.
        heading: label of the vertical axis.
        references: the series from the papers.
        log_scale: logarithmic horizontal axis.
    """
    figure = _figure(3.0)
    axes = figure.subplots()
    colours = _series_colours(series, references)
    markers = dict(zip(series, "osD^vPX" * (1 + len(series)), strict=False))
    for name, scores in series.items():
        scores = np.asarray(scores, float)
        known = np.isfinite(scores)
        style = "--" if name in references else "-"
        axes.plot(np.asarray(values)[known], scores[known], style, color=colours[name], marker=markers[name], label=name)
        if known.any():
            best = int(np.nanargmax(scores))
            axes.annotate(
                f"{scores[best]:.1f}",
                (values[best], scores[best]),
                xytext=(0, 5),
                textcoords="offset points",
                ha="center",
                fontsize=8,
                color=colours[name],
            )
    if log_scale:
        axes.set_xscale("log")
    axes.set_xticks(list(values), [f"{v:g}" for v in values])
    axes.minorticks_off()
    axes.set_xlabel(parameter)
    axes.set_ylabel(heading)
    axes.margins(y=0.14)
    axes.legend(loc="best")
    return figure


@_styled
def reliability_diagram(bins: pd.DataFrame, before: pd.DataFrame | None = None) -> Figure:
    """How far a confidence can be trusted: accuracy against confidence, and how many samples have it.

    Args:
        bins: of `streetscan.segmentation.metrics.reliability_bins`.
        before: bins of the same samples before their confidence was calibrated.
    """
    figure = _figure(3.4, 4.6)
    axes, below = figure.subplots(2, 1, sharex=True, height_ratios=[3, 1])
    edges = np.linspace(0, 1, len(bins) + 1)
    axes.plot([0, 100], [0, 100], ":", color=QUIET, linewidth=1, label="perfectly calibrated")
    if before is not None:
        used = before[before["n"] > 0]
        axes.plot(100 * used["confidence"], 100 * used["accuracy"], "--", color=PAPER, marker="s", label="as trained")
    used = bins[bins["n"] > 0]
    axes.plot(
        100 * used["confidence"], 100 * used["accuracy"], color=OURS, marker="o", label="measured" if before is None else "calibrated"
    )
    axes.fill_between(100 * used["confidence"], 100 * used["confidence"], 100 * used["accuracy"], color=OURS, alpha=0.15, linewidth=0)
    axes.set_ylabel("accuracy [%]")
    axes.set_xlim(0, 100)
    axes.set_ylim(0, 102)
    gaps = [f"{100 * calibration_error(b):.1f}" for b in (before, bins) if b is not None and b["n"].sum() > 0]
    axes.set_title(f"mean gap {' → '.join(gaps)} %" if gaps else "no labelled voxel")
    axes.legend(loc="upper left")
    shares = 100 * bins["n"] / max(1, bins["n"].sum())
    below.bar(100 * (edges[:-1] + edges[1:]) / 2, shares, 100 / len(bins) * 0.92, color=QUIET)
    below.set_ylabel("share [%]")
    below.set_xlabel("confidence [%]")
    below.grid(axis="x", visible=False)
    return figure


@_styled
def class_shares(shares: dict[str, Sequence[float]], names: Sequence[str] | None = None) -> Figure:
    """How often each class occurs, as horizontal bars on a logarithmic axis, one row of dots per series.

    Args:
        shares: title to the count (or share) of each class; normalised here.
        names: the classes' titles, by default the nine.
    """
    names = [c.title for c in CLASSES] if names is None else list(names)
    figure = _figure(0.28 * len(names) + 1.0)
    axes = figure.subplots()
    colours = _series_colours(shares, [])
    height = 0.8 / max(1, len(shares))
    y = np.arange(len(names))
    for k, (name, values) in enumerate(shares.items()):
        values = np.asarray(values, float)
        percent = 100 * values / values.sum() if values.sum() > 0 else np.zeros(len(values))
        at = y + (k - (len(shares) - 1) / 2) * height
        axes.barh(at, np.where(percent > 0, percent, np.nan), height * 0.9, color=colours[name], label=name)
        for yi, p in zip(at, percent, strict=True):
            text = "none" if p == 0 else f"{p:.1f}" if p >= 0.1 else f"{p:.2g}"
            axes.annotate(text, (max(p, 1e-3), yi), xytext=(3, 0), textcoords="offset points", va="center", fontsize=7, color=INK)
    axes.set_xscale("log")
    axes.set_xlim(1e-3, 200)
    axes.set_xticks([0.001, 0.01, 0.1, 1, 10, 100], ["0.001", "0.01", "0.1", "1", "10", "100"])
    axes.minorticks_off()
    axes.set_yticks(y, names)
    axes.invert_yaxis()
    axes.tick_params(axis="y", length=0)
    axes.grid(axis="y", visible=False)
    axes.set_xlabel("share of the voxels [%]")
    if len(shares) > 1:
        figure.legend(loc="outside upper left", ncols=4)
    return figure


def legend_entries(labels: np.ndarray) -> list[tuple[str, tuple[int, int, int]]]:
    """Titles and colours of the classes that occur among labels, in class order, unlabelled last."""
    present = set(np.unique(labels).tolist())
    entries = [(c.title, c.colour) for c in CLASSES if c.label in present]
    return entries + ([("Unlabelled", UNLABELLED_COLOUR)] if UNLABELLED in present else [])


@_styled
def map_view(
    image: np.ndarray,
    entries: Sequence[tuple[str, tuple[int, int, int]]],
    title: str,
    pixel_m: float | None = None,
    north_rad: float | None = None,
) -> Figure:
    """A rendered view with its title, legend, and for a view from above a scale bar and a north arrow.

    Args:
        image: (H, W, 3) uint8.
        entries: titles and RGB colours of the legend.
        title: heading.
        pixel_m: edge of a pixel on the ground; None draws no scale bar.
        north_rad: direction of north in the picture, counter-clockwise from its right; None draws no arrow.
    """
    height, width = image.shape[:2]
    scale = WIDTH_IN / width
    n_legend_rows = max(1, -(-len(entries) // 6))
    per_row = max(1, -(-len(entries) // n_legend_rows))
    top_in, bottom_in = 0.28, 0.12 + 0.19 * n_legend_rows
    figure = Figure(figsize=(WIDTH_IN, height * scale + top_in + bottom_in))
    FigureCanvasAgg(figure)
    total = height * scale + top_in + bottom_in
    axes = figure.add_axes((0, bottom_in / total, 1, height * scale / total))
    axes.imshow(image, interpolation="antialiased", aspect="auto")
    axes.set_axis_off()
    axes.add_patch(Rectangle((0, 0), 1, 1, transform=axes.transAxes, fill=False, edgecolor=FAINT, linewidth=1.2))
    figure.text(0.004, 1 - 0.07 / total, title, va="top", ha="left", weight="bold", fontsize=9.5, color=INK)
    patches = [Patch(facecolor=np.array(c) / 255, edgecolor=QUIET, linewidth=0.4, label=name) for name, c in entries]
    if patches:
        figure.legend(
            handles=patches,
            loc="lower left",
            bbox_to_anchor=(0, 0),
            ncols=per_row,
            borderaxespad=0.2,
            handlelength=1.2,
            handleheight=1.0,
            columnspacing=1.4,
            labelspacing=0.25,
            fontsize=8,
        )
    if pixel_m is not None:
        _draw_scale_bar(axes, width, height, pixel_m)
    if north_rad is not None:
        _draw_north(axes, width, height, north_rad)
    return figure


@_styled
def close_ups(rows: Sequence[tuple[str, Sequence[np.ndarray]]], headings: Sequence[str]) -> Figure:
    """Rows of small pictures, each with its caption, two rows beside each other.

    Args:
        rows: caption and pictures, (H, W, 3) uint8 of one size, of each.
        headings: of the pictures of a row.
    """
    n_lines, n = -(-len(rows) // 2), len(headings)
    height, width = rows[0][1][0].shape[:2] if rows else (1, 1)
    wide = WIDTH_IN * 1.4
    figure = _figure(max(1, n_lines) * (wide / (2 * n) * height / width + 0.45), wide)
    grid = figure.subplots(max(1, n_lines), 2 * n, squeeze=False)
    for axes in grid.flat:
        axes.set_axis_off()
    for i, (caption, pictures) in enumerate(rows):
        of_row = grid[i // 2, (i % 2) * n : (i % 2 + 1) * n]
        for axes, picture, heading in zip(of_row, pictures, headings, strict=True):
            axes.imshow(picture, interpolation="antialiased")
            axes.text(0.5, -0.01, heading, transform=axes.transAxes, ha="center", va="top", fontsize=6.5, color=QUIET)
        of_row[0].set_title(textwrap.fill(caption, 68), fontsize=7.5, weight="normal", loc="left")
    return figure


def _draw_scale_bar(axes, width: int, height: int, pixel_m: float) -> None:
    wanted_m = 0.18 * width * pixel_m
    decade = 10 ** np.floor(np.log10(wanted_m))
    length_m = max(s * decade for s in (1, 2, 5) if s * decade <= wanted_m)
    length, x, y = length_m / pixel_m, 0.02 * width, height - 0.022 * width
    box = {"boxstyle": "round,pad=0.15", "facecolor": "white", "edgecolor": "none", "alpha": 0.8}
    axes.plot([x, x + length], [y, y], color="white", linewidth=5, solid_capstyle="butt", alpha=0.8)
    axes.plot([x, x + length], [y, y], color=INK, linewidth=2.5, solid_capstyle="butt")
    axes.text(x + length / 2, y - 0.009 * width, f"{length_m:g} m", ha="center", va="bottom", fontsize=8, color=INK, bbox=box)
    axes.set_xlim(-0.5, width - 0.5)
    axes.set_ylim(height - 0.5, -0.5)


def _draw_north(axes, width: int, height: int, north_rad: float) -> None:
    length = 0.03 * width
    centre = np.array([0.965 * width, 0.045 * width])
    step = length * np.array([np.cos(north_rad), -np.sin(north_rad)])
    box = {"boxstyle": "round,pad=0.1", "facecolor": "white", "edgecolor": "none", "alpha": 0.8}
    axes.annotate("", centre + step / 2, centre - step / 2, arrowprops={"arrowstyle": "-|>", "color": INK, "linewidth": 1.4})
    axes.text(*(centre - step * 0.95), "N", ha="center", va="center", fontsize=8, weight="bold", color=INK, bbox=box)
    axes.set_xlim(-0.5, width - 0.5)
    axes.set_ylim(height - 0.5, -0.5)


@_styled
def paths(tracks: dict[str, np.ndarray], true: dict[str, np.ndarray], failed: dict[str, np.ndarray]) -> Figure:
    """Paths from above, and how far each is from the true one along the way. Ways are long and narrow: the axes have scales of their own.

    Args:
        tracks: title to positions (K, 2) in metres, NaN where unknown; they start with the true one.
        true: title to the true positions (K, 2) of the same frames.
        failed: title to (K,) bool, frames marked by a cross.
    """
    figure = _figure(4.2)
    above, off = figure.subplots(2, 1, height_ratios=[3, 2])
    longest = max(true.values(), key=len)
    above.plot(longest[:, 0], longest[:, 1], color=INK, linestyle="--", linewidth=1.4, label="true", zorder=3)
    colours = [OURS, PAPER, THIRD, FOURTH, ALARM, QUIET, "#56B4E9", "#F0E442"]
    for (name, track), colour in zip(tracks.items(), itertools.cycle(colours), strict=False):
        above.plot(track[:, 0], track[:, 1], color=colour, linewidth=1.2, label=name)
        wrong = failed[name]
        above.plot(track[wrong, 0], track[wrong, 1], "x", color=colour, markersize=5)
        way_m = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(true[name], axis=0), axis=1))])
        off.plot(way_m, np.linalg.norm(track - true[name], axis=1), color=colour, linewidth=1.2)
    above.set_xlabel("ahead [m]")
    above.set_ylabel("to the left [m]")
    off.set_xlabel("way [m]")
    off.set_ylabel("off the true path [m]")
    off.set_ylim(bottom=0)
    figure.legend(loc="outside upper left", ncols=3)
    return figure


@_styled
def trial_errors(series: dict[str, np.ndarray], heading: str) -> Figure:
    """Errors of repeated trials, one after the other; a trial without an error leaves a gap.

    Args:
        series: title to (T,) errors, NaN where there is none.
        heading: of the axis, with the unit.
    """
    figure = _figure(2.8)
    axes = figure.subplots()
    for (name, values), colour, marker in zip(series.items(), (OURS, PAPER, THIRD), "os^", strict=False):
        axes.plot(np.arange(1, len(values) + 1), values, color=colour, marker=marker, markersize=3, linewidth=0.8, label=name)
    axes.set_ylim(bottom=0)
    axes.set_xlabel("trial")
    axes.set_ylabel(heading)
    figure.legend(loc="outside upper left", ncols=3)
    return figure


@_styled
def before_and_after(before: np.ndarray, after: np.ndarray, is_replaced: np.ndarray, heading: str) -> Figure:
    """Errors of what was in force, against those of what is afterwards, on logarithmic axes; above the dashed line it is worse.

    Args:
        before, after: (T,) errors; infinite and zero ones are drawn at the edges, those that are not known are counted alone.
        is_replaced: (T,) bool, where something else is in force afterwards.
        heading: of the axes, with the unit.
    """
    figure = _figure(4.0)
    axes = figure.subplots()
    shown = {
        "kept": (~is_replaced, QUIET, "x"),
        "replaced, better": (is_replaced & (after <= before), OURS, "o"),
        "replaced, worse": (is_replaced & (after > before), ALARM, "^"),
    }
    unknown = is_replaced & np.isnan(before + after)
    if unknown.any():
        shown["not known"] = unknown, INK, ","
    errors = np.concatenate([before, after])
    errors = errors[np.isfinite(errors) & (errors > 0)]
    edges = (errors.min() / 1.5, errors.max() * 1.5) if len(errors) else (0.1, 10.0)
    for name, (own, colour, marker) in shown.items():
        axes.plot(
            np.clip(before[own], *edges),
            np.clip(after[own], *edges),
            marker,
            color=colour,
            markersize=4,
            alpha=0.7,
            label=f"{name} ({own.sum()})",
        )
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.axline((1, 1), (10, 10), color=INK, linestyle="--", linewidth=0.8)
    axes.set_xlabel(f"in force before, {heading}")
    axes.set_ylabel(f"in force afterwards, {heading}")
    figure.legend(loc="outside upper left", ncols=3)
    return figure


@_styled
def frame_errors(frames: Sequence[int], series: dict[str, np.ndarray], heading: str) -> Figure:
    """Errors frame by frame on a logarithmic axis, a marker of its own for each method.

    Args:
        frames: numbers of the F frames.
        series: title to (F,) errors, NaN where there is none.
        heading: of the axis, with the unit.
    """
    figure = _figure(3.0)
    axes = figure.subplots()
    colours = [OURS, PAPER, THIRD, FOURTH, ALARM, QUIET]
    for (name, values), colour, marker in zip(series.items(), itertools.cycle(colours), itertools.cycle("os^DvxP*"), strict=False):
        axes.plot(np.arange(len(frames)), values, color=colour, marker=marker, linewidth=1.0, label=name)
    axes.set_yscale("log")
    n_shown = min(len(frames), 13)
    at = np.unique(np.linspace(0, max(len(frames) - 1, 0), n_shown).astype(int)) if frames else np.empty(0, int)
    axes.set_xticks(at, [str(frames[i]) for i in at])
    axes.set_xlabel("frame")
    axes.set_ylabel(heading)
    figure.legend(loc="outside upper left", ncols=3)
    return figure
