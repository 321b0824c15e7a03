"""The toy keyframe calibrated again with its lidar turned, and with other bins of the vote."""

import numpy as np
import pandas as pd

from scripts import evaluate_recalibration
from streetscan.benchmarks.calibrations import draw_recalibrations, recalibration_scores

BINS = [{"turn_step_deg": 0.25, "step_m": 0.2}, {"turn_step_deg": 1.0, "step_m": 0.8}]


def test_turned_lidars_are_calibrated_alike(tmp_path, toy_inputs, detectors):
    folder = tmp_path / "evaluate_recalibration" / "my_drive"
    outputs = {name: str(folder / f"{name}.csv") for name in ("trials", "sizes", "scores")} | {"figure": str(folder / "trials.png")}
    inputs = {name: str(toy_inputs[f"{name}_path"]) for name in ("drive", "keyframes", "poses")}
    settings = {"final": "motion"}
    # A detector that believes nothing marks nothing.
    nothing = detectors["lidar_detector"] | {"choice": {"min_score": 1.0}}
    evaluate_recalibration.main(
        **inputs, truth=str(toy_inputs["drive_path"].parent / "truth"), models=[str(toy_inputs["model_folder"])],
        lidar_files=detectors["lidar_files"], lidar_detector=nothing, margin_m=0.1, foot_m=0.1, n_threads=1, seed=4,
        settings=settings, n_trials=2, max_step=0, max_tilt_deg=3.0, max_in_force_deg=0.02, max_in_force_m=0.002, bins=BINS, **outputs,
    )  # fmt: skip
    trials = pd.read_csv(outputs["trials"])
    # In force is as good as the truth, which nothing is better than.
    assert trials["status"].tolist() == ["not_better", "not_better"]
    np.testing.assert_allclose(trials["in_force_m"] / trials["in_force_deg"], 0.1, rtol=0.1)
    assert trials["in_force_deg"].between(0, 0.02, inclusive="neither").all()
    assert (trials[["in_force_x_px", "in_force_y_px"]] < 1.5).all().all()
    assert (trials["in_force_mounting_px"] < 0.5).all()
    assert trials["mounting_px"].between(0.01, 1.5).all()
    assert trials["yaw_deg"].abs().max() > 20
    assert (trials["tilt_deg"] <= 3).all()
    assert (trials[["x_px", "y_px"]] < 1.5).all().all()
    assert (trials["rotation_deg"] < 0.2).all()
    assert (trials["translation_m"] < 0.05).all()
    bins = pd.read_csv(outputs["sizes"])
    assert bins["is_found"].all()
    assert bins["turn_step_deg"].tolist() == [0.25, 1.0]
    rows = pd.DataFrame(recalibration_scores([outputs["scores"]]))
    beside = rows[rows.table == "nagy_text"].set_index(["row", "column"])
    assert beside.loc[("recalibration_max", "proposed x_mean"), "paper"] == "1.8"
    assert beside.loc[("recalibration_max", "proposed x_mean"), "ours"] < 1.5
    assert {"my_drive", "my_drive/bins 0.25 deg 0.2 m"} <= set(rows.row)
    assert (folder / "trials.png").stat().st_size > 5000
    (section,) = draw_recalibrations(tmp_path / "figures", [outputs["figure"]], [outputs["trials"]])
    assert len(section.figures) == 3
    assert {p.name for p in (tmp_path / "figures").glob("*.svg")} == {"in_force_pixels.svg", "in_force_mounting.svg"}
