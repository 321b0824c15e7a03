"""The chain of poses: good drives, bad frames, breaks, resumption."""

from dataclasses import replace

import numpy as np
import pytest
from street_frames import PERIOD_S, drive, pose, scan, street_boxes

from streetscan.errors import BadInput
from streetscan.geometry import invert, rotation_angle, transform
from streetscan.registration.grid_classes import TALL_STRUCTURE, segment_frame
from streetscan.registration.ndt import NdtSettings
from streetscan.registration.odometry import (
    STATUSES,
    Frame,
    Odometry,
    OdometrySettings,
    make_settings,
    motion_of,
    register_drive,
    register_frames,
    register_pair,
    select_points,
    twist_of,
)
from streetscan.registration.pose_tables import read_pose_table, tabulate_poses, write_tum_segment

SETTINGS = OdometrySettings()


def frame(index, points, offsets=None, time_s=None):
    return Frame(index, index * PERIOD_S if time_s is None else time_s, points, segment_frame(points, 1.8), offsets)


@pytest.fixture(scope="module")
def straight():
    points, poses = drive(24, speed_mps=8.0, turn_rate_radps=0.05)
    return [frame(i, p) for i, p in enumerate(points)], np.array([invert(poses[0]) @ T for T in poses])


def errors(rows, truth):
    """Position errors of the posed rows, metres."""
    return [np.linalg.norm(r.T_segment_lidar[:3, 3] - truth[r.index][:3, 3]) for r in rows if r.is_posed]


@pytest.mark.parametrize(
    ("method", "target", "limit_m"),
    [("ndt", "street", 0.08), ("ndt", "previous", 0.15), ("gicp", "previous", 0.6), ("vgicp", "street", 0.4)],
)
def test_a_drive_comes_back(straight, method, target, limit_m):
    frames, truth = straight
    rows = list(register_frames(frames[:16], OdometrySettings(method=method, target=target, thin_m=0.3)))
    # GICP does not always come to rest; it is a peer, not ours.
    assert sum(r.status in ("start", "ok") for r in rows) >= (16 if method == "ndt" else 13)
    assert {r.segment for r in rows} == {0}
    assert max(errors(rows, truth)) < limit_m
    assert rows[5].velocity_mps[0] == pytest.approx(8.0, abs=0.3)
    assert (np.linalg.eigvalsh(rows[5].covariance) > 0).all()


def test_all_points_can_be_matched_too(straight):
    frames, _ = straight
    rows = list(register_frames(frames[:8], OdometrySettings(classes=(), target="previous")))
    assert [r.status for r in rows] == ["start"] + ["ok"] * 7


@pytest.fixture(scope="module")
def odometry_after(straight):
    """An odometry that has seen ten frames, made anew by its state."""
    frames, _ = straight
    odometry = Odometry(SETTINGS)
    for f in frames[:10]:
        odometry.add(f)
    state = {k: v.copy() for k, v in odometry.state().items()}

    def make():
        copy = Odometry(SETTINGS)
        copy.restore(state)
        return copy

    return make


def ground_only(points):
    return points[points[:, 2] < -1.75]


@pytest.mark.parametrize(
    ("spoil", "status"),
    [
        (lambda f: frame(10, np.empty((0, 3), np.float32)), "empty"),
        (lambda f: frame(10, np.full((50, 3), np.nan, np.float32)), "empty"),
        (lambda f: frame(10, ground_only(f[10].points)), "too_few_points"),
        (lambda f: frame(10, f[9].points), "repeated"),
        (lambda f: replace(f[10], time_s=f[8].time_s), "time_backwards"),
        (lambda f: replace(f[10], time_s=np.nan), "time_backwards"),
        (lambda f: frame(10, f[10].points @ np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1]], np.float32)), "low_overlap"),
    ],
)
def test_a_bad_frame_keeps_its_row_and_the_chain_goes_on(straight, odometry_after, spoil, status):
    frames, truth = straight
    odometry = odometry_after()
    row = odometry.add(spoil(frames))
    assert row.status in ({"low_overlap", "poor_fit", "not_converged", "implausible_motion"} if status == "low_overlap" else {status})
    assert row.status in STATUSES
    assert np.isnan(row.T_segment_lidar).all()
    following = [odometry.add(f) for f in frames[11:14]]
    assert [r.status for r in following] == ["ok"] * 3
    assert following[0].segment == 0
    assert max(errors(following, truth)) < 0.1


def test_a_clock_that_was_set_back_breaks_the_chain(straight, odometry_after):
    frames, truth = straight
    odometry, n_lost = odometry_after(), SETTINGS.max_lost_frames
    rows = [odometry.add(replace(f, time_s=f.time_s - 60)) for f in frames[10:]]
    assert [r.status for r in rows] == ["time_backwards"] * n_lost + ["start"] + ["ok"] * (len(rows) - n_lost - 1)
    assert rows[-1].segment == 1
    since_start = invert(truth[10 + n_lost]) @ truth[rows[-1].index]
    assert np.linalg.norm((invert(since_start) @ rows[-1].T_segment_lidar)[:3, 3]) < 0.1


def test_one_stamp_far_ahead_does_not_end_the_drive(straight, odometry_after):
    frames, _ = straight
    odometry = odometry_after()
    rows = [odometry.add(replace(frames[10], time_s=3600.0)), *(odometry.add(f) for f in frames[11:])]
    assert not rows[0].is_posed
    assert [r.status for r in rows[1:]] == ["time_backwards"] * 9 + ["start"] + ["ok"] * (len(rows) - 11)


def test_nan_points_do_not_matter(straight, odometry_after):
    frames, truth = straight
    points = np.insert(frames[10].points, [0, 500, 9000], np.nan, axis=0)
    row = odometry_after().add(frame(10, points))
    assert row.status == "ok"
    assert max(errors([row], truth)) < 0.1


def test_a_gap_of_ten_frames_is_bridged_or_said(straight, odometry_after):
    frames, truth = straight
    row = odometry_after().add(frames[20])
    assert row.status == "ok"
    assert max(errors([row], truth)) < 0.2


def test_without_a_prediction_the_search_starts_at_the_last_frame(straight):
    frames, truth = straight
    plain = OdometrySettings(target="previous", is_predicted=False)
    near = list(register_frames(frames[:4], plain))
    assert [r.status for r in near] == ["start", "ok", "ok", "ok"]
    assert max(errors(near, truth)) < 0.1
    far = list(register_frames(frames[:19:6], replace(plain, ndt=NdtSettings(sizes_m=(1.0,)))))
    assert all(r.status not in ("ok", "start") for r in far[1:])
    predicted = list(register_frames(frames[:19:6], OdometrySettings(target="previous")))
    assert [r.status for r in predicted] == ["start", "ok", "ok", "ok"]


def test_another_place_breaks_the_chain(odometry_after):
    odometry, rng = odometry_after(), np.random.default_rng(5)
    boxes = street_boxes(np.random.default_rng(99)) + [0, 2.5, 0, 0, 2.5, 0]
    elsewhere = [scan(pose(40 + 0.8 * i, 1.0, 0.6), boxes, rng)[0] for i in range(14)]
    rows = [odometry.add(frame(10 + i, p)) for i, p in enumerate(elsewhere)]
    n_lost = SETTINGS.max_lost_frames
    assert all(r.status not in ("ok", "start") for r in rows[: n_lost - 1])
    assert rows[n_lost - 1].status == "start"
    assert [r.segment for r in rows] == [0] * (n_lost - 1) + [1] * (15 - n_lost)
    assert [r.status for r in rows[n_lost:]] == ["ok"] * (14 - n_lost)
    assert np.linalg.norm(rows[-1].T_segment_lidar[:3, 3]) == pytest.approx(0.8 * (14 - n_lost), abs=0.1)


@pytest.mark.parametrize("target", ["street", "previous"])
def test_standing_does_not_drift(target):
    rng, boxes = np.random.default_rng(0), street_boxes()
    odometry = Odometry(OdometrySettings(target=target))
    rows = [odometry.add(frame(i, scan(pose(0), boxes, rng)[0])) for i in range(12)]
    assert all(r.is_posed for r in rows)
    assert max(np.linalg.norm(r.T_segment_lidar[:3, 3]) for r in rows) < 0.02
    assert max(rotation_angle(r.T_segment_lidar) for r in rows) < np.radians(0.1)


def test_a_convoy_does_not_carry_the_street_along():
    """Ten cars keep their distance; with them and the rings on the road raw frames stand still (Józsa & Benedek 2013, 6.3)."""
    rng, boxes, step_m = np.random.default_rng(0), street_boxes(), 0.4
    places = [(8, -0.9), (-12, -0.9), (16, -0.9), (2, 2.4), (-5, 2.4), (10, 2.4), (0, -4.0), (7.5, -4.0), (-8, -4.0), (17, 2.4)]
    frames = []
    for i in range(8):
        cars = [(i * step_m + x, y, 0.25, i * step_m + x + 4.2, y + 1.7, 1.45) for x, y in places]
        frames.append(frame(i, scan(pose(i * step_m), np.concatenate([boxes, cars]), rng, n_beams=64)[0]))

    def way_m(classes):
        rows = list(register_frames(frames, OdometrySettings(classes=classes)))
        assert [r.status for r in rows] == ["start"] + ["ok"] * 7
        return rows[-1].T_segment_lidar[0, 3]

    assert way_m((TALL_STRUCTURE,)) == pytest.approx(7 * step_m, abs=0.03)
    assert way_m(()) < step_m


def test_motion_within_the_revolution_is_undone():
    rng, boxes = np.random.default_rng(0), street_boxes()
    speed = np.array([14.0, 0, 0])
    fired = [scan(pose(i * 1.4), boxes, rng, velocity_mps=speed) for i in range(8)]
    truth = np.array([transform([i * 1.4, 0, 0]) for i in range(8)])

    def scores(is_deskewed):
        frames = [frame(i, p, o) for i, (p, o) in enumerate(fired)]
        return list(register_frames(frames, OdometrySettings(is_deskewed=is_deskewed)))

    with_times, without = scores(True), scores(False)
    assert [r.status for r in with_times] == ["start"] + ["ok"] * 7
    assert max(errors(with_times, truth)) < 0.08
    assert np.mean(errors(with_times, truth)) < np.mean(errors(without, truth))


def test_resumed_is_uninterrupted(straight, tmp_path):
    frames, _ = straight
    asked = []

    def read(first, last):
        asked.append((first, last))
        yield from frames[first:last]

    def read_and_die(first, last):
        if first >= 14:
            raise KeyboardInterrupt
        yield from frames[first:last]

    whole, _ = register_drive(read, 24, tmp_path / "a", SETTINGS, group_frames=7)
    with pytest.raises(KeyboardInterrupt):
        register_drive(read_and_die, 24, tmp_path / "b", SETTINGS, group_frames=7)
    asked.clear()
    resumed, seconds = register_drive(read, 24, tmp_path / "b", SETTINGS, group_frames=7)
    assert asked == [(14, 21), (21, 24)]
    assert len(seconds) == 24
    assert tabulate_poses(resumed).equals(tabulate_poses(whole))
    for a, b in zip(whole, resumed, strict=True):
        assert np.array_equal(a.T_segment_lidar, b.T_segment_lidar)
    # Other settings start afresh.
    asked.clear()
    register_drive(read, 7, tmp_path / "b", replace(SETTINGS, thin_m=1.0), group_frames=7)
    assert asked == [(0, 7)]


@pytest.mark.parametrize("method", ["gicp", "vgicp"])
def test_state_of_the_peers(straight, method):
    frames, _ = straight
    settings = OdometrySettings(method=method, target="previous" if method == "gicp" else "street", n_threads=1)
    odometry = Odometry(settings)
    for f in frames[:4]:
        odometry.add(f)
    copy = Odometry(settings)
    copy.restore(odometry.state())
    assert np.allclose(odometry.add(frames[4]).T_segment_lidar, copy.add(frames[4]).T_segment_lidar, atol=1e-9)


def test_pairs(straight):
    frames, truth = straight
    row = register_pair(frames[0], frames[1], settings=SETTINGS)
    assert row.status == "ok"
    assert np.linalg.norm((invert(truth[1]) @ row.T_segment_lidar)[:3, 3]) < 0.06
    twin = register_pair(frames[0], replace(frames[0], time_s=0.1))
    assert np.allclose(twin.T_segment_lidar, np.eye(4), atol=0.02)
    assert register_pair(frames[1], frames[0]).status == "time_backwards"
    assert register_pair(frames[0], frame(1, np.empty((0, 3), np.float32))).status == "empty"
    assert register_pair(frames[0], frame(1, ground_only(frames[1].points))).status == "too_few_points"
    assert not register_pair(frames[0], frames[20]).is_posed


def test_selection_by_class_and_range():
    points = np.array([[1, 0, 0], [50, 0, 0], [2, 0, 0], [np.nan, 0, 0], [1, 0, np.inf]])
    labels = np.array([3, 3, 1, 3, 3], np.uint8)
    assert select_points(points, labels, (3,), 10.0).tolist() == [0]
    assert select_points(points, None, (), 10.0).tolist() == [0, 2]
    with pytest.raises(BadInput, match="segment_frames"):
        select_points(points, None, (3,), 10.0)
    with pytest.raises(BadInput, match="4 grid classes for 5 points"):
        select_points(points, labels[:4], (3,), 10.0)


def test_twists_and_motions_are_inverse():
    T = transform([1, -2, 0.5], [0.1, -0.2, 2.5])
    assert np.allclose(motion_of(twist_of(T)), T)


@pytest.mark.parametrize("bad", [{"method": "icp"}, {"target": "next"}, {"classes": ["wall"]}, {"colour": 1}, {"ndt": {"sizes": [1]}}])
def test_bad_settings(bad):
    with pytest.raises(BadInput):
        Odometry(make_settings(bad))


def test_settings_from_plain_values():
    settings = make_settings({"classes": ["ground", "tall_structure"], "ndt": {"sizes_m": [2, 1]}, "start_speeds_mps": [0, 5]})
    assert settings.classes == (1, 3)
    assert settings.ndt.sizes_m == (2.0, 1.0)


def test_table_round_trip(straight, odometry_after, tmp_path):
    frames, _ = straight
    odometry = odometry_after()
    rows = [odometry.add(frames[10]), odometry.add(frame(11, np.empty((0, 3), np.float32))), odometry.add(frames[12])]
    tabulate_poses(rows).to_csv(tmp_path / "poses.csv", index=False)
    back = read_pose_table(tmp_path / "poses.csv")
    assert [r.status for r in back] == ["ok", "empty", "ok"]
    assert np.allclose(back[0].T_segment_lidar, rows[0].T_segment_lidar)
    assert np.allclose(np.diag(back[2].covariance), np.diag(rows[2].covariance))
    assert np.allclose(back[2].velocity_mps, rows[2].velocity_mps)
    write_tum_segment(tmp_path / "poses.tum", rows)
    assert np.loadtxt(tmp_path / "poses.tum").shape == (2, 8)
    write_tum_segment(tmp_path / "none.tum", rows[1:2])
    with pytest.raises(BadInput):
        read_pose_table(tmp_path / "poses.tum")
