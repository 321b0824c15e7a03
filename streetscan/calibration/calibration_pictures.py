"""Pictures of a calibrated keyframe as the thesis shows them: Figs. 4.5-4.9, 4.11 and 4.13."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial import cKDTree

from streetscan.benchmarks.rendering import View, render_cloud
from streetscan.calibration.keyframe_calibration import KeyframeCalibration, KeyframeClouds
from streetscan.calibration.linear_projection import linear_of, project_linear
from streetscan.calibration.objects import FLAT, LINEAR, SCATTERED, UNSHAPED, CloudObjects, ObjectSettings, find_objects
from streetscan.geometry import apply, invert
from streetscan.registration.frame_pictures import write_picture

_SHAPE_COLOURS = np.zeros((4, 3), np.uint8)
_SHAPE_COLOURS[[LINEAR, FLAT, SCATTERED, UNSHAPED]] = [(220, 40, 40), (40, 90, 220), (40, 160, 60), (170, 170, 170)]
_LIDAR, _CAMERA, _OBJECT = (240, 130, 20), (70, 70, 70), (40, 80, 255)
_PALETTE = np.array(
    [(0, 114, 178), (230, 159, 0), (0, 158, 115), (204, 121, 167), (86, 180, 233), (213, 94, 0), (148, 103, 189), (140, 86, 75)], np.uint8
)
_SIZE = 1200, 750
# Stages before the last, by the picture of their projection.
_OVERLAYS = {"objects_raw": "overlay_raw", "objects": "overlay_before", "place": "overlay_place", "curves": "overlay_curves"}
# A point of the camera's cloud as near as this to a matched object is drawn in its colour.
_MATCHED_M = 0.3


def write_pictures(folder: Path, made: KeyframeCalibration, clouds: KeyframeClouds, objects: ObjectSettings) -> None:
    """Write what was made of a keyframe into an existing folder; `objects` is what its objects were found with.

    `lidar_objects.png`, `sfm_objects.png` (Fig. 4.5e), `lidar_pillars.png`, `sfm_pillars.png` (Fig. 4.5d), `lidar_shapes.png`,
    `sfm_shapes.png` (Fig. 4.5c), `aligned_start.png` (Fig. 4.6c: both clouds level, as they came), `aligned_raw.png` (Fig. 4.6d, by
    objects with moving things left in), `aligned_objects.png` (Fig. 4.6e), `aligned_curves.png` (Fig. 4.8: after ICP and T*; lidar orange,
    camera's cloud grey), `aligned.png` (the outcome), `curves.png` (Fig. 4.9), `overlay.png` (Fig. 4.11: points by distance, objects blue)
    and before it `overlay_initial.png` (by the calibration in force), of earlier stages `overlay_raw.png`, `overlay_before.png` (by
    objects, with and without moving things), `overlay_place.png` (where ICP begins) and `overlay_curves.png` (after T*); `matched.png`
    (Figs. 4.7 and 4.13: the matched objects of both clouds from above, a colour each, the camera's lighter).
    """
    pictures = {}
    for name in ("lidar", "sfm"):
        if (cloud := getattr(made, name)) is not None:
            # Its points are level already.
            pillars = find_objects(cloud.points, np.eye(4), replace(objects, is_split=False))
            pictures |= {f"{name}_objects": _draw_objects(cloud), f"{name}_pillars": _draw_objects(pillars)}
            pictures[f"{name}_shapes"] = _draw_shapes(cloud)
    if made.lidar is not None and made.sfm is not None:
        pictures["aligned_start"] = _draw_aligned(made.lidar, made.sfm, invert(made.sfm.T_level_cloud) @ made.lidar.T_level_cloud)
    if clouds.T_initial is not None:
        pictures["overlay_initial"] = _overlay(made, clouds, linear_of(clouds.T_stamp_in_force, clouds.view.K))
    if made.raw is not None:
        pictures["aligned_raw"] = _draw_aligned(*made.raw)
    if made.voted:
        pictures["aligned_objects"] = _draw_aligned(made.lidar, made.sfm, made.voted[0].T_sfm_lidar)
    for stage, name in _OVERLAYS.items():
        if stage in made.stages:
            pictures[name] = _overlay(made, clouds, made.stages[stage])
    if made.T_camera_stamp is not None:
        T_sfm_stamp = invert(clouds.view.T_camera_sfm) @ made.T_camera_stamp
        pictures["aligned"] = _draw_aligned(made.lidar, made.sfm, T_sfm_stamp)
        if made.control is not None and len(made.control.objects):
            pictures["matched"] = _draw_matched(made, T_sfm_stamp)
    if made.projection is not None:
        pictures["overlay"] = _overlay(made, clouds, made.projection)
    if made.curves is not None:
        pictures["curves"] = _draw_curves(made)
        pictures["aligned_curves"] = _draw_aligned(made.lidar, made.sfm, made.T_icp, made.curves.move)
    for name, picture in pictures.items():
        write_picture(folder / f"{name}.png", picture)


# From behind and above the sensor, in a level frame with x forward.
_BEHIND = View((-12.0, 0.0, 12.0), (14.0, 0.0, 0.0), *_SIZE)
_ABOVE = View((14.0, 0.0, 45.0), (17.0, 0.0, 0.0), *_SIZE)


def _draw_objects(cloud: CloudObjects) -> np.ndarray:
    """Objects in colours of their own, all else that stands dark, ground light."""
    number = np.repeat(np.arange(len(cloud)), np.diff(cloud.starts))
    rest = np.where((cloud.heights_m > 0.2)[:, None], 120, 215).repeat(3, axis=1)
    points, colours = np.concatenate([cloud.members, cloud.points]), np.concatenate([_PALETTE[number % len(_PALETTE)], rest])
    return render_cloud(points, colours.astype(np.uint8), _BEHIND, 0.06, background=(250, 250, 250))


def _draw_shapes(cloud: CloudObjects) -> np.ndarray:
    """Voxels by category: linear red, flat blue, scattered green."""
    voxel_m = cloud.voxel_m
    return render_cloud((cloud.voxels + 0.5) * voxel_m, _SHAPE_COLOURS[cloud.voxel_shapes], _BEHIND, voxel_m, background=(250, 250, 250))


def _draw_aligned(
    lidar: CloudObjects, sfm: CloudObjects, T_sfm_lidar: np.ndarray, move: Callable[[np.ndarray], np.ndarray] = lambda points: points
) -> np.ndarray:
    """What stands in both clouds: lidar orange, camera's cloud grey; `move` takes the lidar's points in the frame `sfm` on from there."""
    own = lidar.points[(lidar.heights_m > 0.3) & (lidar.heights_m < 4.0)]
    theirs = sfm.points[(sfm.heights_m > 0.3) & (sfm.heights_m < 4.0)]
    moved = apply(sfm.T_level_cloud, move(apply(T_sfm_lidar @ invert(lidar.T_level_cloud), own)))
    colours = np.concatenate([np.tile(_LIDAR, (len(own), 1)), np.tile(_CAMERA, (len(theirs), 1))]).astype(np.uint8)
    return render_cloud(np.concatenate([moved, theirs]), colours, _ABOVE, 0.1, background=(250, 250, 250))


def _draw_matched(made: KeyframeCalibration, T_sfm_lidar: np.ndarray) -> np.ndarray:
    """Matched objects of the lidar and the points of the camera's cloud at them, an object a colour; what else stands light grey."""
    lidar, sfm = made.lidar, made.sfm
    members = [lidar.points_of(m) for m in made.control.objects]
    number = np.repeat(np.arange(len(members)), [len(m) for m in members])
    moved = apply(sfm.T_level_cloud @ T_sfm_lidar @ invert(lidar.T_level_cloud), np.concatenate(members))
    distances, rows = cKDTree(moved).query(sfm.points, distance_upper_bound=_MATCHED_M)
    near = np.isfinite(distances)
    # An object may be higher or lower than what is drawn around it.
    shown = near | ((sfm.heights_m > 0.3) & (sfm.heights_m < 4.0))
    theirs, near, rows = sfm.points[shown], near[shown], rows[shown]
    own = _PALETTE[number % len(_PALETTE)]
    # The camera's are lighter, so that both are seen where they do not lie on each other.
    colours = np.full((len(theirs), 3), 205, np.uint8)
    colours[near] = 128 + own[rows[near]] // 2
    return render_cloud(np.concatenate([theirs, moved]), np.concatenate([colours, own]), _ABOVE, 0.12, background=(250, 250, 250))


def _draw_curves(made: KeyframeCalibration) -> np.ndarray:
    """Control points red, the lidar's curve orange, the camera's blue, over what stands; shifts ten times as long as they are."""
    curves, sfm = made.curves, made.sfm
    standing = sfm.points[(sfm.heights_m > 0.3) & (sfm.heights_m < 4.0)]
    own = apply(sfm.T_level_cloud, curves.bins_lidar)
    theirs = own + 10 * (apply(sfm.T_level_cloud, curves.bins_sfm) - own)
    control = apply(sfm.T_level_cloud, curves.control_lidar)
    parts = [(np.repeat(control, 8, axis=0) + np.random.default_rng(0).normal(0, 0.15, (8 * len(control), 3)), (220, 30, 30))]
    parts += [(own, _LIDAR), (theirs, _OBJECT), (standing, (190, 190, 190))]
    colours = np.concatenate([np.tile(colour, (len(points), 1)) for points, colour in parts]).astype(np.uint8)
    return render_cloud(np.concatenate([points for points, _ in parts]), colours, _ABOVE, 0.12, background=(250, 250, 250))


def _overlay(made: KeyframeCalibration, clouds: KeyframeClouds, projection: np.ndarray) -> np.ndarray:
    """The image with the frame's points: near ones red, far ones green, those of matched objects blue (Fig. 4.11)."""
    picture = clouds.image // 2 + 40
    points = clouds.points_lidar[::2]
    pixels = project_linear(projection, points)
    depth = np.linalg.norm(points, axis=1)
    hues = (60 * np.clip(depth / 40, 0, 1)).astype(np.uint8)
    colours = cv2.cvtColor(np.stack([hues, np.full_like(hues, 230), np.full_like(hues, 240)], axis=1)[None], cv2.COLOR_HSV2RGB)[0]
    _dots(picture, pixels, colours, clouds)
    if made.control is not None and len(made.control.objects):
        members = np.concatenate([made.lidar.points_of(m) for m in made.control.objects])
        own = project_linear(projection, apply(invert(made.lidar.T_level_cloud), members))
        _dots(picture, own, np.tile(np.array(_OBJECT, np.uint8), (len(own), 1)), clouds)
    return picture


def _dots(picture: np.ndarray, pixels: np.ndarray, colours: np.ndarray, clouds: KeyframeClouds) -> None:
    inside = clouds.view.contains(pixels)
    u, v = np.rint(pixels[inside]).astype(int).T
    for du, dv in ((0, 0), (1, 0), (0, 1), (1, 1)):
        picture[np.minimum(v + dv, picture.shape[0] - 1), np.minimum(u + du, picture.shape[1] - 1)] = colours[inside]
