"""Houses: facades with recessed windows, doors, balconies, cornices and shops, roofs, and rooms seen through the glass.

Frame of a house: x along the front from its left corner as seen from the street, y into the house, z up from the
ground at the front's middle; the wall reaches 3 m below the ground so that no slope lays its foot bare. Metres.

Everything that belongs to a house is facade: balconies, awnings, hanging signs, drainpipes, rooms and scaffolding
(ASSUME: the thesis has no finer class, and an annotator marks them with the house).
"""

import numpy as np

from streetscan.classes import FACADE
from streetscan.simulation.appearance import draw_colour
from streetscan.simulation.meshes import Relief, Surface, box, join, quads, revolve, transform, tube
from streetscan.simulation.scene import Mesh

FOUNDATION_M = 3.0


def _surface(material: str, colour: tuple) -> Surface:
    return Surface(FACADE, material, colour)


class _Style:
    """What all floors of one house share."""

    def __init__(self, rng: np.random.Generator):
        self.floors = int(rng.integers(2, 6))
        self.ground_floor = float(rng.uniform(3.5, 4.6))
        self.floor = float(rng.uniform(2.9, 3.9))
        self.bay = float(rng.uniform(2.2, 3.6))
        self.window = (float(rng.uniform(0.9, 1.5)), float(rng.uniform(1.4, 2.1)))
        self.recess = float(rng.uniform(0.12, 0.30))
        self.sill = float(rng.uniform(0.8, 1.0))
        family = ("plaster", "plaster", "plaster", "brick", "stone")[int(rng.integers(5))]
        self.wall = _surface(family, draw_colour(family, rng))
        self.trim = _surface("plaster", draw_colour("stone", rng))
        self.frame = _surface("wood", draw_colour("door", rng) if rng.random() < 0.4 else (226, 224, 218))
        self.glass = _surface("glass", (52, 64, 72))
        self.plinth = _surface("stone", draw_colour("stone", rng))
        self.roof = _surface("roof_tile", draw_colour("roof", rng))
        self.hood = rng.random() < 0.5
        self.string_course = rng.random() < 0.6
        self.pilasters = rng.random() < 0.25
        self.rustic = rng.random() < 0.35
        self.is_modern = rng.random() < 0.2
        self.balcony_share = float(rng.choice([0.0, 0.15, 0.4]))
        self.has_shop = rng.random() < 0.6
        self.oriel = rng.random() < 0.25
        self.top = self.ground_floor + (self.floors - 1) * self.floor + 0.5


def _window(relief: Relief, style: _Style, x: float, z: float, width: float, height: float, panes: int = 2, base: float = 0.0) -> None:
    """A window with its lower edge at z, centred on x, in a wall of depth `base`."""
    a, b, deep = x - width / 2, x + width / 2, base - style.recess
    if style.hood:
        relief.paint(a - 0.14, b + 0.14, z - 0.05, z + height + 0.14, base + 0.04, style.trim)
        relief.paint(a - 0.2, b + 0.2, z + height + 0.14, z + height + 0.26, base + 0.16, style.trim)
    relief.paint(a - 0.1, b + 0.1, z - 0.10, z - 0.02, base + 0.11, style.trim)
    relief.paint(a, b, z, z + height, deep + 0.05, style.frame)
    for i in range(panes):
        c, d = a + 0.06 + i * (width - 0.06) / panes, a + (i + 1) * (width - 0.06) / panes
        relief.paint(c, d, z + 0.06, z + 0.68 * height, deep, style.glass)
        relief.paint(c, d, z + 0.68 * height + 0.06, z + height - 0.06, deep, style.glass)


def _front(style: _Style, width: float, rng: np.random.Generator, has_shop: bool, has_balconies: bool) -> tuple[Mesh, list[tuple]]:
    """One wall with its openings, x from 0 to `width`, and the (x, z, width, height) of its windows."""
    relief = Relief((0, width), (-FOUNDATION_M, style.top), 0.0, style.wall)
    windows, extras = [], []
    plinth = rng.uniform(0.4, 0.9)
    n = max(1, int((width - 0.6) / style.bay))
    xs = (np.arange(n) + 0.5) * width / n
    pitch = width / n
    if style.rustic:
        relief.paint(0, width, plinth, style.ground_floor - 0.2, 0.06, style.trim)
        for z in np.arange(plinth + 0.4, style.ground_floor - 0.25, 0.42):
            relief.paint(0, width, z, z + 0.05, 0.0, style.trim)
    relief.paint(0, width, -FOUNDATION_M, plinth, 0.09, style.plinth)
    if style.pilasters:
        for x in (0.3, width - 0.3, *(xs[:-1:2] + pitch / 2)):
            relief.paint(x - 0.22, x + 0.22, style.ground_floor, style.top - 0.4, 0.10, style.trim)
    oriel = int(rng.integers(n)) if style.oriel and n > 2 and style.floors > 2 else -1
    if oriel >= 0:
        relief.paint(xs[oriel] - 0.47 * pitch, xs[oriel] + 0.47 * pitch, style.ground_floor + 0.2, style.top - 0.9, 0.75, style.wall)
    if style.string_course:
        for k in range(style.floors - 1):
            z = style.ground_floor + k * style.floor
            relief.paint(0, width, z - 0.16, z, 0.16, style.trim)
    # Upper floors.
    for k in range(1, style.floors):
        z = style.ground_floor + (k - 1) * style.floor + style.sill
        for i, x in enumerate(xs):
            height = min(style.window[1], style.floor - style.sill - 0.5)
            w = min(style.window[0], pitch - 0.7)
            base = 0.75 if i == oriel else 0.0
            if has_balconies and i != oriel and rng.random() < style.balcony_share:
                _window(relief, style, x, z - style.sill + 0.1, w, height + style.sill - 0.1, base=base)
                extras.append(_balcony(x, z - style.sill, min(pitch - 0.3, w + 0.9), rng))
            else:
                _window(relief, style, x, z, w, height, int(rng.integers(1, 4)) if style.is_modern else 2, base)
            windows.append((x, z, w, height, base))
    # Ground floor: a door or gateway, shops or windows.
    door = int(rng.integers(n))
    for i, x in enumerate(xs):
        if i == door:
            w, h = (min(2.6, pitch - 0.4), min(3.0, style.ground_floor - 0.5)) if rng.random() < 0.35 else (1.15, 2.35)
            relief.paint(x - w / 2 - 0.15, x + w / 2 + 0.15, 0.0, h + 0.15, 0.08, style.trim)
            relief.paint(x - w / 2, x + w / 2, -0.6, h, -0.35, _surface("wood", draw_colour("door", rng)))
            for dx in (-w / 4, w / 4):
                for z in (0.25, 1.2):
                    relief.paint(x + dx - 0.17 * w, x + dx + 0.17 * w, z, z + 0.75, -0.40, _surface("wood", draw_colour("door", rng)))
            extras.append(box((x - w / 2 - 0.1, -0.40, -0.6), (x + w / 2 + 0.1, 0.0, 0.10), style.plinth))
        elif has_shop:
            w, h = pitch - 0.45, style.ground_floor - 1.2
            relief.paint(x - w / 2 - 0.06, x + w / 2 + 0.06, 0.25, h + 0.12, 0.02, _surface("painted_metal", (58, 58, 60)))
            relief.paint(x - w / 2, x + w / 2, 0.4, h, -0.15, _surface("glass", (56, 70, 76)))
            relief.paint(x - 0.03, x + 0.03, 0.4, h, -0.08, _surface("painted_metal", (58, 58, 60)))
            windows.append((x, 0.4, w, h - 0.4, 0.0))
        else:
            w = min(style.window[0], pitch - 0.7)
            _window(relief, style, x, 1.2, w, min(style.window[1], style.ground_floor - 1.9))
            windows.append((x, 1.2, w, 1.5, 0.0))
    if has_shop:
        colour = draw_colour("shop", rng)
        relief.paint(0.1, width - 0.1, style.ground_floor - 1.0, style.ground_floor - 0.3, 0.12, _surface("plastic", colour))
        if rng.random() < 0.5:
            reach, z = rng.uniform(0.8, 1.5), style.ground_floor - 1.0
            a, b = sorted(rng.uniform(0.1, width - 0.1, 2))
            if b - a > 1.5:
                slanted = np.array([[[a, -reach, z - 0.55], [b, -reach, z - 0.55], [b, -0.05, z], [a, -0.05, z]]])
                valance = np.array([[[a, -reach, z - 0.75], [b, -reach, z - 0.75], [b, -reach, z - 0.55], [a, -reach, z - 0.55]]])
                extras.append(quads(np.concatenate([slanted, valance]), _surface("cloth", colour)))
        if rng.random() < 0.7:
            x, z = rng.uniform(0.5, width - 0.5), rng.uniform(2.5, 3.4)
            extras.append(
                box(
                    (x - 0.05, -rng.uniform(0.6, 1.1), z),
                    (x + 0.05, -0.12, z + rng.uniform(0.4, 0.9)),
                    _surface("plastic", draw_colour("shop", rng)),
                )
            )
    # Crowning cornice in three steps.
    for i, out in enumerate((0.12, 0.26, 0.42)):
        relief.paint(0, width, style.top - 0.42 + 0.14 * i, style.top - 0.28 + 0.14 * i, out * (0.3 if style.is_modern else 1), style.trim)
    for x in (0.12, width - 0.12):
        if rng.random() < 0.6:
            pipe = np.array([[x, -0.16, 0.1], [x, -0.16, style.top - 0.45], [x, -0.40, style.top - 0.1]])
            extras.append(tube(pipe, 0.05, _surface("metal", (112, 108, 100)), 6))
    for _ in range(int(rng.integers(0, 4))):
        x, z = rng.uniform(0.5, width - 0.5), rng.uniform(2.4, style.top - 1.0)
        extras.append(
            box((x - 0.4, -0.32, z), (x + 0.4, -0.05, z + 0.55), _surface("painted_metal", (212, 212, 208)))
            if rng.random() < 0.5
            else _wall_lamp(x, rng.uniform(2.6, 3.6))
        )
    mesh = relief.build(lambda a, b, d: np.stack([a, -d, b], -1))
    return join([mesh, *extras]), windows


def _wall_lamp(x: float, z: float) -> Mesh:
    iron = _surface("painted_metal", (44, 46, 48))
    return join(
        [
            tube(np.array([[x, 0, z], [x, -0.45, z + 0.15]]), 0.02, iron, 5),
            revolve(np.array([[0.05, z - 0.25], [0.13, z + 0.05], [0.05, z + 0.15]]), iron, 8, (x, -0.48, 0)),
        ]
    )


def _balcony(x: float, z: float, width: float, rng: np.random.Generator) -> Mesh:
    depth = rng.uniform(0.7, 1.3)
    iron = _surface("painted_metal", draw_colour("pole", rng))
    a, b = x - width / 2, x + width / 2
    parts = [box((a, -depth, z - 0.16), (b, 0.05, z), _surface("stone", draw_colour("stone", rng)))]
    if rng.random() < 0.3:
        wall = _surface("plaster", draw_colour("stone", rng))
        parts += [box((a, -depth, z), (b, -depth + 0.08, z + 0.95), wall)]
        parts += [box((x0, -depth, z), (x0 + 0.08, 0, z + 0.95), wall) for x0 in (a, b - 0.08)]
    else:
        for y in np.linspace(a + 0.03, b - 0.03, max(3, int(width / 0.14))):
            parts.append(box((y - 0.008, -depth, z), (y + 0.008, -depth + 0.016, z + 0.95), iron))
        for x0 in (a, b - 0.03):
            parts += [box((x0, y, z), (x0 + 0.016, y + 0.016, z + 0.95), iron) for y in np.arange(-depth, -0.1, 0.16)]
            parts.append(box((x0, -depth, z + 0.93), (x0 + 0.04, 0, z + 0.98), iron))
        parts.append(box((a, -depth, z + 0.93), (b, -depth + 0.04, z + 0.98), iron))
    if rng.random() < 0.35:
        parts.append(
            box(
                (a + 0.2, -depth + 0.1, z),
                (a + 0.7, -depth + 0.5, z + rng.uniform(0.3, 0.9)),
                _surface("plastic", draw_colour("furniture", rng)),
            )
        )
    return join(parts)


def _rooms(style: _Style, width: float, depth: float, windows: list[tuple], rng: np.random.Generator) -> Mesh:
    """Floors, a rear wall, partitions, curtains and things in the rooms behind the windows."""
    wall = _surface("interior", (190, 182, 168))
    back = min(rng.uniform(3.0, 5.5), depth - 0.5)
    parts = [box((0.2, back, -0.5), (width - 0.2, back + 0.1, style.top - 0.3), wall)]
    parts.append(box((0.2, 0.05, style.top - 0.35), (width - 0.2, back, style.top - 0.3), wall))
    for k in range(style.floors):
        z = 0.05 if k == 0 else style.ground_floor + (k - 1) * style.floor
        parts.append(box((0.2, 0.05, z - 0.2), (width - 0.2, back, z), _surface("wood", (134, 108, 80))))
        for x in np.cumsum(rng.uniform(2.8, 6.0, 6)):
            if x < width - 1:
                height = style.ground_floor if k == 0 else style.floor
                parts.append(box((x, 0.35, z), (x + 0.1, back, z + height - 0.25), wall))
    for x, z, w, height, _ in windows:
        if z > 1.0 and rng.random() < 0.55:
            side, share = rng.choice([-1, 1]), rng.uniform(0.2, 0.9)
            a, b = sorted((x + side * w / 2, x + side * (w / 2 - share * w)))
            cloth = quads(
                np.array([[[a, 0.45, z], [b, 0.45, z], [b, 0.45, z + height], [a, 0.45, z + height]]]), _surface("cloth", (214, 206, 190))
            )
            parts.append(cloth)
        for _ in range(3 if z < 1.0 else 1):
            cx, cy = rng.uniform(x - w / 2, x + w / 2), rng.uniform(0.6, back - 0.4)
            size = rng.uniform(0.2, 0.55, 3) * [1, 1, 2.0]
            floor = max(0.05, z - style.sill) if z > 1.0 else 0.05
            parts.append(
                box(
                    (cx - size[0], max(0.3, cy - size[1]), floor),
                    (cx + size[0], cy + size[1], floor + 2 * size[2] * 0.7),
                    _surface("interior", draw_colour("furniture", rng)),
                )
            )
    return join(parts)


def _roof(style: _Style, width: float, depth: float, rng: np.random.Generator) -> Mesh:
    if style.is_modern:
        parapet = [box((0, 0, style.top), (width, 0.25, style.top + 0.5), style.trim)]
        parapet += [box((x, 0, style.top), (x + 0.25, depth, style.top + 0.5), style.trim) for x in (0, width - 0.25)]
        return join(
            [
                quads(np.array([[[0, 0, style.top], [width, 0, style.top], [width, depth, style.top], [0, depth, style.top]]]), style.roof),
                *parapet,
            ]
        )
    rise = np.tan(np.deg2rad(rng.uniform(28, 46))) * depth / 2
    eave, ridge, z = -0.5, depth / 2, style.top
    low = z - 0.5 * rise / (depth / 2) * 0.6
    front = np.array([[0, eave, low], [width, eave, low], [width, ridge, z + rise], [0, ridge, z + rise]])
    rear = np.array([[width, depth, z], [0, depth, z], [0, ridge, z + rise], [width, ridge, z + rise]])
    parts = [quads(np.stack([front, rear]), style.roof)]
    parts.append(tube(np.array([[0, eave, low - 0.03], [width, eave, low - 0.03]]), 0.07, _surface("metal", (120, 112, 100)), 6))
    for x in (0.0, width):
        gable = np.array([[[x, 0, z], [x, depth, z], [x, ridge, z + rise], [x, ridge, z + rise]]])
        parts.append(quads(gable, style.wall))
    for x in np.arange(1.8, width - 1.5, rng.uniform(2.6, 4.5)):
        if rng.random() < 0.6:
            y0, h = 0.8, 1.5
            foot = z + rise * y0 / ridge
            parts.append(box((x - 0.6, y0, foot - 0.3), (x + 0.6, y0 + 2.0, foot + h), style.wall))
            parts.append(
                quads(
                    np.array(
                        [
                            [
                                [x - 0.42, y0 - 0.01, foot + 0.15],
                                [x + 0.42, y0 - 0.01, foot + 0.15],
                                [x + 0.42, y0 - 0.01, foot + h - 0.15],
                                [x - 0.42, y0 - 0.01, foot + h - 0.15],
                            ]
                        ]
                    ),
                    style.glass,
                )
            )
        else:
            parts.append(
                box(
                    (x - 0.35, ridge - 1.5, z + rise * 0.5),
                    (x + 0.35, ridge - 0.8, z + rise + 0.8),
                    _surface("brick", draw_colour("brick", rng)),
                )
            )
    return join(parts)


def _scaffolding(width: float, height: float, rng: np.random.Generator) -> Mesh:
    """Tubes, boards and a torn net before the front."""
    steel, wood = _surface("metal", (150, 150, 148)), _surface("wood", (150, 122, 88))
    parts, xs = [], np.arange(0.3, width, 2.2)
    for x in xs:
        parts += [tube(np.array([[x, y, 0.0], [x, y, height]]), 0.024, steel, 6, caps=False) for y in (-0.35, -1.15)]
    for z in np.arange(2.0, height, 2.0):
        parts.append(box((xs[0], -1.15, z), (xs[-1], -0.35, z + 0.04), wood))
        parts += [tube(np.array([[xs[0], -1.15, z + d], [xs[-1], -1.15, z + d]]), 0.02, steel, 5, caps=False) for d in (0.5, 1.0)]
        x = float(rng.choice(xs[:-1]))
        parts.append(tube(np.array([[x, -1.15, z - 2.0], [x + 2.2, -1.15, z]]), 0.02, steel, 5, caps=False))
    net = []
    for x in xs[:-1]:
        for z in np.arange(2.0, height - 2, 2.0):
            if rng.random() < 0.45:
                net.append([[x, -1.2, z], [x + 2.2, -1.2, z], [x + 2.2, -1.2, z + 2.0], [x, -1.2, z + 2.0]])
    if net:
        parts.append(quads(np.array(net), _surface("leaves", (60, 120, 90))))  # a net lets a few pulses through, as leaves do
    return join(parts)


def make_building(width: float, depth: float, sides: tuple[bool, bool], rng: np.random.Generator) -> Mesh:
    """A house.

    Args:
        width, depth: of its plan, metres.
        sides: whether the side at x = 0 and the one at x = width can be seen and get windows too.
        rng: draws its style.
    """
    style = _Style(rng)
    front, windows = _front(style, width, rng, style.has_shop, True)
    parts = [front, _rooms(style, width, depth, windows, rng), _roof(style, width, depth, rng)]
    for x, seen in zip((0.0, width), sides, strict=True):
        if seen:
            wall, _ = _front(style, depth, rng, style.has_shop and rng.random() < 0.5, False)
            # Turned so that its outside faces away from the house.
            parts.append(transform(wall, -np.pi / 2, (0, depth, 0)) if x == 0 else transform(wall, np.pi / 2, (width, 0, 0)))
        else:
            parts.append(
                quads(np.array([[[x, 0, -FOUNDATION_M], [x, depth, -FOUNDATION_M], [x, depth, style.top], [x, 0, style.top]]]), style.wall)
            )
    parts.append(
        quads(
            np.array([[[width, depth, -FOUNDATION_M], [0, depth, -FOUNDATION_M], [0, depth, style.top], [width, depth, style.top]]]),
            style.wall,
        )
    )
    if rng.random() < 0.10:
        parts.append(_scaffolding(width, style.top + 0.5, rng))
    return join(parts)


def make_garden_wall(length: float, rng: np.random.Generator) -> Mesh:
    """A wall with a gate between two houses, along x, its street side at y = 0."""
    height, wall = rng.uniform(1.9, 2.8), _surface("plaster", draw_colour("plaster", rng))
    relief = Relief((0, length), (-FOUNDATION_M, height), 0.0, wall)
    relief.paint(0, length, height - 0.12, height, 0.08, _surface("stone", draw_colour("stone", rng)))
    gate = min(2.8, length - 0.8)
    a = rng.uniform(0.3, length - gate - 0.3)
    relief.paint(a, a + gate, -0.5, height - 0.15, -0.12, _surface("wood", draw_colour("door", rng)))
    mesh = relief.build(lambda a, b, d: np.stack([a, -d, b], -1))
    back = quads(
        np.array(
            [
                [[length, 0.3, -1], [0, 0.3, -1], [0, 0.3, height], [length, 0.3, height]],
                [[0, 0, height], [length, 0, height], [length, 0.3, height], [0, 0.3, height]],
            ]
        ),
        wall,
    )
    return join([mesh, back])
