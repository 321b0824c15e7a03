"""Columns: lamp posts, signs, traffic lights, catenary and other poles.

Every base shape takes two generators, as in `streetscan.simulation.shapes`: `g` draws the design, `rng` the instance.
"""

import numpy as np

from streetscan.classes import COLUMN
from streetscan.simulation.appearance import draw_colour
from streetscan.simulation.meshes import Surface, box, ellipsoid, join, loft, revolve, transform, tube
from streetscan.simulation.scene import Mesh

Generator = np.random.Generator


def _pole(height: float, radius: float, surface: Surface, taper: float = 0.7, at: tuple = (0, 0)) -> Mesh:
    profile = [(radius * 1.6, -0.3), (radius * 1.6, 0.25), (radius, 0.3), (radius * taper, height)]
    return revolve(np.array(profile), surface, 10, (*at, 0))


def _pole_surface(rng: Generator, material: str = "painted_metal") -> Surface:
    return Surface(COLUMN, material, draw_colour("pole", rng))


def lamp_arm(g, rng):
    """A street lamp with one curved arm over the road (towards +y)."""
    h, reach, s = g.uniform(6.5, 9.5), g.uniform(1.2, 2.4), _pole_surface(rng)
    u = np.linspace(0, np.pi / 2, 6)
    arm = np.stack([0 * u, reach * (1 - np.cos(u)), h - 0.05 + 0.7 * np.sin(u)], 1)
    head = box((-0.14, reach - 0.1, h + 0.55), (0.14, reach + 0.6, h + 0.70), Surface(COLUMN, "plastic", (180, 180, 176)))
    return join([_pole(h, g.uniform(0.07, 0.11), s), tube(arm, 0.04, s, 7), head])


def lamp_double(g, rng):
    """Two straight arms, along y."""
    h, reach, s = g.uniform(7.0, 10.0), g.uniform(1.0, 1.9), _pole_surface(rng)
    parts = [
        _pole(h, g.uniform(0.08, 0.12), s),
        tube(np.array([[0, -reach, h + 0.25], [0, 0, h - 0.1], [0, reach, h + 0.25]]), 0.04, s, 6),
    ]
    parts += [
        box((-0.13, y - 0.35, h + 0.2), (0.13, y + 0.35, h + 0.33), Surface(COLUMN, "plastic", (170, 170, 168))) for y in (-reach, reach)
    ]
    return join(parts)


def lamp_classic(g, rng):
    """A cast-iron lamp: fluted foot, rings, lantern on top."""
    h, s = g.uniform(3.4, 5.0), Surface(COLUMN, "painted_metal", draw_colour("pole", rng))
    r = g.uniform(0.05, 0.08)
    profile = [
        (0.22, -0.3),
        (0.22, 0.15),
        (0.16, 0.2),
        (0.15, 0.8),
        (0.11, 0.9),
        (r, 1.0),
        (r, 0.55 * h),
        (r * 1.7, 0.56 * h),
        (r, 0.58 * h),
        (r * 0.8, h - 0.1),
        (r * 2, h),
    ]
    lantern = [(0.10, h), (0.20, h + 0.45), (0.27, h + 0.47), (0.10, h + 0.65), (0.02, h + 0.78)]
    bar = tube(np.array([[-0.35, 0, h - 0.45], [0.35, 0, h - 0.45]]), 0.02, s, 5)
    return join([revolve(np.array(profile), s, 10), revolve(np.array(lantern), Surface(COLUMN, "plastic", (210, 206, 180)), 6), bar])


def lamp_globe(g, rng):
    """A park lamp: a globe, or a cluster of globes, on a plain post."""
    h, s = g.uniform(2.8, 4.2), _pole_surface(rng)
    r = g.uniform(0.18, 0.28)
    parts = [_pole(h, g.uniform(0.05, 0.08), s), ellipsoid((r, r, r), (0, 0, h + r), Surface(COLUMN, "plastic", (226, 224, 210)), 12, 7)]
    if g.random() < 0.4:
        for y in (-0.5, 0.5):
            parts.append(tube(np.array([[0, 0, h - 0.7], [0, y, h - 0.6]]), 0.03, s, 5))
            parts.append(ellipsoid((r * 0.8,) * 3, (0, y, h - 0.5 + r * 0.8), Surface(COLUMN, "plastic", (226, 224, 210)), 10, 6))
    return join(parts)


def _plate(kind: str, size: float, z: float, colour: tuple, y: float = 0.0) -> Mesh:
    """A sign facing -x, on the pole's -x side."""
    n = {"round": 16, "triangle": 3, "octagon": 8, "square": 4, "yield": 3}[kind]
    start = {"triangle": np.pi / 2, "yield": -np.pi / 2, "square": np.pi / 4, "octagon": np.pi / 8}.get(kind, 0.0)
    angle = start + np.linspace(0, 2 * np.pi, n, endpoint=False)
    ring = np.stack([0 * angle, y + size * np.cos(angle), z + size * np.sin(angle)], 1)
    return join(
        [loft(np.stack([ring - np.array([0.06, 0, 0]), ring - np.array([0.045, 0, 0])]), Surface(COLUMN, "retroreflector", colour))]
    )


def sign_single(g, rng):
    h = g.uniform(2.3, 3.0)
    kind = ("round", "triangle", "octagon", "square", "yield")[int(g.integers(5))]
    colour = ((200, 30, 34), (230, 200, 40), (200, 30, 34), (36, 84, 170), (210, 40, 40))[int(rng.integers(5))]
    size = g.uniform(0.30, 0.42)
    return join([_pole(h, g.uniform(0.025, 0.04), _pole_surface(rng, "metal"), 1.0), _plate(kind, size, h - size * 0.8, colour)])


def sign_stack(g, rng):
    """Two or three plates over each other, one of them a rectangle of text."""
    h = g.uniform(2.9, 3.8)
    parts = [_pole(h, g.uniform(0.03, 0.045), _pole_surface(rng, "metal"), 1.0)]
    parts.append(_plate("round", 0.33, h - 0.3, (200, 30, 34)))
    parts.append(_plate("square" if g.random() < 0.5 else "triangle", 0.40, h - 1.0, (36, 84, 170)))
    parts.append(box((-0.06, -0.3, h - 1.7), (-0.045, 0.3, h - 1.45), Surface(COLUMN, "retroreflector", (230, 230, 226))))
    return join(parts)


def sign_direction(g, rng):
    """A large direction board on two posts, above heads."""
    h, width = g.uniform(3.2, 4.2), g.uniform(1.4, 2.4)
    s = _pole_surface(rng, "metal")
    parts = [_pole(h, 0.045, s, 1.0, (0, y)) for y in (-0.35 * width, 0.35 * width)]
    parts.append(
        box((-0.09, -width / 2, h - g.uniform(0.9, 1.4)), (-0.05, width / 2, h + 0.05), Surface(COLUMN, "retroreflector", (30, 96, 60)))
    )
    return join(parts)


def traffic_light(g, rng):
    """A post with one or two signal heads (facing -x)."""
    h, s = g.uniform(3.2, 3.8), _pole_surface(rng)
    parts = [_pole(h, g.uniform(0.055, 0.08), s, 0.9), _signal_head((-0.16, 0, h - 1.0))]
    if g.random() < 0.6:
        parts.append(transform(_signal_head((-0.16, 0, h - 1.35), 0.22), np.pi / 2))
    parts.append(box((-0.07, 0.06, 0.95), (0.07, 0.16, 1.2), Surface(COLUMN, "plastic", (220, 190, 40))))
    return join(parts)


def _signal_head(at: tuple, r: float = 0.15) -> Mesh:
    black = Surface(COLUMN, "plastic", (24, 24, 24))
    x, y, z = at
    parts = [box((x - 0.1, y - r, z), (x + 0.1, y + r, z + 0.9), black)]
    for i, colour in enumerate(((30, 160, 70), (220, 160, 30), (200, 40, 36))):
        lens = np.array([[x - 0.11, y, z + 0.15 + 0.3 * i], [x - 0.2, y, z + 0.15 + 0.3 * i]])
        parts.append(tube(lens, 0.1, Surface(COLUMN, "plastic", colour), 8))
    return join(parts)


def traffic_light_mast(g, rng):
    """A signal mast with an arm over the lanes (towards +y)."""
    h, reach, s = g.uniform(5.4, 6.2), g.uniform(3.2, 5.5), _pole_surface(rng)
    arm = tube(np.array([[0, 0, h - 0.4], [0, reach * 0.5, h], [0, reach, h + 0.1]]), [0.09, 0.07, 0.05], s, 8)
    return join([_pole(h, g.uniform(0.10, 0.14), s), arm, _signal_head((-0.1, reach - 0.2, h - 0.6)), _signal_head((-0.18, 0, 2.4))])


def catenary_pole(g, rng):
    """A tram pole with a bracket over the track (towards +y)."""
    h, reach, s = g.uniform(7.0, 8.5), g.uniform(2.5, 4.5), _pole_surface(rng)
    parts = [_pole(h, g.uniform(0.10, 0.15), s, 0.75), tube(np.array([[0, 0, 6.2], [0, reach, 6.0]]), 0.035, s, 6)]
    parts.append(tube(np.array([[0, 0, h - 0.2], [0, 0.7 * reach, 6.1]]), 0.015, s, 4))
    parts += [revolve(np.array([[r, z], [r, z + 0.06]]), s, 12) for r, z in ((0.19, 1.1), (0.19, 1.6))]
    return join(parts)


def utility_pole(g, rng):
    """A wooden pole with a crossarm and insulators."""
    h, wood = g.uniform(6.5, 9.0), Surface(COLUMN, "wood", draw_colour("bark", rng))
    parts = [_pole(h, g.uniform(0.10, 0.14), wood, 0.7), box((-0.06, -0.9, h - 0.7), (0.06, 0.9, h - 0.55), wood)]
    parts += [
        revolve(np.array([[0.05, h - 0.55], [0.06, h - 0.42], [0.03, h - 0.36]]), Surface(COLUMN, "plastic", (150, 90, 60)), 7, (0, y, 0))
        for y in (-0.8, -0.4, 0.4, 0.8)
    ]
    return join(parts)


def flag_pole(g, rng):
    h, s = g.uniform(5.5, 8.0), Surface(COLUMN, "metal", (200, 202, 204))
    x = np.linspace(0, g.uniform(0.9, 1.5), 6)
    wave = 0.10 * np.sin(5 * x + rng.uniform(0, 6))
    low, high = np.stack([x, wave, 0 * x + h - 1.6], 1), np.stack([x, wave, 0 * x + h - 0.15], 1)
    cloth = loft(np.stack([low, high]), Surface(COLUMN, "cloth", draw_colour("shop", rng)), closed=False, caps=False)
    return join([_pole(h, g.uniform(0.035, 0.05), s, 0.7), cloth, ellipsoid((0.07, 0.07, 0.07), (0, 0, h), s, 8, 5)])


def camera_pole(g, rng):
    h, s = g.uniform(4.0, 5.5), _pole_surface(rng)
    return join(
        [
            _pole(h, g.uniform(0.06, 0.09), s, 0.9),
            tube(np.array([[0, -0.6, h - 0.2], [0, 0.6, h - 0.2]]), 0.035, s, 6),
            *(box((-0.2, y - 0.08, h - 0.15), (0.2, y + 0.08, h + 0.02), Surface(COLUMN, "plastic", (225, 225, 222))) for y in (-0.5, 0.5)),
            box((-0.25, -0.05, 1.2), (-0.05, 0.25, 1.8), Surface(COLUMN, "painted_metal", (150, 152, 150))),
        ]
    )
