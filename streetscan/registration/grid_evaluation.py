"""How right the grid's classes are, against true labels of the points.

Which label is which class of the grid stands here. Labels of any height (fences, vegetation, furniture, other objects) are left
out. Buses and trucks are short objects by meaning, since they move, and tall by shape: they count against tall structure.
"""

from collections.abc import Iterable, Mapping

import numpy as np
import pandas as pd

from streetscan import classes
from streetscan.errors import BadInput
from streetscan.registration.grid_classes import GROUND, NAMES, SHORT_OBJECT, TALL_STRUCTURE, count_classes

GRID_CLASSES = {
    # Road, parking, sidewalk, other ground, lane marking, terrain; vehicles, people and riders, moving ones too; building, other
    # structure, trunk, pole, traffic sign.
    "semantickitti": {
        GROUND: (40, 44, 48, 49, 60, 72),
        SHORT_OBJECT: (10, 11, 13, 15, 16, 18, 20, 30, 31, 32, *range(252, 260)),
        TALL_STRUCTURE: (50, 52, 71, 80, 81),
    },
    "streetscan": {
        GROUND: (classes.GROUND,),
        SHORT_OBJECT: (classes.CAR, classes.PEDESTRIAN, classes.TRAM_BUS),
        TALL_STRUCTURE: (classes.FACADE, classes.COLUMN),
    },
}


def find_mapping(ids: str) -> Mapping[int, tuple[int, ...]]:
    """Class of the grid to the label ids it should have. BadInput when nobody wrote down what these ids mean."""
    if ids not in GRID_CLASSES:
        raise BadInput(f"truth.labels.ids '{ids}'", "is no list of labels we know", f"use one of {', '.join(GRID_CLASSES)}")
    return GRID_CLASSES[ids]


def count_confusion(frames: Iterable[tuple[np.ndarray, np.ndarray]], mapping: Mapping[int, tuple[int, ...]]) -> np.ndarray:
    """(4, 4) int64 points, rows true, columns found, of (grid classes (N,), label ids (N,)) per frame; ids without a class are left out."""
    confusion = np.zeros((len(NAMES), len(NAMES)), np.int64)
    for found, ids in frames:
        for true, wanted in mapping.items():
            confusion[true] += count_classes(found[np.isin(ids, wanted)])
    return confusion


def score_grid(confusion: np.ndarray) -> pd.DataFrame:
    """Precision and recall of ground, short objects and tall structure: `class`, `metric`, `value` in per cent, `unit`, `n` true points.

    A point in a sparse cell is found as nothing, which costs recall.
    """
    rows = []
    for c in (GROUND, SHORT_OBJECT, TALL_STRUCTURE):
        hits, n_found, n_true = confusion[c, c], confusion[1:, c].sum(), confusion[c].sum()
        for metric, n in (("precision", n_found), ("recall", n_true)):
            rows.append((NAMES[c], metric, 100 * hits / n if n else np.nan, "%", n_true))
    return pd.DataFrame(rows, columns=["class", "metric", "value", "unit", "n"])
