"""Pictures of a reconstructed keyframe as the thesis shows them: Figs. 4.2, 4.3 and 4.4."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from streetscan.benchmarks.rendering import View, render_cloud
from streetscan.calibration.projection import project_pinhole
from streetscan.calibration.reconstruction import Reconstruction
from streetscan.classes import PEDESTRIAN
from streetscan.frames import CameraModel
from streetscan.registration.frame_pictures import write_picture

_BLUE, _RED, _GREY = np.array([30, 90, 255]), np.array([230, 30, 30]), np.array([150, 150, 150])
# Frame `camera` to axes that stand upright: x right, y forward, z up.
_UPRIGHT = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
_ERROR_SCALE = 10


def write_pictures(folder: Path, made: Reconstruction, images: Sequence[np.ndarray], masks: np.ndarray | None, camera: CameraModel) -> None:
    """Write `images.png`, `sparse.png`, `dense.png` (Fig. 4.2), `masks.png`, `dynamic.png` (Fig. 4.3), `points.png`, `features.png` and
    `errors.png` (Fig. 4.4; errors ten times as long as they are) into an existing folder, as far as they were made.

    Args:
        folder: to write to.
        made: what became of the keyframe.
        images: n of (H, W, 3) uint8 RGB, rectified.
        masks: (n, H, W) uint8 class of the moving thing at each pixel, or None.
        camera: intrinsics.
    """
    pictures = {"images": _strip(images)}
    if made.sparse is not None:
        s = made.sparse
        image, own = images[made.reference], s.image_of == made.reference
        pixels, rows = s.pixels[own], s.point_of[own]
        hues = _hues(len(s.points))
        pictures["sparse"] = _view(s.points, s.colours, 0.16)
        pictures["points"] = _view(s.points, hues, 0.2)
        pictures["features"] = _dots(image, pixels, hues[rows])
        pictures["dynamic"] = _view(s.points, _by_label(s.labels), 0.12)
        if masks is not None:
            pictures["masks"] = _tint(image, masks[made.reference])
        if made.projection is not None:
            seen = project_pinhole(s.points[rows], camera.K, made.projection.T_camera_sfm)
            pictures["errors"] = _arrows(image, pixels, seen)
    if made.dense is not None and len(made.dense):
        pictures["dense"] = _view(made.dense.points, made.dense.colours, 0.06)
        if masks is not None:
            moving = np.where((made.dense.labels > 0)[:, None], _by_label(made.dense.labels), made.dense.colours)
            pictures["dynamic"] = _view(made.dense.points, moving.astype(np.uint8), 0.06)
    for name, picture in pictures.items():
        write_picture(folder / f"{name}.png", picture)


def _view(points: np.ndarray, colours: np.ndarray, point_size: float) -> np.ndarray:
    """The cloud from behind and above the camera; sizes are relative to the depth of the scene."""
    # A twentieth of the depth most points are within is about a metre in a street; it makes the view the same without a unit.
    unit = max(float(np.quantile(points[:, 2], 0.8)), 1e-6) / 20
    view = View(position=(0.0, -9 * unit, 6 * unit), target=(0.0, 12 * unit, 1.5 * unit))
    return render_cloud(points @ _UPRIGHT.T, colours, view, point_size * unit, background=(250, 250, 250), edge_shading=0.3)


def _strip(images: Sequence[np.ndarray]) -> np.ndarray:
    """All images, four in a row, a third of their size."""
    small = [cv2.resize(image, None, fx=1 / 3, fy=1 / 3, interpolation=cv2.INTER_AREA) for image in images]
    small += [np.full_like(small[0], 255)] * (-len(small) % 4)
    return np.vstack([np.hstack(small[i : i + 4]) for i in range(0, len(small), 4)])


def _by_label(labels: np.ndarray) -> np.ndarray:
    """Thesis Fig. 4.3: vehicles red, pedestrians blue, all else grey."""
    return np.select([(labels == PEDESTRIAN)[:, None], (labels > 0)[:, None]], [_BLUE, _RED], _GREY).astype(np.uint8)


def _tint(image: np.ndarray, mask: np.ndarray) -> np.ndarray:
    colours = _by_label(mask.ravel()).reshape(image.shape)
    return np.where((mask > 0)[..., None], image // 2 + colours // 2, image).astype(np.uint8)


def _hues(n: int) -> np.ndarray:
    """n colours, uint8 (n, 3), far apart for neighbouring numbers."""
    hues = (np.arange(n) * 0.618034 % 1 * 180).astype(np.uint8)
    return cv2.cvtColor(np.stack([hues, np.full_like(hues, 220), np.full_like(hues, 235)], axis=1)[None], cv2.COLOR_HSV2RGB)[0]


def _dots(image: np.ndarray, pixels: np.ndarray, colours: np.ndarray) -> np.ndarray:
    picture = image.copy()
    for (u, v), colour in zip(np.rint(pixels).astype(int).tolist(), colours.tolist(), strict=True):
        cv2.circle(picture, (u, v), 3, colour, -1, cv2.LINE_AA)
    return picture


def _arrows(image: np.ndarray, observed: np.ndarray, projected: np.ndarray) -> np.ndarray:
    picture = image // 2
    for at, seen in zip(observed, projected, strict=True):
        if np.isfinite(seen).all():
            start, end = at, at + _ERROR_SCALE * (seen - at)
            cv2.line(picture, np.rint(start).astype(int).tolist(), np.rint(end).astype(int).tolist(), (255, 220, 0), 1, cv2.LINE_AA)
            cv2.circle(picture, np.rint(start).astype(int).tolist(), 2, (0, 255, 120), -1, cv2.LINE_AA)
    return picture
