"""EPnP on chosen points."""

import numpy as np
import pytest
from toy_camera import toy_camera

from streetscan.calibration.projection import (
    ProjectionSettings,
    choose_dense,
    choose_spaced,
    choose_spread,
    estimate_projection,
    project_pinhole,
)
from streetscan.errors import BadInput
from streetscan.geometry import transform

K = toy_camera().K


def seen_points(n: int = 120) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(2)
    T = transform([0.3, -0.2, 1.0], [0.05, -0.1, 0.02])
    points = np.c_[rng.uniform(-6, 6, n), rng.uniform(-3, 2, n), rng.uniform(8, 30, n)]
    return points, project_pinhole(points, K, T), T


@pytest.mark.parametrize("selection", ["density", "spaced", "spread"])
def test_the_pose_is_found(selection):
    points, pixels, T = seen_points()
    found = estimate_projection(points, pixels, K, ProjectionSettings(selection=selection))
    assert len(found.chosen) == 45
    assert np.allclose(found.T_camera_sfm, T, atol=1e-4)
    assert found.mean_error_px < 1e-2
    one = found.matrix(K) @ np.append(points[3], 1)
    assert np.allclose(one[:2] / one[2], pixels[3], atol=0.02)


def test_errors_are_of_all_points_not_of_the_chosen():
    points, pixels, _ = seen_points()
    pixels[7] = -900, -900
    found = estimate_projection(points, pixels, K, ProjectionSettings())
    assert 7 not in found.chosen
    assert found.errors_px[7] > 500
    assert np.median(found.errors_px) < 0.1


def test_the_densest_by_hand():
    pixels = np.array([[0, 0], [10, 0], [20, 0], [100, 0], [101, 0], [300, 0]], float)
    # Within 15 px: 1, 2, 1, 1, 1, 0 others; 0 and 2 are near 1, and 4 is near 3.
    assert choose_dense(pixels, 3, 15.0).tolist() == [1, 0, 2]
    assert choose_spaced(pixels, 3, 15.0).tolist() == [1, 3, 0]
    assert choose_spaced(pixels, 99, 15.0).tolist() == [1, 3, 0, 2, 4, 5]


def test_the_densest_all_lie_in_one_spot():
    """Why some distance is asked for: most features of an image are where its texture is."""
    grid = 60.0 * np.stack(np.meshgrid(np.arange(10), np.arange(10)), axis=-1).reshape(-1, 2)
    pixels = np.concatenate([grid, np.random.default_rng(0).normal(-150, 8, (50, 2))])
    assert (choose_dense(pixels, 45, 50.0) >= 100).all()
    assert (choose_spaced(pixels, 45, 50.0) >= 100).sum() < 3


def test_spread_by_hand():
    pixels = np.array([[0, 0], [48, 0], [50, 0], [52, 0], [100, 0]], float)
    assert choose_spread(pixels, 3).tolist() in ([2, 0, 4], [2, 4, 0])


def test_behind_the_camera_is_nowhere():
    assert np.isnan(project_pinhole(np.array([[0, 0, -1.0]]), K, np.eye(4))).all()


def test_too_little_is_refused():
    points, pixels, _ = seen_points(3)
    with pytest.raises(ValueError, match="3 static points"):
        estimate_projection(points, pixels, K)
    with pytest.raises(BadInput, match="selection"):
        ProjectionSettings(selection="best")
    with pytest.raises(BadInput, match="n_points"):
        ProjectionSettings(n_points=3)
