"""Pictures of point clouds without a display: every point a small square with its depth, the nearest one seen."""

from dataclasses import dataclass

import numba
import numpy as np

_BATCH = 2_000_000


@dataclass(frozen=True)
class View:
    """A perspective view.

    Attributes:
        position: (x, y, z) of the eye, metres, frame of the points.
        target: (x, y, z) of the picture's middle.
        width_px, height_px: size of the picture.
        field_of_view_deg: horizontally.
        near_m: nothing nearer is drawn.
    """

    position: tuple[float, float, float]
    target: tuple[float, float, float]
    width_px: int = 1280
    height_px: int = 720
    field_of_view_deg: float = 70.0
    near_m: float = 0.3


def render_cloud(
    points: np.ndarray,
    colours: np.ndarray,
    view: View,
    point_size_m: float = 0.04,
    background: tuple[int, int, int] = (255, 255, 255),
    edge_shading: float = 0.6,
) -> np.ndarray:
    """A perspective picture of a point cloud.

    Args:
        points: (N, 3) float, metres; z up.
        colours: (N, 3) uint8 RGB.
        view: the camera.
        point_size_m: edge of a point's square in space; never less than one pixel.
        background: where no point is.
        edge_shading: darkens pixels behind their neighbours (eye-dome lighting), so that shapes read without light; 0 is off.
    Returns:
        (height, width, 3) uint8 RGB.
    """
    eye, target = np.asarray(view.position, np.float64), np.asarray(view.target, np.float64)
    forward = (target - eye) / np.linalg.norm(target - eye)
    up = np.array([0.0, 0.0, 1.0]) if abs(forward[2]) < 0.999 else np.array([0.0, 1.0, 0.0])
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    axes = np.stack([right, np.cross(forward, right), forward])
    focal_px = view.width_px / 2 / np.tan(np.radians(view.field_of_view_deg) / 2)
    image, depth = _blank(view.height_px, view.width_px, background)
    for first in range(0, len(points), _BATCH):
        seen = (points[first : first + _BATCH] - eye) @ axes.T
        rows = np.flatnonzero(seen[:, 2] > view.near_m)
        z = seen[rows, 2]
        u = seen[rows, 0] / z * focal_px + (view.width_px - 1) / 2
        v = seen[rows, 1] / z * focal_px + (view.height_px - 1) / 2
        _splat(u, v, z, point_size_m * focal_px / z / 2, np.ascontiguousarray(colours[first : first + _BATCH][rows]), image, depth)
    return _shade_edges(image, depth, edge_shading)


def render_top(
    points: np.ndarray,
    colours: np.ndarray,
    pixel_m: float = 0.1,
    bounds_m: tuple[float, float, float, float] | None = None,
    point_size_m: float = 0.0,
    background: tuple[int, int, int] = (255, 255, 255),
) -> np.ndarray:
    """The cloud from straight above, north up: the highest point of each pixel.

    Args:
        points: (N, 3) float, metres.
        colours: (N, 3) uint8 RGB.
        pixel_m: edge of a pixel.
        bounds_m: (x low, y low, x high, y high); of the points when not given.
        point_size_m: edge of a point's square; never less than one pixel.
        background: where no point is.
    Returns:
        (height, width, 3) uint8 RGB.
    """
    if bounds_m is None:
        low, high = (points[:, :2].min(axis=0), points[:, :2].max(axis=0)) if len(points) else (np.zeros(2), np.ones(2))
    else:
        low, high = np.array(bounds_m[:2]), np.array(bounds_m[2:])
    width, height = np.maximum(np.ceil((high - low) / pixel_m).astype(int), 1)
    image, depth = _blank(height, width, background)
    for first in range(0, len(points), _BATCH):
        part = points[first : first + _BATCH]
        u, v = (part[:, 0] - low[0]) / pixel_m - 0.5, (high[1] - part[:, 1]) / pixel_m - 0.5
        radius = np.full(len(part), point_size_m / pixel_m / 2)
        _splat(u, v, -part[:, 2], radius, np.ascontiguousarray(colours[first : first + _BATCH]), image, depth)
    return image


def grey_levels(values: np.ndarray, low_percent: float = 1.0, high_percent: float = 99.0) -> np.ndarray:
    """(N, 3) uint8 greys of a scalar field (intensity, height), stretched between two percentiles."""
    values = np.asarray(values, np.float64)
    if len(values) == 0:
        return np.empty((0, 3), np.uint8)
    low, high = np.percentile(values, [low_percent, high_percent])
    grey = np.clip((values - low) / max(high - low, 1e-12), 0, 1) * 255
    return np.repeat(grey.astype(np.uint8)[:, None], 3, axis=1)


def _blank(height: int, width: int, background: tuple[int, int, int]) -> tuple[np.ndarray, np.ndarray]:
    image = np.empty((height, width, 3), np.uint8)
    image[:] = background
    return image, np.full((height, width), np.inf)


@numba.njit(cache=True)
def _splat(u, v, z, radius, colours, image, depth):
    height, width = depth.shape
    for i in range(len(u)):
        r = radius[i]
        if not (-r - 1 < u[i] < width + r and -r - 1 < v[i] < height + r):
            continue
        x, y = int(np.floor(u[i] + 0.5)), int(np.floor(v[i] + 0.5))
        reach = int(min(r, 12.0))
        for row in range(max(y - reach, 0), min(y + reach + 1, height)):
            for column in range(max(x - reach, 0), min(x + reach + 1, width)):
                if z[i] < depth[row, column]:
                    depth[row, column] = z[i]
                    image[row, column] = colours[i]


def _shade_edges(image: np.ndarray, depth: np.ndarray, strength: float) -> np.ndarray:
    """Eye-dome lighting (Boucheny 2009): a pixel darkens by how far it lies behind its neighbours, in logarithmic depth."""
    drawn = np.isfinite(depth)
    if strength <= 0 or not drawn.any():
        return image
    logs = np.where(drawn, np.log2(np.where(drawn, depth, 1)), np.nan)
    padded = np.pad(logs, 1, constant_values=np.nan)
    height, width = depth.shape
    behind = np.zeros(depth.shape)
    for dy, dx in ((0, 1), (0, -1), (1, 0), (-1, 0)):
        difference = logs - padded[1 + dy : 1 + dy + height, 1 + dx : 1 + dx + width]
        behind += np.nan_to_num(np.clip(difference, 0, 0.15))
    light = np.where(drawn, np.exp(-strength * 5 * behind), 1)
    return (image * light[..., None]).astype(np.uint8)
