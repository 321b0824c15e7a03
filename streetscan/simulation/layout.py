"""The simulated street: what stands where, and the traffic on it.

A street is a row of blocks of some 120 m. Each block has its own seed, so that one block of a street of kilometres can
be built without the others: the block, and a margin of its neighbours, which come out the same whichever of the blocks
is asked for. A block holds a main road with a tram, a crossroads with a narrow street, houses, a square, the edge of a
park and a bridge; a street shorter than 60 m is one block of houses and a park, with something of every class.

The three splits of a city are three streets. They share no object: designs come from disjoint ranges
(`streetscan.simulation.shapes.DESIGNS`), and houses, colours and places from the split's own seed.

Source: Nagy (2020), 2.1-2.5: both directions of two-way roads at 30-50 km/h, main roads with heavy traffic, squares,
parks, sidewalks, more than 50 m of elevation difference, nine classes.
"""

import zlib

import numpy as np

from streetscan.classes import FURNITURE, UNLABELLED
from streetscan.errors import BadInput
from streetscan.simulation import actors as traffic
from streetscan.simulation import buildings, shapes, terrain
from streetscan.simulation.blocks import HOUSE_DEPTH_M, House, Item, Plan, plan_block
from streetscan.simulation.changes import Change, Day, change_block, dress
from streetscan.simulation.meshes import Surface, join, transform, tube, with_instances
from streetscan.simulation.scene import Actor, Mesh, Scene
from streetscan.simulation.terrain import KERB_HEIGHT_M, KERB_M, SIDEWALK_M, Axis

# Of everything in streetscan.simulation that shapes a map: geometry, traffic, materials, scanner. A change of any of it raises
# the version and re-opens every number made with the city. 1: of the first networks. 2: bus stops have shelters and signs, squares
# a kiosk; each split's drives have errors and noise of their own.
GENERATOR_VERSION = 2

BLOCK_M = 120.0
MARGIN_M = 25.0
CROSS_STREET_M = 42.0  # how far the mapping vehicle follows a cross street to either side
CITY_CRS = "EPSG:23700"
CITY_ORIGIN = (650_000.0, 240_000.0, 110.0)
# Instance ids: split, then block, then object.
_PER_SPLIT, _PER_BLOCK, _ITEMS, _ACTORS = 1_000_000_000, 100_000, 1000, 40_000
_SPLIT_NUMBERS = {"train": 0, "validation": 1, "test": 2, "all": 3}
_CYCLE_S = 40.0  # of the traffic lights
# The main road gets green about when the recording begins: its first drive meets traffic that moves, the second a queue.
_PHASE_S = (-8.0, 4.0)
_WIRE = Surface(UNLABELLED, "metal", (60, 60, 60))


def _house_mesh(axis: Axis, house: House) -> Mesh:
    rng = np.random.default_rng(house.seed)
    if house.is_wall:
        mesh = buildings.make_garden_wall(house.width, rng)
    else:
        mesh = buildings.make_building(house.width, HOUSE_DEPTH_M, house.sides, rng)
    mesh = transform(mesh, position=(-house.width / 2, 0, 0))
    return transform(mesh, float(axis.yaw_at(house.s)) + house.turn_rad, axis.to_map(house.s, house.t, KERB_HEIGHT_M)[0])


def _item_mesh(axis: Axis, item: Item, day: Day | None) -> Mesh:
    mesh = shapes.make_object(item.name, item.design, np.random.default_rng(item.seed))
    if day is not None:
        mesh = dress(mesh, item.name, day.season, np.random.default_rng([item.seed, day.number]))
    # Vehicles and what is long lies on the slope; poles, people and trees stand upright.
    lies = item.name in shapes.BASE_SHAPES["car"] + shapes.BASE_SHAPES["tram_bus"] + shapes.BASE_SHAPES["furniture"] + shapes.SHRUBS
    slope = axis.slope_at(item.s, item.t, item.turn_rad) if lies else (0.0, 0.0)
    return transform(mesh, float(axis.yaw_at(item.s)) + item.turn_rad, axis.to_map(item.s, item.t, item.h)[0], slope=slope)


def _wires(axis: Axis, s0: float, s1: float, plans: list[Plan]) -> list[Mesh]:
    """The tram's contact wires with their span wires, and cables across the street.

    ASSUME: no class of the thesis describes a wire; it is unlabelled (255), which neither trains nor scores.
    """
    meshes = []
    along = np.arange(np.floor(s0 / 4) * 4, s1 + 4, 4.0)
    for t in (-terrain.OUTER_LANE_M, terrain.OUTER_LANE_M):
        sag = 0.04 * np.sin(np.pi * (along % 28.0) / 28.0)
        path = axis.to_map(along, np.full(len(along), t), 5.55 - sag)
        meshes.append(tube(path, 0.010, _WIRE, 3, caps=False))
    for s in np.arange(np.ceil(s0 / 28.0) * 28.0, s1, 28.0):
        t = np.linspace(-SIDEWALK_M, SIDEWALK_M, 13)
        sides = [next((z.side(sign) for p in plans for z in p.zones if z.s0 <= s < z.s1), "park") for sign in (-1, 1)]
        if all(kind == "buildings" for kind in sides) and all(abs(s - c) > 8 for p in plans for c in p.crossings):
            sag = 5.75 + 1.3 * (np.abs(t) / SIDEWALK_M) ** 2
            meshes.append(tube(axis.to_map(np.full(13, s), t, sag), 0.007, _WIRE, 3, caps=False))
    return meshes


def _lanes(
    axis: Axis, a: float, b: float, plans: list[Plan], traffic_density: float, n_pedestrians: float, seed: int
) -> list[tuple[traffic.Lane, tuple[float, float]]]:
    """All lanes between s = a and b, each with the stretch of it that counts."""
    rng = np.random.default_rng([seed, 12])
    phase = float(rng.uniform(*_PHASE_S))
    # The main road has green for 18 s; then the cross street for 10 s. Who walks starts early enough to be across in time.
    main, cross = traffic.Signal(_CYCLE_S, 18.0, phase), traffic.Signal(_CYCLE_S, 10.0, phase + 21.5)
    walk_along, walk_across = traffic.Signal(_CYCLE_S, 9.0, phase), traffic.Signal(_CYCLE_S, 3.0, phase + 21.0)
    crossings = [c for p in plans for c in p.crossings]
    cars = {n: 0.8 / len(shapes.SEDANS) for n in shapes.SEDANS} | {"delivery_van": 0.12, "minibus": 0.04, "pickup": 0.04}
    mixed = {n: 0.52 / len(shapes.SEDANS) for n in shapes.SEDANS} | {
        "delivery_van": 0.12,
        "minibus": 0.03,
        "box_truck": 0.06,
        "tipper": 0.03,
        "garbage_truck": 0.03,
    }
    mixed |= {n: 0.09 / len(shapes.BUSES) for n in shapes.BUSES} | {n: 0.12 / len(shapes.TRAMS) for n in shapes.TRAMS}
    people = dict.fromkeys(shapes.WALKERS, 1.0)
    lanes = []

    def along(t, sign):
        """A lane parallel to the axis; distances count in driving direction."""
        return lambda d: (sign * d, np.full_like(d, t), np.full_like(d, 0.0 if sign > 0 else np.pi))

    def across(s, sign):
        return lambda d: (np.full_like(d, s), sign * d, np.full_like(d, sign * np.pi / 2))

    def lights(signal, sign, places):
        return tuple((sign * c - terrain.CROSS_EDGE_M - 5.6, signal) for c in places if a - 60 < c < b + 60)

    for sign in (-1, 1):
        window = (a - 70, b + 70) if sign > 0 else (-b - 70, -a + 70)
        right = -sign  # right-hand traffic: with the axis at negative t
        stop = next((sign * s + 4 for p in plans for side, s in p.stops if side == right and a < s < b), None)
        common = {"start_m": window[0], "end_m": window[1]}
        density = max(traffic_density, 1e-3)
        lanes.append(
            (
                traffic.Lane(
                    along(right * terrain.LANE_M, sign),
                    **common,
                    names=cars,
                    speed_mps=(9.0, 13.0),
                    spacing_m=26 / density,
                    lights=lights(main, sign, crossings),
                    sideways_m=0.12,
                ),
                window,
            )
        )
        lanes.append(
            (
                traffic.Lane(
                    along(right * terrain.OUTER_LANE_M, sign),
                    **common,
                    names=mixed,
                    speed_mps=(6.0, 10.5),
                    spacing_m=11 / density,
                    lights=lights(main, sign, crossings),
                    stop_m=stop,
                    sideways_m=0.0,
                ),
                window,
            )
        )
        lanes.append(
            (
                traffic.Lane(
                    along(right * terrain.BICYCLE_LANE_M, sign),
                    **common,
                    names={"cyclist": 0.8, "scooter_rider": 0.2},
                    speed_mps=(3.5, 6.5),
                    spacing_m=32 / density,
                    lights=lights(main, sign, crossings),
                    gap_m=1.0,
                    sideways_m=0.04,
                ),
                window,
            )
        )
        for t, names in ((11.85, people), (12.75, people)):
            for side in (-1, 1):
                # In each file of walkers all go the same way; the two files of a sidewalk go opposite ways.
                if (sign > 0) == ((t > 12) == (side > 0)):
                    spacing = 2 * 100 / max(n_pedestrians, 1e-3) * 4
                    lanes.append(
                        (
                            traffic.Lane(
                                along(side * t, sign),
                                **common,
                                names=names,
                                speed_mps=(0.9, 1.7),
                                spacing_m=spacing,
                                height_m=KERB_HEIGHT_M,
                                gap_m=0.5,
                                sideways_m=0.08,
                                lights=tuple((sign * c - terrain.CROSS_EDGE_M + 1.2, walk_along) for c in crossings if a - 60 < c < b + 60),
                            ),
                            window,
                        )
                    )
    for c in crossings:
        if not a - 5 < c < b + 5:
            continue
        reach = (-terrain.GROUND_M - 40, terrain.GROUND_M + 40)
        for sign in (-1, 1):
            light = ((-KERB_M - 4.6, cross),)  # before the zebra crossing
            lanes.append(
                (
                    traffic.Lane(
                        across(c + sign * terrain.LANE_M, sign),
                        *reach,
                        names=cars,
                        speed_mps=(7.0, 9.5),
                        spacing_m=18 / max(traffic_density, 1e-3),
                        lights=light,
                        sideways_m=0.1,
                    ),
                    reach,
                )
            )
        for offset, sign in ((-5.2, 1), (-6.2, -1), (6.4, 1)):
            lanes.append(
                (
                    traffic.Lane(
                        across(c + offset, sign),
                        *reach,
                        names=people,
                        speed_mps=(0.9, 1.6),
                        spacing_m=1600 / max(n_pedestrians, 1e-3),
                        height_m=KERB_HEIGHT_M,
                        gap_m=0.5,
                        sideways_m=0.05,
                        lights=((-KERB_M - 5.4, walk_across),),
                    ),
                    reach,
                )
            )
    return lanes


def _traffic(
    axis: Axis,
    a: float,
    b: float,
    plans: list[Plan],
    split: str,
    seed: int,
    number: int,
    time_span_s,
    traffic_density: float,
    n_pedestrians: float,
    first: int,
    day: Day | None,
) -> list[Actor]:
    of_day = [] if day is None else [day.number]
    lane_seed = int(np.random.default_rng([seed, zlib.crc32(split.encode()), 13, number + 1, *of_day]).integers(2**31))
    found: list[Actor] = []
    for i, (lane, window) in enumerate(_lanes(axis, a, b, plans, traffic_density, n_pedestrians, lane_seed)):
        rng = np.random.default_rng([lane_seed, 14, i])
        found += traffic.lane_actors(lane, axis, split, time_span_s, window, rng, first + 2000 * i)
    phase = float(np.random.default_rng([lane_seed, 12]).uniform(*_PHASE_S))
    signal = traffic.Signal(_CYCLE_S, 18.0, phase)
    for k, c in enumerate(c for p in plans for c in p.crossings if a <= c < b):
        for j, end in enumerate((-1, 1)):
            rng = np.random.default_rng([lane_seed, 15, k, j])
            n = round(n_pedestrians / 8)
            found += traffic.crossing_walkers(
                axis, c + end * (terrain.CROSS_EDGE_M + 2.7), signal, n, split, time_span_s, rng, first + 54_000 + 500 * (2 * k + j)
            )
    return found


def _change_rows(axis: Axis, changes: list[Change], base: int) -> list[dict]:
    """Changes with map coordinates and instance ids, 0 where an object is not."""
    rows = []
    for c in changes:
        x, y, _ = axis.to_map(c.s, c.t)[0]
        now, before = (base + _ITEMS + 4 * k if k >= 0 else 0 for k in (c.index, c.index_before))
        row = {"class": c.kind, "change": c.what, "name": c.name, "instance": now, "instance_before": before}
        rows.append(row | {"x_m": round(float(x), 3), "y_m": round(float(y), 3), "moved_m": round(c.moved_m, 3)})
    return rows


def _places(axis: Axis, a: float, b: float, plans: list[Plan]) -> dict[str, list[np.ndarray]]:
    """Lines to drive along by the kind of place: a main road, a narrow one, a turn at a crossroads, past a square, over a bridge."""

    def line(s, t):
        return axis.to_map(*np.broadcast_arrays(np.asarray(s, float), np.asarray(t, float)))

    stations = np.append(np.arange(a, b, 2.0), b)
    places = {"main_road": [line(stations, 0.0)]}
    across = np.arange(-CROSS_STREET_M, CROSS_STREET_M + 1, 2.0)
    for c in (c for p in plans for c in p.crossings if a <= c < b):
        places.setdefault("narrow_road", []).append(line(c, across))
        # Turning right: a quarter circle whose lane clears the kerb.
        radius, angles = 9.0, np.linspace(0, np.pi / 2, 10)
        s = np.concatenate([np.arange(max(a, c - 50.0), c - radius, 2.0), c - radius + radius * np.sin(angles), np.full(15, c)])
        t = np.concatenate([np.zeros(len(s) - 25), radius * (np.cos(angles) - 1), -radius - np.arange(2.0, 32.0, 2.0)])
        places.setdefault("crossroads", []).append(line(s, t))
    for kind in ("square", "bridge"):
        for zone in (z for p in plans for z in p.zones if kind in (z.left, z.right) and a <= z.s0 < b):
            places.setdefault(kind, []).append(line(np.arange(max(a, zone.s0 - 15), min(b, zone.s1 + 15), 2.0), 0.0))
    return places


def count_blocks(length_m: float) -> int:
    """Number of blocks a street of this length is divided into."""
    return max(1, round(length_m / BLOCK_M))


def build_street(
    length_m: float,
    split: str,
    seed: int,
    max_slope: float = 0.05,
    relief_m: float = 6.0,
    speed_kmh: float = 40.0,
    narrow_speed_kmh: float = 30.0,
    traffic_density: float = 1.0,
    n_pedestrians: float = 30.0,
    clutter: float = 1.0,
    n_rounds: int = 1,
    time_span_s: tuple[float, float] | None = None,
    block: int | tuple[int, int] | None = None,
    crs: str = CITY_CRS,
    origin: tuple[float, float, float] = CITY_ORIGIN,
    day: Day | None = None,
) -> Scene:
    """The street of one split, or one block of it.

    Args:
        length_m: metres the mapping vehicle drives on it; the street is `count_blocks(length_m)` blocks long.
        split: train, validation, test or all: which pool of designs and which seed.
        seed: of the city.
        max_slope: largest longitudinal slope, rise per metre.
        relief_m: range of heights of a long street; a short one has what its slope allows.
        speed_kmh, narrow_speed_kmh: of the mapping vehicle on the main road and in the cross streets.
        traffic_density: 1 is heavy traffic (a vehicle every 20 m of the outer lane), 0.3 is a quiet hour.
        n_pedestrians: people per 100 m of street, about half of them walking.
        clutter: how closely furniture stands on the sidewalks; 1 is a European main street.
        n_rounds: how often the mapping vehicle drives every road in both directions.
        time_span_s: during which actors move; by default as long as those drives take, and 10 s before.
        block: number of the block to build, or of the first and the last of several, with a margin of 25 m of their neighbours;
            None builds the whole street.
        crs: of the map.
        origin: easting, northing, height of the train street's start; the other splits' streets lie 20 km apart.
        day: how the street differs from the one that is mapped; None is the day of the map.
    Returns:
        Scene whose roads are the main road (of the block) and its cross streets; `places` are stretches of them by kind.
    Raises:
        BadInput: unknown split, a length below 20 m, a slope above 0.15, or a block that does not exist.
    """
    if split not in _SPLIT_NUMBERS:
        raise BadInput("split", f"'{split}' is unknown", f"use one of {', '.join(_SPLIT_NUMBERS)}")
    if not length_m >= 20:
        raise BadInput("length_m", f"a street of {length_m} m", "make it 20 m or longer")
    if not 0 <= max_slope <= 0.15:
        raise BadInput("max_slope", f"a slope of {max_slope}", "use 0 to 0.15 (rise per metre)")
    n = count_blocks(length_m)
    first, last = (0, n - 1) if block is None else (block, block) if isinstance(block, int) else block
    if not 0 <= first <= last < n:
        raise BadInput("block", f"block {block} of a street of {n} blocks", f"use 0 to {n - 1}")
    size = length_m / n
    number = _SPLIT_NUMBERS[split]
    code = zlib.crc32(split.encode())
    axis_rng = np.random.default_rng([seed, code, 10])
    axis = terrain.draw_axis(length_m, max_slope, relief_m, (origin[0] + 20_000.0 * number, origin[1], origin[2]), axis_rng)

    a, b = first * size, (last + 1) * size
    plans = []
    for i in range(first - 1, last + 2):
        is_inner = 0 <= i < n
        s0, s1 = (i * size, (i + 1) * size) if is_inner else ((-MARGIN_M, 0.0) if i < 0 else (length_m, length_m + MARGIN_M))
        plans.append((i, plan_block(i, s0, s1, is_inner, n == 1, split, seed, clutter, n_pedestrians)))

    meshes, changes = [], []
    for i, plan in plans:
        base = number * _PER_SPLIT + (i + 2) * _PER_BLOCK
        items = list(enumerate(plan.items))
        if day is not None:
            items, changed = change_block(plan, day, np.random.default_rng([seed, code, 17, i + 1, day.number]))
            changes += _change_rows(axis, changed, base) if a <= plan.s0 < b else []
        for k, house in enumerate(plan.houses):
            if a - MARGIN_M <= house.s < b + MARGIN_M:
                meshes.append(with_instances(_house_mesh(axis, house), base + 1 + k)[0])
        for k, item in items:
            if a - MARGIN_M <= item.s < b + MARGIN_M:
                meshes.append(with_instances(_item_mesh(axis, item, day), base + _ITEMS + 4 * k)[0])
    only = [p for _, p in plans]
    reach = 45.0
    zones = [z for p in only for z in p.zones]
    crossings = [c for p in only for c in p.crossings]
    ground_seed = int(axis_rng.integers(2**31))
    base = number * _PER_SPLIT + (first + 2) * _PER_BLOCK
    ground = terrain.ground_mesh(
        axis, a - MARGIN_M - reach, b + MARGIN_M + reach, zones, crossings, [p for q in only for p in q.pits], ground_seed
    )
    ground.instances[ground.labels == FURNITURE] = base + 999
    wires, _ = with_instances(join(_wires(axis, a - MARGIN_M, b + MARGIN_M, only)), base + 998)
    static = join([ground, wires, *meshes])

    stations = np.append(np.arange(a, b, 2.0), b)
    roads, speeds = [axis.to_map(stations, np.zeros(len(stations)))], [speed_kmh]
    for c in crossings:
        if a <= c < b:
            t = np.arange(-CROSS_STREET_M, CROSS_STREET_M + 1, 2.0)
            roads.append(axis.to_map(np.full(len(t), c), t))
            speeds.append(narrow_speed_kmh)
    if time_span_s is None:
        # Drives swing about their mean speed, and turning round takes some seconds.
        drives = sum(
            2 * (np.linalg.norm(np.diff(r, axis=0), axis=1).sum() / (v / 3.6) * 1.1 + 6.0) for r, v in zip(roads, speeds, strict=True)
        )
        time_span_s = (-10.0, float(n_rounds * drives))
    found = _traffic(axis, a, b, only, split, seed, first, time_span_s, traffic_density, n_pedestrians, base + _ACTORS, day)
    return Scene(static, found, roads, speeds, terrain.LANE_M, crs, _places(axis, a, b, only), changes)
