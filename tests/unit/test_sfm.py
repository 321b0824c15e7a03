"""Structure from motion on rendered streets whose cameras and depths are known."""

from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import map_coordinates
from toy_camera import toy_camera

from streetscan.calibration import sfm
from streetscan.calibration.sfm import ReconstructionFailed, SfmSettings, majority_labels, reconstruct
from streetscan.errors import BadInput
from streetscan.geometry import invert, rotation_angle


def centres(T_camera_frame: np.ndarray) -> np.ndarray:
    return invert(T_camera_frame)[:, :3, 3]


def test_cameras_and_points_are_found_up_to_a_similarity(toy_street, toy_model):
    found, true = centres(toy_model.T_camera_sfm), toy_street.poses[:, :3, 3]
    ways, true_ways = (np.linalg.norm(np.diff(c, axis=0), axis=1) for c in (found, true))
    assert np.abs(ways / true_ways / np.mean(ways / true_ways) - 1).max() < 0.02
    turns = invert(toy_model.T_camera_sfm[:1] @ invert(toy_model.T_camera_sfm)) @ (invert(toy_street.poses[:1]) @ toy_street.poses)
    assert np.degrees(rotation_angle(turns)).max() < 0.1
    assert toy_model.errors_px.mean() < 0.3


def test_observations_lie_where_the_street_is_seen_with_pixel_centres_at_integers(toy_street, toy_model):
    """Half a pixel of difference in the convention would show as a bias of half a pixel against the rendered depths."""
    m, camera = toy_model, toy_street.camera
    first, last = (dict(zip(m.point_of[m.image_of == i], m.pixels[m.image_of == i], strict=True)) for i in (0, 4))
    both = sorted(set(first) & set(last))
    here, there = np.array([first[p] for p in both]), np.array([last[p] for p in both])
    inverse = map_coordinates(1 / toy_street.depths[0], [here[:, 1], here[:, 0]], order=1)
    points = np.c_[(here - camera.K[:2, 2]) / camera.K[[0, 1], [0, 1]], np.ones(len(here))] / inverse[:, None]
    T = invert(toy_street.poses[4]) @ toy_street.poses[0]
    seen = (points @ T[:3, :3].T + T[:3, 3]) @ camera.K.T
    assert np.abs(np.median(there - seen[:, :2] / seen[:, 2:], axis=0)).max() < 0.05
    # The sparse points are those points, too.
    way, true_way = (np.linalg.norm(c[4] - c[0]) for c in (centres(m.T_camera_sfm), toy_street.poses[:, :3, 3]))
    found = (m.points[both] @ m.T_camera_sfm[0, :3, :3].T + m.T_camera_sfm[0, :3, 3]) * true_way / way
    near = points[:, 2] < 15
    assert np.median(np.abs(found[near, 2] / points[near, 2] - 1)) < 0.012


def test_a_spot_is_a_feature_at_its_middle(tmp_path):
    camera = toy_camera(120, 90)
    v, u = np.mgrid[:90, :120]
    image = np.rint(220 * np.exp(-((u - 60) ** 2 + (v - 40) ** 2) / 32)).astype(np.uint8)
    work = sfm._Colmap(tmp_path, [np.repeat(image[..., None], 3, axis=2)], camera, SfmSettings(), 0, 1)
    features = work.extract()[0]
    assert np.abs(features - [60, 40]).max(axis=1).min() < 0.05


def test_equal_seeds_give_equal_numbers(toy_street, toy_model):
    again = reconstruct(toy_street.images, toy_street.camera, seed=1)
    for name, values in vars(toy_model).items():
        assert np.array_equal(values, getattr(again, name), equal_nan=True), name


def test_points_on_moving_things_are_labelled_and_keep_out_of_the_cameras(toy_street, toy_model):
    masks = np.zeros((5, *toy_street.images[0].shape[:2]), np.uint8)
    masks[:, :, :130] = 5
    model = reconstruct(toy_street.images, toy_street.camera, masks, seed=1)
    is_left = np.bincount(model.point_of, model.pixels[:, 0] < 130, minlength=len(model.points)) >= model.n_views / 2
    assert (model.labels[is_left] == 5).mean() > 0.95
    assert (model.labels[~is_left] == 0).mean() > 0.95
    assert 20 < (model.labels == 5).sum() < len(model.points) / 2
    ways = np.linalg.norm(np.diff(centres(model.T_camera_sfm), axis=0), axis=1)
    true_ways = np.linalg.norm(np.diff(toy_street.poses[:, :3, 3], axis=0), axis=1)
    assert np.abs(ways / true_ways / np.mean(ways / true_ways) - 1).max() < 0.03


def test_labels_by_hand():
    labels = majority_labels(np.array([0, 0, 0, 1, 1, 2, 2, 2]), np.array([5, 0, 0, 4, 0, 4, 5, 5], np.uint8), 4)
    assert labels.tolist() == [0, 4, 5, 0]


def test_a_similarity_moves_points_and_cameras_alike(toy_model):
    T = np.eye(4)
    T[:3] *= 2.5
    T[:3, 3] = 1, -2, 3
    moved = toy_model.transformed(T)
    rows = toy_model.image_of == 2
    seen = [m.points[m.point_of[rows]] @ m.T_camera_sfm[2, :3, :3].T + m.T_camera_sfm[2, :3, 3] for m in (toy_model, moved)]
    assert np.allclose(seen[1], 2.5 * seen[0])
    assert np.allclose(np.linalg.det(moved.T_camera_sfm[:, :3, :3]), 1)


@pytest.mark.parametrize(
    ("make", "status", "reason"),
    [
        (lambda images: images[:2], "bad_images", "2 images"),
        (lambda images: [*images[:3], images[3][:-1]], "bad_images", "400 x 299, 400 x 300"),
        (lambda images: [np.full_like(image, 255) for image in images], "not_matched", "in common"),
        (lambda images: [images[0]] * 4, "not_registered", "hardly move|registered"),
    ],
)
def test_what_cannot_be_reconstructed_says_why(toy_street, make, status, reason):
    with pytest.raises(ReconstructionFailed, match=reason) as failure:
        reconstruct(make(toy_street.images), toy_street.camera)
    assert failure.value.status == status


def test_wrong_masks_and_settings_are_refused(toy_street):
    with pytest.raises(BadInput, match="masks"):
        reconstruct(toy_street.images, toy_street.camera, np.zeros((5, 3, 3), np.uint8))
    with pytest.raises(BadInput, match="mapper"):
        SfmSettings(mapper="magic")


def test_no_files_are_left_behind(toy_street, tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    with pytest.raises(ReconstructionFailed):
        reconstruct([np.full_like(image, 255) for image in toy_street.images], toy_street.camera)
    assert list(Path(tmp_path).iterdir()) == []
