"""The sparse evaluator gives what the network gives cube by cube: logits, gradients, with any shape of the map."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.nn.functional import cross_entropy

from streetscan.segmentation import kernels_gpu, sparse
from streetscan.segmentation.c2cnn import C2CNN, Settings, extract_cubes
from streetscan.segmentation.kernels_cpu import _bitmap, _rank, _spread, find_sites
from streetscan.segmentation.sparse import sparse_logits
from streetscan.voxels import VoxelGrid


def make_network(k=23, channels=("count", "height"), **more):
    network = C2CNN(Settings(k=k, channels=channels, **more), seed=5)
    # Zero biases would hide mistakes in the value of empty space.
    generator = torch.Generator().manual_seed(2)
    with torch.no_grad():
        for layer in (*network.convolutions, network.hidden, network.output):
            layer.bias.uniform_(-0.4, 0.4, generator=generator)
    return network


def make_scene(seed, n=400, extent=(60, 40, 30), n_channels=2):
    rng = np.random.default_rng(seed)
    keys = np.concatenate([rng.integers(0, extent, (n, 3)), np.c_[rng.integers(0, extent[:2], (2 * n, 2)), np.zeros(2 * n, int)]])
    keys = np.unique(keys - 11, axis=0).astype(np.int32)
    channels = rng.uniform(0.1, 2, (len(keys), n_channels)).astype(np.float32)
    return VoxelGrid(np.zeros(3), 0.1, keys, *(np.ones(len(keys)),) * 3), channels


@pytest.fixture(params=["cpu", "gpu"])
def kernels(request, monkeypatch):
    """The kernels of the processor, and those of a GPU, which run on the processor, too."""
    if request.param == "gpu":
        monkeypatch.setattr(sparse, "_kernels_of", lambda _: kernels_gpu)


def compare(network, grid, channels, wanted):
    cubes = torch.from_numpy(extract_cubes(grid, channels, wanted, np.zeros(len(wanted), int), network.settings.k))
    labels = torch.arange(len(wanted)) % 9
    results = []
    for logits in (network(cubes), sparse_logits(network, channels, grid.keys, wanted)):
        gradients = torch.autograd.grad(cross_entropy(logits, labels), list(network.parameters()))
        results.append((logits.detach().numpy(), [g.numpy() for g in gradients]))
    (expected, expected_gradients), (ours, our_gradients) = results
    np.testing.assert_allclose(ours, expected, atol=1e-5)
    for a, b in zip(our_gradients, expected_gradients, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-5)


@pytest.mark.parametrize("k", [7, 9, 11, 17, 19, 23, 27, 31])
def test_logits_and_gradients_equal_the_cubes(k, kernels):
    grid, channels = make_scene(k)
    compare(make_network(k), grid, channels, grid.keys[::29])


@pytest.mark.parametrize("k", [7, 11, 17])
def test_padded_networks_are_evaluated_cube_by_cube(k):
    grid, channels = make_scene(k)
    compare(make_network(k, is_padded=True), grid, channels, grid.keys[::29])


def test_many_padded_cubes_are_evaluated_in_parts(monkeypatch):
    grid, channels = make_scene(2)
    network = make_network(7, is_padded=True)
    with torch.no_grad():
        whole = sparse_logits(network, channels, grid.keys, grid.keys[:50])
        monkeypatch.setattr(sparse, "_CUBES", 8)
        np.testing.assert_allclose(sparse_logits(network, channels, grid.keys, grid.keys[:50]), whole, atol=1e-6)


def test_one_channel(kernels):
    grid, channels = make_scene(1, n_channels=1)
    compare(make_network(channels=("occupancy",)), grid, channels, grid.keys[::60])


def test_one_voxel_alone(kernels):
    grid = VoxelGrid(np.zeros(3), 0.1, np.array([[-5, 7, 3]], np.int32), *(np.ones(1),) * 3)
    compare(make_network(), grid, np.array([[1.5, 0.2]], np.float32), grid.keys)


def test_a_high_map_crosses_the_words_of_the_bitmaps(kernels):
    grid, channels = make_scene(3, n=2000, extent=(12, 12, 200))
    compare(make_network(), grid, channels, grid.keys[::80])


def test_repeated_and_unoccupied_centres(kernels):
    grid, channels = make_scene(4)
    compare(make_network(), grid, channels, np.array([[0, 0, 0], [0, 0, 0], [3, 3, 5], [200, 200, 200]]))


def test_a_centre_far_from_all_voxels(kernels):
    grid, channels = make_scene(4)
    compare(make_network(), grid, channels, np.array([[500, 500, 500]]))


def test_no_wanted_voxel_gives_no_logits():
    grid, channels = make_scene(4)
    assert sparse_logits(make_network(), channels, grid.keys, np.empty((0, 3), int)).shape == (0, 9)


def test_the_company_of_other_voxels_changes_nothing(kernels):
    grid, channels = make_scene(5)
    network = make_network()
    with torch.no_grad():
        together = sparse_logits(network, channels, grid.keys, grid.keys).numpy()
        halves = [sparse_logits(network, channels, grid.keys, part).numpy() for part in np.array_split(grid.keys, 3)]
    np.testing.assert_allclose(np.concatenate(halves), together, atol=1e-6)


def test_fifty_steps_of_training_agree_with_the_cubes(kernels):
    grid, channels = make_scene(6)
    wanted = grid.keys[::40]
    cubes = torch.from_numpy(extract_cubes(grid, channels, wanted, np.zeros(len(wanted), int), 11))
    labels = torch.arange(len(wanted)) % 9
    losses = []
    for forward in (lambda n: n(cubes), lambda n: sparse_logits(n, channels, grid.keys, wanted)):
        network = make_network(11)
        optimizer = torch.optim.SGD(network.parameters(), lr=0.02, momentum=0.9)
        for _ in range(50):
            loss = cross_entropy(forward(network), labels)
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
        losses.append(float(loss.detach()))
    assert losses[0] == pytest.approx(losses[1], rel=1e-3)
    assert losses[0] < 2.0


def test_dropout_of_equal_generators_is_equal():
    grid, channels = make_scene(7)
    network = make_network(9)
    a, b = (sparse_logits(network, channels, grid.keys, grid.keys[:50], torch.Generator().manual_seed(4)) for _ in range(2))
    assert torch.equal(a, b)
    assert not torch.equal(a, sparse_logits(network, channels, grid.keys, grid.keys[:50]))


def test_dropout_is_spread_as_that_of_cubes(kernels):
    """Neighbours share their convolutions, but each sample's units are dropped on their own, as in cubes: equal means, spreads and no tie
    between neighbours.
    """
    grid, channels = make_scene(7)
    network = make_network(9)
    pair = grid.keys[:2]
    wanted = np.repeat(pair, 3000, axis=0)
    cubes = torch.from_numpy(extract_cubes(grid, channels, pair, np.zeros(2, int), 9)).repeat_interleave(3000, dim=0)
    with torch.no_grad():
        network.output.weight.mul_(10)
        of_cubes = network(cubes, torch.Generator().manual_seed(1)).numpy().reshape(2, 3000, -1)
        of_sites = sparse_logits(network, channels, grid.keys, wanted, torch.Generator().manual_seed(2)).numpy().reshape(2, 3000, -1)
    std = of_cubes.std(axis=1)
    assert (std > 0.01).any()
    # Of 3000 draws: means within four, spreads within five of their own deviations.
    np.testing.assert_array_less(np.abs(of_sites.mean(axis=1) - of_cubes.mean(axis=1)), 4 * std * np.sqrt(2 / 3000) + 1e-6)
    np.testing.assert_allclose(of_sites.std(axis=1), std, rtol=0.1, atol=1e-6)
    for drawn in (of_cubes, of_sites):
        a, b = (own - own.mean(axis=0) for own in drawn)
        tie = (a * b).mean(axis=0) / np.maximum(a.std(axis=0) * b.std(axis=0), 1e-9)
        assert np.abs(tie).max() < 4 / np.sqrt(3000)


def test_empty_space_costs_nothing():
    settings = Settings()
    near = find_sites(settings.layers, 11, np.array([[0, 0, 0]]), np.array([[0, 0, 0]]), False)
    far = find_sites(settings.layers, 11, np.array([[0, 0, 0], [300, 0, 0]]), np.array([[0, 0, 0], [300, 0, 0]]), False)
    assert [len(table) for table in far.inputs] == [2 * len(table) for table in near.inputs]
    # The one voxel is seen by 27 sites of the first convolution.
    assert len(near.inputs[0]) == 27


@settings(deadline=None, max_examples=40)
@given(
    points=st.lists(st.tuples(st.integers(0, 8), st.integers(0, 5), st.integers(0, 150)), min_size=1, max_size=20),
    width=st.integers(1, 6),
    step=st.sampled_from([1, 2, 4, -1, -2, -4, 16, -16]),
)
def test_sets_spread_as_sets_of_tuples_do(points, width, step):
    shape = (9, 6, 151)
    points = set(points)
    words = _spread(_bitmap(np.array(sorted(points), np.int32), shape), width, step)
    taps = [t * step for t in range(width)]
    expected = {(x + i, y + j, z + k) for x, y, z in points for i in taps for j in taps for k in taps}
    # The words' last bits reach beyond the shape.
    expected = {p for p in expected if 0 <= p[0] < 9 and 0 <= p[1] < 6 and 0 <= p[2] < 192}
    bits = (words[..., None] >> np.arange(64, dtype=np.uint64)) & np.uint64(1)
    found = np.argwhere(bits.transpose(0, 2, 1, 3).reshape(9, 6, 192))
    assert set(map(tuple, found.tolist())) == expected
    assert _rank(words)[1] == len(expected)


def test_a_gpus_sites_in_few_batches_give_the_same(monkeypatch):
    grid, channels = make_scene(2)
    network = make_network()
    monkeypatch.setattr(sparse, "_kernels_of", lambda _: kernels_gpu)
    monkeypatch.setattr(kernels_gpu, "_GATHERED", 100)
    compare(network, grid, channels, grid.keys[::60])


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU here")
def test_a_gpu_gives_what_the_processor_gives():
    grid, channels = make_scene(8)
    network = make_network()
    expected, found = sparse_logits(network, channels, grid.keys, grid.keys), sparse_logits(network.cuda(), channels, grid.keys, grid.keys)
    np.testing.assert_allclose(found.detach().cpu(), expected.detach(), atol=1e-4)
