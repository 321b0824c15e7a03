import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from streetscan import geometry
from streetscan.errors import BadInput
from streetscan.io import trajectories


@pytest.fixture
def poses():
    rng = np.random.default_rng(0)
    return geometry.transform(rng.normal(size=(5, 3)) * 100, rng.uniform(-1, 1, (5, 3)))


def test_kitti_round_trip(tmp_path, poses):
    trajectories.write_kitti_poses(tmp_path / "poses.txt", poses)
    np.testing.assert_allclose(trajectories.read_kitti_poses(tmp_path / "poses.txt"), poses, atol=1e-6)


def test_tum_round_trip_leaves_unknown_poses_out(tmp_path, poses):
    poses[2] = np.nan
    times = 1.5e9 + np.arange(5) * 0.1
    trajectories.write_tum(tmp_path / "poses.tum", times, poses)
    got_times, got = trajectories.read_tum(tmp_path / "poses.tum")
    np.testing.assert_allclose(got_times, times[[0, 1, 3, 4]], atol=1e-6)
    np.testing.assert_allclose(got, poses[[0, 1, 3, 4]], atol=1e-6)


def test_csv_round_trip_keeps_unknown_poses(tmp_path, poses):
    poses[0] = np.nan
    trajectories.write_poses_csv(tmp_path / "poses.csv", np.arange(5), 1.5e9 + np.arange(5) * 0.1, poses)
    frames, times, got = trajectories.read_poses_csv(tmp_path / "poses.csv")
    assert frames.tolist() == [0, 1, 2, 3, 4]
    np.testing.assert_allclose(got, poses, atol=1e-6)
    assert ",unknown,nan,nan" in (tmp_path / "poses.csv").read_text()
    np.testing.assert_allclose(np.diff(times), 0.1, atol=1e-6)


def test_no_pose_at_all(tmp_path):
    trajectories.write_poses_csv(tmp_path / "poses.csv", np.arange(2), np.zeros(2), np.full((2, 4, 4), np.nan))
    assert np.isnan(trajectories.read_poses_csv(tmp_path / "poses.csv")[2]).all()
    trajectories.write_tum(tmp_path / "poses.tum", np.zeros(2), np.full((2, 4, 4), np.nan))
    with pytest.raises(BadInput, match="no pose"):
        trajectories.read_tum(tmp_path / "poses.tum")


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("1 0 0 0 0 1 0 0 0 0 1\n", "11 numbers"),
        ("2 0 0 0 0 1 0 0 0 0 1 0\n", "no rotation"),
        ("", "no pose"),
        ("x " * 12, "no number"),
        ("nan " * 12, "NaN"),
    ],
)
def test_bad_kitti_files(tmp_path, text, found):
    (tmp_path / "poses.txt").write_text(text)
    with pytest.raises(BadInput, match=found):
        trajectories.read_kitti_poses(tmp_path / "poses.txt")


@pytest.mark.parametrize(("text", "found"), [("0 0 0 0 0 0 0 0\n", "length zero"), ("1 0 0 0 0 0 0 1\n0 0 0 0 0 0 0 1\n", "not increase")])
def test_bad_tum_files(tmp_path, text, found):
    (tmp_path / "poses.tum").write_text(text)
    with pytest.raises(BadInput, match=found):
        trajectories.read_tum(tmp_path / "poses.tum")


@settings(deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.one_of(st.binary(max_size=200), st.text("0123456789.e- \n#naif,", max_size=200).map(str.encode)))
def test_any_bytes_give_poses_or_a_clear_error(tmp_path, data):
    (tmp_path / "poses.txt").write_bytes(data)
    for read in (trajectories.read_kitti_poses, trajectories.read_tum, trajectories.read_poses_csv):
        try:
            read(tmp_path / "poses.txt")
        except BadInput as error:
            assert "poses.txt" in str(error)  # noqa: PT017
