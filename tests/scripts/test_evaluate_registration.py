"""evaluate_registration on a tiny drive, with and without true poses."""

import numpy as np
import pandas as pd

from scripts import evaluate_registration

LIMITS = {"max_distance_m": 0.5, "max_angle_deg": 2.0, "drift_length_m": 2.0}


def evaluate(registered_drive, truth_folder, folder, reference):
    made = registered_drive.folder
    evaluate_registration.main(
        truth_folder, made / "poses.csv", [made / "timings.csv", made / "grid_timings.csv"], folder / "scores.csv",
        folder / "trajectory.csv", reference=reference, **LIMITS,
    )  # fmt: skip
    return pd.read_csv(folder / "scores.csv").set_index("metric"), pd.read_csv(folder / "trajectory.csv")


def test_scores_and_path(registered_drive, tmp_path):
    n = registered_drive.n_frames
    scores, path = evaluate(registered_drive, registered_drive.folder / "truth", tmp_path, {})
    assert scores.loc["failed_pairs", "value"] == 1
    assert scores.loc["failed_pairs", "n"] == n - 1
    assert scores.loc["rpe_rmse", "value"] < 0.05
    assert scores.loc["n_registered", "value"] == n - 1
    assert path.is_failed.tolist() == [0, 0, 0, 0, 1, 0, 0, 0]
    assert np.allclose(path.true_x_m, 0.6 * np.arange(n), atol=1e-6)
    assert np.nanmax(np.abs(path.x_m - path.true_x_m)) < 0.1
    both = [pd.read_csv(registered_drive.folder / f"{name}.csv").duration_s for name in ("timings", "grid_timings")]
    assert scores.loc["pair_time_median", "value"] > 1000 * both[0][1:].median()
    planar, path = evaluate(registered_drive, registered_drive.folder / "truth", tmp_path, {"is_planar": True, "smoothing_s": 0.5})
    assert path.true_z_m.isna().all()
    assert planar.loc["rpe_rmse", "value"] < scores.loc["rpe_rmse", "value"] + 0.01


def test_without_true_poses_only_the_status_counts(registered_drive, tmp_path):
    (tmp_path / "truth").mkdir()
    scores, path = evaluate(registered_drive, tmp_path / "truth", tmp_path, {})
    assert scores.loc["failed_pairs", "value"] == 1
    assert scores.loc[["ape_rmse", "rpe_rmse", "drift"], "value"].isna().all()
    assert path.true_x_m.isna().all()
    assert abs(path.x_m[7] - 4.2) < 0.1
