"""Views of a labelled map: truth, prediction and errors, from above and from eye level.

Source: thesis Figs. 2.8-2.12 show such views beside each other.
"""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from streetscan.benchmarks import figures
from streetscan.benchmarks.failures import describe_failures, draw_failures, find_failures
from streetscan.benchmarks.rendering import View, grey_levels, render_cloud, render_top
from streetscan.benchmarks.volumes import draw_volumes
from streetscan.classes import FACADE, GROUND, N_CLASSES, UNLABELLED, colours
from streetscan.clouds import PointCloud
from streetscan.segmentation.metrics import reliability_bins
from streetscan.voxels import VoxelGrid

EYE_HEIGHT_M = 2.2
_PITCH = -0.07
_MEASURED = {"intensity": "Intensity", "rgb": "Colours of the cameras"}
_REACH_M, _CELL_M, _N_DIRECTIONS, _MAX_PLACES = 35.0, 4.0, 16, 500
# The ground that is looked from is scanned better than this share of the ground.
_SCANNED_QUANTILE, _BLOCKING = 0.8, 2.0


# The picture of the houses is narrower than the others, and its eye looks for facades, whatever else stands before it.
_HOUSES_WIDTH, _HOUSES_REACH_M, _HOUSES_BLOCKING = 0.7, 18.0, 0.25


class Viewpoint(NamedTuple):
    """An eye: (3,) position in frame `map`, metres, and the direction it looks, counter-clockwise from easting."""

    position: np.ndarray
    yaw_rad: float


def choose_viewpoint(
    points: np.ndarray,
    labels: np.ndarray,
    counts: np.ndarray | None = None,
    wanted: Sequence[int] = range(N_CLASSES),
    reach_m: float = _REACH_M,
    blocking: float = _BLOCKING,
) -> Viewpoint:
    """A place on the road that has a free view of much of many classes.

    Well-scanned ground cells of 4 m (up to 500, evenly spread: the scanner passed there) and 16 directions are tried; the score of a
    direction is the sum over the classes of the logarithm of what a wedge of 60 degrees holds of it from 6 m to `reach_m` away, so that
    one rare class outweighs much of a common one, less `blocking` times the logarithm of what stands in its first 6 m.

    Args:
        points: (V, 3) float64, frame `map`, metres.
        labels: (V,) uint8.
        counts: (V,) measured points that each of them stands for; None: one.
        wanted: classes that are looked for.
        reach_m: how far they are.
        blocking: how much what stands at the feet counts.
    Returns:
        the viewpoint, 2.2 m above the ground there; without ground, above the lowest points.
    """
    floor = labels == GROUND if (labels == GROUND).any() else points[:, 2] <= np.quantile(points[:, 2], 0.1)
    cells, first = _cells(points, _CELL_M)
    held = np.zeros((len(cells), N_CLASSES))
    known = np.isin(labels, list(wanted))
    np.add.at(held, (first[known], labels[known]), 1)
    standing = np.bincount(first[~floor], minlength=len(cells))
    scanned = np.bincount(first[floor], None if counts is None else counts[floor], minlength=len(cells))
    centres = (cells + 0.5) * _CELL_M
    directions = np.arange(_N_DIRECTIONS) * 2 * np.pi / _N_DIRECTIONS
    best = (-np.inf, -np.inf, centres[0], 0.0)
    middle = np.median(points[:, :2], axis=0)
    candidates = np.flatnonzero(scanned >= np.quantile(scanned[scanned > 0], _SCANNED_QUANTILE))
    for here in candidates[:: -(-len(candidates) // _MAX_PLACES)]:
        centre = centres[here]
        offset = centres - centre
        distance = np.hypot(*offset.T)
        seen = (distance > 1.5 * _CELL_M) & (distance < reach_m)
        at_feet = (distance > 0) & (distance <= 1.5 * _CELL_M)
        azimuth = np.arctan2(offset[:, 1], offset[:, 0])
        for yaw in directions:
            ahead = np.cos(azimuth - yaw) > np.cos(np.radians(30))
            # Things at the feet fill the picture and hide the rest.
            hiding = standing[here] + standing[at_feet & ahead].sum()
            score = float(np.log1p(held[seen & ahead].sum(axis=0)).sum() - blocking * np.log1p(hiding))
            candidate = (round(score, 6), -float(np.hypot(*(centre - middle))), centre, float(yaw))
            best = max(best, candidate, key=lambda c: c[:2])
    centre, yaw = best[2:]
    on_floor = points[floor]
    nearest = np.argsort(np.hypot(*(on_floor[:, :2] - centre).T), kind="stable")[:50]
    return Viewpoint(np.array([*centre, np.median(on_floor[nearest, 2]) + EYE_HEIGHT_M]), yaw)


def _cells(points: np.ndarray, size_m: float) -> tuple[np.ndarray, np.ndarray]:
    """The occupied cells of a horizontal grid, (C, 2) int64, and the cell each point lies in, (N,)."""
    keys = np.floor(points[:, :2] / size_m).astype(np.int64)
    low = keys.min(axis=0)
    width = int(keys[:, 1].max() - low[1]) + 1
    packed, inverse = np.unique((keys[:, 0] - low[0]) * width + keys[:, 1] - low[1], return_inverse=True)
    return np.stack(np.divmod(packed, width), axis=1) + low, inverse


def error_colours(predicted: np.ndarray, true: np.ndarray) -> np.ndarray:
    """(N, 3) uint8: grey where the prediction is right, orange where it is wrong, blue-grey where truth is unlabelled."""
    out = np.where((predicted == true)[:, None], np.uint8(figures.CORRECT_COLOUR), np.uint8(figures.WRONG_COLOUR))
    out[true == UNLABELLED] = figures.UNKNOWN_COLOUR
    return out


def draw_views(
    grid: VoxelGrid,
    predicted: np.ndarray,
    true: np.ndarray | None,
    clouds: Iterable[PointCloud],
    width_px: int = 1440,
    reach_m: float = 80.0,
) -> dict[str, Figure]:
    """Pictures of a labelled map.

    Args:
        grid: its voxels.
        predicted: (V,) uint8, the voxels' predicted labels.
        true: (V,) uint8, the voxels' true labels, or None when nothing is known.
        clouds: together the map's points, frame `map`, with `intensity` and `rgb` where it has them. Only those near the eye are kept.
        width_px: width of the pictures.
        reach_m: how far the eye sees.
    Returns:
        `predicted_top`, `predicted_street` and, when any voxel has a true label, `true_*` and `errors_*`; `intensity_*` and `rgb_*`
        when the points have them. The view from above shows voxels (the mean of their points' intensities and colours), turned so that
        the map's long side lies across; the view from eye level shows points. Where there are facades, what is true and measured is
        shown from a second eye, too, which looks for them (`*_houses`).
    """
    centres = grid.centres
    seen_from = choose_viewpoint(centres, predicted, grid.counts)
    yaw = _principal_yaw(centres)
    turned = _turn(centres, -yaw)
    bounds_m, pixel_m = _frame(turned, width_px)
    known = true if _has_truth(true) else predicted
    eyes = [seen_from]
    if (known == FACADE).any():
        eyes.append(choose_viewpoint(centres, known, grid.counts, [FACADE], _HOUSES_REACH_M, _HOUSES_BLOCKING))
    seen, means = _look(grid, clouds, eyes, reach_m)
    eye = _view(seen_from, width_px)
    voxel_colours = {"predicted": colours(predicted)}
    if _has_truth(true):
        voxel_colours |= {"true": colours(true), "errors": error_colours(predicted, true)}
    headings = {"predicted": "Predicted labels", "true": "True labels", "errors": _error_heading(predicted, true)}
    drawn: dict[str, Figure] = {}
    for name, paint in voxel_colours.items():
        shown = true if name == "true" else predicted
        entries = _error_entries(predicted, true) if name == "errors" else figures.legend_entries(shown)
        top = render_top(turned, paint, pixel_m, bounds_m, point_size_m=2 * grid.size_m)
        heading = headings[name]
        drawn[f"{name}_top"] = figures.map_view(top, entries, heading, pixel_m, np.pi / 2 - yaw)
        street = render_cloud(seen[0].points, paint[seen[0].rows], eye, point_size_m=0.06)
        drawn[f"{name}_street"] = figures.map_view(street, entries, heading)
    for name, of_voxels in means.items():
        above = render_top(turned, _paint(name, of_voxels), pixel_m, bounds_m, point_size_m=2 * grid.size_m)
        drawn[f"{name}_top"] = figures.map_view(above, [], _MEASURED[name], pixel_m, np.pi / 2 - yaw)
        street = render_cloud(seen[0].points, _paint(name, seen[0].values[name]), eye, point_size_m=0.06)
        drawn[f"{name}_street"] = figures.map_view(street, [], _MEASURED[name])
    for there, place in zip(seen[1:], eyes[1:], strict=True):
        of_houses = {name: (_MEASURED[name], _paint(name, there.values[name])) for name in means}
        if "true" in voxel_colours:
            of_houses["true"] = headings["true"], voxel_colours["true"][there.rows]
        for name, (heading, paint) in of_houses.items():
            picture = render_cloud(there.points, paint, _view(place, round(_HOUSES_WIDTH * width_px)), point_size_m=0.06)
            drawn[f"{name}_houses"] = figures.map_view(picture, [], heading)
    return drawn


def draw_statistics(predicted: np.ndarray, confidence: np.ndarray, true: np.ndarray | None) -> dict[str, Figure]:
    """How often each class occurs, and whether the confidence can be trusted.

    Args:
        predicted: (V,) uint8 in 0..8.
        confidence: (V,) float32 in 0..1.
        true: (V,) uint8, 255 where unknown, or None when nothing is known.
    Returns:
        `class_shares`, of the voxels with a true label where there are any, and, when any voxel has a true label, `reliability`.
    """
    if not _has_truth(true):
        return {"class_shares": figures.class_shares({"predicted": np.bincount(predicted, minlength=N_CLASSES)})}
    known = true != UNLABELLED
    shares = {name: np.bincount(labels[known], minlength=N_CLASSES) for name, labels in (("true", true), ("predicted", predicted))}
    bins = reliability_bins(predicted[known] == true[known], confidence[known])
    return {"class_shares": figures.class_shares(shares), "reliability": figures.reliability_diagram(bins)}


def draw_closely(
    grid: VoxelGrid, predicted: np.ndarray, true: np.ndarray | None, k: int, n_failures: int
) -> tuple[dict[str, Figure], pd.DataFrame | None]:
    """Training volumes and the worst failures of a labelled map, close up.

    Args:
        grid: the map's voxels with heights.
        predicted: (V,) uint8 labels.
        true: (V,) uint8, 255 where unknown, or None when nothing is known.
        k: voxels an axis of a training volume.
        n_failures: how many at most.
    Returns:
        `volumes` by true labels, by predicted ones where none are known, and, where there are any, `failures`; the failures as
        `describe_failures` says them, None without truth.
    """
    if not _has_truth(true):
        return {"volumes": draw_volumes(grid, predicted, k)}, None
    failures = find_failures(grid, predicted, true, n_failures)
    drawn = {"volumes": draw_volumes(grid, true, k)}
    if failures:
        drawn["failures"] = draw_failures(grid, predicted, true, failures)
    return drawn, describe_failures(grid, failures)


def _paint(name: str, values: np.ndarray) -> np.ndarray:
    return grey_levels(values) if name == "intensity" else values.astype(np.uint8)


def _has_truth(true: np.ndarray | None) -> bool:
    return true is not None and bool((true != UNLABELLED).any())


class _Seen(NamedTuple):
    """Points near an eye (n, 3), their voxels (n,), and per field that was measured its values at them."""

    points: np.ndarray
    rows: np.ndarray
    values: dict[str, np.ndarray]


def _look(
    grid: VoxelGrid, clouds: Iterable[PointCloud], eyes: Sequence[Viewpoint], reach_m: float
) -> tuple[list[_Seen], dict[str, np.ndarray]]:
    """What each eye has near it, and per field that all clouds have its mean in every voxel; the clouds are read once."""
    points, rows, values = [[] for _ in eyes], [[] for _ in eyes], [{name: [] for name in _MEASURED} for _ in eyes]
    sums = dict.fromkeys(_MEASURED, 0.0)
    for cloud in clouds:
        row = grid.find(grid.keys_of(cloud.points))
        sums = {name: of for name, of in sums.items() if name in cloud.fields}
        fields = {name: cloud.fields[name].astype(np.float64).reshape(len(cloud), -1) for name in sums}
        for name, field in fields.items():
            columns = [np.bincount(row[row >= 0], v[row >= 0], minlength=len(grid)) for v in field.T]
            sums[name] = sums[name] + np.stack(columns, axis=1)
        for k, eye in enumerate(eyes):
            near = (row >= 0) & (np.hypot(*(cloud.points[:, :2] - eye.position[:2]).T) < reach_m)
            points[k].append(cloud.points[near])
            rows[k].append(row[near])
            for name, field in fields.items():
                values[k][name].append(field[near])
    means = {name: of / np.maximum(grid.counts, 1)[:, None] for name, of in sums.items() if not np.isscalar(of)}
    # A field that is one value throughout was left empty.
    means = {name: mean for name, mean in means.items() if np.ptp(mean) > 0}
    seen = [
        _Seen(
            np.concatenate(points[k] or [np.empty((0, 3))]),
            np.concatenate(rows[k] or [np.empty(0, np.int64)]),
            {name: _one_column(name, np.concatenate(values[k][name])) for name in means},
        )
        for k in range(len(eyes))
    ]
    return seen, {name: _one_column(name, mean) for name, mean in means.items()}


def _one_column(name: str, values: np.ndarray) -> np.ndarray:
    return values[:, 0] if name == "intensity" else values


def _principal_yaw(points: np.ndarray) -> float:
    """Direction of the long side of the smallest rectangle around the map, in [-90, 90) degrees, to one degree."""
    places = _cells(points, 0.5)[0] * 0.5
    yaws = np.radians(np.arange(-90, 90))
    sides = np.array([np.ptp(places @ np.array([[np.cos(y), -np.sin(y)], [np.sin(y), np.cos(y)]]), axis=0) for y in yaws])
    # Of rectangles as good as each other, the first whose long side lies along its yaw.
    area = np.where(sides[:, 0] >= sides[:, 1], np.round((sides[:, 0] + 1) * (sides[:, 1] + 1), 6), np.inf)
    return float(yaws[np.argmin(area)])


def _turn(points: np.ndarray, yaw_rad: float) -> np.ndarray:
    middle = points[:, :2].mean(axis=0)
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    return np.c_[(points[:, :2] - middle) @ np.array([[c, s], [-s, c]]), points[:, 2]]


def _frame(points: np.ndarray, width_px: int) -> tuple[tuple[float, float, float, float], float]:
    """Bounds of the view from above with a margin of 2 %, metres, and the edge of a pixel; at most as high as wide."""
    low, high = points[:, :2].min(axis=0), points[:, :2].max(axis=0)
    margin = max(0.5, 0.02 * float((high - low).max()))
    low, high = low - margin, high + margin
    return (*low.tolist(), *high.tolist()), float((high - low).max()) / width_px


def _view(seen_from: Viewpoint, width_px: int) -> View:
    forward = np.array([np.cos(seen_from.yaw_rad), np.sin(seen_from.yaw_rad), _PITCH])
    target = seen_from.position + forward
    return View(tuple(seen_from.position.tolist()), tuple(target.tolist()), width_px, width_px // 2, field_of_view_deg=75.0)


def _error_entries(predicted: np.ndarray, true: np.ndarray) -> list[tuple[str, tuple[int, int, int]]]:
    entries = [("Right", figures.CORRECT_COLOUR), ("Wrong", figures.WRONG_COLOUR)]
    return entries + ([("No true label", figures.UNKNOWN_COLOUR)] if (true == UNLABELLED).any() else [])


def _error_heading(predicted: np.ndarray, true: np.ndarray | None) -> str:
    if not _has_truth(true):
        return "Errors"
    known = true != UNLABELLED
    wrong = int((predicted[known] != true[known]).sum())
    return f"Errors: {100 * wrong / int(known.sum()):.1f} % of {int(known.sum()):,} labelled voxels".replace(",", "\u202f")
