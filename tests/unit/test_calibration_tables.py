"""Reconstructed and calibrated keyframes in the tables and the report."""

import cv2
import numpy as np
import pandas as pd
import pytest

from streetscan.benchmarks.calibrations import (
    calibration_scores,
    draw_reconstructions,
    gate_scores,
    recalibration_scores,
    reconstruction_scores,
    runtime_scores,
)
from streetscan.benchmarks.scores import collect_scores
from streetscan.benchmarks.tables import make_tables
from streetscan.errors import BadInput


def write_scores(folder):
    path = folder / "evaluate_reconstruction" / "my_drive" / "scores.csv"
    path.parent.mkdir(parents=True)
    rows = [("accepted", 50.0, "%", 2), ("n_sparse", 1500, "", 1), ("n_dense", 200000, "", 1), ("projection_error", 0.6, "px", 1)]
    pd.DataFrame(rows, columns=["metric", "value", "unit", "n"]).to_csv(path, index=False)
    return str(path)


def test_our_counts_stand_beside_the_thesis_s(tmp_path):
    rows = pd.DataFrame(reconstruction_scores([write_scores(tmp_path)]))
    beside = rows[rows.table == "nagy_text"].set_index("row")
    assert beside.paper.to_dict() == {"sfm_sparse": "2041", "sfm_dense": "257796", "sfm_reprojection": "1.02"}
    assert beside.ours.to_dict() == {"sfm_sparse": 1500, "sfm_dense": 200000, "sfm_reprojection": 0.6}
    assert rows[rows.table == "reconstruction"].column.tolist() == ["accepted", "n_sparse", "n_dense", "projection_error"]
    tables = make_tables(collect_scores([], {}, rows.to_dict("records")))
    assert tables


def test_a_table_of_something_else_is_refused(tmp_path):
    (tmp_path / "scores.csv").write_text("a\n1\n")
    with pytest.raises(BadInput, match="metric"):
        reconstruction_scores([str(tmp_path / "scores.csv")])


def test_keyframes_with_pictures_have_a_place_in_the_report(tmp_path):
    models = [tmp_path / "my_drive" / f"{k:02d}" / "model" for k in range(2)]
    for model in models:
        model.mkdir(parents=True)
    cv2.imwrite(str(models[0] / "dense.png"), np.zeros((4, 4, 3), np.uint8))
    sections = draw_reconstructions([str(model) for model in models])
    assert [section.parts[0].heading for section in sections] == ["Keyframe 00"]
    assert len(sections[0].parts) == 1
    assert draw_reconstructions([str(models[1])]) == []


def test_calibration_stands_in_both_tables_of_the_thesis(tmp_path):
    path = tmp_path / "evaluate_calibration" / "my_drive" / "scores.csv"
    path.parent.mkdir(parents=True)
    pixels = [("slow", stage, f"{axis}_mean", 1.0, "px", 2) for stage in ("objects", "final") for axis in "xy"]
    turn = [("", "drive", metric, 0.1, "deg", 2) for metric in ("rotation", "rotation_sigma")]
    rows = [("", "", "accepted", 50.0, "%", 4), *pixels, *turn]
    columns = ["set", "stage", "metric", "value", "unit", "n"]
    pd.DataFrame(rows, columns=columns).to_csv(path, index=False)
    found = collect_scores([], {}, calibration_scores([str(path)]))
    ours = found[found.method != ""]
    assert ours.groupby("table").size().to_dict() == {"calibration": 5, "nagy_4_1": 2, "nagy_4_2": 2}
    pd.DataFrame([*rows, ("fast", "final", "x_mean", 2.0, "px", 1)], columns=columns).to_csv(path, index=False)
    both = collect_scores([], {}, calibration_scores([str(path)]))
    assert {"my_drive/slow", "my_drive/fast", "my_drive"} <= set(both[both.table == "calibration"].row)


def test_only_drives_whose_camera_was_moved_stand_in_the_table_of_shifts(tmp_path):
    columns, paths = ["set", "stage", "metric", "value", "unit", "n"], []
    for drive, n_after in (("still", 0), ("moved", 4)):
        paths.append(tmp_path / "evaluate_calibration" / drive / "scores.csv")
        paths[-1].parent.mkdir(parents=True)
        found = [("noticed_after", 1.0 if n_after else np.nan, "keyframes", n_after), ("rotation", 0.1, "deg", n_after)]
        rows = [("", "shift", *row) for row in [*found, ("false_alarms", 0.0, "keyframes", 4)]]
        pd.DataFrame([("slow", "objects", "n_points", 1.0, "", 1), *rows], columns=columns).to_csv(paths[-1])
    rows = pd.DataFrame(calibration_scores([str(path) for path in paths]))
    assert rows[["table", "row"]].drop_duplicates().to_numpy().tolist() == [["mount_shift", "moved"]]
    assert rows["column"].tolist() == ["noticed_after", "rotation", "false_alarms"]
    (table,) = make_tables(collect_scores([], {}, rows.to_dict("records")))
    assert [c.heading for c in table.columns] == ["Noticed after [keyframes]", "Rotation [°]", "False alarms [keyframes]"]
    assert [table.text(0, j) for j in range(3)] == ["1", "0.10", "0"]


def test_drives_are_pooled_in_the_tables_of_the_thesis(tmp_path):
    paths = []
    for drive, value, n in (("a", 1.0, 3), ("b", 2.0, 1)):
        paths.append(tmp_path / "evaluate_calibration" / drive / "scores.csv")
        paths[-1].parent.mkdir(parents=True)
        rows = [("slow", "final", "x_mean", value, "px", n)]
        pd.DataFrame(rows, columns=["set", "stage", "metric", "value", "unit", "n"]).to_csv(paths[-1], index=False)
    found = pd.DataFrame(calibration_scores([str(path) for path in paths]))
    pooled = found[found.table == "nagy_4_1"].iloc[0]
    assert (pooled.ours, pooled.n, pooled.dataset) == (1.25, 4, "all_drives")
    assert found[found.table == "calibration"].row.tolist() == ["a", "b"]


def test_accepted_keyframes_are_counted_over_all_drives_too(tmp_path):
    paths = []
    for drive, share, n, n_open in (("a", 50.0, 4, 2), ("b", 100.0, 1, 0)):
        paths.append(tmp_path / "evaluate_calibration" / drive / "scores.csv")
        paths[-1].parent.mkdir(parents=True)
        rows = [("", "", "accepted", share, "%", n), ("", "", "accepted_open", 100.0 if n_open else np.nan, "%", n_open)]
        pd.DataFrame(rows, columns=["set", "stage", "metric", "value", "unit", "n"]).to_csv(paths[-1], index=False)
    found = pd.DataFrame(calibration_scores([str(path) for path in paths])).set_index(["row", "column"])
    assert found.loc[("all_drives", "accepted"), ["ours", "n"]].tolist() == [60.0, 5]
    assert found.loc[("all_drives", "accepted_open"), ["ours", "n"]].tolist() == [100.0, 2]
    alone = pd.DataFrame(calibration_scores([str(paths[0])]))
    assert alone.row.tolist() == ["a", "a"]


def test_statuses_all_points_voxels_and_gates_have_their_tables(tmp_path):
    folder = tmp_path / "evaluate_calibration" / "a"
    folder.mkdir(parents=True)
    rows = [("slow", "final", "x_mean", 1.0, "px", 2), ("slow", "final", "all_x_mean", 3.0, "px", 2), ("", "status", "ok", 2.0, "", 3)]
    rows += [("", "status", "no_match", 1.0, "", 3), ("", "", "n_lidar_voxels", 9000.0, "", 3)]
    pd.DataFrame(rows, columns=["set", "stage", "metric", "value", "unit", "n"]).to_csv(folder / "scores.csv", index=False)
    found = pd.DataFrame(calibration_scores([str(folder / "scores.csv")])).set_index(["table", "row", "column"])["ours"]
    assert found["nagy_4_1", "proposed_all", "slow x_mean"] == 3.0
    assert found["calibration_status", "a", "ok"] == 2
    assert found["calibration_status", "a", "no_match"] == 1
    assert found["nagy_text", "sparse_voxels", "proposed n_voxels"] == 9000
    errors = {"keyframe": [0, 1], "stage": "final", "median_distance_m": [0.01, 9.0], "sigma_x_px": 1.0, "edge_margin_px": 2.0}
    pd.DataFrame(errors).to_csv(folder / "errors.csv", index=False)
    pd.DataFrame({"keyframe": [0, 1, "drive"], "rotation_deg": 0.1, "translation_m": 0.1}).to_csv(folder / "transforms.csv", index=False)
    gates = gate_scores([str(folder / "errors.csv")], [str(folder / "transforms.csv")], {"quality": {"max_distance_m": 0.05}})
    of_distance = pd.DataFrame(gates).set_index(["row", "column"]).loc["median_distance_m"]
    assert of_distance["ours"].dropna().to_dict() == {"limit": 0.05, "limit_95": 9.0, "good_passed": 50.0}
    assert of_distance.loc["wrong_passed", "n"] == 0
    assert make_tables(collect_scores([], {}, [*calibration_scores([str(folder / "scores.csv")]), *gates]))
    assert gate_scores([], [], {}) == []


def test_trials_of_drives_are_pooled(tmp_path):
    """Means by their counts, extremes as they are; a drive with nothing accepted adds its refusals and no error."""
    paths = []
    for drive, share, least, n_ok in (("a", 75.0, 0.5, 3), ("b", 25.0, 0.9, 1), ("c", 0.0, np.nan, 0)):
        paths.append(tmp_path / "evaluate_recalibration" / drive / "scores.csv")
        paths[-1].parent.mkdir(parents=True)
        rows = [("", "accepted", share, "%", 4), ("", "x_min", least, "px", n_ok), ("", "x_mean", 2 * least, "px", n_ok)]
        rows.append(("tilt 0 to 2.5 deg", "accepted", share, "%", 2))
        pd.DataFrame(rows, columns=["set", "metric", "value", "unit", "n"]).to_csv(paths[-1], index=False)
    found = pd.DataFrame(recalibration_scores([str(path) for path in paths]))
    own = found[found.table == "recalibration"].set_index(["row", "column"])
    assert own.loc[("all_drives", "accepted"), ["ours", "n"]].tolist() == [pytest.approx(100 / 3), 12]
    assert own.loc[("all_drives", "x_min"), ["ours", "n"]].tolist() == [0.5, 4]
    assert own.loc[("all_drives", "x_mean"), "ours"] == pytest.approx((3 * 1.0 + 1.8) / 4)
    assert own.loc[("all_drives/tilt 0 to 2.5 deg", "accepted"), ["ours", "n"]].tolist() == [pytest.approx(100 / 3), 6]
    assert "a/tilt 0 to 2.5 deg" not in own.index.get_level_values("row")
    beside = found[found.table == "nagy_text"].set_index("row")
    assert beside.loc["recalibration_min", ["ours", "paper", "dataset"]].tolist() == [0.5, "1.2", "all_drives"]
    assert make_tables(collect_scores([], {}, found.to_dict("records")))


def test_steps_of_drives_are_compared_on_the_same_keyframes(tmp_path):
    """Drive `b` lacks a step: its keyframes stand beside, and enter no error of Table 4.2; how bad the worst are stands in a table."""
    paths = []
    for drive, value, stages in (("a", 1.0, ("objects", "icp")), ("b", 5.0, ("objects",))):
        paths.append(tmp_path / "evaluate_calibration" / drive / "scores.csv")
        paths[-1].parent.mkdir(parents=True)
        rows = [("slow", s, "x_mean", value, "px", 2) for s in stages] + [("slow", s, "n_with_stage", 3.0, "", 4) for s in stages]
        rows.append(("", "worst", "ok_but_wrong", 25.0, "%", 4))
        pd.DataFrame(rows, columns=["set", "stage", "metric", "value", "unit", "n"]).to_csv(paths[-1], index=False)
    found = pd.DataFrame(calibration_scores([str(path) for path in paths]))
    of_steps = found[found.table == "nagy_4_2"].set_index(["row", "column"])
    assert of_steps.loc[("oba_dynamic_filtered", "x_mean"), ["ours", "n", "dataset"]].tolist() == [1.0, 2, "a"]
    assert of_steps.loc[("oba_dynamic_filtered", "n_with_stage"), "ours"] == 6
    assert of_steps.loc[("icp", "n_with_stage"), "ours"] == 3
    assert found[found.table == "calibration_worst"][["row", "column", "ours"]].to_numpy().tolist() == [
        ["a", "ok_but_wrong", 25.0], ["b", "ok_but_wrong", 25.0],
    ]  # fmt: skip
    assert make_tables(collect_scores([], {}, found.to_dict("records")))


def test_time_is_told_by_stage_over_what_came_to_it(tmp_path):
    """The second keyframe was refused, the third has no clouds: their stages count where they were reached, not the sum."""
    columns = {"densification_s": (60.0, 70.0, np.nan), "quality_s": (1.0, 3.0, np.nan)}
    paths = {name: [] for name in columns}
    for name, seconds in columns.items():
        for k, (status, value) in enumerate(zip(("ok", "far_apart", "no_clouds"), seconds, strict=True)):
            path = tmp_path / name / "my_drive" / f"{k:02d}" / "summary.csv"
            path.parent.mkdir(parents=True)
            pd.DataFrame({"keyframe": [k], "status": status, name: value}).to_csv(path, index=False)
            paths[name].append(str(path))
    rows = runtime_scores(*paths.values())
    found = pd.DataFrame(rows).set_index(["table", "row"])
    assert found.loc[("calibration_time", "reconstruction/densification_stage"), ["ours", "n"]].tolist() == [65.0, 2]
    assert found.loc[("calibration_time", "calibration/quality_stage"), ["ours", "n"]].tolist() == [2.0, 2]
    assert found.loc[("calibration_time", "all_stages"), ["ours", "n"]].tolist() == [61.0, 1]
    assert found.loc[("nagy_text", "calibration"), ["ours", "paper"]].tolist() == [61.0, "<180"]
    assert make_tables(collect_scores([], {}, rows))
    assert runtime_scores([], []) == []
