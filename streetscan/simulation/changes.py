"""Another day in the same street: what is still there, what is other, what has moved, what is gone.

Houses, columns and most furniture stay. Parked cars are others, people and traffic too; some furniture has moved or is gone;
trees are in another season; and there is a building site. An object that stays is the same to the last bit and keeps its id.

Source: the map and the vehicle that finds itself in it are recorded on different days (Nagy 2020, 3.1.2).
ASSUME: the shares below are ours; the thesis gives none.
"""

from dataclasses import dataclass, replace

import numpy as np

from streetscan.classes import VEGETATION
from streetscan.errors import BadInput
from streetscan.simulation import shapes, terrain
from streetscan.simulation.appearance import MATERIAL_IDS
from streetscan.simulation.blocks import Item, Plan
from streetscan.simulation.scene import Mesh

# Share of the leaves that hang, and how far their colour has turned to the second colour.
SEASONS = {
    "spring": (0.7, 0.3, (150, 190, 80)),
    "summer": (1.0, 0.0, (0, 0, 0)),
    "autumn": (0.55, 0.8, (176, 120, 44)),
    "winter": (0.03, 1.0, (120, 96, 60)),
}
# Conifers, hedges and ivy keep their leaves.
_DECIDUOUS = frozenset({"lime", "plane_tree", "poplar", "round_tree", "weeping_tree", "low_branching_tree", "bush"})
_SITE_M = (16.0, 6.6)  # length along the street, and across: the parking lane and half of the sidewalk
_KINDS = {name: kind for kind, names in shapes.BASE_SHAPES.items() for name in names}


@dataclass(frozen=True)
class Day:
    """How a day differs from the one the map was made on.

    Attributes:
        number: of the day; another number is another draw of everything below.
        season: a key of SEASONS.
        parked_cars: share of the parked vehicles that are others, or whose place is empty.
        people: share of those who stand or sit that are others.
        furniture_moved, furniture_gone: shares of the furniture.
        n_building_sites: in each block of the street.
    """

    number: int = 1
    season: str = "autumn"
    parked_cars: float = 0.7
    people: float = 1.0
    furniture_moved: float = 0.08
    furniture_gone: float = 0.06
    n_building_sites: int = 1

    def __post_init__(self):
        if self.season not in SEASONS:
            raise BadInput("day.season", f"'{self.season}' is unknown", f"use one of {', '.join(SEASONS)}")


@dataclass(frozen=True)
class Change:
    """What became of one object.

    Attributes:
        kind: its class as in BASE_SHAPES.
        what: same, moved, gone, other (something of its kind in its stead) or new.
        name: the base shape.
        index, index_before: number in the block's plan on this day and on the map's, -1 where it is not.
        s, t: where it is, or was, in street coordinates.
        moved_m: how far it was moved.
    """

    kind: str
    what: str
    name: str
    index: int
    index_before: int
    s: float
    t: float
    moved_m: float = 0.0


def change_block(plan: Plan, day: Day, rng: np.random.Generator) -> tuple[list[tuple[int, Item]], list[Change]]:
    """What stands in a block on another day.

    Args:
        plan: of the block on the map's day; left as it is.
        day: how much changes.
        rng: draws the changes.
    Returns:
        the objects with their numbers, those of the map's day keeping theirs; and what became of every object.
    """
    today = replace(plan, rng=rng, items=[], taken=[])
    kept: dict[int, Item] = {}
    changes: list[Change] = []
    cars, transit, people, moving = [], [], [], []
    for k, item in enumerate(plan.items):
        kind, draw = _KINDS[item.name], rng.random()
        if kind == "car" and draw < day.parked_cars:
            cars.append((k, item))
        elif kind == "tram_bus" and draw < day.parked_cars:
            transit.append((k, item))
        elif kind == "pedestrian" and draw < day.people:
            people.append((k, item))
        elif kind == "furniture" and draw < day.furniture_gone:
            changes.append(Change(kind, "gone", item.name, -1, k, item.s, item.t))
        elif kind == "furniture" and draw < day.furniture_gone + day.furniture_moved:
            moving.append((k, item))
        else:
            kept[k] = item
    today.taken = [_footprint(item) for item in kept.values()]
    sites = [site for _ in range(day.n_building_sites) if (site := _clear_site(today, kept, changes)) is not None]

    for k, item in moving:
        moved = _move(today, item)
        if moved is None:
            changes.append(Change("furniture", "gone", item.name, -1, k, item.s, item.t))
        else:
            kept[k] = moved
            moved_m = float(np.hypot(moved.s - item.s, moved.t - item.t))
            changes.append(Change("furniture", "moved", item.name, k, k, moved.s, moved.t, moved_m))
    first, old = len(plan.items), {}
    for k, item in cars:
        if rng.random() < 0.85 and _replace_vehicle(today, item, (*shapes.SEDANS, *shapes.SEDANS, *shapes.VANS)):
            old[len(today.items) - 1] = k
        else:
            changes.append(Change("car", "gone", item.name, -1, k, item.s, item.t))
    for k, item in transit:
        if rng.random() < 0.5 and _replace_vehicle(today, item, shapes.BUSES if item.name in shapes.BUSES else shapes.TRAMS):
            old[len(today.items) - 1] = k
        else:
            changes.append(Change("tram_bus", "gone", item.name, -1, k, item.s, item.t))
    for k, item in people:
        if _replace_person(today, item):
            old[len(today.items) - 1] = k
        else:
            changes.append(Change("pedestrian", "gone", item.name, -1, k, item.s, item.t))
    for site in sites:
        _build_site(today, *site)

    changes += [Change(_KINDS[i.name], "same", i.name, k, k, i.s, i.t) for k, i in kept.items() if not any(m == k for m, _ in moving)]
    for j, item in enumerate(today.items):
        changes.append(Change(_KINDS[item.name], "other" if j in old else "new", item.name, first + j, old.get(j, -1), item.s, item.t))
    return [*sorted(kept.items()), *((first + j, item) for j, item in enumerate(today.items))], changes


def dress(mesh: Mesh, name: str, season: str, rng: np.random.Generator) -> Mesh:
    """A plant in a season: some of its leaves fallen, the others turned; what is no leaf, and what keeps its leaves, stays as it is."""
    share, turned, colour = SEASONS[season]
    leaves = (mesh.materials == MATERIAL_IDS["leaves"]) & (mesh.labels == VEGETATION)
    if name not in _DECIDUOUS or season == "summer" or not leaves.any():
        return mesh
    stays = ~leaves | (rng.random(len(leaves)) < share)
    colours = mesh.colours.astype(np.float64)
    colours[leaves] += turned * (np.array(colour) + rng.normal(0, 14, (leaves.sum(), 1)) - colours[leaves])
    return Mesh(
        mesh.vertices,
        mesh.triangles[stays],
        mesh.labels[stays],
        mesh.instances[stays],
        mesh.materials[stays],
        np.clip(colours[stays], 0, 255).astype(np.uint8),
    )


def _footprint(item: Item) -> tuple[float, float, float, float]:
    """The rectangle an object keeps, (s low, s high, t low, t high)."""
    a, b = shapes.HALF_SIZES_M.get(item.name, (0.35, 0.35))
    c, n = abs(np.cos(item.turn_rad)), abs(np.sin(item.turn_rad))
    ds, dt = c * a + n * b, n * a + c * b
    return item.s - ds, item.s + ds, item.t - dt, item.t + dt


def _is_free(today: Plan, box: tuple[float, float, float, float], gap: float = 0.05) -> bool:
    k = np.array(today.taken).reshape(-1, 4)
    hit = (k[:, 0] < box[1] + gap) & (k[:, 1] > box[0] - gap) & (k[:, 2] < box[3] + gap) & (k[:, 3] > box[2] - gap)
    return not hit.any() and today.s0 <= box[0] and box[1] <= today.s1


def _move(today: Plan, item: Item) -> Item | None:
    """The same thing a step or a few away along the street, where there is room."""
    for _ in range(8):
        shift = today.pick(-1, 1) * today.between(0.6, 4.0)
        moved = replace(item, s=float(item.s + shift), turn_rad=float(item.turn_rad + today.rng.normal(0, 0.1)))
        crosses = any(abs(moved.s - c) < terrain.CROSS_EDGE_M for c in today.crossings)
        if not crosses and _is_free(today, _footprint(moved)):
            today.taken.append(_footprint(moved))
            return moved
    return None


def _replace_vehicle(today: Plan, item: Item, names: tuple[str, ...]) -> bool:
    """Another vehicle in the stead of one, of those that fit."""
    for name in today.rng.permutation(names)[:6]:
        turn = item.turn_rad + (np.pi if today.chance(0.1) else 0.0)
        if today.add(str(name), item.s + today.rng.normal(0, 0.15), item.t + today.rng.normal(0, 0.06), item.h, turn, gap=0.15):
            return True
    return False


def _replace_person(today: Plan, item: Item) -> bool:
    """Somebody else, within some steps of where somebody was; on the same bench who sits."""
    if item.name == "person_sitting":
        return today.chance(0.5) and today.add("person_sitting", item.s, item.t, item.h, item.turn_rad, force=True)
    for _ in range(6):
        place = item.s + today.rng.normal(0, 4.0), item.t + today.rng.normal(0, 0.4)
        if any(abs(place[0] - c) < terrain.CROSS_EDGE_M for c in today.crossings) or abs(place[1]) < terrain.KERB_M + 0.35:
            continue
        if today.add(today.pick(*shapes.STANDERS), *place, item.h, today.between(-3, 3), gap=-0.15):
            return True
    return False


def _clear_site(today: Plan, kept: dict[int, Item], changes: list[Change]) -> tuple[float, int] | None:
    """Room for a building site at the kerb: (s of its start, side); what stood there is gone, poles and trees stay."""
    length = _SITE_M[0]
    for _ in range(30):
        side, s = today.pick(-1, 1), today.between(today.s0 + 1, max(today.s1 - length - 1, today.s0 + 1.1))
        inside = [z for z in today.zones if z.s0 < s + length and z.s1 > s]
        is_clear = all(not s - 14 < c < s + length + 14 for c in today.crossings) and all(
            abs(s + length / 2 - x) > 20 for _, x in today.stops
        )
        if s + length > today.s1 or not inside or not is_clear or any(z.side(side) == "bridge" for z in inside):
            continue
        low, high = sorted((side * terrain.PARKING_M[0], side * (terrain.PARKING_M[0] + _SITE_M[1])))
        for k, item in list(kept.items()):
            box = _footprint(item)
            if box[1] > s and box[0] < s + length and box[3] > low and box[2] < high and _KINDS[item.name] not in ("column", "vegetation"):
                del kept[k]
                changes.append(Change(_KINDS[item.name], "gone", item.name, -1, k, item.s, item.t))
        today.taken = [_footprint(item) for item in kept.values()]
        return s, side
    return None


def _build_site(today: Plan, s: float, side: int) -> None:
    """Barriers and cones round a stretch of the parking lane, with a lorry, a container and scaffolds."""
    edge, middle = side * (terrain.PARKING_M[0] + 0.25), side * sum(terrain.PARKING_M) / 2
    for along in np.arange(s + 1.3, s + _SITE_M[0] - 1.2, 2.5):
        today.add("barrier", along, edge, 0.0, 0.0, force=True)
    for along in (s - 0.2, s - 1.4, s + _SITE_M[0] + 0.2, s + _SITE_M[0] + 1.4):
        today.add("cone", along, edge + side * 0.5, 0.0, force=True)
    today.add(today.pick("tipper", "box_truck"), s + 5.2, middle + side * 0.25, 0.0, 0.0)
    today.add("container", s + 11.5, middle + side * 0.3, 0.0)
    for along in np.arange(s + 1.5, s + _SITE_M[0], 2.2):
        today.add("scaffold_tower", along, side * (terrain.SIDEWALK_M - 0.7), terrain.KERB_HEIGHT_M)
    for along in np.arange(s + 2.2, s + _SITE_M[0] - 2, 4.2):
        today.add("wooden_fence", along, side * (terrain.KERB_M + 2.6), terrain.KERB_HEIGHT_M)
