"""Keyframes and drives compared with the place the camera truly had, and how it was noticed that it was moved."""

import math

import numpy as np
import pandas as pd
import pytest

from streetscan.calibration.calibration_evaluation import (
    COLUMNS,
    HARD_SHARE,
    TRANSFORM_COLUMNS,
    TruePixels,
    limit_gates,
    score_keyframe,
    score_transform,
    summarize_errors,
    times_of_images,
)
from streetscan.calibration.drive_calibration import KeyframeResult, follow_drive
from streetscan.calibration.keyframes import Keyframe
from streetscan.calibration.linear_projection import project_linear
from streetscan.geometry import apply, transform

T_BEFORE = np.array([[0.0, -1, 0, 0.1], [0, 0, -1, -0.2], [1, 0, 0, -0.4], [0, 0, 0, 1]])
KNOCK = transform([0.03, 0, 0], (0, 0, np.radians(0.5)))
STILL = {"T_camera_lidar": T_BEFORE.tolist(), "time_offset_s": 0.004}
SHIFTED = STILL | {"shift": {"from_image_time_ns": 5000, "T_camera_lidar": (KNOCK @ T_BEFORE).tolist()}}


def shift_scores(extrinsics: dict, statuses: list[str], is_shifted: list[bool], in_force: list[int]) -> pd.DataFrame:
    """Scores of keyframes at 1000, 2000, ... ns; that of number k is off by k tenths of a degree and k centimetres."""
    transforms = []
    for k, status in enumerate(statuses):
        time_ns = 1000 * (k + 1)
        true = KNOCK @ T_BEFORE if "shift" in extrinsics and time_ns >= 5000 else T_BEFORE
        T = true @ transform(rpy_rad=(0, 0, np.radians(0.1 * k)))
        T[0, 3] += 0.01 * k
        transforms.append(score_transform(f"{k:02d}", status, T.tolist() if status == "ok" else None, extrinsics, time_ns))
    transforms.append(score_transform("drive", "ok", (KNOCK @ T_BEFORE).tolist(), extrinsics, offset_s=0.005))
    history = pd.DataFrame({"is_shifted": is_shifted, "in_force": in_force})
    errors = pd.DataFrame(columns=COLUMNS)
    scores = summarize_errors(errors, pd.DataFrame(transforms, columns=TRANSFORM_COLUMNS), history)
    return scores[scores["stage"].isin(["shift", "drive"])].set_index(["stage", "metric"])


def test_a_shift_is_scored_by_the_keyframes_it_took():
    alarms = [False, True, False, False, False, True, True]
    scores = shift_scores(SHIFTED, ["ok"] * 4 + ["not_matched", "ok", "ok"], alarms, [0, 0, 2, 2, 2, 2, 6])
    values = scores.loc["shift", "value"]
    # Keyframe 4 is the first after the shift, and was refused.
    assert (values["noticed_after"], values["recalibrated_after"], values["false_alarms"]) == (2, 3, 1)
    assert (values["rotation"], values["translation"]) == pytest.approx((0.6, 0.06))
    assert scores.loc["shift", "n"].to_dict() == {
        "noticed_after": 3, "recalibrated_after": 3, "rotation": 3, "translation": 3, "false_alarms": 4,
    }  # fmt: skip
    # The drive is compared with the place at its end.
    assert scores.loc[("drive", "rotation"), "value"] == pytest.approx(0, abs=1e-5)
    assert scores.loc[("drive", "translation"), "value"] == pytest.approx(0, abs=1e-9)
    assert scores.loc[("drive", "offset_error"), "value"] == pytest.approx(0.001)


def test_a_shift_that_nobody_noticed_has_no_numbers():
    values = shift_scores(SHIFTED, ["ok"] * 6, [False] * 6, [0] * 6).loc["shift", "value"]
    assert values.drop("false_alarms").isna().all()
    assert values["false_alarms"] == 0


def test_a_calibration_that_was_refused_is_never_in_force():
    values = shift_scores(SHIFTED, ["not_matched"] * 6, [False] * 6, [-1] * 6).loc["shift", "value"]
    assert np.isnan(values["recalibrated_after"])


def test_without_a_shift_every_alarm_is_false():
    scores = shift_scores(STILL, ["ok"] * 6, [False, False, True, False, True, False], [0, 1, 1, 1, 4, 4])
    assert scores.loc["shift", "value"].drop("false_alarms").isna().all()
    assert scores.loc["shift", "n"].drop("false_alarms").eq(0).all()
    assert scores.loc[("shift", "false_alarms"), ["value", "n"]].tolist() == [2, 6]
    assert scores.loc[("drive", "rotation"), "value"] == pytest.approx(0.5)


def test_a_drives_own_history_is_scored():
    """Exact keyframes of a still lidar: the first after the knock is noticed; with the second, which agrees, the calibration changes."""
    rng, keyframes, transforms = np.random.default_rng(3), [], []
    for k in range(6):
        T, points, normals = (KNOCK if k >= 4 else np.eye(4)) @ T_BEFORE, rng.uniform(-20, 20, (300, 3)), rng.normal(size=(300, 3))
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        keyframes.append(KeyframeResult(k, "ok", T, None, np.c_[points, apply(T, points), normals]))
        transforms.append(score_transform(f"{k:02d}", "ok", T.tolist(), SHIFTED, 1000 * (k + 1)))
    errors, transforms = pd.DataFrame(columns=COLUMNS), pd.DataFrame(transforms, columns=TRANSFORM_COLUMNS)
    values = summarize_errors(errors, transforms, follow_drive(keyframes)).set_index("metric")["value"]
    assert values[["noticed_after", "recalibrated_after", "false_alarms"]].tolist() == [1, 2, 0]
    assert values["rotation"] == pytest.approx(0, abs=1e-5)


def test_a_place_without_images_counts_as_the_one_before_it():
    places = [([100, 101], 102, 101), ([200, 201], 203, None), ([], -1, None), ([], 405, None), ([500], 500, 500)]
    keyframes = [Keyframe(k, lidar_time_ns=lidar, image_times_ns=images) for k, (images, lidar, _) in enumerate(places)]
    assert times_of_images(keyframes, [{"image_time_ns": found} for *_, found in places]) == [101, 200, 200, 405, 500]


def test_the_end_of_a_drive_is_after_every_shift():
    assert score_transform("drive", "ok", None, SHIFTED)["is_after_shift"]
    assert not score_transform("drive", "ok", None, STILL, math.inf)["is_after_shift"]


def of_keyframes(*rows: tuple) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Tables of keyframes of (status, stages with their error in px, rotation_deg) at 20 km/h."""
    errors, transforms = [], []
    for k, (status, stages, rotation_deg) in enumerate(rows):
        for stage, px in stages.items():
            values = {name: px for name in COLUMNS if name.endswith("_px")}
            errors.append(values | {"keyframe": f"{k:02d}", "status": status, "stage": stage, "speed_kmh": 20.0})
        transforms.append({"keyframe": f"{k:02d}", "status": status, "rotation_deg": rotation_deg, "translation_m": 0.1})
    tables = pd.DataFrame(errors, columns=COLUMNS), pd.DataFrame(transforms, columns=TRANSFORM_COLUMNS)
    tables[1]["is_after_shift"] = False
    return tables


def scores_of(*rows: tuple) -> pd.DataFrame:
    history = pd.DataFrame({"is_shifted": [False] * len(rows), "in_force": [-1] * len(rows)})
    return summarize_errors(*of_keyframes(*rows), history).set_index(["set", "stage", "metric"])


def test_stages_are_compared_on_the_same_keyframes():
    scores = scores_of(
        ("ok", {"objects": 9.0, "curves": 2.0, "final": 2.0}, 0.1),
        ("ok", {"objects": 1.0, "final": 1.0}, 0.1),
        ("uncertain", {"objects": 50.0, "curves": 50.0, "final": 50.0}, 9.0),
    )
    slow = scores.loc["slow"]
    assert slow.loc[("objects", "x_mean"), ["value", "n"]].tolist() == [9.0, 1]
    assert slow.loc[("curves", "x_mean"), ["value", "n"]].tolist() == [2.0, 1]
    assert slow.loc[("objects", "n_with_stage"), ["value", "n"]].tolist() == [2, 2]
    assert slow.loc[("curves", "n_with_stage"), ["value", "n"]].tolist() == [1, 2]
    # The outcome itself is of all accepted keyframes.
    assert slow.loc[("final", "x_mean"), ["value", "n"]].tolist() == [1.5, 2]


def test_without_a_keyframe_that_has_every_stage_none_is_compared():
    slow = scores_of(("ok", {"objects": 9.0, "final": 2.0}, 0.1), ("ok", {"icp": 1.0, "final": 1.0}, 0.1)).loc["slow"]
    assert slow.loc[("objects", "x_mean"), "n"] == slow.loc[("icp", "x_mean"), "n"] == 0
    assert np.isnan(slow.loc[("objects", "x_mean"), "value"])


def test_accepted_keyframes_that_are_wrong_are_counted():
    """Of twenty, one is turned and one is off in the image; a refused one does not count."""
    rows = [("ok", {"final": 1.0}, 0.1)] * 18
    rows += [
        ("ok", {"final": 1.0}, 1.2),
        ("ok", {"final": 7.0}, 0.1),
        ("uncertain", {"final": 99.0}, 9),
    ]
    worst = scores_of(*rows).loc[("", "worst"), "value"]
    assert worst["ok_but_wrong"] == pytest.approx(10)
    assert (worst["x_p95"], worst["x_max"], worst["rotation_max"], worst["translation_max"]) == (7.0, 7.0, 1.2, 0.1)


def test_without_truth_no_keyframe_is_called_right_or_wrong():
    errors, transforms = of_keyframes(("ok", {"final": np.nan}, np.nan))
    transforms["translation_m"] = np.nan
    history = pd.DataFrame({"is_shifted": [False], "in_force": [0]})
    assert "worst" not in set(summarize_errors(errors, transforms, history)["stage"])


def test_a_point_behind_the_camera_is_infinitely_wrong():
    """The true camera looks along x; one that looks back has every point behind it."""
    P = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0]])
    points = np.array([[4.0, 1, 0], [5, -2, 1], [8, 0, 1]])
    truth = TruePixels(points, np.zeros(len(points)), project_linear(P, points), np.array([0, 1]), 20.0)
    found = {"stages": {"icp": P.tolist()}, "projection": (-P).tolist(), "status": "ok", "figures": {}}
    errors = pd.DataFrame(score_keyframe(found, 0, truth), columns=COLUMNS)
    assert errors.set_index("stage")["x_px"].to_dict() == {"icp": 0.0, "final": np.inf}
    transforms = pd.DataFrame([score_transform("00", "ok", None, STILL)], columns=TRANSFORM_COLUMNS)
    scores = summarize_errors(errors, transforms, pd.DataFrame({"is_shifted": [False], "in_force": [0]})).set_index(["stage", "metric"])
    assert scores.loc[("worst", "ok_but_wrong"), "value"] == 100
    assert scores.loc[("final", "x_mean"), "value"] == scores.loc[("worst", "x_p95"), "value"] == np.inf


def test_a_frame_without_features_has_no_error_of_them():
    P = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0]])
    truth = TruePixels(np.array([[4.0, 1, 0]]), np.zeros(1), np.zeros((1, 2)), np.empty(0, int), 20.0)
    (row,) = score_keyframe({"stages": {}, "projection": P.tolist(), "status": "ok", "figures": {}}, 0, truth)
    assert np.isnan(row["x_px"])
    assert row["all_x_px"] == 0.25


def test_hard_stretches_are_told_apart():
    """Things that could move fill the image of the third keyframe; of the fourth no mask is known, so that it is on neither kind."""
    errors, transforms = of_keyframes(*((status, {"final": 1.0}, 0.1) for status in ("ok", "uncertain", "far_apart", "ok")))
    history = pd.DataFrame({"is_shifted": [False] * 4, "in_force": [0] * 4})
    assert "accepted_open" not in set(summarize_errors(errors, transforms, history)["metric"])
    errors["movable_share"] = [0.1, HARD_SHARE, 0.4, np.nan]
    scores = summarize_errors(errors, transforms, history).set_index("metric")
    assert scores.loc["accepted", ["value", "n"]].tolist() == [50.0, 4]
    assert scores.loc["accepted_open", ["value", "n"]].tolist() == [50.0, 2]


def test_what_edges_of_a_drive_tell_of_the_camera_s_way_stands_beside_its_transform():
    history = pd.DataFrame({"is_shifted": [], "in_force": []})
    for bend, told in (({"found_deg": 0.3, "std_deg": 0.05}, (0.3, 0.05)), ({"found_deg": None, "std_deg": None}, (np.nan, np.nan))):
        drive = score_transform("drive", "ok", T_BEFORE.tolist(), STILL, bend=bend)
        transforms = pd.DataFrame([drive], columns=TRANSFORM_COLUMNS)
        scores = summarize_errors(pd.DataFrame(columns=COLUMNS), transforms, history).set_index(["stage", "metric"])["value"]
        np.testing.assert_equal((scores["drive", "bend"], scores["drive", "bend_sigma"]), told)


def test_gates_are_held_against_right_and_wrong_keyframes():
    """Of twenty right keyframes one is beyond the limit: with the limit of 95 % nineteen pass; the wrong one passes the distance alone."""
    distances = [0.01 * k for k in range(1, 20)] + [0.5, 0.1]
    errors = pd.DataFrame({"drive": "a", "keyframe": [f"{k:02d}" for k in range(21)], "stage": "final"})
    errors["median_distance_m"], errors["edge_margin_px"] = distances, [1.0] * 20 + [-1.0]
    transforms = errors[["drive", "keyframe"]].assign(rotation_deg=[0.1] * 20 + [0.1], translation_m=[0.1] * 20 + [2.0])
    found = limit_gates(errors, transforms, {"median_distance_m": 0.15, "edge_margin_px": 0.5}).set_index("gate")
    assert found.loc["median_distance_m", ["limit_95", "good_passed", "wrong_passed"]].tolist() == pytest.approx([0.19, 75.0, 100.0])
    assert found.loc["edge_margin_px", ["limit_95", "good_passed", "wrong_passed"]].tolist() == [1.0, 100.0, 0.0]
    assert found[["n_good", "n_wrong"]].iloc[0].tolist() == [20, 1]
    nothing = limit_gates(errors.iloc[:0], transforms.iloc[:0], {"median_distance_m": 0.15})
    assert nothing.iloc[0, 2:5].isna().all()


def test_statuses_are_counted_and_deviations_compared_with_errors():
    errors, transforms = of_keyframes(("ok", {"final": 1.0}, 0.1), ("no_match", {"final": np.nan}, np.nan), ("ok", {"final": 1.0}, 0.1))
    errors["hausdorff_m"], errors["n_lidar_voxels"] = [2.0, 50.0, 4.0], [100, 200, 300]
    drive = score_transform("drive", "ok", T_BEFORE.tolist(), STILL, std={"x_y_z_m": [0.03, 0, 0.04], "turn_deg": [0.1, 0, 0]})
    drive |= {"rotation_deg": 0.05, "translation_m": 0.1}
    transforms = pd.concat([transforms, pd.DataFrame([drive])], ignore_index=True)
    history = pd.DataFrame({"is_shifted": [False] * 3, "in_force": [0] * 3})
    scores = summarize_errors(errors, transforms, history).set_index(["stage", "metric"])
    assert scores.loc["status", "value"].to_dict() == {"ok": 2, "no_match": 1}
    assert scores.loc[("", "hausdorff"), ["value", "n"]].tolist() == [3.0, 2]
    assert scores.loc[("", "n_lidar_voxels"), ["value", "n"]].tolist() == [200, 3]
    assert scores.loc[("drive", "rotation_ratio"), "value"] == pytest.approx(2.0)
    assert scores.loc[("drive", "translation_ratio"), "value"] == pytest.approx(0.5)
