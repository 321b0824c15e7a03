"""Objects of the street: vehicles, people, plants, columns and furniture, as parametric base shapes.

A base shape (`vehicles.hatchback`, `plants.lime`, `furniture.bus_shelter`) is a function of two generators. The first
draws the design: sizes and proportions. The second draws what differs between two instances of one design: colour,
posture, leaves. A design is known by its number, and each split of a city owns its own numbers (`DESIGNS`): no object
of the training street occurs in the validation or the test street, not even in another colour.

Frame of an object: origin on the ground below its middle, x forward, y left, z up; metres.

Classes follow the thesis (2.4): a label is the object's class when it stands. ASSUME, where the thesis is silent:
a tree's trunk is column, its limbs and leaves vegetation; a rider with his bicycle is a pedestrian; a parked bicycle or
motorcycle, a fence, a railing and a statue are furniture; a café umbrella is furniture.
"""

import zlib
from collections.abc import Callable

import numpy as np

from streetscan.errors import BadInput
from streetscan.simulation import columns, furniture, people, plants, vehicles
from streetscan.simulation.meshes import transform
from streetscan.simulation.scene import Mesh

Generator = np.random.Generator

# Design numbers of each split; the ranges are disjoint.
DESIGNS = {"train": range(0, 40), "validation": range(100, 120), "test": range(200, 220), "all": range(300, 340)}

SEDANS = ("hatchback", "sedan", "estate", "suv", "coupe", "minivan")
VANS = ("delivery_van", "minibus", "pickup")
TRUCKS = ("box_truck", "tipper", "garbage_truck")
BUSES = ("city_bus", "midi_bus", "coach", "double_decker", "articulated_bus")
TRAMS = ("tram_classic", "tram_pair", "tram_low_floor", "tram_long")
WALKERS = ("person_walking", "person_coat", "person_backpack", "person_child", "person_umbrella", "person_with_pram", "person_with_dog")
STANDERS = ("person_standing", "person_coat", "person_backpack", "person_child", "person_with_pram", "person_with_dog")
RIDERS = ("cyclist", "scooter_rider")
TREES = ("lime", "plane_tree", "poplar", "conifer", "round_tree", "weeping_tree", "low_branching_tree")
SHRUBS = ("bush", "hedge", "shrub_grass", "ivy")
LAMPS = ("lamp_arm", "lamp_double", "lamp_classic", "lamp_globe")
SIGNS = ("sign_single", "sign_stack", "sign_direction")
OTHER_POLES = ("traffic_light", "traffic_light_mast", "catenary_pole", "utility_pole", "flag_pole", "camera_pole")
SMALL_FURNITURE = (
    "litter_bin",
    "hung_bin",
    "wheeled_bin",
    "hydrant",
    "switch_box",
    "mail_box",
    "parking_meter",
    "planter",
    "cone",
    "bollard",
    "stone_bollard",
    "parked_bicycle",
)
LARGE_FURNITURE = (
    "bench",
    "stone_bench",
    "container",
    "kiosk",
    "market_stall",
    "bus_shelter",
    "bicycle_rack",
    "motorcycle",
    "advert_column",
    "advert_panel",
    "cafe_set",
    "iron_fence",
    "wooden_fence",
    "guard_rail",
    "bridge_railing",
    "barrier",
    "telephone_booth",
    "statue",
    "fountain",
    "scaffold_tower",
)

# Base shapes of each object class.
BASE_SHAPES: dict[str, tuple[str, ...]] = {
    "car": SEDANS + VANS + TRUCKS,
    "tram_bus": BUSES + TRAMS,
    "pedestrian": tuple(dict.fromkeys((*STANDERS, *WALKERS, "person_sitting", *RIDERS))),
    "vegetation": TREES + SHRUBS,
    "column": LAMPS + SIGNS + OTHER_POLES,
    "furniture": SMALL_FURNITURE + LARGE_FURNITURE,
}
# Half length and half width on the ground of what is not small, metres; 0.35 both for the rest. Mirrors, arms, crowns and leads of dogs
# reach beyond it.
# fmt: off
HALF_SIZES_M = {
    "hatchback": (2.15, 0.95), "sedan": (2.55, 0.95), "estate": (2.5, 0.95), "suv": (2.5, 1.0), "coupe": (2.4, 0.95),
    "minivan": (2.45, 0.97), "delivery_van": (3.2, 1.05), "minibus": (3.4, 1.05), "pickup": (2.8, 1.0), "box_truck": (4.4, 1.25),
    "tipper": (4.1, 1.25), "garbage_truck": (4.65, 1.25), "city_bus": (6.4, 1.3), "midi_bus": (4.8, 1.3), "coach": (7.1, 1.3),
    "double_decker": (5.9, 1.3), "articulated_bus": (9.35, 1.3), "tram_classic": (8.0, 1.25), "tram_pair": (13.2, 1.25),
    "tram_low_floor": (14.7, 1.25), "tram_long": (16.5, 1.25), "bench": (1.1, 0.45), "stone_bench": (1.35, 0.3), "kiosk": (1.8, 1.8),
    "market_stall": (1.9, 1.2), "bus_shelter": (2.5, 0.9), "bicycle_rack": (1.6, 1.1), "motorcycle": (1.0, 0.4),
    "parked_bicycle": (0.95, 0.3), "advert_column": (0.85, 0.85), "advert_panel": (0.75, 0.3), "cafe_set": (1.0, 1.0),
    "iron_fence": (2.2, 0.1), "wooden_fence": (2.0, 0.12), "guard_rail": (1.6, 0.1), "bridge_railing": (2.0, 0.12),
    "barrier": (1.2, 0.35), "telephone_booth": (0.55, 0.55), "statue": (1.3, 1.3), "fountain": (2.5, 2.5), "scaffold_tower": (1.0, 0.5),
    "container": (0.8, 0.75), "planter": (0.7, 0.7), "switch_box": (0.75, 0.3), "hedge": (2.2, 0.45), "bush": (0.8, 0.8),
    "ivy": (2.2, 0.1), "shrub_grass": (0.5, 0.5), "low_branching_tree": (0.7, 0.7), "plane_tree": (0.45, 0.45),
    "person_with_pram": (0.85, 0.35), "person_with_dog": (0.85, 0.5), "bollard": (0.15, 0.15), "cone": (0.2, 0.2),
    "sign_direction": (0.15, 0.9), "flag_pole": (0.2, 0.2), "lamp_arm": (0.2, 0.2), "lamp_double": (0.2, 0.2),
    "lamp_classic": (0.25, 0.25), "lamp_globe": (0.15, 0.15), "sign_single": (0.15, 0.2), "sign_stack": (0.15, 0.2),
    "catenary_pole": (0.25, 0.25), "traffic_light": (0.2, 0.2), "traffic_light_mast": (0.25, 0.25), "hung_bin": (0.25, 0.2),
}
# fmt: on
_MODULES = (vehicles, people, plants, columns, furniture)
_MAKERS: dict[str, Callable[[Generator, Generator], Mesh]] = {
    name: next(getattr(m, name) for m in _MODULES if hasattr(m, name)) for names in BASE_SHAPES.values() for name in names
}


def make_object(name: str, design: int, rng: Generator) -> Mesh:
    """One instance of a base shape.

    Args:
        name: a base shape of BASE_SHAPES.
        design: number of the design; equal numbers give equal sizes and proportions.
        rng: draws what differs between instances of the design: colours, posture, leaves, and a size within 3 %.
    Returns:
        Mesh in the object's own frame, instance 0.
    Raises:
        BadInput: there is no base shape of this name.
    """
    if name not in _MAKERS:
        raise BadInput("shapes", f"there is no base shape '{name}'", f"use one of {', '.join(sorted(_MAKERS))}")
    mesh = _MAKERS[name](np.random.default_rng([zlib.crc32(name.encode()), design]), rng)
    return transform(mesh, scale=rng.uniform(0.97, 1.03))


def draw_design(split: str, rng: Generator) -> int:
    """A design number of the split's own pool.

    Raises:
        BadInput: the split is unknown.
    """
    if split not in DESIGNS:
        raise BadInput("split", f"'{split}' is unknown", f"use one of {', '.join(DESIGNS)}")
    pool = DESIGNS[split]
    return int(pool[rng.integers(len(pool))])
