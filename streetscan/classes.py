"""The nine classes of the map, their order, colours and LAS codes.

Source: Nagy (2020), 2.4 (the network's integer output 0..8); LAS 1.4 keeps codes 64 and up for users.
"""

from typing import NamedTuple

import numpy as np

from streetscan.errors import BadInput


class SemanticClass(NamedTuple):
    """One class: `label` is its index, `las_code` its LAS 1.4 classification, `colour` its RGB in figures."""

    label: int
    name: str
    title: str
    las_code: int
    colour: tuple[int, int, int]
    is_movable: bool
    is_object: bool


CLASSES = (
    SemanticClass(0, "ground", "Ground", 2, (150, 150, 150), False, False),
    SemanticClass(1, "facade", "Facade", 6, (222, 184, 135), False, False),
    SemanticClass(2, "phantom", "Phantom", 64, (255, 215, 0), True, True),
    SemanticClass(3, "tram_bus", "Tram/Bus", 65, (30, 144, 255), True, True),
    SemanticClass(4, "pedestrian", "Pedestrian", 66, (220, 20, 60), True, True),
    SemanticClass(5, "car", "Car", 67, (148, 0, 211), True, True),
    SemanticClass(6, "vegetation", "Vegetation", 5, (34, 139, 34), False, True),
    SemanticClass(7, "column", "Column", 68, (255, 120, 0), False, True),
    SemanticClass(8, "furniture", "Furniture", 69, (0, 206, 209), False, True),
)
N_CLASSES = len(CLASSES)
UNLABELLED = 255
UNLABELLED_LAS_CODE = 1
UNLABELLED_COLOUR = (60, 60, 60)

NAMES = tuple(c.name for c in CLASSES)
LABELS = {c.name: c.label for c in CLASSES} | {"unlabelled": UNLABELLED}
GROUND, FACADE, PHANTOM, TRAM_BUS, PEDESTRIAN, CAR, VEGETATION, COLUMN, FURNITURE = range(N_CLASSES)
OBJECT_LABELS = tuple(c.label for c in CLASSES if c.is_object)
MOVABLE_LABELS = tuple(c.label for c in CLASSES if c.is_movable)


def las_codes(labels: np.ndarray) -> np.ndarray:
    """LAS classification codes, uint8, of labels (any shape, uint8; 255 is unlabelled)."""
    table = np.full(256, UNLABELLED_LAS_CODE, np.uint8)
    for c in CLASSES:
        table[c.label] = c.las_code
    return table[labels]


def labels_of_las_codes(codes: np.ndarray) -> np.ndarray:
    """Labels, uint8, of the LAS codes `las_codes` writes; every other code becomes unlabelled (255)."""
    table = np.full(256, UNLABELLED, np.uint8)
    for c in CLASSES:
        table[c.las_code] = c.label
    return table[codes]


def colours(labels: np.ndarray) -> np.ndarray:
    """RGB colours, uint8 (..., 3), of labels (uint8; 255 is unlabelled)."""
    table = np.full((256, 3), UNLABELLED_COLOUR, np.uint8)
    for c in CLASSES:
        table[c.label] = c.colour
    return table[labels]


def map_labels(ids: np.ndarray, class_map: dict[int, str], where: object) -> np.ndarray:
    """Labels of a foreign data set's class ids.

    Args:
        ids: (N,) integers of the foreign data set.
        class_map: foreign id to the name of one of the nine classes, or `unlabelled`.
        where: the file, named in errors.
    Returns:
        (N,) uint8 labels, 255 for `unlabelled`.
    Raises:
        BadInput: an id that occurs has no entry, or an entry names no class.
    """
    unknown = sorted({name for name in class_map.values() if name not in LABELS})
    if unknown:
        raise BadInput(where, f"the class map names '{unknown[0]}', which is no class", f"use one of {', '.join(LABELS)}")
    present, inverse = np.unique(np.asarray(ids), return_inverse=True)
    missing = [int(i) for i in present if int(i) not in class_map]
    if missing:
        raise BadInput(where, f"class id {missing[0]} occurs but is not in the class map", "add it to class_map in the data set's file")
    return np.array([LABELS[class_map[int(i)]] for i in present], np.uint8)[inverse.reshape(-1)]
