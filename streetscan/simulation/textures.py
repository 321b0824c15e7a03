"""What surfaces look like from near: solid textures, evaluated where a ray hits, in the frame of the object that is hit.

A texture is a function of the point alone, so a point has one colour in every view. It takes the size of a pixel on the
surface: whatever is finer fades to its mean before it could flicker. Contrast is spread evenly over the octaves, as in
pictures of streets, so that a feature detector finds something at every distance.

ASSUME: patterns, sizes and contrasts are ours; the papers give none.
"""

from typing import NamedTuple

import cv2
import numba
import numpy as np

from streetscan.classes import CAR, COLUMN, FURNITURE
from streetscan.simulation.appearance import MATERIAL_IDS, MATERIALS

PLAIN, ASPHALT, SETTS, BRICK, PLASTER, ASHLAR, TILES, PRINT, POSTER, CLOTH, WOOD, METAL, MARKING, SLABS, PLATE = range(15)


class Look(NamedTuple):
    """How a material looks to a camera.

    Attributes:
        pattern: one of this module's patterns.
        contrast: standard deviation of the logarithm of brightness over all octaves of the grain.
        coarsest_m, finest_m: cells of the largest and the smallest octave.
        mirror: reflectance at normal incidence of a smooth clear surface (Fresnel), 0 for none: rays are then followed further.
        gloss: exponent of the highlight the sun makes (Blinn-Phong).
        translucency: share of the light from behind that passes.
    """

    pattern: int = PLAIN
    contrast: float = 0.15
    coarsest_m: float = 0.6
    finest_m: float = 0.01
    mirror: float = 0.0
    gloss: float = 4.0
    translucency: float = 0.0


LOOKS = {
    "asphalt": Look(ASPHALT, 0.36, 0.3, 0.005, gloss=12.0),
    "wet_asphalt": Look(ASPHALT, 0.20, 1.6, 0.008, mirror=0.02, gloss=400.0),
    "marking": Look(MARKING, 0.16, 0.8, 0.008, gloss=8.0),
    "concrete": Look(SLABS, 0.28, 0.4, 0.006),
    "paving": Look(SETTS, 0.26, 1.2, 0.008),
    "brick": Look(BRICK, 0.26, 1.2, 0.008),
    "plaster": Look(PLASTER, 0.24, 2.4, 0.010),
    "stone": Look(ASHLAR, 0.28, 1.2, 0.008),
    "roof_tile": Look(TILES, 0.28, 1.0, 0.01),
    "glass": Look(PLAIN, 0.05, 0.5, 0.02, mirror=0.09, gloss=2000.0),
    "car_glass": Look(PLAIN, 0.06, 0.5, 0.02, mirror=0.07, gloss=2000.0),
    "paint_white": Look(PLAIN, 0.06, 0.8, 0.02, mirror=0.04, gloss=600.0),
    "paint_silver": Look(PLAIN, 0.08, 0.8, 0.02, mirror=0.06, gloss=200.0),
    "paint_colour": Look(PLAIN, 0.08, 0.8, 0.02, mirror=0.04, gloss=600.0),
    "paint_dark": Look(PLAIN, 0.10, 0.8, 0.02, mirror=0.04, gloss=600.0),
    "paint_black": Look(PLAIN, 0.12, 0.8, 0.02, mirror=0.04, gloss=600.0),
    "metal": Look(METAL, 0.24, 0.5, 0.008, gloss=60.0),
    "painted_metal": Look(METAL, 0.20, 0.5, 0.008, gloss=40.0),
    "rail": Look(METAL, 0.15, 0.5, 0.008, gloss=80.0),
    "retroreflector": Look(PRINT, 0.06, 0.4, 0.01),
    "leaves": Look(PLAIN, 0.35, 0.3, 0.01, gloss=10.0, translucency=0.35),
    "bark": Look(WOOD, 0.45, 0.4, 0.008),
    "grass": Look(PLAIN, 0.45, 1.2, 0.006, translucency=0.2),
    "soil": Look(PLAIN, 0.45, 0.8, 0.006),
    "gravel": Look(SETTS, 0.40, 0.6, 0.006),
    "wood": Look(WOOD, 0.30, 0.5, 0.006),
    "plastic": Look(PRINT, 0.10, 0.5, 0.01, gloss=30.0),
    "rubber": Look(PLAIN, 0.20, 0.3, 0.008),
    "cloth": Look(CLOTH, 0.22, 0.4, 0.008),
    "cloth_dark": Look(CLOTH, 0.22, 0.4, 0.008),
    "skin": Look(PLAIN, 0.08, 0.1, 0.01),
    "hair": Look(PLAIN, 0.25, 0.1, 0.004),
    "interior": Look(PLAIN, 0.40, 1.0, 0.03),
    "water": Look(PLAIN, 0.15, 2.0, 0.05, mirror=0.02, gloss=200.0),
}
# Rows of the table the kernels read.
LOOK_TABLE = np.array([LOOKS[m.name] for m in MATERIALS], np.float64)
CONTRAST, COARSEST, FINEST, MIRROR, GLOSS, TRANSLUCENCY = range(1, 7)

_LETTERS = "ABCDEFGHIJKLMNOPRSTUVZ"
_LETTER_ROWS, _LETTER_COLUMNS = 40, 28


def _draw_letters() -> np.ndarray:
    """(letters, rows, columns) float32 coverage of each letter's cell, row 0 at the top."""
    cells = np.zeros((len(_LETTERS), _LETTER_ROWS, _LETTER_COLUMNS), np.uint8)
    for cell, letter in zip(cells, _LETTERS, strict=True):
        (width, height), _ = cv2.getTextSize(letter, cv2.FONT_HERSHEY_DUPLEX, 1.1, 3)
        cv2.putText(
            cell, letter, ((_LETTER_COLUMNS - width) // 2, (_LETTER_ROWS + height) // 2), cv2.FONT_HERSHEY_DUPLEX, 1.1, 255, 3, cv2.LINE_AA
        )
    return cells.astype(np.float32) / 255


LETTERS = _draw_letters()
LETTER_COVERAGE = float(LETTERS.mean())


def patterns_of(materials: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """(T,) uint8 pattern of each triangle: of its material, but for what the class says more of.

    What is plastered in the furniture class is an advertising pillar, full of posters; what reflects on a car is its number
    plate; the plastic of cars and columns is lamps and lenses, without print.
    """
    patterns = LOOK_TABLE[:, 0].astype(np.uint8)[materials]
    patterns[(materials == MATERIAL_IDS["plaster"]) & (labels == FURNITURE)] = POSTER
    patterns[(materials == MATERIAL_IDS["retroreflector"]) & (labels == CAR)] = PLATE
    patterns[(materials == MATERIAL_IDS["plastic"]) & ((labels == CAR) | (labels == COLUMN))] = PLAIN
    return patterns


@numba.njit(cache=True, inline="always")
def random_of(x, y, z, seed):
    """A number in [0, 1) that belongs to a cell of a lattice."""
    h = x * 0x9E3779B1 + y * 0x85EBCA77 + z * 0xC2B2AE3D + seed * 0x27D4EB2F
    h ^= (h >> 15) & 0x1FFFFFFFF
    h *= 0x2C1B3C6D
    h ^= (h >> 12) & 0xFFFFFFFF
    h *= 0x297A2D39
    h ^= (h >> 15) & 0x1FFFFFFFF
    return (h & 0xFFFFFF) / 16777216.0


@numba.njit(cache=True)
def value_noise(x, y, z, seed):
    """Smooth noise with cells of 1, mean 0, between -1 and 1."""
    fx, fy, fz = np.floor(x), np.floor(y), np.floor(z)
    i, j, k = np.int64(fx), np.int64(fy), np.int64(fz)
    u, v, w = x - fx, y - fy, z - fz
    u, v, w = u * u * (3 - 2 * u), v * v * (3 - 2 * v), w * w * (3 - 2 * w)
    low = 0.0
    high = 0.0
    a = random_of(i, j, k, seed)
    a += u * (random_of(i + 1, j, k, seed) - a)
    b = random_of(i, j + 1, k, seed)
    b += u * (random_of(i + 1, j + 1, k, seed) - b)
    low = a + v * (b - a)
    a = random_of(i, j, k + 1, seed)
    a += u * (random_of(i + 1, j, k + 1, seed) - a)
    b = random_of(i, j + 1, k + 1, seed)
    b += u * (random_of(i + 1, j + 1, k + 1, seed) - b)
    high = a + v * (b - a)
    return 2 * (low + w * (high - low)) - 1


@numba.njit(cache=True)
def visible(size_m, footprint_m):
    """How much of a detail of this size a pixel of this size shows: 0 below one pixel, all from 2.5 pixels on."""
    return min(max((size_m / footprint_m - 1.0) / 1.5, 0.0), 1.0)


@numba.njit(cache=True)
def octaves(x, y, z, coarsest_m, finest_m, footprint_m, seed):
    """Noise with equal contrast in every octave from coarsest to finest, unit standard deviation when all are seen."""
    total, n, cell = 0.0, 0, coarsest_m
    while cell >= finest_m:
        seen = visible(cell, footprint_m)
        if seen > 0:
            total += seen * value_noise(x / cell, y / cell, z / cell, seed + n)
        cell *= 0.5
        n += 1
        # Each octave's lattice is turned against the last one's, so that no axis shows.
        x, y, z = 0.8 * x - 0.6 * y, 0.48 * x + 0.64 * y - 0.6 * z, 0.36 * x + 0.48 * y + 0.8 * z
    # The standard deviation of one octave is 0.35.
    return total / (0.35 * np.sqrt(max(n, 1)))


@numba.njit(cache=True)
def _line(distance_m, width_m, period_m, footprint_m):
    """Share of a pixel that lies in a line of `width_m`, `distance_m` from its middle, one line every `period_m`."""
    seen = visible(0.5 * period_m, footprint_m)
    inside = min(max((0.5 * width_m - distance_m) / footprint_m + 0.5, 0.0), min(1.0, width_m / footprint_m))
    return seen * inside + (1 - seen) * width_m / period_m


@numba.njit(cache=True)
def _blocks(u, v, width_m, height_m, joint_m, footprint_m, seed):
    """Courses of blocks, every other one shifted by half: share of joint, and a number in [-1, 1] of the block."""
    row = np.floor(v / height_m)
    shifted = u / width_m + 0.5 * (row % 2)
    column = np.floor(shifted)
    from_edge_u = (0.5 - abs(shifted - column - 0.5)) * width_m
    from_edge_v = (0.5 - abs(v / height_m - row - 0.5)) * height_m
    along = _line(from_edge_v, joint_m, height_m, footprint_m)
    across = _line(from_edge_u, joint_m, width_m, footprint_m)
    tone = 2 * random_of(np.int64(column), np.int64(row), 17, seed) - 1
    return 1 - (1 - along) * (1 - across), tone * visible(height_m, footprint_m)


@numba.njit(cache=True)
def _cells(u, v, size_m, jitter, joint_m, footprint_m, seed):
    """Stones around jittered centres: share of joint, and a number in [-1, 1] of the stone."""
    i0, j0 = np.int64(np.floor(u / size_m)), np.int64(np.floor(v / size_m))
    first, second, tone = 1e9, 1e9, 0.0
    for di in range(-1, 2):
        for dj in range(-1, 2):
            i, j = i0 + di, j0 + dj
            cu = (i + 0.5 + jitter * (random_of(i, j, 1, seed) - 0.5)) * size_m - u
            cv = (j + 0.5 + jitter * (random_of(i, j, 2, seed) - 0.5)) * size_m - v
            d = np.sqrt(cu * cu + cv * cv)
            if d < first:
                first, second = d, first
                tone = 2 * random_of(i, j, 3, seed) - 1
            elif d < second:
                second = d
    return _line(0.5 * (second - first), joint_m, 0.5 * size_m, footprint_m), tone * visible(size_m, footprint_m)


@numba.njit(cache=True)
def _text(u, v, height_m, footprint_m, seed):
    """Share of ink of lines of words; each letter's cell is 0.7 times as wide as high, lines are 1.7 heights apart."""
    row = np.floor(v / (1.7 * height_m))
    in_row = v / height_m - 1.7 * row
    width = 0.7 * height_m
    column = np.int64(np.floor(u / width))
    # Words of one to eight letters and gaps between them.
    is_blank = random_of(column, np.int64(row), 5, seed) < 0.18
    seen = visible(height_m / 5, footprint_m)
    if is_blank or in_row >= 1.0:
        return (1 - seen) * LETTER_COVERAGE * 0.5
    letter = np.int64(random_of(column, np.int64(row), 6, seed) * LETTERS.shape[0])
    r = (1 - in_row) * LETTERS.shape[1] - 0.5
    c = (u / width - column) * LETTERS.shape[2] - 0.5
    r0, c0 = np.int64(np.floor(r)), np.int64(np.floor(c))
    ink = 0.0
    for dr in range(2):
        for dc in range(2):
            rr, cc = r0 + dr, c0 + dc
            if 0 <= rr < LETTERS.shape[1] and 0 <= cc < LETTERS.shape[2]:
                ink += LETTERS[letter, rr, cc] * (1 - abs(r - rr)) * (1 - abs(c - cc))
    return seen * ink + (1 - seen) * LETTER_COVERAGE * 0.5


@numba.njit(cache=True)
def _mix(a, b, share):
    return a[0] + share * (b[0] - a[0]), a[1] + share * (b[1] - a[1]), a[2] + share * (b[2] - a[2])


@numba.njit(cache=True)
def _scale(a, factor):
    return a[0] * factor, a[1] * factor, a[2] * factor


@numba.njit(cache=True)
def _ink_colour(i, j, k, seed):
    """A strong colour of a printer's palette."""
    pick = random_of(i, j, k, seed)
    if pick < 0.2:
        return 0.55, 0.03, 0.03
    if pick < 0.36:
        return 0.03, 0.10, 0.40
    if pick < 0.5:
        return 0.75, 0.55, 0.05
    if pick < 0.62:
        return 0.04, 0.28, 0.10
    if pick < 0.78:
        return 0.80, 0.80, 0.76
    if pick < 0.9:
        return 0.03, 0.03, 0.04
    return 0.45, 0.12, 0.40


@numba.njit(cache=True)
def _poster(u, v, width_m, height_m, footprint_m, seed):
    """One sheet after another: a coloured ground, two blocks, a disc and lines of text."""
    i, j = np.int64(np.floor(u / width_m)), np.int64(np.floor(v / height_m))
    a, b = u / width_m - i, v / height_m - j
    colour = _ink_colour(i, j, 21, seed)
    second, third = _ink_colour(i, j, 22, seed), _ink_colour(i, j, 23, seed)
    seen = visible(0.15 * height_m, footprint_m)
    edge = footprint_m / height_m
    top = 0.45 + 0.4 * random_of(i, j, 24, seed)
    colour = _mix(colour, second, seen * min(max((b - top) / edge + 0.5, 0.0), 1.0))
    ca, cb, radius = 0.3 + 0.4 * random_of(i, j, 25, seed), 0.35 + 0.3 * random_of(i, j, 26, seed), 0.12 + 0.2 * random_of(i, j, 27, seed)
    off = np.sqrt(((a - ca) * width_m / height_m) ** 2 + (b - cb) ** 2)
    colour = _mix(colour, third, seen * min(max((radius - off) / edge + 0.5, 0.0), 1.0))
    is_dark = colour[0] + colour[1] + colour[2] < 0.8
    ink = (0.85, 0.85, 0.82) if is_dark else (0.03, 0.03, 0.03)
    size = 0.12 * height_m if random_of(i, j, 28, seed) < 0.5 else 0.05 * height_m
    if 0.08 < a < 0.92 and (b < 0.33 or b > 0.8):
        colour = _mix(colour, ink, _text(u, v, size, footprint_m, seed + i))
    border = min(min(a, 1 - a) * width_m, min(b, 1 - b) * height_m)
    return _mix(colour, (0.7, 0.7, 0.68), _line(border, 0.03, 0.5 * width_m, footprint_m))


@numba.njit(cache=True)
def albedo_at(pattern, look, base, x, y, z, nx, ny, nz, footprint_m, seed):
    """Linear RGB albedo of a surface point.

    Args:
        pattern: of the triangle.
        look: row of LOOK_TABLE.
        base: linear RGB of the triangle.
        x, y, z, nx, ny, nz: point (metres) and unit normal in the object's own frame.
        footprint_m: size of a pixel on the surface.
        seed: of the object.
    """
    # Coordinates on the surface: along it and up on walls, the plan on what lies flat.
    level = np.sqrt(nx * nx + ny * ny)
    if level > 0.5:
        u, v = (-ny * x + nx * y) / level, z
    else:
        u, v = x, y
    contrast = look[CONTRAST]
    grain = octaves(x, y, z, look[COARSEST], look[FINEST], footprint_m, seed)
    colour = base
    if pattern == ASPHALT:
        # Patches of other age, cracks along the zero lines of a coarse noise, and spots of oil.
        patch = value_noise(x / 3.1, y / 3.1, z / 3.1, seed + 40)
        edge = footprint_m / 3.1 + 0.02
        colour = _scale(colour, 1 - 0.22 * min(max((patch - 0.25) / edge, 0.0), 1.0))
        ridge = abs(value_noise(x / 0.9, y / 0.9, 0.0, seed + 41) + 0.35 * value_noise(x / 0.23, y / 0.23, 0.0, seed + 42))
        where = min(max(3 * value_noise(x / 4.7, y / 4.7, 0.0, seed + 43), 0.0), 1.0)
        colour = _scale(colour, 1 - 0.6 * where * _line(0.5 * ridge, 0.014, 0.6, footprint_m))
        spot = value_noise(x / 0.35, y / 0.35, 0.0, seed + 44)
        colour = _scale(colour, 1 - 0.45 * min(max((spot - 0.55) * 6, 0.0), 1.0) * visible(0.3, footprint_m))
    elif pattern == MARKING:
        worn = value_noise(x / 0.11, y / 0.11, 0.0, seed + 45) * visible(0.11, footprint_m) + 0.7 * value_noise(
            x / 0.03, y / 0.03, 0.0, seed + 46
        ) * visible(0.03, footprint_m)
        colour = _mix(colour, (0.09, 0.09, 0.09), min(max((worn - 0.6) * 4, 0.0), 0.8))
    elif pattern == SLABS:
        joint, tone = _blocks(u, v, 1.0, 1.0, 0.015, footprint_m, seed)
        colour = _scale(colour, (1 + 0.10 * tone) * (1 - 0.5 * joint))
    elif pattern == SETTS:
        joint, tone = _cells(u, v, 0.17, 0.55, 0.022, footprint_m, seed)
        colour = _scale(colour, (1 + 0.28 * tone) * (1 - 0.65 * joint))
    elif pattern == BRICK:
        joint, tone = _blocks(u, v, 0.26, 0.077, 0.012, footprint_m, seed)
        colour = _scale(colour, 1 + 0.30 * tone)
        colour = _mix(colour, (0.42, 0.40, 0.36), 0.8 * joint)
    elif pattern == ASHLAR:
        joint, tone = _blocks(u, v, 0.72, 0.36, 0.012, footprint_m, seed)
        colour = _scale(colour, (1 + 0.14 * tone) * (1 - 0.5 * joint))
    elif pattern == TILES:
        joint, tone = _blocks(u, v, 0.21, 0.16, 0.02, footprint_m, seed)
        colour = _scale(colour, (1 + 0.25 * tone) * (1 - 0.55 * joint))
    elif pattern == PLASTER:
        colour = _plaster(colour, x, y, z, u, v, level, footprint_m, seed)
    elif pattern == POSTER:
        colour = _poster(np.arctan2(y - 0.7, x - 0.7) * 0.7, v, 0.73, 1.05, footprint_m, seed)
    elif pattern == PLATE:
        colour = _mix(colour, (0.03, 0.03, 0.03), _text(u, v, 0.065, footprint_m, seed))
    elif pattern == PRINT:
        is_dark = colour[0] + colour[1] + colour[2] < 1.0
        ink = (0.80, 0.80, 0.76) if is_dark else (0.04, 0.04, 0.06)
        height = 0.34 if random_of(seed, 1, 1, 7) < 0.6 else 0.17
        colour = _mix(colour, ink, _text(u, v, height, footprint_m, seed) if level > 0.5 else 0.0)
    elif pattern == CLOTH:
        kind = random_of(seed, 2, 2, 7)
        if kind < 0.45:
            stripe = (
                _line(abs(v % 0.09 - 0.045), 0.03, 0.09, footprint_m) if kind < 0.25 else _line(abs(u % 0.3 - 0.15), 0.15, 0.3, footprint_m)
            )
            colour = _mix(colour, _ink_colour(seed, 3, 3, 7), 0.6 * stripe)
    elif pattern == WOOD:
        fibre = octaves(x * 3, y * 3, z * 0.35, 0.12, 0.01, footprint_m, seed + 50)
        colour = _scale(colour, np.exp(0.2 * fibre))
    elif pattern == METAL:
        rust = value_noise(x / 0.16, y / 0.16, z / 0.16, seed + 51) + 0.5 * value_noise(x / 0.04, y / 0.04, z / 0.04, seed + 52)
        colour = _mix(colour, (0.16, 0.07, 0.035), 0.7 * min(max((rust - 0.62) * 5, 0.0), 1.0) * visible(0.08, footprint_m))
    factor = np.exp(contrast * max(min(grain, 3.0), -3.0) - 0.5 * contrast * contrast)
    colour = _scale(colour, factor)
    return min(colour[0], 0.95), min(colour[1], 0.95), min(colour[2], 0.95)


@numba.njit(cache=True)
def _plaster(colour, x, y, z, u, v, level, footprint_m, seed):
    """Stains, streaks below ledges, places where the coat has come off, and at eye level posters."""
    streak = value_noise(x / 0.22, y / 0.22, z / 2.6, seed + 60) * visible(0.22, footprint_m)
    streak += 0.6 * value_noise(x / 0.07, y / 0.07, z / 1.1, seed + 61) * visible(0.07, footprint_m)
    colour = _scale(colour, 1 - 0.30 * max(streak - 0.15, 0.0))
    # An object's frame begins at its lowest point: 3 m below the ground for a house.
    colour = _scale(colour, 1 - 0.35 * np.exp(-max(z - 3.2, 0.0) / 0.5))
    peel = value_noise(x / 0.8, y / 0.8, z / 0.8, seed + 62) + 0.45 * value_noise(x / 0.17, y / 0.17, z / 0.17, seed + 63)
    peel += 0.25 * value_noise(x / 0.05, y / 0.05, z / 0.05, seed + 64)
    bare = min(max((peel - 0.78) * min(12.0, 0.6 / footprint_m), 0.0), 1.0) * visible(0.12, footprint_m)
    joint, tone = _blocks(u, v, 0.26, 0.077, 0.012, footprint_m, seed)
    brick = _mix(_scale((0.24, 0.10, 0.065), 1 + 0.3 * tone), (0.4, 0.38, 0.34), 0.7 * joint)
    colour = _mix(colour, brick, 0.9 * bare)
    ridge = abs(value_noise(x / 1.3, y / 1.3, z / 1.3, seed + 65) + 0.3 * value_noise(x / 0.2, y / 0.2, z / 0.2, seed + 66))
    where = min(max(3 * value_noise(x / 3.7, y / 3.7, z / 3.7, seed + 67), 0.0), 1.0)
    colour = _scale(colour, 1 - 0.5 * where * _line(0.6 * ridge, 0.008, 0.8, footprint_m))
    if level > 0.5 and 4.1 < v < 5.15 and random_of(np.int64(np.floor(u / 0.73)), 0, 68, seed) < 0.22:
        colour = _poster(u, v - 4.1, 0.73, 1.05, footprint_m, seed + 69)
    return colour


@numba.njit(cache=True, parallel=True)
def look_at(
    origins,
    directions,
    distances_m,
    faces,
    actors,
    behind_m,
    spread_rad,
    face_normals,
    poses,
    seeds,
    patterns,
    materials,
    colours,
    contrasts,
    looks,
):
    """Points (n, 3) float64, normals towards the viewer and albedos (n, 3) float32 of hits; NaN, 0 and 0 where nothing is hit.

    All that evaluates patterns stands in this module: numba's cache of a kernel does not see an edit of another file.

    Args:
        origins, directions, distances_m, faces, actors: of rays and their hits; origins as the points from the caster's origin.
        behind_m: (n,) way of the light behind the ray's origin.
        spread_rad: angle between neighbouring pixels.
        face_normals, seeds, patterns, materials, colours (linear), contrasts: of triangles.
        poses: (n, 4) of the objects hit, as `SceneCaster.own_poses`.
        looks: LOOK_TABLE.
    """
    n = len(faces)
    points, normals, albedo = np.full((n, 3), np.nan), np.zeros((n, 3), np.float32), np.zeros((n, 3), np.float32)
    for r in numba.prange(n):
        face = faces[r]
        if face < 0:
            continue
        x, y, z, yaw = poses[r, 0], poses[r, 1], poses[r, 2], poses[r, 3]
        cos, sin = np.cos(yaw), np.sin(yaw)
        px = origins[r, 0] + distances_m[r] * directions[r, 0]
        py = origins[r, 1] + distances_m[r] * directions[r, 1]
        pz = origins[r, 2] + distances_m[r] * directions[r, 2]
        # Normals of moving actors are in the actor's frame, all others in the map's.
        nx, ny, nz = face_normals[face, 0], face_normals[face, 1], face_normals[face, 2]
        if actors[r] >= 0:
            mx, my, ox, oy = cos * nx - sin * ny, sin * nx + cos * ny, nx, ny
        else:
            mx, my, ox, oy = nx, ny, cos * nx + sin * ny, -sin * nx + cos * ny
        towards = mx * directions[r, 0] + my * directions[r, 1] + nz * directions[r, 2]
        side = -1.0 if towards > 0 else 1.0
        footprint = (distances_m[r] + behind_m[r]) * spread_rad / max(abs(towards), 0.05) ** 0.7
        dx, dy = px - x, py - y
        material = materials[face]
        base = (np.float64(colours[face, 0]), np.float64(colours[face, 1]), np.float64(colours[face, 2]))
        c = albedo_at(
            patterns[face],
            looks[material],
            base,
            cos * dx + sin * dy,
            -sin * dx + cos * dy,
            pz - z,
            np.float64(ox),
            np.float64(oy),
            np.float64(nz),
            max(footprint, 1e-4),
            seeds[face],
        )
        points[r, 0], points[r, 1], points[r, 2] = px, py, pz
        normals[r, 0], normals[r, 1], normals[r, 2] = side * mx, side * my, side * nz
        for k in range(3):
            albedo[r, k] = base[k] + contrasts[face] * (c[k] - base[k])
    return points, normals, albedo


@numba.njit(cache=True)
def _sky_radiance(dx, dy, dz, sky, spread_rad):
    """Linear RGB of the sky: brighter to the horizon and around the sun, with clouds."""
    towards = dx * sky[0] + dy * sky[1] + dz * sky[2]
    up = max(dz, 0.0)
    horizon = np.exp(-5.0 * up)
    glow = 0.4 * max(towards, 0.0) ** 10 + 5.0 * max(towards, 0.0) ** 200
    r = sky[6] * (0.75 + 2.6 * horizon) + glow * sky[3]
    g = sky[7] * (1.10 + 1.8 * horizon) + glow * sky[4]
    b = sky[8] * (1.50 + 0.7 * horizon) + glow * sky[5]
    if sky[9] > 0 and up > 0.03:
        u, v = dx / (up + 0.12), dy / (up + 0.12)
        field = octaves(0.6 * u, v, 0.0, 1.6, 0.05, spread_rad / (up + 0.12) + 0.02, np.int64(sky[10]) + 900)
        cover = min(max((field + 3 * (sky[9] - 0.5)) * 0.4, 0.0), 0.9) * min((up - 0.03) / 0.1, 1.0)
        white = 0.65 + 0.15 * max(min(field, 2.0), -1.0)
        r += cover * (white * (0.75 * sky[3] + 0.9 * sky[6]) - 0.8 * r)
        g += cover * (white * (0.75 * sky[4] + 0.9 * sky[7]) - 0.8 * g)
        b += cover * (white * (0.75 * sky[5] + 0.9 * sky[8]) - 0.8 * b)
    # The sun's disc, 0.53 degrees wide.
    if towards > 0.99998:
        r, g, b = r + 3000 * sky[3], g + 3000 * sky[4], b + 3000 * sky[5]
    return r, g, b


@numba.njit(cache=True, parallel=True)
def look_up(directions, faces, sky, spread_rad, largest):
    """(n, 3) float32 radiance of the sky along rays that hit nothing, cut at `largest`; 0 along the others."""
    radiance = np.zeros((len(faces), 3), np.float32)
    for r in numba.prange(len(faces)):
        if faces[r] < 0:
            a, b, c = _sky_radiance(
                np.float64(directions[r, 0]), np.float64(directions[r, 1]), np.float64(directions[r, 2]), sky, spread_rad
            )
            radiance[r, 0], radiance[r, 1], radiance[r, 2] = min(a, largest), min(b, largest), min(c, largest)
    return radiance
