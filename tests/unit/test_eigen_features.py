"""Shapes whose eigenvalues are known."""

import numpy as np
import pytest

from streetscan.errors import BadInput
from streetscan.segmentation.baselines.eigen_features import SCALE_FEATURES, NeighbourTree, eigen_features, feature_names
from streetscan.voxels import voxelize


def features_of(points: np.ndarray, neighbours=(9, 25), origin=(650_000.0, 240_000.0, 100.0)) -> tuple[dict, NeighbourTree]:
    """Columns of the features of all voxels of 0.1 m of a cloud, by name."""
    grid = voxelize([np.asarray(points) + origin], 0.1)
    grid.height_m = (grid.mean_z_m - origin[2]).astype(np.float32)
    tree = NeighbourTree(grid)
    values = eigen_features(tree, np.arange(len(grid)), neighbours)
    assert values.shape == (len(grid), len(feature_names(neighbours)))
    assert np.isfinite(values).all()
    return dict(zip(feature_names(neighbours), values.T, strict=True)), tree


def lattice(*counts: int) -> np.ndarray:
    """A point in the middle of each voxel of a box of so many voxels."""
    return (np.stack(np.meshgrid(*(np.arange(n) for n in counts), indexing="ij"), -1).reshape(-1, 3) + 0.5) * 0.1


def test_a_pole_is_linear_and_steep():
    found, _ = features_of(lattice(1, 1, 60))
    inner = slice(15, 45)
    assert found["linearity_9"][inner].min() > 0.999
    assert found["steepness_9"][inner].min() > 0.999
    # Four neighbours above and four below, 0.1 m apart.
    np.testing.assert_allclose(found["radius_m_9"][inner], 0.4, atol=1e-5)
    np.testing.assert_allclose(found["height_range_m_9"][inner], 0.8, atol=1e-5)
    np.testing.assert_allclose(found["height_above_lowest_m_9"][inner], 0.4, atol=1e-5)
    np.testing.assert_allclose(found["height_above_ground_m"], (np.arange(60) + 0.5) * 0.1, atol=1e-4)


def test_ground_is_planar_and_level_and_a_wall_planar_and_upright():
    ground, _ = features_of(lattice(30, 30, 1))
    wall, _ = features_of(lattice(30, 1, 30))
    inside = np.zeros((30, 30), bool)
    inside[5:25, 5:25] = True
    for found, verticality in ((ground, 0.0), (wall, 1.0)):
        # The nine nearest are a square of three by three: two equal eigenvalues and a third of zero.
        assert found["planarity_9"][inside.ravel()].min() > 0.999
        assert found["scattering_25"].max() < 1e-6
        np.testing.assert_allclose(found["verticality_9"][inside.ravel()], verticality, atol=1e-6)


def test_a_crown_scatters():
    rng = np.random.default_rng(0)
    found, _ = features_of(rng.uniform(0, 2, (4000, 3)), (30, 80))
    assert np.median(found["scattering_80"]) > 0.5
    assert np.median(found["linearity_80"]) < 0.35
    assert np.median(found["eigenentropy_80"]) > 1.0  # ln 3 = 1.099 at most
    assert found["eigenentropy_80"].max() <= np.log(3) + 1e-6
    assert found["curvature_80"].max() <= 1 / 3 + 1e-6


def test_the_map_may_turn_about_the_vertical_and_have_few_voxels():
    rng = np.random.default_rng(1)
    points = rng.uniform(0, 1, (300, 3))
    turned = np.stack([-points[:, 1], points[:, 0], points[:, 2]], axis=1)
    a, b = (features_of(p, (10,))[0] for p in (points, turned))
    # Voxels of one lie where the other's do; only ties among neighbours may fall otherwise.
    for name in ("linearity_10", "verticality_10"):
        assert np.abs(np.sort(a[name]) - np.sort(b[name])).mean() < 0.05
    lonely, _ = features_of([[0.0, 0.0, 1.0]], (10, 30))
    assert {float(lonely[f"{name}_30"][0]) for name in ("linearity", "planarity", "radius_m")} == {0.0}
    assert len(lonely) == 2 + 2 * len(SCALE_FEATURES)


def test_threads_and_batches_change_nothing():
    rng = np.random.default_rng(2)
    _, tree = features_of(rng.uniform(0, 3, (3000, 3)))
    rows = np.arange(0, len(tree.points), 7)
    whole = eigen_features(tree, np.arange(len(tree.points)), (10, 30))
    np.testing.assert_array_equal(eigen_features(tree, rows, (10, 30), n_threads=2), whole[rows])


def test_impossible_scales_and_unknown_heights_are_refused():
    _, tree = features_of(lattice(5, 5, 5))
    for neighbours in ((), (30, 10), (2, 10), (10, 10)):
        with pytest.raises(BadInput, match="neighbours"):
            eigen_features(tree, np.arange(5), neighbours)
    tree.grid.height_m[3] = np.nan
    with pytest.raises(BadInput, match="height"):
        eigen_features(tree, np.arange(5), (10,))
