"""C²CNN: a small 3-D convolutional network that names the centre voxel of a K x K x K cube with two channels.

`C2CNN.forward` takes cubes one by one, as the thesis describes the sliding volume; `streetscan.segmentation.sparse`
evaluates the same weights for many voxels at once.

Source: Nagy (2020), 2.4 and Fig. 2.7, appendix A.2; N-013..N-024.
"""

import itertools
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import nn

from streetscan.classes import N_CLASSES, NAMES
from streetscan.errors import BadInput
from streetscan.io.weights import check_equal_settings, load_settings, load_weights, save_settings, save_weights
from streetscan.segmentation.density import mean_counts_around
from streetscan.segmentation.pillars import filled_shares
from streetscan.voxels import VoxelGrid, find_sorted, pack_keys

CHANNELS = ("count", "height", "occupancy", "spread", "pillar")
COUNT_SCALES = ("log", "raw", "local")
# Points a voxel is said to hold where it holds as many as the voxels around it, in the scale `local`.
_TYPICAL_COUNT = 10.0
# Times between the points of a voxel enter as ln(1 + seconds / this): the two scanners of a van pass a place a second apart.
_HOW_TO_GIVE_TIMES = (
    "name their field (`time_s` in reader.fields of the data set's file), or use a model without the channel spread, such as c2cnn_shipped"
)
_SPREAD_SCALE_S = 0.1
# Three 3x3x3 convolutions without a pooling between them look at 7 voxels.
SMALLEST_K = 7


class Layer(NamedTuple):
    """One layer of the network seen by a window that slides by one voxel: `width` taps an axis, `step` voxels apart."""

    kind: str
    width: int
    step: int


@dataclass(frozen=True)
class Settings:
    """Everything needed to rebuild a network and its input; stored beside the weights.

    Attributes:
        size_m: voxel edge λ the weights were made for.
        k: voxels an axis of the cube, odd.
        is_padded: whether convolutions see zeros beyond their input, so that they keep its size. Cubes then share nothing, and each is
            evaluated by itself.
        channels: input channels, of `count` (points), `height` (above ground), `occupancy` (1) and two that are not in the thesis:
            `spread` (seconds from the first to the last point: what moves is met once, what stands by every scanner and on every
            drive) and `pillar` (how much of what is above and below is filled, up to 12 m: a wall goes on where a bus ends). OG-CNN
            is occupancy alone.
        count_scale: `log` enters ln(1 + count), `raw` the count itself (the thesis' wording), `local` ln(1 + 10 count / mean count of the
            voxels in the square of columns below and above the cube), which no scanner and no speed changes.
        height_scale_m: the height enters divided by this, cut to [-1, 3].
        filters: filters of the three convolutions.
        n_hidden: units of the hidden dense layer.
        dropout: share of units removed in training.
        classes: names of the outputs in order.
    """

    size_m: float = 0.1
    k: int = 23
    is_padded: bool = False
    channels: tuple[str, ...] = ("count", "height")
    # ASSUME: the thesis does not scale its inputs. Counts span three decades, with which SGD does not converge reliably,
    # and heights in metres dwarf every other input: logarithm and a division by 10 m.
    count_scale: str = "log"
    height_scale_m: float = 10.0
    filters: tuple[int, ...] = (8, 16, 32)
    # ASSUME: Fig. 2.7 names no width; LeNet-5 has 120 and 84. One hidden layer of 128 (a multiple of the vector width).
    n_hidden: int = 128
    dropout: float = 0.3
    classes: tuple[str, ...] = NAMES

    def __post_init__(self):
        for name in ("channels", "filters", "classes"):
            object.__setattr__(self, name, tuple(getattr(self, name)))
        if not self.size_m > 0:
            raise BadInput("size_m", f"{self.size_m} is not above 0", "give the voxel edge in metres, such as 0.1")
        if int(self.k) != self.k or self.k % 2 == 0 or self.k < SMALLEST_K:
            raise BadInput("k", f"{self.k} is not an odd number of at least {SMALLEST_K}", "give the cube's side in voxels, such as 23")
        if not self.channels or len(set(self.channels)) < len(self.channels) or not set(self.channels) <= set(CHANNELS):
            raise BadInput("channels", f"{list(self.channels)}", f"choose one or more of {', '.join(CHANNELS)}, each once")
        if self.count_scale not in COUNT_SCALES:
            raise BadInput("count_scale", f"'{self.count_scale}' is unknown", f"choose one of {', '.join(COUNT_SCALES)}")
        if not self.height_scale_m > 0:
            raise BadInput("height_scale_m", f"{self.height_scale_m} is not above 0", "give metres, such as 10")
        if len(self.filters) != 3 or min(self.filters) < 1 or self.n_hidden < 1:
            raise BadInput(
                "filters", f"{list(self.filters)} and {self.n_hidden} hidden units", "give three convolutions, such as 8, 16, 32"
            )
        if not 0 <= self.dropout < 1:
            raise BadInput("dropout", f"{self.dropout} is not in [0, 1)", "give a share, such as 0.3")
        missing = [n for n in NAMES if n not in self.classes]
        if missing or len(self.classes) != N_CLASSES:
            found = f"class '{missing[0]}' is missing" if missing else f"{len(self.classes)} classes instead of {N_CLASSES}"
            raise BadInput("the weights' settings", found, "train with all nine classes or use other weights")
        if self.classes != NAMES:
            raise BadInput("the weights' settings", f"the classes are in the order {', '.join(self.classes)}", "train again")

    @property
    def radius(self) -> int:
        """Voxels from the centre of the cube to its face."""
        return self.k // 2

    @property
    def layers(self) -> tuple[Layer, ...]:
        """Convolutions, poolings and the dense layer from input to output.

        ASSUME: the text gives no padding. Without padding a cube's output depends on nothing but the voxels around its
        centre, so neighbouring cubes share all their work. Each of the first two convolutions is followed by a
        max-pooling of 2 with stride 2 (LeNet-5's order); below K = 18 two poolings leave nothing for the third
        convolution, and as many as fit are kept, the earlier one first. The thesis' Table 2.2 goes down to K = 7 with
        both, which padded convolutions allow.
        """
        for pooled in ((True, True), (True, False), (False, True), (False, False)):
            layers, width, step = [], self.k, 1
            for has_pooling in (*pooled, False):
                layers.append(Layer("conv", 3, step))
                width -= 0 if self.is_padded else 2
                if has_pooling:
                    layers.append(Layer("pool", 2, step))
                    width, step = width // 2, 2 * step
            if width >= 1:
                return (*layers, Layer("dense", width, step))
        raise AssertionError(f"k = {self.k} was let through")

    def save(self, path: str | Path) -> None:
        """Write as YAML."""
        save_settings(self, path)

    @classmethod
    def load(cls, path: str | Path) -> "Settings":
        """Read what `save` wrote. BadInput when a key is missing, unknown or its value impossible."""
        return load_settings(cls, path)


class C2CNN(nn.Module):
    """The network of Fig. 2.7, cube by cube.

    ASSUME: the two dropouts act before and after the hidden dense layer. Thesis 2.4.2 counts dropout layers to the convolutional part and
    not to the dense one, without a place; ours begin where that part ends. There each sample has its own even when neighbouring cubes
    share their convolutions, so both evaluators train alike (tested: equal means and spreads of logits, no tie between neighbours).
    """

    def __init__(self, settings: Settings, seed: int = 0):
        """
        Args:
            settings: the network's shape.
            seed: of the random initial weights. The thesis only says random (N-023); ASSUME He's uniform with zero biases, the
                output layer's a tenth of it so that training starts from even guesses.
        """
        super().__init__()
        self.settings = settings
        widths = (len(settings.channels), *settings.filters)
        n_features = settings.layers[-1].width ** 3 * settings.filters[-1]
        self.convolutions = nn.ModuleList(nn.Conv3d(a, b, 3, padding=int(settings.is_padded)) for a, b in itertools.pairwise(widths))
        self.hidden = nn.Linear(n_features, settings.n_hidden)
        self.output = nn.Linear(settings.n_hidden, len(settings.classes))
        generator = torch.Generator().manual_seed(seed)
        for layer in (*self.convolutions, self.hidden, self.output):
            nn.init.kaiming_uniform_(layer.weight, nonlinearity="relu", generator=generator)
            nn.init.zeros_(layer.bias)
        with torch.no_grad():
            self.output.weight.mul_(0.1)

    @property
    def device(self) -> torch.device:
        """Where the weights are."""
        return self.output.weight.device

    def forward(self, cubes: torch.Tensor, generator: torch.Generator | None = None) -> torch.Tensor:
        """Logits (B, 9) of cubes (B, C, K, K, K) float32, axes x, y, z. Drops units when a generator is given."""
        x, convolutions = cubes, iter(self.convolutions)
        for layer in self.settings.layers:
            if layer.kind == "conv":
                x = torch.relu(next(convolutions)(x))
            elif layer.kind == "pool":
                x = nn.functional.max_pool3d(x, layer.width)
        return self.classify(x.flatten(1), self.hidden.weight, generator)

    def classify(self, features: torch.Tensor, hidden_weight: torch.Tensor, generator: torch.Generator | None) -> torch.Tensor:
        """The dense part: (B, F) features to (B, 9) logits; `hidden_weight` in the order of the features."""
        features = drop(features, self.settings.dropout, generator)
        hidden = torch.relu(nn.functional.linear(features, hidden_weight, self.hidden.bias))
        return self.output(drop(hidden, self.settings.dropout, generator))


def drop(x: torch.Tensor, share: float, generator: torch.Generator | None) -> torch.Tensor:
    """Dropout drawn from `generator`; x itself without one."""
    if generator is None or share == 0:
        return x
    kept = torch.rand(x.shape, generator=generator, device=x.device) >= share
    return x * kept / (1 - share)


def grid_channels(grid: VoxelGrid, settings: Settings) -> np.ndarray:
    """The network's input (V, C) float32 at all voxels of a map; see `input_channels`."""
    is_local = settings.count_scale == "local"
    around = mean_counts_around(grid.keys, grid.counts, settings.radius) if is_local else None
    return input_channels(grid.counts, grid.height_m, grid.spread_s, settings, around, grid_pillars(grid, settings))


def grid_pillars(grid: VoxelGrid, settings: Settings) -> np.ndarray | None:
    """The channel `pillar` (V,) at all voxels of a map, or None for a network without it."""
    return filled_shares(grid.keys, grid.height_m, grid.size_m) if "pillar" in settings.channels else None


def input_channels(
    counts: np.ndarray, height_m: np.ndarray, spread_s: np.ndarray, settings: Settings, around: np.ndarray | None = None,
    pillars: np.ndarray | None = None,
) -> np.ndarray:  # fmt: skip
    """The network's input at occupied voxels; an empty voxel is 0 in every channel.

    Args:
        counts: (V,) points in each voxel.
        height_m: (V,) float32 mean height above the local ground.
        spread_s: (V,) float32 seconds from the first to the last point.
        settings: channels and their scaling.
        around: (V,) mean number of points of the voxels around each; only counts of scale `local` need it.
        pillars: (V,) of `grid_pillars`; only the channel `pillar` needs it.
    Returns:
        (V, C) float32.
    Raises:
        BadInput: the height channel is wanted and a height is unknown, or the spread and the points have no times.
    """
    columns = []
    for channel in settings.channels:
        if channel == "count":
            columns.append(_scale_counts(counts.astype(np.float32), settings.count_scale, around))
        elif channel == "height":
            if not np.isfinite(height_m).all():
                n_unknown = int((~np.isfinite(height_m)).sum())
                raise BadInput("the voxels", f"{n_unknown} have no height above ground", "run voxelize_map again")
            columns.append(np.clip(height_m / settings.height_scale_m, -1, 3))
        elif channel == "spread":
            if not np.isfinite(spread_s).all():
                raise BadInput("the map", "its points have no times", _HOW_TO_GIVE_TIMES)
            columns.append(np.log1p(spread_s / _SPREAD_SCALE_S))
        elif channel == "pillar":
            columns.append(pillars)
        else:
            columns.append(np.ones(len(counts)))
    return np.stack(columns, axis=1).astype(np.float32)


def _scale_counts(counts: np.ndarray, scale: str, around: np.ndarray | None) -> np.ndarray:
    if scale == "raw":
        return counts
    return np.log1p(_TYPICAL_COUNT * counts / around if scale == "local" else counts)


def turn_keys(keys: np.ndarray, turns: np.ndarray | int) -> np.ndarray:
    """Voxel keys (N, 3) turned by quarter turns, counter-clockwise about the vertical through voxel (0, 0, 0)."""
    x, y, z = np.asarray(keys).T
    turns = np.broadcast_to(turns, x.shape) % 4
    turned_x = np.choose(turns, (x, -y, -x, y))
    turned_y = np.choose(turns, (y, x, -y, -x))
    return np.stack([turned_x, turned_y, z], axis=1)


def extract_cubes(grid: VoxelGrid, channels: np.ndarray, keys: np.ndarray, turns: np.ndarray, k: int) -> np.ndarray:
    """Cut the K x K x K neighbourhoods of voxels out of the sparse grid.

    Args:
        grid: the occupied voxels.
        channels: (V, C) float32 input at them.
        keys: (S, 3) centre voxels.
        turns: (S,) quarter turns, counter-clockwise about the vertical through the centre.
        k: side in voxels, odd.
    Returns:
        (S, C, K, K, K) float32, axes x, y, z of the turned neighbourhood.
    """
    steps = np.arange(k) - k // 2
    offsets = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
    padded = np.vstack([channels, np.zeros((1, channels.shape[1]), np.float32)])
    packed = pack_keys(grid.keys)
    cubes = np.empty((len(keys), channels.shape[1], k, k, k), np.float32)
    for i, (key, turn) in enumerate(zip(keys, turns, strict=True)):
        # A cell of the turned cube shows what lies at the offset turned back.
        rows = find_sorted(packed, pack_keys(np.asarray(key, np.int64) + turn_keys(offsets, -int(turn))))
        cubes[i] = padded[rows].T.reshape(-1, k, k, k)
    return cubes


def save_network(network: C2CNN, weights: str | Path, settings: str | Path) -> None:
    """Write the weights (safetensors) and the settings (YAML)."""
    network.settings.save(settings)
    save_weights(network, weights)


def load_network(weights: str | Path, settings: str | Path) -> C2CNN:
    """Rebuild a network. BadInput when a file is damaged or the two do not belong together."""
    network = C2CNN(Settings.load(settings))
    load_weights(network, weights, settings)
    return network.eval()


def check_same_settings(found: Settings, wanted: Settings, where: object) -> None:
    """Refuse weights that were made with other settings. BadInput names the first that differs."""
    # Dropout acts in training only.
    check_equal_settings(found, wanted, where, ("dropout",))
