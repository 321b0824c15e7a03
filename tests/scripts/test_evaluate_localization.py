"""evaluate_localization: truth fed in as a method scores perfectly, wrong and missing poses count."""

import numpy as np
import pandas as pd
import pytest

from scripts import evaluate_localization
from streetscan.errors import BadInput
from streetscan.geometry import transform
from streetscan.localization.drive import FrameLocation
from streetscan.localization.evaluation import COLUMNS
from streetscan.localization.localizer import Location, Start
from streetscan.localization.location_tables import tabulate_locations


def evaluate(files, folder, poses, statuses, with_floor=False, settings=None, **changes):
    """Scores of made-up poses."""
    rows = []
    for i, (T, status) in enumerate(zip(poses, statuses, strict=True)):
        location = Location(status, T, T.copy(), covariance=np.eye(6) * 0.01, source="objects")
        rows.append(FrameLocation(i, 1.7e9 + 0.1 * i, Start(T[:2, 3] + [3.0, 4.0], 0.1), location))
    tabulate_locations(rows).to_csv(folder / "poses.csv", index=False)
    inputs = {"drive_path": files.drive, "truth_path": files.truth, "poses_path": folder / "poses.csv", "reference_path": files.reference}
    inputs |= {"landmarks_path": files.landmarks, "voxels_path": files.voxels, "labels_path": files.labels} | changes
    paths = {"errors_path": folder / "errors.csv", "scores_path": folder / "scores.csv"}
    evaluate_localization.main(**inputs, **paths, settings=settings or {}, with_floor=with_floor)
    return pd.read_csv(paths["errors_path"]), pd.read_csv(paths["scores_path"]).set_index("metric")["value"]


def test_truth_scores_perfectly(localization_files, tmp_path):
    errors, scores = evaluate(localization_files, tmp_path, localization_files.poses, ["ok"] * 4, with_floor=True)
    assert tuple(errors.columns) == COLUMNS
    assert scores["success"] == scores["ok"] == 100
    assert scores["wrong_but_ok"] == 0
    assert scores["translation_mean"] < 1e-6
    assert scores["nees_mean"] < 1e-6
    assert scores["floor_translation_median"] < 0.1
    # What is left of the keypoint distance is how differently a frame and a map see an object.
    assert scores["keypoint_distance_mean"] == scores["vote_keypoint_distance_mean"] < 0.4
    assert 5 < scores["good_landmarks"] < 60
    assert np.allclose(errors["start_m"], 5)
    assert (errors["phantom_share"] == 0).all()
    assert scores["landmarks"] > 10
    # Cars are no landmarks of a labelled map.
    assert scores["movable_landmarks"] == 0


def test_a_wrong_pose_that_is_believed_is_counted(localization_files, tmp_path):
    poses = localization_files.poses.copy()
    poses[0] = transform([3.0, 0, 0]) @ poses[0]
    poses[1] = poses[1] @ transform(rpy_rad=(0, 0, np.radians(7)))
    poses[3] = np.nan
    errors, scores = evaluate(localization_files, tmp_path, poses, ["ok", "ok", "ambiguous", "off_map"])
    assert errors["found_m"].round(3).tolist()[:2] == [3.0, 0.0]
    assert errors["found_deg"].round(3).tolist()[:2] == [0.0, 7.0]
    assert scores["success"] == 25
    assert scores["ok"] == 50
    assert scores["n_wrong_but_ok"] == 2
    assert scores["ambiguous_right"] == 1
    assert scores["off_map_wrong"] == 1


def test_the_keypoint_distance_grows_with_the_error_and_the_strategy_does_not_change_it(localization_files, tmp_path):
    truth = localization_files.poses
    shifted = truth.copy()
    shifted[:, :3, 3] += [2.0, 0, 0]
    at_truth, off = (evaluate(localization_files, tmp_path, poses, ["ok"] * 4)[0]["keypoint_m"] for poses in (truth, shifted))
    known = at_truth.notna()
    assert known.sum() == 3
    assert (np.abs(off - at_truth)[known] > 1).all()
    assert (off[known] < at_truth[known] + 2.001).all()
    by_centres = evaluate(localization_files, tmp_path, shifted, ["ok"] * 4, settings={"n_keypoints": 1})[0]["keypoint_m"]
    assert np.allclose(by_centres[known], off[known])


def test_a_map_without_true_classes(localization_files, tmp_path):
    errors, _ = evaluate(localization_files, tmp_path, localization_files.poses, ["ok"] * 4, voxels_path=None, labels_path=None)
    assert errors["phantom_share"].isna().all()


def test_the_truth_of_a_shorter_drive_is_refused(localization_files, tmp_path):
    poses = np.concatenate([localization_files.poses] * 2)
    with pytest.raises(BadInput, match="same drive"):
        evaluate(localization_files, tmp_path, poses, ["ok"] * 8)
