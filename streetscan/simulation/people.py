"""People who stand, walk, sit and ride, with what they carry, push and lead.

Every base shape takes two generators, as in `streetscan.simulation.shapes`: `g` draws the design, `rng` the instance.
"""

import numpy as np

from streetscan.classes import PEDESTRIAN
from streetscan.simulation.appearance import DARK, RUBBER, draw_colour
from streetscan.simulation.meshes import Surface, box, ellipsoid, join, loft, revolve, transform, tube
from streetscan.simulation.scene import Mesh

Generator = np.random.Generator


def make_person(g: Generator, rng: Generator, height, stride=0.0, sit=False, coat=0.0, arms="down", girth=1.0) -> Mesh:
    """A person facing +x. `stride` is the swing of the legs (rad), `coat` how far a skirt or coat hangs below the hip (share of height)."""
    h = height
    skin, hair = Surface(PEDESTRIAN, "skin", draw_colour("skin", rng)), Surface(PEDESTRIAN, "hair", draw_colour("hair", rng))
    top = Surface(PEDESTRIAN, "cloth", draw_colour("cloth", rng))
    trousers = Surface(PEDESTRIAN, "cloth_dark", draw_colour("cloth", rng))
    shoes = Surface(PEDESTRIAN, "rubber", (40, 34, 30))
    hip = 0.50 * h if not sit else 0.28 * h
    lean = rng.uniform(-0.02, 0.05) * h
    parts = []
    for side in (-1, 1):
        swing = side * stride
        y = side * 0.055 * h * girth
        if sit:
            path = np.array([[0, y, hip], [0.25 * h, y * 1.3, hip + 0.01], [0.27 * h, y * 1.3, 0.05 * h]])
        else:
            knee = (0.25 * h * np.sin(swing) + 0.02 * h, y, hip - 0.25 * h * np.cos(swing))
            ankle_swing = swing - (0.35 * stride if side < 0 else 0)
            path = np.array(
                [[0, y, hip], knee, (knee[0] + 0.22 * h * np.sin(ankle_swing), y, max(0.04 * h, knee[2] - 0.22 * h * np.cos(ankle_swing)))]
            )
        parts.append(tube(path, np.array([0.058 * girth, 0.038, 0.028]) * h, trousers, 7))
        foot = path[-1]
        parts.append(
            box(
                (foot[0] - 0.04 * h, y - 0.026 * h, max(0.0, foot[2] - 0.045 * h)),
                (foot[0] + 0.11 * h, y + 0.026 * h, foot[2] + 0.01 * h),
                shoes,
            )
        )
        shoulder = np.array([lean, side * 0.115 * h * girth, hip + 0.315 * h])
        swing = -swing * 0.8 + 0.06
        if arms == "phone" and side > 0:
            elbow, hand = shoulder + np.array([0.03, 0.02, -0.17]) * h, shoulder + np.array([0.12, -0.05, 0.06]) * h
        elif arms == "forward":
            elbow, hand = shoulder + np.array([0.06, 0.02 * side, -0.15]) * h, shoulder + np.array([0.22, 0.0, -0.15]) * h
        elif arms == "wide":
            elbow, hand = shoulder + np.array([0.02, 0.13 * side, -0.10]) * h, shoulder + np.array([0.08, 0.20 * side, 0.02]) * h
        else:
            elbow = shoulder + np.array([0.17 * np.sin(swing), 0.025 * side, -0.17 * np.cos(swing)]) * h
            hand = elbow + np.array([0.15 * np.sin(swing + 0.3), 0.0, -0.15 * np.cos(swing + 0.3)]) * h
        inner = shoulder + np.array([0, -0.03 * side, 0.012]) * h  # rounds the shoulder
        thickness = np.array([0.018, 0.036, 0.028, 0.022]) * h * (0.6 + 0.4 * girth)
        parts.append(tube(np.stack([inner, shoulder, elbow, hand]), thickness, top, 6))
        parts.append(ellipsoid((0.025 * h,) * 3, tuple(hand), skin, 5, 3))
    # The trunk of the body: ellipses from hip to neck.
    levels = np.array(
        [
            [-0.03, 0.085, 0.075, 0],
            [0.06, 0.085, 0.07, 0.3],
            [0.18, 0.10, 0.075, 0.6],
            [0.28, 0.115, 0.07, 0.9],
            [0.325, 0.07, 0.05, 1],
            [0.35, 0.032, 0.032, 1],
        ]
    )
    angle = np.linspace(0, 2 * np.pi, 10, endpoint=False)
    sections = np.stack(
        [
            np.stack([girth * d * h * np.cos(angle) + f * lean, girth * w * h * np.sin(angle), np.full(10, hip + z * h)], 1)
            for z, w, d, f in levels
        ]
    )
    parts.append(loft(sections, top))
    if coat and not sit:
        low, flare = hip - coat * h, 0.095 + 0.05 * coat
        profile = [(flare * h * girth * (1 + stride), low), (0.09 * h * girth, hip), (0.085 * h * girth, hip + 0.1 * h)]
        parts.append(revolve(np.array(profile), top, 10))
    head = hip + 0.425 * h
    parts.append(tube(np.array([[lean, 0, hip + 0.33 * h], [lean, 0, head]]), 0.03 * h, skin, 6))
    parts.append(ellipsoid((0.057 * h, 0.045 * h, 0.068 * h), (lean + 0.008 * h, 0, head), skin, 8, 5))
    parts.append(ellipsoid((0.058 * h, 0.049 * h, 0.055 * h), (lean - 0.008 * h, 0, head + 0.022 * h), hair, 8, 5))
    return join(parts)


def _adult(g):
    return g.uniform(1.55, 1.92)


def person_standing(g, rng):
    return make_person(g, rng, _adult(g), 0.06, arms="phone" if rng.random() < 0.4 else "down", girth=g.uniform(0.9, 1.35))


def person_walking(g, rng):
    return make_person(g, rng, _adult(g), rng.uniform(0.35, 0.55), girth=g.uniform(0.9, 1.3))


def person_coat(g, rng):
    mesh = make_person(g, rng, _adult(g), rng.uniform(0.05, 0.3), coat=g.uniform(0.18, 0.34), girth=g.uniform(1.0, 1.35))
    bag = Surface(PEDESTRIAN, "cloth_dark", draw_colour("cloth", rng))
    side = 0.32 * (1 if rng.random() < 0.5 else -1)
    return join([mesh, box((-0.18, side - 0.07, 0.38), (0.2, side + 0.07, 0.75), bag)])


def person_backpack(g, rng):
    h = _adult(g)
    mesh = make_person(g, rng, h, rng.uniform(0.1, 0.45), girth=g.uniform(0.95, 1.2))
    bag = Surface(PEDESTRIAN, "cloth", draw_colour("cloth", rng))
    size = g.uniform(0.16, 0.30)
    return join([mesh, ellipsoid((size, 0.19, 0.30), (-0.07 - size * 0.8, 0, 0.68 * h), bag, 8, 6)])


def person_umbrella(g, rng):
    h = _adult(g)
    mesh = make_person(g, rng, h, rng.uniform(0.1, 0.4), arms="phone")
    cloth = Surface(PEDESTRIAN, "cloth", draw_colour("cloth", rng))
    r, z = g.uniform(0.45, 0.60), h + 0.05
    canopy = revolve(np.array([[r, z], [0.75 * r, z + 0.14], [0.02, z + 0.24]]), cloth, 10, (0.1, 0.12, 0), caps=False)
    stick = tube(np.array([[0.1, 0.12, 0.6 * h], [0.1, 0.12, z + 0.25]]), 0.012, Surface(PEDESTRIAN, "metal", DARK), 4)
    return join([mesh, canopy, stick])


def person_child(g, rng):
    """A child with a large head and a satchel, often with arms spread."""
    h = g.uniform(1.0, 1.35)
    mesh = make_person(g, rng, h, rng.uniform(0.1, 0.5), girth=g.uniform(1.0, 1.2), arms="wide" if g.random() < 0.6 else "phone")
    head = mesh.vertices[:, 2] > 0.865 * h
    mesh.vertices[head] = (mesh.vertices[head] - [0, 0, 0.865 * h]) * [1.35, 1.35, 1.3] + [0, 0, 0.865 * h]
    satchel = box(
        (-0.34 * h, -0.12 * h, 0.55 * h), (-0.06 * h, 0.12 * h, 0.80 * h), Surface(PEDESTRIAN, "cloth", draw_colour("cloth", rng))
    )
    return join([mesh, satchel])


def person_with_pram(g, rng):
    mesh = transform(make_person(g, rng, _adult(g), rng.uniform(0.2, 0.45), arms="forward"), position=(-0.45, 0, 0))
    cloth, bar = Surface(PEDESTRIAN, "cloth", draw_colour("cloth", rng)), Surface(PEDESTRIAN, "metal", DARK)
    hood = g.uniform(0.2, 0.32)
    parts = [
        mesh,
        ellipsoid((0.38, 0.22, 0.20), (0.42, 0, 0.68), cloth, 10, 6),
        ellipsoid((hood, 0.23, hood), (0.28, 0, 0.86), cloth, 10, 6),
        tube(np.array([[0.70, 0, 0.15], [0.05, 0, 0.95], [-0.1, 0, 1.02]]), 0.015, bar, 5),
    ]
    for x in (0.15, 0.70):
        for y in (-0.22, 0.22):
            parts.append(tube(np.array([[x, y - 0.02, 0.14], [x, y + 0.02, 0.14]]), 0.14, Surface(PEDESTRIAN, "rubber", RUBBER), 10))
    return join(parts)


def _dog(g, rng) -> Mesh:
    fur = Surface(PEDESTRIAN, "hair", draw_colour("hair", rng))
    s = g.uniform(0.7, 1.3)
    parts = [ellipsoid((0.30, 0.10, 0.12), (0, 0, 0.42), fur, 8, 5), ellipsoid((0.13, 0.08, 0.09), (0.36, 0, 0.56), fur, 7, 4)]
    parts += [tube(np.array([[x, y, 0.4], [x + 0.02, y, 0.0]]), 0.03, fur, 5) for x in (-0.22, 0.2) for y in (-0.07, 0.07)]
    return transform(join(parts), scale=s)


def person_with_dog(g, rng):
    return join([make_person(g, rng, _adult(g), rng.uniform(0.1, 0.4)), transform(_dog(g, rng), position=(0.75, -0.45, 0))])


def person_sitting(g, rng):
    return make_person(g, rng, _adult(g), sit=True, girth=g.uniform(0.95, 1.3))


def make_bicycle(g: Generator, rng: Generator, label: int) -> Mesh:
    """A bicycle along x, wheels on the ground."""
    r, base = g.uniform(0.31, 0.35), g.uniform(0.50, 0.56)
    frame, tyre = Surface(label, "painted_metal", draw_colour("cloth", rng)), Surface(label, "rubber", RUBBER)
    angle = np.linspace(0, 2 * np.pi, 15)
    parts = []
    for x in (-base, base):
        parts.append(tube(np.stack([x + r * np.cos(angle), 0 * angle, r + r * np.sin(angle)], 1), 0.022, tyre, 5, caps=False))
        spokes = np.linspace(0, np.pi, 5, endpoint=False)
        parts += [
            tube(
                np.array([[x - r * np.cos(a), 0, r - r * np.sin(a)], [x + r * np.cos(a), 0, r + r * np.sin(a)]]),
                0.005,
                frame,
                3,
                caps=False,
            )
            for a in spokes
        ]
    crank, seat, head = (
        np.array([-0.05, 0, 0.30]),
        np.array([-0.22, 0, g.uniform(0.82, 0.95)]),
        np.array([0.38, 0, g.uniform(0.78, 0.92)]),
    )
    for a, b in (
        (crank, seat),
        (crank, head),
        (seat * [1, 1, 0.9], head),
        ((-base, 0, r), crank),
        ((-base, 0, r), seat * [1, 1, 0.9]),
        ((base, 0, r), head + np.array([0, 0, 0.15])),
    ):
        parts.append(tube(np.array([a, b]), 0.018, frame, 5))
    parts.append(tube(np.array([[0.36, -0.29, 1.0], [0.40, 0, 1.03], [0.36, 0.29, 1.0]]), 0.016, Surface(label, "metal", DARK), 5))
    parts.append(box((-0.34, -0.07, seat[2]), (-0.10, 0.07, seat[2] + 0.06), Surface(label, "rubber", DARK)))
    if g.random() < 0.5:
        parts.append(box((0.42, -0.17, 0.8), (0.70, 0.17, 1.02), Surface(label, "wood", (120, 90, 60))))
    return join(parts)


def cyclist(g, rng):
    h = g.uniform(1.6, 1.88)
    rider = transform(make_person(g, rng, h, rng.uniform(0.3, 0.6), arms="forward"), position=(-0.18, 0, 0.40), scale=(1, 1, 0.95))
    return join([make_bicycle(g, rng, PEDESTRIAN), rider])


def scooter_rider(g, rng):
    rider = transform(make_person(g, rng, _adult(g), 0.15, arms="forward"), position=(-0.1, 0, 0.14))
    bar = Surface(PEDESTRIAN, "metal", DARK)
    parts = [
        box((-0.45, -0.08, 0.08), (0.4, 0.08, 0.14), bar),
        tube(np.array([[0.42, 0, 0.1], [0.32, 0, 1.1]]), 0.025, bar, 6),
        tube(np.array([[0.32, -0.25, 1.1], [0.32, 0.25, 1.1]]), 0.018, bar, 5),
    ]
    parts += [tube(np.array([[x, -0.03, 0.1], [x, 0.03, 0.1]]), 0.1, Surface(PEDESTRIAN, "rubber", RUBBER), 10) for x in (-0.45, 0.45)]
    return join([rider, *parts])
