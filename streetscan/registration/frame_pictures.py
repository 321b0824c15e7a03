"""Pictures of a drive's frames in the colours of the grid.

Source: Józsa & Benedek (2013), 8.2.1 (J-33): stream, simple segment, average height, point density, height range.
"""

from collections.abc import Iterable, Iterator
from pathlib import Path

import cv2
import numpy as np
from matplotlib import colormaps

from streetscan.benchmarks.rendering import View, render_cloud
from streetscan.errors import BadInput
from streetscan.frames import LidarFrame
from streetscan.io.atomic import atomic_path
from streetscan.io.frame_arrays import FrameArrays
from streetscan.io.las import count_points, iterate_las
from streetscan.registration.grid_classes import COLOURS, GridClasses, GridSettings, classify_points
from streetscan.registration.odometry import FramePose

MODES = ("stream", "classes", "mean_height", "density", "height_range")
# From behind and above the vehicle, looking ahead.
DEFAULT_VIEW = View(position=(-22.0, 0.0, 14.0), target=(14.0, 0.0, -2.0))


def colour_points(points: np.ndarray, classes: GridClasses, labels: np.ndarray, mode: str, sensor_height_m: float) -> np.ndarray:
    """Colours of the points of one frame.

    Args:
        points: (N, 3) metres, frame `lidar`.
        classes: the frame's grid.
        labels: (N,) uint8 classes as shown by `classes` (after corrections).
        mode: one of MODES. Heights run from 0 to 4 m above the road, ranges from 0 to 3 m, densities from 1 to 1000 points a cell
            in logarithms.
        sensor_height_m: of the sensor above the road.
    Returns:
        (N, 3) uint8 RGB; grey outside the grid.
    Raises:
        BadInput: no such mode.
    """
    if mode == "classes":
        return COLOURS[labels]
    if mode == "stream":
        return _map_colours((np.asarray(points)[:, 2] + sensor_height_m) / 4, "gray", low=0.25)
    inside = classes.cell_of_point >= 0
    cells = classes.cell_of_point[inside]
    if mode == "mean_height":
        values = (classes.z_mean_m.ravel()[cells] + sensor_height_m) / 4
    elif mode == "density":
        values = np.log10(np.maximum(classes.counts.ravel()[cells], 1)) / 3
    elif mode == "height_range":
        values = (classes.z_max_m.ravel()[cells] - classes.z_min_m.ravel()[cells]) / 3
    else:
        raise BadInput("mode", f"'{mode}'", f"choose one of {', '.join(MODES)}")
    colours = np.full((len(points), 3), 90, np.uint8)
    colours[inside] = _map_colours(values, "turbo")
    return colours


def _map_colours(values: np.ndarray, name: str, low: float = 0.0) -> np.ndarray:
    shares = low + (1 - low) * np.clip(np.nan_to_num(values), 0, 1)
    return (colormaps[name](shares)[:, :3] * 255).astype(np.uint8)


def draw_frame(points: np.ndarray, colours: np.ndarray, view: View = DEFAULT_VIEW) -> np.ndarray:
    """(height, width, 3) uint8 picture of a frame on black; points with NaN are left out."""
    kept = np.isfinite(points).all(axis=1)
    return render_cloud(np.asarray(points, np.float64)[kept], colours[kept], view, 0.08, (0, 0, 0), edge_shading=0.0)


def draw_drive(
    frames: Iterable[LidarFrame],
    labels: FrameArrays,
    mode: str,
    sensor_height_m: float,
    settings: GridSettings,
    first: int = 0,
    last: int | None = None,
) -> Iterator[tuple[int, np.ndarray]]:
    """Numbers and pictures of the frames of a drive with numbers in [first, last).

    Args:
        frames: of the whole drive, in order.
        labels: the classes segment_frames gave them.
        mode, sensor_height_m, settings: see `colour_points` and `classify_points`.
        first, last: `last` None shows all.
    """
    for index, frame in enumerate(frames):
        if last is not None and index >= last:
            return
        if index >= first:
            classes = classify_points(frame.points, sensor_height_m, settings)
            colours = colour_points(frame.points, classes, labels.read(index, len(frame)), mode, sensor_height_m)
            yield index, draw_frame(frame.points, colours)


def save_drive_pictures(pictures: Iterable[tuple[int, np.ndarray]], folder: str | Path, mode: str, video_rate_hz: float = 0.0) -> None:
    """Write `<mode>.mp4` of a rate, or with rate 0 one `<mode>_<frame>.png` each."""
    if video_rate_hz > 0:
        write_video(Path(folder) / f"{mode}.mp4", (image for _, image in pictures), video_rate_hz)
        return
    for index, image in pictures:
        write_picture(Path(folder) / f"{mode}_{index:06d}.png", image)


def draw_merged(folder: str | Path, poses: dict[int, FramePose], n_points: int = 4_000_000) -> np.ndarray:
    """A merged street seen from behind the start of the drive: ground grey by intensity, objects by class, what moves magenta.

    Args:
        folder: tiles of merge_frames.
        poses: of the merged frames, in the frame of the tiles.
        n_points: at most so many points are drawn, evenly over the file.
    Returns:
        (height, width, 3) uint8 RGB.
    """
    paths = sorted(Path(folder).glob("*.laz"))
    stride = max(1, -(-sum(count_points(path) for path in paths) // n_points))
    points, colours = [np.empty((0, 3))], [np.empty((0, 3), np.uint8)]
    for path in paths:
        for cloud in iterate_las(path):
            part = cloud.select(np.s_[::stride])
            points.append(part.points)
            colour = COLOURS[part.fields["grid_class"]].astype(np.float64)
            intensity = part.fields["intensity"][:, None] / 32768
            colour *= 0.6 + 0.4 * np.clip(intensity, 0, 1) if intensity.any() else 1.0
            colour[part.fields["is_moving"] == 1] = (255, 0, 255)
            colours.append(colour.astype(np.uint8))
    track = np.array([poses[i].T_segment_lidar[:3, 3] for i in sorted(poses)])
    start, heading = track[0], track[min(len(track) - 1, max(np.searchsorted(np.linalg.norm(track - track[0], axis=1), 40.0), 1))]
    ahead = (heading - start) * [1, 1, 0]
    ahead = ahead / np.linalg.norm(ahead) if np.linalg.norm(ahead) > 1 else np.array([1.0, 0, 0])
    view = View(tuple(start - 15 * ahead + [0, 0, 18]), tuple(start + 35 * ahead), 1600, 900)
    return render_cloud(np.concatenate(points), np.concatenate(colours), view, point_size_m=0.06)


def write_picture(path: str | Path, image: np.ndarray) -> None:
    """Write an RGB image as PNG."""
    with atomic_path(path) as partial:
        partial.write_bytes(cv2.imencode(".png", image[..., ::-1])[1].tobytes())


def write_video(path: str | Path, images: Iterable[np.ndarray], rate_hz: float) -> int:
    """Write RGB images (all of one size) as an MP4; returns their number.

    Raises:
        BadInput: there is no image, or the machine's OpenCV cannot write MP4.
    """
    writer, n = None, 0
    with atomic_path(path) as partial:
        try:
            for image in images:
                if writer is None:
                    size = image.shape[1], image.shape[0]
                    writer = cv2.VideoWriter(str(partial), cv2.VideoWriter_fourcc(*"mp4v"), rate_hz, size)
                    if not writer.isOpened():
                        raise BadInput(path, "this OpenCV cannot write MP4", "write pictures instead")
                writer.write(np.ascontiguousarray(image[..., ::-1]))
                n += 1
        finally:
            if writer is not None:
                writer.release()
        if n == 0:
            raise BadInput(path, "no frame to show", "choose frames the drive has")
    return n
