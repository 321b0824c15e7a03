"""How real a map looks, in numbers that any map can be asked for: simulated or scanned, labelled or not.

Every function gives rows `statistic, group, x, value, n` of one tidy table, so that tables of several maps can be put
beside each other (`streetscan.simulation.realism_figures`). Costly statistics are exact within a sample of square tiles.
"""

from collections.abc import Iterable, Iterator

import numpy as np
import pandas as pd
from scipy.spatial import cKDTree

from streetscan.classes import NAMES, PHANTOM, UNLABELLED
from streetscan.clouds import PointCloud
from streetscan.simulation.layout import build_street, count_blocks
from streetscan.simulation.raycasting import SceneCaster
from streetscan.simulation.receiver import Receiver, measure
from streetscan.simulation.recording import BLOCK_SEED, Errors, caster_of_drive, draw_bursts, plan_passes, seed_of_recording
from streetscan.simulation.sensors import mobile_mapper
from streetscan.voxels import find_sorted, pack_keys

COLUMNS = ("statistic", "group", "x", "value", "n")
_VOXEL_M = 0.1
_BURST = 2000
_PATCH_M = 0.5
_MIN_PATCH_POINTS = 50
# A patch counts as flat below this; kerbs, cornices and crowns lie above.
_FLAT_M = 0.03
_JUMP_M = 0.3
_PASS_GAP_S = 1.0
_QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95)


def describe_map(
    clouds: Iterable[tuple[PointCloud, np.ndarray | None]],
    track: np.ndarray | None = None,
    tile_m: float = 4.0,
    tile_share: float = 0.25,
    max_range_m: float = 40.0,
) -> pd.DataFrame:
    """The statistics of a map.

    Args:
        clouds: pieces of the map in file order, with their (n,) uint8 labels or None. `intensity` and `time_s` are used when there.
        track: (K, 3) positions of the scanner, metres, frame `map`; None leaves out density against range.
        tile_m: edge of the tiles the sample is made of.
        tile_share: share of the tiles looked at.
        max_range_m: of density against range.
    Returns:
        table with the columns `statistic, group, x, value, n`:
        `class_share` (group: class), `intensity_share` (group: class or all; x: upper bin edge, share of the group's points),
        `mixed_share` and `edge_width_m` (only with time_s), `plane_residual_m` (group: road, facade and the same with `_one_pass`;
        x: quantile), `points_per_voxel` (group: class; x: quantile), `isolated_share`, `ground_density_per_m2` (x: quantile of the
        square metres of ground), `density_per_m2` (x: range, lower bin edge).
    """
    rows: list[tuple] = []
    sample = _sample(clouds, tile_m, tile_share, rows)
    if sample is None:
        return pd.DataFrame(rows, columns=COLUMNS)
    points, labels, intensity, passes = sample
    origin = np.floor(points.min(axis=0))
    local = points - origin
    rows += _voxel_rows(local, labels)
    rows += _patch_rows(local, np.zeros(len(local), np.int64), "")
    if passes is not None:
        rows += _patch_rows(local, passes, "_one_pass")
    # Some files have the field and leave it empty.
    if intensity is not None and np.ptp(intensity) > 0:
        rows += _intensity_rows(intensity, labels)
    cells, densities = _ground_densities(local, labels)
    rows += [("ground_density_per_m2", "ground", q, float(np.quantile(densities, q)), len(densities)) for q in _QUANTILES if len(densities)]
    if track is not None:
        rows += _density_rows(cells, densities, np.asarray(track, np.float64) - origin, max_range_m)
    return pd.DataFrame(rows, columns=COLUMNS)


def density_around(
    clouds: Iterable[tuple[PointCloud, np.ndarray | None]],
    position: np.ndarray,
    max_range_m: float = 40.0,
    time_span_s: tuple[float, float] | None = None,
) -> pd.DataFrame:
    """Points per square metre of ground against the distance from one place (thesis Fig. 2.3, inventory N-009).

    Args:
        clouds: as for `describe_map`; only what lies within range of the place is kept.
        position: (3,) the place, metres, frame `map`.
        max_range_m: horizontally.
        time_span_s: leaves out the points measured at other times; None keeps all.
    Returns:
        rows of `density_per_m2` (x: distance, lower edge of a bin of 2 m; value: median over the square metres; n: how many).
    """
    kept: list[tuple] = []
    for cloud, labels in clouds:
        near = np.hypot(*(cloud.points[:, :2] - position[:2]).T) < max_range_m + 2
        if time_span_s is not None:
            near &= (cloud.fields["time_s"] >= time_span_s[0]) & (cloud.fields["time_s"] < time_span_s[1])
        labels = np.full(len(cloud), UNLABELLED, np.uint8) if labels is None else np.asarray(labels, np.uint8)
        kept.append((cloud.points[near], labels[near]))
    points, labels = (np.concatenate(column) for column in zip(*kept, strict=True))
    origin = np.floor(position)
    rows = _density_rows(*_ground_densities(points - origin, labels), (np.asarray(position, np.float64) - origin)[None], max_range_m)
    return pd.DataFrame(rows, columns=COLUMNS)


def probe_street(split: str, seed: int, length_m: float, settings: dict, n_pulses: int) -> tuple[np.ndarray, pd.DataFrame]:
    """Where a mobile mapper drove in a street of the simulated city, and which of its pulses are heard.

    Args:
        split, seed, length_m: the street.
        settings: of the data set's simulation: `street`, `scanners`, `receiver`, `errors`, `n_rounds`.
        n_pulses: pulses tried, in bursts of 2000 spread over the first drive of each block.
    Returns:
        track (K, 3) of the vehicle every 0.1 s, metres, frame `map`, and the table of `measure_return_rates`.
    """
    street = settings["street"] | {"length_m": length_m}
    n_blocks, of_recording = count_blocks(length_m), seed_of_recording(split, seed)
    tracks, tables = [], []
    for b in range(n_blocks):
        scene = build_street(split=split, seed=seed, n_rounds=settings["n_rounds"], block=b, **street)
        passes = plan_passes(scene, Errors(**settings["errors"]), of_recording + BLOCK_SEED * b, settings["n_rounds"])
        tracks += [p.truth.positions[::20] for p in passes]
        caster = caster_of_drive(scene, passes[0])
        for number, scanner in enumerate(mobile_mapper(**settings["scanners"])):
            rng = np.random.default_rng([of_recording, 8, b, number])
            pulses = draw_bursts(passes[0], scanner, max(n_pulses // n_blocks // 2 // _BURST, 1), _BURST, rng)
            tables.append(measure_return_rates(caster, *pulses, Receiver(**settings["receiver"]), rng))
    table = pd.concat(tables)
    table["heard"] = table["value"] * table["n"]
    sums = table.groupby(["statistic", "group", "x"], sort=False, as_index=False)[["heard", "n"]].sum()
    sums["value"] = sums["heard"] / sums["n"]
    return np.concatenate(tracks), sums[list(COLUMNS)]


def measure_return_rates(
    caster: SceneCaster, origins: np.ndarray, directions: np.ndarray, times_s: np.ndarray, receiver: Receiver, rng: np.random.Generator
) -> pd.DataFrame:
    """Share of the pulses that are heard, against incidence: what a map cannot tell, since silent pulses leave no point.

    Args:
        caster: the scene.
        origins, directions, times_s: pulses, as for `streetscan.simulation.receiver.measure`.
        receiver: the receiving side.
        rng: of its noise.
    Returns:
        rows of `return_rate` (group: class of the first surface, or all; x: incidence in degrees, lower bin edge; n: pulses).
    """
    first = caster.cast(origins, directions, times_s)
    is_hit = (first.faces >= 0) & (first.distances_m < receiver.max_range_m)
    is_heard = np.zeros(len(first), bool)
    is_heard[measure(caster, origins, directions, times_s, receiver, rng).pulses] = True
    labels = caster.labels_at(first, times_s)
    bins = np.minimum(np.degrees(np.arccos(np.clip(first.cos_incidence, 0, 1))) // 10, 8).astype(np.int64)
    rows = []
    for group, member in _groups(labels):
        pulses = np.bincount(bins[is_hit & member], minlength=9)
        heard = np.bincount(bins[is_hit & member & is_heard], minlength=9)
        rows += [("return_rate", group, 10.0 * b, heard[b] / pulses[b], int(pulses[b])) for b in range(9) if pulses[b]]
    return pd.DataFrame(rows, columns=COLUMNS)


def _sample(clouds: Iterable, tile_m: float, tile_share: float, rows: list) -> tuple | None:
    """Points, labels, intensity and pass numbers inside the sampled tiles; whole-map counts and edges go into `rows`."""
    counts, n_mixed, n_edges, steps = np.zeros(256, np.int64), 0, 0, []
    kept: list[tuple] = []
    for cloud, labels in clouds:
        if len(cloud) == 0:
            continue
        labels = np.full(len(cloud), UNLABELLED, np.uint8) if labels is None else np.asarray(labels, np.uint8)
        counts += np.bincount(labels, minlength=256)
        if "time_s" in cloud.fields and np.ptp(cloud.fields["time_s"]) == 0:
            # A LAS file has the field even where nobody knows the times.
            cloud = PointCloud(cloud.points, {k: v for k, v in cloud.fields.items() if k != "time_s"})
        if "time_s" in cloud.fields:
            mixed, edges, step = _count_edges(cloud.points, cloud.fields["time_s"])
            n_mixed, n_edges = n_mixed + mixed, n_edges + edges
            steps.append(step)
        inside = _in_sample(cloud.points, tile_m, tile_share)
        optional = [cloud.fields[name][inside] if name in cloud.fields else None for name in ("intensity", "time_s")]
        kept.append((cloud.points[inside], labels[inside], *optional))
    n = int(counts.sum())
    if n == 0:
        return None
    rows += [("class_share", NAMES[c] if c < len(NAMES) else "unlabelled", np.nan, counts[c] / n, n) for c in np.flatnonzero(counts)]
    # Without labels, or where nobody labelled phantoms, "no phantom" is not known.
    if counts[PHANTOM]:
        rows.append(("phantom_share", "labelled", np.nan, counts[PHANTOM] / (n - counts[UNLABELLED]), n))
    if n_edges:
        rows.append(("mixed_share", "all", np.nan, n_mixed / n_edges, n_edges))
        rows.append(("edge_width_m", "all", np.nan, n_mixed / n_edges * float(np.median(steps)), n_edges))
    points, labels, intensity, time_s = (
        None if any(part is None for part in column) else np.concatenate(column) for column in zip(*kept, strict=True)
    )
    if len(points) == 0:
        return None
    return points, labels, intensity, None if time_s is None else _pass_numbers(time_s)


def _in_sample(points: np.ndarray, tile_m: float, tile_share: float) -> np.ndarray:
    """Points in the tiles an integer hash picks: the same tiles whatever the order of the points."""
    tiles = np.floor(points[:, :2] / tile_m).astype(np.int64)
    hashed = (tiles[:, 0] * 73856093 ^ tiles[:, 1] * 19349663) & 0xFFFF
    return (hashed * 40503 & 0xFFFF) < tile_share * 0x10000


def _pass_numbers(time_s: np.ndarray) -> np.ndarray:
    """Pass each point belongs to: a new one begins where nothing was measured for a second."""
    order = np.argsort(time_s, kind="stable")
    numbers = np.empty(len(time_s), np.int64)
    numbers[order] = np.append(0, np.cumsum(np.diff(time_s[order]) > _PASS_GAP_S))
    return numbers


def _count_edges(points: np.ndarray, time_s: np.ndarray) -> tuple[int, int, float]:
    """Mixed pixels, edges, and the median step between neighbouring points, of points in the order they were measured.

    An edge is a jump of more than 0.3 m that is four times the steps before and after it; it is mixed when one point floats in
    the middle of the jump. Mixed pixels per edge times the step is the width of the zone in which a pulse is mixed.
    """
    if len(points) < 5:
        return 0, 0, 0.0
    moves = np.diff(points, axis=0)
    steps = np.linalg.norm(moves, axis=1)
    # Some files hold each beam's points from the last to the first.
    forward = np.diff(time_s) * (1 if np.median(np.diff(time_s)) >= 0 else -1)
    steps[forward < 0] = np.inf
    plain = (steps[1:-1] > _JUMP_M) & (steps[1:-1] < 10) & (np.maximum(steps[:-2], steps[2:]) < steps[1:-1] / 4)
    chords = points[3:-1] - points[1:-3]
    lengths = np.linalg.norm(chords, axis=1)
    along = np.einsum("ij,ij->i", moves[1:-2], chords) / np.maximum(lengths, 1e-9)
    aside = np.sqrt(np.maximum(steps[1:-2] ** 2 - along**2, 0))
    floats = (along > 0.1) & (along < lengths - 0.1) & (aside < 0.03)
    mixed = floats & (lengths > _JUMP_M) & (lengths < 10) & (np.maximum(steps[:-3], steps[3:]) < lengths / 4)
    n_mixed = int(mixed.sum())
    finite = steps[np.isfinite(steps)]
    return n_mixed, n_mixed + int(plain.sum()), float(np.median(finite)) if len(finite) else 0.0


def _voxel_rows(points: np.ndarray, labels: np.ndarray) -> Iterator[tuple]:
    packed, inverse, counts = np.unique(pack_keys(np.floor(points / _VOXEL_M).astype(np.int64)), return_inverse=True, return_counts=True)
    voxel_labels = np.zeros(len(packed), np.uint8)
    voxel_labels[inverse.reshape(-1)] = labels  # any point's label: voxels of several classes are few
    for group, member in _groups(voxel_labels):
        for q in _QUANTILES if member.any() else ():
            yield "points_per_voxel", group, q, float(np.quantile(counts[member], q)), int(member.sum())
    # A voxel of one point without occupied neighbours holds a stray point.
    lonely = np.flatnonzero(counts == 1)
    keys = np.floor(points / _VOXEL_M).astype(np.int64)
    at = np.zeros(len(packed), np.int64)
    at[inverse.reshape(-1)] = np.arange(len(points))
    own = keys[at[lonely]]
    is_alone = np.ones(len(lonely), bool)
    for offset in np.ndindex(3, 3, 3):
        if offset != (1, 1, 1):
            is_alone &= find_sorted(packed, pack_keys(own + (np.array(offset) - 1))) < 0
    yield "isolated_share", "all", np.nan, float(is_alone.sum() / len(points)), len(points)


def _patch_rows(points: np.ndarray, passes: np.ndarray, suffix: str) -> Iterator[tuple]:
    """Standard deviation of points about the plane of flat half-metre patches."""
    keys = np.floor(points / _PATCH_M).astype(np.int64)
    _, group, counts = np.unique(np.stack([passes, pack_keys(keys)], axis=1), axis=0, return_inverse=True, return_counts=True)
    group = group.reshape(-1)
    offsets = points - (keys + 0.5) * _PATCH_M
    means = np.stack([np.bincount(group, offsets[:, i]) for i in range(3)], axis=1) / counts[:, None]
    covariances = np.empty((len(counts), 3, 3))
    for i in range(3):
        for j in range(i, 3):
            moment = np.bincount(group, offsets[:, i] * offsets[:, j]) / counts - means[:, i] * means[:, j]
            covariances[:, i, j] = covariances[:, j, i] = moment
    covariances = covariances[counts >= _MIN_PATCH_POINTS]
    if len(covariances) == 0:
        return
    values, vectors = np.linalg.eigh(covariances)
    spreads = np.sqrt(np.maximum(values, 0))
    flat = (spreads[:, 0] < _FLAT_M) & (spreads[:, 1] > _PATCH_M / 6)
    steepness = np.abs(vectors[:, 2, 0])
    for name, member in (("road", flat & (steepness > 0.95)), ("facade", flat & (steepness < 0.1))):
        for q in _QUANTILES if member.any() else ():
            yield "plane_residual_m", name + suffix, q, float(np.quantile(spreads[member, 0], q)), int(member.sum())


def _intensity_rows(intensity: np.ndarray, labels: np.ndarray) -> Iterator[tuple]:
    top = float(np.quantile(intensity, 0.999)) or 1.0
    edges = np.linspace(0, top, 41)
    for group, member in _groups(labels):
        if member.any():
            shares = np.histogram(np.minimum(intensity[member], top), edges)[0] / member.sum()
            for edge, share in zip(edges[1:], shares, strict=True):
                yield "intensity_share", group, float(edge), float(share), int(member.sum())


def _ground_densities(points: np.ndarray, labels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Square metres with open ground, (C, 2) int64 lower corners, and the points of ground in each, (C,).

    Ground is what is labelled so; without labels, what lies within 0.15 m of the lowest point of a 1 m cell.
    """
    if len(points) == 0:
        return np.empty((0, 2), np.int64), np.empty(0, np.int64)
    cells, group, counts = np.unique(np.floor(points[:, :2]).astype(np.int64), axis=0, return_inverse=True, return_counts=True)
    group = group.reshape(-1)
    if (labels != UNLABELLED).any():
        is_ground = labels == 0
    else:
        lowest = np.full(len(counts), np.inf)
        np.minimum.at(lowest, group, points[:, 2])
        is_ground = points[:, 2] < lowest[group] + 0.15
    densities = np.bincount(group[is_ground], minlength=len(counts))
    return cells[densities > 0], densities[densities > 0]


def _density_rows(cells: np.ndarray, densities: np.ndarray, track: np.ndarray, max_range_m: float) -> Iterator[tuple]:
    """Median points per square metre of open ground against the horizontal distance from the track."""
    distances = cKDTree(track[:, :2]).query(cells + 0.5)[0]
    for low in np.arange(0, max_range_m, 2.0):
        member = (distances >= low) & (distances < low + 2)
        if member.any():
            yield "density_per_m2", "ground", float(low), float(np.median(densities[member])), int(member.sum())


def _groups(labels: np.ndarray) -> Iterator[tuple[str, np.ndarray]]:
    yield "all", np.ones(len(labels), bool)
    for label, name in enumerate(NAMES):
        if (labels == label).any():
            yield name, labels == label
