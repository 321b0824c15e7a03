"""What a laser receiver makes of the echoes of a pulse: which are heard, at what range, how strong.

The pulse is a cone. Where its footprint lies on one smooth surface a single ray stands for it; where it may not
(edges, foliage, glass) a ring of sub-rays joins, each goes on behind what lets light through, and the echoes merge
into mixed pixels or separate into several returns. Whether an echo is heard follows the laser range equation for
extended targets: energy ~ reflectance * cos(incidence) / range^2.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from streetscan.errors import BadInput
from streetscan.simulation.appearance import MATERIALS
from streetscan.simulation.raycasting import SceneCaster

# A Gaussian cone cut into its core and a ring: share of the energy, and where the ring's rays stand in half divergences.
_CORE_SHARE = 0.4
_RING_RADIUS = 0.85
# Three neighbouring pulses on one plane have equidistant inverse ranges; a bend of more than this means an edge.
_EDGE_BEND_M = 0.03
_STEP_BEHIND_M = 1e-3
_MAX_LAYERS = 4
_FAINT = 0.01

_REFLECTANCES = {nm: np.array([getattr(m, f"reflectance_{nm}") for m in MATERIALS], np.float32) for nm in (905, 1550)}
_TRANSMISSION = np.array([m.transmission for m in MATERIALS], np.float32)
_SPECULARITY = np.array([m.specularity for m in MATERIALS], np.float32)
_ROUGHNESS = np.array([m.roughness for m in MATERIALS], np.float32)
# A mirror lobe of width s concentrates its share of the power by about 1 / (4 s^2) against a diffuse surface.
# ASSUME: at most 30 times, the dust on a pane and the width of the beam being what they are.
_LOBE_GAIN = np.minimum(1 / (4 * _ROUGHNESS**2), 30).astype(np.float32)


@dataclass(frozen=True)
class Receiver:
    """The receiving side of a scanner.

    Attributes:
        min_range_m, max_range_m: echoes outside are not recorded.
        dark_range_m: the range at which a surface of 10 % reflectance, hit squarely, is just heard.
        range_noise_m: standard deviation of the range on a strong echo.
        beam_divergence_mrad: full angle of the cone (1/e^2).
        n_subrays: rays of the ring where the footprint may be mixed; 0 makes every pulse one ray.
        resolution_m: echoes closer than this along the pulse merge into one return.
        max_returns: returns recorded of one pulse.
        saturation_db: the amplitude no echo exceeds, above the faintest one heard.
        fading_db: standard deviation of the strength of echoes from one surface: speckle, dirt and grain.
        wavelength_nm: of the laser, 905 or 1550; decides the reflectances.
        keeps: which returns of a pulse are recorded when there are more than `max_returns`: the first or the strongest.
        dropout: share of returns that are lost for reasons no model has.

    Sources: Riegl's data sheet of the VQ-450 at 550 kHz (140 m on a surface of 80 %, that is 50 m on one of 10 %, 0.3 mrad, a few
    returns per pulse). ASSUME: saturation and fading; 1 dB is what amplitudes on one asphalt scatter by.
    """

    min_range_m: float = 1.5
    max_range_m: float = 200.0
    dark_range_m: float = 50.0
    range_noise_m: float = 0.005
    beam_divergence_mrad: float = 0.3
    n_subrays: int = 6
    resolution_m: float = 0.6
    max_returns: int = 5
    saturation_db: float = 35.0
    fading_db: float = 1.0
    wavelength_nm: int = 1550
    keeps: Literal["first", "strongest"] = "first"
    dropout: float = 0.0

    def __post_init__(self):
        if not self.min_range_m < self.max_range_m:
            found = f"{self.min_range_m:g} with max_range_m {self.max_range_m:g}"
            raise BadInput("receiver.min_range_m", found, "let min_range_m be below max_range_m")
        if not self.resolution_m > 0:
            raise BadInput("receiver.resolution_m", f"{self.resolution_m:g} is not above 0", "give metres, such as 0.6")


@dataclass
class Returns:
    """The returns of a batch of pulses, in the order of the pulses; all arrays (m,).

    Attributes:
        pulses: int32 row of the pulse.
        ranges_m: float32 measured range, with noise.
        faces: int32 row of the triangle most of the energy came from, in the caster's tables.
        actors: int16 the moving actor it belongs to, -1 for what stands still.
        cos_incidence: float32.
        intensities: uint16 amplitude in 0.01 dB above the faintest echo heard.
        return_numbers, n_returns: uint8, from 1.
    """

    pulses: np.ndarray
    ranges_m: np.ndarray
    faces: np.ndarray
    actors: np.ndarray
    cos_incidence: np.ndarray
    intensities: np.ndarray
    return_numbers: np.ndarray
    n_returns: np.ndarray

    def __len__(self) -> int:
        return len(self.pulses)


@dataclass
class _Echoes:
    """Surfaces met by rays: `energies` 1 is the faintest heard."""

    pulses: np.ndarray
    distances_m: np.ndarray
    faces: np.ndarray
    actors: np.ndarray
    cos_incidence: np.ndarray
    energies: np.ndarray

    def select(self, rows: np.ndarray) -> "_Echoes":
        return _Echoes(*(v[rows] for v in vars(self).values()))


def measure(
    caster: SceneCaster, origins: np.ndarray, directions: np.ndarray, times_s: np.ndarray, receiver: Receiver, rng: np.random.Generator
) -> Returns:
    """The returns of pulses.

    Args:
        caster: the scene.
        origins: (n, 3) float64, metres, frame `map`.
        directions: (n, 3) float32 unit vectors, frame `map`, in the order the pulses are fired.
        times_s: (n,) float64.
        receiver: the receiving side.
        rng: range noise and speckle.
    """
    core = caster.cast(origins, directions, times_s)
    is_hit = core.faces >= 0
    is_open = is_hit & (_TRANSMISSION[caster.materials[core.faces]] > 0)
    is_mixed = is_open | (_bends(core.distances_m) if receiver.n_subrays else False)

    simple = np.flatnonzero(is_hit & ~is_mixed)
    single = _Echoes(simple, core.distances_m[simple], core.faces[simple], core.actors[simple], core.cos_incidence[simple], np.float32(1))
    single.energies = _energies(caster, single, np.ones(len(simple), np.float32), receiver)

    mixed = np.flatnonzero(is_mixed)
    many = _trace_cones(caster, origins[mixed], directions[mixed], times_s[mixed], receiver)
    many.pulses = mixed[many.pulses]
    merged = _merge(many, receiver)

    echoes = _Echoes(*(np.concatenate([a, b]) for a, b in zip(vars(single).values(), vars(merged).values(), strict=True)))
    echoes = echoes.select(np.argsort(echoes.pulses, kind="stable"))
    return _record(echoes, receiver, rng)


def _bends(distances_m: np.ndarray) -> np.ndarray:
    """Pulses whose neighbours do not lie on one plane with them (the first and the last of a batch count as such)."""
    inverse = 1 / distances_m
    bends = np.ones(len(distances_m), bool)
    second = np.abs(inverse[2:] - 2 * inverse[1:-1] + inverse[:-2])
    # |d(1/r)| = dr / r^2; a miss has 1/r = 0 and bends wherever one of its neighbours is hit.
    bends[1:-1] = second > _EDGE_BEND_M * np.maximum(inverse[1:-1], 1e-3) ** 2
    return bends


def _trace_cones(caster: SceneCaster, origins: np.ndarray, directions: np.ndarray, times_s: np.ndarray, receiver: Receiver) -> _Echoes:
    """All echoes of pulses followed as a core and a ring of sub-rays, each through what lets light pass."""
    n_pulses, n_ring = len(origins), receiver.n_subrays
    pulses = np.repeat(np.arange(n_pulses), n_ring + 1)
    rays = _cone(directions, n_ring, receiver.beam_divergence_mrad * 1e-3 / 2 * _RING_RADIUS)
    weights = np.full((n_pulses, n_ring + 1), (1 - _CORE_SHARE) / max(n_ring, 1), np.float32)
    weights[:, 0] = _CORE_SHARE if n_ring else 1.0
    weights = weights.ravel()
    starts, travelled = origins[pulses], np.zeros(len(pulses), np.float32)
    layers = []
    for _ in range(_MAX_LAYERS):
        hits = caster.cast(starts, rays, times_s[pulses])
        rows = np.flatnonzero(hits.faces >= 0)
        pulses, rays, weights = pulses[rows], rays[rows], weights[rows]
        steps = hits.distances_m[rows]
        echoes = _Echoes(pulses, travelled[rows] + steps, hits.faces[rows], hits.actors[rows], hits.cos_incidence[rows], weights)
        echoes.energies = _energies(caster, echoes, weights, receiver)
        layers.append(echoes)
        # Light passes what it meets twice, going and coming back.
        weights = weights * _TRANSMISSION[caster.materials[echoes.faces]] ** 2
        on = weights > _FAINT
        if not on.any():
            break
        starts = starts[rows][on] + (steps[on] + _STEP_BEHIND_M)[:, None] * rays[on]
        travelled = (echoes.distances_m + _STEP_BEHIND_M)[on]
        pulses, rays, weights = pulses[on], rays[on], weights[on]
    return _Echoes(*(np.concatenate([getattr(e, name) for e in layers]) for name in vars(layers[0])))


def _cone(directions: np.ndarray, n_ring: int, radius_rad: float) -> np.ndarray:
    """(n * (1 + n_ring), 3) float32: each direction followed by its ring."""
    helper = np.where(np.abs(directions[:, 2:]) < 0.9, [[0, 0, 1]], [[1, 0, 0]]).astype(np.float32)
    side = np.cross(directions, helper)
    side *= radius_rad / np.linalg.norm(side, axis=1, keepdims=True)
    other = np.cross(directions, side)
    angles = 2 * np.pi * np.arange(n_ring) / max(n_ring, 1)
    ring = [directions + np.float32(np.cos(a)) * side + np.float32(np.sin(a)) * other for a in angles]
    return np.stack([directions, *ring], axis=1).reshape(-1, 3).astype(np.float32)


def _energies(caster: SceneCaster, echoes: _Echoes, weights: np.ndarray, receiver: Receiver) -> np.ndarray:
    """Energy of echoes that carry `weights` of their pulse; 1 is the faintest heard."""
    materials = caster.materials[echoes.faces]
    reflectance = _REFLECTANCES[receiver.wavelength_nm][materials]
    cos = echoes.cos_incidence
    # Retro-reflectors (reflectance above 1) send light back whatever the angle.
    diffuse = np.where(reflectance > 1, 1, cos) * (1 - _SPECULARITY[materials])
    angle = np.arccos(np.minimum(cos, 1))
    lobe = _SPECULARITY[materials] * _LOBE_GAIN[materials] * np.exp(-0.5 * (angle / _ROUGHNESS[materials]) ** 2)
    gain = reflectance * (diffuse + lobe)
    faintest = 0.1 / receiver.dark_range_m**2
    return (weights * gain / (faintest * np.maximum(echoes.distances_m, 0.1) ** 2)).astype(np.float32)


def _merge(echoes: _Echoes, receiver: Receiver) -> _Echoes:
    """Echoes of one pulse closer than the resolution become one: energies add, ranges average by energy, the strongest names it."""
    if len(echoes.pulses) == 0:
        return echoes
    echoes = echoes.select(np.lexsort((echoes.distances_m, echoes.pulses)))
    breaks = np.diff(echoes.pulses) != 0
    gaps = np.append(True, breaks | (np.diff(echoes.distances_m) > receiver.resolution_m))
    # A chain of close echoes (foliage) longer than the resolution is cut at its multiples.
    first = echoes.distances_m[np.flatnonzero(gaps)][np.cumsum(gaps) - 1]
    step = np.floor((echoes.distances_m - first) / receiver.resolution_m)
    starts = np.flatnonzero(gaps | np.append(True, np.diff(step) != 0))
    groups = np.repeat(np.arange(len(starts)), np.diff(np.append(starts, len(gaps))))
    energies = np.add.reduceat(echoes.energies, starts)
    ranges = np.add.reduceat(echoes.energies * echoes.distances_m.astype(np.float64), starts) / np.maximum(energies, 1e-30)
    strongest = np.lexsort((-echoes.energies, groups))[starts]
    merged = echoes.select(strongest)
    merged.distances_m = np.where(energies > 0, ranges, merged.distances_m).astype(np.float32)
    merged.energies = energies
    return merged


def _record(echoes: _Echoes, receiver: Receiver, rng: np.random.Generator) -> Returns:
    """The echoes that are heard, with noise and numbers."""
    # ASSUME: a range noise that doubles on the faintest echoes and grows with the slope of the footprint.
    energies = echoes.energies * np.float32(10) ** (receiver.fading_db / 10 * rng.standard_normal(len(echoes.energies), np.float32))
    in_range = (echoes.distances_m >= receiver.min_range_m) & (echoes.distances_m <= receiver.max_range_m)
    rows = np.flatnonzero((energies >= 1) & in_range)
    if receiver.dropout:
        rows = rows[rng.random(len(rows), np.float32) >= receiver.dropout]
    if receiver.keeps == "strongest":
        rows = _strongest(rows, echoes.pulses, energies, receiver.max_returns)
    echoes, energies = echoes.select(rows), energies[rows]

    starts = np.flatnonzero(np.append(True, np.diff(echoes.pulses) != 0)) if len(rows) else np.empty(0, np.int64)
    counts = np.diff(np.append(starts, len(rows)))
    numbers = np.arange(len(rows)) - np.repeat(starts, counts) + 1
    totals = np.minimum(np.repeat(counts, counts), receiver.max_returns)
    kept = numbers <= receiver.max_returns
    echoes, energies, numbers, totals = echoes.select(kept), energies[kept], numbers[kept], totals[kept]

    cos = np.maximum(echoes.cos_incidence, 0.05)
    footprint_m = receiver.beam_divergence_mrad * 1e-3 * echoes.distances_m
    sigma_m = np.hypot(receiver.range_noise_m * np.sqrt(1 + 3 / energies), 0.1 * footprint_m * np.sqrt(np.maximum(1 - cos**2, 0)) / cos)
    amplitude_db = np.minimum(10 * np.log10(np.maximum(energies, 1)), receiver.saturation_db)
    return Returns(
        echoes.pulses.astype(np.int32),
        echoes.distances_m + sigma_m.astype(np.float32) * rng.standard_normal(len(numbers), np.float32),
        echoes.faces,
        echoes.actors,
        echoes.cos_incidence,
        np.round(100 * amplitude_db).astype(np.uint16),
        numbers.astype(np.uint8),
        totals.astype(np.uint8),
    )


def _strongest(rows: np.ndarray, pulses: np.ndarray, energies: np.ndarray, n: int) -> np.ndarray:
    """Those of the rows that are among the n strongest of their pulse, in their order."""
    order = rows[np.lexsort((-energies[rows], pulses[rows]))]
    starts = np.flatnonzero(np.append(True, np.diff(pulses[order]) != 0)) if len(order) else np.empty(0, np.int64)
    ranks = np.arange(len(order)) - np.repeat(starts, np.diff(np.append(starts, len(order))))
    return np.sort(order[ranks < n])
