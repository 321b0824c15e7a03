"""NDT: derivatives, known transforms, fields that grow, shrink and are stored."""

import numpy as np
import pytest
from street_frames import pose, scan, street_boxes

from streetscan.errors import BadInput
from streetscan.geometry import apply, invert, rotation_angle, transform
from streetscan.registration.ndt import (
    NdtField,
    NdtSettings,
    _eigen,
    _rotation_of,
    build_fields,
    fit,
    likelihood_constants,
    thin_points,
)


@pytest.fixture(scope="module")
def clouds():
    """Two frames 0.9 m and 1.5 degrees apart, without the road; and the motion."""
    rng, boxes = np.random.default_rng(0), street_boxes()
    T = [pose(0), pose(0.9, 0.05, np.radians(1.5))]
    points = [scan(t, boxes, rng)[0].astype(float) for t in T]
    return [p[p[:, 2] > -1.6] for p in points], invert(T[0]) @ T[1]


def test_derivatives_are_those_of_the_score():
    rng = np.random.default_rng(0)
    # One cube holds everything, so no point crosses a border while the pose is varied.
    target = rng.normal(size=(500, 3)) * [0.5, 0.3, 0.1] + 5
    field = NdtField(10.0)
    field.add(target)
    rotation, translation = _rotation_of(np.array([0.01, 0.02, -0.03])), np.array([0.1, 0.2, 0.05])
    points = target @ rotation + rng.normal(size=target.shape) * 0.05

    def cost(step):
        return field._evaluate(points, _rotation_of(step[3:]) @ rotation, translation + step[:3], False)[0]

    _, gradient, hessian, gauss, n_hit = field._evaluate(points, rotation, translation, True)
    e = 1e-5 * np.eye(6)
    numeric = np.array([(cost(d) - cost(-d)) / 2e-5 for d in e])
    assert np.allclose(gradient, numeric, rtol=1e-5)
    e = 1e-4 * np.eye(6)
    second = np.array([[(cost(a + b) - cost(a - b) - cost(b - a) + cost(-a - b)) / 4e-8 for b in e] for a in e])
    assert np.allclose(hessian, second, atol=1e-5 * np.abs(hessian).max())
    assert (np.linalg.eigvalsh(gauss) > 0).all()
    assert n_hit == len(points)


def test_known_transform_is_recovered(clouds):
    (target, source), T = clouds
    result = fit(build_fields(target, NdtSettings()), thin_points(source, 0.5), np.eye(4), NdtSettings())
    error = invert(T) @ result.T_target_source
    assert np.linalg.norm(error[:3, 3]) < 0.03
    assert rotation_angle(error) < np.radians(0.1)
    assert result.is_converged
    assert result.overlap > 0.6
    assert result.score / result.overlap > 0.3


def test_the_score_of_a_pose_is_that_of_a_fit_that_takes_no_step(clouds):
    (target, source), T = clouds
    settings = NdtSettings(sizes_m=(1.0,), max_iterations=0)
    fields = build_fields(target, settings)
    for at in (T, np.eye(4)):
        assert fields[0].score(source, at) == pytest.approx(fit(fields, source, at, settings).score, rel=1e-12)
    assert fields[0].score(np.empty((0, 3)), T) == 0


def test_exact_copy_with_a_large_motion_comes_back(clouds):
    (target, _), _ = clouds
    T = transform([2.0, -0.5, 0.1], [0.01, -0.01, 0.06])
    result = fit(build_fields(target, NdtSettings()), apply(invert(T), target), np.eye(4), NdtSettings())
    assert np.allclose(result.T_target_source, T, atol=0.01)
    assert np.allclose(result.T_target_source[:3, :3] @ result.T_target_source[:3, :3].T, np.eye(3), atol=1e-12)


def test_far_from_the_origin_the_fit_is_the_same(clouds):
    (target, source), _ = clouds
    settings = NdtSettings()
    near = fit(build_fields(target, settings), thin_points(source, 0.5), np.eye(4), settings)
    # Whole cubes away, so the cubes hold the same points.
    shift = transform([48_000.0, -16_000.0, 400.0])
    far = fit(build_fields(apply(shift, target), settings), thin_points(source, 0.5), shift, settings)
    assert np.allclose(invert(shift) @ far.T_target_source, near.T_target_source, atol=1e-4)


def test_adding_in_parts_is_adding_at_once(clouds):
    (target, _), _ = clouds
    whole, parts = NdtField(1.0), NdtField(1.0)
    whole.add(target)
    for part in np.array_split(target, 7):
        parts.add(part)
    assert whole.n_cells == parts.n_cells
    for a, b in zip(whole.gaussians, parts.gaussians, strict=True):
        assert np.allclose(a, b)


def test_gaussian_of_a_cube_is_its_points_mean_and_covariance():
    points = np.random.default_rng(0).normal([-3.5, -7.5, 2.5], [0.05, 0.1, 0.08], (200, 3))
    field = NdtField(1.0, NdtSettings(noise_m=0.0))
    field.add(points)
    means, precisions, counts = field.gaussians
    inside = points[(np.floor(points) == [-4, -8, 2]).all(axis=1)]
    row = np.argmax(counts)
    assert counts[row] == len(inside)
    assert np.allclose(means[row], inside.mean(axis=0))
    assert np.allclose(np.linalg.inv(precisions[row]), np.cov(inside.T))


def test_flat_cubes_keep_the_noise_of_the_sensor():
    rng = np.random.default_rng(0)
    field = NdtField(1.0, NdtSettings(noise_m=0.02))
    field.add(np.c_[rng.uniform(0, 1, (50, 2)), np.full(50, 0.5)])
    _, precisions, _ = field.gaussians
    assert 1 / np.sqrt(np.linalg.eigvalsh(precisions[0])[-1]) == pytest.approx(0.02)
    one_spot = NdtField(1.0)
    one_spot.add(np.full((10, 3), 0.3))
    assert np.isfinite(one_spot.gaussians[1]).all()


def test_drop_beyond_and_state(clouds):
    (target, source), _ = clouds
    field = NdtField(2.0)
    field.add(target)
    n = field.n_cells
    field.drop_beyond(np.zeros(3), 30.0)
    assert 0 < field.n_cells < n
    assert (np.hypot(*field.gaussians[0][:, :2].T) < 33).all()
    copy = NdtField(2.0)
    copy.restore(**field.state())
    arguments = source, np.eye(3), np.zeros(3), True
    assert copy._evaluate(*arguments)[0] == field._evaluate(*arguments)[0]
    field.drop_beyond(np.zeros(3), 0.0)
    field.add(target)
    assert field.n_cells == n


def test_nothing_to_hold_on_to():
    settings = NdtSettings()
    T = transform([1, 2, 3])
    for target, source in ((np.empty((0, 3)), np.ones((5, 3))), (np.ones((20, 3)), np.empty((0, 3))), (np.zeros((1, 3)), np.zeros((1, 3)))):
        result = fit(build_fields(target, settings), source, T, settings)
        assert result.overlap == 0
        assert np.allclose(result.T_target_source, T)


def test_a_bare_corridor_keeps_the_prediction_along_it():
    rng = np.random.default_rng(0)
    walls = np.concatenate([np.c_[rng.uniform(-60, 60, 20000), np.full(20000, y), rng.uniform(0, 4, 20000)] for y in (-3.5, 3.5)])
    # Short of the walls' ends nothing fixes x.
    source = walls[np.abs(walls[:, 0]) < 30] - [0, 0.1, 0]
    result = fit(build_fields(walls, NdtSettings()), source, np.eye(4), NdtSettings())
    assert result.T_target_source[1, 3] == pytest.approx(0.1, abs=0.02)
    assert abs(result.T_target_source[0, 3]) < 0.3


def test_thinning_means():
    points = np.array([[0.1, 0.1, 0.1], [0.3, 0.1, 0.1], [-0.1, 0.1, 0.1]])
    assert np.allclose(thin_points(points, 0.5), [[0.2, 0.1, 0.1], [-0.1, 0.1, 0.1]])
    assert np.allclose(thin_points(points, 0.0), points)
    assert thin_points(np.empty((0, 3)), 0.5).shape == (0, 3)


def test_eigenvalues_are_lapacks():
    rng = np.random.default_rng(0)
    for _ in range(50):
        a = rng.normal(size=(3, 3)) * rng.choice([1e-3, 1, 100], 3)
        a = a @ a.T
        values, vectors = _eigen(a)
        assert np.allclose(np.sort(values), np.linalg.eigvalsh(a), rtol=1e-7, atol=1e-9 * np.trace(a))
        assert np.allclose(vectors @ np.diag(values) @ vectors.T, a, rtol=1e-7, atol=1e-9 * np.trace(a))


def test_likelihood_constants_fit_the_mixture():
    # Equal to the mixture's logarithm at 0, at one standard deviation and far out (Magnusson, equation 6.8).
    ratio, size = 0.55, 1.0
    d1, d2 = likelihood_constants(ratio, size)
    c1, c2 = 10 * (1 - ratio), ratio / size**3
    for q2 in (0.0, 1.0):
        assert d1 * np.exp(-d2 * q2 / 2) - np.log(c2) == pytest.approx(-np.log(c1 * np.exp(-q2 / 2) + c2))
    assert d1 < 0 < d2


@pytest.mark.parametrize("bad", [{"sizes_m": ()}, {"sizes_m": (1, 0)}, {"n_neighbours": 3}, {"outlier_ratio": 1.0}])
def test_bad_settings(bad):
    with pytest.raises(BadInput):
        NdtSettings(**bad)
