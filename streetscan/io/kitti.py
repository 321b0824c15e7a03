"""KITTI raw, KITTI odometry and SemanticKITTI: scans, labels, calibrations, OXTS rows, lists of times; and the odometry layout written."""

import datetime
import io
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from streetscan import geometry
from streetscan.errors import BadInput
from streetscan.frames import BadRecord, CameraModel
from streetscan.io.files import read_bytes, read_text

_POINT_BYTES = 16
# ASSUME: no street scanner sees further. A scan with more than this share of points beyond, or with negative reflectances, holds
# something else: another number of columns, or no floating point numbers at all.
_FURTHEST_M = 1000.0
_MOST_IMPLAUSIBLE = 0.01
# So many points, evenly spread, tell: a look at all of a large scan costs ten times what reading it does.
_N_LOOKED_AT = 4096
_NS = 1_000_000_000


def read_scan(path: str | Path) -> tuple[np.ndarray, np.ndarray]:
    """Points (N, 3) float32, metres, frame `lidar`, and reflectances (N,) float32, 0..1, of a `.bin` or `.bin.xz` scan.

    Raises:
        BadRecord: the file ends within a point (`truncated`), cannot be decompressed or holds no four-column scan (`unreadable`).
    """
    path = Path(path)
    try:
        scan = np.fromfile(path, np.float32) if path.suffix != ".xz" else np.frombuffer(read_bytes(path), np.uint8)
        n_bytes = path.stat().st_size if path.suffix != ".xz" else len(scan)
    except (BadInput, OSError) as error:
        raise BadRecord("unreadable", str(error)) from error
    if n_bytes % _POINT_BYTES:
        raise BadRecord("truncated", f"{path} has {n_bytes} bytes, no multiple of {_POINT_BYTES}")
    scan = scan.view(np.float32).reshape(-1, 4)
    some = scan[:: max(len(scan) // _N_LOOKED_AT, 1)]
    with np.errstate(invalid="ignore"):
        n_wrong = max(np.count_nonzero(np.abs(some[:, :3]) > _FURTHEST_M), np.count_nonzero(some[:, 3] < 0))
    if n_wrong > _MOST_IMPLAUSIBLE * len(some):
        reason = f"{n_wrong} of {len(some)} points looked at are beyond {_FURTHEST_M:.0f} m or have a negative reflectance"
        raise BadRecord("unreadable", f"{path} is no scan of x, y, z, reflectance as float32: {reason}")
    return scan[:, :3], scan[:, 3]


def read_labels(path: str | Path) -> np.ndarray:
    """Labels (N,) uint32 of a SemanticKITTI `.label` file: class id in the low, instance in the high 16 bits.

    Raises:
        BadInput: missing, or its size is no multiple of four bytes.
    """
    data = read_bytes(path)
    if len(data) % 4:
        raise BadInput(path, f"has {len(data)} bytes, no multiple of 4", "copy it again")
    return np.frombuffer(data, np.uint32)


def read_times(path: str | Path) -> np.ndarray:
    """Stamps (K,) int64 nanoseconds of a list of times.

    Understood are KITTI raw (`2011-09-26 13:02:25.964389445`, taken as UTC), KITTI odometry (seconds, one number a line) and a CSV with
    a column `unix_time` or `time_s`; a column `frame`, where there is one, must count 0, 1, 2, ...

    Raises:
        BadInput: missing, empty or not one of these.
    """
    text = read_text(path)
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    if not lines:
        raise BadInput(path, "holds no time", "give the list of times that belongs to the recording, or remove the key")
    try:
        if "," in lines[0]:
            return _times_of_csv(text)
        if re.match(r"\d{4}-\d\d-\d\d", lines[0]):
            return np.array([_date_ns(line) for line in lines], np.int64)
        return np.array([_decimal_ns(line) for line in lines], np.int64)
    except (ValueError, KeyError, IndexError, OverflowError, pd.errors.ParserError) as error:
        raise BadInput(
            path, f"no list of times ({error})", "write a date, seconds, or a CSV with a column unix_time or time_s per line"
        ) from error


def _times_of_csv(text: str) -> np.ndarray:
    table = pd.read_csv(io.StringIO(text), dtype=str)
    column = next((c for c in ("unix_time", "time_s") if c in table), None)
    if column is None:
        raise ValueError(f"columns {', '.join(table.columns)}")
    if table[column].isna().any():
        raise ValueError(f"row {int(table[column].isna().argmax())} holds no {column}")
    times = np.array([_decimal_ns(t) for t in table[column]], np.int64)
    if "frame" in table and not np.array_equal(table["frame"].astype(int), np.arange(len(table))):
        raise ValueError("the column frame does not count 0, 1, 2, ...")
    return times


def _date_ns(text: str) -> int:
    moment, _, fraction = text.partition(".")
    seconds = datetime.datetime.fromisoformat(moment).replace(tzinfo=datetime.UTC).timestamp()
    return round(seconds) * _NS + int((fraction + "000000000")[:9])


def _decimal_ns(text: str) -> int:
    # A float64 of Unix seconds cannot hold nanoseconds; digits are taken as they stand where the number is written plainly.
    if match := re.fullmatch(r"(\d+)(?:\.(\d+))?", text.strip()):
        nanoseconds = int(match[1]) * _NS + int(((match[2] or "") + "000000000")[:9])
    else:
        nanoseconds = round(float(text) * _NS)
    if not 0 <= nanoseconds < 2**62:
        raise ValueError(f"the time {text} is out of range")
    return nanoseconds


@dataclass
class GnssTrack:
    """GNSS/INS rows: WGS 84 degrees, metres, and radians against east, north, up (yaw counter-clockwise from true east).

    Attributes:
        time_ns: (K,) int64.
        latitude_deg, longitude_deg, altitude_m: (K,) float64.
        rpy_rad: (K, 3) float64, or None without attitude.
        accuracy_m: (K,) float64 standard deviation of a position, NaN where not given.
    """

    time_ns: np.ndarray
    latitude_deg: np.ndarray
    longitude_deg: np.ndarray
    altitude_m: np.ndarray
    rpy_rad: np.ndarray | None
    accuracy_m: np.ndarray

    def __len__(self) -> int:
        return len(self.time_ns)


def read_oxts(paths: list[Path], time_ns: np.ndarray) -> GnssTrack:
    """The rows of OXTS files, one per frame.

    Args:
        paths: the files `oxts/data/*.txt`, in order.
        time_ns: (K,) their stamps.
    Raises:
        BadInput: a file that does not hold the 30 numbers of KITTI's format, or positions outside the Earth's degrees.
    """
    rows = np.empty((len(paths), 30))
    for i, path in enumerate(paths):
        words = read_text(path).split()
        try:
            rows[i] = np.array(words, np.float64).reshape(30)
        except ValueError as error:
            raise BadInput(path, f"has {len(words)} words that should be 30 numbers ({error})", "copy the OXTS file again") from error
    track = GnssTrack(np.asarray(time_ns), rows[:, 0], rows[:, 1], rows[:, 2], rows[:, 3:6], rows[:, 23])
    return _checked_track(track, [str(p) for p in paths])


def read_gnss_csv(path: str | Path) -> GnssTrack:
    """A table with the columns `unix_time` or `time_s`, `lat_deg`, `lon_deg`, `alt_m` and, for poses, `roll_rad`, `pitch_rad`, `yaw_rad`.

    Raises:
        BadInput: missing, or a column is missing or holds something that is no number.
    """
    times = read_times(path)
    try:
        table = pd.read_csv(io.StringIO(read_text(path)))
        position = table[["lat_deg", "lon_deg", "alt_m"]].to_numpy(np.float64)
        angles = ["roll_rad", "pitch_rad", "yaw_rad"]
        rpy_rad = table[angles].to_numpy(np.float64) if set(angles) <= set(table.columns) else None
    except (KeyError, ValueError) as error:
        raise BadInput(path, f"no table of positions ({error})", "write the columns unix_time, lat_deg, lon_deg, alt_m") from error
    return _checked_track(GnssTrack(times, *position.T, rpy_rad, np.full(len(times), np.nan)), [str(path)] * len(times))


def _checked_track(track: GnssTrack, where: list[str]) -> GnssTrack:
    """The track, when each row is a position on Earth; `where` names the file of each row."""
    is_good = np.isfinite(track.altitude_m) & (np.abs(track.latitude_deg) <= 90) & (np.abs(track.longitude_deg) <= 360)
    if track.rpy_rad is not None:
        is_good &= np.isfinite(track.rpy_rad).all(axis=1)
    if not is_good.all():
        row = int(np.argmin(is_good))
        raise BadInput(where[row], f"row {row} holds no position on Earth", "export the positions again in WGS 84 degrees")
    return track


def read_calibration(path: str | Path) -> dict[str, np.ndarray]:
    """The numbers of a KITTI calibration file by their names (`P_rect_02`, `R_rect_00`, `R`, `T`, `P2`, `Tr`, ...); dates are left out.

    Raises:
        BadInput: missing, or no line of the form `name: numbers`.
    """
    values = {}
    for line in read_text(path).splitlines():
        name, colon, numbers = line.partition(":")
        if not colon or name.lstrip().startswith("#"):
            continue
        try:
            values[name.strip()] = np.array(numbers.split(), np.float64)
        except ValueError:
            continue  # calib_time holds a date
    if not values:
        raise BadInput(path, "no line of the form 'name: numbers'", "give a KITTI calibration file")
    return values


def read_rigid(path: str | Path, key: str | None = None) -> np.ndarray:
    """A rigid transform (4, 4) of a calibration file: twelve numbers under `key`, or `R` and `T`.

    Raises:
        BadInput: the key is missing, has another number of values, or R is no rotation.
    """
    values = read_calibration(path)
    if key is None:
        R, T = _numbers(values, "R", 9, path).reshape(3, 3), _numbers(values, "T", 3, path)
    else:
        R, T = np.split(_numbers(values, key, 12, path).reshape(3, 4), [3], axis=1)
    return geometry.transform_of_rotation(geometry.check_rotation(R, f"{path}, {key or 'R'}"), T.reshape(3))


def read_camera(path: str | Path, camera: int, width: int | None = None, height: int | None = None) -> tuple[CameraModel, np.ndarray]:
    """A rectified KITTI camera and where it sits.

    Args:
        path: `calib_cam_to_cam.txt` (KITTI raw) or `calib.txt` (KITTI odometry).
        camera: 0 to 3.
        width, height: size of the images at hand; with KITTI raw's `S_rect` a smaller size scales the intrinsics.
    Returns:
        the model of the rectified image, without the offset between the cameras, and T_camera_reference (4, 4), from the
        frame of unrectified camera 0 (raw) or rectified camera 0 (odometry) to the camera.
    Raises:
        BadInput: a key is missing, R_rect is no rotation, or the size of the images is unknown.
    """
    values = read_calibration(path)
    is_raw = f"P_rect_{camera:02d}" in values
    P = _numbers(values, f"P_rect_{camera:02d}" if is_raw else f"P{camera}", 12, path).reshape(3, 4)
    K = P[:, :3].copy()
    if abs(np.linalg.det(K)) < 1e-9:
        raise BadInput(path, f"the projection of camera {camera} is singular", "copy the calibration again")
    T = geometry.transform(np.linalg.solve(K, P[:, 3]))
    if is_raw:
        R = geometry.check_rotation(_numbers(values, "R_rect_00", 9, path), f"{path}, R_rect_00")
        T = T @ geometry.transform_of_rotation(R)
    size = values.get(f"S_rect_{camera:02d}")
    if size is not None and width is not None:
        # Pixel centres are at integers: the image's corner, which scaling keeps, is at -0.5.
        scale = np.array([width, height]) / size
        K[:2] *= scale[:, None]
        K[:2, 2] += (scale - 1) / 2
    elif size is not None:
        width, height = (int(v) for v in size)
    if width is None:
        raise BadInput(path, "does not say how large the images are", "write camera.width and camera.height into the drive's file")
    return CameraModel(width, height, K, np.zeros(0), "plumb_bob", np.c_[K, np.zeros(3)]), T


def _numbers(values: dict[str, np.ndarray], key: str, n: int, path: str | Path) -> np.ndarray:
    if key not in values:
        raise BadInput(
            path, f"has no line '{key}:' (found: {', '.join(values)})", "give the calibration file that belongs to the recording"
        )
    if len(values[key]) != n or not np.isfinite(values[key]).all():
        raise BadInput(path, f"'{key}' has {len(values[key])} numbers that should be {n} finite ones", "copy the calibration again")
    return values[key]


def calibration_text(model: CameraModel, T_camera_lidar: np.ndarray | None) -> str:
    """The text of an odometry `calib.txt`: one camera as P0..P3, and Tr when the mounting is known."""

    def row(matrix: np.ndarray) -> str:
        return " ".join(f"{v:.12e}" for v in np.asarray(matrix, np.float64)[:3].ravel())

    lines = [f"P{i}: {row(model.P)}" for i in range(4)]
    if T_camera_lidar is not None:
        lines.append(f"Tr: {row(T_camera_lidar)}")
    return "\n".join(lines) + "\n"


def scan_bytes(points: np.ndarray, intensity: np.ndarray | None) -> bytes:
    """The bytes of a `.bin` scan; without intensity the fourth column is NaN, for 0 would be a measurement."""
    scan = np.full((len(points), 4), np.nan, np.float32)
    scan[:, :3] = points
    if intensity is not None:
        scan[:, 3] = intensity
    return scan.tobytes()
