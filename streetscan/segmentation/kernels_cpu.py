"""Sites of a sparse network and what its layers compute at them, on the processor.

Sets of sites are bitmaps over the bounding box, 64 voxels of a column a word; the row of a site in a layer's array is the number of set
bits before it. The kernels run on one thread and let others run meanwhile.
"""

import functools
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from numba import njit

from streetscan.segmentation.c2cnn import Layer

# Outputs of a convolution that the compiled loop computes together; 8 outputs take twice the time of 16.
_VECTOR = 16
# Sites whose taps are gathered at once for a weight gradient: fits the cache.
_GATHERED = 2048

_COMPILED = {"cache": True, "nogil": True}


@dataclass
class Sites:
    """What connects the layers for one set of wanted voxels; int64 tensors instead of arrays on a GPU.

    Attributes:
        rows: (n,) rows of the given coordinates that enter the first layer, in its order.
        inputs: for each layer (sites, width³) int32: row of each tap in the layer before, -1 for a constant neighbour.
            The last layer's sites are the wanted voxels in the order given.
        users: for each layer the transposed table: (sites of the layer before, width³), or None where not asked for.
    """

    rows: np.ndarray | torch.Tensor
    inputs: list[np.ndarray | torch.Tensor]
    users: list[np.ndarray | torch.Tensor | None]


def find_sites(layers: tuple[Layer, ...], radius: int, coords: np.ndarray, wanted: np.ndarray, with_users: bool) -> Sites:
    """Sites every layer must compute, and their neighbours in the layer before.

    Args:
        layers: the network's layers.
        radius: voxels from a cube's centre to its face.
        coords: (n, 3) integer coordinates of occupied voxels, none twice.
        wanted: (q, 3) integer centres of the cubes; may repeat.
        with_users: also build what a backward pass needs.
    """
    low = wanted.min(axis=0) - radius
    shape = tuple(int(s) for s in wanted.max(axis=0) + radius + 1 - low)
    inside = ((coords >= low) & (coords < low + shape)).all(axis=1)
    candidates = np.flatnonzero(inside)
    coords = (coords[candidates] - low).astype(np.int32)
    origins = (wanted - low - radius).astype(np.int32)
    needed = [_bitmap(origins, shape)]
    for layer in reversed(layers):
        needed.append(_spread(needed[-1], layer.width, layer.step))
    needed.reverse()
    before = _bitmap(coords, shape) & needed[0]
    before_rank, n_before = _rank(before)
    order = _lookup(before, before_rank, coords, 1, 1)[:, 0]
    rows = np.empty(n_before, np.int64)
    rows[order[order >= 0]] = candidates[order >= 0]
    inputs, users = [], []
    for layer, need in zip(layers[:-1], needed[1:], strict=False):
        sites = _spread(before, layer.width, -layer.step) & need
        rank, n_sites = _rank(sites)
        if n_sites <= n_before:
            table = _neighbours(sites, rank, n_sites, before, before_rank, layer.width, layer.step)
        else:
            table = _transpose(_neighbours(before, before_rank, n_before, sites, rank, layer.width, -layer.step), n_sites)
        wants_users = with_users and layer.kind == "conv" and bool(users)
        inputs.append(table)
        users.append(_transpose(table, n_before) if wants_users else None)
        before, before_rank, n_before = sites, rank, n_sites
    inputs.append(_lookup(before, before_rank, origins, layers[-1].width, layers[-1].step))
    return Sites(rows, inputs, [*users, None])


def cut_cubes(channels: np.ndarray, coords: np.ndarray, wanted: np.ndarray, k: int, n_together: int) -> Iterator[np.ndarray]:
    """The cubes around voxels, in batches.

    Args:
        channels: (n, C) float32 input at occupied voxels.
        coords: (n, 3) integer coordinates of them, none twice.
        wanted: (q, 3) integer centres of the cubes.
        k: side in voxels, odd.
        n_together: cubes of a batch.
    Yields:
        (b, C, k, k, k) float32.
    """
    radius = k // 2
    low = wanted.min(axis=0) - radius
    shape = tuple(int(s) for s in wanted.max(axis=0) + radius + 1 - low)
    inside = np.flatnonzero(((coords >= low) & (coords < low + shape)).all(axis=1))
    near = (coords[inside] - low).astype(np.int32)
    present = _bitmap(near, shape)
    rank, n_present = _rank(present)
    # The last row is an empty voxel.
    rows = np.zeros((n_present + 1, channels.shape[1]), np.float32)
    rows[_lookup(present, rank, near, 1, 1)[:, 0]] = channels[inside]
    for part in np.array_split((wanted - low - radius).astype(np.int32), -(-len(wanted) // n_together)):
        cubes = rows[_lookup(present, rank, part, k, 1)].reshape(len(part), k, k, k, -1)
        yield np.ascontiguousarray(np.moveaxis(cubes, -1, 1))


def convolve(x: torch.Tensor, weight: torch.Tensor, inputs: np.ndarray, users: np.ndarray | None) -> torch.Tensor:
    """y[i] = sum over taps t of x[inputs[i, t]] @ weight[t], taps of -1 left out; differentiable, in x only with `users`."""
    return _SparseConv.apply(x, weight, inputs, users)


def pool(x: torch.Tensor, inputs: np.ndarray, users: None) -> torch.Tensor:
    """y[i] = the largest of x[inputs[i, t]] over taps t, per channel, a tap of -1 counting as 0; differentiable."""
    return _MaxPool.apply(x, inputs)


class _SparseConv(torch.autograd.Function):
    @staticmethod
    def forward(ctx, x, weight, inputs, users):
        ctx.save_for_backward(x, weight)
        ctx.tables = inputs, users
        return _apply_taps(x, weight, inputs)

    @staticmethod
    def backward(ctx, grad):
        x, weight = ctx.saved_tensors
        inputs, users = ctx.tables
        grad = grad.contiguous()
        grad_weight = torch.zeros_like(weight)
        padded = torch.cat([x, torch.zeros(1, x.shape[1])])
        rows = torch.from_numpy(np.where(inputs < 0, len(x), inputs))
        for part, grad_part in zip(rows.split(_GATHERED), grad.split(_GATHERED), strict=True):
            taps = padded.index_select(0, part.flatten()).view(len(part), len(grad_weight) * x.shape[1])
            grad_weight.view(-1, grad.shape[1]).addmm_(taps.T, grad_part)
        grad_x = None if users is None else _apply_taps(grad, weight.transpose(1, 2).contiguous(), users)
        return grad_x, grad_weight, None, None


class _MaxPool(torch.autograd.Function):
    @staticmethod
    def forward(ctx, x, inputs):
        y, winners = _max_pool(x.detach().numpy(), inputs)
        ctx.winners, ctx.n_inputs = winners, len(x)
        return torch.from_numpy(y)

    @staticmethod
    def backward(ctx, grad):
        return torch.from_numpy(_unpool(grad.contiguous().numpy(), ctx.winners, ctx.n_inputs)), None


def _apply_taps(x: torch.Tensor, weight: torch.Tensor, inputs: np.ndarray) -> torch.Tensor:
    n_in, n_out = weight.shape[1:]
    weight = weight.detach()
    if n_in >= _VECTOR // 2 and n_out % _VECTOR:
        weight = torch.nn.functional.pad(weight, (0, -n_out % _VECTOR))
    out = np.empty((len(inputs), weight.shape[2]), np.float32)
    _conv_kernel(n_in, weight.shape[2])(x.detach().contiguous().numpy(), inputs, weight.numpy(), out)
    return torch.from_numpy(out)[:, :n_out]


@functools.cache
def _conv_kernel(n_in: int, n_out: int):
    # The channel counts are constants of the compiled code: the inner loops become vector instructions.
    @njit(fastmath=True, **_COMPILED)
    def kernel(x, inputs, weight, out):
        for i in range(inputs.shape[0]):
            for c in range(n_out):
                out[i, c] = 0.0
            for t in range(inputs.shape[1]):
                j = inputs[i, t]
                if j >= 0:
                    for c in range(n_out):
                        total = np.float32(0.0)
                        for k in range(n_in):
                            total += x[j, k] * weight[t, k, c]
                        out[i, c] += total

    return kernel


@njit(**_COMPILED)
def _max_pool(x, inputs):
    n, n_channels = inputs.shape[0], x.shape[1]
    out = np.zeros((n, n_channels), np.float32)
    winners = np.empty((n, n_channels), np.int32)
    for i in range(n):
        winners[i] = -1
        first = True
        for t in range(inputs.shape[1]):
            j = inputs[i, t]
            for c in range(n_channels):
                value = x[j, c] if j >= 0 else np.float32(0.0)
                if first or value > out[i, c]:
                    out[i, c] = value
                    winners[i, c] = j
            first = False
    return out, winners


@njit(**_COMPILED)
def _unpool(grad, winners, n_inputs):
    out = np.zeros((n_inputs, grad.shape[1]), np.float32)
    for i in range(grad.shape[0]):
        for c in range(grad.shape[1]):
            if winners[i, c] >= 0:
                out[winners[i, c], c] += grad[i, c]
    return out


def _bitmap(coords: np.ndarray, shape: tuple[int, int, int]) -> np.ndarray:
    """(X, ceil(Z / 64), Y) uint64 with the bits of (n, 3) coordinates set. Y last: neighbouring columns move together."""
    words = np.zeros((shape[0], (shape[2] + 63) // 64, shape[1]), np.uint64)
    _set_bits(words, coords)
    return words


@njit(**_COMPILED)
def _set_bits(words, coords):
    for i in range(coords.shape[0]):
        z = coords[i, 2]
        words[coords[i, 0], z >> 6, coords[i, 1]] |= np.uint64(1) << np.uint64(z & 63)


@njit(**_COMPILED)
def _spread(words, width, step):
    """The union of a set with its copies moved by `step` * 0 .. width - 1 along every axis (down where step < 0)."""
    n_x, n_words, n_y = words.shape
    along_x, out = np.empty_like(words), np.empty_like(words)
    for x in range(n_x):
        along_x[x] = words[x]
        for t in range(1, width):
            if 0 <= x - t * step < n_x:
                _unite(along_x[x].reshape(-1), words[x - t * step].reshape(-1), 0)
    for x in range(n_x):
        along_y = along_x[x].copy()
        for w in range(n_words):
            for t in range(1, width):
                _unite(along_y[w], along_x[x, w], t * step)
        out[x] = along_y
        for t in range(1, width):
            # Bits move up the column where step > 0: from the word `whole` below and, over its edge, the next one.
            shift = t * abs(step)
            whole, bits = shift >> 6, np.uint64(shift & 63)
            rest = np.uint64(64) - bits
            for w in range(n_words):
                near = w - whole if step > 0 else w + whole
                far = near - 1 if step > 0 else near + 1
                if 0 <= near < n_words:
                    for y in range(n_y):
                        out[x, w, y] |= along_y[near, y] << bits if step > 0 else along_y[near, y] >> bits
                if bits != np.uint64(0) and 0 <= far < n_words:
                    for y in range(n_y):
                        out[x, w, y] |= along_y[far, y] >> rest if step > 0 else along_y[far, y] << rest
    return out


@njit(inline="always")
def _unite(out, words, shift):
    """out[i] |= words[i - shift] where that exists."""
    for i in range(max(0, shift), min(out.size, out.size + shift)):
        out[i] |= words[i - shift]


@njit(inline="always")
def _count_bits(word):
    # LLVM turns this into one instruction.
    word = word - ((word >> np.uint64(1)) & np.uint64(0x5555555555555555))
    word = (word & np.uint64(0x3333333333333333)) + ((word >> np.uint64(2)) & np.uint64(0x3333333333333333))
    word = (word + (word >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
    return np.int64((word * np.uint64(0x0101010101010101)) >> np.uint64(56))


@njit(**_COMPILED)
def _rank(words):
    """Number of set bits before each word, int32 of the words' shape, and in all."""
    rank = np.empty(words.shape, np.int32)
    flat_rank, flat_words = rank.reshape(-1), words.reshape(-1)
    total = 0
    for i in range(flat_words.size):
        flat_rank[i] = total
        total += _count_bits(flat_words[i])
    return rank, total


@njit(inline="always")
def _fill_taps(table, row, words, rank, x, y, z, width, step):
    """Write to table[row] the rows of the site (x, y, z) moved by `step` * taps, -1 where the set does not hold it."""
    n_x, n_words, n_y = words.shape
    tap = 0
    for i in range(width):
        to_x = x + i * step
        for j in range(width):
            to_y = y + j * step
            is_inside = 0 <= to_x < n_x and 0 <= to_y < n_y
            for k in range(width):
                to_z = z + k * step
                found = np.int32(-1)
                if is_inside and 0 <= to_z < n_words * 64:
                    word, bit = words[to_x, to_z >> 6, to_y], np.uint64(to_z & 63)
                    if (word >> bit) & np.uint64(1) != np.uint64(0):
                        below = word & ((np.uint64(1) << bit) - np.uint64(1))
                        found = np.int32(rank[to_x, to_z >> 6, to_y] + _count_bits(below))
                table[row, tap] = found
                tap += 1


@njit(**_COMPILED)
def _transpose(table, n):
    """(n, taps) int32: at [j, t] the row i with table[i, t] = j, -1 where there is none."""
    out = np.full((n, table.shape[1]), -1, np.int32)
    for i in range(table.shape[0]):
        for t in range(table.shape[1]):
            if table[i, t] >= 0:
                out[table[i, t], t] = i
    return out


@njit(**_COMPILED)
def _neighbours(words, rank, n_sites, other, other_rank, width, step):
    """(n_sites, width³) int32: row in the other set of each site moved by `step` * taps, -1 where it holds none."""
    table = np.empty((n_sites, width**3), np.int32)
    for x in range(words.shape[0]):
        for w in range(words.shape[1]):
            for y in range(words.shape[2]):
                rest, row = words[x, w, y], rank[x, w, y]
                while rest != np.uint64(0):
                    lowest = rest & (~rest + np.uint64(1))
                    z = w * 64 + _count_bits(lowest - np.uint64(1))
                    rest ^= lowest
                    _fill_taps(table, row, other, other_rank, x, y, z, width, step)
                    row += 1
    return table


@njit(**_COMPILED)
def _lookup(words, rank, coords, width, step):
    """(n, width³) int32: row in the set of each coordinate moved by `step` * taps, -1 where it holds none."""
    table = np.empty((coords.shape[0], width**3), np.int32)
    for row in range(coords.shape[0]):
        _fill_taps(table, row, words, rank, coords[row, 0], coords[row, 1], coords[row, 2], width, step)
    return table
