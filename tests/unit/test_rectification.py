"""Rectified images against cameras whose distortion is known."""

from dataclasses import replace

import numpy as np
import pytest

from streetscan.calibration.rectification import rectify_image
from streetscan.errors import BadInput
from streetscan.frames import CameraModel
from streetscan.simulation.camera import Camera, pixel_rays

CAMERA = Camera(width=160, height=120, focal_px=120.0).model


def _blob(camera: CameraModel, centre_px: np.ndarray) -> np.ndarray:
    """A round spot of 2 pixels' deviation around a place."""
    v, u = np.mgrid[: camera.height, : camera.width]
    return np.rint(200 * np.exp(-((u - centre_px[0]) ** 2 + (v - centre_px[1]) ** 2) / 8)).astype(np.uint8)


def _centre(image: np.ndarray) -> np.ndarray:
    v, u = np.mgrid[: image.shape[0], : image.shape[1]]
    return np.array([(u * image).sum(), (v * image).sum()]) / image.sum()


@pytest.mark.parametrize("place_px", [(20.0, 15.0), (140.0, 100.0), (79.5, 59.5)])
def test_a_spot_moves_where_the_pinhole_camera_sees_it(place_px):
    rectified = rectify_image(_blob(CAMERA, np.array(place_px)), CAMERA)
    expected = pixel_rays(np.array([place_px]), CAMERA)[0] * CAMERA.K[[0, 1], [0, 1]] + CAMERA.K[:2, 2]
    assert np.abs(_centre(rectified) - expected).max() < 0.05


def test_without_distortion_the_image_stays():
    image = np.random.default_rng(0).integers(0, 255, (120, 160, 3), dtype=np.uint8)
    for D in (np.zeros(0), np.zeros(5)):
        assert np.array_equal(rectify_image(image, replace(CAMERA, D=D)), image)


def test_a_fisheye_lens_is_rectified():
    camera = replace(CAMERA, D=np.array([0.05, -0.01, 0.0, 0.0]), distortion_model="kannala_brandt")
    xy = np.array([0.4, -0.2])
    r = np.hypot(*xy)
    theta = np.arctan(r)
    seen = xy / r * (theta + 0.05 * theta**3 - 0.01 * theta**5) * 120 + camera.K[:2, 2]
    assert np.abs(_centre(rectify_image(_blob(camera, seen), camera)) - (xy * 120 + camera.K[:2, 2])).max() < 0.1


@pytest.mark.parametrize(
    ("change", "found"),
    [
        ({"K": np.diag([0.0, 120, 1])}, "no camera matrix"),
        ({"distortion_model": "thin_prism"}, "thin_prism"),
        ({"D": np.array([np.nan, 0, 0, 0])}, "finite coefficients"),
        ({"width": 0}, "0 x 120"),
        ({"width": 200}, "160 x 120 pixels for intrinsics of 200 x 120"),
    ],
)
def test_unusable_intrinsics_are_one_sentence(change, found):
    with pytest.raises(BadInput, match=found):
        rectify_image(np.zeros((120, 160), np.uint8), replace(CAMERA, **change), "drive.mcap")


def test_missing_intrinsics_are_one_sentence():
    with pytest.raises(BadInput, match="holds no intrinsics"):
        rectify_image(np.zeros((120, 160), np.uint8), None, "drive.mcap")
