"""Errors of chains against numbers worked out by hand, and against evo where it is installed."""

import numpy as np
import pytest

from streetscan.errors import BadInput
from streetscan.geometry import transform
from streetscan.registration.evaluation import (
    absolute_errors,
    drift_per_distance,
    evaluate_chain,
    find_failed_pairs,
    relative_errors,
    smooth_positions,
)
from streetscan.registration.odometry import FramePose


def path(n, scale=1.0):
    """A bend: a metre and 0.02 rad a frame."""
    step, poses = transform([scale, 0, 0.02], [0, 0, 0.02]), [np.eye(4)]
    for _ in range(n - 1):
        poses.append(poses[-1] @ step)
    return np.array(poses)


def rows_of(poses, statuses=None, segments=None):
    n = len(poses)
    statuses, segments = statuses or ["start"] + ["ok"] * (n - 1), segments or [0] * n
    rows = [FramePose(i, 0.1 * i, statuses[i], segments[i]) for i in range(n)]
    for row, T in zip(rows, poses, strict=True):
        if row.is_posed:
            row.T_segment_lidar = T
    return rows


def test_equal_chains_have_no_error_in_any_frame():
    truth = path(30)
    moved = transform([5, -3, 1], [0.1, 0.2, 2.0]) @ truth
    distance, angle = relative_errors(moved, truth)
    assert distance.max() < 1e-9
    assert angle.max() < 1e-7
    assert absolute_errors(moved, truth).max() < 1e-9
    assert drift_per_distance(moved, truth, 5.0).max() < 1e-9


def test_errors_by_hand():
    truth, poses = path(10), path(10)
    poses[4:] = poses[4:] @ transform([0, 0, 0.3], [0, 0, np.radians(1.5)])
    distance, angle = relative_errors(poses, truth)
    assert np.flatnonzero(distance > 0.1).tolist() == [3]
    assert np.degrees(angle[3]) == pytest.approx(1.5)
    planar, _ = relative_errors(poses, truth, is_planar=True)
    assert planar[3] < 1e-9 < distance[3]
    assert relative_errors(poses, truth, step=3)[0].shape == (7,)


def test_drift_of_a_wrong_scale():
    truth = np.array([transform([i, 0, 0]) for i in range(60)])
    poses = np.array([transform([1.01 * i, 0, 0]) for i in range(60)])
    drift = drift_per_distance(poses, truth, 50.0)
    assert len(drift) == 10
    assert np.allclose(drift, 0.01)
    assert drift_per_distance(poses, truth, 100.0).size == 0


def test_unknown_poses_stay_unknown():
    truth, poses = path(10), path(10)
    poses[4] = np.nan
    distance, _ = relative_errors(poses, truth)
    assert np.flatnonzero(np.isnan(distance)).tolist() == [3, 4]
    assert np.isnan(absolute_errors(poses, truth)).sum() == 1
    with pytest.raises(BadInput):
        absolute_errors(poses[:2], truth[:2])


def test_failed_pairs_count_status_segment_and_error():
    truth = path(8)
    poses = truth.copy()
    poses[3:] = poses[3:] @ transform([0.6, 0, 0])
    statuses = ["start", "ok", "empty", "ok", "ok", "start", "ok", "ok"]
    failed = find_failed_pairs(rows_of(poses, statuses, [0] * 5 + [1] * 3), truth)
    # Frame 2 has a status, frame 3 is off by 0.6 m against frame 1, frame 5 starts anew.
    assert failed.tolist() == [False, True, True, False, True, False, False]


def test_smoothing_keeps_a_parabola_and_evens_out_jumps():
    t = np.arange(40) * 0.1
    truth = np.array([transform([8 * x, x**2, 0]) for x in t])
    assert np.allclose(smooth_positions(t, truth), truth, atol=1e-9)
    rng = np.random.default_rng(0)
    noisy = truth.copy()
    noisy[:, :3, 3] += rng.normal(0, 0.05, (40, 3))
    error = lambda T: np.linalg.norm(T[:, :3, 3] - truth[:, :3, 3], axis=1).mean()  # noqa: E731
    assert error(smooth_positions(t, noisy)) < 0.7 * error(noisy)
    assert smooth_positions(t[:3], truth[:3]) is not None


def test_all_figures_of_a_chain():
    truth = path(80)
    table = evaluate_chain(rows_of(truth), truth, np.full(80, 0.02)).set_index("metric")
    assert table.loc["failed_pairs", "value"] == 0
    assert table.loc["failed_pairs", "n"] == 79
    assert table.loc["frame_rate", "value"] == pytest.approx(50)
    assert table.loc["ape_rmse", "value"] < 1e-9
    assert table.loc["drift", "n"] > 0
    lost = evaluate_chain(rows_of(truth, ["empty"] * 80), truth, np.full(80, 0.02)).set_index("metric")
    assert lost.loc["failed_share", "value"] == 100
    assert np.isnan(lost.loc["rpe_rmse", "value"])
    assert lost.loc["n_segments", "value"] == 0
    with pytest.raises(BadInput):
        evaluate_chain(rows_of(truth), truth[:5], np.full(80, 0.02))


def test_against_evo():
    pytest.importorskip("evo", reason="evo is not installed")
    from evo.core import metrics
    from evo.core.trajectory import PosePath3D

    rng = np.random.default_rng(0)
    truth = path(60)
    poses = transform([3, 1, 2], [0, 0.1, 1]) @ truth @ transform(rng.normal(0, 0.05, (60, 3)), rng.normal(0, 0.01, (60, 3)))
    estimate, reference = PosePath3D(poses_se3=list(poses)), PosePath3D(poses_se3=list(truth))
    rpe = metrics.RPE(metrics.PoseRelation.translation_part, 1, metrics.Unit.frames)
    rpe.process_data((reference, estimate))
    ours, angle = relative_errors(poses, truth)
    assert np.allclose(ours, rpe.error)
    turn = metrics.RPE(metrics.PoseRelation.rotation_angle_rad, 1, metrics.Unit.frames)
    turn.process_data((reference, estimate))
    assert np.allclose(angle, turn.error)
    estimate.align(reference)
    ape = metrics.APE(metrics.PoseRelation.translation_part)
    ape.process_data((reference, estimate))
    assert np.allclose(absolute_errors(poses, truth), ape.error)
