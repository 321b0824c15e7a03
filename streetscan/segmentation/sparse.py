"""The sliding window of C²CNN without its repeated work.

Neighbouring cubes overlap, so most of what their convolutions compute is the same number. Because the network pads
nothing, the value a convolution or pooling has in a cube depends only on where in the map it lies: a layer behind a
stride-2 pooling becomes the same layer with its taps twice as far apart ("à trous"), and each value is needed once.
Far from any point every layer has one constant value, so only the sites count that (a) some wanted voxel looks at and
(b) see an occupied voxel. We compute there the deviation from that constant, in which an empty neighbour adds nothing.

Both training and labelling use these functions, with the kernels of the processor or the GPU the network is on; forward
and backward give what `C2CNN.forward` gives on cubes, up to rounding.

Source: ours; stands in for N-013, N-024 (the thesis takes each volume separately).
"""

from collections.abc import Iterator
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import contextmanager
from types import ModuleType

import numpy as np
import torch
from torch.nn.functional import embedding

from streetscan.segmentation import kernels_cpu, kernels_gpu
from streetscan.segmentation.c2cnn import C2CNN

# Cubes of a padded network evaluated at once.
_CUBES = 256


@contextmanager
def open_workers(n_threads: int) -> Iterator[Executor]:
    """Threads to evaluate independent sets of voxels on, one set a thread; torch itself keeps to one thread meanwhile.

    Whole sets instead of loops are shared out, so that no thread waits for another within a layer and results do not
    depend on the number of threads.
    """
    n_before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with ThreadPoolExecutor(n_threads) as workers:
            yield workers
    finally:
        torch.set_num_threads(n_before)


def sparse_logits(
    network: C2CNN, channels: np.ndarray, coords: np.ndarray, wanted: np.ndarray, generator: torch.Generator | None = None
) -> torch.Tensor:
    """The logits `network` gives the cubes around voxels.

    Args:
        network: weights and settings.
        channels: (n, C) float32 input at occupied voxels.
        coords: (n, 3) integer coordinates of them, none twice.
        wanted: (q, 3) integer centres of the cubes.
        generator: of the dropout, on the network's device; None drops nothing.
    Returns:
        (q, 9) float32 logits on the network's device, with a gradient when torch records one. Memory grows with q and the room around
        it. Padded networks are evaluated cube by cube.
    """
    settings, device = network.settings, network.device
    if len(wanted) == 0:
        return torch.zeros((0, len(settings.classes)), device=device)
    if settings.is_padded:
        cubes = kernels_cpu.cut_cubes(channels, coords, wanted, settings.k, _CUBES)
        return torch.cat([network(torch.from_numpy(batch).to(device), generator) for batch in cubes])
    kernels = _kernels_of(device)
    if kernels is kernels_gpu:
        coords, wanted = (torch.from_numpy(np.asarray(a, np.int64)).to(device) for a in (coords, wanted))
    sites = kernels.find_sites(settings.layers, settings.radius, coords, wanted, torch.is_grad_enabled())
    x = torch.from_numpy(np.ascontiguousarray(channels, np.float32)).to(device)[torch.as_tensor(sites.rows)]
    constant = torch.zeros(x.shape[1], device=device)
    convolutions = iter(network.convolutions)
    base = constant
    has_sum = False
    for layer, inputs, users in zip(settings.layers, sites.inputs, sites.users, strict=True):
        if layer.kind == "pool":
            # The largest deviation: adding a constant and ReLU keep the order, so both may wait.
            x = kernels.pool(x, inputs, users)
            continue
        if has_sum:
            constant = torch.relu(base)
            x = torch.relu(x + base) - constant
        if layer.kind == "conv":
            convolution = next(convolutions)
            # (out, in, x, y, z) -> (tap, in, out)
            weight = convolution.weight.flatten(2).permute(2, 1, 0).contiguous()
            base = convolution.bias + constant @ weight.sum(0)
            x, has_sum = kernels.convolve(x, weight, inputs, users), True
    features = torch.cat([x + constant, constant[None]])
    inputs = torch.as_tensor(inputs)
    rows = torch.where(inputs < 0, len(x), inputs)
    hidden_weight = network.hidden.weight.view(settings.n_hidden, -1, inputs.shape[1]).transpose(1, 2).flatten(1)
    return network.classify(embedding(rows, features).flatten(1), hidden_weight, generator)


def _kernels_of(device: torch.device) -> ModuleType:
    return kernels_cpu if device.type == "cpu" else kernels_gpu
