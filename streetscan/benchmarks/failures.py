"""The worst failures of a labelled map, found by the program, seen close up, and why they may have happened.

Source: Nagy (2020), 2.5.4 and Fig. 2.12 (N-043).
"""

from dataclasses import dataclass

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from streetscan.benchmarks.figures import WRONG_COLOUR, close_ups
from streetscan.benchmarks.rendering import View, render_cloud
from streetscan.classes import CLASSES, N_CLASSES, UNLABELLED, colours
from streetscan.segmentation.objects import grow_regions
from streetscan.voxels import VoxelGrid

# How far around a failure the picture reaches, m, and from how high above it one looks down, rise over run.
_MARGIN_M, _PITCH = 2.5, 0.55
_N_DIRECTIONS = 8
_WIDTH_PX, _HEIGHT_PX = 460, 320
# Half an edge of the surroundings that a reason looks at: about that of the thesis' cube, m.
_AROUND_M = 1.15
# Surroundings of which this share belong to the class a thing is taken for explain it; so does a density this many times another.
_MIXED, _TIMES_DENSER = 0.25, 2.0


@dataclass(frozen=True)
class Failure:
    """A connected region of voxels of one class that are called another.

    Attributes:
        rows: (v,) of the grid.
        true, predicted: the classes' labels.
        reason: one sentence.
    """

    rows: np.ndarray
    true: int
    predicted: int
    reason: str


def find_failures(grid: VoxelGrid, predicted: np.ndarray, true: np.ndarray, n: int) -> list[Failure]:
    """The largest failures, one of each confusion, the largest first.

    Args:
        grid: the map's voxels with heights.
        predicted: (V,) uint8 labels.
        true: (V,) uint8, 255 where unknown.
        n: how many at most.
    """
    wrong = np.flatnonzero((true != UNLABELLED) & (predicted != true))
    if len(wrong) == 0:
        return []
    confusion = true[wrong].astype(np.int64) * N_CLASSES + predicted[wrong]
    region = grow_regions(grid.keys[wrong], confusion)
    sizes = np.bincount(region)
    confusion_of = np.zeros(len(sizes), np.int64)
    confusion_of[region] = confusion
    largest_first = np.lexsort((np.arange(len(sizes)), -sizes))
    _, first = np.unique(confusion_of[largest_first], return_index=True)
    found = []
    for r in largest_first[np.sort(first)][:n]:
        rows, (of, called) = wrong[region == r], divmod(int(confusion_of[r]), N_CLASSES)
        found.append(Failure(rows, of, called, _explain(grid, true, rows, of, called)))
    return found


def _explain(grid: VoxelGrid, true: np.ndarray, rows: np.ndarray, of: int, called: int) -> str:
    """What sets a failure apart: the class it is taken for is in the box around it, or its density is nearer that class' than its own."""
    name, other = CLASSES[of].title, CLASSES[called].title
    reach = round(_AROUND_M / grid.size_m)
    low, high = grid.keys[rows].min(axis=0) - reach, grid.keys[rows].max(axis=0) + reach
    around = ((grid.keys >= low) & (grid.keys <= high)).all(axis=1) & (true != UNLABELLED)
    around[rows] = False
    share = float((true[around] == called).mean()) if around.any() else 0.0
    of_class, of_other = (np.median(grid.counts[true == c]) if (true == c).any() else np.nan for c in (of, called))
    density = float(np.median(grid.counts[rows]))
    if share >= _MIXED:
        return f"{100 * share:.0f} % of what stands around it is {other}"
    # As factors; of a class without a voxel here it is not known.
    from_class, from_other = (abs(np.log(density / of)) for of in (of_class, of_other))
    if from_class >= np.log(_TIMES_DENSER) and not from_other >= from_class:
        beside = "" if np.isnan(of_other) else f" and {other} {of_other:.0f}"
        return f"{density:.0f} points a voxel, where {name} has {of_class:.0f}{beside}"
    return f"neither density nor surroundings set it apart ({100 * share:.0f} % {other} around it)"


def describe_failures(grid: VoxelGrid, failures: list[Failure]) -> pd.DataFrame:
    """One row per failure: true and predicted class, voxels, points, centre in frame `map` and heights above ground in m, reason."""
    rows = []
    for f in failures:
        centre, height = grid.centres[f.rows].mean(axis=0), grid.height_m[f.rows]
        low, high = (float(height.min()), float(height.max())) if np.isfinite(height).all() else (np.nan, np.nan)
        names = CLASSES[f.true].name, CLASSES[f.predicted].name
        rows.append((*names, len(f.rows), int(grid.counts[f.rows].sum()), *centre.round(2), low, high, f.reason))
    columns = ("true", "predicted", "n_voxels", "n_points", "x_m", "y_m", "z_m", "lowest_m", "highest_m", "reason")
    return pd.DataFrame(rows, columns=columns)


def draw_failures(grid: VoxelGrid, predicted: np.ndarray, true: np.ndarray, failures: list[Failure]) -> Figure:
    """Each failure as labelled and as it is, from where most of it is seen; Fig. 2.12."""
    rows = []
    for f in failures:
        view, near = _look_at(grid, f.rows)
        pictures = [render_cloud(grid.centres[near], colours(labels[near]), view, grid.size_m) for labels in (predicted, true)]
        caption = f"{CLASSES[f.true].title} called {CLASSES[f.predicted].title}, {len(f.rows)} voxels: {f.reason}"
        rows.append((caption, pictures))
    return close_ups(rows, ["as labelled", "as it is"])


def _look_at(grid: VoxelGrid, rows: np.ndarray) -> tuple[View, np.ndarray]:
    """A view of some voxels from the direction in which most of them are seen, and the rows of what is drawn."""
    centres = grid.centres
    low, high = centres[rows].min(axis=0), centres[rows].max(axis=0)
    middle, reach = (low + high) / 2, float(np.linalg.norm(high - low)) / 2 + _MARGIN_M
    near = np.flatnonzero((np.abs(centres - middle) < reach).all(axis=1))
    paint = np.where(np.isin(near, rows)[:, None], np.uint8(WRONG_COLOUR), np.uint8((0, 0, 0)))
    best = (-1, None)
    for yaw in 2 * np.pi * np.arange(_N_DIRECTIONS) / _N_DIRECTIONS:
        position = middle + 2.2 * reach * np.array([np.cos(yaw), np.sin(yaw), _PITCH])
        view = View(tuple(position), tuple(middle), _WIDTH_PX, _HEIGHT_PX, field_of_view_deg=50.0)
        picture = render_cloud(centres[near], paint, view, grid.size_m, edge_shading=0.0)
        best = max(best, (int((picture == np.uint8(WRONG_COLOUR)).all(axis=2).sum()), view), key=lambda b: b[0])
    return best[1], near
