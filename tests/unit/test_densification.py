"""PatchMatch on slanted textured planes whose depths are known."""

from dataclasses import replace

import numpy as np
import pytest

from streetscan.calibration.densification import DensificationSettings, densify
from streetscan.calibration.sfm import ReconstructionFailed
from streetscan.errors import BadInput
from streetscan.geometry import invert

SETTINGS = DensificationSettings(n_maps=2, n_sources=2, step_px=3, min_parallax_px=4.0)


@pytest.fixture(scope="module")
def true_model(toy_model, toy_street):
    """The sparse model with the true cameras, in the frame of the first one; its points in metres."""
    found = invert(toy_model.T_camera_sfm)[:, :3, 3]
    scale = np.linalg.norm(toy_street.poses[4, :3, 3]) / np.linalg.norm(found[4] - found[0])
    T = toy_model.T_camera_sfm[0].copy()
    T[:3] *= scale
    return replace(toy_model.transformed(T), T_camera_sfm=invert(toy_street.poses))


@pytest.fixture(scope="module")
def cloud(toy_street, true_model):
    masks = np.zeros((5, *toy_street.images[0].shape[:2]), np.uint8)
    masks[:, 200:, :] = 5
    return densify(toy_street.images, toy_street.camera.K, true_model, masks, SETTINGS, seed=1)


def true_depths(toy_street, points: np.ndarray) -> np.ndarray:
    """Depth of the street in the first image where each point is seen; NaN outside."""
    pixels = np.rint((points / points[:, 2:]) @ toy_street.camera.K.T)[:, :2].astype(int)
    height, width = toy_street.depths[0].shape
    inside = (points[:, 2] > 0) & (pixels >= 0).all(axis=1) & (pixels < [width, height]).all(axis=1)
    depths = np.full(len(points), np.nan)
    depths[inside] = toy_street.depths[0][pixels[inside, 1], pixels[inside, 0]]
    return depths


def test_slanted_planes_are_found(toy_street, cloud):
    depths = true_depths(toy_street, cloud.points)
    near = depths < 12
    error = np.abs(cloud.points[near, 2] / depths[near] - 1)
    assert len(cloud) > 3000
    assert near.sum() > 2000
    assert np.median(error) < 0.01
    assert np.quantile(error, 0.9) < 0.05


def test_points_know_colour_views_and_what_moves(toy_street, cloud):
    assert (cloud.n_views == 2).all()
    pixels = (cloud.points / cloud.points[:, 2:]) @ toy_street.camera.K.T
    seen = (pixels[:, 1] > 0) & (pixels[:, 1] < 150)
    assert (cloud.labels[seen] == 0).mean() > 0.99
    below = (pixels[:, 1] > 205) & (pixels[:, 1] < 230)
    assert below.sum() > 50
    assert (cloud.labels[below] == 5).mean() > 0.95
    grey = np.array(toy_street.images)[..., 0]
    assert abs(cloud.colours.mean() - grey.mean()) < 15
    assert cloud.colours.std() > 10


def test_threads_change_nothing_and_seeds_little(toy_street, true_model, cloud):
    again = densify(toy_street.images, toy_street.camera.K, true_model, None, SETTINGS, seed=1, n_threads=2)
    assert np.array_equal(again.points, cloud.points)
    assert not again.labels.any()


def test_without_texture_there_is_nothing(toy_street, true_model):
    blank = [np.full_like(image, 128) for image in toy_street.images]
    assert len(densify(blank, toy_street.camera.K, true_model, None, SETTINGS)) == 0


def seen_only(model, image: int, keep: np.ndarray):
    """The model, of which an image observes those of its observations alone that are kept."""
    rows = np.flatnonzero(model.image_of == image)
    kept = np.setdiff1d(np.arange(len(model.image_of)), rows[~keep])
    names = ("point_of", "image_of", "feature_of", "pixels")
    return replace(model, **{name: getattr(model, name)[kept] for name in names})


def test_an_image_that_sees_too_few_points_or_a_line_has_no_map(toy_street, true_model):
    """The last image sees nothing, two points, or points on a line; the other two maps stay."""
    three = replace(SETTINGS, n_maps=3)
    n = int((true_model.image_of == 4).sum())
    on_a_line = replace(true_model, pixels=true_model.pixels.copy())
    on_a_line.pixels[true_model.image_of == 4, 1] = 150.0
    poor = [seen_only(true_model, 4, np.arange(n) < k) for k in (0, 2)]
    for model in (*poor, on_a_line):
        assert len(densify(toy_street.images, toy_street.camera.K, model, None, three)) > 1000
        with pytest.raises(ReconstructionFailed, match="1 of 2 images") as failure:
            densify(toy_street.images, toy_street.camera.K, model, None, SETTINGS)
        assert failure.value.status == "not_dense"


def test_far_points_are_left_out(toy_street, true_model):
    strict = replace(SETTINGS, min_parallax_px=1e4)
    assert len(densify(toy_street.images, toy_street.camera.K, true_model, None, strict)) == 0


def test_more_views_than_maps_cannot_agree():
    with pytest.raises(BadInput, match="min_views"):
        DensificationSettings(n_maps=2, min_views=3)
