"""The network cube by cube: its shape, its input, its files."""

import numpy as np
import pytest
import torch
import yaml

from streetscan.classes import NAMES
from streetscan.errors import BadInput
from streetscan.segmentation.c2cnn import (
    C2CNN,
    Settings,
    check_same_settings,
    drop,
    extract_cubes,
    grid_channels,
    grid_pillars,
    input_channels,
    load_network,
    save_network,
    turn_keys,
)
from streetscan.voxels import VoxelGrid


def make_grid(keys, counts=None):
    keys = np.array(keys, np.int32)
    keys = keys[np.lexsort(keys.T[::-1])]
    n = len(keys)
    counts = np.arange(1, n + 1, dtype=np.uint32) if counts is None else np.array(counts, np.uint32)
    return VoxelGrid(np.zeros(3), 0.1, keys, counts, np.zeros(n), np.linspace(0, 5, n).astype(np.float32))


def test_the_papers_network_has_its_filters_and_nine_outputs():
    network = C2CNN(Settings())
    assert [tuple(c.weight.shape) for c in network.convolutions] == [(8, 2, 3, 3, 3), (16, 8, 3, 3, 3), (32, 16, 3, 3, 3)]
    assert [layer.kind for layer in network.settings.layers] == ["conv", "pool", "conv", "pool", "conv", "dense"]
    assert [layer.step for layer in network.settings.layers] == [1, 1, 2, 2, 4, 4]
    assert network(torch.zeros(3, 2, 23, 23, 23)).shape == (3, 9)


@pytest.mark.parametrize("k", range(7, 47, 2))
def test_every_odd_size_gives_an_output(k):
    network = C2CNN(Settings(k=k, channels=("occupancy",)))
    assert network(torch.zeros(2, 1, k, k, k)).shape == (2, 9)
    assert sum(layer.kind == "conv" for layer in network.settings.layers) == 3


@pytest.mark.parametrize(("k", "n_poolings"), [(7, 0), (9, 0), (11, 1), (17, 1), (19, 2), (23, 2)])
def test_small_cubes_lose_poolings(k, n_poolings):
    assert sum(layer.kind == "pool" for layer in Settings(k=k).layers) == n_poolings


@pytest.mark.parametrize("k", range(7, 47, 2))
def test_padded_networks_keep_both_poolings(k):
    settings = Settings(k=k, channels=("occupancy",), is_padded=True)
    assert [layer.kind for layer in settings.layers] == ["conv", "pool", "conv", "pool", "conv", "dense"]
    assert settings.layers[-1].width == k // 4
    assert C2CNN(settings)(torch.zeros(2, 1, k, k, k)).shape == (2, 9)


@pytest.mark.parametrize(
    "wrong",
    [
        {"k": 22},
        {"k": 5},
        {"k": 7.5},
        {"size_m": 0.0},
        {"size_m": -0.1},
        {"size_m": float("nan")},
        {"channels": ("colour",)},
        {"channels": ()},
        {"channels": ("count", "count")},
        {"count_scale": "sqrt"},
        {"height_scale_m": 0},
        {"filters": (8, 16)},
        {"dropout": 1.0},
        {"classes": NAMES[:-1]},
        {"classes": NAMES[::-1]},
    ],
)
def test_impossible_settings_are_refused(wrong):
    with pytest.raises(BadInput):
        Settings(**wrong)


def test_a_missing_class_is_named():
    with pytest.raises(BadInput, match="phantom"):
        Settings(classes=tuple(n for n in NAMES if n != "phantom"))


def test_input_channels_by_hand():
    counts, height = np.array([1, 7], np.uint32), np.array([5.0, -40.0], np.float32)
    both = input_channels(counts, height, np.full(len(counts), np.nan), Settings())
    np.testing.assert_allclose(both, [[np.log(2), 0.5], [np.log(8), -1.0]], rtol=1e-6)
    raw = input_channels(counts, height, np.full(len(counts), np.nan), Settings(channels=("occupancy", "count"), count_scale="raw"))
    np.testing.assert_array_equal(raw, [[1, 1], [1, 7]])
    assert raw.dtype == np.float32


def test_spread_by_hand_and_points_without_times():
    counts, height = np.array([1, 2], np.uint32), np.zeros(2, np.float32)
    settings = Settings(channels=("count", "spread"))
    found = input_channels(counts, height, np.array([0.0, 0.9], np.float32), settings)
    np.testing.assert_allclose(found[:, 1], [0, np.log(10)], rtol=1e-6)
    with pytest.raises(BadInput, match="no times"):
        input_channels(counts, height, np.full(2, np.nan, np.float32), settings)


def test_local_counts_by_hand():
    """Two voxels in one square of columns: their mean is 4, as much as ten points say."""
    grid = make_grid([[0, 0, 0], [5, 0, 30]], counts=[2, 6])
    found = grid_channels(grid, Settings(k=11, channels=("count",), count_scale="local"))
    np.testing.assert_allclose(found[:, 0], np.log1p([5, 15]), rtol=1e-6)


def test_pillars_by_hand():
    """One pillar holds two slabs of 24, the other one."""
    grid = make_grid([[0, 0, 0], [1, 0, 25], [50, 0, 50]])
    found = grid_channels(grid, Settings(channels=("occupancy", "pillar")))
    np.testing.assert_allclose(found, [[1, 2 / 24], [1, 2 / 24], [1, 1 / 24]], rtol=1e-6)
    assert grid_pillars(grid, Settings()) is None


def test_unknown_heights_are_refused_only_where_they_are_used():
    counts, height = np.array([1], np.uint32), np.array([np.nan], np.float32)
    with pytest.raises(BadInput, match="height"):
        input_channels(counts, height, np.full(len(counts), np.nan), Settings())
    assert input_channels(counts, height, np.full(len(counts), np.nan), Settings(channels=("count",))).shape == (1, 1)


def test_turning_by_hand():
    np.testing.assert_array_equal(turn_keys(np.array([[1, 0, 5]]), 1), [[0, 1, 5]])
    np.testing.assert_array_equal(turn_keys(np.array([[1, 2, 3]] * 4), np.arange(4)), [[1, 2, 3], [-2, 1, 3], [-1, -2, 3], [2, -1, 3]])


def test_a_cube_shows_the_neighbours_at_their_offsets():
    grid = make_grid([[0, 0, 0], [1, 0, 0], [0, -2, 0], [0, 0, 3], [50, 0, 0]], counts=[1, 2, 3, 4, 5])
    cube = extract_cubes(grid, grid.counts[:, None].astype(np.float32), np.array([[0, 0, 0]]), np.array([0]), 7)[0, 0]
    at = {tuple(key): count for key, count in zip(grid.keys.tolist(), grid.counts, strict=True)}
    assert np.count_nonzero(cube) == 4
    assert cube[3, 3, 3] == at[0, 0, 0]
    assert cube[4, 3, 3] == at[1, 0, 0]
    assert cube[3, 1, 3] == at[0, -2, 0]
    assert cube[3, 3, 6] == at[0, 0, 3]


def test_a_turned_cube_is_the_cube_of_the_turned_map():
    rng = np.random.default_rng(0)
    keys = np.unique(rng.integers(-5, 6, (200, 3)), axis=0)
    grid = make_grid(keys)
    channels = rng.random((len(keys), 2)).astype(np.float32)
    for turn in range(4):
        turned = turn_keys(grid.keys, turn)
        order = np.lexsort(turned.T[::-1])
        turned_grid = VoxelGrid(grid.origin, 0.1, turned[order].astype(np.int32), *(np.zeros(len(keys)),) * 3)
        ours = extract_cubes(grid, channels, grid.keys[:5], np.full(5, turn), 9)
        expected = extract_cubes(turned_grid, channels[order], turn_keys(grid.keys[:5], turn), np.zeros(5, int), 9)
        np.testing.assert_array_equal(ours, expected)


def test_dropout_removes_its_share_and_keeps_the_mean():
    x = torch.ones(200, 200)
    dropped = drop(x, 0.3, torch.Generator().manual_seed(1))
    assert float((dropped == 0).float().mean()) == pytest.approx(0.3, abs=0.01)
    assert float(dropped.mean()) == pytest.approx(1.0, abs=0.01)
    assert drop(x, 0.3, None) is x


def test_equal_seeds_give_equal_weights():
    a, b, c = (torch.cat([p.flatten() for p in C2CNN(Settings(k=9), seed).parameters()]) for seed in (1, 1, 2))
    assert torch.equal(a, b)
    assert not torch.equal(a, c)


def test_a_network_survives_its_files(tmp_path):
    network = C2CNN(Settings(k=9, channels=("count",), count_scale="raw", n_hidden=12), seed=3).eval()
    save_network(network, tmp_path / "w.safetensors", tmp_path / "s.yaml")
    loaded = load_network(tmp_path / "w.safetensors", tmp_path / "s.yaml")
    assert loaded.settings == network.settings
    cubes = torch.rand(2, 1, 9, 9, 9)
    assert torch.equal(loaded(cubes), network(cubes))


def test_weights_of_other_settings_are_refused(tmp_path):
    weights, settings = tmp_path / "w.safetensors", tmp_path / "s.yaml"
    save_network(C2CNN(Settings(k=9)), weights, settings)
    Settings(k=9, channels=("occupancy",)).save(settings)
    with pytest.raises(BadInput, match="other settings"):
        load_network(weights, settings)
    with pytest.raises(BadInput, match="k is 9, not 23"):
        check_same_settings(Settings(k=9), Settings(), "w")
    check_same_settings(Settings(dropout=0.1), Settings(), "w")


def test_damaged_files_are_refused(tmp_path):
    weights, settings = tmp_path / "w.safetensors", tmp_path / "s.yaml"
    save_network(C2CNN(Settings(k=9)), weights, settings)
    content = weights.read_bytes()
    for damaged in (b"", content[:40], content[:-100]):
        weights.write_bytes(damaged)
        with pytest.raises(BadInput, match=str(weights)):
            load_network(weights, settings)
    with pytest.raises(BadInput):
        load_network(tmp_path / "none.safetensors", settings)
    known = yaml.safe_load(settings.read_text())
    for text in ("", "[1", yaml.dump({"k": 9}), yaml.dump(known | {"colour": 1}), yaml.dump(known | {"k": "many"}), "\x00"):
        settings.write_text(text)
        with pytest.raises(BadInput):
            Settings.load(settings)


def test_weights_that_are_no_numbers_are_refused(tmp_path):
    network = C2CNN(Settings(k=9))
    with torch.no_grad():
        network.output.bias[0] = float("nan")
    save_network(network, tmp_path / "w.safetensors", tmp_path / "s.yaml")
    with pytest.raises(BadInput, match="NaN"):
        load_network(tmp_path / "w.safetensors", tmp_path / "s.yaml")
