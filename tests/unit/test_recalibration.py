"""Draws of trials, and what is counted of them."""

import numpy as np
import pandas as pd
import pytest

from streetscan.calibration.recalibration import BIN_COLUMNS, TRIAL_COLUMNS, draw_trials, summarize_trials
from streetscan.geometry import invert, rotation_angle, rpy_of_transform, transform


def test_trials_are_spread_over_keyframes_and_repeat():
    trials = list(draw_trials(100, [0, 2, 5], 2, 4.0, 1.0, 0.2, seed=3))
    assert [t.keyframe for t in trials[:4]] == [0, 2, 5, 0]
    assert {t.frame_step for t in trials} == {-2, -1, 0, 1, 2}
    assert max(t.tilt_deg for t in trials) <= 4
    assert max(t.rpy_deg[2] for t in trials) > 150
    assert list(draw_trials(100, [0, 2, 5], 2, 4.0, 1.0, 0.2, seed=3)) == trials
    np.testing.assert_allclose(np.degrees(rpy_of_transform(trials[7].T_turned_lidar)), trials[7].rpy_deg)


def test_without_a_cloud_there_are_no_trials():
    assert list(draw_trials(10, [], 1, 1.0, 1.0, 0.2, seed=0)) == []
    scores = summarize_trials(pd.DataFrame(columns=TRIAL_COLUMNS), pd.DataFrame(columns=BIN_COLUMNS)).set_index("metric")
    assert scores.loc["accepted", "n"] == 0
    assert np.isnan(scores.loc["accepted", "value"])


def test_refused_trials_count_and_have_no_errors():
    rows = [("ok", 1.0, 0.5, 1.0, 100.0, 0.1), ("ok", 2.0, 1.0, 4.0, 100.0, 1.5), ("no_match", np.nan, np.nan, 4.5, -10.0, np.nan)]
    trials = pd.DataFrame(rows, columns=["status", "all_x_px", "all_y_px", "tilt_deg", "yaw_deg", "rotation_deg"])
    trials = trials.reindex(columns=[*TRIAL_COLUMNS]).assign(x_px=trials["all_x_px"], y_px=trials["all_y_px"], translation_m=0.1)
    bins = pd.DataFrame({
        "keyframe": ["00", "01"], "turn_step_deg": 0.25, "step_m": 0.2, "is_found": [True, False], "rotation_deg": [0.5, 90.0],
        "translation_m": [0.1, 9.0],
    })  # fmt: skip
    scores = summarize_trials(trials, bins).set_index(["set", "metric"])["value"]
    assert scores["", "accepted"] == pytest.approx(200 / 3)
    assert (scores["", "x_min"], scores["", "x_mean"], scores["", "x_max"]) == (1.0, 1.5, 2.0)
    assert scores["tilt 0 to 2.5 deg", "accepted"] == 100
    assert scores["tilt 2.5 to 5 deg", "accepted"] == 50
    # The second is accepted and turned by more than a degree.
    assert scores["", "right"] == scores["", "ok_but_wrong"] == pytest.approx(100 / 3)
    assert (scores["tilt 0 to 2.5 deg", "right"], scores["tilt 2.5 to 5 deg", "right"]) == (100, 0)
    assert (scores["yaw 90 to 135 deg", "accepted"], scores["yaw 90 to 135 deg", "right"]) == (100, 50)
    assert scores["yaw -45 to 0 deg", "accepted"] == 0
    assert scores["bins 0.25 deg 0.2 m", "failed"] == 50
    assert scores["bins 0.25 deg 0.2 m", "rotation"] == 0.5


def test_what_is_in_force_is_off_by_what_was_drawn():
    trials = list(draw_trials(400, [0], 0, 0.0, 2.0, 0.3, seed=1))
    true = transform([0.3, -1.0, 0.2], np.radians([-90, 0, -90]))
    off = np.array([t.put_in_force(true) @ invert(true) for t in trials])
    turned, moved = np.degrees(rotation_angle(off)), np.linalg.norm(off[:, :3, 3], axis=1)
    # One size for both, to the limits; every other of the squares is below a quarter.
    np.testing.assert_allclose(turned / 2.0, moved / 0.3, atol=1e-6)
    assert 1.9 < turned.max() <= 2.0
    assert 0.35 < np.median(turned) < 0.65
    assert np.abs(np.array([t.error for t in trials]).mean(axis=0)).max() < 0.1


def test_what_is_in_force_afterwards_is_counted_by_how_wrong_it_was():
    rows = [
        ("not_better", 0.05, 1.0, 2.0),
        ("ok", 0.05, 1.0, 1.5),
        ("ok", 1.5, 30.0, 2.0),
        ("not_better", 1.5, 20.0, 3.0),
        ("no_match", 0.3, 9.0, np.nan),
    ]
    trials = pd.DataFrame(rows, columns=["status", "in_force_deg", "in_force_x_px", "all_x_px"]).reindex(columns=TRIAL_COLUMNS)
    trials = trials.assign(tilt_deg=0.0, yaw_deg=0.0, in_force_y_px=0.0, all_y_px=0.0, in_force_mounting_px=5.0, mounting_px=6.0)
    scores = summarize_trials(trials, pd.DataFrame(columns=BIN_COLUMNS)).set_index(["set", "metric"])
    small, large, every = "in force 0 to 0.1 deg", "in force from 1 deg", "in force"
    assert scores.loc[("", "accepted"), "value"] == 80
    assert scores.loc[(small, "replaced"), ["value", "n"]].tolist() == [50, 2]
    assert scores.loc[(small, "worse"), "value"] == 50
    assert scores.loc[(small, "after"), "value"] == pytest.approx((1.0 + 1.5) / 2)
    assert scores.loc[(large, "worse"), "value"] == 0
    assert scores.loc[(large, "before"), "value"] == 25
    assert scores.loc[(large, "after"), "value"] == 11
    assert scores.loc[(every, "replaced"), ["value", "n"]].tolist() == [50, 4]
    # As mounted each new one is worse.
    assert scores.loc[(every, "mounting_worse"), "value"] == 50
    assert scores.loc[(every, "mounting_after"), "value"] == 5.5
    assert "in force 0.25 to 0.5 deg" not in scores.index.get_level_values("set")
