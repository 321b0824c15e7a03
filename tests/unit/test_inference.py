"""Labels of a map: groups of tiles change nothing, every voxel and point is labelled once."""

import numpy as np
import pytest
import torch

from streetscan.clouds import PointCloud
from streetscan.errors import BadInput
from streetscan.segmentation import inference
from streetscan.segmentation.c2cnn import C2CNN, Settings, extract_cubes, input_channels
from streetscan.segmentation.inference import assign_tiles, label_points, label_voxels, parse_tiles
from streetscan.segmentation.smoothing import Smoothing
from streetscan.voxels import voxelize

NETWORK = C2CNN(Settings(k=11), seed=4).eval()


@pytest.fixture(scope="module")
def cloud():
    rng = np.random.default_rng(0)
    points = rng.random((4000, 3)) * [12, 7, 3] + [-653_000.0, 240_000.0, -20.0]
    return PointCloud(points, {"intensity": rng.integers(0, 9, 4000).astype(np.uint16)})


@pytest.fixture(scope="module")
def grid(cloud):
    grid = voxelize([cloud.points], 0.1)
    grid.height_m[:] = grid.mean_z_m + 20
    return grid


def test_labels_are_those_of_the_cubes(grid):
    rows, labels, confidence = label_voxels(NETWORK, grid, 4.0)[:3]
    assert (rows == np.arange(len(grid))).all()
    picked = rows[::50]
    cubes = extract_cubes(
        grid, input_channels(grid.counts, grid.height_m, grid.spread_s, NETWORK.settings), grid.keys[picked], np.zeros(len(picked)), 11
    )
    with torch.no_grad():
        shares = torch.softmax(NETWORK(torch.from_numpy(cubes)), 1).numpy()
    np.testing.assert_array_equal(labels[picked], shares.argmax(1))
    np.testing.assert_allclose(confidence[picked], shares.max(1), atol=1e-5)


def test_turns_are_looked_at_together(grid):
    """Every label is that of the mean over the turned cubes; a turned map has the same labels."""
    _, labels, confidence = label_voxels(NETWORK, grid, 4.0, n_turns=4)[:3]
    picked = np.arange(len(grid))[::50]
    channels = input_channels(grid.counts, grid.height_m, grid.spread_s, NETWORK.settings)
    with torch.no_grad():
        cubes = [extract_cubes(grid, channels, grid.keys[picked], np.full(len(picked), turn), 11) for turn in range(4)]
        shares = np.mean([torch.softmax(NETWORK(torch.from_numpy(c)), 1).numpy() for c in cubes], axis=0)
    np.testing.assert_array_equal(labels[picked], shares.argmax(1))
    np.testing.assert_allclose(confidence[picked], shares.max(1), atol=1e-5)
    one = label_voxels(NETWORK, grid, 4.0)[1]
    assert (one != labels).any()


def test_nine_groups_give_what_one_gives(grid):
    whole = label_voxels(NETWORK, grid, 2.0)
    parts = [label_voxels(NETWORK, grid, 2.0, k, 9) for k in range(9)]
    rows = np.concatenate([p[0] for p in parts])
    order = np.argsort(rows)
    np.testing.assert_array_equal(rows[order], whole[0])
    for i in (1, 2):
        np.testing.assert_array_equal(np.concatenate([p[i] for p in parts])[order], whole[i])


@pytest.mark.parametrize("n_groups", [3, 9])
def test_groups_smooth_as_the_whole_map_does(grid, n_groups):
    smoothing = Smoothing(cell_voxels=2, n_rounds=3)
    whole = label_voxels(NETWORK, grid, 1.0, smoothing=smoothing)
    parts = [label_voxels(NETWORK, grid, 1.0, k, n_groups, smoothing=smoothing) for k in range(n_groups)]
    order = np.argsort(np.concatenate([p.rows for p in parts]))
    for name in ("rows", "labels", "alone"):
        np.testing.assert_array_equal(np.concatenate([getattr(p, name) for p in parts])[order], getattr(whole, name))
    np.testing.assert_allclose(np.concatenate([p.confidence for p in parts])[order], whole.confidence, atol=1e-5)
    np.testing.assert_array_equal(whole.alone, label_voxels(NETWORK, grid, 1.0).labels)
    assert (whole.alone != whole.labels).any()


def test_threads_change_nothing(grid):
    for a, b in zip(label_voxels(NETWORK, grid, 2.0), label_voxels(NETWORK, grid, 2.0, n_threads=3), strict=True):
        np.testing.assert_array_equal(a, b)


def test_splitting_a_tile_changes_no_label(grid, monkeypatch):
    whole = label_voxels(NETWORK, grid, 20.0)
    monkeypatch.setattr(inference, "_MAX_WANTED", 100)
    split = label_voxels(NETWORK, grid, 20.0)
    np.testing.assert_array_equal(split[1], whole[1])
    np.testing.assert_allclose(split[2], whole[2], atol=1e-5)


def test_a_stray_point_far_above_makes_no_tower():
    """What is evaluated together stays within a box, however far apart voxels lie."""
    keys = np.array([[0, 0, 0], [3, 0, 1], [5, 5, 100_000], [0, 700, 2], [0, 705, 3]])
    parts = list(inference._split(keys, np.arange(5)))
    assert sorted(np.concatenate(parts).tolist()) == [0, 1, 2, 3, 4]
    assert [sorted(part.tolist()) for part in parts if 0 in part] == [[0, 1]]
    assert all((np.ptp(keys[part], axis=0) < inference._MAX_EXTENT).all() for part in parts)


def test_only_quarter_turns_are_looked_at(grid):
    with pytest.raises(BadInput, match="1, 2 or 4"):
        label_voxels(NETWORK, grid, 20.0, n_turns=3)


def test_tiles_are_squares_and_groups_are_even(grid):
    tile, group = assign_tiles(grid, 2.0, 4)
    for i in np.unique(tile):
        assert np.ptp(grid.keys[tile == i, :2], axis=0).max() < 20
    n_voxels = np.bincount(group[tile], minlength=4)
    assert n_voxels.min() > 0.5 * n_voxels.max()
    assert (np.diff(group) >= 0).all()


def test_more_groups_than_tiles_leave_some_empty(grid):
    results = [label_voxels(NETWORK, grid, 100.0, k, 3) for k in range(3)]
    assert sorted(len(r[0]) for r in results) == [0, 0, len(grid)]


def test_every_point_is_labelled_once(cloud, grid):
    chunks = [cloud.select(slice(0, 1500)), cloud.select(slice(1500, None))]
    n = 0
    for k in range(3):
        rows, labels, confidence = label_voxels(NETWORK, grid, 2.0, k, 3)[:3]
        for part in label_points(chunks, grid, rows, labels, confidence):
            at = np.searchsorted(rows, grid.find(grid.keys_of(part.points)))
            np.testing.assert_array_equal(part.fields["label"], labels[at])
            np.testing.assert_array_equal(part.fields["confidence"], confidence[at])
            assert "intensity" in part.fields
            n += len(part)
    assert n == len(cloud)


def test_a_group_without_points_yields_one_empty_cloud_with_all_fields(cloud, grid):
    empty = np.empty(0, np.int64)
    clouds = list(label_points([cloud, cloud], grid, empty, empty.astype(np.uint8), empty.astype(np.float32)))
    assert [len(c) for c in clouds] == [0]
    assert set(clouds[0].fields) == {"intensity", "label", "confidence"}


def test_points_outside_the_grid_are_refused(grid):
    with pytest.raises(BadInput, match="no voxel"):
        list(label_points([PointCloud(grid.centres[:1] + np.array([0, 0, 50.0]))], grid, *label_voxels(NETWORK, grid, 5.0)[:3]))


def test_other_voxel_sizes_and_unknown_heights_are_refused(cloud, grid):
    with pytest.raises(BadInput, match="other settings"):
        label_voxels(NETWORK, voxelize([cloud.points], 0.2), 5.0)
    with pytest.raises(BadInput, match="height"):
        label_voxels(NETWORK, voxelize([cloud.points], 0.1), 5.0)
    with pytest.raises(BadInput, match="tile_m"):
        label_voxels(NETWORK, grid, 0.0)


def test_names_of_groups():
    assert parse_tiles("3of9") == (3, 9)
    for wrong in ("9of9", "0of0", "of3", "1/3", "-1of3"):
        with pytest.raises(BadInput):
            parse_tiles(wrong)
