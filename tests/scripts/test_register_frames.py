"""segment_frames, register_frames, merge_frames, show_frames and evaluate_registration on a tiny drive."""

import cv2
import numpy as np
import pandas as pd
import pytest
from street_frames import PERIOD_S, drive

from scripts import evaluate_registration, merge_frames, register_frames, segment_frames, show_frames
from streetscan.clouds import check_points
from streetscan.errors import BadInput
from streetscan.frames import LidarFrame
from streetscan.io.las import read_las
from streetscan.io.mcap import open_drive_writer
from streetscan.io.trajectories import write_poses_csv

N = 8


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A drive of eight frames, the fifth one empty, through all steps."""
    folder = tmp_path_factory.mktemp("drive")
    points, poses = drive(N, speed_mps=6.0)
    points[4] = np.empty((0, 3), np.float32)
    times_ns = [1_700_000_000_000_000_000 + int(i * PERIOD_S * 1e9) for i in range(N)]
    with open_drive_writer(folder / "drive.mcap") as writer:
        for time_ns, frame in zip(times_ns, points, strict=True):
            writer.write_lidar(LidarFrame(time_ns, frame, intensity=np.full(len(frame), 0.5, np.float32)))
    write_poses_csv(folder / "truth.csv", np.arange(N), np.array(times_ns) / 1e9, poses)
    paths = {"drive_path": folder / "drive.mcap", "classes_path": folder / "classes.npz"}
    segment_frames.main(
        **paths, summary_path=folder / "classes.csv", sensor_height_m=1.8, grid={}, foot_method="reclassify", foot_m=0.1,
        outlier_neighbours=0,
    )  # fmt: skip
    outputs = {"poses_path": folder / "poses.csv", "tum_path": folder / "poses.tum", "timings_path": folder / "timings.csv"}
    register_frames.main(**paths, **outputs, group_frames=3, step=1, registrar={"target": "street"})
    merge_frames.main(
        **paths, poses_path=folder / "poses.csv", tiles_folder=folder / "tiles", elevation_path=folder / "elevation.asc",
        picture_path=folder / "street.png", classes=["ground", "tall_structure"], group_frames=3,
    )  # fmt: skip
    return folder, paths


def test_classes(run):
    folder, _ = run
    summary = pd.read_csv(folder / "classes.csv")
    assert len(summary) == N
    assert (summary.n_ground[summary.frame != 4] > 1000).all()
    assert summary.loc[4, ["n_sparse", "n_ground", "n_short_object", "n_tall_structure"]].sum() == 0
    assert 100 * summary.n_sparse.sum() / summary.filter(like="n_").to_numpy().sum() < 20


def test_poses_and_scores(run):
    folder, _ = run
    table = pd.read_csv(folder / "poses.csv")
    assert table.status.tolist() == ["start", "ok", "ok", "ok", "empty", "ok", "ok", "ok"]
    assert np.allclose(table.x_m.drop(4), 0.6 * np.delete(np.arange(N), 4), atol=0.1)
    assert table.x_m.isna().tolist() == [i == 4 for i in range(N)]
    assert not (folder / "poses.csv.resume").exists()
    assert np.loadtxt(folder / "poses.tum").shape == (N - 1, 8)
    evaluate_registration.main(
        folder / "truth.csv", folder / "poses.csv", folder / "timings.csv", folder / "scores.csv", drift_length_m=2.0
    )
    scores = pd.read_csv(folder / "scores.csv").set_index("metric")
    assert scores.loc["failed_pairs", "value"] == 1
    assert scores.loc["failed_pairs", "n"] == N - 1
    assert scores.loc["rpe_rmse", "value"] < 0.05


def test_every_second_frame(run, tmp_path):
    _, paths = run
    outputs = {"poses_path": tmp_path / "p.csv", "tum_path": tmp_path / "p.tum", "timings_path": tmp_path / "t.csv"}
    register_frames.main(**paths, **outputs, group_frames=3, step=2, registrar={})
    assert pd.read_csv(tmp_path / "p.csv").frame.tolist() == [0, 2, 4, 6]


def test_merged_map_is_a_map(run):
    folder, _ = run
    tiles = [read_las(path) for path in (folder / "tiles").glob("*.laz")]
    assert sum(len(t) for t in tiles) > 10_000
    for tile in tiles:
        check_points(tile.points, "tile")
        assert set(np.unique(tile.fields["grid_class"])) <= {1, 3}
        assert 4 not in tile.fields["frame"]
    image = cv2.imread(str(folder / "street.png"))
    assert image.shape == (900, 1600, 3)
    assert 0.02 < (image != 255).any(axis=2).mean() < 1
    assert "NODATA_value" in (folder / "elevation.asc").read_text()


def test_pictures_and_video(run, tmp_path):
    _, paths = run
    modes = ["stream", "classes", "mean_height", "density", "height_range"]
    show_frames.main(**paths, folder=tmp_path, modes=modes, sensor_height_m=1.8, grid={}, first=2, last=3, video_rate_hz=0)
    pictures = [cv2.imread(str(tmp_path / f"{mode}_000002.png")) for mode in modes]
    assert all((p.reshape(-1, 3).max(axis=1) > 0).mean() > 0.01 for p in pictures)
    assert not np.array_equal(pictures[1], pictures[2])
    show_frames.main(**paths, folder=tmp_path, modes=["classes"], sensor_height_m=1.8, grid={}, first=0, last=None, video_rate_hz=5)
    assert cv2.VideoCapture(str(tmp_path / "classes.mp4")).get(cv2.CAP_PROP_FRAME_COUNT) == N
    with pytest.raises(BadInput, match="mode"):
        show_frames.main(**paths, folder=tmp_path, modes=["x"], sensor_height_m=1.8, grid={}, first=2, last=3, video_rate_hz=0)
    with pytest.raises(BadInput, match="no frame"):
        show_frames.main(**paths, folder=tmp_path, modes=["classes"], sensor_height_m=1.8, grid={}, first=90, last=99, video_rate_hz=5)
    assert not (tmp_path / "x.mp4").exists()


def test_classes_of_another_drive_are_refused(run, tmp_path):
    _, paths = run
    points, _ = drive(2)
    with open_drive_writer(tmp_path / "other.mcap") as writer:
        for i, frame in enumerate(points):
            writer.write_lidar(LidarFrame(i, frame[:-5]))
    with pytest.raises(BadInput, match="segment_frames"):
        register_frames.main(
            tmp_path / "other.mcap", paths["classes_path"], tmp_path / "p.csv", tmp_path / "p.tum", tmp_path / "t.csv", 10, 1, {}
        )
    assert not (tmp_path / "p.csv").exists()
