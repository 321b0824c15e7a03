"""evaluate_reconstruction on models whose errors are known."""

import numpy as np
import pandas as pd
import pytest
from toy_camera import forward_poses, toy_camera

from scripts import evaluate_reconstruction
from streetscan.calibration.densification import DenseCloud
from streetscan.calibration.model_files import summarize, write_model
from streetscan.calibration.reconstruction import Reconstruction
from streetscan.calibration.reconstruction_evaluation import compare_ranges, evaluate_keyframe, true_camera_poses
from streetscan.calibration.scale import Scale
from streetscan.calibration.sfm import SparseModel
from streetscan.classes import CAR, FACADE, GROUND
from streetscan.errors import BadInput
from streetscan.geometry import invert, transform
from streetscan.io.tables import save_tables
from streetscan.io.trajectories import write_poses_csv

TIMES_NS = [1_700_000_000_000_000_000 + i * 100_000_000 for i in range(4)]
SCALE, FAR = 1.02, 1.05


@pytest.fixture
def model(tmp_path):
    """A keyframe 2 % too long, its dense points a further 3 % too far; the truth in a folder beside it."""
    poses, points = forward_poses(4), np.random.default_rng(0).uniform([-3, -1, 4], [3, 1, 15], (500, 3))
    cameras = poses.copy()
    cameras[:, :3, 3] *= SCALE
    ones = np.zeros(500, np.uint8)
    track = np.arange(500)
    sparse = SparseModel(
        invert(cameras), points * SCALE, np.zeros((500, 3), np.uint8), ones, np.zeros(500), track, track % 4, track, np.zeros((500, 2))
    )
    dense = DenseCloud(points * FAR, np.zeros((500, 3), np.uint8), ones + 2, ones)
    made = Reconstruction(reference=0, sparse=sparse, dense=dense, scale=Scale(3.0, 0.03, np.zeros(3), 1.5), seconds={"sfm": 4.0})
    (tmp_path / "model").mkdir()
    write_model(tmp_path / "model", made, toy_camera(), TIMES_NS)
    save_tables({tmp_path / "summary.csv": summarize(made, 0, 4)})
    (tmp_path / "truth").mkdir()
    T_map_first = transform([500.0, 200.0, 100.0], [0.1, 0.2, 1.0])
    write_poses_csv(tmp_path / "truth" / "camera_poses.csv", np.arange(4), np.array(TIMES_NS) / 1e9, T_map_first @ poses)
    return tmp_path


def true_surfaces(time_ns: int, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A street in which all is nearer than found, and is road on the left and a house on the right."""
    assert time_ns == TIMES_NS[0]
    return np.linalg.norm(directions, axis=1) / FAR, np.where(directions[:, 0] < 0, GROUND, FACADE).astype(np.uint8)


def test_errors_by_hand(model):
    summary = pd.read_csv(model / "summary.csv").iloc[0]
    errors = evaluate_keyframe(summary, model / "model", model / "truth", true_surfaces, 20.0)
    assert errors["scale_error"] == pytest.approx(SCALE - 1, abs=1e-6)
    assert errors["rotation_error_deg"] < 1e-5
    assert errors["dense_error"] == pytest.approx(FAR - 1, abs=1e-3)
    assert errors["dense_shape_error"] == pytest.approx(FAR / SCALE - 1, abs=1e-3)
    assert errors["n_compared"] == 500
    assert evaluate_keyframe(summary, model / "model", model / "truth", true_surfaces, 8.0)["n_compared"] < 400
    assert errors["n_ground"] + errors["n_standing"] == 500
    assert errors["dense_ground_error"] == pytest.approx(FAR - 1, abs=1e-3)


def test_what_stands_is_not_hidden_by_the_road():
    """90 points of road that are right, 6 of houses wrong by 10 %, 2 of a car, one in the sky; of 4 farther ones two in the sky."""
    truth = np.r_[np.full(90, 10.0), np.full(6, 15.0), 12.0, 12.0, np.inf, 30.0, 30.0, np.inf, np.inf]
    ranges = np.r_[np.full(90, 10.0), np.full(6, 16.5), 12.12, 12.12, 14.0, 30.6, 33.0, 25.0, 60.0]
    labels = np.r_[np.full(90, GROUND), np.full(6, FACADE), CAR, CAR, 255, FACADE, FACADE, 255, 255].astype(np.uint8)
    found = compare_ranges(ranges, truth, labels, 1.0, 20.0)
    assert {name: found[f"n_{name}"] for name in ("compared", "ground", "standing", "movable", "far", "missing")} == {
        "compared": 98, "ground": 90, "standing": 6, "movable": 2, "far": 2, "missing": 1,
    }  # fmt: skip
    assert (found["dense_error"], found["dense_ground_error"]) == (0, 0)
    assert found["dense_standing_error"] == pytest.approx(0.1)
    assert found["dense_movable_error"] == pytest.approx(0.01)
    assert found["dense_far_error"] == pytest.approx(0.06)
    assert (found["dense_off"], found["dense_standing_off"]) == (pytest.approx(7 / 99), 1)
    assert found["dense_far_off"] == pytest.approx(2 / 3)
    assert found["dense_standing_share"] == pytest.approx(6 / 98)
    nothing = compare_ranges(*(np.empty(0),) * 2, np.empty(0, np.uint8), 1.0, 20.0)
    assert nothing["n_compared"] == 0
    assert np.isnan([nothing["dense_error"], nothing["dense_off"], nothing["dense_standing_share"]]).all()


def test_scores_count_every_keyframe(model):
    failed = Reconstruction("no_images", "2 images")
    save_tables({model / "failed.csv": summarize(failed, 1, 0)})
    evaluate_reconstruction.main(
        "drive.yaml", "schema.yaml", model / "truth", [model / "summary.csv", model / "failed.csv"], [model / "model", model / "none"],
        model / "keyframes.csv", model / "scores.csv", drive="toy", street=None, data_root=".", seed=1, n_threads=1, max_range_m=20.0,
    )  # fmt: skip
    scores = pd.read_csv(model / "scores.csv").set_index("metric")
    assert scores.value[["accepted", "n_sparse", "n_dense"]].tolist() == [50, 500, 500]
    assert scores.value["scale_error"] == pytest.approx(2, abs=1e-4)
    assert scores.value[["scale_right", "turns_right"]].tolist() == [0, 100]
    assert scores.n[["scale_right", "turns_right"]].tolist() == [1, 1]
    assert scores.n[["accepted", "scale_error", "dense_error"]].tolist() == [2, 1, 0]
    table = pd.read_csv(model / "keyframes.csv")
    assert table.status.tolist() == ["ok", "no_images"]
    assert np.isnan(table.scale_error[1])


def test_true_cameras_of_a_recording_come_from_the_lidar(model, tmp_path):
    lidar, T_camera_lidar = forward_poses(4), transform([0.1, -0.2, 0.3], [0.1, 0.2, 0.3])
    folder = tmp_path / "recorded"
    folder.mkdir()
    write_poses_csv(folder / "poses.csv", np.arange(4), np.array(TIMES_NS) / 1e9, lidar)
    (folder / "truth.yaml").write_text("labels: null\n")
    with pytest.raises(BadInput, match="neither poses nor extrinsics"):
        true_camera_poses(folder, np.array(TIMES_NS))
    (folder / "truth.yaml").write_text(f"extrinsics:\n  T_camera_lidar: {T_camera_lidar.tolist()}\n")
    assert np.allclose(true_camera_poses(folder, np.array(TIMES_NS)), lidar @ invert(T_camera_lidar), atol=1e-6)


def test_truth_of_other_images_is_refused(model):
    with pytest.raises(BadInput, match="lacks an image"):
        true_camera_poses(model / "truth", np.array(TIMES_NS) + 50_000_000)
