"""Registered drives in the tables and the report: Józsa's Tables 1 and 2, the peers, paths and streets.

Source: Józsa & Benedek (2013), Tables 1 and 2, Figures 9-14; Nagy (2020), Fig. 3.10.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from streetscan.benchmarks import figures as draw
from streetscan.benchmarks.published import title
from streetscan.benchmarks.report import Gallery, Part, Picture, Section, embed, save_picture
from streetscan.benchmarks.scores import make_score
from streetscan.io.tables import read_csv

# The registrars that are the paper's two columns.
PAPER_COLUMNS = {"ndt_tall": "presegmented", "ndt_raw": "raw"}
_PEER_METRICS = ("n_frames", "failed_pairs", "frame_rate", "ape_rmse", "rpe_rmse", "rpe_max", "rpe_rotation_rmse", "drift")
# Errors of centimetres and drifts of less than a per cent need finer units in print.
_FINER = {"m": (100, "cm"), "%": (10, "mm/m")}
_MODES = {
    "stream": "Stream", "classes": "Classes", "mean_height": "Mean height", "density": "Density", "height_range": "Height range",
}  # fmt: skip


@dataclass(frozen=True)
class Registration:
    """What evaluate_registration found for one drive and registrar.

    Attributes:
        drive, registrar: whose.
        scores: `metric`, `value`, `unit`, `n`.
        trajectory: of `streetscan.registration.evaluation.align_trajectory`.
    """

    drive: str
    registrar: str
    scores: pd.DataFrame
    trajectory: pd.DataFrame

    def value(self, metric: str) -> tuple[float, str, float]:
        """Value, unit and n of a metric; NaN when it is not there."""
        found = self.scores[self.scores["metric"] == metric]
        return (math.nan, "", math.nan) if found.empty else tuple(found.iloc[0][["value", "unit", "n"]])


def read_registrations(scores: Sequence[str], trajectories: Sequence[str], pairs: Sequence[tuple[str, str]]) -> list[Registration]:
    """What evaluate_registration wrote, one of each per (drive, registrar) pair. BadInput when a file is missing or lacks a column."""
    columns = ("metric", "value", "unit", "n"), ("frame", "x_m", "y_m", "true_x_m")
    return [
        Registration(*pair, *(read_csv(path, names, "evaluate_registration") for path, names in zip(paths, columns, strict=True)))
        for *paths, pair in zip(scores, trajectories, pairs, strict=True)
    ]


def _grid_scores(path: str) -> list[dict]:
    drive, content = Path(path).parent.name, read_csv(path, ("class", "metric", "value", "unit"), "evaluate_frames")
    return [
        make_score("grid_classes", drive, r["class"], r["metric"], r["value"], r["unit"], dataset=drive, method="grid")
        for r in content.to_dict("records")
    ]


def registration_scores(registrations: Sequence[Registration], grids: Sequence[str] = ()) -> list[dict]:
    """Rows of the tidy scores: Tables 1 and 2 of the paper, and one row per drive and registrar beside the peers.

    Args:
        registrations: to tabulate.
        grids: `evaluate_frames/<drive>/scores.csv`, precision and recall of the grid's classes.
    """
    rows = []
    for drive in dict.fromkeys(r.drive for r in registrations):
        of_drive = {PAPER_COLUMNS.get(r.registrar, r.registrar): r for r in registrations if r.drive == drive}
        rows += _pair_scores(drive, {k: r for k, r in of_drive.items() if k in PAPER_COLUMNS.values()})
        rows += _drive_scores(drive, of_drive)
    for r in registrations:
        for metric in _PEER_METRICS:
            value, unit, n = r.value(metric)
            value, unit = (value * _FINER[unit][0], _FINER[unit][1]) if unit in _FINER else (value, _unit(unit))
            row = make_score("registration", f"{r.drive}/{r.registrar}", "", metric, value, unit, n, r.drive, r.registrar)
            rows.append(row | {"n": math.nan})
    return rows + [row for path in grids for row in _grid_scores(path)]


def _unit(unit: str) -> str:
    """Counts have no unit in a table: their heading says what is counted."""
    return "" if unit in ("frames", "pairs", "segments") else unit


def _pair_scores(drive: str, columns: Mapping[str, Registration]) -> list[dict]:
    """Table 1."""
    rows, times = [], {}
    for column, r in columns.items():
        milliseconds, _, n = r.value("pair_time_median")
        times[column] = milliseconds / 1000
        rows.append(make_score("jozsa_1", drive, column, "time", times[column], "s", n, drive, r.registrar))
        rows.append(make_score("jozsa_1", drive, column, "failed_pairs", r.value("failed_pairs")[0], "", n, drive, r.registrar))
    if len(times) == len(PAPER_COLUMNS):
        rows.append(make_score("jozsa_1", drive, "", "ratio", times["raw"] / times["presegmented"], "", n, drive, "ndt"))
    return rows


def _drive_scores(drive: str, columns: Mapping[str, Registration]) -> list[dict]:
    """Table 2."""
    n_frames = max(r.value("n_frames")[0] for r in columns.values())
    rows = [make_score("jozsa_2", drive, "", "n_scans", n_frames, "", dataset=drive, method="ndt")]
    for column in [*PAPER_COLUMNS.values(), "ndt_street"]:
        if column in columns:
            r = columns[column]
            for metric in ("n_registered", "n_segments", "failed_pairs"):
                rows.append(make_score("jozsa_2", drive, column, metric, r.value(metric)[0], "", dataset=drive, method=r.registrar))
    return rows


def draw_drives(
    folder: str | Path,
    registrations: Sequence[Registration],
    streets: Mapping[tuple[str, str], str],
    pictures: Sequence[str],
) -> list[Section]:
    """A section per drive: the paths of its registrars, its merged streets, its frames in the colours of the grid.

    Args:
        folder: for the figures.
        registrations: to draw.
        streets: (drive, registrar) to the picture of merge_frames.
        pictures: the folders of show_frames, `<drive>/pictures`.
    """
    sections = []
    folders = {Path(path).parent.name: Path(path) for path in pictures}
    for drive in dict.fromkeys([*(r.drive for r in registrations), *(d for d, _ in streets)]):
        of_drive = [r for r in registrations if r.drive == drive]
        parts = [
            Part(f"drive-{drive}-{registrar}", f"Street by {title(registrar)}", "", [], [embed(path, _street_caption(drive, registrar))])
            for (of, registrar), path in streets.items()
            if of == drive
        ]
        frames = [(name, path) for mode, name in _MODES.items() for path in sorted(folders[drive].glob(f"{mode}_*.png"))[:1]]
        if frames:
            caption = f"A frame of {title(drive)}; classes: ground grey, short objects red, tall structure tan, sparse blue."
            gallery = Gallery(f"frame-{drive}", [(name, embed(path, f"{name} of {title(drive)}")) for name, path in frames], caption)
            parts.append(Part(f"drive-{drive}-frame", "A frame in the colours of the grid", "", [gallery]))
        paths = [_paths(Path(folder), drive, of_drive)] if of_drive else []
        sections.append(Section(f"drive-{drive}", f"Drive {title(drive)}", "", paths, parts))
    return sections


def _street_caption(drive: str, registrar: str) -> str:
    return (
        f"The street of {title(drive)}, merged from the poses of {title(registrar)}: ground grey, short objects red, tall structure tan, "
        "moving points magenta."
    )


def _track(trajectory: pd.DataFrame) -> np.ndarray:
    return trajectory[["x_m", "y_m"]].to_numpy()


def _true(trajectory: pd.DataFrame) -> np.ndarray:
    return trajectory[["true_x_m", "true_y_m"]].to_numpy()


def _failed(trajectory: pd.DataFrame) -> np.ndarray:
    return trajectory["is_failed"].to_numpy(bool)


def _paths(folder: Path, drive: str, registrations: Sequence[Registration]) -> Picture:
    """Paths from above of all registrars and the true one, with the failed pairs marked."""
    tracks, true, failed = ({title(r.registrar): value(r.trajectory) for r in registrations} for value in (_track, _true, _failed))
    caption = (
        f"Paths of {title(drive)} from above, from the first true pose on, and below how far off they get; crosses end pairs that failed. "
        "Side and way are drawn to different scales."
    )
    if not any(np.isfinite(track).any() for track in true.values()):
        caption = f"Paths of {title(drive)} from above; its true poses are not known. Side and way are drawn to different scales."
    return save_picture(draw.paths(tracks, true, failed), folder, f"paths_{drive}", caption)
