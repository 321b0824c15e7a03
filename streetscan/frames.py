"""What a drive consists of: lidar frames, images, GPS fixes, the camera's model and the mountings a user gave.

Times are whole nanoseconds since the Unix epoch (`time_ns`), because a float64 of seconds steps by 0.24 microseconds today.
"""

import dataclasses
from dataclasses import dataclass

import numpy as np

from streetscan.errors import BadInput

# What can be the matter with a frame. The frame keeps its row whatever its status is.
STATUSES = {
    "ok": "whole and in order",
    "empty": "the sensor's record is there and holds no point",
    "partial": "the revolution is not complete",
    "truncated": "the record ends too early",
    "unreadable": "the record cannot be decoded",
    "missing": "the numbering or the list of times has the frame, no record exists",
    "time_backwards": "its stamp is out of the order of the other frames",
    "labels_do_not_fit": "its true labels are damaged, or not as many as its points",
}

# How many coefficients each distortion model may have, in the order OpenCV and Foxglove share.
DISTORTIONS = {"plumb_bob": (0, 4, 5), "rational_polynomial": (0, 8, 12, 14), "kannala_brandt": (0, 4)}

# ASSUME: a revolution that lacks more than 3 % of its azimuths is not complete; cuts between packets are 0.5 degrees apart.
LEAST_COVERED = 0.97


class BadRecord(Exception):
    """One record of a recording is unusable; its frame stays, with this status (a key of STATUSES)."""

    def __init__(self, status: str, reason: str):
        super().__init__(reason)
        self.status = status


def nanoseconds(time_s: float) -> int:
    """Seconds as whole nanoseconds, rounded to the microsecond a float64 of Unix seconds can hold."""
    return round(float(time_s) * 1e6) * 1000


@dataclass
class LidarFrame:
    """One revolution of the lidar.

    Attributes:
        time_ns: the firing at azimuth 0 (forward).
        points: (N, 3) float32, metres, frame `lidar` at each point's own firing.
        intensity: (N,) float32, 1 is the source's largest value, or None.
        ring: (N,) uint16, the beam, or None.
        time_offset_s: (N,) float32, the point's firing minus the stamp, or None when not known.
            0 throughout when the recording was de-skewed: all coordinates then hold at the stamp.
        status: a key of STATUSES.
        number: the frame's number in the recording: in its file's name, or the count of messages or revolutions.
        source: the file it comes from, or empty.
        n_dropped: returns without finite coordinates, left out.
        labels: (N,) uint32 true labels in the source's own ids, or None; they never go into the drive's file.
        instances: (N,) uint32 the true object, 0 for none, or None; likewise.
    """

    time_ns: int
    points: np.ndarray
    intensity: np.ndarray | None = None
    ring: np.ndarray | None = None
    time_offset_s: np.ndarray | None = None
    status: str = "ok"
    number: int = 0
    source: str = ""
    n_dropped: int = 0
    labels: np.ndarray | None = None
    instances: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.points)


# The camera of a drive that has one; of several each has a name of its own, which begins so.
CAMERA = "camera"


@dataclass
class CameraImage:
    """One compressed image.

    `time_ns` is the middle of its exposure, `format` is `png` or `jpeg`, status `ok`, `missing`, `unreadable`, or `other_size`
    than its calibration. `camera` is the name of the camera. `instances` (H, W) uint32 and `labels` (H, W) uint8 are the true object
    and class of each pixel, or None;
    they never go into the drive's file.
    """

    time_ns: int
    data: bytes
    format: str
    status: str = "ok"
    source: str = ""
    instances: np.ndarray | None = None
    labels: np.ndarray | None = None
    camera: str = CAMERA


@dataclass
class GpsFix:
    """One position, WGS 84 degrees and metres; covariance_m2 (3, 3) of east, north, up, or None. NaN altitude: not measured.

    `heading_rad` is clockwise from true north, or None when the receiver does not tell it.
    """

    time_ns: int
    latitude_deg: float
    longitude_deg: float
    altitude_m: float
    covariance_m2: np.ndarray | None = None
    heading_rad: float | None = None


@dataclass
class CameraModel:
    """Intrinsics of a camera, pixel centres at integers.

    Attributes:
        width, height: pixels.
        K: (3, 3) float64.
        D: distortion coefficients of `distortion_model` (`plumb_bob`, `rational_polynomial`, `kannala_brandt`; empty without distortion).
        P: (3, 4) float64, projection of the rectified image.
        camera: its name.
    """

    width: int
    height: int
    K: np.ndarray
    D: np.ndarray
    distortion_model: str
    P: np.ndarray
    camera: str = CAMERA

    def equals(self, other: "CameraModel") -> bool:
        """Whether two models are the same, and of the same camera, in every number."""
        own, others = (dataclasses.astuple(model) for model in (self, other))
        return all(np.array_equal(a, b) for a, b in zip(own, others, strict=True))


def camera_model(width: int, height: int, K: np.ndarray, D: np.ndarray, name: str, P: np.ndarray, where: object) -> CameraModel:
    """A model under the names we know; see CameraModel for the arguments.

    Args:
        name: the source's name of the distortion model; ROS calls `kannala_brandt` equidistant.
        where: the record, named in errors.
    Raises:
        BadInput: no camera matrix, a distortion model that is none of DISTORTIONS, or another number of coefficients.
    """
    K, D, P = (np.asarray(matrix, np.float64) for matrix in (K, D, P))
    if not (np.isfinite(K).all() and K[0, 0] > 0 and K[1, 1] > 0 and K[2, 2] == 1):
        raise BadInput(where, f"K = {K.ravel().tolist()} is no camera matrix", "calibrate the camera: [fx, 0, cx, 0, fy, cy, 0, 0, 1]")
    name = "kannala_brandt" if name == "equidistant" else name
    if name not in DISTORTIONS and not D.any():
        name, D = "plumb_bob", np.zeros(0)
    if name not in DISTORTIONS:
        raise BadInput(where, f"the distortion model '{name}'", f"calibrate the camera with one of {', '.join(DISTORTIONS)}")
    if D.size not in DISTORTIONS[name] or not np.isfinite(D).all():
        expected = " or ".join(str(n) for n in DISTORTIONS[name])
        raise BadInput(where, f"D = {D.tolist()} for distortion model '{name}'", f"give {expected} finite coefficients")
    return CameraModel(int(width), int(height), K, D, name, P)


@dataclass
class Mounting:
    """Where a sensor sits on the vehicle, as the user measured it: T_parent_child (4, 4)."""

    parent: str
    child: str
    T_parent_child: np.ndarray
    source: str = ""


def empty_frame(time_ns: int, status: str, number: int, source: str = "") -> LidarFrame:
    """A frame without points, for a record that is missing or cannot be read."""
    return LidarFrame(time_ns, np.empty((0, 3), np.float32), status=status, number=number, source=source)


def drop_non_finite(frame: LidarFrame) -> LidarFrame:
    """The frame without the points that have NaN or infinite coordinates, counted in `n_dropped`; `empty` when none is left."""
    # A sum sees every NaN and infinity, and as a product it is twenty times as fast as a look at each coordinate.
    with np.errstate(all="ignore"):
        is_clean = bool(np.isfinite(np.ones(len(frame), np.float32) @ frame.points).all())
    if not is_clean:
        kept = np.isfinite(frame.points).all(axis=1)
        frame.n_dropped += int((~kept).sum())
        frame.points = frame.points[kept]
        for name in ("intensity", "ring", "time_offset_s", "labels", "instances"):
            if (values := getattr(frame, name)) is not None:
                setattr(frame, name, values[kept])
    if len(frame) == 0 and frame.status == "ok":
        frame.status = "empty"
    return frame
