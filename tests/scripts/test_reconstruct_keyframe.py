"""reconstruct_keyframe on a tiny drive with a camera."""

import numpy as np
import pandas as pd
import pycolmap
import pytest
import yaml
from toy_camera import lidar_poses, write_camera_drive

from scripts import choose_keyframes, reconstruct_keyframe
from streetscan.calibration.dynamic_objects import DynamicPixels
from streetscan.errors import BadInput
from streetscan.geometry import transform
from streetscan.io.las import read_las
from streetscan.io.tables import save_tables
from streetscan.registration.pose_tables import tabulate_poses

N_IMAGES = 5
SETTINGS = {
    "sfm": {"max_features": 3000}, "densification": {"n_maps": 2, "n_sources": 2, "step_px": 4, "min_parallax_px": 4.0},
    "scale": {"margin_s": 1.0},
}  # fmt: skip


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """A drive, its keyframes (the second has no images), the lidar's poses, and masks of the left third."""
    folder = tmp_path_factory.mktemp("keyframes")
    write_camera_drive(folder / "drive.mcap", N_IMAGES)
    settings = {"n_images": N_IMAGES, "min_columns": 0, "min_movement_px": 2.0}
    choose_keyframes.main(folder / "drive.mcap", folder / "keyframes.csv", 2, settings)
    save_tables({folder / "poses.csv": tabulate_poses(lidar_poses(N_IMAGES))})
    (folder / "masks").mkdir()
    masks = np.zeros((N_IMAGES, 300, 400), np.uint8)
    masks[:, :, :130] = 5
    DynamicPixels(masks, masks.astype(np.uint16), np.zeros(5, np.float32)).save(folder / "masks" / "00.npz")
    return folder


def run(files, folder, keyframe=0, masks=True, poses="poses.csv", settings=SETTINGS, n_threads=1):
    reconstruct_keyframe.main(
        files / "drive.mcap", files / "keyframes.csv", files / poses, files / "masks" if masks else None, folder / "model",
        folder / "summary.csv", keyframe, settings, 1, n_threads,
    )  # fmt: skip
    return pd.read_csv(folder / "summary.csv").iloc[0]


@pytest.fixture(scope="module")
def made(files, tmp_path_factory):
    folder = tmp_path_factory.mktemp("made")
    return folder, run(files, folder)


def test_clouds_cameras_and_pictures(made):
    folder, summary = made
    assert summary.status == "ok"
    assert summary.n_registered == N_IMAGES
    assert summary.projection_error_px < 1
    # T1 is from the densest points with some distance; how good others would be is told beside it.
    assert summary.projection_error_px == summary.spaced_error_px
    assert len({summary.spaced_error_px, summary.spread_error_px, summary.density_error_px}) == 3
    assert summary.spread_error_px < 1
    model = folder / "model"
    sparse, dense = read_las(model / "sparse.laz"), read_las(model / "dense.laz")
    assert len(sparse) == summary.n_sparse > 200
    assert len(dense) == summary.n_dense > 2000
    for cloud in (sparse, dense):
        assert set(cloud.fields) >= {"rgb", "is_dynamic", "n_views", "classification"}
        # 67 is a car, 1 has no class.
        assert set(np.unique(cloud.fields["classification"][cloud.fields["is_dynamic"] > 0])) == {67}
        assert set(np.unique(cloud.fields["classification"][cloud.fields["is_dynamic"] == 0])) == {1}
    names = {"images", "sparse", "dense", "masks", "dynamic", "points", "features", "errors"}
    assert {path.stem for path in model.glob("*.png")} == names
    # Roads lie 1.6 m below the camera: the cloud is in metres.
    road = dense.points[(np.abs(dense.points[:, 0]) < 2) & (dense.points[:, 2] < 8)]
    assert np.median(road[:, 1] + 0.06 * road[:, 2]) == pytest.approx(1.6, rel=0.03)


def test_colmap_reads_its_text_form(made):
    folder, summary = made
    model = pycolmap.Reconstruction(folder / "model" / "colmap")
    assert (model.num_reg_images(), model.num_points3D()) == (N_IMAGES, summary.n_sparse)
    known = yaml.safe_load((folder / "model" / "cameras.yaml").read_text())
    stored = np.load(folder / "model" / "observations.npz")
    image = model.find_image_with_name("000002.png")
    seen = stored["point"][stored["image"] == 2]
    assert [p.point3D_id - 1 for p in image.points2D] == seen.tolist()
    # What COLMAP projects lies half a pixel to the right of and below our pixel.
    ours = stored["pixel"][stored["image"] == 2]
    theirs = np.array([image.project_point(model.point3D(p + 1).xyz) for p in seen])
    assert np.abs(np.median(theirs - ours, axis=0) - 0.5).max() < 0.1
    T1 = np.array(known["projection"])
    own = stored["image"] == known["reference"]
    points = read_las(folder / "model" / "sparse.laz").points[stored["point"][own]]
    projected = np.c_[points, np.ones(len(points))] @ T1.T
    static = ~read_las(folder / "model" / "sparse.laz").fields["is_dynamic"].astype(bool)[stored["point"][own]]
    error = np.linalg.norm(projected[:, :2] / projected[:, 2:] - stored["pixel"][own], axis=1)[static]
    assert error.mean() == pytest.approx(summary.projection_error_px, abs=0.05)


def test_equal_seeds_and_any_threads_give_equal_clouds(files, made, tmp_path):
    run(files, tmp_path, n_threads=2)
    for name in ("sparse.laz", "dense.laz"):
        first, again = (read_las(folder / "model" / name) for folder in (made[0], tmp_path))
        assert np.array_equal(first.points, again.points)
    assert (made[0] / "model" / "cameras.yaml").read_text() == (tmp_path / "model" / "cameras.yaml").read_text()


def test_a_keyframe_without_images_keeps_its_row(files, tmp_path):
    summary = run(files, tmp_path, keyframe=1)
    assert (summary.status, summary.n_sparse, summary.n_dense) == ("no_images", 0, 0)
    assert list((tmp_path / "model").iterdir()) == []


def test_without_poses_of_the_lidar_there_is_no_unit(files, tmp_path):
    save_tables({files / "lost.csv": tabulate_poses([])})
    light = SETTINGS | {"densification": SETTINGS["densification"] | {"step_px": 16}}
    summary = run(files, tmp_path, poses="lost.csv", masks=False, settings=light)
    assert summary.status == "no_scale"
    assert np.isnan(summary.way_m)
    assert "no unit" in yaml.safe_load((tmp_path / "model" / "cameras.yaml").read_text())["frame"]


def test_cameras_that_turn_otherwise_than_the_lidar_are_refused(files, tmp_path):
    poses = lidar_poses(N_IMAGES)
    for pose in poses:
        yaw = 0.2 * (pose.time_s - poses[0].time_s)
        pose.T_segment_lidar[:3, :3] = transform([0, 0, 0], [0, 0, yaw])[:3, :3]
    save_tables({files / "turning.csv": tabulate_poses(poses)})
    light = SETTINGS | {"densification": SETTINGS["densification"] | {"step_px": 16}}
    summary = run(files, tmp_path, poses="turning.csv", masks=False, settings=light)
    assert summary.status == "disagrees"
    assert "turns of cameras and lidar differ" in summary.reason
    assert summary.turn_off_deg == pytest.approx(np.degrees(0.2 * 0.4), abs=2)
    assert summary.n_dense > 0


def test_every_reason_is_kept(files, tmp_path):
    save_tables({files / "lost.csv": tabulate_poses([])})
    light = SETTINGS | {"densification": SETTINGS["densification"] | {"step_px": 16}, "projection": {"max_error_px": 0.01}}
    summary = run(files, tmp_path, poses="lost.csv", masks=False, settings=light)
    assert summary.status == "no_scale"
    assert "0 frames of the lidar" in summary.reason
    assert "reprojection error" in summary.reason


def test_detectors_that_could_not_be_used_are_a_status(files, tmp_path):
    (tmp_path / "masks").mkdir()
    DynamicPixels.nothing("weights of another network").save(tmp_path / "masks" / "00.npz")
    reconstruct_keyframe.main(
        files / "drive.mcap", files / "keyframes.csv", files / "poses.csv", tmp_path / "masks", tmp_path / "model",
        tmp_path / "summary.csv", 0, SETTINGS, 1, 1,
    )  # fmt: skip
    summary = pd.read_csv(tmp_path / "summary.csv").iloc[0]
    assert (summary.status, summary.reason, summary.n_images) == ("bad_detector", "weights of another network", N_IMAGES)
    assert list((tmp_path / "model").iterdir()) == []


def test_missing_masks_are_one_sentence(files, tmp_path):
    (files / "masks" / "00.npz").rename(files / "masks" / "gone.npz")
    try:
        with pytest.raises(BadInput, match=r"00\.npz"):
            run(files, tmp_path)
    finally:
        (files / "masks" / "gone.npz").rename(files / "masks" / "00.npz")
    assert not (tmp_path / "model").exists()
