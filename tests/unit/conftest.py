"""A rendered street and what structure from motion makes of it, made once."""

import pytest
from toy_camera import ToyStreet, toy_camera, toy_images

from streetscan.calibration.sfm import SparseModel, reconstruct


@pytest.fixture(scope="session")
def toy_street() -> ToyStreet:
    """Five images; treat them as read-only."""
    camera = toy_camera()
    return ToyStreet(camera, *toy_images(5, camera))


@pytest.fixture(scope="session")
def toy_model(toy_street) -> SparseModel:
    """Its cameras and sparse points."""
    return reconstruct(toy_street.images, toy_street.camera, seed=1)
