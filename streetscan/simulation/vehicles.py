"""Vehicles: cars, vans, lorries, buses and trams, as skins over cross sections, with wheels, lamps and seats behind the glass.

Every function draws one base shape in the frame of `streetscan.simulation.shapes`: `g` draws the design, `rng` the instance.
"""

from itertools import pairwise

import numpy as np

from streetscan.classes import CAR, TRAM_BUS
from streetscan.simulation.appearance import CHROME, DARK, RUBBER, draw_car_paint, draw_colour
from streetscan.simulation.meshes import Surface, box, ellipsoid, join, loft, quads, tube
from streetscan.simulation.scene import Mesh

Generator = np.random.Generator


def _sections(stations: list[tuple]) -> np.ndarray:
    """(K, 12, 3) closed sections of a vehicle from stations (x, z_low, z_mid, z_belt, z_top, w_low, w_mid, w_belt, w_top)."""
    s = np.array(stations, float)
    x, low, mid, belt, top, w_low, w_mid, w_belt, w_top = s.T
    zero = np.zeros_like(x)
    # The rounded edge of the roof takes a third of the height above the belt, at most 7 cm.
    edge = np.minimum(0.07, (top - belt) / 3)
    half = [(zero, low), (w_low, low), (w_mid, mid), (w_belt, belt), (w_top, top - edge), (w_top - 1.5 * edge, top), (zero, top)]
    ring = [*half, *[(-w, z) for w, z in half[-2:0:-1]]]
    return np.stack([np.stack([x, w, z], 1) for w, z in ring], 1)


def _hull(stations: list[tuple], kinds: str, label: int, paint: tuple[str, tuple], trim: tuple | None = None) -> Mesh:
    """The skin of a vehicle: one letter of `kinds` per interval between stations.

    b body, c cabin with side windows, w windscreen or rear window (glass across the roof strips).
    """
    mesh = loft(_sections(stations), Surface(label, *paint))
    n = len(kinds)
    strips = np.zeros((n, 12), bool)
    for i, kind in enumerate(kinds):
        if kind == "c":
            strips[i, [3, 8]] = True
        if kind == "w":
            strips[i, [4, 5, 6, 7]] = True
    glass = np.append(np.repeat(strips.reshape(-1), 2), np.zeros(24, bool))
    like = box((0, 0, 0), (1, 1, 1), Surface(label, "car_glass", (46, 56, 60)))
    mesh.materials[glass], mesh.colours[glass] = like.materials[0], like.colours[0]
    if trim is not None:
        lower = np.zeros((n, 12), bool)
        lower[:, [0, 1, 10, 11]] = True
        mesh.colours[: n * 24][np.repeat(lower.reshape(-1), 2)] = trim
    return mesh


def _wheels(xs: list[float], half_width: float, radius: float, label: int, width: float = 0.22) -> Mesh:
    parts = []
    for x in xs:
        for side in (-1, 1):
            outer = side * (half_width + 0.03)
            path = np.array([[x, outer - side * width, radius], [x, outer, radius]])
            parts.append(tube(path, radius, Surface(label, "rubber", RUBBER), n_sides=14))
            hub = np.array([[x, outer, radius], [x, outer + side * 0.015, radius]])
            parts.append(tube(hub, 0.6 * radius, Surface(label, "metal", CHROME), n_sides=10))
    return join(parts)


def _fittings(length: float, width: float, height: float, label: int, paint: tuple, mirror_x: float, light_z: float) -> Mesh:
    """Mirrors, lamps and number plates."""
    parts = []
    for side in (-1, 1):
        y = side * (width / 2 + 0.09)
        parts.append(
            box((mirror_x - 0.08, y - 0.10, 0.62 * height), (mirror_x + 0.08, y + 0.10, 0.62 * height + 0.14), Surface(label, *paint))
        )
        for end, colour in ((-1, (170, 20, 24)), (1, (230, 230, 225))):
            x = end * (length / 2 - 0.02)
            low, high = sorted((x, x + end * 0.035))
            parts.append(
                box(
                    (low, side * 0.38 * width - 0.14, light_z),
                    (high, side * 0.38 * width + 0.14, light_z + 0.13),
                    Surface(label, "plastic", colour),
                )
            )
    for end in (-1, 1):
        x = end * (length / 2 + 0.01)
        parts.append(box((x - 0.012, -0.26, 0.42), (x + 0.012, 0.26, 0.53), Surface(label, "retroreflector", (235, 235, 225))))
    return join(parts)


def _seats(xs: list[float], width: float, floor: float, label: int, high: float = 0.62) -> Mesh:
    surface = Surface(label, "cloth_dark", (44, 44, 48))
    parts = []
    for x in xs:
        for y in (-0.24 * width, 0.24 * width):
            parts.append(box((x - 0.22, y - 0.22, floor), (x + 0.25, y + 0.22, floor + 0.28), surface))
            parts.append(box((x - 0.32, y - 0.22, floor + 0.05), (x - 0.20, y + 0.22, floor + 0.25 + high), surface))
    return join(parts)


def _car(
    g: Generator, rng: Generator, length, width, height, trunk, rear_glass, screen, hood, deck, hood_height, windows: str = "cc"
) -> Mesh:
    """A passenger car. Pairs are ranges; trunk, rear_glass, screen and hood are shares of the length, heights of the height."""
    length, width, height = (g.uniform(*v) for v in (length, width, height))
    trunk, rear_glass, screen, hood = (g.uniform(*v) * length for v in (trunk, rear_glass, screen, hood))
    deck, hood_height = g.uniform(*deck) * height, g.uniform(*hood_height) * height
    paint = draw_car_paint(rng)
    clearance, belt = g.uniform(0.17, 0.23) + 0.04 * (height > 1.6), g.uniform(0.60, 0.66) * height
    w, tumble = width / 2, g.uniform(0.76, 0.86)
    back, front = -length / 2, length / 2
    x_roof_rear, x_roof_front = back + trunk + rear_glass, front - hood - screen
    middle = x_roof_rear + g.uniform(0.42, 0.52) * (x_roof_front - x_roof_rear)
    mid = 0.36 * height
    stations = [
        (back, 0.36, 0.48, 0.85 * deck, 0.90 * deck, 0.80 * w, 0.88 * w, 0.84 * w, 0.76 * w),
        (back + 0.09, clearance + 0.05, mid, 0.94 * deck, deck, 0.90 * w, w, 0.95 * w, 0.84 * w),
        (back + max(trunk, 0.14), clearance, mid, min(belt, deck), deck + 0.02, 0.92 * w, w, 0.97 * w, 0.84 * w),
        (x_roof_rear, clearance, mid, belt, 0.96 * height, 0.92 * w, w, 0.97 * w, tumble * w),
        (middle - 0.05, clearance, mid, belt - 0.02, height, 0.92 * w, w, 0.97 * w, tumble * w),
        (middle + 0.05, clearance, mid, belt - 0.02, height, 0.92 * w, w, 0.97 * w, tumble * w),
        (x_roof_front, clearance, mid, belt - 0.04, 0.97 * height, 0.92 * w, w, 0.97 * w, tumble * w),
        (front - hood, clearance, mid, hood_height - 0.05, hood_height, 0.92 * w, w, 0.96 * w, 0.88 * w),
        (front - 0.30, clearance + 0.02, mid, 0.86 * hood_height, 0.90 * hood_height, 0.90 * w, 0.98 * w, 0.92 * w, 0.82 * w),
        (front, 0.34, 0.48, 0.66 * hood_height, 0.72 * hood_height, 0.74 * w, 0.82 * w, 0.80 * w, 0.72 * w),
    ]
    radius = g.uniform(0.29, 0.35) + 0.03 * (height > 1.6)
    axle_rear, axle_front = back + g.uniform(0.17, 0.20) * length, front - g.uniform(0.18, 0.21) * length
    parts = [
        _hull(stations, f"bbw{windows[0]}b{windows[1]}wbb", CAR, paint),
        _wheels([axle_rear, axle_front], w, radius, CAR),
        _fittings(length, width, height, CAR, paint, front - hood - 0.3 * screen, 0.46 * height),
        _seats([middle - 0.35, middle + 0.55], width, 0.34 * height, CAR, 0.36 * height),
    ]
    if g.random() < 0.3:
        bar = Surface(CAR, "metal", CHROME)
        for y in (-0.62 * w, 0.62 * w):
            parts.append(tube(np.array([[x_roof_rear + 0.2, y, height + 0.05], [x_roof_front - 0.1, y, height + 0.05]]), 0.02, bar, 5))
    return join(parts)


def hatchback(g, rng):
    return _car(
        g, rng, (3.5, 4.2), (1.64, 1.80), (1.42, 1.56), (0, 0.02), (0.07, 0.12), (0.13, 0.17), (0.18, 0.24), (0.60, 0.66), (0.58, 0.64)
    )


def sedan(g, rng):
    return _car(
        g, rng, (4.4, 5.0), (1.74, 1.88), (1.40, 1.49), (0.13, 0.18), (0.10, 0.14), (0.13, 0.16), (0.23, 0.27), (0.66, 0.72), (0.60, 0.66)
    )


def estate(g, rng):
    return _car(
        g, rng, (4.4, 4.9), (1.75, 1.86), (1.44, 1.54), (0, 0.02), (0.04, 0.07), (0.13, 0.16), (0.23, 0.27), (0.62, 0.68), (0.60, 0.65)
    )


def suv(g, rng):
    return _car(
        g, rng, (4.2, 4.9), (1.82, 1.98), (1.64, 1.84), (0, 0.02), (0.05, 0.09), (0.10, 0.13), (0.21, 0.26), (0.60, 0.66), (0.60, 0.66)
    )


def coupe(g, rng):
    return _car(
        g,
        rng,
        (4.1, 4.6),
        (1.76, 1.90),
        (1.24, 1.34),
        (0.05, 0.10),
        (0.22, 0.28),
        (0.15, 0.18),
        (0.27, 0.32),
        (0.70, 0.76),
        (0.62, 0.68),
        "cb",
    )


def minivan(g, rng):
    return _car(
        g, rng, (4.3, 4.8), (1.78, 1.92), (1.60, 1.75), (0, 0.02), (0.03, 0.06), (0.17, 0.22), (0.12, 0.17), (0.58, 0.64), (0.54, 0.60)
    )


def delivery_van(g, rng):
    return _car(
        g,
        rng,
        (4.8, 6.2),
        (1.92, 2.05),
        (1.95, 2.6),
        (0, 0.005),
        (0.005, 0.01),
        (0.09, 0.13),
        (0.10, 0.15),
        (0.55, 0.60),
        (0.46, 0.52),
        "bc",
    )


def minibus(g, rng):
    return _car(
        g, rng, (5.0, 6.6), (1.95, 2.08), (2.2, 2.75), (0, 0.005), (0.01, 0.02), (0.06, 0.10), (0.07, 0.11), (0.55, 0.60), (0.44, 0.50)
    )


def pickup(g, rng):
    """A pick-up: cab over an open load bed."""
    mesh = _car(
        g, rng, (5.0, 5.4), (1.82, 1.92), (1.72, 1.84), (0.28, 0.33), (0.01, 0.02), (0.10, 0.13), (0.22, 0.25), (0.54, 0.58), (0.58, 0.62)
    )
    load = Surface(CAR, "wood", (120, 96, 70))
    boxes = [box((-2.3 + 0.4 * i, -0.5, 0.95), (-2.0 + 0.4 * i, 0.6, 1.05 + g.uniform(0.05, 0.5)), load) for i in range(3)]
    return join([mesh, *boxes])


def _cab(g: Generator, front: float, width: float, height: float, paint: tuple) -> Mesh:
    """The cab of a truck: nose at `front`."""
    depth, w = g.uniform(1.6, 2.1), width / 2
    stations = [
        (front - depth, 0.55, 1.2, 1.75, height - 0.05, 0.9 * w, w, w, 0.93 * w),
        (front - 0.75 * depth, 0.5, 1.2, 1.75, height, 0.9 * w, w, w, 0.93 * w),
        (front - 0.30, 0.45, 1.2, 1.70, height - 0.05, 0.9 * w, w, w, 0.9 * w),
        (front - 0.05, 0.45, 1.1, 1.55, 1.65, 0.9 * w, 0.98 * w, 0.95 * w, 0.9 * w),
        (front, 0.5, 1.0, 1.2, 1.3, 0.85 * w, 0.95 * w, 0.95 * w, 0.9 * w),
    ]
    mirrors = [
        box((front - 0.25, s * (w + 0.2) - 0.1, 1.7), (front - 0.15, s * (w + 0.2) + 0.1, 2.2), Surface(CAR, "plastic", DARK))
        for s in (-1, 1)
    ]
    return join([_hull(stations, "bcwb", CAR, paint), *mirrors])


def _frame(back: float, front: float, width: float, axles: list[float], radius: float) -> Mesh:
    chassis = box((back, -0.45, 0.55), (front - 0.6, 0.45, 0.85), Surface(CAR, "painted_metal", DARK))
    lights = [
        box((back - 0.05, s * 0.4 * width - 0.2, 0.8), (back, s * 0.4 * width + 0.2, 0.95), Surface(CAR, "retroreflector", (180, 30, 26)))
        for s in (-1, 1)
    ]
    return join([chassis, *lights, _wheels(axles, width / 2 - 0.03, radius, CAR, 0.3)])


def box_truck(g, rng):
    """A lorry with a closed body."""
    length, width, height = g.uniform(6.0, 8.5), g.uniform(2.2, 2.5), g.uniform(2.9, 3.6)
    paint = ("paint_white", draw_colour("truck", rng))
    front, back = length / 2, -length / 2
    body = box((back, -width / 2, 0.95), (front - 2.1, width / 2, height), Surface(CAR, "painted_metal", draw_colour("truck", rng)))
    return join(
        [_cab(g, front, width * 0.96, min(height - 0.3, 2.8), paint), body, _frame(back, front, width, [back + 1.6, front - 1.2], 0.45)]
    )


def tipper(g, rng):
    """A lorry with an open tipping body, loaded."""
    length, width = g.uniform(6.2, 8.0), g.uniform(2.3, 2.5)
    front, back, rim = length / 2, -length / 2, g.uniform(1.9, 2.4)
    steel = Surface(CAR, "painted_metal", draw_colour("truck", rng))
    w = width / 2
    bed = [
        box((back, -w, 1.0), (front - 2.3, w, 1.12), steel),
        box((back, -w, 1.1), (back + 0.08, w, rim), steel),
        box((front - 2.4, -w, 1.1), (front - 2.3, w, rim + 0.4), steel),
        box((back, -w, 1.1), (front - 2.3, -w + 0.08, rim), steel),
        box((back, w - 0.08, 1.1), (front - 2.3, w, rim), steel),
        ellipsoid(
            (length * 0.3, w * 0.9, g.uniform(0.4, 0.9)),
            ((back + front - 2.3) / 2, 0, rim - 0.35),
            Surface(CAR, "gravel", (130, 118, 100)),
        ),
    ]
    return join(
        [
            _cab(g, front, width * 0.96, 2.75, ("paint_colour", draw_colour("truck", rng))),
            *bed,
            _frame(back, front, width, [back + 1.0, back + 2.2, front - 1.2], 0.48),
        ]
    )


def garbage_truck(g, rng):
    """A refuse lorry: rounded body with a loading hopper behind."""
    length, width, height = g.uniform(7.5, 9.0), 2.45, g.uniform(3.0, 3.4)
    front, back, w = length / 2, -length / 2, 2.45 / 2
    orange = Surface(CAR, "paint_colour", draw_colour("truck", rng))
    stations = [
        (back, 0.9, 1.3, 1.8, height - 1.2, 0.9 * w, w, w, 0.9 * w),
        (back + 0.6, 0.7, 1.3, 2.0, height - 0.1, 0.9 * w, w, w, 0.8 * w),
        (back + 1.6, 0.9, 1.5, 2.4, height, 0.9 * w, w, w, 0.8 * w),
        (front - 2.2, 0.9, 1.5, 2.4, height, 0.9 * w, w, w, 0.8 * w),
    ]
    return join(
        [
            _cab(g, front, width * 0.96, 2.7, orange[1:]),
            loft(_sections(stations), orange),
            _frame(back + 0.8, front, width, [back + 2.2, back + 3.4, front - 1.2], 0.5),
        ]
    )


def _passenger_body(g, length, width, height, clearance, paint, label, x0=0.0, rounded=(0.15, 0.15), belt=None) -> Mesh:
    """A box of windows and pillars: one car of a bus or tram, from x0 - length/2 to x0 + length/2."""
    w = width / 2
    belt = belt or clearance + g.uniform(0.75, 1.0)
    pitch, pillar = g.uniform(1.3, 1.9), 0.14
    n = max(2, round((length - 1.2) / pitch))
    back, front = x0 - length / 2, x0 + length / 2

    def station(x, taper=1.0, drop=0.0):
        return (x, clearance, (clearance + belt) / 2, belt, height - drop, 0.97 * w * taper, w * taper, w * taper, 0.97 * w * taper)

    stations, kinds = [station(back, 1 - rounded[0], 0.25), station(back + 0.35)], ["w" if rounded[0] > 0.05 else "b"]
    xs = np.linspace(back + 0.5, front - 0.7, n + 1)
    for a, b in pairwise(xs):
        stations += [station(a + pillar / 2), station(b - pillar / 2)]
        kinds += ["b", "c"]
    stations += [station(front - 0.35), station(front, 1 - rounded[1], 0.25)]
    kinds += ["b", "w" if rounded[1] > 0.05 else "b"]
    hull = _hull(stations, "".join(kinds), label, paint)
    seats = _seats(list(np.arange(back + 1.2, front - 1.5, 1.1)), width * 0.9, clearance + 0.3, label, 0.8)
    screens = []
    for end, taper in ((back - 0.01, rounded[0]), (front + 0.01, rounded[1])):
        if taper > 0.05:
            y = 0.80 * w * (1 - taper)
            corners = [(end, -y, belt), (end, y, belt), (end, y, height - 0.55), (end, -y, height - 0.55)]
            screens.append(quads(np.array([corners if end > x0 else corners[::-1]]), Surface(label, "car_glass", (40, 50, 56))))
    return join([hull, seats, *screens])


def _bus(g, rng, length, height, n_axles=2, paint=None, double=False) -> Mesh:
    length, height, width = g.uniform(*length), g.uniform(*height), g.uniform(2.45, 2.55)
    paint = paint or ("paint_colour", draw_colour("bus", rng))
    parts = [_passenger_body(g, length, width, height if not double else 2.2, 0.32, paint, TRAM_BUS)]
    if double:
        parts.append(_passenger_body(g, length - 0.1, width, height, 2.15, paint, TRAM_BUS, belt=2.75))
    axles = [-length / 2 + 2.4, length / 2 - 2.6, *([-length / 2 + 3.6] if n_axles == 3 else [])]
    parts.append(_wheels(axles, width / 2, 0.48, TRAM_BUS, 0.3))
    parts += [
        box(
            (length / 2 - 0.2, s * (width / 2 + 0.22) - 0.09, 1.9),
            (length / 2 - 0.1, s * (width / 2 + 0.22) + 0.09, 2.3),
            Surface(TRAM_BUS, "plastic", DARK),
        )
        for s in (-1, 1)
    ]
    parts.append(
        box((length / 2 - 0.02, -0.7, height - 0.32), (length / 2 + 0.02, 0.7, height - 0.12), Surface(TRAM_BUS, "plastic", (20, 20, 16)))
    )
    if g.random() < 0.6 and not double:
        x = g.uniform(-0.25, 0.2) * length
        parts.append(box((x - 1.2, -0.85, height - 0.04), (x + 1.2, 0.85, height + 0.28), Surface(TRAM_BUS, "plastic", (210, 210, 206))))
    return join(parts)


def city_bus(g, rng):
    return _bus(g, rng, (10.5, 12.5), (2.85, 3.1))


def midi_bus(g, rng):
    return _bus(g, rng, (7.5, 9.2), (2.65, 2.85))


def coach(g, rng):
    return _bus(g, rng, (12.0, 13.8), (3.4, 3.75), 3, ("paint_white", draw_colour("bus", rng)))


def double_decker(g, rng):
    return _bus(g, rng, (10.0, 11.5), (4.1, 4.4), double=True)


def articulated_bus(g, rng):
    """A bus of two cars with bellows between them."""
    paint = ("paint_colour", draw_colour("bus", rng))
    height, width, first, second = g.uniform(2.9, 3.1), 2.52, g.uniform(9.2, 10.2), g.uniform(6.4, 7.2)
    gap = 1.1
    x1, x2 = (second + gap) / 2, -(first + gap) / 2
    parts = [
        _passenger_body(g, first, width, height, 0.32, paint, TRAM_BUS, x1, (0.0, 0.15)),
        _passenger_body(g, second, width, height, 0.32, paint, TRAM_BUS, x2, (0.15, 0.0)),
        _bellows(x1 - first / 2 - gap, x1 - first / 2, width, 0.4, height),
        _wheels([x1 + first / 2 - 2.6, x1 - first / 2 + 1.5, x2 - 0.6], width / 2, 0.48, TRAM_BUS, 0.3),
    ]
    return join(parts)


def _bellows(x0, x1, width, low, high) -> Mesh:
    xs = np.linspace(x0 - 0.05, x1 + 0.05, 13)
    w = width / 2 - np.where(np.arange(13) % 2 == 0, 0.05, 0.16)
    sections = np.stack(
        [np.stack([xs, sy * w, np.full(13, z)], 1) for sy, z in ((1, low), (1, high - 0.1), (-1, high - 0.1), (-1, low))], 1
    )
    return loft(sections, Surface(TRAM_BUS, "rubber", (44, 44, 46)))


def _tram(g, rng, n_cars, car_length, height, rounded, clearance=0.3, roof=True) -> Mesh:
    paint = ("paint_colour", draw_colour("tram", rng))
    width, gap = g.uniform(2.3, 2.5), 0.7
    lengths = [g.uniform(*car_length)] * n_cars
    total = sum(lengths) + gap * (n_cars - 1)
    x, parts = -total / 2, []
    for i, length in enumerate(lengths):
        ends = (rounded if i == 0 else 0.0, rounded if i == n_cars - 1 else 0.0)
        centre = x + length / 2
        parts.append(_passenger_body(g, length, width, height, clearance, paint, TRAM_BUS, centre, ends))
        for bogie in (-0.3, 0.3):
            parts.append(
                box(
                    (centre + bogie * length - 1.0, -0.9, 0.04),
                    (centre + bogie * length + 1.0, 0.9, clearance + 0.05),
                    Surface(TRAM_BUS, "painted_metal", (52, 50, 48)),
                )
            )
        if i:
            parts.append(_bellows(x - gap, x, width, clearance + 0.1, height))
        if roof:
            parts.append(
                box(
                    (centre - 0.28 * length, -0.8, height - 0.04),
                    (centre + 0.2 * length, 0.8, height + g.uniform(0.25, 0.45)),
                    Surface(TRAM_BUS, "painted_metal", (170, 170, 166)),
                )
            )
        x += length + gap
    bar = Surface(TRAM_BUS, "metal", (90, 90, 92))
    top = 5.45
    for y in (-0.5, 0.5):
        parts.append(tube(np.array([[0.6, y, height + 0.1], [-0.5, y, (height + top) / 2 + 0.1], [0.5, y * 0.8, top]]), 0.035, bar, 5))
    parts.append(tube(np.array([[0.5, -0.75, top], [0.5, 0.75, top]]), 0.04, bar, 5))
    return join(parts)


def tram_classic(g, rng):
    return _tram(g, rng, 1, (13.0, 15.5), g.uniform(3.1, 3.3), 0.32, 0.55, roof=False)


def tram_pair(g, rng):
    return _tram(g, rng, 2, (10.5, 12.5), g.uniform(3.1, 3.3), 0.3, 0.5, roof=False)


def tram_low_floor(g, rng):
    return _tram(g, rng, 3, (7.5, 9.0), g.uniform(3.3, 3.5), 0.22)


def tram_long(g, rng):
    return _tram(g, rng, 4, (6.5, 7.5), g.uniform(3.4, 3.6), 0.18)
