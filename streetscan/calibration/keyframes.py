"""Keyframes: places of a drive with the images and the lidar frame that one calibration works on.

Source: Nagy (2020), 4.3.1 (N = 8 images, global movement of 10 pixels or more between successive ones; N-203), 4.3.4 (the lidar frame
nearest in time to the first image; N-210), 4.4.2 (more than three column-shaped objects; N-234).

ASSUME: the global movement is the mean length of the dense optical flow over the image. Corners alone would not do: they gather far
ahead, where a driving camera's image stands nearly still.

ASSUME: images more than `max_gap_s` apart do not belong to one keyframe, since features cannot be followed over it.

ASSUME: a keyframe needs `min_images`, the thesis' least N of 3. A place that gives fewer than N images is used with what it gives.

ASSUME: columns are counted where the camera sees: it looks ahead, to within `margin_deg`, which is all that is known before it is
calibrated. An object is a column by its shaft alone: slim, standing, and higher than people. Of 15 places of training and validation
streets four have more than three such columns in view, and one has none; clouds come out right, and to scale, at training places with none
to three. So `min_columns` is 1, not the thesis' four; the thesis does not say how far it looks, or how its lidar's columns are counted.
"""

import logging
from bisect import bisect_right
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
import pandas as pd

from streetscan.calibration.rectification import check_camera, rectify_image
from streetscan.errors import BadInput
from streetscan.frames import CameraModel, LidarFrame
from streetscan.io.files import find_file
from streetscan.io.images import decode_image
from streetscan.io.mcap import iterate_images, iterate_lidar, read_camera_model
from streetscan.localization.ground import GroundSettings, find_ground
from streetscan.localization.objects import find_objects
from streetscan.registration.drive_frames import read_mounting

logger = logging.getLogger(__name__)

# What can be the matter with a keyframe; all but `ok` keep their row and are not reconstructed.
STATUSES = {
    "ok": "images, lidar frame and columns are there",
    "no_images": "the place has fewer images in a row than a keyframe needs",
    "no_motion": "the vehicle hardly moves",
    "bad_intrinsics": "no intrinsics of the camera, or such as cannot be used",
    "bad_images": "images cannot be decoded, or differ in size from the intrinsics",
    "saturated": "the images are blown out or black",
    "no_lidar": "no lidar frame close enough in time",
    "few_columns": "too few column-shaped objects in view",
}
COLUMNS = (
    "keyframe", "status", "reason", "lidar_frame", "lidar_time_ns", "images", "image_times_ns", "movements_px", "n_columns",
)  # fmt: skip


@dataclass(frozen=True)
class KeyframeSettings:
    """What makes a keyframe.

    Attributes:
        n_images: N of the thesis (8).
        min_images: fewer do not make a keyframe (thesis: 3).
        min_movement_px: least global movement between successive images (thesis: 10).
        max_gap_s: images farther apart in time are not of one keyframe.
        min_columns: least number of columns in view; the thesis wants more than three.
        column_ratio: a column is at least so many times as high as wide.
        min_column_m: the top of a column is higher above the ground, as that of a person is not, m.
        max_column_m: a column is slimmer, m.
        max_base_m: what is seen of a column begins lower above the ground, m; parked cars hide its foot.
        column_range_m: columns are counted within this distance, m.
        margin_deg: ... and up to so far beyond the sides of the image, degrees.
        max_lidar_gap_s: farthest lidar frame from the first image.
        max_saturated: largest share of pixels that are black or white in all channels.
        n_starts: first images tried at a place, spread over it.
    """

    n_images: int = 8
    min_images: int = 3
    min_movement_px: float = 10.0
    max_gap_s: float = 0.25
    min_columns: int = 1
    column_ratio: float = 2.0
    min_column_m: float = 1.9
    max_column_m: float = 0.5
    max_base_m: float = 0.9
    column_range_m: float = 30.0
    margin_deg: float = 25.0
    max_lidar_gap_s: float = 0.1
    max_saturated: float = 0.5
    n_starts: int = 5

    def __post_init__(self):
        if not 2 <= self.min_images <= self.n_images:
            raise BadInput(
                "choose_keyframes.min_images", f"{self.min_images} of n_images {self.n_images}", "let 2 <= min_images <= n_images"
            )


@dataclass
class Keyframe:
    """One place; `images` and `lidar_frame` count the drive's images and lidar frames in order, -1 is none.

    Attributes:
        index: 0 .. n - 1.
        status: a key of STATUSES.
        reason: what was found, with numbers.
        lidar_frame, lidar_time_ns: the lidar frame nearest in time to the first image.
        images, image_times_ns: of its images, in the order of time.
        movements_px: from each image to the next.
        n_columns: column-shaped objects in view; -1 where they were not counted.
    """

    index: int
    status: str = "no_images"
    reason: str = ""
    lidar_frame: int = -1
    lidar_time_ns: int = -1
    images: list[int] = field(default_factory=list)
    image_times_ns: list[int] = field(default_factory=list)
    movements_px: list[float] = field(default_factory=list)
    n_columns: int = -1


def choose_keyframes(drive_path: str | Path, n_keyframes: int, settings: KeyframeSettings = KeyframeSettings()) -> list[Keyframe]:
    """Keyframes spread over a drive, one for each of `n_keyframes` places.

    First images that are followed by enough others without a gap are parted into `n_keyframes` places of equal number, in order. At each
    place some are tried, and the best kept: `ok` before all, then more images.

    Args:
        drive_path: drive.mcap.
        n_keyframes: how many.
        settings: see KeyframeSettings.
    Returns:
        exactly `n_keyframes`, each with its status.
    Raises:
        BadInput: the drive is damaged.
    """
    image_times = np.array([image.time_ns for image in iterate_images(drive_path)], np.int64)
    lidar_times = np.array([frame.time_ns for frame in iterate_lidar(drive_path)], np.int64)
    try:
        camera = read_camera(drive_path)
    except BadInput as error:
        logger.info("all keyframes: bad_intrinsics (%s)", error)
        return [Keyframe(index, "bad_intrinsics", str(error)) for index in range(n_keyframes)]
    starts = _first_images(image_times, settings)
    keyframes = []
    for index, place in enumerate(np.array_split(starts, n_keyframes)):
        tried = place[np.unique(np.linspace(0, len(place) - 1, settings.n_starts).round().astype(int))] if len(place) else []
        best, nothing = None, Keyframe(index, reason=f"{len(image_times)} images of the drive hold no {settings.min_images} in a row here")
        for start in tried:
            found = _try_start(drive_path, camera, image_times, lidar_times, int(start), index, settings)
            if best is None or (found.status == "ok", len(found.images)) > (best.status == "ok", len(best.images)):
                best = found
            if best.status == "ok" and len(best.images) == settings.n_images:
                break
        best = best or nothing
        logger.info("keyframe %02d: %s%s", index, best.status, f" ({best.reason})" if best.reason else "")
        keyframes.append(best)
    return keyframes


def read_camera(drive_path: str | Path) -> CameraModel:
    """The intrinsics of a drive, sure to be usable. BadInput as in `rectify_image`."""
    return check_camera(read_camera_model(drive_path), drive_path)


def find_camera(drive_path: str | Path) -> CameraModel | None:
    """The intrinsics of a drive; None where they cannot be used, which its keyframes say (`bad_intrinsics`)."""
    try:
        return read_camera(drive_path)
    except BadInput:
        return None


def read_keyframe_images(drive_path: str | Path, keyframe: Keyframe) -> list[np.ndarray]:
    """The rectified images (H, W, 3) uint8 RGB of a keyframe, in its order. BadInput as in `rectify_image` and `decode_image`."""
    wanted = keyframe.image_times_ns
    if not wanted:
        return []
    camera = read_camera(drive_path)
    images = {i.time_ns: i for i in iterate_images(drive_path, wanted[0], wanted[-1] + 1) if i.time_ns in set(wanted)}
    if len(images) < len(wanted):
        raise BadInput(
            drive_path, f"holds {len(images)} of the {len(wanted)} images of keyframe {keyframe.index}", "run choose_keyframes again"
        )
    return [rectify_image(decode_image(images[time_ns]), camera, f"{drive_path}, image at {time_ns} ns") for time_ns in wanted]


def read_keyframe_lidar(drive_path: str | Path, keyframe: Keyframe) -> LidarFrame:
    """The lidar frame of a keyframe. BadInput when the drive does not hold it."""
    for frame in iterate_lidar(drive_path, keyframe.lidar_time_ns, keyframe.lidar_time_ns + 1):
        return frame
    raise BadInput(drive_path, f"holds no lidar frame at {keyframe.lidar_time_ns} ns", "run choose_keyframes again")


def tabulate_keyframes(keyframes: list[Keyframe]) -> pd.DataFrame:
    """One row per keyframe with the columns of COLUMNS; lists are separated by blanks."""
    rows = []
    for k in keyframes:
        lists = [" ".join(map(str, k.images)), " ".join(map(str, k.image_times_ns)), " ".join(f"{m:.2f}" for m in k.movements_px)]
        rows.append((f"{k.index:02d}", k.status, k.reason, k.lidar_frame, k.lidar_time_ns, *lists, k.n_columns))
    return pd.DataFrame(rows, columns=COLUMNS)


def read_keyframes(path: str | Path) -> list[Keyframe]:
    """The rows of a table `tabulate_keyframes` made. BadInput: no such file, or one without these columns."""
    try:
        table = pd.read_csv(find_file(path), dtype=str, keep_default_na=False)
        return [_read_row(row) for row in table[list(COLUMNS)].itertuples()]
    except (ValueError, KeyError, UnicodeDecodeError, pd.errors.ParserError) as error:
        raise BadInput(path, f"no table of keyframes ({error})", "run choose_keyframes again") from error


def _read_row(row) -> Keyframe:
    images, times_ns = ([int(number) for number in text.split()] for text in (row.images, row.image_times_ns))
    movements_px = [float(number) for number in row.movements_px.split()]
    where = int(row.lidar_frame), int(row.lidar_time_ns)
    return Keyframe(int(row.keyframe), row.status, row.reason, *where, images, times_ns, movements_px, int(row.n_columns))


def _first_images(times_ns: np.ndarray, s: KeyframeSettings) -> np.ndarray:
    """Numbers of the images that are followed, without a gap, by enough others; by N where such a stretch is somewhere."""
    last = np.arange(len(times_ns))
    for i in range(len(times_ns) - 2, -1, -1):
        if times_ns[i + 1] - times_ns[i] <= s.max_gap_s * 1e9:
            last[i] = last[i + 1]
    n_following = last - np.arange(len(times_ns)) + 1
    least = s.n_images if (n_following >= s.n_images).any() else s.min_images
    return np.flatnonzero(n_following >= least)


def _try_start(drive_path, camera: CameraModel, image_times, lidar_times, start: int, index: int, s: KeyframeSettings) -> Keyframe:
    """The keyframe whose first image is `start`."""
    found = Keyframe(index)
    problem = _gather(found, drive_path, camera, image_times, start, s) or _pair_lidar(found, lidar_times, s)
    if not problem:
        points = read_keyframe_lidar(drive_path, found).points @ _turn_of_lidar(drive_path).T
        found.n_columns = count_columns(points, camera, s)
        if found.n_columns < s.min_columns:
            problem = "few_columns", f"{found.n_columns} column-shaped objects in view within {s.column_range_m:g} m"
    found.status, found.reason = problem or ("ok", "")
    return found


def _gather(found: Keyframe, drive_path, camera: CameraModel, times_ns, start: int, s: KeyframeSettings) -> tuple[str, str] | None:
    """Collect images from `start` on, each moved by enough from the one before; what stopped it, or None."""
    previous, previous_ns = None, int(times_ns[start])
    for number, image in enumerate(iterate_images(drive_path, int(times_ns[start])), start=start):
        if len(found.images) == s.n_images or image.time_ns - previous_ns > s.max_gap_s * 1e9:
            break
        previous_ns = image.time_ns
        try:
            pixels = rectify_image(decode_image(image), camera, f"image {number}")
        except BadInput as error:
            return "bad_images", str(error)
        if (share := saturated_share(pixels)) > s.max_saturated:
            return "saturated", f"{100 * share:.0f} % of image {number} is black or white"
        grey = cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY)
        movement_px = np.inf if previous is None else measure_movement(previous, grey)
        if movement_px < s.min_movement_px:
            continue
        if previous is not None:
            found.movements_px.append(movement_px)
        found.images.append(number)
        found.image_times_ns.append(image.time_ns)
        previous = grey
    if len(found.images) < s.min_images:
        return "no_motion", f"{len(found.images)} images moved by {s.min_movement_px:g} px or more"
    return None


def _pair_lidar(found: Keyframe, times_ns: np.ndarray, s: KeyframeSettings) -> tuple[str, str] | None:
    """Take the lidar frame nearest in time to the first image; what is the matter, or None."""
    first_ns = found.image_times_ns[0]
    after = bisect_right(times_ns, first_ns)
    near = [i for i in (after - 1, after) if 0 <= i < len(times_ns)]
    if not near:
        return "no_lidar", "the drive has no lidar frames"
    nearest = min(near, key=lambda i: abs(int(times_ns[i]) - first_ns))
    gap_s = abs(int(times_ns[nearest]) - first_ns) / 1e9
    if gap_s > s.max_lidar_gap_s:
        return "no_lidar", f"the nearest lidar frame is {gap_s:.2f} s from the first image"
    found.lidar_frame, found.lidar_time_ns = nearest, int(times_ns[nearest])
    return None


def measure_movement(previous: np.ndarray, current: np.ndarray) -> float:
    """Mean length in pixels of the optical flow from one grey image (H, W) uint8 to the next (DIS flow at half the size)."""
    size = previous.shape[1] // 2, previous.shape[0] // 2
    small = [cv2.resize(image, size, interpolation=cv2.INTER_AREA) for image in (previous, current)]
    flow = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_FAST).calc(*small, None)
    return 2 * float(np.hypot(flow[..., 0], flow[..., 1]).mean())


def saturated_share(image: np.ndarray) -> float:
    """The share of pixels (H, W, 3) uint8 that hold no detail: white or black in every channel."""
    return float(((image >= 250).all(axis=2) | (image <= 5).all(axis=2)).mean())


def count_columns(points: np.ndarray, camera: CameraModel, settings: KeyframeSettings = KeyframeSettings()) -> int:
    """Column-shaped objects of a lidar frame that a camera looking ahead has in view.

    Args:
        points: (N, 3) float, metres, about the lidar; x ahead, z up.
        camera: its intrinsics tell the width of the view.
        settings: those of columns.
    """
    s = settings
    ground = find_ground(points, GroundSettings(range_m=s.column_range_m))
    found = find_objects(ground)
    if not len(found):
        return 0
    heights = ground.heights_m[np.searchsorted(ground.rows, found.rows)]
    top, base = np.maximum.reduceat(heights, found.starts[:-1]), np.minimum.reduceat(heights, found.starts[:-1])
    sizes, centres = found.objects.sizes_m, found.objects.centres
    width = sizes[:, :2].max(axis=1)
    is_slim = (width <= s.max_column_m) & (sizes[:, 2] >= s.column_ratio * width)
    is_standing = (base <= s.max_base_m) & (top >= s.min_column_m)
    half_width = max(camera.K[0, 2], camera.width - 1 - camera.K[0, 2]) / camera.K[0, 0]
    side = np.abs(np.arctan2(centres[:, 1], centres[:, 0]))
    return int((is_slim & is_standing & (side <= np.arctan(half_width) + np.radians(s.margin_deg))).sum())


def _turn_of_lidar(drive_path: str | Path) -> np.ndarray:
    """(3, 3) from the lidar's axes to the vehicle's by the mounting the drive holds; without one the lidar is taken to stand level."""
    try:
        return read_mounting(drive_path)[:3, :3]
    except BadInput:
        return np.eye(3)
