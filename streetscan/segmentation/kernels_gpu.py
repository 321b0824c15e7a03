"""Sites of a sparse network and what its layers compute at them, by PyTorch, for a GPU.

Sets of sites are volumes over the bounding box, as dense as the box: a GPU fills one faster than it searches bitmaps. Gradients are
gathered, never scattered, so that sums have one order and a training can be repeated. It runs on the processor as well, slowly.
"""

from collections.abc import Iterator

import torch

from streetscan.segmentation.c2cnn import Layer
from streetscan.segmentation.kernels_cpu import Sites

# Sites whose taps are gathered at once: bounds the memory (27 taps of 32 channels: 3.5 KB a site).
_GATHERED = 1 << 18


def find_sites(layers: tuple[Layer, ...], radius: int, coords: torch.Tensor, wanted: torch.Tensor, with_users: bool) -> Sites:
    """What `kernels_cpu.find_sites` gives, as int64 tensors on the device of the coordinates; poolings have users, too."""
    # A tap up or down from a site never leaves the volume.
    reach = max((layer.width - 1) * layer.step for layer in layers[:-1])
    low = wanted.amin(0) - radius - reach
    shape = tuple((wanted.amax(0) + radius + 1 - low).tolist())
    inside = ((coords >= low) & (coords < low + torch.tensor(shape, device=low.device))).all(1).nonzero()[:, 0]
    size = shape[0] * shape[1] * shape[2]
    given = torch.full((size,), -1, device=coords.device)
    given[_flatten(coords[inside] - low, shape)] = inside
    origins = _flatten(wanted - low - radius, shape)
    is_needed = torch.zeros(size, dtype=torch.bool, device=coords.device)
    is_needed[origins] = True
    needed = [is_needed.view(shape)]
    for layer in reversed(layers):
        needed.append(_spread(needed[-1], layer.width, layer.step))
    needed.reverse()
    before = (given.view(shape) >= 0) & needed[0]
    flat_before, row_before = _number(before)
    rows, inputs, users = given[flat_before], [], []
    for layer, need in zip(layers[:-1], needed[1:], strict=False):
        sites = _spread(before, layer.width, -layer.step) & need
        flat, row = _number(sites)
        taps = _tap_offsets(layer, shape, flat.device)
        inputs.append(row_before[flat[:, None] + taps])
        # Nothing before the first convolution wants a gradient.
        users.append(row[flat_before[:, None] - taps] if with_users and users else None)
        before, flat_before, row_before = sites, flat, row
    inputs.append(row_before[origins[:, None] + _tap_offsets(layers[-1], shape, origins.device)])
    return Sites(rows, inputs, [*users, None])


def convolve(x: torch.Tensor, weight: torch.Tensor, inputs: torch.Tensor, users: torch.Tensor | None) -> torch.Tensor:
    """What `kernels_cpu.convolve` gives."""
    return _SparseConv.apply(x, weight, inputs, users)


def pool(x: torch.Tensor, inputs: torch.Tensor, users: torch.Tensor | None) -> torch.Tensor:
    """What `kernels_cpu.pool` gives; a gradient asks for `users`."""
    return _MaxPool.apply(x, inputs, users)


class _SparseConv(torch.autograd.Function):
    @staticmethod
    def forward(ctx, x, weight, inputs, users):
        ctx.save_for_backward(x, weight, inputs, users)
        return _apply_taps(x, weight, inputs)

    @staticmethod
    def backward(ctx, grad):
        x, weight, inputs, users = ctx.saved_tensors
        grad_weight = torch.zeros_like(weight).flatten(0, 1)
        for taps, grad_part in zip(_gather(x, inputs), grad.split(_GATHERED), strict=True):
            grad_weight.addmm_(taps.T, grad_part)
        grad_x = None if users is None else _apply_taps(grad, weight.transpose(1, 2), users)
        return grad_x, grad_weight.view_as(weight), None, None


class _MaxPool(torch.autograd.Function):
    @staticmethod
    def forward(ctx, x, inputs, users):
        y, taps = _with_zero(x)[inputs].max(1)
        # Row of the largest, -1 for an empty neighbour.
        ctx.save_for_backward(inputs.gather(1, taps), users)
        return y

    @staticmethod
    def backward(ctx, grad):
        winners, users = ctx.saved_tensors
        # An absent user, -1, is the last row: it gives nothing, whoever won there.
        has_won = torch.cat([winners, winners.new_full((1, winners.shape[1]), -1)])[users]
        has_won = has_won == torch.arange(len(users), device=grad.device)[:, None, None]
        return (_with_zero(grad)[users] * has_won).sum(1), None, None


def _apply_taps(x: torch.Tensor, weight: torch.Tensor, inputs: torch.Tensor) -> torch.Tensor:
    return torch.cat([taps @ weight.flatten(0, 1) for taps in _gather(x, inputs)])


def _gather(x: torch.Tensor, inputs: torch.Tensor) -> Iterator[torch.Tensor]:
    """What the taps see, (b, taps * channels), in batches of sites."""
    x = _with_zero(x)
    return (x[part].flatten(1) for part in inputs.split(_GATHERED))


def _with_zero(x: torch.Tensor) -> torch.Tensor:
    """x with a last row of zeros, which the index -1 finds."""
    return torch.cat([x, x.new_zeros(1, x.shape[1])])


def _flatten(coords: torch.Tensor, shape: tuple[int, int, int]) -> torch.Tensor:
    """(n, 3) coordinates to (n,) positions in a volume."""
    return (coords[:, 0] * shape[1] + coords[:, 1]) * shape[2] + coords[:, 2]


def _tap_offsets(layer: Layer, shape: tuple[int, int, int], device: torch.device) -> torch.Tensor:
    """(width³,) how far in a volume the taps of a layer are from their site."""
    steps = torch.arange(layer.width, device=device) * layer.step
    return _flatten(torch.cartesian_prod(steps, steps, steps), shape)


def _number(sites: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Positions (n,) of a volume's set sites, and a volume, flat, of their rows, -1 elsewhere."""
    flat = sites.flatten().nonzero()[:, 0]
    rows = torch.full((sites.numel(),), -1, device=sites.device)
    rows[flat] = torch.arange(len(flat), device=sites.device)
    return flat, rows


def _spread(sites: torch.Tensor, width: int, step: int) -> torch.Tensor:
    """The union of a volume's set with its copies moved by `step` * 0 .. width - 1 along every axis (down where step < 0)."""
    for axis in range(3):
        united = sites.clone()
        for t in range(1, width):
            n = sites.shape[axis] - t * abs(step)
            if n > 0:
                start, to = (0, t * step) if step > 0 else (-t * step, 0)
                united.narrow(axis, to, n).logical_or_(sites.narrow(axis, start, n))
        sites = united
    return sites
