"""Recordings kept as folders of numbered files: KITTI raw and odometry, sequences of bin, PCD and LAZ, range images."""

import logging
import os
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from streetscan.errors import BadInput
from streetscan.frames import LEAST_COVERED, BadRecord, CameraImage, LidarFrame, drop_non_finite, empty_frame, nanoseconds
from streetscan.io import kitti, range_images
from streetscan.io.files import check_readable
from streetscan.io.images import check_image
from streetscan.io.las import read_las
from streetscan.io.pcd_sequence import read_pcd_columns
from streetscan.io.point_columns import LidarConventions, frame_of_columns, stamp_forward
from streetscan.sweeps import azimuth_offsets, azimuths_of

logger = logging.getLogger(__name__)

# ASSUME: nobody counts a billion frames; such a number in a name is a time (Unix seconds or finer).
_FIRST_TIME = 10**9
# ASSUME: a numbering with more gaps than this is no count of frames, for instance milliseconds of the day.
_MOST_MISSING = 1_000_000


@dataclass(frozen=True)
class NumberedFiles:
    """Files of a folder by their frame numbers, with the stamp of each frame.

    Attributes:
        paths: number to path, ascending.
        time_ns: stamp of a number.
        n_listed: rows of the list of times, each of which is a frame; None without a list.
    """

    paths: dict[int, Path]
    time_ns: Callable[[int], int]
    n_listed: int | None = None


def list_files(root: Path, pattern: str, key: str) -> dict[int, Path]:
    """The files a pattern finds below the root, by the last number in their names, ascending.

    Args:
        root: the recording's folder.
        pattern: like `velodyne_points/data/*.bin`; `.xz` files are found too.
        key: the key of the drive's file the pattern comes from, named in errors.
    Raises:
        BadInput: no pattern below the root, no file found, a name without number, or one number twice.
    """
    remedy = f"write {key} relative to root, like folder/*.bin, or **/*.bin for all folders"
    if Path(pattern).is_absolute():
        raise BadInput(root, f"the pattern '{pattern}' finds nothing (it is absolute)", remedy)
    try:
        paths = sorted([*root.glob(pattern), *root.glob(pattern + ".xz")])
    except ValueError as error:  # such as `**` within a name
        raise BadInput(root, f"the pattern '{pattern}' finds nothing ({error})", remedy) from error
    if not paths:
        if os.path.isdir(folder := root / Path(pattern).parent):
            check_readable(folder)
        raise BadInput(root, f"holds no file '{pattern}'", f"is it the right data set? correct root or {key} in the drive's file")
    numbers = []
    for path in paths:
        digits = re.findall(r"\d+", path.name.split(".")[0])
        if not digits:
            raise BadInput(path, "has no number in its name", f"number the files that {key} finds")
        numbers.append(int(digits[-1]))
    files = dict(sorted(zip(numbers, paths, strict=True)))
    if len(files) < len(paths):
        raise BadInput(root, f"{len(paths) - len(files)} files of '{pattern}' share a number with another", f"correct {key}")
    return files


def count_frames(files: dict[int, Path], key: str, are_times: bool) -> dict[int, Path]:
    """Files by the number of their frame: the number in the name, or the place in the order of time where names are times.

    Args:
        files: by the numbers in their names, ascending.
        key: the key of the drive's file, named in errors.
        are_times: the names are said to be times; names that can be nothing else are taken for times anyway.
    Raises:
        BadInput: numbers that are neither a count of frames nor times.
    """
    first, last = min(files), max(files)
    if are_times or first >= _FIRST_TIME:
        return dict(enumerate(files.values()))
    if last - first - len(files) > _MOST_MISSING:
        found = f"{len(files)} files of {key} are numbered {first} to {last}, which is no count of frames"
        raise BadInput(files[first].parent, found, "number the files 0, 1, 2, ..., or name them by nanoseconds")
    return files


def stamps_of(
    root: Path, times: str | None, files: dict[int, Path], rate_hz: float, start_ns: int
) -> tuple[Callable[[int], int], int | None]:
    """The stamp of each frame number, and how many rows the list of times has (None without a list).

    Args:
        root: the recording's folder.
        times: a list of times (row n is frame n), `file_names` for names that are nanoseconds, or None for an even rate.
        files: the files the stamps are for.
        rate_hz: frames per second, used without a list.
        start_ns: the stamp of frame 0, used without a list.
    Raises:
        BadInput: the list is shorter than the numbers of the files, or a name is no time.
    """
    if times is None:
        return lambda number: start_ns + nanoseconds(number / rate_hz), None
    if times == "file_names":
        stamps = {number: int(re.findall(r"\d+", path.name.split(".")[0])[-1]) for number, path in files.items()}
        return partial(_stamp, stamps, root), None
    listed = kitti.read_times(root / times)
    if max(files) >= len(listed):
        raise BadInput(
            root / times, f"lists {len(listed)} times, but there is a file number {max(files)}", "give the list of this recording"
        )
    return partial(_stamp, dict(enumerate(listed.tolist())), root / times), len(listed)


def _stamp(stamps: dict[int, int], where: Path, number: int) -> int:
    if number not in stamps:
        raise BadInput(where, f"holds no time for frame {number}", "give the list of this recording, or correct `frames`")
    return stamps[number]


def iterate_folder(
    lidar: NumberedFiles,
    images: NumberedFiles | None,
    labels: dict[int, Path],
    read: Callable[[Path, int], LidarFrame],
    numbers: list[int] | None = None,
) -> Iterator[LidarFrame | CameraImage]:
    """The frames of a folder by ascending number: each number's image, then its lidar frame.

    Args:
        lidar: scans and their stamps. A number between the first and the last, or a row of the list of times, without a file
            becomes a frame of status `missing`.
        images: images likewise, or None.
        labels: true labels of some frames.
        read: a path and its stamp to a frame.
        numbers: only these numbers; None: all.
    """
    wanted = numbers
    if wanted is None:
        wanted = range(min(lidar.paths), max(lidar.paths) + 1) if lidar.n_listed is None else range(lidar.n_listed)
        n_missing = len(wanted) - len(lidar.paths)
        if 2 * n_missing > len(wanted):
            logger.warning("%d of %d frames have no scan; for a part of a recording name the part in `frames`", n_missing, len(wanted))
    extra = set() if images is None or numbers is not None else set(images.paths)
    for number in sorted({*wanted, *extra}):
        if images is not None and number in images.paths:
            path = images.paths[number]
            yield _read_image(path, images.time_ns(number))
        if number not in wanted:
            continue
        if number not in lidar.paths:
            yield empty_frame(lidar.time_ns(number), "missing", number)
            continue
        frame = _read_frame(lidar.paths[number], lidar.time_ns(number), read, labels.get(number))
        frame.number = number
        yield frame


def _read_frame(path: Path, time_ns: int, read: Callable[[Path, int], LidarFrame], labels: Path | None) -> LidarFrame:
    try:
        frame = read(path, time_ns)
    except BadRecord as error:
        logger.warning("%s: %s", error.status, error)
        return empty_frame(time_ns, error.status, 0, path.name)
    frame.source = path.name
    if labels is not None and frame.status in ("ok", "partial"):
        try:
            frame.labels = kitti.read_labels(labels)
        except BadInput as error:
            logger.warning("labels_do_not_fit: %s", error)
        if frame.labels is None or len(frame.labels) != len(frame) + frame.n_dropped:
            frame.labels, frame.status = None, "labels_do_not_fit"
    return drop_non_finite(frame)


def _read_image(path: Path, time_ns: int) -> CameraImage:
    try:
        data = path.read_bytes()
    except OSError:
        return CameraImage(time_ns, b"", "png", "unreadable", path.name)
    return check_image(CameraImage(time_ns, data, "", source=path.name))


def scan_reader(
    pattern: str,
    conventions: LidarConventions,
    layout: range_images.RangeImageLayout | None,
    halves_s: Callable[[int], tuple[float, float]] | None,
) -> Callable[[Path, int], LidarFrame]:
    """The function that reads one file of a sequence, by the ending of the pattern.

    Args:
        pattern: like `*.bin`, `*.pcd`, `*.laz`, `*.png`.
        conventions: what the numbers mean.
        layout: of range images, needed for `.png`.
        halves_s: of a stamp: start and end of its revolution relative to it, when the recording lists them.
    Raises:
        BadInput: an ending no reader knows.
    """
    suffix = Path(pattern.removesuffix(".xz")).suffix.lower()
    if suffix == ".bin":
        columns = _read_bin
    elif suffix == ".pcd":
        columns = read_pcd_columns
    elif suffix in (".laz", ".las"):
        columns = _read_laz
    elif suffix == ".png" and layout is not None:
        columns = partial(_read_range_image, layout=layout)
    else:
        raise BadInput(pattern, f"no reader for files ending in '{suffix}'", "use .bin, .pcd, .laz, .las, or .png with lidar.layout")

    def read(path: Path, time_ns: int) -> LidarFrame:
        record = columns(path)
        if isinstance(record, dict):
            try:
                return frame_of_columns(record, time_ns, conventions, path)
            except BadInput as error:
                raise BadRecord("unreadable", str(error)) from error
        frame, azimuths_rad = record
        frame.time_ns = time_ns
        if frame.intensity is not None and conventions.intensity_max != 1.0:
            frame.intensity = frame.intensity / np.float32(conventions.intensity_max)
        if conventions.points == "as_fired" and conventions.stamp == "forward":
            half_s = conventions.period_s / 2
            start_s, end_s = halves_s(time_ns) if halves_s is not None else (-half_s, half_s)
            azimuths_rad = azimuths_of(frame.points) if azimuths_rad is None else azimuths_rad
            frame.time_offset_s = azimuth_offsets(azimuths_rad, start_s, end_s, conventions.direction)
            return frame
        return stamp_forward(frame, None, conventions)

    return read


def _read_bin(path: Path) -> tuple[LidarFrame, None]:
    points, intensity = kitti.read_scan(path)
    return LidarFrame(0, points, intensity), None


def _read_laz(path: Path) -> dict[str, np.ndarray]:
    try:
        cloud = read_las(path)
    except BadInput as error:
        raise BadRecord("truncated" if "truncated" in error.found else "unreadable", str(error)) from error
    fields = {k: v for k, v in cloud.fields.items() if v.ndim == 1 and k not in ("return_number", "n_returns", "classification", "time_s")}
    return {"x": cloud.points[:, 0], "y": cloud.points[:, 1], "z": cloud.points[:, 2]} | fields


def _read_range_image(path: Path, layout: range_images.RangeImageLayout) -> tuple[LidarFrame, np.ndarray]:
    points, ring, azimuths_rad, covered = range_images.read_range_image(path, layout)
    is_partial = len(points) > 0 and covered < LEAST_COVERED
    return LidarFrame(0, points, ring=ring, status="partial" if is_partial else "ok"), azimuths_rad
