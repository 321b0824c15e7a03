"""A part of a foreign data set becomes a map of ours, with its truth apart."""

import itertools
import logging
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pyproj

from streetscan.classes import NAMES, UNLABELLED, map_labels
from streetscan.clouds import PointCloud
from streetscan.datasets import Dataset
from streetscan.errors import BadInput
from streetscan.io.atomic import atomic_path
from streetscan.io.foreign import iterate_clouds
from streetscan.io.las import open_las_writer
from streetscan.io.npy import open_npy_writer

logger = logging.getLogger(__name__)
# What voxel keys of 0.1 m reach; a street is never as long, a point at (0, 0, 0) of a national grid is farther.
_MAX_EXTENT_M = 100_000.0
# No street is as small; a street in degrees is.
_MIN_EXTENT_M = 0.5


def import_map(
    dataset: Dataset,
    files: Sequence[str | Path],
    map_path: str | Path,
    labels_path: str | Path,
    stretch: tuple[float, float] = (0.0, 1.0),
) -> np.ndarray:
    """Stream files into one map; neither output appears unless both are complete.

    Args:
        dataset: the facts; its reader, class map and reference system are used.
        files: the part's files, in the order of the map; a folder stands for the LAZ tiles in it, in the order of their names.
        map_path: LAZ to write: the points and the fields the reader keeps, never a label.
        labels_path: `.npy` to write: (N,) uint8 labels in the map's order, 255 where unlabelled or without truth.
        stretch: from which to which share of the files' longer horizontal side the map reaches, the end left out unless it is 1. Less
            than the whole is read twice.
    Returns:
        (256,) int64: number of points of each label.
    Raises:
        BadInput: a file is damaged or not stored as the facts say, holds a class id the class map lacks, or its
            reference system is not the data set's, not that of the other files, or not in metres; no point lies in the stretch.
    """
    files = [tile for path in map(Path, files) for tile in (sorted(path.glob("*.laz")) if path.is_dir() else [path])]
    if not files:
        raise BadInput(f"data set '{dataset.name}'", "the part has no files", "list them in the data set's file")
    counts = np.zeros(256, np.int64)
    crs, low, high = None, np.full(2, np.inf), np.full(2, -np.inf)
    with atomic_path(map_path) as partial_map, atomic_path(labels_path) as partial_labels:
        clouds = _cut(dataset, files, stretch)
        first = next(clouds, None)
        if first is None:
            raise BadInput(files[0], f"has no point in the stretch {list(stretch)}", "widen parts.<part>.stretch in the data set's file")
        crs = first[0].crs
        with open_las_writer(partial_map, crs) as las, open_npy_writer(partial_labels, np.uint8) as labels_writer:
            for cloud, labels in itertools.chain([first], clouds):
                las.write(cloud)
                if len(cloud):
                    low, high = np.fmin(low, cloud.points[:, :2].min(axis=0)), np.fmax(high, cloud.points[:, :2].max(axis=0))
                labels_writer.write(labels)
                counts += np.bincount(labels, minlength=256)
            if counts.sum() == 1:
                raise BadInput(files[0], "holds a single point, which is no map", "give the whole scan")
    if (high - low).max() < _MIN_EXTENT_M:
        found = "%s: the map is only %.3g x %.3g m large; if its coordinates are degrees, reproject them to metres"
        logger.warning(found, files[0], *(high - low))
    shares = ", ".join(f"{name} {counts[i]}" for i, name in enumerate(NAMES) if counts[i])
    logger.info("%d points in all (%s): %s, unlabelled %d", counts.sum(), crs or "local frame", shares or "no class", counts[UNLABELLED])
    return counts


def _cut(dataset: Dataset, files: Sequence[str | Path], stretch: tuple[float, float]) -> Iterator[tuple[PointCloud, np.ndarray]]:
    """What `_iterate_files` yields, of one stretch along the longer horizontal side of all files."""
    if tuple(stretch) == (0, 1):
        yield from _iterate_files(dataset, files)
        return
    bounds = [(c.points[:, :2].min(axis=0), c.points[:, :2].max(axis=0)) for c, _ in _iterate_files(dataset, files) if len(c)]
    low, high = np.min([b[0] for b in bounds], axis=0), np.max([b[1] for b in bounds], axis=0)
    axis = int(np.argmax(high - low))
    begin, end = low[axis] + np.asarray(stretch) * (high[axis] - low[axis])
    for cloud, labels in _iterate_files(dataset, files):
        along = cloud.points[:, axis]
        inside = (along >= begin) & ((along < end) | (stretch[1] == 1))
        if inside.any():
            yield cloud.select(inside), labels[inside]


def _iterate_files(dataset: Dataset, files: Sequence[str | Path]) -> Iterator[tuple[PointCloud, np.ndarray]]:
    """(cloud, labels) chunk by chunk; every cloud carries the reference system of the map."""
    map_crs, first_path, first_point = None, None, None
    for i, path in enumerate(files):
        n_points, is_new_file = 0, True
        for cloud, class_ids in iterate_clouds(path, dataset.reader):
            if is_new_file:
                crs = common_crs(dataset.crs, cloud.crs, path)
                if first_path is None:
                    map_crs, first_path = crs, path
                elif not _is_same(crs, map_crs):
                    raise BadInput(
                        path,
                        f"is in {_name(crs)} but {first_path} is in {_name(map_crs)}",
                        "reproject one of them, or set crs in the data set's file if both lack theirs",
                    )
                is_new_file = False
            cloud.crs = map_crs
            first_point = cloud.points[0] if first_point is None and len(cloud) else first_point
            far = np.flatnonzero((np.abs(cloud.points - first_point) > _MAX_EXTENT_M).any(axis=1)) if len(cloud) else ()
            if len(far):
                found = (
                    f"the point {cloud.points[far[0]].round(3).tolist()} lies more than {_MAX_EXTENT_M / 1000:.0f} km from the first one"
                )
                raise BadInput(path, found, "take stray points out, or split the map")
            cloud.points[:, 0] += i * dataset.reader.spacing_m
            labels = np.full(len(cloud), UNLABELLED, np.uint8) if class_ids is None else map_labels(class_ids, dataset.class_map, path)
            n_points += len(cloud)
            yield cloud, labels
        logger.info("%s: %d points", path, n_points)


def common_crs(declared: str | None, stored: str | None, where: object) -> str | None:
    """The reference system of a file: the data set's, or its own when the data set declares none.

    Args:
        declared: the data set's, as pyproj reads it, or None.
        stored: the file's, or None.
        where: the file, named in errors.
    Raises:
        BadInput: not a reference system; both are given and their horizontal parts differ; not projected in metres.
    """
    crs = declared if declared is not None else stored
    if crs is None:
        return None
    try:
        parsed = pyproj.CRS.from_user_input(crs)
    except pyproj.exceptions.CRSError as error:
        raise BadInput(
            where, f"crs '{crs}' is no reference system pyproj knows", "give an EPSG code such as EPSG:23700, or null"
        ) from error
    if not parsed.is_projected or any(axis.unit_name != "metre" for axis in parsed.to_2d().axis_info):
        units = " and ".join(sorted({axis.unit_name for axis in parsed.axis_info}))
        raise BadInput(where, f"is in {parsed.name}, whose unit is {units}", "reproject it to a projected system in metres")
    if declared is not None and stored is not None and not _is_same(declared, stored):
        raise BadInput(where, f"is in {_name(stored)} but the data set declares {_name(declared)}", "mend crs in the data set's file")
    return crs


def _is_same(a: str | None, b: str | None) -> bool:
    """Whether two reference systems agree horizontally; files often leave out the vertical one."""
    if a is None or b is None:
        return a is b
    return a == b or pyproj.CRS.from_user_input(a).to_2d().equals(pyproj.CRS.from_user_input(b).to_2d(), ignore_axis_order=True)


def _name(crs: str | None) -> str:
    return "no reference system" if crs is None else pyproj.CRS.from_user_input(crs).name
