"""A rendered street and what structure from motion makes of it, and a part of a map to train on, made once."""

import pytest
from toy_camera import ToyStreet, toy_camera, toy_images
from toy_parts import make_part

from streetscan.calibration.sfm import SparseModel, reconstruct
from streetscan.segmentation.training import Part


@pytest.fixture(scope="session")
def toy_street() -> ToyStreet:
    """Five images; treat them as read-only."""
    camera = toy_camera()
    return ToyStreet(camera, *toy_images(5, camera))


@pytest.fixture(scope="session")
def toy_model(toy_street) -> SparseModel:
    """Its cameras and sparse points."""
    return reconstruct(toy_street.images, toy_street.camera, seed=1)


@pytest.fixture(scope="session")
def toy_part() -> Part:
    """A floor, a wall and clutter with samples of each; treat it as read-only."""
    return make_part(1)
