"""How alike the frames of two drives are, in numbers any HDL-64E's frames can be asked for: simulated beside real.

The streets differ, so what is compared is the sensor: how many of its firings come back, from which beams, from how far, and
where its rings lie on the road.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd

from streetscan.errors import BadInput
from streetscan.frames import LidarFrame
from streetscan.sweeps import azimuths_of

COLUMNS = ("statistic", "x", "drive", "reference", "ratio", "n")
_FIRINGS_PER_S = 64 / 48e-6
_RANGE_STEP_M = 2.0
# ASSUME: what lies this near the height of the wheels, and no farther, is road.
_ROAD_M, _ROAD_REACH_M = 0.25, 20.0
_LEAST_POINTS = 100


@dataclass
class FrameFigures:
    """Figures of a drive's frames.

    Attributes:
        n_frames: looked at.
        points_per_frame: mean.
        no_return_share: of the firings.
        returns_per_ring: (R,) mean per frame, from the lowest ring.
        range_shares: (K,) share of the points in each 2 m of distance.
        road_radius_m: (R,) median horizontal distance of a ring's points on the road, NaN where it has few.
    """

    n_frames: int
    points_per_frame: float
    no_return_share: float
    returns_per_ring: np.ndarray
    range_shares: np.ndarray
    road_radius_m: np.ndarray


def rings_of_order(points: np.ndarray) -> np.ndarray:
    """(N,) rings from the lowest of points stored beam after beam from the highest, each from azimuth 0 on: KITTI's order."""
    azimuths = azimuths_of(points)
    wraps = (azimuths[:-1] < 0) & (azimuths[1:] >= 0) & (np.abs(azimuths[:-1]) < np.pi / 2) & (np.abs(azimuths[1:]) < np.pi / 2)
    rows = np.append(0, np.cumsum(wraps))
    return rows[-1] - rows


def describe_frames(frames: Iterable[LidarFrame], sensor_height_m: float, min_range_m: float, max_range_m: float) -> FrameFigures:
    """Figures of frames, streaming.

    Args:
        frames: of one drive in order of time.
        sensor_height_m: of the sensor above the road.
        min_range_m, max_range_m: points outside are left out, as one of two drives may have them left out.
    Raises:
        BadInput: fewer than two frames, or frames whose rings are neither stored nor tell themselves by the order of the points.
    """
    stamps, counts, radii = [], np.zeros(64), [[] for _ in range(64)]
    edges = np.arange(0, max_range_m + _RANGE_STEP_M, _RANGE_STEP_M)
    ranges = np.zeros(len(edges) - 1)
    for frame in frames:
        rings = frame.ring.astype(int) if frame.ring is not None else rings_of_order(frame.points)
        if len(rings) and rings.max() != 63:
            raise BadInput("the lidar's frames", f"{rings.max() + 1} rings in frame {frame.number}", "compare drives of a HDL-64E")
        distances = np.linalg.norm(frame.points, axis=1)
        kept = (distances >= min_range_m) & (distances <= max_range_m)
        points, rings = frame.points[kept], rings[kept]
        counts += np.bincount(rings, minlength=64)
        ranges += np.histogram(distances[kept], edges)[0]
        level = np.hypot(points[:, 0], points[:, 1])
        # Ahead and behind is road, to the sides are kerbs.
        on_road = (np.abs(points[:, 2] + sensor_height_m) < _ROAD_M) & (level < _ROAD_REACH_M) & (np.abs(points[:, 1]) < 3.0)
        for ring in np.unique(rings[on_road]):
            radii[ring].append(level[on_road & (rings == ring)])
        stamps.append(frame.time_ns)
    if len(stamps) < 2:
        raise BadInput("the lidar's frames", f"{len(stamps)} of them", "compare drives of two frames or more")
    firings = _FIRINGS_PER_S * (stamps[-1] - stamps[0]) * 1e-9 / (len(stamps) - 1)
    on_road = [np.concatenate(r) if r else np.empty(0) for r in radii]
    return FrameFigures(
        len(stamps),
        counts.sum() / len(stamps),
        1 - counts.sum() / len(stamps) / firings,
        counts / len(stamps),
        ranges / max(ranges.sum(), 1),
        np.array([np.median(r) if len(r) >= _LEAST_POINTS else np.nan for r in on_road]),
    )


def compare_figures(drive: FrameFigures, reference: FrameFigures) -> pd.DataFrame:
    """One tidy table: `statistic, x, drive, reference, ratio, n`; x is a ring or a distance in m, n what a figure rests on."""
    rows = [
        ("points_per_frame", "", drive.points_per_frame, reference.points_per_frame, drive.points_per_frame / reference.points_per_frame),
        ("no_return_share", "", drive.no_return_share, reference.no_return_share, drive.no_return_share / reference.no_return_share),
    ]
    # Per firing, so that a sensor that turns slower does not count as one that sees more.
    share_a, share_b = (f.returns_per_ring * (1 - f.no_return_share) / f.points_per_frame * 64 for f in (drive, reference))
    ratios = share_a / share_b
    rows.append(("range_overlap", "", np.minimum(drive.range_shares, reference.range_shares).sum(), 1.0, np.nan))
    rows.append(("rings_within_25_percent", "", float((np.abs(ratios - 1) <= 0.25).mean()), 1.0, np.nan))
    spacing_a, spacing_b = (np.diff(f.road_radius_m[:32]) for f in (drive, reference))
    known = np.isfinite(spacing_a) & np.isfinite(spacing_b)
    spacing = [float(np.median(s[known])) if known.any() else np.nan for s in (spacing_a, spacing_b)]
    rows.append(("road_ring_spacing_m", "", *spacing, spacing[0] / spacing[1]))
    rows += [("returns_per_firing_of_ring", k, share_a[k], share_b[k], ratios[k]) for k in range(64)]
    rows += [("road_radius_m", k, a, b, a / b) for k, (a, b) in enumerate(zip(drive.road_radius_m, reference.road_radius_m, strict=True))]
    rows += [
        ("range_share", k * _RANGE_STEP_M, a, b, a / b if b else np.nan)
        for k, (a, b) in enumerate(zip(drive.range_shares, reference.range_shares, strict=True))
    ]
    return pd.DataFrame([(*row, drive.n_frames) for row in rows], columns=list(COLUMNS))


def draw_comparison(table: pd.DataFrame, drive: str, reference: str) -> plt.Figure:
    """Returns per beam, distances, and rings on the road, of both drives."""
    figure, axes = plt.subplots(3, 1, figsize=(9, 10), layout="constrained")
    panels = (
        ("returns_per_firing_of_ring", "ring, from the lowest", "returns per firing"),
        ("range_share", "distance [m]", "share of the points per 2 m"),
        ("road_radius_m", "ring, from the lowest", "radius on the road [m]"),
    )
    for axis, (statistic, x, y) in zip(axes, panels, strict=True):
        rows = table[table["statistic"] == statistic]
        for column, name, style in (("drive", drive, "-o"), ("reference", reference, "-s")):
            axis.plot(rows["x"].astype(float), rows[column], style, ms=3, lw=1, label=name)
        axis.set(xlabel=x, ylabel=y)
        axis.grid(alpha=0.3)
    axes[0].set_ylim(0, 1.05)
    rings = table[table["statistic"] == "returns_per_firing_of_ring"]
    axes[0].fill_between(rings["x"].astype(float), 0.75 * rings["reference"], 1.25 * rings["reference"], color="C1", alpha=0.12)
    axes[0].legend()
    single = table[table["x"] == ""].set_index("statistic")
    axes[0].set_title(
        f"{single.loc['points_per_frame', 'drive']:.0f} beside {single.loc['points_per_frame', 'reference']:.0f} points a frame; "
        f"no return: {single.loc['no_return_share', 'drive']:.1%} beside {single.loc['no_return_share', 'reference']:.1%}; "
        f"distances overlap by {single.loc['range_overlap', 'drive']:.2f}",
        fontsize=10,
    )
    return figure
