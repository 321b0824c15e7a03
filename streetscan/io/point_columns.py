"""Lidar frames out of named columns: the point fields of PointCloud2, Foxglove PointCloud, PCD and LAS, whatever the driver called them."""

from dataclasses import dataclass

import numpy as np

from streetscan.errors import BadInput
from streetscan.frames import LidarFrame, drop_non_finite, nanoseconds
from streetscan.sweeps import azimuth_offsets, azimuths_of, forward_time

_INTENSITY = ("intensity", "reflectivity", "remission", "reflectance", "i")
_RING = ("ring", "channel", "line", "laser_id", "laserid")
# time: Velodyne; t: Ouster; timestamp: Hesai, Robosense; offset_time: Livox; time_stamp: Nebula; time_offset_s: ours.
_TIME = ("time_offset_s", "time", "t", "timestamp", "offset_time", "time_stamp")
# ASSUME: no offset within a revolution is as long as a day, and no recording is from 2 January 1970.
_ABSOLUTE_S = 86_400.0
# ASSUME: the middle half of a frame's firings lies within five revolutions; a wrong unit is wrong by a thousand.
_LONGEST_REVOLUTIONS = 5.0


@dataclass(frozen=True)
class LidarConventions:
    """What the numbers of a recording's lidar frames mean.

    Attributes:
        points: `as_fired`, or `de_skewed` when the source already brought all points to the stamp.
        direction: how the sensor turns seen from above, `clockwise` or `counterclockwise`.
        stamp: which firing the source's stamp of a frame is: `forward` (azimuth 0), `start` or `end` of the revolution.
        period_s: duration of one revolution.
        intensity_max: the source's number for full reflectance.
        time_unit_s: unit of the points' time field; None: seconds in floating point fields, nanoseconds in integer fields.
    """

    points: str = "as_fired"
    direction: str = "clockwise"
    stamp: str = "forward"
    period_s: float = 0.1
    intensity_max: float = 1.0
    time_unit_s: float | None = None


def frame_of_columns(columns: dict[str, np.ndarray], time_ns: int, conventions: LidarConventions, where: object) -> LidarFrame:
    """A lidar frame, stamped at azimuth 0.

    Args:
        columns: field name to (N,) array; x, y, z are needed, the others are found under the names drivers use.
        time_ns: the source's stamp.
        conventions: what the numbers mean.
        where: the record, named in errors.
    Raises:
        BadInput: no x, y or z; columns of different length; times of points in another unit than the conventions say.
    """
    names = {name.lower(): name for name in columns}
    if missing := [axis for axis in "xyz" if axis not in names]:
        found = ", ".join(columns) or "no field"
        raise BadInput(where, f"the points have no field '{missing[0]}' (found: {found})", "choose the topic or file that holds the points")
    if len({len(v) for v in columns.values()}) > 1:
        raise BadInput(where, "fields of different length", "record or export it again")
    points = np.stack([np.asarray(columns[names[axis]], np.float32) for axis in "xyz"], axis=1)
    frame = LidarFrame(time_ns, points)
    if name := _first(names, _INTENSITY):
        frame.intensity = np.asarray(columns[name], np.float32)
        if conventions.intensity_max != 1.0:
            frame.intensity = frame.intensity / np.float32(conventions.intensity_max)
    if name := _first(names, _RING):
        frame.ring = np.asarray(columns[name]).astype(np.uint16)
    if name := _first(names, _TIME):
        times_s = _seconds(np.asarray(columns[name]), conventions.time_unit_s, time_ns)
        # Our own name is in seconds by definition.
        spread_s = 0.0 if name == _TIME[0] else _spread_s(times_s)
        if spread_s > _LONGEST_REVOLUTIONS * conventions.period_s:
            found = f"half of the points' own times ('{name}') lie {spread_s:.6g} s apart, in revolutions of {conventions.period_s:.3g} s"
            raise BadInput(where, found, "write their unit as lidar.time_unit_s into the drive's file")
        # A return whose firing is unknown or a day away is as useless as one without coordinates.
        with np.errstate(invalid="ignore"):
            is_wrong = ~(np.abs(times_s) < _ABSOLUTE_S)
        points[is_wrong] = np.nan
        frame.time_offset_s = times_s
    frame = drop_non_finite(frame)
    return stamp_forward(frame, frame.time_offset_s, conventions)


def stamp_forward(frame: LidarFrame, times_s: np.ndarray | None, conventions: LidarConventions) -> LidarFrame:
    """The frame with its stamp moved to the firing at azimuth 0 and its `time_offset_s` filled.

    Args:
        frame: with the source's stamp.
        times_s: (N,) float64 firing times relative to the source's stamp, or None when the source has none.
        conventions: what the source's stamp is. `forward` keeps it and takes the times as they are.
    """
    if conventions.points == "de_skewed":
        frame.time_offset_s = np.zeros(len(frame), np.float32)
        return frame
    half_s = conventions.period_s / 2
    if times_s is not None:
        forward_s = 0.0 if conventions.stamp == "forward" else forward_time(frame.points, times_s)
        if not np.isfinite(forward_s):
            # ASSUME: the sweep starts at the rear, so forward is half a revolution away.
            forward_s = half_s if conventions.stamp == "start" else -half_s
        frame.time_offset_s = (times_s - forward_s).astype(np.float32)
    else:
        forward_s = {"forward": 0.0, "start": half_s, "end": -half_s}[conventions.stamp]
        frame.time_offset_s = azimuth_offsets(azimuths_of(frame.points), -half_s, half_s, conventions.direction)
    frame.time_ns += nanoseconds(forward_s)
    return frame


def _first(names: dict[str, str], wanted: tuple[str, ...]) -> str | None:
    return next((names[w] for w in wanted if w in names), None)


def _spread_s(times_s: np.ndarray) -> float:
    """How far the middle half of the finite times reaches; 0 for none."""
    known = times_s[np.isfinite(times_s)]
    if not len(known):
        return 0.0
    quarter, three_quarters = np.partition(known, [len(known) // 4, 3 * len(known) // 4])[[len(known) // 4, 3 * len(known) // 4]]
    return float(three_quarters - quarter)


def _seconds(values: np.ndarray, unit_s: float | None, time_ns: int) -> np.ndarray:
    """Firing times in seconds relative to the stamp, from a field that may count since the stamp or since 1970."""
    if len(values) == 0:
        return np.zeros(0)
    is_integer = np.issubdtype(values.dtype, np.integer)
    unit_s = unit_s or (1e-9 if is_integer else 1.0)
    typical = float(np.median(values))
    if not typical * unit_s >= _ABSOLUTE_S:
        return values.astype(np.float64) * unit_s
    if is_integer:
        # Whole numbers are subtracted before the conversion, for a float64 cannot hold nanoseconds since 1970.
        stamp = round(time_ns * 1e-9 / unit_s) if unit_s != 1e-9 else time_ns
        return (values.astype(np.int64) - stamp).astype(np.float64) * unit_s
    return values.astype(np.float64) * unit_s - time_ns * 1e-9
