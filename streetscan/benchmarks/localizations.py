"""Localized drives in the tables and the report: the thesis' Table 3.1, its Fig. 3.8, verdicts, and the reference methods.

Source: Nagy (2020), 3.4, Table 3.1, Figs. 3.3, 3.4, 3.8, 3.9.

Table 3.1 and the strategies of Fig. 3.8 are the vote alone, as in the thesis, which refines nothing; the table over the frames called `ok`
for what their objects say. ASSUME: its "manually labeled data" are our true labels; main, narrow and cross roads are what a simulated
drive goes along; many phantoms are more than 3 % of what stands within 30 m.
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
from streetscan.localization.drive import spread_frames
from streetscan.localization.evaluation import COLUMNS, MANY_PHANTOMS, summarize

# The vote whose figures Table 3.1 prints, and its maps in the thesis' words.
_TABLE_LOCALIZER, _MAPS = "voting_8", {"raw": "raw", "oracle_truth": "manual"}
_PLACES = {"main_road": "main_roads", "narrow_road": "narrow_roads", "crossroads": "crossroads"}
# Of Fig. 3.8: the vote alone for the strategies, the pose at the end for the others.
_STRATEGIES = ("voting_1", "voting_4", "voting_8", "voting_16")
_PEERS = ("crossmodal", "kiss_matcher", "gicp_from_gps", "ndt_from_gps")
_N_FIGURE_FRAMES = 25
_METRICS = (
    "success", "ok", "n_wrong_but_ok", "vote_success", "vote_translation_mean", "vote_rotation_mean", "translation_median",
    "rotation_median", "floor_translation_median", "nees_mean", "landmarks", "movable_landmarks", "good_landmarks",
    "vote_keypoint_distance_mean", "keypoint_distance_mean", "by_points", "detection_vote_rate", "frame_rate",
)  # fmt: skip
# ASSUME: a map is clearly worse when its vote is half as far off again.
_CLEARLY = 1.5
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
    """Rows of the tidy scores: Table 3.1; per drive, map and localizer, and for all drives together, its figures and its verdicts."""
    rows = []
    for dataset in dict.fromkeys(r.dataset for r in localizations):
        rows += _table_3_1([r for r in localizations if r.dataset == dataset and r.localizer == _TABLE_LOCALIZER], dataset)
    for r in [*localizations, *_pool(localizations)]:
        figures = summarize(r.errors).set_index("metric")
        name, method = f"{r.drive}/{r.labels}/{r.localizer}", f"{r.labels}/{r.localizer}"
        for metric in _METRICS:
            value, unit, n = figures.loc[metric, ["value", "unit", "n"]]
            unit = "" if unit == "frames" else unit
            rows.append(make_score("localization", name, "", metric, value, unit, n, r.dataset, method))
        for verdict in dict.fromkeys(r.errors["status"]):
            for outcome in ("right", "wrong"):
                value = figures.loc[f"{verdict}_{outcome}", "value"]
                rows.append(make_score("localization_verdicts", name, verdict, outcome, value, "", len(r.errors), r.dataset, method))
    return rows


def _pool(localizations: Sequence[Localization]) -> list[Localization]:
    """All drives together, per data set, map and localizer that has several."""
    groups = {}
    for r in localizations:
        groups.setdefault((r.dataset, r.labels, r.localizer), []).append(r.errors)
    return [
        Localization(dataset, "all_drives", labels, localizer, "", pd.concat(errors, ignore_index=True))
        for (dataset, labels, localizer), errors in groups.items()
        if len(errors) > 1
    ]


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
    """A section per localized drive: Fig. 3.8 where its localizers ran, errors of the maps, and the pictures; before them one of all.

    Args:
        folder: for the figures.
        localizations: to draw.
        pictures: the folders localize_frames wrote, one per localization.
    """
    sections = []
    for dataset in dict.fromkeys(r.dataset for r in localizations):
        if text := _compare_maps([r for r in _pool(localizations) if r.dataset == dataset]):
            sections.append(Section(f"localized-{dataset}", f"All drives on the map of {dataset}", text))
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

    In the thesis (Table 3.1) the vote is 4.6 times as far off on a raw map; where ours is not, the text says why.
    """
    maps = {
        r.labels: summarize(r.errors).set_index("metric")["value"]
        for r in localizations
        if r.localizer == _TABLE_LOCALIZER and not r.errors["n_movable"].isna().all()
    }
    if len(maps) < 2:
        return ""
    said = " ".join(
        f"The map by {title(labels)} {m['landmarks']:.0f} landmarks within 30 m, {m['movable_landmarks']:.1f} % of them phantoms, "
        f"vehicles or people, which have left by the day of the drive; {m['ok']:.0f} % of the frames ok; the vote within 1 m and 5° in "
        f"{m['vote_success']:.0f} %, and where objects decide {100 * m['vote_translation_mean']:.1f} cm and "
        f"{m['vote_rotation_mean']:.2f}° off."
        for labels, m in maps.items()
    )
    phantoms = 100 * np.nanmean(np.concatenate([r.errors["phantom_share"] for r in localizations]))
    text = f"{said} Phantoms are {phantoms:.1f} % of what stands within 30 m."
    model = next((m for labels, m in maps.items() if labels not in _MAPS), None)
    if model is not None and "raw" in maps:
        text += _judge_raw(maps["raw"], model)
    if model is not None and "oracle_truth" in maps:
        names = ("vote_translation_mean", "vote_rotation_mean")
        shares = [100 * (1 - maps["oracle_truth"][name] / model[name]) for name in names]
        text += f" True labels make the vote {shares[0]:.0f} % and {shares[1]:.0f} % better than the model's (thesis: 35 % and 26 %)."
    return text


def _judge_raw(raw: pd.Series, model: pd.Series) -> str:
    """Whether a raw map is worse than a labelled one, and why if it is not."""
    ratio = raw["vote_translation_mean"] / model["vote_translation_mean"]
    figures = (
        f"{ratio:.1f} times the labelled map's error of the vote (thesis: 4.6), {model['ok'] - raw['ok']:+.0f} % of the frames not ok, "
        f"{model['vote_success'] - raw['vote_success']:+.0f} % of the votes wrong"
    )
    if ratio >= _CLEARLY:
        return f" The raw map is clearly worse: {figures}."
    return (
        f" Where the raw map's frames are believed it is not clearly worse: {figures}. A landmark that has left has no counterpart in the "
        "frame; its votes fall on shifts of their own, and no peak gathers them. So it costs time and margin, and with it belief, and the "
        "error only where lasting landmarks are few, or where it has grown together with one."
    )


def _figure_3_8(folder: Path, drive: str, localizations: Sequence[Localization]) -> list[Picture]:
    """Mean keypoint distance of 25 frames, logarithmic, per strategy and reference method; for the first map that has two of them."""
    for labels in dict.fromkeys(r.labels for r in localizations):
        wanted = dict.fromkeys(_STRATEGIES, "vote_keypoint_m") | dict.fromkeys(_PEERS, "keypoint_m")
        errors = {r.localizer: r.errors.set_index("frame") for r in localizations if r.labels == labels and r.localizer in wanted}
        if len(errors) < 2:
            continue
        frames = spread_frames(sorted(set.intersection(*(set(e.index) for e in errors.values()))), _N_FIGURE_FRAMES)
        series = {title(n): errors[n][column].reindex(frames).to_numpy() for n, column in wanted.items() if n in errors}
        caption = (
            f"Mean distance of the corners of good objects from those of their landmarks, {len(frames)} frames of {title(drive)} on the "
            f"map by {title(labels)}; voting alone, without refinement (thesis, Fig. 3.8: 8 keypoints 0.15 to 0.5 m). Gaps: nothing was "
            "found, or no object has a landmark."
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
