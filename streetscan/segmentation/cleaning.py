"""The static map: what is left of a labelled map without phantoms and movable objects.

Source: Nagy (2020), Fig. 2.2 and 3.4.1 (N-006).
"""

from collections.abc import Iterable, Iterator

import numpy as np

from streetscan.classes import LABELS
from streetscan.clouds import PointCloud
from streetscan.errors import BadInput


def keep_classes(clouds: Iterable[PointCloud], keep: Iterable[str]) -> Iterator[PointCloud]:
    """The points of the kept classes, cloud by cloud, with all their fields.

    Args:
        clouds: parts of a map with a field `label`, (n,) uint8.
        keep: names of the classes that stay; `unlabelled` is one of them.
    Yields:
        one cloud for each given, empty where nothing stays.
    Raises:
        BadInput: a name that is no class, or a cloud without labels.
    """
    keep = list(keep)
    for name in keep:
        if name not in LABELS:
            raise BadInput("clean_map.keep", f"'{name}' is no class", f"use {', '.join(LABELS)}")
    kept_labels = np.array([LABELS[name] for name in keep], np.uint8)
    for cloud in clouds:
        if "label" not in cloud.fields:
            raise BadInput("the labelled map", "has no field 'label'", "give maps written by label_map")
        yield cloud.select(np.isin(cloud.fields["label"], kept_labels))
