"""The realism sheet: the statistics of several maps beside each other."""

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from streetscan.classes import CLASSES, UNLABELLED_COLOUR

_LINES = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
_MARKERS = "osD^vP"
_CLASS_COLOURS = {c.name: np.array(c.colour) / 255 for c in CLASSES} | {"unlabelled": np.array(UNLABELLED_COLOUR) / 255}


def draw_realism_sheet(tables: dict[str, pd.DataFrame]) -> Figure:
    """Eight panels of the statistics `streetscan.simulation.realism` computes; a panel without data says so.

    Args:
        tables: name of a map to its table (columns `statistic, group, x, value, n`).
    """
    figure = Figure(figsize=(13, 13.5), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(4, 2)
    _lines(axes[0, 0], tables, "density_per_m2", "ground", "distance from the track [m]", "points per m² of ground", log=True)
    _lines(axes[0, 1], tables, "return_rate", "all", "incidence [deg]", "share of pulses heard")
    _quantiles(
        axes[1, 0],
        tables,
        "plane_residual_m",
        ("road_one_pass", "facade_one_pass", "road", "facade"),
        1000,
        "residual of flat patches [mm]",
    )
    _quantiles(axes[1, 1], tables, "points_per_voxel", tuple(c.name for c in CLASSES), 1, "points per 0.1 m voxel", log=True)
    _lines(axes[2, 0], tables, "intensity_share", "all", "intensity, share of the 99.9 % quantile", "share of the points", normalise=True)
    _class_intensities(axes[2, 1], tables)
    _shares(axes[3, 0], tables)
    _numbers(axes[3, 1], tables)
    return figure


def draw_density_curves(tables: dict[str, pd.DataFrame]) -> Figure:
    """Point density against the distance from one place, a line per map (thesis Fig. 2.3).

    Args:
        tables: name of a map to its table of `streetscan.simulation.realism.density_around`.
    """
    figure = Figure(figsize=(7.2, 3.6), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    _lines(axes, tables, "density_per_m2", "ground", "distance from the tripod [m]", "points per m² of ground", log=True)
    return figure


def _select(table: pd.DataFrame, statistic: str, group: str | None = None) -> pd.DataFrame:
    rows = table[table.statistic == statistic]
    return rows if group is None else rows[rows.group == group]


def _lines(axes: Axes, tables: dict, statistic: str, group: str, x: str, y: str, log: bool = False, normalise: bool = False) -> None:
    for i, (name, table) in enumerate(tables.items()):
        rows = _select(table, statistic, group).sort_values("x")
        if len(rows):
            scale = rows.x.max() if normalise else 1
            axes.plot(rows.x / scale, rows.value, color=_LINES[i % 6], marker=_MARKERS[i % 6], markersize=4, label=name)
    _finish(axes, x, y, log)


def _quantiles(axes: Axes, tables: dict, statistic: str, groups: tuple, factor: float, y: str, log: bool = False) -> None:
    """Median with the span from 5 to 95 % per group and map."""
    width = 0.8 / max(len(tables), 1)
    for i, (name, table) in enumerate(tables.items()):
        rows = _select(table, statistic)
        shown = [(k, rows[rows.group == g].set_index("x").value * factor) for k, g in enumerate(groups) if (rows.group == g).any()]
        if shown:
            at = [k + (i - (len(tables) - 1) / 2) * width for k, _ in shown]
            middle = np.array([v[0.5] for _, v in shown])
            spans = [middle - [v[0.05] for _, v in shown], [v[0.95] for _, v in shown] - middle]
            axes.errorbar(at, middle, spans, fmt=_MARKERS[i % 6], color=_LINES[i % 6], capsize=2, markersize=4, label=name)
    axes.set_xticks(range(len(groups)), [g.replace("_", " ") for g in groups], rotation=25, ha="right", fontsize=8)
    _finish(axes, "", y, log)


def _class_intensities(axes: Axes, tables: dict) -> None:
    """Intensity histograms of the classes of the first map that has both."""
    for name, table in tables.items():
        rows = _select(table, "intensity_share")
        groups = [c.name for c in CLASSES if (rows.group == c.name).any()]
        if groups:
            for group in groups:
                one = rows[rows.group == group].sort_values("x")
                axes.plot(one.x, one.value, color=_CLASS_COLOURS[group], label=group)
            axes.set_title(name)
            break
    _finish(axes, "intensity", "share of the class's points", False)


def _shares(axes: Axes, tables: dict) -> None:
    for i, table in enumerate(tables.values()):
        left = 0.0
        for _, row in _select(table, "class_share").iterrows():
            axes.barh(i, row.value, left=left, color=_CLASS_COLOURS[row.group])
            if row.value > 0.08:
                text = f"{row.group}\n{100 * row.value:.1f} %" if row.value < 1 else "no labels"
                ink = "white" if row.group == "unlabelled" else "black"
                axes.text(left + row.value / 2, i, text, ha="center", va="center", fontsize=7, color=ink)
            left += row.value
    axes.set_yticks(range(len(tables)), list(tables))
    axes.set_xlabel("share of the points")


def _numbers(axes: Axes, tables: dict) -> None:
    axes.axis("off")
    wanted = (
        ("phantom_share", "phantoms", 100, "%"),
        ("mixed_share", "mixed edges", 100, "%"),
        ("edge_width_m", "edge width", 1000, "mm"),
        ("isolated_share", "stray points", 100, "%"),
        ("ground_density_per_m2", "ground, median", 1, "per m²"),
    )
    cells = []
    for table in tables.values():
        found = [_select(table, s) for s, *_ in wanted]
        found = [rows.value[rows.x.isna() | (rows.x == 0.5)] for rows in found]
        cells.append([f"{f * float(v.iloc[0]):.3g} {unit}" if len(v) else "n/a" for v, (*_, f, unit) in zip(found, wanted, strict=True)])
    table = axes.table(cells, rowLabels=list(tables), colLabels=[heading for _, heading, *_ in wanted], loc="center", cellLoc="right")
    table.scale(1, 1.5)


def _finish(axes: Axes, x: str, y: str, log: bool) -> None:
    axes.set_xlabel(x)
    axes.set_ylabel(y)
    axes.grid(alpha=0.3)
    if axes.lines or axes.containers:
        axes.legend(fontsize=7)
        if log:
            axes.set_yscale("log")
    else:
        axes.text(0.5, 0.5, "not known for these maps", transform=axes.transAxes, ha="center", color="0.5")
