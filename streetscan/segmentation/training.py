"""Training of C²CNN on sampled voxels.

Samples that lie close together share most of the network's work, so a batch is a number of small patches, each with
several of its samples, placed side by side in one coordinate frame. Each time a patch is drawn it is turned about the
vertical by another number of quarter turns, which map voxels onto voxels: the thesis' randomly rotated clones (N-021).

Source: Nagy (2020), 2.4.2 and appendix A.2.6; N-020..N-023, N-027..N-029.
"""

import copy
import hashlib
import json
import logging
import time
from collections.abc import Iterator
from concurrent.futures import Executor
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
from numba import njit
from torch.nn.functional import cross_entropy

from streetscan.classes import N_CLASSES
from streetscan.errors import BadInput
from streetscan.io.arrays import load_npz
from streetscan.io.atomic import atomic_path
from streetscan.segmentation.c2cnn import C2CNN, Settings, check_same_settings, grid_channels, grid_pillars, input_channels, turn_keys
from streetscan.segmentation.density import mean_counts_around
from streetscan.segmentation.devices import choose_device
from streetscan.segmentation.sparse import open_workers, sparse_logits
from streetscan.voxels import VoxelGrid, find_sorted, pack_keys

logger = logging.getLogger(__name__)

# ASSUME: a class with few samples weighs at most this much more than the others; a handful of voxels must not rule.
_LARGEST_WEIGHT = 10.0
# Parts of a batch that are computed apart on the processor, fixed so that sums do not depend on the number of threads. A GPU waits for
# orders, not for sums: it takes a batch whole.
_N_SHARES = {"cpu": 8, "cuda": 1}
# Densities a training patch may have.
_N_SHARES_KEPT = 8
# Samples scored together.
_SCORED = 1024


@dataclass(frozen=True)
class Schedule:
    """How to train. Steps decide when it ends, never the clock.

    Attributes:
        n_epochs: epochs; after each one the validation part is scored.
        samples_per_epoch: samples drawn for an epoch (all where there are fewer).
        learning_rate: at the start.
        momentum: of SGD.
        averaging: the network that is scored and kept is the running mean of the weights, in which a batch's weights fade by this
            factor with each later one; 0 takes the last weights. ASSUME: the thesis has none; it takes out the noise of the last
            steps without waiting for the rate to fall.
        max_gradient: a batch's gradient is shortened to this length. ASSUME: the thesis names no limit; without normalisation
            layers a few dense patches give steps so long that ReLUs die for good.
        lr_factor: the learning rate is multiplied by this when the validation accuracy stops rising (N-022).
        lr_patience: epochs without a better validation accuracy that are waited for.
        patch_voxels: side of a patch, odd.
        samples_per_patch: samples of a patch that enter a batch together. More is faster a sample and more alike.
        samples_per_batch: samples of a batch, from as many patches as that takes, drawn from the whole part, so that a batch is not one
            spot of the street.
        class_power: the loss weighs classes by (their share of the labelled voxels) ** class_power: 0 all alike
            (the thesis' even classes), 1 as they occur.
        thinning: lowest share of points kept when each patch is thinned at random, see `Part.thin`; 1 leaves all (the thesis).
        seed: of initial weights, batches and dropout.
    """

    n_epochs: int = 12
    samples_per_epoch: int = 200_000
    learning_rate: float = 0.05
    momentum: float = 0.9
    averaging: float = 0.0
    max_gradient: float = 1.0
    lr_factor: float = 0.3
    lr_patience: int = 1
    patch_voxels: int = 15
    samples_per_patch: int = 1000
    samples_per_batch: int = 512
    class_power: float = 0.0
    thinning: float = 1.0
    seed: int = 1

    def __post_init__(self):
        for name in ("n_epochs", "samples_per_epoch", "samples_per_patch", "samples_per_batch"):
            if getattr(self, name) < 1:
                raise BadInput(name, f"{getattr(self, name)} is not above 0", "give a whole number of at least 1")
        if self.patch_voxels < 1 or self.patch_voxels % 2 == 0:
            raise BadInput("patch_voxels", f"{self.patch_voxels} is not odd", "give an odd number of voxels, such as 25")
        if not self.learning_rate > 0 or not 0 <= self.momentum < 1:
            raise BadInput(
                "learning_rate", f"{self.learning_rate} with momentum {self.momentum}", "give a rate above 0, a momentum in [0, 1)"
            )
        if not 0 <= self.averaging < 1:
            raise BadInput("averaging", f"{self.averaging} is not in [0, 1)", "give the factor by which older weights fade, 0 for none")
        if not self.max_gradient > 0:
            raise BadInput("max_gradient", f"{self.max_gradient} is not above 0", "give the longest gradient, such as 1")
        if not 0 < self.lr_factor < 1 or self.lr_patience < 0:
            raise BadInput(
                "lr_factor", f"{self.lr_factor} with patience {self.lr_patience}", "give a factor in (0, 1), a patience of 0 or more"
            )
        if not 0 < self.thinning <= 1:
            raise BadInput("thinning", f"{self.thinning} is not in (0, 1]", "give the lowest share of points kept, 1 for all")
        if not self.class_power >= 0:
            raise BadInput("class_power", f"{self.class_power} is below 0", "give 0 (even) to 1 (as they occur)")


@dataclass
class Samples:
    """Voxels to train or validate on.

    Attributes:
        keys: (S, 3) int32 centre voxels.
        labels: (S,) uint8, 0..8.
    """

    keys: np.ndarray
    labels: np.ndarray

    def __len__(self) -> int:
        return len(self.keys)

    @classmethod
    def load(cls, path: str | Path) -> "Samples":
        """Read what extract_samples wrote. BadInput when the file is something else, empty, or has labels beyond 0..8."""
        samples = cls(*load_npz(path, ("keys", "labels"), "extract_samples"))
        if not len(samples.keys) == len(samples.labels) > 0:
            raise BadInput(path, "holds no samples, or columns of different length", "run extract_samples again")
        if samples.labels.max() >= N_CLASSES:
            raise BadInput(path, f"label {samples.labels.max()} is no class", "run extract_samples again")
        return samples


class Part:
    """A part of the map with its samples, ready to be cut into batches."""

    def __init__(self, grid: VoxelGrid, samples: Samples, settings: Settings, patch_voxels: int, where: object = "the samples"):
        """
        Args:
            grid: occupied voxels with heights.
            samples: voxels to train or validate on.
            settings: of the network.
            patch_voxels: side of a patch, odd.
            where: the samples' file, named in errors.
        Raises:
            BadInput: a sample is no voxel of the grid, the voxel size is not the network's, or a height is unknown.
        """
        if not np.isclose(grid.size_m, settings.size_m, rtol=1e-9):
            raise BadInput(where, f"voxels of {grid.size_m} m for a network of {settings.size_m} m", "voxelize with the network's size_m")
        if (grid.find(samples.keys) < 0).any():
            raise BadInput(where, "names voxels the grid does not have", "run extract_samples again on this grid")
        self.grid, self.samples, self.settings, self.patch_voxels = grid, samples, settings, patch_voxels
        self.channels, self._shares, self._around = grid_channels(grid, settings), np.ones(1), None
        self._pillars = grid_pillars(grid, settings)
        # Voxels sorted by patch: the neighbourhood of a patch is a few slices.
        packed = pack_keys(np.floor_divide(grid.keys, patch_voxels))
        self._order = np.argsort(packed, kind="stable")
        self._patches, starts = np.unique(packed[self._order], return_index=True)
        self._bounds = np.append(starts, len(grid))
        self._sample_patch = np.floor_divide(samples.keys, patch_voxels)

    @classmethod
    def load(cls, voxels_path: str | Path, samples_path: str | Path, settings: Settings, patch_voxels: int) -> "Part":
        """A part from the files of voxelize_map and extract_samples."""
        return cls(VoxelGrid.load(voxels_path), Samples.load(samples_path), settings, patch_voxels, samples_path)

    def runs(self, n: int, n_samples: int, rng: np.random.Generator) -> list[np.ndarray]:
        """Group the samples in runs of at most `n` of one patch, and draw runs with about `n_samples` in all.

        Returns rows of samples, a run each, in random order; no sample twice.
        """
        drawn = rng.permutation(len(self.samples))
        group = pack_keys(self._sample_patch[drawn])
        order = np.argsort(group, kind="stable")
        drawn, group = drawn[order], group[order]
        first = np.flatnonzero(np.r_[True, group[1:] != group[:-1]])
        within = np.arange(len(drawn)) - np.repeat(first, np.diff(np.append(first, len(drawn))))
        cuts = np.flatnonzero(within % n == 0)[1:]
        runs = np.split(drawn, cuts)
        runs = [runs[i] for i in rng.permutation(len(runs))]
        return runs[: int(np.searchsorted(np.cumsum([len(run) for run in runs]), n_samples)) + 1]

    def thin(self, lowest_share: float) -> None:
        """Thin the points of each patch at random in the batches to come; 1 leaves them all.

        ASSUME: of the shares of points that are kept, from `lowest_share` to all, each factor is as likely as another.
        """
        self._shares, self._around = np.geomspace(lowest_share, 1, _N_SHARES_KEPT), None
        if lowest_share < 1 and self.settings.count_scale == "local":
            around = (mean_counts_around(self.grid.keys, self.grid.counts, self.settings.radius, share) for share in self._shares)
            self._around = np.stack(list(around))

    def batch(
        self, runs: list[np.ndarray], turns: np.ndarray, rng: np.random.Generator | None = None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """The patches of several runs side by side.

        Args:
            runs: rows of samples, each run of one patch.
            turns: (len(runs),) int64 quarter turns of each patch, counter-clockwise about the vertical.
            rng: of the thinning, see `thin`; None leaves all points.
        Returns:
            input channels (n, C) float32 and coordinates (n, 3) of the occupied voxels, coordinates (q, 3) and labels
            (q,) int64 of the samples.
        """
        radius, side = self.settings.radius, self.patch_voxels
        patches = self._sample_patch[[run[0] for run in runs]]
        middles = patches * side + side // 2
        # Beside each other along x, a patch with its surroundings each: no cube sees two patches.
        spacing = side + 2 * radius + 1
        slices, slots = self._slices_around(patches, -(-radius // side))
        rows, slots, coords = _place(
            self.grid.keys, self._order, slices, slots, middles.astype(np.int64), turns, side // 2 + radius, spacing
        )
        places = np.zeros((len(runs), 3), np.int64)
        places[:, 0] = np.arange(len(runs)) * spacing
        picked = np.concatenate(runs)
        sample_slots = np.repeat(np.arange(len(runs)), [len(run) for run in runs])
        wanted = turn_keys(self.samples.keys[picked] - middles[sample_slots], turns[sample_slots]) + places[sample_slots]
        channels = self.channels[rows]
        if rng is not None and self._shares[0] < 1:
            drawn = rng.integers(len(self._shares), size=len(runs))[slots]
            counts = rng.binomial(self.grid.counts[rows], self._shares[drawn])
            # A sample's own voxel is never lost: it is what we ask about.
            is_wanted = find_sorted(np.unique(pack_keys(wanted)), pack_keys(coords)) >= 0
            counts = np.maximum(counts, is_wanted)
            around = None if self._around is None else self._around[drawn, rows]
            # What a pillar is filled with does not change with the points: a slab of it holds many.
            pillars = None if self._pillars is None else self._pillars[rows]
            channels = input_channels(counts, self.grid.height_m[rows], self.grid.spread_s[rows], self.settings, around, pillars)
            channels = channels[counts > 0]
            coords = coords[counts > 0]
        return channels, coords, wanted, self.samples.labels[picked].astype(np.int64)

    def _slices_around(self, patches: np.ndarray, reach: int) -> tuple[np.ndarray, np.ndarray]:
        """Slices (n, 2) of `_order` that hold the patches up to `reach` from each given one, and which it is, (n,)."""
        steps = np.arange(-reach, reach + 1)
        offsets = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
        found = find_sorted(self._patches, pack_keys((patches[:, None] + offsets).reshape(-1, 3)))
        slots = np.repeat(np.arange(len(patches)), len(offsets))[found >= 0]
        found = found[found >= 0]
        return np.stack([self._bounds[found], self._bounds[found + 1]], axis=1), slots


@njit(cache=True, nogil=True)
def _place(keys, order, slices, slots, middles, turns, reach, spacing):
    """Voxels at most `reach` from the middle of a patch, turned about it and moved to the patch's place.

    Returns rows (n,) of keys, the patch of each (n,) and coordinates (n, 3).
    """
    n = 0
    for s in range(len(slices)):
        n += slices[s, 1] - slices[s, 0]
    rows, patches, coords = np.empty(n, np.int64), np.empty(n, np.int64), np.empty((n, 3), np.int32)
    n = 0
    for s in range(len(slices)):
        patch = slots[s]
        turn = turns[patch]
        for i in range(slices[s, 0], slices[s, 1]):
            row = order[i]
            x, y, z = keys[row, 0] - middles[patch, 0], keys[row, 1] - middles[patch, 1], keys[row, 2] - middles[patch, 2]
            if max(abs(x), abs(y), abs(z)) > reach:
                continue
            for _ in range(turn):
                x, y = -y, x
            rows[n], patches[n] = row, patch
            coords[n, 0], coords[n, 1], coords[n, 2] = x + patch * spacing, y, z
            n += 1
    return rows[:n], patches[:n], coords[:n]


def class_weights(sample_labels: np.ndarray, voxel_labels: np.ndarray, power: float) -> np.ndarray:
    """(9,) float32 loss weights, on average 1 over the samples.

    Classes weigh as share ** power in sum, their samples evenly within; share is that of the labelled voxels.
    """
    n_samples = np.bincount(sample_labels, minlength=N_CLASSES)[:N_CLASSES]
    n_voxels = np.bincount(voxel_labels, minlength=256)[:N_CLASSES]
    weights = np.zeros(N_CLASSES)
    has_samples = n_samples > 0
    shares = np.maximum(n_voxels[has_samples], 1) / max(n_voxels.sum(), 1)
    weights[has_samples] = shares**power / n_samples[has_samples]
    if power == 0:
        weights = np.minimum(weights, _LARGEST_WEIGHT * weights[has_samples].min())
    return (weights * n_samples.sum() / (weights * n_samples).sum()).astype(np.float32)


def train(
    settings: Settings,
    schedule: Schedule,
    training: Part,
    validation: Part,
    weights: np.ndarray | None = None,
    initial: C2CNN | None = None,
    resume_folder: str | Path | None = None,
    n_threads: int = 1,
    device: str = "cpu",
) -> tuple[C2CNN, list[dict]]:
    """Train a network with SGD on cross-entropy; keep the weights of the best validation accuracy.

    ASSUME: "the learning rate is changed as a function of the validation accuracy change" (N-022) means lowered when
    it stops rising. Accuracy is the mean of the classes' recalls, so that an uneven draw does not change its meaning.

    Args:
        settings: of the network.
        schedule: of the training.
        training, validation: parts with samples, without overlap.
        weights: (9,) float32 weights of the classes in the loss; None for all alike.
        initial: a network to start from (fine-tuning), made with the same settings.
        resume_folder: where to keep the state after each epoch; a training with the same inputs and settings goes on from
            there and ends as if it had not been interrupted. The caller deletes it when the results are safe.
        n_threads: threads; the result does not depend on it.
        device: cpu, or cuda, where the same seed gives another network, for sums and dropout differ.
    Returns:
        the network, on the processor, and for each epoch: epoch, train_loss, train_accuracy, validation_loss, validation_accuracy,
        learning_rate, time_s.
    Raises:
        BadInput: initial weights of other settings, a loss that is no number, or no such device.
    """
    device = choose_device(device)
    network = C2CNN(settings, schedule.seed)
    if initial is not None:
        check_same_settings(initial.settings, settings, "the initial weights")
        network.load_state_dict(initial.state_dict())
    weights = torch.from_numpy(np.ones(N_CLASSES, np.float32) if weights is None else np.asarray(weights, np.float32))
    fingerprint = _fingerprint(schedule, training, validation, weights, network)
    network, weights = network.to(device), weights.to(device)
    optimizer = torch.optim.SGD(network.parameters(), lr=schedule.learning_rate, momentum=schedule.momentum)
    scheduler = torch.optim.lr_scheduler.ReduceLROnPlateau(
        optimizer, "max", schedule.lr_factor, schedule.lr_patience, threshold=1e-3, threshold_mode="abs"
    )
    training.thin(schedule.thinning)
    rng = np.random.default_rng(schedule.seed)
    averaged = copy.deepcopy(network)
    history, best = [], copy.deepcopy(network.state_dict())
    checkpoint = None
    if resume_folder is not None:
        checkpoint = Path(resume_folder) / f"{fingerprint}_{device.type}.pt"
        if checkpoint.is_file():
            state = torch.load(checkpoint, map_location=device, weights_only=True)
            network.load_state_dict(state["network"])
            averaged.load_state_dict(state["averaged"])
            optimizer.load_state_dict(state["optimizer"])
            scheduler.load_state_dict(state["scheduler"])
            rng.bit_generator.state = json.loads(state["rng"])
            history, best = state["history"], state["best"]
            logger.info("going on after epoch %d (%s)", len(history), checkpoint)
    with open_workers(n_threads) as workers:
        for epoch in range(len(history) + 1, schedule.n_epochs + 1):
            start = time.perf_counter()
            learning_rate = optimizer.param_groups[0]["lr"]
            train_loss, train_accuracy = _run_epoch(network, averaged, training, schedule, weights, rng, optimizer, workers, epoch)
            validation_loss, validation_accuracy = score(averaged, validation, weights, workers)
            scheduler.step(validation_accuracy)
            if validation_accuracy > max((row["validation_accuracy"] for row in history), default=-1.0):
                best = copy.deepcopy(averaged.state_dict())
            history.append(
                {
                    "epoch": epoch,
                    "train_loss": train_loss,
                    "train_accuracy": train_accuracy,
                    "validation_loss": validation_loss,
                    "validation_accuracy": validation_accuracy,
                    "learning_rate": learning_rate,
                    "time_s": time.perf_counter() - start,
                }
            )
            left_s = np.mean([row["time_s"] for row in history]) * (schedule.n_epochs - epoch)
            text = "epoch %d of %d: loss %.3f, accuracy %.3f; validation %.3f, %.3f; learning rate %.4g; %d min %02d s left"
            logger.info(text, epoch, schedule.n_epochs, *list(history[-1].values())[1:6], *divmod(round(left_s), 60))
            if checkpoint is not None:
                state = {"network": network.state_dict(), "averaged": averaged.state_dict(), "optimizer": optimizer.state_dict()}
                state |= {"scheduler": scheduler.state_dict(), "rng": json.dumps(rng.bit_generator.state), "history": history, "best": best}
                with atomic_path(checkpoint) as partial:
                    torch.save(state, partial)
    network.load_state_dict(best)
    return network.cpu().eval(), history


def sample_logits(network: C2CNN, part: Part, workers: Executor, turn: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    """Logits (S, 9) float32 and labels (S,) int64 of all samples of a part, turned by quarter turns, in an order of their own.

    Both are on the network's device.
    """
    rng = np.random.default_rng(0)

    def evaluate(runs):
        channels, coords, wanted, labels = part.batch(runs, np.full(len(runs), turn))
        with torch.inference_mode():
            return sparse_logits(network, channels, coords, wanted), torch.from_numpy(labels).to(network.device)

    results = list(workers.map(evaluate, list(_batches(part.runs(_SCORED, len(part.samples), rng), _SCORED))))
    logits, labels = (torch.cat(column) for column in zip(*results, strict=True))
    return logits, labels


def score(network: C2CNN, part: Part, weights: torch.Tensor, workers: Executor) -> tuple[float, float]:
    """Mean loss and mean recall over the classes of a part's samples."""
    tally = _Tally()
    logits, labels = sample_logits(network, part, workers)
    tally.add(cross_entropy(logits, labels, weights, reduction="none"), logits, labels)
    return tally.loss, tally.accuracy


def _run_epoch(
    network: C2CNN,
    averaged: C2CNN,
    part: Part,
    schedule: Schedule,
    weights: torch.Tensor,
    rng: np.random.Generator,
    optimizer: torch.optim.Optimizer,
    workers: Executor,
    epoch: int,
) -> tuple[float, float]:
    tally, last_message = _Tally(), time.perf_counter()
    parameters, n_shares = list(network.parameters()), _N_SHARES[network.device.type]
    batches = list(_batches(part.runs(schedule.samples_per_patch, schedule.samples_per_epoch, rng), schedule.samples_per_batch))

    def differentiate(runs, seed):
        rng = np.random.default_rng(seed)
        turns = rng.integers(4, size=len(runs))
        channels, coords, wanted, labels = part.batch(runs, turns, rng)
        labels = torch.from_numpy(labels).to(network.device)
        logits = sparse_logits(network, channels, coords, wanted, torch.Generator(network.device).manual_seed(seed))
        losses = cross_entropy(logits, labels, weights, reduction="none")
        return torch.autograd.grad(losses.sum(), parameters), losses.detach(), logits.detach(), labels

    for i, runs in enumerate(batches):
        shares = [share for share in (runs[k::n_shares] for k in range(n_shares)) if share]
        results = list(workers.map(differentiate, shares, rng.integers(2**62, size=len(shares)).tolist()))
        if not all(bool(torch.isfinite(losses).all()) for _, losses, _, _ in results):
            raise BadInput("train_segmenter.learning_rate", f"the loss is no number in epoch {epoch}", "lower the learning rate")
        n_samples = sum(len(run) for run in runs)
        for parameter, *gradients in zip(parameters, *(result[0] for result in results), strict=True):
            parameter.grad = sum(gradients) / n_samples
        torch.nn.utils.clip_grad_norm_(parameters, schedule.max_gradient)
        optimizer.step()
        _average(averaged, network, schedule.averaging, (epoch - 1) * len(batches) + i)
        for result in results:
            tally.add(*result[1:])
        if time.perf_counter() - last_message > 30:
            last_message = time.perf_counter()
            logger.info("epoch %d: %d of %d batches, loss %.3f", epoch, i + 1, len(batches), tally.loss)
    return tally.loss, tally.accuracy


def _average(averaged: C2CNN, network: C2CNN, factor: float, n_before: int) -> None:
    """Move the running mean towards a network's weights; the first weights, far from any good ones, fade faster."""
    factor = min(factor, n_before / (n_before + 10))
    with torch.no_grad():
        for mean, latest in zip(averaged.parameters(), network.parameters(), strict=True):
            mean.lerp_(latest, 1 - factor)


class _Tally:
    """Sums of losses and of right answers per class."""

    def __init__(self):
        self.sum_losses, self.n_right, self.n_samples = 0.0, np.zeros(N_CLASSES), np.zeros(N_CLASSES)

    def add(self, losses: torch.Tensor, logits: torch.Tensor, labels: torch.Tensor) -> None:
        self.sum_losses += float(losses.detach().sum())
        is_right = logits.detach().argmax(1) == labels
        labels, is_right = labels.cpu().numpy(), is_right.cpu().numpy()
        self.n_right += np.bincount(labels[is_right], minlength=N_CLASSES)
        self.n_samples += np.bincount(labels, minlength=N_CLASSES)

    @property
    def loss(self) -> float:
        return self.sum_losses / float(self.n_samples.sum())

    @property
    def accuracy(self) -> float:
        seen = self.n_samples > 0
        return float((self.n_right[seen] / self.n_samples[seen]).mean())


def _batches(runs: list[np.ndarray], n_samples: int) -> Iterator[list[np.ndarray]]:
    """Consecutive runs with about `n_samples` samples together."""
    batch_of_run = np.cumsum([0, *(len(run) for run in runs[:-1])]) // n_samples
    for i in range(batch_of_run[-1] + 1):
        start, stop = np.searchsorted(batch_of_run, [i, i + 1])
        if stop > start:
            yield runs[start:stop]


def _fingerprint(schedule: Schedule, training: Part, validation: Part, weights: torch.Tensor, network: C2CNN) -> str:
    """Hash of everything the result depends on."""
    digest = hashlib.sha256(json.dumps([asdict(network.settings), asdict(schedule), torch.__version__]).encode())
    for part in (training, validation):
        for array in (part.grid.keys, part.channels, part.samples.keys, part.samples.labels):
            digest.update(np.ascontiguousarray(array))
    for tensor in (weights, *network.state_dict().values()):
        digest.update(tensor.detach().numpy().tobytes())
    return digest.hexdigest()[:16]
