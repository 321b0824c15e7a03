"""What localization looks like: a file for Foxglove with the aligned scans beside the map, and the thesis' pictures.

Source: Nagy (2020), Fig. 3.3 (ground removal), Fig. 3.4 (landmarks and detected objects), Fig. 3.9 (before and after).
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from streetscan.benchmarks.rendering import View, render_cloud
from streetscan.classes import COLUMN
from streetscan.frames import LidarFrame, Mounting
from streetscan.geometry import apply, transform
from streetscan.io.atomic import atomic_folder
from streetscan.io.mcap import iterate_lidar, open_drive_writer
from streetscan.localization.drive import FrameLocation
from streetscan.localization.ground import find_ground
from streetscan.localization.localizer import level_of, place_start
from streetscan.localization.objects import find_objects
from streetscan.localization.reference import Reference
from streetscan.registration.frame_pictures import write_picture

_SCAN, _LOW, _HIGH = (220, 30, 30), np.array([70, 80, 95]), np.array([205, 215, 225])
_PALETTE = np.array([
    (0, 114, 178), (230, 159, 0), (0, 158, 115), (204, 121, 167), (86, 180, 233), (213, 94, 0), (148, 103, 189), (140, 86, 75),
    (188, 189, 34), (23, 190, 207),
], np.uint8)  # fmt: skip
_RANGE_M = 45.0


def write_view(path: str | Path, drive_path: str | Path, rows: Sequence[FrameLocation], reference: Reference) -> None:
    """Write believed poses (`/tf`, map to lidar), their scans (`/lidar`) and the static map (`/map`) for Foxglove.

    The frame `map` begins at the reference's origin, for a viewer's float32 holds no UTM coordinates; the origin is in the metadata.
    """
    believed = {row.index: row.location.T_map_lidar for row in rows if row.location.status == "ok"}
    with open_drive_writer(path) as writer:
        writer.write_metadata("map", {"crs": reference.crs or "", **dict(zip(("x_m", "y_m", "z_m"), reference.origin, strict=True))})
        is_first = True
        for index, frame in enumerate(iterate_lidar(drive_path)):
            if is_first:
                writer.write_cloud("/map", "map", reference.static, frame.time_ns)
                is_first = False
            if (T := believed.get(index)) is not None:
                local = T.copy()
                local[:3, 3] -= reference.origin
                writer.write_mounting(Mounting("map", "lidar", local), frame.time_ns)
                writer.write_lidar(frame)


def write_pictures(folder: str | Path, drive_path: str | Path, rows: Sequence[FrameLocation], reference: Reference) -> None:
    """Write the thesis' pictures of the believed frame that the start was farthest from; of any frame found, or none, without one.

    `ground.png` (Fig. 3.3), `landmarks.png` and `objects.png` (Fig. 3.4), `before.png` and `after.png` (Fig. 3.9).
    """
    found = [row for row in rows if np.isfinite(row.location.T_map_lidar).all() and np.isfinite(row.start.xy_m).all()]
    believed = [row for row in found if row.location.status == "ok"] or found
    with atomic_folder(folder) as partial:
        if not believed:
            return
        row = max(believed, key=lambda r: np.hypot(*(r.start.xy_m[:2] - r.location.T_map_lidar[:2, 3])))
        frame = next(f for i, f in enumerate(iterate_lidar(drive_path)) if i == row.index)
        for name, image in draw_frame_on_map(frame, row, reference).items():
            write_picture(partial / f"{name}.png", image)


def draw_frame_on_map(frame: LidarFrame, row: FrameLocation, reference: Reference) -> dict[str, np.ndarray]:
    """Pictures of one localized frame by name, (height, width, 3) uint8."""
    T = row.location.T_map_lidar.copy()
    T[:3, 3] -= reference.origin
    points = np.asarray(frame.points, np.float64)
    ground = find_ground(points[np.isfinite(points).all(axis=1)])
    level = level_of(ground)
    objects = find_objects(ground)
    map_points = reference.cut(T[:2, 3], _RANGE_M)
    heights = map_points[:, 2] - reference.ground_at(map_points)
    map_colours = _shade(heights)
    yaw = np.nan_to_num(row.start.yaw_rad)
    T_start = place_start(reference, row.start.xy_m[:2] - reference.origin[:2], yaw, -ground.plane[2]) @ level
    # Without ground on either side, which would hide what stands on it (thesis, Fig. 3.7).
    scan = ground.points[ground.heights_m > 0.3].astype(np.float64)
    # Crowns and wires would hide the street.
    is_wall = (heights > 0.3) & (heights < 4.0)
    red = np.tile(np.array(_SCAN, np.uint8), (len(scan), 1))
    from_above = View(tuple(T[:3, 3] + T[:3, :3] @ [-22.0, -8.0, 42.0]), tuple(T[:3, 3] + T[:3, :3] @ [2.0, 0, -2.0]), 1600, 1000)

    def overlay(pose: np.ndarray) -> np.ndarray:
        together = np.concatenate([apply(pose, scan), map_points[is_wall]])
        return render_cloud(together, np.concatenate([red, map_colours[is_wall]]), from_above, 0.12)

    behind = View((-16.0, -3.0, 11.0), (8.0, 0.0, -2.0), 1600, 900)
    removed = np.where((ground.heights_m > 0.1)[:, None], np.array((0, 114, 178)), np.array((190, 190, 190))).astype(np.uint8)
    grouped = np.full((len(ground.points), 3), (235, 150, 150), np.uint8)
    grouped[ground.heights_m > 0.1] = (205, 205, 205)
    blob = np.repeat(np.arange(len(objects)), np.diff(objects.starts))
    return {
        "ground": render_cloud(ground.points.astype(np.float64), removed, behind, 0.05),
        "objects": render_cloud(
            # Of points in one place the first is seen.
            np.concatenate([objects.points, ground.points.astype(np.float64)]),
            np.concatenate([_PALETTE[blob % len(_PALETTE)], grouped]),
            behind,
            0.05,
        ),
        "landmarks": _draw_landmarks(map_points, heights, reference, T, from_above),
        "before": overlay(T_start),
        "after": overlay(T),
    }


def _draw_landmarks(points: np.ndarray, heights: np.ndarray, reference: Reference, T: np.ndarray, view: View) -> np.ndarray:
    """The map in grey, each landmark's points in a colour of its own; columns are drawn with their whole height."""
    landmarks = reference.landmarks.select(reference.landmarks.near(T[:2, 3], _RANGE_M))
    colours = _shade(heights)
    for i in range(len(landmarks)):
        o = landmarks.objects
        yaw, size = o.yaws_rad[i], o.sizes_m[i]
        middle = o.corners[i].reshape(-1, 3).mean(axis=0)
        local = apply(np.linalg.inv(transform(middle, (0, 0, yaw))), points)
        top = np.inf if landmarks.kinds[i] == COLUMN else size[2] / 2 + 0.2
        inside = (np.abs(local[:, 0]) < size[0] / 2 + 0.15) & (np.abs(local[:, 1]) < size[1] / 2 + 0.15)
        inside &= (local[:, 2] > -size[2] / 2 - 0.05) & (local[:, 2] < top)
        colours[inside] = _PALETTE[i % len(_PALETTE)]
    return render_cloud(points, colours, view, 0.12)


def _shade(heights: np.ndarray) -> np.ndarray:
    share = np.clip(heights / 6, 0, 1)[:, None]
    return (_HIGH + share * (_LOW - _HIGH)).astype(np.uint8)
