"""Trees, bushes, hedges, grasses and ivy: trunks and limbs, and leaves as single triangles, so that pulses find their way between.

Every base shape takes two generators, as in `streetscan.simulation.shapes`: `g` draws the design, `rng` the instance.
"""

import numpy as np

from streetscan.classes import COLUMN, VEGETATION
from streetscan.simulation.appearance import draw_colour, vary_colours
from streetscan.simulation.meshes import Surface, join, triangle_soup, tube
from streetscan.simulation.scene import Mesh

Generator = np.random.Generator


def scatter_leaves(
    centres: np.ndarray, spread: float, n: int, size: float, colour: tuple, rng: Generator, material: str = "leaves", flat: float = 1.0
) -> Mesh:
    """n leaf triangles scattered about cluster centres (C, 3); `flat` below 1 squeezes each cluster in height."""
    where = centres[rng.integers(len(centres), size=n)] + rng.normal(0, spread, (n, 3)) * [1, 1, flat]
    where[:, 2] = np.maximum(where[:, 2], 0.02)
    normal = rng.normal(size=(n, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    u = np.cross(normal, rng.normal(size=(n, 3)))
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    v = np.cross(normal, u)
    scale = size * rng.uniform(0.6, 1.4, (n, 1))
    corners = np.stack([where + scale * u, where - scale * (0.5 * u + 0.6 * v), where - scale * (0.5 * u - 0.6 * v)], 1)
    mesh = triangle_soup(corners, Surface(VEGETATION, material, colour))
    mesh.colours = vary_colours(colour, n, 16, rng)
    return mesh


def points_in_ball(n: int, rng: Generator, shell: float = 0.5) -> np.ndarray:
    """(n, 3) points of the unit ball, the radius drawn between uniform in volume (shell 0) and on the surface (1)."""
    direction = rng.normal(size=(n, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    radius = rng.random((n, 1)) ** (1 / 3)
    return direction * (shell + (1 - shell) * radius)


def _trunk(g: Generator, rng: Generator, height: float, radius: float, lean: float = 0.04) -> tuple[Mesh, np.ndarray]:
    """A trunk from below the ground to `height`, and its upper end."""
    top = np.array([*rng.normal(0, lean * height, 2), height])
    z = np.array([-0.3, 0.0, 0.25, 0.5 * height, height])
    path = np.stack([top[0] * (np.maximum(z, 0) / height) ** 1.5, top[1] * (np.maximum(z, 0) / height) ** 1.3, z], 1)
    path[3, :2] += rng.normal(0, 0.03, 2)
    mesh = tube(path, radius * np.array([1.5, 1.4, 1.1, 1.0, 0.8]), Surface(COLUMN, "bark", draw_colour("bark", rng)), 9)
    return mesh, top


def _limbs(start: np.ndarray, ends: np.ndarray, radius: float, rng: Generator) -> Mesh:
    bark = Surface(VEGETATION, "bark", draw_colour("bark", rng))
    parts = []
    for end in ends:
        bend = start + 0.5 * (end - start) + [0, 0, 0.12 * np.linalg.norm(end - start)] + rng.normal(0, 0.1, 3)
        parts.append(tube(np.stack([start, bend, end]), min(radius, 0.2) * np.array([0.6, 0.35, 0.1]), bark, 5, caps=False))
    return join(parts)


def _tree(
    g,
    rng,
    trunk,
    radius,
    crown_radii,
    crown_shift=0.0,
    shell=0.55,
    n_clusters=70,
    spread=0.36,
    n_leaves=6500,
    leaf=0.085,
    flat=0.8,
    taper=0.0,
    droop=0.0,
) -> Mesh:
    """A tree: trunk (column), limbs and leaf clusters in an ellipsoid that may taper upwards and droop at its rim."""
    height, thick = g.uniform(*trunk), g.uniform(*radius)
    rx, rz = (g.uniform(*r) for r in crown_radii)
    stem, top = _trunk(g, rng, height, thick)
    unit = points_in_ball(n_clusters, rng, shell)
    width = 1 - taper * (unit[:, 2:] + 1) / 2
    centres = unit * [rx, rx * g.uniform(0.85, 1.1), rz] * np.concatenate([width, width, np.ones_like(width)], 1)
    centres[:, 2] -= droop * rz * (np.linalg.norm(unit[:, :2], axis=1) ** 2)
    centres += top + np.array([0, 0, rz * (0.82 + crown_shift)])
    limbs = _limbs(top - [0, 0, 0.1], centres[rng.choice(n_clusters, 14, replace=False)], thick, rng)
    leader = tube(
        np.stack([top - [0, 0, 0.1], top + np.array([0, 0, 1.3 * rz])]),
        [0.6 * thick, 0.03],
        Surface(VEGETATION, "bark", draw_colour("bark", rng)),
        6,
        caps=False,
    )
    return join([stem, limbs, leader, scatter_leaves(centres, spread, n_leaves, leaf, draw_colour("leaves", rng), rng, flat=flat)])


def lime(g, rng):
    return _tree(g, rng, (2.4, 3.2), (0.12, 0.22), ((1.8, 2.9), (2.2, 3.4)))


def plane_tree(g, rng):
    return _tree(g, rng, (3.0, 4.2), (0.22, 0.38), ((3.2, 4.4), (2.6, 3.6)), n_clusters=130, n_leaves=10000, leaf=0.11, spread=0.45)


def poplar(g, rng):
    return _tree(
        g, rng, (1.6, 2.4), (0.14, 0.24), ((0.9, 1.4), (4.0, 5.6)), n_clusters=80, spread=0.30, n_leaves=7000, taper=0.5, leaf=0.08
    )


def conifer(g, rng):
    """Whorls of drooping branches, wide below and pointed above."""
    height, rim = g.uniform(5.0, 9.0), g.uniform(1.3, 2.3)
    stem, _ = _trunk(g, rng, 1.1, g.uniform(0.10, 0.18), 0.01)
    bark = Surface(VEGETATION, "bark", draw_colour("bark", rng))
    level = rng.random(150) ** 1.4
    angle = rng.uniform(0, 2 * np.pi, 150)
    r = rim * (1 - level) * rng.uniform(0.45, 1.0, 150) + 0.08
    centres = np.stack([r * np.cos(angle), r * np.sin(angle), 0.7 + level * (height - 0.9) - 0.15 * r], 1)
    pole = tube(np.array([[0, 0, 1.0], [0, 0, height - 0.2]]), [0.12, 0.02], bark, 6)
    leaves = scatter_leaves(centres, 0.16, 6000, 0.07, (46, 78, 52), rng, flat=0.5)
    return join([stem, pole, leaves])


def round_tree(g, rng):
    """A small pollarded street tree: a ball on a thin stem, often tied to a stake."""
    mesh = _tree(
        g,
        rng,
        (1.9, 2.5),
        (0.05, 0.09),
        ((0.8, 1.2), (0.8, 1.1)),
        shell=0.3,
        n_clusters=30,
        spread=0.22,
        n_leaves=2800,
        leaf=0.065,
        flat=1.0,
    )
    stake = tube(np.array([[0.22, 0, -0.3], [0.22, 0, 1.7]]), 0.035, Surface(COLUMN, "wood", (140, 110, 78)), 6)
    return join([mesh, stake])


def weeping_tree(g, rng):
    return _tree(
        g,
        rng,
        (2.6, 3.6),
        (0.14, 0.24),
        ((2.4, 3.4), (1.6, 2.2)),
        shell=0.75,
        n_clusters=110,
        spread=0.26,
        n_leaves=8000,
        leaf=0.075,
        flat=1.8,
        droop=0.95,
    )


def low_branching_tree(g, rng):
    """Two or three stems from the ground, with branches down to the roofs of cars."""
    n = int(g.integers(2, 4))
    angle = 2 * np.pi * (np.arange(n) / n + rng.random())
    parts, tops = [], []
    for a in angle:
        stem, top = _trunk(g, rng, g.uniform(1.8, 2.5), g.uniform(0.07, 0.12), 0.02)
        lean = np.array([0.45 * np.cos(a), 0.45 * np.sin(a)])
        stem.vertices[:, :2] += np.clip(stem.vertices[:, 2:], 0, None) * lean + 0.12 * np.array([np.cos(a), np.sin(a)])
        parts.append(stem)
        tops.append(top + np.append(lean * top[2] + 0.12 * np.array([np.cos(a), np.sin(a)]), 0))
    rx, rz = g.uniform(1.7, 2.6), g.uniform(1.4, 2.1)
    centres = points_in_ball(60, rng, 0.5) * [rx, rx, rz] + np.mean(tops, 0) + [0, 0, rz * 0.75]
    for top in tops:
        parts.append(_limbs(top - [0, 0, 0.05], centres[rng.choice(60, 5, replace=False)], 0.09, rng))
    return join([*parts, scatter_leaves(centres, 0.35, 6000, 0.08, draw_colour("leaves", rng), rng)])


def bush(g, rng):
    rx, rz = g.uniform(0.4, 1.0), g.uniform(0.4, 0.9)
    centres = (
        np.abs(points_in_ball(26, rng, 0.4))
        * [1, 1, 1]
        * np.sign(rng.normal(size=(26, 3)) + np.array([0, 0, 9]))
        * [rx, rx * g.uniform(0.7, 1.2), rz * 1.5]
    )
    return scatter_leaves(centres + np.array([0, 0, 0.08]), 0.16, int(1400 * rx * (0.5 + rz)) + 400, 0.065, draw_colour("leaves", rng), rng)


def hedge(g, rng):
    """A clipped box hedge along x."""
    length, width, height = g.uniform(2.5, 4.5), g.uniform(0.45, 0.9), g.uniform(0.7, 1.5)
    n = int(900 * length * (0.4 + height) * (0.4 + width) / 1.2)
    where = rng.uniform(-0.5, 0.5, (n, 3))
    # Most leaves sit near one of the faces.
    axis = rng.integers(0, 3, n)
    outer = rng.random(n) < 0.75
    where[outer, axis[outer]] = np.sign(where[outer, axis[outer]]) * (0.5 - np.abs(rng.normal(0, 0.05, outer.sum())))
    centres = where * [length, width, height] + [0, 0, height / 2]
    return scatter_leaves(centres, 0.02, n, 0.06, draw_colour("leaves", rng), rng)


def shrub_grass(g, rng):
    """Tall ornamental grass: blades that bend outwards."""
    n, h = 700, g.uniform(0.6, 1.3)
    angle, tilt = rng.uniform(0, 2 * np.pi, n), np.abs(rng.normal(0, 0.38, n))
    base = rng.normal(0, 0.12, (n, 2))
    length = h * rng.uniform(0.6, 1.1, n)
    tip = np.column_stack([base + (length * np.sin(tilt))[:, None] * np.stack([np.cos(angle), np.sin(angle)], 1), length * np.cos(tilt)])
    side = 0.012 * np.stack([-np.sin(angle), np.cos(angle)], 1)
    corners = np.stack([np.column_stack([base - side, np.zeros(n)]), np.column_stack([base + side, np.zeros(n)]), tip], 1)
    mesh = triangle_soup(corners, Surface(VEGETATION, "grass", (120, 126, 70)))
    mesh.colours = vary_colours((126, 132, 74), n, 18, rng)
    return mesh


def ivy(g, rng):
    """Climbing leaves on a wall: a thin sheet along x, the wall on its -y side."""
    width, height = g.uniform(2.0, 4.5), g.uniform(2.5, 6.5)
    n = int(220 * width * height) + 300
    stems = rng.uniform(-width / 2, width / 2, 9)
    z = height * rng.random(n) ** 0.8
    x = stems[rng.integers(9, size=n)] + rng.normal(0, 0.35, n) * (0.4 + z / height)
    y = np.abs(rng.normal(0, 0.10, n)) + 0.02
    return scatter_leaves(np.stack([x, y, z], 1), 0.02, n, 0.065, draw_colour("leaves", rng), rng)
