"""Why a keyframe's calibration was believed or refused: what each check found, and what it asks.

The checks need no truth. They are made by calibrate_keyframe, which writes what they found; here they are laid beside their limits.
"""

from collections.abc import Mapping

import pandas as pd

from streetscan.benchmarks.report import Check
from streetscan.benchmarks.tables import format_number
from streetscan.calibration.keyframe_calibration import CalibrationSettings
from streetscan.calibration.quality import SURE, QualitySettings, judge_gain

# What the reader of a calibration should know of its verdict.
HOW_TO_READ = (
    "How to know that a calibration is right, without truth: the objects of lidar and camera matched under it must lie on the camera's "
    "surfaces, what the clouds leave open across the image must be small, image edges must lie where the lidar sees the sides of things, "
    "nearer than when the calibration is turned, no other place may fit as well, and the calibration in force must "
    "fit worse. Beside it, look at the picture Projected: blue points belong on their objects, and depths change where the image has an "
    "outline. Why one that is ok may still be worse than the calibration before it: no check objecting is not the same as being right. "
    "Sides of things tell a turn to the left or right, hardly one up or down, which rests on the ground in both clouds. Smooth walls "
    "leave open where along the street the lidar is. Equal things at equal distances fit one place further on, too. An error that both "
    "clouds share, as of the camera's distortion or of a time stamp, is seen by nothing here, and the deviation left open holds noise "
    "alone, no such error. Where truth is known, the tables of calibrations say how often an accepted one is wrong."
)


def checks_of(row: Mapping, settings: CalibrationSettings) -> list[Check]:
    """The checks of a keyframe, in the order they are made.

    Args:
        row: of calibrate_keyframe's summary; a figure that is missing or NaN was not reached, or there is nothing to compare with.
        settings: it was calibrated by.
    """
    a, q = settings.alignment, settings.quality
    least, most = _limit(row, at_least=True), _limit(row, at_least=False)
    lines = [
        least("Overlap of the clouds", "overlap", a.min_overlap, "fraction"),
        _told(row, "Points of the lidar that ICP laid on the camera's surfaces", "n_icp", ""),
        _told(row, "Scale ICP gave the camera's cloud", "scale", "fraction"),
        least("Matched objects", "n_matched", q.min_objects, ""),
        most("Median distance of matched objects from the camera's surfaces", "median_distance_m", q.max_distance_m, "m"),
        most("Deviation that clouds and way leave open across the image", "sigma_x_px", q.max_sigma_px, "px"),
        _told(row, "... and up and down", "sigma_y_px", "px"),
        most("Way of the lidar when the scale is left to the clouds", "free_shift_m", q.max_free_shift_m, "m"),
        _told(row, "... and that scale", "free_scale", "fraction"),
        least("Edges: how much nearer than with the camera turned", "edge_margin_px", q.least_margin_px(row.get("n_shots", 1)), "px"),
        _told(row, "Edges: distance under this calibration", "edge_px", "px"),
        _told(row, "Edges: distance under the calibration in force", "edge_before_px", "px"),
        most("Other places that fit as well", "n_rivals", 0, ""),
        *_better(row, q),
        _told(row, "Lidar's way past the camera's", "way_off_deg", "deg"),
        _told(row, "Error of the camera's way that clouds and the lidar's way find", "bend_icp_deg", "deg"),
        _told(row, "... that edges find beside it", "bend_found_deg", "deg"),
        _told(row, "... and that was corrected, since they are sure of it", "bend_deg", "deg"),
    ]
    return [line for line in lines if line is not None]


def _limit(row: Mapping, at_least: bool):
    sign, word = (1, "at least") if at_least else (-1, "at most")

    def check(name: str, figure: str, limit: float, unit: str) -> Check:
        value = _value(row, figure)
        verdict = "" if pd.isna(value) else "passes" if sign * (value - limit) >= 0 else "fails"
        return Check(name, f"{word} {_text(limit, unit)}", _found(value, unit), verdict)

    return check


def _told(row: Mapping, name: str, figure: str, unit: str) -> Check | None:
    """What is told and refuses nothing; None where there is nothing."""
    value = _value(row, figure)
    return None if pd.isna(value) else Check(name, "", _text(value, unit), "")


def _better(row: Mapping, q: QualitySettings) -> list[Check]:
    """What the clouds gain over the calibration in force, and what edges kept for the check do."""
    names = "Clouds: gain over the calibration in force", "Edges: gain over the calibration in force"
    f = {figure: _value(row, figure) for figure in ("gain_m", "gain_std_m", "edge_gain_px", "edge_gain_std_px")}
    if pd.isna(f["gain_m"]):
        return [Check(names[0], "none is in force to be better than", "", "")]
    bend, n_common = _value(row, "bend_deg"), _value(row, "n_common_edges")
    says = judge_gain(f | {"bend_deg": 0.0 if pd.isna(bend) else bend, "n_common_edges": n_common}, q)
    judged = {sensor: "passes" if is_gain else "fails" for sensor, is_gain in says.items()}
    noise, least = _text(SURE * f["edge_gain_std_px"], "px"), _text(max(q.min_gain_m, SURE * f["gain_std_m"]), "m")
    clouds = f"at least {least}" if "clouds" in judged else "no say: edges corrected its way, or see another camera"
    edges = f"no loss beyond {noise}" if "clouds" in judged else f"above {noise}"
    of_clouds = Check(names[0], clouds, _text(f["gain_m"], "m"), judged.get("clouds", ""))
    if "edges" not in judged:
        return [of_clouds, Check(names[1], "no say: none is in view under both", "", "")]
    return [of_clouds, Check(names[1], edges, _text(f["edge_gain_px"], "px"), judged["edges"])]


def _value(row: Mapping, figure: str) -> float:
    value = row.get(figure)
    return float("nan") if value is None or value == "" else float(value)


def _found(value: float, unit: str) -> str:
    return "not reached" if pd.isna(value) else _text(value, unit)


def _text(value: float, unit: str) -> str:
    # Distances of clouds are centimetres: two digits of a metre would hide them.
    text = f"{value:.3f}" if unit == "m" else format_number(value, unit)
    return text + {"fraction": "", "deg": "°", "": ""}.get(unit, f" {unit}")
