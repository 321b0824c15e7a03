"""Localized drives in the tables and the report: the thesis' Table 3.1, its Fig. 3.8, verdicts, and the reference methods.

Source: Nagy (2020), 3.4, Table 3.1, Figs. 3.3, 3.4, 3.8, 3.9.

Table 3.1 prints the vote alone, as the thesis has it, over the frames called `ok` for what their objects
say. ASSUME: its "manually labeled data" are our true
labels; main, narrow and cross roads are what a simulated drive goes along; many phantoms are more than 3 % of what stands within 30 m.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from streetscan.benchmarks import figures as draw
from streetscan.benchmarks.published import title
from streetscan.benchmarks.report import Gallery, Part, Picture, Section, embed, save_picture
from streetscan.benchmarks.scores import make_score
from streetscan.errors import BadInput
from streetscan.localization.evaluation import COLUMNS, MANY_PHANTOMS, summarize

# The vote whose figures Table 3.1 prints, and its maps in the thesis' words.
_TABLE_LOCALIZER, _MAPS = "voting_8", {"raw": "raw", "oracle_truth": "manual"}
_PLACES = {"main_road": "main_roads", "narrow_road": "narrow_roads", "crossroads": "crossroads"}
_FIGURE_LOCALIZERS = ("voting_1", "voting_4", "voting_8", "voting_16", "crossmodal")
_N_FIGURE_FRAMES = 25
_METRICS = (
    "success", "ok", "n_wrong_but_ok", "vote_success", "vote_translation_mean", "vote_rotation_mean", "translation_median",
    "rotation_median", "floor_translation_median", "nees_mean", "landmarks", "movable_landmarks", "good_landmarks",
    "keypoint_distance_mean", "by_points", "detection_vote_rate", "frame_rate",
)  # fmt: skip
_PICTURES = {
    "before": "At the start", "after": "Localized", "ground": "Ground removal", "objects": "Objects", "landmarks": "Landmarks",
}  # fmt: skip


@dataclass(frozen=True)
class Localization:
    """What evaluate_localization found for one drive, map and localizer.

    Attributes:
        dataset, drive, labels, localizer: whose.
        place: what the drive goes along, or empty.
        errors: a row per frame, columns of `streetscan.localization.evaluation.COLUMNS`.
    """

    dataset: str
    drive: str
    labels: str
    localizer: str
    place: str
    errors: pd.DataFrame

    @property
    def map_column(self) -> str:
        """The map in the thesis' words."""
        return _MAPS.get(self.labels, self.labels)


def read_localizations(paths: Sequence[str], names: Sequence[tuple[str, str, str, str, str]]) -> list[Localization]:
    """What evaluate_localization wrote, one table per (data set, drive, labels, localizer, place). BadInput when a table is none."""
    found = []
    for path, name in zip(paths, names, strict=True):
        try:
            errors = pd.read_csv(path)
        except (OSError, ValueError) as error:
            raise BadInput(path, f"not a CSV table ({error})", "delete it and run evaluate_localization again") from error
        if missing := [c for c in COLUMNS if c not in errors]:
            raise BadInput(path, f"lacks the column '{missing[0]}'", "delete it and run evaluate_localization again")
        found.append(Localization(*name, errors))
    return found


def localization_scores(localizations: Sequence[Localization]) -> list[dict]:
    """Rows of the tidy scores: Table 3.1, and a row per drive, map and localizer."""
    rows = []
    for dataset in dict.fromkeys(r.dataset for r in localizations):
        rows += _table_3_1([r for r in localizations if r.dataset == dataset and r.localizer == _TABLE_LOCALIZER], dataset)
    for r in localizations:
        figures = summarize(r.errors).set_index("metric")
        name = f"{r.drive}/{r.labels}/{r.localizer}"
        for metric in _METRICS:
            value, unit, n = figures.loc[metric, ["value", "unit", "n"]]
            unit = "" if unit == "frames" else unit
            rows.append(make_score("localization", name, "", metric, value, unit, n, r.dataset, f"{r.labels}/{r.localizer}"))
    return rows


def _table_3_1(localizations: Sequence[Localization], dataset: str) -> list[dict]:
    rows = []
    for column in dict.fromkeys(r.map_column for r in localizations):
        frames = pd.concat([r.errors.assign(place=r.place) for r in localizations if r.map_column == column])
        is_many = frames["phantom_share"] >= MANY_PHANTOMS
        sets = {row: frames["place"] == place for place, row in _PLACES.items()}
        sets |= {"few_phantoms": ~is_many & frames["phantom_share"].notna(), "many_phantoms": is_many}
        sets |= {"overall": pd.Series(True, index=frames.index)}
        for row, chosen in sets.items():
            ok = frames[chosen & (frames["status"] == "ok") & (frames["source"] == "objects")]
            if not chosen.any():
                continue
            for metric, name, unit in (("translation_error", "vote_m", "m"), ("rotation_error", "vote_deg", "deg")):
                value = float(ok[name].mean()) if len(ok) else float("nan")
                rows.append(make_score("nagy_3_1", row, column, metric, value, unit, len(ok), dataset, column))
    return rows


def draw_localizations(folder: str | Path, localizations: Sequence[Localization], pictures: Sequence[str]) -> list[Section]:
    """A section per localized drive: Fig. 3.8 where its localizers ran, errors of the maps, and the pictures.

    Args:
        folder: for the figures.
        localizations: to draw.
        pictures: the folders localize_frames wrote, one per localization.
    """
    sections = []
    for dataset, drive in dict.fromkeys((r.dataset, r.drive) for r in localizations):
        own = [(r, Path(p)) for r, p in zip(localizations, pictures, strict=True) if (r.dataset, r.drive) == (dataset, drive)]
        shown = _figure_3_8(Path(folder), drive, [r for r, _ in own]) + _verdicts(Path(folder), drive, [r for r, _ in own])
        parts = []
        for r, path in own:
            files = [(name, path / f"{kind}.png") for kind, name in _PICTURES.items() if (path / f"{kind}.png").is_file()]
            if files:
                who = f"{title(r.localizer)} on the map by {title(r.labels)}"
                anchor = f"localized-{drive}-{r.labels}-{r.localizer}"
                caption = f"A frame of {title(drive)}, {who}: the frame red, the map's standing points by height."
                gallery = Gallery(f"{anchor}-frame", [(name, embed(p, f"{name}, {who}")) for name, p in files], caption)
                parts.append(Part(anchor, who, "", [gallery]))
        text = _compare_maps([r for r, _ in own])
        sections.append(Section(f"localized-{drive}", f"{title(drive)} on the map of {dataset}", text, shown, parts))
    return sections


def _compare_maps(localizations: Sequence[Localization]) -> str:
    """What the maps of a drive differ in, in words and figures, and what that does to the vote; empty for one map alone.

    In the thesis (Table 3.1) a raw map is twice as bad; ours says why it need not be.
    """
    said = []
    for r in localizations:
        if r.localizer != _TABLE_LOCALIZER or r.errors["n_movable"].isna().all():
            continue
        figures = summarize(r.errors).set_index("metric")["value"]
        said.append(
            f"by {title(r.labels)} {figures['landmarks']:.0f} landmarks within 30 m, {figures['movable_landmarks']:.1f} % of them phantoms,"
            " vehicles or people, which have left by the day of the drive; "
            f"vote {100 * figures['vote_translation_mean']:.0f} cm, {figures['vote_rotation_mean']:.2f}°"
        )
    if len(said) < 2:
        return ""
    phantoms = 100 * np.nanmean(np.concatenate([r.errors["phantom_share"] for r in localizations]))
    return (
        f"The maps: {'; '.join(said)}. Phantoms are {phantoms:.1f} % of what stands within 30 m. A landmark that has left has no "
        "counterpart in the frame; its votes fall on shifts of their own, and no peak gathers them. So it costs time and margin, and the "
        "error only where lasting landmarks are few, or where it has grown together with one."
    )


def _figure_3_8(folder: Path, drive: str, localizations: Sequence[Localization]) -> list[Picture]:
    """Mean keypoint distance of 25 frames, logarithmic, per strategy and the reference method; for the first map that has two of them."""
    for labels in dict.fromkeys(r.labels for r in localizations):
        own = {r.localizer: r.errors for r in localizations if r.labels == labels and r.localizer in _FIGURE_LOCALIZERS}
        if len(own) < 2:
            continue
        frames = sorted(set.intersection(*(set(e["frame"]) for e in own.values())))
        frames = [frames[i] for i in np.unique(np.linspace(0, len(frames) - 1, _N_FIGURE_FRAMES).astype(int))] if frames else []
        series = {title(n): own[n].set_index("frame")["keypoint_m"].reindex(frames).to_numpy() for n in _FIGURE_LOCALIZERS if n in own}
        caption = (
            f"Mean distance of the keypoints after localization, {len(frames)} frames of {title(drive)} on the map by {title(labels)} "
            "(thesis, Fig. 3.8: 8 keypoints 0.15 to 0.5 m). Gaps: nothing was found, or no object has a landmark."
        )
        figure = draw.frame_errors(frames, series, "mean keypoint distance [m]")
        return [save_picture(figure, folder, f"nagy_fig_3_8_{drive}", caption)]
    return []


def _verdicts(folder: Path, drive: str, localizations: Sequence[Localization]) -> list[Picture]:
    series = {
        f"{title(r.localizer)}, {title(r.labels)}": np.maximum(r.errors["found_m"].to_numpy(), 1e-3)
        for r in localizations
        if r.localizer == _TABLE_LOCALIZER
    }
    if not series:
        return []
    frames = next(r.errors["frame"].tolist() for r in localizations if r.localizer == _TABLE_LOCALIZER)
    series = {name: values for name, values in series.items() if len(values) == len(frames)}
    caption = f"Distance of the poses of {title(drive)} from the true ones, frame by frame."
    return [save_picture(draw.frame_errors(frames, series, "position error [m]"), folder, f"localized_{drive}", caption)]
