"""What a keyframe's calibration was judged by, beside the limits, in the report."""

import cv2
import numpy as np
import pandas as pd
import pytest

from streetscan.benchmarks.calibrations import draw_calibrations
from streetscan.benchmarks.report import render_report
from streetscan.benchmarks.scores import SCORE_COLUMNS
from streetscan.benchmarks.verdicts import checks_of
from streetscan.calibration.alignment import AlignmentSettings
from streetscan.calibration.keyframe_calibration import CalibrationSettings
from streetscan.calibration.quality import QualitySettings
from streetscan.errors import BadInput

GOOD = {
    "overlap": 0.3, "n_rivals": 0, "n_matched": 5, "median_distance_m": 0.02, "sigma_x_px": 1.0, "edge_margin_px": 1.0, "edge_px": 2.0,
    "edge_before_px": 3.0, "gain_m": 0.03, "gain_std_m": 0.005, "edge_gain_px": 1.0, "edge_gain_std_px": 0.4,
}  # fmt: skip
SETTINGS = CalibrationSettings(
    alignment=AlignmentSettings(min_overlap=0.1),
    quality=QualitySettings(min_objects=3, max_distance_m=0.04, max_sigma_px=4.0, min_edge_margin_px=0.5),
)


def verdicts(**changes) -> dict[str, str]:
    return {check.name: check.verdict for check in checks_of(GOOD | changes, SETTINGS) if check.verdict}


def test_what_is_good_passes_every_check():
    assert list(verdicts().values()) == ["passes"] * 8


@pytest.mark.parametrize(
    ("change", "part"),
    [
        ({"overlap": 0.05}, "Overlap"), ({"n_rivals": 1}, "Other places"), ({"n_matched": 2}, "Matched"),
        ({"median_distance_m": 0.05}, "Median"), ({"sigma_x_px": 4.5}, "Deviation"), ({"edge_margin_px": 0.4}, "Edges: how much"),
        ({"gain_m": 0.009}, "Clouds: gain"), ({"gain_m": 0.009, "gain_std_m": 0.0}, "Clouds: gain"),
        ({"edge_gain_px": -0.9}, "Edges: gain"),
    ],
)  # fmt: skip
def test_one_that_is_not_fails_its_own_check_alone(change, part):
    (failed,) = [name for name, verdict in verdicts(**change).items() if verdict == "fails"]
    assert failed.startswith(part)


def test_a_limit_that_is_met_exactly_passes():
    assert set(verdicts(median_distance_m=0.04, sigma_x_px=4.0, n_matched=3).values()) == {"passes"}


def test_what_was_not_reached_is_neither_passed_nor_failed():
    found = {check.name: check for check in checks_of({"overlap": 0.05}, SETTINGS)}
    assert [c.verdict for c in found.values() if c.verdict] == ["fails"]
    assert found["Matched objects"].found == "not reached"
    assert "Edges: distance under this calibration" not in found


def test_without_a_calibration_in_force_there_is_nothing_to_be_better_than():
    (line,) = [c for c in checks_of(GOOD | {"gain_m": np.nan}, SETTINGS) if "over the calibration in force" in c.name]
    assert (line.asked, line.found, line.verdict) == ("none is in force to be better than", "", "")


def test_where_edges_corrected_the_way_of_the_camera_they_alone_decide():
    lines = [c for c in checks_of(GOOD | {"bend_deg": 0.4, "gain_m": -0.02}, SETTINGS) if "over the calibration in force" in c.name]
    assert [c.verdict for c in lines] == ["", "passes"]
    assert verdicts(bend_deg=0.4, edge_gain_px=0.7)["Edges: gain over the calibration in force"] == "fails"


def make_keyframe(folder, n_pictures: int):
    """Pictures and summary of a keyframe."""
    (folder / "pictures").mkdir(parents=True)
    names = ("overlay", "overlay_before", "aligned", "aligned_objects", "lidar_objects", "sfm_objects", "lidar_shapes")
    for name in names[:n_pictures]:
        cv2.imwrite(str(folder / "pictures" / f"{name}.png"), np.zeros((4, 4, 3), np.uint8))
    pd.DataFrame([GOOD | {"status": "ok" if n_pictures else "no_clouds", "reason": ""}]).to_csv(folder / "summary.csv", index=False)
    return str(folder / "pictures"), str(folder / "summary.csv")


def test_the_report_tells_what_a_keyframe_was_judged_by_and_shows_every_picture(tmp_path):
    folders, summaries = zip(*(make_keyframe(tmp_path / "my_drive" / f"{k:02d}", n) for k, n in enumerate((7, 0))), strict=True)
    (section,) = draw_calibrations(folders, summaries, {"quality": {"max_sigma_px": 0.5}})
    assert [part.heading for part in section.parts] == ["Keyframe 00: ok", "Keyframe 01: no_clouds"]
    assert section.parts[1].checks == []
    html = render_report({"Run": "try"}, pd.DataFrame(columns=SCORE_COLUMNS), [], [section], "")
    assert '<td class="first">at most 0.50 px</td><td class="worse">fails</td>' in html
    assert "How to know that a calibration is right" in html
    assert html.count("nth-of-type(7):checked") == 1
    assert "nth-of-type(8)" not in html


def test_settings_with_an_unknown_key_are_refused(tmp_path):
    with pytest.raises(BadInput, match="no such key"):
        draw_calibrations([], [], {"qualty": {}})
