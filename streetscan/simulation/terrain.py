"""The course of a street in plan and height, and the ground along it.

Street coordinates: s along the axis from its start, t across (positive to the left), h above the terrain; metres.
Cross section, half of it (the other half mirrors it): driving lane, lane shared with the tram, a strip for bicycles,
parked vehicles, kerb, sidewalk; beyond lie buildings, a square, a park, or the void beside a bridge.
"""

from dataclasses import dataclass, field

import numpy as np

from streetscan.classes import FURNITURE, GROUND
from streetscan.simulation.appearance import draw_colour
from streetscan.simulation.meshes import Relief, Surface, join, quads
from streetscan.simulation.scene import Mesh

LANE_M = 1.75  # middle of the inner lane, where the mapping vehicle drives
LANE_LINE_M = 3.5
OUTER_LANE_M = 5.0  # middle of the outer lane: cars, buses and trams
TRACK_GAUGE_M = 1.435
BICYCLE_LANE_M = 6.85
PARKING_M = (7.3, 9.4)
KERB_M = 9.4
SIDEWALK_M = 14.2  # its outer edge: the building line
KERB_HEIGHT_M = 0.12
BRIDGE_EDGE_M = 12.6
GROUND_M = 58.0  # how far the ground reaches to either side
CROSS_KERB_M = (3.4, 5.4)  # half widths of a cross street: without and with its parking lane (on the +s side)
CROSS_EDGE_M = 7.2
CORNER_RADIUS_M = 3.6
BRIDGE_DEPTH_M = 6.0


@dataclass(frozen=True)
class Axis:
    """The axis of a street: a gently winding line on a rolling terrain.

    Attributes:
        length_m: the street's length; the axis goes on beyond both ends.
        origin: (easting, northing, height) of s = 0.
        heading_rad, bend_rad, bend_length_m, bend_phase_rad: heading = heading + bend sin(2 pi s / bend_length + phase).
        slopes, wave_lengths_m, wave_phases_rad: the longitudinal slope is the sum of slope sin(2 pi s / length + phase).
        side_slope: rise per metre away from the sidewalk's edge, left positive.
    """

    length_m: float
    origin: tuple[float, float, float]
    heading_rad: float
    bend_rad: float
    bend_length_m: float
    bend_phase_rad: float
    slopes: tuple[float, ...]
    wave_lengths_m: tuple[float, ...]
    wave_phases_rad: tuple[float, ...]
    side_slope: float
    _table: np.ndarray = field(init=False, repr=False, compare=False, default=None)

    def __post_init__(self):
        s = np.arange(-400.0, self.length_m + 400.5, 0.5)
        heading = self.yaw_at(s)
        step = 0.5 * np.stack([np.cos(heading), np.sin(heading)], 1)
        xy = np.cumsum(step, 0) - step / 2
        xy -= [np.interp(0.0, s, xy[:, 0]), np.interp(0.0, s, xy[:, 1])]
        object.__setattr__(self, "_table", np.column_stack([s, xy]))

    def yaw_at(self, s: np.ndarray) -> np.ndarray:
        """Heading of the axis, radians counter-clockwise from easting."""
        return self.heading_rad + self.bend_rad * np.sin(2 * np.pi * np.asarray(s, float) / self.bend_length_m + self.bend_phase_rad)

    def profile(self, s: np.ndarray) -> np.ndarray:
        """Height of the axis above that of s = 0."""
        s, z = np.asarray(s, float), 0.0
        for slope, length, phase in zip(self.slopes, self.wave_lengths_m, self.wave_phases_rad, strict=True):
            k = 2 * np.pi / length
            z = z + slope / k * (np.cos(phase) - np.cos(k * s + phase))
        return z

    def height_at(self, s: np.ndarray, t: np.ndarray) -> np.ndarray:
        """Height (map) of the terrain: profile, 2 % crossfall of carriageway and sidewalks, slope and humps beyond."""
        s, t = np.broadcast_arrays(np.asarray(s, float), np.asarray(t, float))
        side = np.abs(t)
        beyond = np.clip(side - SIDEWALK_M, 0, None)
        crossfall = -0.02 * np.minimum(side, KERB_M) + 0.02 * np.clip(side - KERB_M, 0, SIDEWALK_M - KERB_M)
        humps = 0.07 * np.sin(s / 4.3) * np.sin(t / 3.7) * np.minimum(1, beyond / 3)
        # Wear is long enough for the ground's cells of 2 m x 4 m to follow it within a millimetre.
        wear = 0.005 * np.sin(s / 3.1 + 0.35 * t) + 0.003 * np.sin(s / 2.3 - 0.5 * t)
        return self.origin[2] + self.profile(s) + crossfall + np.sign(t) * self.side_slope * beyond + humps + wear

    def to_map(self, s: np.ndarray, t: np.ndarray, h: np.ndarray | float = 0.0) -> np.ndarray:
        """(n, 3) map coordinates of street coordinates."""
        s, t, h = np.broadcast_arrays(*(np.atleast_1d(np.asarray(v, float)) for v in (s, t, h)))
        x = np.interp(s, self._table[:, 0], self._table[:, 1])
        y = np.interp(s, self._table[:, 0], self._table[:, 2])
        yaw = self.yaw_at(s)
        return np.stack([self.origin[0] + x - t * np.sin(yaw), self.origin[1] + y + t * np.cos(yaw), self.height_at(s, t) + h], -1)

    def slope_at(self, s: float, t: float, yaw_rad: float) -> tuple[float, float]:
        """Rise of the terrain per metre along x and y of an object at (s, t) that is turned by `yaw_rad` from the axis."""
        d = 1.0
        along = float(self.height_at(s + d, t) - self.height_at(s - d, t)) / (2 * d)
        across = float(self.height_at(s, t + 0.4) - self.height_at(s, t - 0.4)) / 0.8
        c, n = np.cos(yaw_rad), np.sin(yaw_rad)
        return c * along + n * across, -n * along + c * across


def draw_axis(length_m: float, max_slope: float, relief_m: float, origin: tuple, rng: np.random.Generator) -> Axis:
    """An axis whose slope never exceeds `max_slope` and whose height, over a long street, ranges over `relief_m`.

    Three quarters of the slope belong to one long wave, the rest to a short one. A street shorter than half the long
    wave gets a wave of twice and a half its own length instead, so that it rises and falls within itself.
    """
    long = np.pi * relief_m / max(0.75 * max_slope, 1e-6)
    lengths = (max(min(long, 2.5 * length_m), 60.0), max(min(long / 9, 0.6 * length_m), 40.0))
    bend_length = float(rng.uniform(420, 640))
    # The curve's radius is at least 350 m.
    bend = bend_length / (2 * np.pi * 350) * float(rng.uniform(0.5, 1.0)) * float(rng.choice([-1, 1]))
    return Axis(
        length_m,
        origin,
        float(rng.uniform(0, 2 * np.pi)),
        bend,
        bend_length,
        float(rng.uniform(0, 2 * np.pi)),
        (0.75 * max_slope, 0.25 * max_slope),
        tuple(float(v) for v in lengths),
        (float(rng.uniform(0.2, 0.9)), float(rng.uniform(0, 2 * np.pi))),
        float(rng.uniform(-0.02, 0.02)),
    )


@dataclass(frozen=True)
class Zone:
    """What lies beside the street from s0 to s1: `left` and `right` are buildings, square, park or bridge."""

    s0: float
    s1: float
    left: str
    right: str

    def side(self, sign: int) -> str:
        """The kind on the left (+1) or right (-1)."""
        return self.left if sign > 0 else self.right


def ground_mesh(
    axis: Axis, s0: float, s1: float, zones: list[Zone], crossings: list[float], pits: list[tuple[float, float]], seed: int
) -> Mesh:
    """The ground from s0 to s1: carriageway, kerbs, sidewalks, tree pits, lawns, cross streets and what is painted on them.

    Args:
        zones: what lies beside the street.
        crossings: s of the cross streets' centre lines.
        pits: (s, t) of tree pits.
        seed: of the street, so that colours are the same in every part of it.
    """
    rng = np.random.default_rng([seed, 7001])
    asphalt = Surface(GROUND, "asphalt", draw_colour("asphalt", rng, 4))
    old_asphalt = Surface(GROUND, "asphalt", draw_colour("asphalt", rng, 8))
    setts = Surface(GROUND, "paving", draw_colour("paving", rng, 8))
    slabs = Surface(GROUND, "concrete", (142, 140, 136))
    kerb = Surface(GROUND, "stone", (170, 168, 162))
    walk = Surface(GROUND, "paving", draw_colour("paving", rng, 6))
    square = Surface(GROUND, "paving", draw_colour("paving", rng, 12))
    band = Surface(GROUND, "stone", (196, 188, 172))
    lawn = Surface(GROUND, "grass", draw_colour("grass", rng, 5))
    gravel = Surface(GROUND, "gravel", (176, 160, 130))
    soil = Surface(GROUND, "soil", (92, 74, 58))
    water = Surface(GROUND, "water", (62, 84, 88))
    bank = Surface(GROUND, "grass", (96, 104, 64))
    parapet = Surface(FURNITURE, "stone", (168, 160, 148))
    k = KERB_HEIGHT_M

    relief = Relief((s0, s1), (-GROUND_M, GROUND_M), k, walk)
    for sign in (-1, 1):

        def paint(a, b, low, high, h, surface, sign=sign):
            relief.paint(a, b, *sorted((sign * low, sign * high)), h, surface)

        for zone in zones:
            a, b, kind = zone.s0, zone.s1, zone.side(sign)
            if kind == "park":
                paint(a, b, SIDEWALK_M, SIDEWALK_M + 0.12, k + 0.10, kerb)
                paint(a, b, SIDEWALK_M + 0.12, GROUND_M, k + 0.04, lawn)
                paint(a, b, SIDEWALK_M + 6.0, SIDEWALK_M + 8.2, k, gravel)
                middle = (a + b) / 2
                paint(middle - 1.1, middle + 1.1, SIDEWALK_M, GROUND_M, k, gravel)
            elif kind == "square":
                paint(a, b, SIDEWALK_M, GROUND_M, k, square)
                for s in np.arange(a + 2, b - 1, 5.0):
                    paint(s, s + 0.4, SIDEWALK_M, GROUND_M, k, band)
                for t in np.arange(SIDEWALK_M + 1, GROUND_M, 5.0):
                    paint(a, b, t, t + 0.4, k, band)
            elif kind == "bridge":
                paint(a, b, BRIDGE_EDGE_M, GROUND_M, -BRIDGE_DEPTH_M + 1.2, bank)
                paint(a + 3, b - 3, BRIDGE_EDGE_M, GROUND_M, -BRIDGE_DEPTH_M, water)
                paint(a, b, BRIDGE_EDGE_M, BRIDGE_EDGE_M + 0.1, k, kerb)
                paint(a, b, BRIDGE_EDGE_M - 0.45, BRIDGE_EDGE_M, k + 0.18, parapet)
        paint(s0, s1, 0, KERB_M, 0.0, asphalt)
        paint(s0, s1, OUTER_LANE_M - 1.25, OUTER_LANE_M + 1.25, 0.0, slabs)
        paint(s0, s1, *PARKING_M, 0.0, setts)
        paint(s0, s1, KERB_M, KERB_M + 0.15, k, kerb)
    for s, t in pits:
        relief.paint(s - 0.75, s + 0.75, t - 0.75, t + 0.75, k - 0.05, soil)
    for s in crossings:
        for sign in (-1, 1):

            def paint(a, b, low, high, h, surface, sign=sign):
                relief.paint(a, b, *sorted((sign * low, sign * high)), h, surface)

            left, right = s - CROSS_KERB_M[0], s + CROSS_KERB_M[1]
            paint(s - CROSS_EDGE_M, s + CROSS_EDGE_M, KERB_M, GROUND_M, k, walk)
            paint(left - 0.15, right + 0.15, KERB_M, GROUND_M, k, kerb)
            paint(left, right, KERB_M, GROUND_M, 0.0, old_asphalt)
            paint(s + CROSS_KERB_M[0], right, KERB_M + 5.0, GROUND_M, 0.0, setts)
            # Rounded corners, in steps of 0.3 m.
            for u in np.arange(0, CORNER_RADIUS_M, 0.3):
                reach = CORNER_RADIUS_M - np.sqrt(CORNER_RADIUS_M**2 - (CORNER_RADIUS_M - u - 0.15) ** 2)
                paint(left - reach - 0.15, left, KERB_M + u, KERB_M + u + 0.3, k, kerb)
                paint(right, right + reach + 0.15, KERB_M + u, KERB_M + u + 0.3, k, kerb)
                paint(left - reach, left, KERB_M + u, KERB_M + u + 0.3, 0.0, old_asphalt)
                paint(right, right + reach, KERB_M + u, KERB_M + u + 0.3, 0.0, old_asphalt)
            # Lowered kerbs where people cross.
            for a in (s - CROSS_EDGE_M - 4.2, s + CROSS_EDGE_M + 1.2):
                paint(a, a + 3.0, KERB_M, KERB_M + 0.5, 0.03, kerb)
                paint(a, a + 3.0, KERB_M + 0.5, KERB_M + 1.0, 0.07, walk)
    mesh = relief.build(axis.to_map, (2.0, 4.0), 5.0, rng)
    return join([mesh, *_markings(axis, s0, s1, zones, crossings, seed)])


def _strips(axis: Axis, rectangles: list[tuple], lift: float, surface: Surface) -> Mesh:
    """Thin rectangles (a0, a1, b0, b1) laid on the terrain, cut along s so that they follow it."""
    pieces = []
    for a0, a1, b0, b1 in rectangles:
        edges = np.linspace(a0, a1, max(1, int(np.ceil((a1 - a0) / 1.0))) + 1)
        pieces.append(np.stack([edges[:-1], edges[1:], np.full(len(edges) - 1, b0), np.full(len(edges) - 1, b1)], 1))
    if not pieces:
        return quads(np.zeros((0, 4, 3)), surface)
    a0, a1, b0, b1 = np.concatenate(pieces).T
    s, t = np.stack([a0, a1, a1, a0], 1), np.stack([b0, b0, b1, b1], 1)
    return quads(axis.to_map(s.ravel(), t.ravel(), lift).reshape(-1, 4, 3), surface)


def _puddle(s: float, t: float, length: float, half_width: float, rng: np.random.Generator) -> list[tuple]:
    """Rectangles (a0, a1, b0, b1) that make a puddle of ragged outline from s to s + length, its middle line at t."""
    edges = np.linspace(s, s + length, max(4, round(length / 0.2)) + 1)
    middles = (edges[:-1] + edges[1:]) / 2
    widths = half_width * np.sqrt(1 - (2 * (middles - s) / length - 1) ** 2)
    left, right = widths * rng.uniform(0.6, 1.0, (2, len(widths)))
    return list(zip(edges[:-1], edges[1:], t - right, t + left, strict=True))


def _markings(axis: Axis, s0: float, s1: float, zones: list[Zone], crossings: list[float], seed: int) -> list[Mesh]:
    """Lane markings, zebra crossings, rails, manhole covers, patches and puddles, a few millimetres above the ground."""
    white = Surface(GROUND, "marking", (226, 226, 220))
    rail, groove = Surface(GROUND, "rail", (120, 116, 110)), Surface(GROUND, "rubber", (40, 38, 36))

    def clear(a, b):
        return all(b < c - 13.5 or a > c + 13.5 for c in crossings)

    lines, rails, grooves, patches, puddles = [], [], [], [], []
    for a in np.arange(np.floor(s0 / 9) * 9, s1, 9.0):
        low, high = max(a, s0), min(a + 9.0, s1)
        if high <= low:
            continue
        if clear(low, high):
            lines += [(low, high, y - 0.06, y + 0.06) for y in (-0.14, 0.14)]
            lines += [(a, min(a + 3.0, s1), y - 0.06, y + 0.06) for y in (-LANE_LINE_M, LANE_LINE_M) if a >= s0]
            lines += [(low, high, y - 0.05, y + 0.05) for y in (-6.35, 6.35)]
            lines += [(a, a + 0.1, *sorted((y * PARKING_M[0], y * PARKING_M[1]))) for y in (-1, 1) if a >= s0]
        for y in (-OUTER_LANE_M, OUTER_LANE_M):
            for side in (-1, 1):
                centre = y + side * TRACK_GAUGE_M / 2
                rails.append((low, high, centre - 0.035, centre + 0.035))
                grooves.append((low, high, centre - side * 0.09 - 0.03, centre - side * 0.09 + 0.03))
    covers = []
    # Patches, puddles and covers are drawn per 20 m of street, the same in whatever part it is built.
    for cell in range(int(np.floor(s0 / 20)), int(np.ceil(s1 / 20))):
        rng = np.random.default_rng([seed, 7002, cell + 1000])
        for _ in range(3):
            a, t = 20 * cell + rng.uniform(0, 16), rng.uniform(-9, 7)
            patches.append((a, a + rng.uniform(0.8, 4), t, t + rng.uniform(0.6, 2.0)))
        for _ in range(2):  # in the gutter, and where wheels have worn the road
            puddles += _puddle(20 * cell + rng.uniform(0, 16), rng.choice([-1, 1]) * (KERB_M - 0.35), rng.uniform(1, 4), 0.33, rng)
            track = rng.choice([-1, 1]) * rng.choice([1.0, 2.5, OUTER_LANE_M, BICYCLE_LANE_M])
            puddles += _puddle(20 * cell + rng.uniform(0, 16), track, rng.uniform(1, 5), rng.uniform(0.25, 0.7), rng)
        for _ in range(3):
            covers.append(
                (20 * cell + rng.uniform(1, 19), rng.choice([-12.3, -7.0, -3.1, -1.75, 1.75, 3.1, 7.0, 12.3]), rng.uniform(0.28, 0.36))
            )
    for c in crossings:
        for side in (-1, 1):
            a = c + side * (CROSS_EDGE_M + 2.7)
            lines += [(a - 1.5, a + 1.5, t - 0.25, t + 0.25) for t in np.arange(-KERB_M + 0.9, KERB_M - 0.5, 1.0)]
            stop = c + side * (CROSS_EDGE_M + 5.2)
            # Right-hand traffic: who comes from smaller s drives at negative t.
            lines.append((stop - 0.2, stop + 0.2, *sorted((side * 0.3, side * 6.3))))
            lines += [(x - 0.25, x + 0.25, *sorted((side * 10.6, side * 13.2))) for x in np.arange(c - 3.0, c + 5.2, 1.0)]
            lines += [(c - 0.06, c + 0.06, *sorted((side * x, side * (x + 2.0)))) for x in np.arange(16.0, GROUND_M - 3, 5.0)]

    def inside(rows):
        return [(max(a0, s0), min(a1, s1), b0, b1) for a0, a1, b0, b1 in rows if min(a1, s1) - max(a0, s0) > 0.02]

    meshes = [
        _strips(axis, inside(patches), 0.002, Surface(GROUND, "asphalt", (58, 58, 60))),
        _strips(axis, inside(puddles), 0.003, Surface(GROUND, "wet_asphalt", (44, 46, 50))),
        _strips(axis, inside(lines), 0.004, white),
        _strips(axis, inside(grooves), 0.001, groove),
        _strips(axis, inside(rails), 0.006, rail),
    ]
    angle = np.linspace(0, 2 * np.pi, 13)
    for s, t, r in covers:
        if s0 < s - r and s + r < s1:
            lift = 0.005 + (KERB_HEIGHT_M if abs(t) > KERB_M else 0.0)
            ring = axis.to_map(s + r * np.cos(angle), t + r * np.sin(angle), lift)
            centre = np.broadcast_to(axis.to_map(s, t, lift), (6, 3))
            meshes.append(quads(np.stack([centre, ring[0:12:2], ring[1:13:2], ring[2:14:2]], 1), Surface(GROUND, "metal", (84, 82, 80))))
    return meshes
