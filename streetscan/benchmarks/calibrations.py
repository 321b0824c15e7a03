"""Reconstructed and calibrated keyframes in the tables and the report, beside the thesis' figures.

Source: Nagy (2020), 4.3.1 (points of Fig. 4.2, reprojection error), Figs. 4.2-4.9, 4.11, 4.13, Tables 4.1 and 4.2.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from streetscan.benchmarks import figures as draw
from streetscan.benchmarks.published import title
from streetscan.benchmarks.report import Gallery, Part, Section, embed, save_picture
from streetscan.benchmarks.scores import make_score
from streetscan.benchmarks.verdicts import HOW_TO_READ, checks_of
from streetscan.calibration.calibration_evaluation import limit_gates
from streetscan.calibration.keyframe_calibration import CalibrationSettings
from streetscan.calibration.recalibration import is_accepted, pixels_in_force
from streetscan.io.tables import read_csv
from streetscan.localization.settings import build

# Metric of evaluate_reconstruction to row and metric of the thesis' single figures.
_TEXT = {
    "n_sparse": ("sfm_sparse", "n_points"), "n_dense": ("sfm_dense", "n_points"), "projection_error": ("sfm_reprojection", "error"),
}  # fmt: skip
_PICTURES = {
    "images": "Images", "sparse": "Sparse", "dense": "Dense", "masks": "Moving", "dynamic": "Moving in 3-D", "points": "Points",
    "features": "Their features", "errors": "Errors x 10",
}  # fmt: skip

_CALIBRATION_PICTURES = {
    "overlay": "Projected", "overlay_initial": "Projected by the calibration before", "overlay_before": "Projected, by objects alone",
    "overlay_raw": "Projected, moving things left in", "overlay_place": "Projected, from where ICP begins",
    "overlay_curves": "Projected, after the curves", "matched": "Matched objects",
    "aligned": "Aligned", "aligned_start": "Before anything is known", "aligned_raw": "Aligned by objects, moving things left in",
    "aligned_objects": "Aligned by objects", "aligned_curves": "Aligned by ICP and curves",
    "lidar_objects": "Objects of the lidar", "sfm_objects": "Objects of the images", "lidar_pillars": "Pillars of the lidar",
    "sfm_pillars": "Pillars of the images", "lidar_shapes": "Shapes of the lidar", "sfm_shapes": "Shapes of the images",
    "curves": "Control curves",
}  # fmt: skip
# Stage to row of Table 4.2, which is of the slow set.
_STEPS = {
    "objects_raw": "oba_raw",
    "objects": "oba_dynamic_filtered",
    "curves": "icp_nurbs",
    "place": "place",
    "icp": "icp",
    "motion": "motion",
    "edges": "edges",
}
# Keyframes that have a step, beside those its errors are of.
_N_STAGE = "n_with_stage"
# Voxels of a cloud to whose they are; the thesis' figure is one for both.
_VOXELS = {"n_lidar_voxels": "proposed", "n_sfm_voxels": "proposed_camera"}
_PIXELS = ("x_mean", "x_deviation", "y_mean", "y_deviation")
_ALL = "all_drives"


def reconstruction_scores(paths: Sequence[str]) -> list[dict]:
    """Rows of the tidy scores: one row per drive in the table `reconstruction`, and the thesis' single figures.

    Args:
        paths: `evaluate_reconstruction/<drive>/scores.csv`, one per drive.
    """
    rows = []
    for path in paths:
        drive = Path(path).parent.name
        found = read_csv(path, ("metric", "value", "unit", "n"), "evaluate_reconstruction")
        found["unit"] = found["unit"].fillna("")
        for r in found.to_dict("records"):
            rows.append(make_score("reconstruction", drive, "", r["metric"], r["value"], r["unit"], r["n"], drive, "sfm"))
            if r["metric"] in _TEXT:
                row, metric = _TEXT[r["metric"]]
                rows.append(make_score("nagy_text", row, "proposed", metric, r["value"], r["unit"], r["n"], drive, "sfm"))
    return rows


def detection_scores(paths: Sequence[str]) -> list[dict]:
    """Rows of the tidy scores: what could move, found in images and lidar frames, per drive and class.

    Args:
        paths: `evaluate_detections/<drive>/scores.csv`.
    """
    rows = []
    for path in paths:
        drive = Path(path).parent.name
        for r in read_csv(path, ("sensor", "class", "metric", "value", "unit", "n"), "evaluate_detections").to_dict("records"):
            row = f"{drive}/{r['class']}"
            # What n counts differs from metric to metric; evaluate_detections has each.
            rows.append(make_score("detection", row, "", r["metric"], r["value"], r["unit"], dataset=drive, method=r["sensor"]))
    return rows


def draw_reconstructions(models: Sequence[str]) -> list[Section]:
    """A section per drive with the pictures of its keyframes.

    Args:
        models: folders of reconstruct_keyframe, `<drive>/<keyframe>/model`, one per keyframe.
    """
    sections, keyframes = [], [Path(path).parts[-3:-1] for path in models]
    for drive in dict.fromkeys(d for d, _ in keyframes):
        parts = []
        for folder, (of, keyframe) in zip(map(Path, models), keyframes, strict=True):
            files = [(name, folder / f"{kind}.png") for kind, name in _PICTURES.items() if (folder / f"{kind}.png").is_file()]
            if of == drive and files:
                who = f"keyframe {keyframe} of {title(drive)}"
                caption = f"{who.capitalize()}: images, clouds from behind and above the camera, points and the features that saw them."
                gallery = Gallery(f"keyframe-{drive}-{keyframe}", [(name, embed(path, f"{name}, {who}")) for name, path in files], caption)
                parts.append(Part(f"reconstructed-{drive}-{keyframe}", f"Keyframe {keyframe}", "", [gallery]))
        if parts:
            sections.append(Section(f"reconstructed-{drive}", f"{title(drive)} from images", "", [], parts))
    return sections


def calibration_scores(paths: Sequence[str]) -> list[dict]:
    """Rows of the tidy scores: Tables 4.1 and 4.2 over all keyframes, one row per drive in the table `calibration`, and one per drive whose
    camera was moved in the table `mount_shift`. How bad accepted keyframes are at their worst is in the table `calibration_worst`, how
    many have which status in `calibration_status`.

    Args:
        paths: `evaluate_calibration/<drive>/scores.csv`, one per drive.
    """
    rows, pixels, voxels = [], [], []
    for path in paths:
        drive = Path(path).parent.name
        found = read_csv(path, ("set", "stage", "metric", "value", "unit", "n"), "evaluate_calibration")
        found = found.astype({"set": object, "stage": object}).fillna({"set": "", "stage": "", "unit": ""})
        is_both = {"slow", "fast"} <= set(found["set"])
        is_moved = bool((found["metric"].eq("noticed_after") & found["n"].gt(0)).any())
        for r in found.to_dict("records"):
            figure = r["value"], r["unit"], r["n"], drive
            if r["stage"] == "final":
                of, metric = ("proposed_all", r["metric"][4:]) if r["metric"].startswith("all_") else ("proposed", r["metric"])
                if metric in _PIXELS:
                    pixels.append((("nagy_4_1", of, r["set"], metric), *figure, "final"))
                row = f"{drive}/{r['set']}" if is_both else drive
                rows.append(make_score("calibration", row, "", r["metric"], *figure, "final"))
            elif r["stage"] in _STEPS and r["set"] == "slow" and r["metric"] in (*_PIXELS, _N_STAGE):
                pixels.append((("nagy_4_2", _STEPS[r["stage"]], "", r["metric"]), *figure, r["stage"]))
            elif r["stage"] == "worst":
                rows.append(make_score("calibration_worst", drive, "", r["metric"], *figure, "final"))
            elif r["stage"] == "status":
                rows.append(make_score("calibration_status", drive, "", r["metric"], *figure, "keyframes"))
            elif r["metric"] in _VOXELS:
                voxels.append((("nagy_text", "sparse_voxels", _VOXELS[r["metric"]], "n_voxels"), *figure, "keyframes"))
            elif r["stage"] in ("", "drive"):
                rows.append(make_score("calibration", drive, "", r["metric"], *figure, r["stage"] or "keyframes"))
            elif r["stage"] == "shift" and is_moved:
                rows.append(make_score("mount_shift", drive, "", r["metric"], *figure, r["stage"]))
    return rows + _pool_shares(rows) + _pool(pixels) + _pool(voxels)


def gate_scores(errors: Sequence[str], transforms: Sequence[str], settings: Mapping) -> list[dict]:
    """Rows of the table `calibration_gates`: how the gates treat right and wrong keyframes of all drives.

    Args:
        errors, transforms: `evaluate_calibration/<drive>/errors.csv` and transforms.csv, one of each per drive.
        settings: keys of CalibrationSettings the keyframes were judged by.
    """
    if not errors:
        return []
    q = build(CalibrationSettings, settings, "calibrate_keyframe.settings").quality
    limits = {"median_distance_m": q.max_distance_m, "sigma_x_px": q.max_sigma_px, "edge_margin_px": q.min_edge_margin_px}
    tables = (
        pd.concat([read_csv(p, ("keyframe",), "evaluate_calibration").assign(drive=Path(p).parent.name) for p in paths], ignore_index=True)
        for paths in (errors, transforms)
    )
    rows, dataset = [], _common([Path(p).parent.name for p in errors])
    for r in limit_gates(*tables, limits).to_dict("records"):
        unit = r["gate"].rsplit("_", 1)[1]
        for metric, value, of, n in (
            ("limit", r["limit"], unit, r["n_good"]), ("limit_95", r["limit_95"], unit, r["n_good"]),
            ("good_passed", r["good_passed"], "%", r["n_good"]), ("wrong_passed", r["wrong_passed"], "%", r["n_wrong"]),
        ):  # fmt: skip
            rows.append(make_score("calibration_gates", r["gate"], "", metric, value, of, n, dataset, "keyframes"))
    return rows


def _pool_shares(rows: Sequence[dict]) -> list[dict]:
    """Rows of the shares of accepted keyframes of all drives, where there are several."""
    pooled = []
    for metric in ("accepted", "accepted_open"):
        own = [r for r in rows if (r["table"], r["column"]) == ("calibration", metric)]
        if len(own) > 1:
            share, n = _weigh([r["ours"] for r in own], [r["n"] for r in own])
            pooled.append(make_score("calibration", _ALL, "", metric, share, "%", n, _ALL, "keyframes"))
    return pooled


def _weigh(values: Sequence[float], counts: Sequence[int]) -> tuple[float, int]:
    """The mean over everything that values are means of, and of how much; those of nothing do not count."""
    values, counts = np.array(values, float), np.array(counts, int)
    n = int(counts.sum())
    return (float(np.average(values[counts > 0], weights=counts[counts > 0])) if n else np.nan), n


def _pool(figures: Sequence[tuple]) -> list[dict]:
    """Rows of means over the keyframes of all drives, of (place in a table, value, unit, n, drive, method) of each drive.

    Steps are compared on the same keyframes, so Table 4.2 takes its errors from drives that have every step.
    """
    rows, steps = [], {}
    for (table, step, *_), _, _, n, drive, _ in figures:
        if table == "nagy_4_2" and n:
            steps.setdefault(drive, set()).add(step)
    every = set().union(*steps.values())
    whole = {drive for drive, own in steps.items() if own == every}
    for place in dict.fromkeys(place for place, *_ in figures):
        table, *_, metric = place
        own = [f for f in figures if f[0] == place and (table != "nagy_4_2" or metric == _N_STAGE or f[4] in whole)]
        unit, method = next((unit, method) for p, _, unit, _, _, method in figures if p == place)
        values, drives = [f[1] for f in own], [f[4] for f in own]
        mean, n = _weigh(values, [f[3] for f in own])
        value = float(sum(values)) if metric == _N_STAGE else mean
        rows.append(make_score(*place, value, unit, n, _common(drives), method))
    return rows


def _common(drives: Sequence[str]) -> str:
    """What stands for the data of these drives."""
    return drives[0] if len(drives) == 1 else _ALL


def recalibration_scores(paths: Sequence[str]) -> list[dict]:
    """Rows of the tidy scores: the thesis' range of Fig. 4.12, and in the table `recalibration` a row per drive; rows per tilt, yaw and
    size of the bins are over all drives.

    Args:
        paths: `evaluate_recalibration/<drive>/scores.csv`.
    """
    rows, figures = [], {}
    for path in paths:
        drive = Path(path).parent.name
        for r in read_csv(path, ("set", "metric", "value", "unit", "n"), "evaluate_recalibration").fillna({"set": ""}).to_dict("records"):
            if not r["set"] or len(paths) == 1:
                rows.append(_trial_row(drive, r["set"], r["metric"], r["value"], r["unit"], r["n"]))
            figures.setdefault((r["set"], r["metric"], r["unit"]), []).append((r["value"], r["n"]))
    where = _common([Path(path).parent.name for path in paths])
    for (of, metric, unit), found in figures.items():
        values, counts = zip(*found, strict=True)
        axis, _, kind = metric.partition("_")
        value, n = _weigh(values, counts)
        if kind in _EXTREMES:
            value = float(getattr(pd.Series(values), kind)())
        if len(paths) > 1:
            rows.append(_trial_row(_ALL, of, metric, value, unit, n))
        if not of and kind in ("mean", *_EXTREMES):
            rows.append(make_score("nagy_text", f"recalibration_{kind}", "proposed", f"{axis}_mean", value, unit, n, where, "final"))
    return rows


# Of all drives these are no means; a drive without any has NaN.
_EXTREMES = ("min", "max")


def _trial_row(drive: str, of: str, metric: str, value: float, unit: str, n: int) -> dict:
    return make_score("recalibration", f"{drive}/{of}" if of else drive, "", metric, value, unit, n, drive, "final")


_IN_FORCE = {
    "pixels": "how far static points of the trial's frame are off their true pixels.",
    "mounting": "how far static points fall from where the true mounting has them.",
}


def draw_recalibrations(folder: Path, figures: Sequence[str], trials: Sequence[str]) -> list[Section]:
    """A section with what is in force before and after the trials of all drives, and Fig. 4.12 of each.

    Args:
        folder: for figures.
        figures, trials: `evaluate_recalibration/<drive>/trials.png` and `trials.csv`.
    """
    if not figures:
        return []
    asked = ("status", "all_x_px", "all_y_px", "in_force_x_px", "in_force_y_px", "mounting_px", "in_force_mounting_px")
    of_all = pd.concat([read_csv(path, asked, "evaluate_recalibration") for path in trials])
    accepted, shown = of_all[is_accepted(of_all)], []
    is_replaced = (accepted["status"] == "ok").to_numpy()
    for name, told in _IN_FORCE.items():
        before, after = (of.to_numpy() for of in pixels_in_force(accepted, name == "mounting"))
        figure = draw.before_and_after(before, after, is_replaced, "pixels off")
        shown.append(save_picture(figure, folder, f"in_force_{name}", f"Accepted trials of all drives, before and after: {told}"))
    caption = "mean difference from the true pixels of all static points, calibration by calibration (Fig. 4.12); a gap: refused."
    shown += [embed(path, f"{title(Path(path).parent.name)}: {caption}") for path in figures]
    return [Section("recalibrated", "Calibrated again and again", "", shown)]


def draw_calibrations(folders: Sequence[str], summaries: Sequence[str], settings: Mapping, detected: Sequence[str] = ()) -> list[Section]:
    """A section per drive with the verdicts and pictures of its keyframes, and what each check found.

    Args:
        folders, summaries: of calibrate_keyframe, `<drive>/<keyframe>/pictures` and summary.csv, one of each per keyframe.
        settings: keys of CalibrationSettings they were calibrated by.
        detected: of detect_dynamic, `<drive>/pictures`, one per drive.
    """
    boxes = {Path(path).parent.name: Path(path) for path in detected}
    asked = build(CalibrationSettings, settings, "calibrate_keyframe.settings")
    sections, keyframes = [], [Path(path).parts[-3:-1] for path in folders]
    for drive in dict.fromkeys(d for d, _ in keyframes):
        parts = []
        for folder, summary, (of, keyframe) in zip(map(Path, folders), summaries, keyframes, strict=True):
            if of != drive:
                continue
            row = read_csv(summary, ("status", "reason"), "calibrate_keyframe").iloc[0]
            reason = "" if pd.isna(row.reason) else row.reason
            verdict = f"{row.status}{f': {reason}' if reason else ''}"
            who = f"keyframe {keyframe} of {title(drive)}"
            files = [(name, folder / f"{kind}.png") for kind, name in _CALIBRATION_PICTURES.items() if (folder / f"{kind}.png").is_file()]
            if files and of in boxes and (boxes[of] / f"{keyframe}.png").is_file():
                files.append(("Found moving things", boxes[of] / f"{keyframe}.png"))
            caption = f"{who.capitalize()} ({verdict}): points of the lidar red nearby, green far off, those of matched objects blue."
            shown = [Gallery(f"calibrated-{drive}-{keyframe}-g", [(name, embed(path, f"{name}, {who}")) for name, path in files], caption)]
            # A keyframe without clouds was not calibrated: there is nothing it was judged by.
            checks = checks_of(row, asked) if files else []
            heading = f"Keyframe {keyframe}: {verdict}"
            parts.append(Part(f"calibrated-{drive}-{keyframe}", heading, "", shown if files else [], checks=checks))
        sections.append(Section(f"calibrated-{drive}", f"Camera and lidar of {title(drive)}", HOW_TO_READ, [], parts))
    return sections


def runtime_scores(models: Sequence[str], calibrations: Sequence[str]) -> list[dict]:
    """Rows of the tidy scores: the seconds of each stage in the table `calibration_time`, and of all beside the thesis' three minutes.

    Args:
        models, calibrations: summary.csv of reconstruct_keyframe and of calibrate_keyframe, `<drive>/<keyframe>/summary.csv`, one of each
            per keyframe.
    Returns:
        medians over the keyframes that came to a stage; of all stages over those that were accepted, since others stop early.
    """
    files = (models, "reconstruct_keyframe", "densification_s"), (calibrations, "calibrate_keyframe", "quality_s")
    steps = [[read_csv(path, ("status", last), step).iloc[0] for path in paths] for paths, step, last in files]
    drives = list(dict.fromkeys(Path(path).parts[-3] for path in calibrations))
    dataset = _common(drives)
    rows, totals = [], 0.0
    for name, found in zip(("reconstruction", "calibration"), steps, strict=True):
        table = pd.DataFrame([{k: v for k, v in row.items() if k.endswith("_s")} for row in found], dtype=float)
        for column in table:
            seconds = table[column].dropna()
            if len(seconds):
                rows.append(_time_row(f"{name}/{column.removesuffix('_s')}_stage", seconds, dataset))
        totals = totals + table.sum(axis=1)
    if rows:
        accepted = totals[[row["status"] == "ok" for row in steps[1]]]
        rows.append(_time_row("all_stages", accepted, dataset))
        rows.append(make_score("nagy_text", "calibration", "proposed", "time", _median(accepted), "s", len(accepted), dataset, "keyframes"))
    return rows


def _time_row(row: str, seconds: pd.Series, dataset: str) -> dict:
    return make_score("calibration_time", row, "", "time", _median(seconds), "s", len(seconds), dataset, "keyframes")


def _median(values: pd.Series) -> float:
    return float(values.median()) if len(values) else np.nan


def draw_keyframes(folder: Path, inputs: Mapping[str, Sequence[str]], settings: Mapping) -> list[Section]:
    """The sections of `models`, `calibrated` with their `verdicts` under `settings`, and `recalibration_figures`, `recalibration_trials`;
    what is drawn goes into a folder.
    """
    of_keyframes = draw_reconstructions(inputs["models"]) + draw_calibrations(
        inputs["calibrated"], inputs["verdicts"], settings, inputs["detected"]
    )
    return of_keyframes + draw_recalibrations(folder, inputs["recalibration_figures"], inputs["recalibration_trials"])


def all_scores(inputs: Mapping[str, Sequence[str]], settings: Mapping) -> list[dict]:
    """Rows of the tidy scores of `reconstructions`, `detections`, `calibrations` and `recalibrations`, each of the step of its name, of
    the time that `model_summaries` and `verdicts` tell, and of the gates of `settings` over `calibration_errors` and
    `calibration_transforms`.
    """
    of_images = reconstruction_scores(inputs["reconstructions"]) + detection_scores(inputs["detections"])
    of_keyframes = calibration_scores(inputs["calibrations"]) + runtime_scores(inputs["model_summaries"], inputs["verdicts"])
    of_keyframes += gate_scores(inputs["calibration_errors"], inputs["calibration_transforms"], settings)
    return of_images + of_keyframes + recalibration_scores(inputs["recalibrations"])
