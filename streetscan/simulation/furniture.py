"""Street furniture: benches, bins, kiosks, shelters, bicycles, fences and what else stands about.

Every base shape takes two generators, as in `streetscan.simulation.shapes`: `g` draws the design, `rng` the instance.
"""

import numpy as np

from streetscan.classes import FURNITURE
from streetscan.simulation.appearance import CHROME, DARK, RUBBER, draw_colour, vary_colours
from streetscan.simulation.meshes import Surface, box, ellipsoid, join, loft, quads, revolve, transform, tube
from streetscan.simulation.people import make_bicycle, make_person
from streetscan.simulation.plants import points_in_ball, scatter_leaves
from streetscan.simulation.scene import Mesh

Generator = np.random.Generator


def _furniture(material: str, colour: tuple) -> Surface:
    return Surface(FURNITURE, material, colour)


def bench(g, rng):
    """A bench along x, its back on the -y side."""
    length, wood = g.uniform(1.4, 2.1), _furniture("wood", draw_colour("furniture", rng))
    iron = _furniture("painted_metal", draw_colour("pole", rng))
    seat, n = g.uniform(0.42, 0.48), int(g.integers(3, 5))
    parts = [box((-length / 2, -0.2 + 0.45 * i / n, seat), (length / 2, -0.2 + 0.45 * (i + 0.8) / n, seat + 0.04), wood) for i in range(n)]
    parts += [
        box((-length / 2, -0.30 - 0.04 * i, seat + 0.15 + 0.14 * i), (length / 2, -0.26 - 0.04 * i, seat + 0.25 + 0.14 * i), wood)
        for i in range(3)
    ]
    for x in (-0.4 * length, 0.4 * length):
        parts += [
            box((x - 0.03, -0.25, 0), (x + 0.03, 0.25, seat), iron),
            box((x - 0.03, -0.42, seat), (x + 0.03, -0.25, seat + 0.5), iron),
        ]
    return join(parts)


def stone_bench(g, rng):
    stone = _furniture("concrete", draw_colour("stone", rng))
    length, seat = g.uniform(1.5, 2.6), g.uniform(0.40, 0.50)
    parts = [box((-length / 2, -0.28, seat - 0.12), (length / 2, 0.28, seat), stone)]
    parts += [box((x - 0.15, -0.22, 0), (x + 0.15, 0.22, seat - 0.1), stone) for x in (-0.35 * length, 0.35 * length)]
    return join(parts)


def litter_bin(g, rng):
    s = _furniture("painted_metal", draw_colour("furniture", rng))
    r, h = g.uniform(0.18, 0.28), g.uniform(0.75, 1.05)
    parts = [
        revolve(np.array([[r * 0.85, 0.0], [r * 0.9, 0.08], [r, h * 0.8], [r * 1.08, h * 0.82], [r * 1.08, h * 0.87], [r * 0.5, h]]), s, 12)
    ]
    return join(parts)


def hung_bin(g, rng):
    """A small bin on its own post."""
    s, post = _furniture("plastic", draw_colour("furniture", rng)), _furniture("metal", CHROME)
    h = g.uniform(0.95, 1.25)
    return join(
        [
            tube(np.array([[0, 0, 0], [0, 0, h]]), 0.03, post, 7),
            revolve(np.array([[0.12, h - 0.55], [0.18, h - 0.05], [0.20, h], [0.05, h + 0.06]]), s, 9, (0.2, 0, 0)),
        ]
    )


def wheeled_bin(g, rng):
    s = _furniture("plastic", draw_colour("furniture", rng))
    h, w = g.uniform(0.95, 1.15), g.uniform(0.25, 0.32)
    sections = np.array(
        [
            [[a * k, b * k, z] for a, b in ((-w, -w), (w, -w), (w, w), (-w, w))]
            for z, k in ((0.05, 0.75), (h - 0.1, 1.0), (h - 0.08, 1.1), (h, 0.95))
        ]
    )
    wheels = [
        tube(np.array([[-w * 0.7, y - 0.03, 0.1], [-w * 0.7, y + 0.03, 0.1]]), 0.1, _furniture("rubber", RUBBER), 8)
        for y in (-w * 0.8, w * 0.8)
    ]
    return join([loft(sections, s), *wheels])


def container(g, rng):
    """A recycling container."""
    s = _furniture("plastic", draw_colour("furniture", rng))
    a, h = g.uniform(0.55, 0.8), g.uniform(1.3, 1.7)
    ring = np.array([(-1, -0.9), (1, -0.9), (1, 0.9), (-1, 0.9)])
    sections = np.stack(
        [np.column_stack([ring * k * a, np.full(4, z)]) for z, k in ((0.05, 0.9), (0.7 * h, 1.0), (0.92 * h, 0.75), (h, 0.3))]
    )
    hole = tube(np.array([[0.6 * a, 0, 0.75 * h], [1.02 * a, 0, 0.75 * h]]), 0.12, _furniture("rubber", RUBBER), 10)
    return join([loft(sections, s), hole])


def kiosk(g, rng):
    """A newspaper stand: counter window, roof that juts out, sometimes eight sides."""
    a, h = g.uniform(1.0, 1.5), g.uniform(2.4, 2.9)
    wall, roof = _furniture("painted_metal", draw_colour("furniture", rng)), _furniture("painted_metal", draw_colour("pole", rng))
    n = 8 if g.random() < 0.5 else 4
    turn = np.pi / n
    angle = turn + np.linspace(0, 2 * np.pi, n, endpoint=False)
    ring = np.stack([np.cos(angle), np.sin(angle)], 1) * a / np.cos(turn)

    def level(z, k):
        return np.column_stack([ring * k, np.full(n, z)])

    body = loft(np.stack([level(0, 1), level(1.0, 1)]), wall)
    glass = loft(np.stack([level(1.0, 0.98), level(h - 0.4, 0.98)]), _furniture("glass", (70, 90, 96)), caps=False)
    top = loft(
        np.stack([level(h - 0.4, 1.0), level(h - 0.15, 1.0), level(h - 0.12, 1.25), level(h, 1.25), level(h + g.uniform(0.1, 0.6), 0.2)]),
        roof,
    )
    goods = _furniture("cloth", (180, 150, 120))
    shelves = [box((-0.6 * a, -0.6 * a, z), (0.6 * a, 0.6 * a, z + 0.25), goods) for z in (0.9, 1.3, 1.7)]
    shelf = box((a * 0.9, -0.6 * a, 0.85), (a + 0.3, 0.6 * a, 1.0), wall)
    return join([body, glass, top, *shelves, shelf])


def market_stall(g, rng):
    """A stall: table with goods under a cloth roof on four thin posts."""
    length, depth = g.uniform(2.0, 3.2), g.uniform(1.2, 1.8)
    iron, cloth = _furniture("metal", CHROME), _furniture("cloth", draw_colour("shop", rng))
    parts = [tube(np.array([[x, y, 0], [x, y, 2.2]]), 0.025, iron, 5) for x in (-length / 2, length / 2) for y in (-depth / 2, depth / 2)]
    ridge = np.array([[-length / 2 - 0.2, 0, 2.75], [length / 2 + 0.2, 0, 2.75]])
    for side in (-1, 1):
        eave = np.array([[-length / 2 - 0.2, side * (depth / 2 + 0.3), 2.15], [length / 2 + 0.2, side * (depth / 2 + 0.3), 2.15]])
        parts.append(quads(np.array([[eave[0], eave[1], ridge[1], ridge[0]][::-side]]), cloth))
    parts.append(box((-length / 2, -depth * 0.3, 0.75), (length / 2, depth * 0.45, 0.82), _furniture("wood", (150, 116, 78))))
    parts += [
        box(
            (x, -depth * 0.25, 0.82), (x + 0.35, depth * 0.35, 0.82 + rng.uniform(0.08, 0.3)), _furniture("cloth", draw_colour("shop", rng))
        )
        for x in np.arange(-length / 2 + 0.05, length / 2 - 0.4, 0.42)
    ]
    return join(parts)


def bollard(g, rng):
    s = _furniture("painted_metal", draw_colour("pole", rng))
    r, h = g.uniform(0.05, 0.10), g.uniform(0.70, 1.05)
    return revolve(
        np.array(
            [
                [r * 1.3, -0.1],
                [r * 1.3, 0.08],
                [r, 0.12],
                [r, h * 0.8],
                [r * 1.25, h * 0.83],
                [r, h * 0.87],
                [r * 0.9, h],
                [r * 0.4, h + 0.05],
            ]
        ),
        s,
        10,
    )


def stone_bollard(g, rng):
    r, h = g.uniform(0.18, 0.30), g.uniform(0.45, 0.75)
    s = _furniture("stone", draw_colour("stone", rng))
    return revolve(np.array([[r, -0.1], [r, h * 0.6], [r * 0.8, h * 0.9], [r * 0.3, h]]), s, 10)


def bus_shelter(g, rng):
    """A shelter along x, open on the +y side: glass walls, roof, bench, timetable."""
    length, depth, h = g.uniform(3.0, 4.6), g.uniform(1.2, 1.6), g.uniform(2.35, 2.6)
    iron, glass = _furniture("painted_metal", draw_colour("pole", rng)), _furniture("glass", (120, 140, 146))
    back = -depth / 2
    parts = [box((x - 0.04, y - 0.04, 0), (x + 0.04, y + 0.04, h), iron) for x in np.linspace(-length / 2, length / 2, 4) for y in (back,)]
    parts += [box((x - 0.04, depth / 2 - 0.3, 0), (x + 0.04, depth / 2 - 0.22, h), iron) for x in (-length / 2, length / 2)]
    parts.append(box((-length / 2 - 0.1, back - 0.1, h), (length / 2 + 0.1, depth / 2 + 0.1, h + 0.12), iron))
    parts.append(box((-length / 2, back - 0.006, 0.25), (length / 2, back + 0.006, h - 0.1), glass))
    parts.append(box((-length / 2 - 0.006, back, 0.25), (-length / 2 + 0.006, depth / 2 - 0.3, h - 0.1), glass))
    parts.append(
        box((length / 2 - 0.07, back, 0.2), (length / 2 + 0.07, depth / 2 - 0.3, h - 0.2), _furniture("plastic", draw_colour("shop", rng)))
    )
    parts.append(box((-length / 2 + 0.5, back + 0.1, 0.45), (length / 2 - 0.8, back + 0.45, 0.50), _furniture("wood", (130, 96, 62))))
    return join(parts)


def parked_bicycle(g, rng):
    """A bicycle leaning a little to one side."""
    mesh = make_bicycle(g, rng, FURNITURE)
    lean = rng.normal(0, 0.12)
    mesh.vertices = np.column_stack([mesh.vertices[:, 0], mesh.vertices[:, 1] + lean * mesh.vertices[:, 2], mesh.vertices[:, 2]])
    return mesh


def bicycle_rack(g, rng):
    """Hoops across x with one to four bicycles."""
    s = _furniture("metal", CHROME)
    parts = []
    for i in range(int(g.integers(2, 5))):
        u = np.linspace(0, np.pi, 7)
        hoop = np.stack([0 * u + 0.7 * i - 1.0, 0.35 * np.cos(u), 0.45 + 0.35 * np.sin(u)], 1)
        parts.append(tube(np.concatenate([[[hoop[0, 0], 0.35, 0]], hoop, [[hoop[0, 0], -0.35, 0]]]), 0.025, s, 6))
        if rng.random() < 0.7:
            parts.append(transform(parked_bicycle(g, rng), np.pi / 2 + rng.normal(0, 0.08), (0.7 * i - 0.85, rng.normal(0, 0.1), 0)))
    return join(parts)


def motorcycle(g, rng):
    paint = _furniture("paint_colour", draw_colour("cloth", rng))
    r = g.uniform(0.25, 0.31)
    parts = [tube(np.array([[x, -0.06, r], [x, 0.06, r]]), r, _furniture("rubber", RUBBER), 14) for x in (-0.65, 0.65)]
    parts += [
        ellipsoid((0.42, 0.15, 0.2), (0.15, 0, 0.72), paint, 9, 5),
        ellipsoid((0.4, 0.13, 0.1), (-0.42, 0, 0.78), _furniture("rubber", DARK), 9, 5),
        box((-0.25, -0.16, 0.25), (0.3, 0.16, 0.62), _furniture("metal", (90, 90, 92))),
        tube(np.array([[0.65, 0, r], [0.45, 0, 1.0]]), 0.04, _furniture("metal", CHROME), 6),
        tube(np.array([[0.38, -0.36, 1.02], [0.45, 0, 1.0], [0.38, 0.36, 1.02]]), 0.02, _furniture("metal", DARK), 5),
    ]
    if g.random() < 0.5:
        parts.append(box((0.5, -0.2, 0.75), (0.6, 0.2, 1.3), paint))
    return join(parts)


def hydrant(g, rng):
    s = _furniture("painted_metal", (176, 36, 32) if rng.random() < 0.6 else draw_colour("furniture", rng))
    h, r = g.uniform(0.65, 0.95), g.uniform(0.09, 0.13)
    parts = [
        revolve(
            np.array([[r * 1.6, -0.05], [r * 1.6, 0.06], [r, 0.1], [r, h * 0.75], [r * 1.4, h * 0.77], [r * 1.2, h * 0.88], [r * 0.3, h]]),
            s,
            10,
        )
    ]
    parts.append(tube(np.array([[0, -r * 1.9, h * 0.6], [0, r * 1.9, h * 0.6]]), 0.05, s, 8))
    return join(parts)


def switch_box(g, rng):
    """An electrical cabinet."""
    w, d, h = g.uniform(0.5, 1.4), g.uniform(0.28, 0.45), g.uniform(0.9, 1.5)
    s = _furniture("painted_metal", draw_colour("furniture", rng))
    parts = [
        box((-w / 2, -d / 2, 0), (w / 2, d / 2, h), s),
        box((-w / 2 - 0.04, -d / 2 - 0.04, h), (w / 2 + 0.04, d / 2 + 0.04, h + 0.06), s),
    ]
    parts.append(box((-w / 2 - 0.03, -d / 2 - 0.03, -0.1), (w / 2 + 0.03, d / 2 + 0.03, 0.12), _furniture("concrete", (140, 138, 132))))
    return join(parts)


def mail_box(g, rng):
    s = _furniture("painted_metal", (178, 34, 30) if g.random() < 0.5 else (220, 180, 40))
    h = g.uniform(1.1, 1.45)
    u = np.linspace(0, np.pi, 7)
    arch = np.concatenate([[[-0.25, 0.35]], np.stack([-0.25 * np.cos(u), h - 0.25 + 0.25 * np.sin(u)], 1), [[0.25, 0.35]]])
    sections = np.stack([np.column_stack([arch[::-1, 0], np.full(len(arch), y), arch[::-1, 1]]) for y in (-0.18, 0.18)])
    return join([loft(sections, s), box((-0.06, -0.06, -0.1), (0.06, 0.06, 0.4), _furniture("painted_metal", DARK))])


def parking_meter(g, rng):
    s = _furniture("painted_metal", draw_colour("furniture", rng))
    h = g.uniform(1.4, 1.75)
    return join(
        [
            box((-0.12, -0.10, 0), (0.12, 0.10, h * 0.55), s),
            box((-0.18, -0.15, h * 0.5), (0.18, 0.15, h), s),
            box((-0.12, 0.15, h * 0.75), (0.12, 0.16, h * 0.92), _furniture("glass", (40, 50, 56))),
        ]
    )


def planter(g, rng):
    """A concrete tub (furniture) with shrubs in it (vegetation)."""
    a, h = g.uniform(0.35, 0.75), g.uniform(0.4, 0.75)
    stone = _furniture("concrete", draw_colour("stone", rng))
    ring = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) * a
    tub = loft(np.stack([np.column_stack([ring * k, np.full(4, z)]) for z, k in ((0, 0.85), (h, 1.0))]), stone)
    centres = points_in_ball(14, rng, 0.3) * [a * 0.9, a * 0.9, 0.3] + [0, 0, h + 0.25]
    return join([tub, scatter_leaves(centres, 0.10, 700, 0.05, draw_colour("leaves", rng), rng)])


def advert_column(g, rng):
    """A round advertising pillar."""
    r, h = g.uniform(0.55, 0.8), g.uniform(2.8, 3.6)
    s = _furniture("painted_metal", draw_colour("pole", rng))
    body = revolve(np.array([[r, 0.3], [r, h - 0.4]]), _furniture("plaster", draw_colour("shop", rng)), 18, caps=False)
    body.colours = vary_colours((170, 150, 140), len(body.colours), 30, rng)
    return join(
        [
            revolve(np.array([[r * 1.1, -0.1], [r * 1.1, 0.3], [r * 0.9, 0.32]]), s, 18),
            body,
            revolve(np.array([[r * 1.15, h - 0.4], [r * 1.15, h - 0.2], [r * 0.6, h], [r * 0.1, h + 0.35]]), s, 18),
        ]
    )


def advert_panel(g, rng):
    """A lit poster case on a foot."""
    w, h = g.uniform(1.1, 1.4), g.uniform(2.2, 2.7)
    s = _furniture("painted_metal", draw_colour("pole", rng))
    return join(
        [
            box((-0.35, -0.12, 0), (0.35, 0.12, 0.5), s),
            box((-w / 2, -0.11, 0.5), (w / 2, 0.11, h), s),
            *(
                box((-w / 2 + 0.07, y - 0.005, 0.6), (w / 2 - 0.07, y + 0.005, h - 0.1), _furniture("glass", draw_colour("shop", rng)))
                for y in (-0.12, 0.12)
            ),
        ]
    )


def cafe_set(g, rng):
    """A round table, two to four chairs, often an umbrella."""
    iron, wood = _furniture("metal", DARK), _furniture("wood", draw_colour("furniture", rng))
    parts = [revolve(np.array([[0.22, 0.0], [0.03, 0.04], [0.03, 0.70], [0.35, 0.71], [0.35, 0.74]]), iron, 12)]
    for i in range(int(g.integers(2, 5))):
        chair = [box((-0.2, -0.2, 0.43), (0.2, 0.2, 0.46), wood), box((0.17, -0.2, 0.46), (0.2, 0.2, 0.85), wood)]
        chair += [tube(np.array([[x, y, 0], [x, y, 0.45]]), 0.013, iron, 4) for x in (-0.18, 0.18) for y in (-0.18, 0.18)]
        a = 2 * np.pi * i / 4 + rng.normal(0, 0.15)
        parts.append(transform(join(chair), a, (0.68 * np.cos(a), 0.68 * np.sin(a), 0)))
    if g.random() < 0.6:
        r, h = g.uniform(1.1, 1.6), g.uniform(2.2, 2.6)
        parts.append(tube(np.array([[0, 0, 0], [0, 0, h + 0.35]]), 0.025, iron, 6))
        parts.append(
            revolve(np.array([[r, h - 0.1], [r, h], [0.03, h + 0.4]]), _furniture("cloth", draw_colour("shop", rng)), 8, caps=False)
        )
    return join(parts)


def _rail_posts(length: float, height: float, pitch: float, radius: float, s: Surface) -> list[Mesh]:
    return [
        tube(np.array([[x, 0, -0.2], [x, 0, height]]), radius, s, 6)
        for x in np.linspace(-length / 2, length / 2, max(2, round(length / pitch) + 1))
    ]


def iron_fence(g, rng):
    """Thin bars between posts, along x."""
    length, h = g.uniform(3.0, 4.5), g.uniform(1.1, 1.9)
    s = _furniture("painted_metal", draw_colour("pole", rng))
    parts = _rail_posts(length, h + 0.1, 1.5, 0.03, s)
    parts += [box((x - 0.009, -0.009, 0.08), (x + 0.009, 0.009, h), s) for x in np.arange(-length / 2, length / 2, 0.13)]
    parts += [box((-length / 2, -0.015, z - 0.02), (length / 2, 0.015, z + 0.02), s) for z in (0.15, h - 0.12)]
    return join(parts)


def wooden_fence(g, rng):
    length, h = g.uniform(2.5, 4.0), g.uniform(1.0, 1.8)
    s = _furniture("wood", draw_colour("bark", rng))
    parts = _rail_posts(length, h, 2.0, 0.05, s)
    parts += [
        box((x, 0.03, 0.06), (x + 0.10, 0.05, h * rng.uniform(0.95, 1.02)), s) for x in np.arange(-length / 2, length / 2 - 0.05, 0.13)
    ]
    return join(parts)


def guard_rail(g, rng):
    """Pedestrian railing: posts and two or three bars."""
    length, h = g.uniform(1.8, 3.2), g.uniform(0.9, 1.1)
    s = _furniture("painted_metal", draw_colour("pole", rng))
    parts = _rail_posts(length, h, 1.5, 0.03, s)
    parts += [tube(np.array([[-length / 2, 0, z], [length / 2, 0, z]]), 0.025, s, 6) for z in np.linspace(0.35, h, int(g.integers(2, 4)))]
    return join(parts)


def bridge_railing(g, rng):
    """A heavy railing with a hand rail and close bars, 4 m along x."""
    h = g.uniform(1.05, 1.25)
    s = _furniture("painted_metal", draw_colour("pole", rng))
    parts = [box((x - 0.06, -0.06, -0.2), (x + 0.06, 0.06, h), s) for x in (-2.0, 0.0, 2.0)]
    parts += [box((x - 0.015, -0.02, 0.1), (x + 0.015, 0.02, h - 0.05), s) for x in np.arange(-1.85, 2.0, 0.18)]
    parts += [box((-2, -0.06, h - 0.08), (2, 0.06, h), s), box((-2, -0.03, 0.08), (2, 0.03, 0.14), s)]
    return join(parts)


def barrier(g, rng):
    """A construction barrier with its feet."""
    length = g.uniform(1.6, 2.4)
    white, red = _furniture("retroreflector", (226, 226, 222)), _furniture("plastic", (200, 40, 36))
    parts = [
        box((x, -0.02, 0.75), (x + length / 8 - 0.01, 0.02, 1.0), (white, red)[i % 2])
        for i, x in enumerate(np.linspace(-length / 2, length / 2, 9)[:-1])
    ]
    parts += [box((-length / 2, -0.015, z), (length / 2, 0.015, z + 0.05), red) for z in (0.25, 0.5)]
    parts += [box((x - 0.05, -0.35, 0), (x + 0.05, 0.35, 0.1), _furniture("rubber", RUBBER)) for x in (-0.42 * length, 0.42 * length)]
    parts += [box((x - 0.02, -0.02, 0.1), (x + 0.02, 0.02, 1.0), white) for x in (-0.42 * length, 0.42 * length)]
    return join(parts)


def cone(g, rng):
    h = g.uniform(0.45, 0.75)
    return join(
        [
            box((-0.18, -0.18, 0), (0.18, 0.18, 0.03), _furniture("rubber", RUBBER)),
            revolve(np.array([[0.13, 0.03], [0.09, h * 0.4]]), _furniture("plastic", (220, 80, 30)), 10, caps=False),
            revolve(np.array([[0.09, h * 0.4], [0.03, h]]), _furniture("retroreflector", (230, 226, 220)), 10),
        ]
    )


def telephone_booth(g, rng):
    h = g.uniform(2.2, 2.5)
    s, a = _furniture("painted_metal", draw_colour("furniture", rng)), g.uniform(0.42, 0.5)
    parts = [box((x - 0.03, y - 0.03, 0), (x + 0.03, y + 0.03, h), s) for x in (-a, a) for y in (-a, a)]
    parts += [box((-a - 0.05, -a - 0.05, h), (a + 0.05, a + 0.05, h + 0.15), s), box((-0.2, -a + 0.02, 1.0), (0.2, -a + 0.2, 1.6), s)]
    parts += [box((x - 0.004, -a, 0.3), (x + 0.004, a, h - 0.1), _furniture("glass", (130, 150, 156))) for x in (-a, a)]
    parts.append(box((-a, -a - 0.004, 0.3), (a, -a + 0.004, h - 0.1), _furniture("glass", (130, 150, 156))))
    return join(parts)


def statue(g, rng):
    """A bronze figure on a stepped plinth."""
    stone, h = _furniture("stone", draw_colour("stone", rng)), g.uniform(1.2, 2.4)
    w = g.uniform(0.5, 0.8)
    parts = [
        box((-w * k, -w * k, z0), (w * k, w * k, z1), stone)
        for k, z0, z1 in ((1.8, -0.2, 0.2), (1.4, 0.2, 0.4), (0.9, 0.4, h), (1.1, h, h + 0.12))
    ]
    figure = transform(make_person(g, rng, g.uniform(1.9, 2.6), 0.2, coat=0.25, arms="wide"), rng.uniform(-3, 3), (0, 0, h + 0.12))
    bronze = box((0, 0, 0), (1, 1, 1), _furniture("metal", (86, 104, 88)))
    figure.labels[:], figure.materials[:], figure.colours[:] = FURNITURE, bronze.materials[0], bronze.colours[0]
    return join([*parts, figure])


def fountain(g, rng):
    r, stone = g.uniform(1.4, 2.4), _furniture("stone", draw_colour("stone", rng))
    basin = revolve(np.array([[r, -0.2], [r, 0.5], [r - 0.2, 0.5], [r - 0.2, 0.1]]), stone, 24, caps=False)
    water = revolve(np.array([[0.01, 0.33], [r - 0.2, 0.34]])[::-1], _furniture("water", (70, 100, 110)), 24, caps=False)
    h = g.uniform(1.2, 2.0)
    column = revolve(
        np.array([[0.3, 0.0], [0.2, 0.4], [0.15, 0.7 * h], [0.7, 0.75 * h], [0.75, 0.82 * h], [0.15, 0.82 * h], [0.1, h], [0.02, h + 0.2]]),
        stone,
        14,
    )
    return join([basin, water, column])


def scaffold_tower(g, rng):
    """A mobile scaffold: four legs, braces, boards."""
    s, h = _furniture("metal", CHROME), g.uniform(2.2, 3.8)
    parts = [tube(np.array([[x, y, 0], [x, y, h]]), 0.024, s, 6) for x in (-0.9, 0.9) for y in (-0.4, 0.4)]
    for z in np.arange(0.3, h, 0.5):
        parts += [tube(np.array([[x, -0.4, z], [x, 0.4, z]]), 0.02, s, 5) for x in (-0.9, 0.9)]
    parts += [tube(np.array([[-0.9, y, 0.3], [0.9, y, h - 0.3]]), 0.018, s, 5) for y in (-0.4, 0.4)]
    parts.append(box((-0.9, -0.38, h - 0.9), (0.9, 0.38, h - 0.85), _furniture("wood", (150, 120, 84))))
    return join(parts)
