"""The plan of one block of a street: its zones, its houses, and what stands where.

Places are in street coordinates (`streetscan.simulation.terrain`). A plan holds no meshes, so that the plan of a
neighbouring block costs little. Objects stand close together, as in a real street, but not in one another: each keeps
the rectangle it covers, except where something is meant to stand in something else (a sign in a hedge).
"""

import zlib
from dataclasses import dataclass, field

import numpy as np

from streetscan.simulation import shapes, terrain
from streetscan.simulation.terrain import KERB_HEIGHT_M, SIDEWALK_M, Zone

HOUSE_DEPTH_M = 12.0


@dataclass(frozen=True)
class Item:
    """An object of the plan: what, where (street coordinates), turned how from the axis, and the seeds of its shape."""

    name: str
    s: float
    t: float
    h: float
    turn_rad: float
    design: int
    seed: int


@dataclass(frozen=True)
class House:
    """A house or garden wall: the middle of its front, its size, and which of its sides show."""

    s: float
    t: float
    turn_rad: float
    width: float
    sides: tuple[bool, bool]
    seed: int
    is_wall: bool = False


# fmt: off

# What stands along the kerb, along the houses and on squares; a name may occur twice to be drawn more often.
_AT_KERB = (
    "sign_single", "sign_stack", "sign_single", "switch_box", "litter_bin", "wheeled_bin", "hydrant", "mail_box", "parking_meter",
    "bench", "planter", "motorcycle", "parked_bicycle", "advert_panel", "hedge", "bush", "bicycle_rack", "telephone_booth",
    "advert_column", "guard_rail", "camera_pole", "traffic_light", "barrier", "scaffold_tower", "utility_pole", "flag_pole",
    "sign_direction",
)
_AT_WALL = (
    "wheeled_bin", "litter_bin", "planter", "parked_bicycle", "person_standing", "person_standing", "person_coat", "bench", "cafe_set",
    "shrub_grass", "bush", "stone_bench", "mail_box", "advert_panel", "switch_box", "ivy", "ivy", "motorcycle", "scaffold_tower",
    "container", "lamp_globe", "flag_pole",
)
_ON_SQUARE = (
    "kiosk", "market_stall", "market_stall", "cafe_set", "cafe_set", "cafe_set", "bench", "stone_bench", "advert_column", "planter",
    "bicycle_rack", "litter_bin", "lamp_globe", "lamp_classic", "lime", "round_tree", "low_branching_tree", "delivery_van", "bush",
    "telephone_booth", "flag_pole", "statue", "parked_bicycle", "hydrant", "barrier", "motorcycle", "stone_bollard",
)
# fmt: on


@dataclass
class Plan:
    """One block: zones, crossings and everything that stands in it."""

    s0: float
    s1: float
    split: str
    rng: np.random.Generator
    zones: list[Zone] = field(default_factory=list)
    crossings: list[float] = field(default_factory=list)
    items: list[Item] = field(default_factory=list)
    houses: list[House] = field(default_factory=list)
    pits: list[tuple[float, float]] = field(default_factory=list)
    stops: list[tuple[int, float]] = field(default_factory=list)  # side and s of the stops of buses and trams
    taken: list[tuple[float, float, float, float]] = field(default_factory=list)

    def add(self, name: str, s: float, t: float, h: float, turn: float = 0.0, gap: float = 0.05, force: bool = False) -> bool:
        """Put an object down unless its place is taken or outside the block; says whether it stands."""
        a, b = shapes.HALF_SIZES_M.get(name, (0.35, 0.35))
        c, n = abs(np.cos(turn)), abs(np.sin(turn))
        ds, dt = c * a + n * b, n * a + c * b
        design, seed = shapes.draw_design(self.split, self.rng), int(self.rng.integers(2**62))
        if s - ds < self.s0 or s + ds > self.s1:
            return False
        box = (s - ds, s + ds, t - dt, t + dt)
        if not force and self.taken:
            # What touches at exactly the gap has room, whatever rounding makes of it.
            k, gap = np.array(self.taken), gap - 1e-9
            if ((k[:, 0] < box[1] + gap) & (k[:, 1] > box[0] - gap) & (k[:, 2] < box[3] + gap) & (k[:, 3] > box[2] - gap)).any():
                return False
        self.taken.append(box)
        self.items.append(Item(name, float(s), float(t), float(h), float(turn), design, seed))
        return True

    def pick(self, *names):
        """One of the arguments."""
        return names[self.rng.integers(len(names))]

    def chance(self, p: float) -> bool:
        """True with probability p."""
        return bool(self.rng.random() < p)

    def between(self, low: float, high: float) -> float:
        """A uniform draw."""
        return float(self.rng.uniform(low, high))


def _toward_road(side: int) -> float:
    """Turn of an object whose +y (arm, seat) shall point to the road."""
    return np.pi if side > 0 else 0.0


def _zones(plan: Plan, is_inner: bool, is_only: bool) -> None:
    """Divide the block; `is_only`: it must hold every kind of place."""
    s0, s1, rng = plan.s0, plan.s1, plan.rng
    length = s1 - s0
    if not is_inner:
        plan.zones = [Zone(s0, s1, "buildings", "buildings")]
        return
    if length < 60:
        # Too short for a crossroads: houses and, on one side, the edge of a park.
        cut = s0 + 0.55 * length
        plan.zones = [
            Zone(s0, cut, "buildings", "buildings"),
            Zone(cut, s1, *(("buildings", "park") if plan.chance(0.5) else ("park", "buildings"))),
        ]
        return
    crossing = s0 + length * plan.between(0.28, 0.36)
    plan.crossings = [crossing]
    edge = terrain.CROSS_EDGE_M
    bridge = s1 - length * (plan.between(0.13, 0.17) if is_only or plan.chance(0.35) else 0.0)
    first = "square" if is_only or plan.chance(0.5) else plan.pick("park", "buildings")
    second = "park" if is_only or plan.chance(0.5) else "buildings"
    middle = (crossing + edge) + (bridge - crossing - edge) * plan.between(0.48, 0.56)
    sides = [int(rng.choice([-1, 1])) for _ in range(2)]
    plan.zones = [
        Zone(s0, crossing, "buildings", "buildings"),
        Zone(crossing, middle, *((first, "buildings") if sides[0] > 0 else ("buildings", first))),
        Zone(middle, bridge, *((second, "buildings") if sides[1] > 0 else ("buildings", second))),
    ]
    if bridge < s1:
        plan.zones.append(Zone(bridge, s1, "bridge", "bridge"))


def _clear_of_crossings(plan: Plan, s: float, margin: float) -> bool:
    return all(abs(s - c) > margin for c in plan.crossings)


def _houses(plan: Plan) -> None:
    """Rows of houses along the building line, and along the cross streets."""
    edge = terrain.CROSS_EDGE_M
    for side in (-1, 1):
        # Neighbouring zones of houses join to one row.
        rows: list[list[float]] = []
        for zone in plan.zones:
            if zone.side(side) == "buildings":
                if rows and abs(rows[-1][1] - zone.s0) < 1e-6 and zone.s0 not in plan.crossings:
                    rows[-1][1] = zone.s1
                else:
                    rows.append([zone.s0, zone.s1])
        for a, b in rows:
            starts_at_corner, ends_at_corner = a in plan.crossings, b in plan.crossings
            a, b = a + edge * starts_at_corner, b - edge * ends_at_corner
            _row_of_houses(
                plan, a, b, side * SIDEWALK_M, 0.0 if side > 0 else np.pi, (starts_at_corner or a > plan.s0, ends_at_corner or b < plan.s1)
            )
        for zone in plan.zones:
            # A square is closed by houses at its far side.
            if zone.side(side) == "square":
                a = zone.s0 + edge * (zone.s0 in plan.crossings)
                _row_of_houses(plan, a, zone.s1, side * (terrain.GROUND_M - HOUSE_DEPTH_M - 1), 0.0 if side > 0 else np.pi, (True, True))
    for c in plan.crossings:
        before = next(z for z in plan.zones if z.s1 == c)
        after = next(z for z in plan.zones if z.s0 == c)
        for side in (-1, 1):
            for zone, s, turn in ((before, c - edge, np.pi / 2), (after, c + edge, -np.pi / 2)):
                if zone.side(side) == "buildings":
                    _cross_row(plan, s, side, turn)


def _row_of_houses(plan: Plan, a: float, b: float, t: float, turn: float, ends: tuple[bool, bool]) -> None:
    """Houses side by side from s = a to b with their fronts at t."""
    s, is_first = a, True
    while b - s > 3.0:
        width = plan.between(9.0, 16.0)
        if b - s - width < 7.0:
            width = b - s if b - s <= 18.0 else (b - s) / 2
        if plan.chance(0.12) and not is_first and b - s - 4.0 > 9.0:
            gap = plan.between(3.2, 4.0)
            plan.houses.append(House(s + gap / 2, t, turn, gap, (True, True), int(plan.rng.integers(2**62)), True))
            s += gap
            continue
        low, high = is_first and ends[0], s + width >= b - 1e-6 and ends[1]
        sides = (low, high) if turn == 0.0 else (high, low)
        setback = plan.between(0.0, 0.35) * np.sign(t)
        plan.houses.append(House(s + width / 2, t + setback, turn, width, sides, int(plan.rng.integers(2**62))))
        s, is_first = s + width, False


def _cross_row(plan: Plan, s: float, side: int, turn: float) -> None:
    """Houses along a cross street, their fronts at s, behind the corner house."""
    t, end = SIDEWALK_M + HOUSE_DEPTH_M + 0.4, terrain.GROUND_M - 2
    while end - t > 7:
        width = min(plan.between(9.0, 14.0), end - t)
        plan.houses.append(House(s, side * (t + width / 2), turn, width, (False, False), int(plan.rng.integers(2**62))))
        t += width


def _parked_vehicles(plan: Plan, density: float) -> None:
    """The parking lane: mostly cars, close together; a stop of buses and trams with its shelter."""
    length = plan.s1 - plan.s0
    for side in (-1, 1):
        heading = 0.0 if side < 0 else np.pi
        middle = side * (terrain.PARKING_M[0] + terrain.PARKING_M[1]) / 2
        s = plan.s0 + plan.between(0.3, 1.5)
        stop = plan.s0 + length * (plan.between(0.60, 0.72) if side < 0 else plan.between(0.70, 0.82))
        bus = plan.pick(*shapes.BUSES[:4]) if length > 60 or side > 0 else plan.pick("midi_bus", "city_bus")
        if length > 26:
            if side > 0 or length > 60 or plan.chance(0.5):
                plan.add(bus, stop, middle + side * 0.1, 0.0, heading, force=True)
            plan.stops.append((side, stop))
            shelter = stop + plan.between(-1.5, 1.5)
            if plan.add("bus_shelter", shelter, side * 10.7, KERB_HEIGHT_M, _toward_road(side)):
                for place in (-1.2, -0.1, 1.0):
                    if plan.chance(0.6):
                        s_inside = shelter + place + plan.between(-0.2, 0.2)
                        plan.add(plan.pick(*shapes.STANDERS), s_inside, side * 10.35, KERB_HEIGHT_M, plan.between(-3, 3), force=True)
            plan.add("sign_single", stop + np.cos(heading) * 4.5, side * 10.0, KERB_HEIGHT_M, heading)
            # Those who find the shelter's place taken wait before and behind it.
            for _ in range(plan.rng.integers(4, 9)):
                plan.add(
                    plan.pick(*shapes.STANDERS),
                    stop + plan.between(-6.5, 6.5),
                    side * plan.between(9.8, 11.3),
                    KERB_HEIGHT_M,
                    plan.between(-3, 3),
                )
        while s < plan.s1:
            in_bridge = any(z.side(side) == "bridge" and z.s0 - 2 < s < z.s1 for z in plan.zones)
            name = plan.pick(*shapes.SEDANS, *shapes.SEDANS, *shapes.SEDANS, *shapes.VANS, "box_truck")
            half = shapes.HALF_SIZES_M[name][0]
            s += half
            if not in_bridge and _clear_of_crossings(plan, s, 14.5 + half) and plan.chance(0.85 * min(1.0, density)):
                turned = heading + (np.pi if plan.chance(0.12) else 0.0) + plan.rng.normal(0, 0.015)
                stands = plan.add(name, s, middle + plan.rng.normal(0, 0.08), 0.0, turned, gap=0.3)
                if stands and plan.chance(0.3):
                    # Someone at the car's door, on the kerb.
                    plan.add(
                        plan.pick("person_standing", "person_coat"),
                        s + plan.between(-1, 1),
                        side * 9.75,
                        KERB_HEIGHT_M,
                        plan.between(-3, 3),
                    )
            elif plan.chance(0.35) and _clear_of_crossings(plan, s, 14.5):
                plan.add(plan.pick("motorcycle", "container", "bicycle_rack", "planter", "barrier"), s, middle + side * 0.4, 0.0, np.pi / 2)
            s += half + plan.between(0.35, 1.1)


def _sidewalk(plan: Plan, clutter: float) -> None:
    """The strip between kerb and walkers (trees, poles, furniture) and the strip along the houses."""
    for side in (-1, 1):
        road = _toward_road(side)
        with_traffic = 0.0 if side < 0 else np.pi
        lamp = plan.pick(*shapes.LAMPS[:3])
        tree = plan.pick(*shapes.TREES)
        s, k = plan.s0 + plan.between(0.8, 3.0), 0
        while s < plan.s1 - 0.5:
            kind = next((z.side(side) for z in plan.zones if z.s0 <= s < z.s1), "buildings")
            free = _clear_of_crossings(plan, s, 12.8)
            if not free:
                s += 1.0
                continue
            if k % 4 == 0:
                name = "catenary_pole" if plan.chance(0.4) else lamp
                if plan.add(name, s, side * plan.between(9.8, 10.1), KERB_HEIGHT_M, road) and plan.chance(0.45):
                    beside = plan.pick("hung_bin", "litter_bin", "parked_bicycle", "person_standing", "sign_single", "bush")
                    plan.add(
                        beside, s + plan.between(0.3, 0.6), side * plan.between(10.0, 10.5), KERB_HEIGHT_M, plan.between(-3, 3), gap=-0.15
                    )
            elif k % 4 == 2 and kind != "bridge":
                name = tree if plan.chance(0.7) else plan.pick(*shapes.TREES)
                t = side * plan.between(10.1, 10.7)
                if plan.add(name, s, t, 0.05, plan.between(-3, 3)):
                    plan.pits.append((s, t))
                    if plan.chance(0.35):
                        plan.add(
                            plan.pick("shrub_grass", "bush", "parked_bicycle", "person_standing"),
                            s + plan.between(-0.9, 0.9),
                            t + plan.between(-0.5, 0.2) * side,
                            0.08,
                            plan.between(-3, 3),
                            gap=-0.3,
                        )
            else:
                name = plan.pick(*_AT_KERB)
                turn = with_traffic if name.startswith(("sign", "traffic", "parked", "motor")) else road
                plan.add(name, s, side * plan.between(9.95, 10.9), KERB_HEIGHT_M, turn + plan.rng.normal(0, 0.08))
                if name == "hedge" and plan.chance(0.6):
                    plan.add(
                        plan.pick("sign_single", "lamp_globe", "bollard"),
                        s + plan.between(-1, 1),
                        side * 10.3,
                        KERB_HEIGHT_M,
                        with_traffic,
                        force=True,
                    )
                if plan.chance(0.5 * clutter):
                    plan.add(
                        plan.pick("bollard", "stone_bollard", "cone", "hung_bin", "bush", "sign_single"),
                        s + plan.between(0.8, 1.6),
                        side * plan.between(9.75, 10.9),
                        KERB_HEIGHT_M,
                        with_traffic,
                    )
            s += plan.between(1.6, 2.9) / clutter
            k += 1
        # Along the houses.
        s = plan.s0 + plan.between(0.5, 2.0)
        while s < plan.s1 - 0.5:
            kind = next((z.side(side) for z in plan.zones if z.s0 <= s < z.s1), "buildings")
            if kind == "buildings" and _clear_of_crossings(plan, s, terrain.CROSS_EDGE_M + 0.5):
                name = plan.pick(*_AT_WALL)
                turn = (
                    road
                    if name in ("bench", "ivy", "advert_panel", "switch_box", "mail_box")
                    else plan.pick(0.0, np.pi) + plan.rng.normal(0, 0.1)
                )
                t = SIDEWALK_M - 0.12 if name == "ivy" else SIDEWALK_M - 0.12 - shapes.HALF_SIZES_M.get(name, (0.3, 0.3))[1]
                plan.add(name, s, side * t, KERB_HEIGHT_M, turn)
            s += plan.between(1.5, 4.5) / clutter


def _crossroads(plan: Plan) -> None:
    """Lights, signs, bollards and waiting people at the corners; parked cars and poles in the cross street."""
    edge = terrain.CROSS_EDGE_M
    for c in plan.crossings:
        for end in (-1, 1):
            for side in (-1, 1):
                # Who comes along the street from smaller s (end -1) drives at negative t.
                turn = 0.0 if end < 0 else np.pi
                s = c + end * (edge + 5.0)
                name = "traffic_light_mast" if side == end else "traffic_light"
                plan.add(name, s, side * 9.85, KERB_HEIGHT_M, turn if side < 0 or name == "traffic_light" else turn + 0.0, force=True)
                plan.add(
                    plan.pick("sign_stack", "sign_direction", "camera_pole", "switch_box"),
                    c + end * (edge + 6.2),
                    side * plan.between(10.0, 11.0),
                    KERB_HEIGHT_M,
                    turn,
                )
                plan.add("traffic_light", c + end * (edge - 0.7), side * 10.3, KERB_HEIGHT_M, side * -np.pi / 2)
                for k in range(4):
                    plan.add("bollard", c + end * (edge + 0.35), side * (10.0 + 0.45 * k), KERB_HEIGHT_M)
                if plan.chance(0.6):
                    plan.add(
                        plan.pick("advert_column", "telephone_booth", "litter_bin", "mail_box"),
                        c + end * (edge + 7.6),
                        side * 10.9,
                        KERB_HEIGHT_M,
                        _toward_road(side),
                    )
        for side in (-1, 1):
            t = 18.0
            while t < terrain.GROUND_M - 4:
                if plan.chance(0.8):
                    name = plan.pick(*shapes.SEDANS, "delivery_van")
                    plan.add(name, c + 4.4, side * (t + 2.6), 0.0, side * plan.pick(-np.pi / 2, np.pi / 2), gap=0.2)
                if plan.chance(0.7):
                    name = plan.pick(
                        "lamp_classic",
                        "sign_single",
                        "sign_stack",
                        "bollard",
                        "parking_meter",
                        "litter_bin",
                        "person_standing",
                        "parked_bicycle",
                        "wheeled_bin",
                    )
                    plan.add(name, c - plan.between(3.75, 4.2), side * (t + plan.between(0, 4)), KERB_HEIGHT_M, np.pi / 2)
                if plan.chance(0.6):
                    name = plan.pick("bollard", "sign_single", "round_tree", "hung_bin", "person_standing", "planter")
                    plan.add(name, c + plan.between(5.6, 5.8), side * (t + plan.between(0, 4)), KERB_HEIGHT_M, np.pi / 2)
                t += plan.between(5.2, 6.4)


def _group(plan: Plan, s: float, t: float, h: float, n: int) -> None:
    """People who stand together and face one another, as far as their places are free."""
    start = plan.between(0, 2 * np.pi)
    for i in range(n):
        a = start + 2 * np.pi * i / n
        r = plan.between(0.40, 0.6)
        plan.add(plan.pick(*shapes.STANDERS), s + r * np.cos(a), t + r * np.sin(a), h, a + np.pi + plan.rng.normal(0, 0.3), gap=-0.25)


def _square(plan: Plan, zone: Zone, side: int) -> None:
    """Kiosks, stalls, cafés, a fountain, benches under trees, groups of people, a tram at its terminus."""
    s0 = zone.s0 + (terrain.CROSS_EDGE_M if zone.s0 in plan.crossings else 0)
    h, middle = KERB_HEIGHT_M, (s0 + zone.s1) / 2
    tram = plan.pick("tram_pair", "tram_low_floor") if zone.s1 - s0 > 29 else "tram_classic"
    plan.add(tram, middle + plan.between(-0.5, 0.5), side * 17.2, h, 0.0)
    plan.add(plan.pick("fountain", "statue"), middle + plan.between(-2, 2), side * 31.0, h)
    for t in np.arange(s0 + 1, zone.s1, 1.6):
        plan.add("bollard", t, side * (SIDEWALK_M + 0.3), h)
    # A kiosk is the widest thing here and would hardly find a place later.
    plan.add("kiosk", plan.between(s0 + 2, zone.s1 - 2), side * plan.between(20.5, 25.0), h, _toward_road(side))
    for _ in range(int((zone.s1 - s0) * 1.6)):
        name = plan.pick(*_ON_SQUARE)
        s, t = plan.between(s0, zone.s1), side * plan.between(19.5, 42.0)
        stands = plan.add(name, s, t, h, plan.pick(0.0, np.pi / 2, np.pi, -np.pi / 2) + plan.rng.normal(0, 0.05), gap=0.15)
        if stands and name in ("lime", "round_tree"):
            plan.pits.append((s, t))
        if stands and name in ("bench", "kiosk", "market_stall", "advert_column") and plan.chance(0.6):
            plan.add(plan.pick(*shapes.STANDERS), s + plan.between(-2, 2), t + plan.between(-2, 2), h, plan.between(-3, 3))
    for _ in range(int((zone.s1 - s0) / 4)):
        _group(plan, plan.between(s0, zone.s1), side * plan.between(15.5, 40.0), h, int(plan.rng.integers(1, 5)))


def _park(plan: Plan, zone: Zone, side: int) -> None:
    """A hedge or fence at the edge, trees, bushes, benches along the path, people."""
    s0 = zone.s0 + (terrain.CROSS_EDGE_M if zone.s0 in plan.crossings else 0)
    h, middle = KERB_HEIGHT_M + 0.04, (zone.s0 + zone.s1) / 2
    s = s0 + 2.3
    border = plan.pick("hedge", "iron_fence", "wooden_fence", "hedge")
    while s < zone.s1 - 2:
        if abs(s - middle) > 3.4:
            plan.add(border if plan.chance(0.85) else plan.pick("hedge", "iron_fence"), s, side * (SIDEWALK_M + 0.75), h, 0.0, force=True)
            if plan.chance(0.4):
                plan.add(
                    plan.pick("lamp_classic", "sign_single", "utility_pole", "bollard"),
                    s + plan.between(-1, 1),
                    side * (SIDEWALK_M + 0.8),
                    h,
                    0.0,
                    force=True,
                )
        s += 4.3
    for _ in range(int((zone.s1 - s0) * 0.9)):
        name = plan.pick(*shapes.TREES)
        plan.add(name, plan.between(s0, zone.s1), side * plan.between(SIDEWALK_M + 2.3, 52.0), h, plan.between(-3, 3), gap=1.2)
    for _ in range(int((zone.s1 - s0) * 0.8)):
        name = plan.pick(
            "bush",
            "bush",
            "bush",
            "shrub_grass",
            "hedge",
            "lamp_globe",
            "statue",
            "switch_box",
            "litter_bin",
            "stone_bollard",
            "person_standing",
        )
        t = plan.between(SIDEWALK_M + 1.4, 45.0)
        if not SIDEWALK_M + 5.8 < t < SIDEWALK_M + 8.4:
            plan.add(name, plan.between(s0, zone.s1), side * t, h, plan.between(-3, 3), gap=-0.1)
    for s in np.arange(s0 + 2, zone.s1 - 1, plan.between(4.0, 6.5)):
        turn = _toward_road(-side)
        t = side * (SIDEWALK_M + 5.6)
        if plan.add(plan.pick("bench", "bench", "stone_bench"), s, t, h, turn) and plan.chance(0.6):
            plan.add("person_sitting", s + plan.between(-0.4, 0.4), t - 0.02 * side, h, turn + np.pi / 2, force=True)
        plan.add(plan.pick("litter_bin", "lamp_globe", "person_standing"), s + 1.7, t + 0.1 * side, h)
    for _ in range(int((zone.s1 - s0) / 8)):
        _group(plan, plan.between(s0, zone.s1), side * plan.between(SIDEWALK_M + 6.3, SIDEWALK_M + 8), h, int(plan.rng.integers(1, 4)))


def _bridge(plan: Plan, zone: Zone, side: int) -> None:
    s = zone.s0 + 2.0
    while s + 2.0 <= zone.s1 + 1e-6:
        plan.add("bridge_railing", s, side * (terrain.BRIDGE_EDGE_M - 0.22), KERB_HEIGHT_M + 0.18, 0.0, force=True)
        s += 4.0
    for _ in range(3):
        plan.add(plan.pick(*shapes.STANDERS), plan.between(zone.s0, zone.s1), side * 11.6, KERB_HEIGHT_M, side * np.pi / 2)


def _every_class(plan: Plan) -> None:
    """A short street still has what a long one has by chance: people, poles, bins, a tree and a bush."""
    for side in (-1, 1):
        for _ in range(14):
            place = plan.between(plan.s0 + 2, plan.s1 - 2), side * plan.between(9.8, 11.3)
            _group(plan, *place, KERB_HEIGHT_M, int(plan.rng.integers(2, 5)))
        for name in ("lamp_arm", "sign_single", "litter_bin", "bush", "round_tree", "bollard", "switch_box", "bench"):
            for _ in range(6):
                if plan.add(
                    name, plan.between(plan.s0 + 1, plan.s1 - 1), side * plan.between(9.9, 11.0), KERB_HEIGHT_M, _toward_road(side)
                ):
                    break


def plan_block(
    number: int, s0: float, s1: float, is_inner: bool, is_only: bool, split: str, seed: int, clutter: float, n_pedestrians: float
) -> Plan:
    """The plan of block `number` (-1 and n are the margins beyond the street's ends) from s0 to s1.

    Args:
        is_inner: not a margin.
        is_only: the street's only block, which must hold every kind of place.
        split, seed: whose designs, and the city.
        clutter: how closely furniture stands; 1 is a European main street.
        n_pedestrians: per 100 m; half of them stand.
    """
    rng = np.random.default_rng([seed, zlib.crc32(split.encode()), 11, number + 1])
    plan = Plan(s0, s1, split, rng)
    _zones(plan, is_inner, is_only)
    _houses(plan)
    _crossroads(plan)
    _parked_vehicles(plan, 1.0)
    for zone in plan.zones:
        for side in (-1, 1):
            {"square": _square, "park": _park, "bridge": _bridge}.get(zone.side(side), lambda *_: None)(plan, zone, side)
    if is_inner and s1 - s0 < 60:
        _every_class(plan)
    _sidewalk(plan, clutter)
    if is_inner:
        # Half of the people stand, two to a group; about half of the tries find a free place.
        for _ in range(round(n_pedestrians * (s1 - s0) / 100 / 2)):
            s = plan.between(s0 + 1, s1 - 1)
            side = plan.pick(-1, 1)
            by_houses = next(z.side(side) for z in plan.zones if z.s0 <= s <= z.s1) == "buildings" and plan.chance(0.5)
            if _clear_of_crossings(plan, s, terrain.CROSS_EDGE_M):
                _group(plan, s, side * (13.5 if by_houses else plan.between(9.9, 11.2)), KERB_HEIGHT_M, int(plan.rng.integers(1, 4)))
    return plan
