"""A camera on a vehicle in a simulated street: lens distortion, exposure with motion blur, noise, automatic exposure.

Every ray has its own time within the exposure, so the blur of what moves, and of what is passed, comes by itself (global
shutter: all pixels share the exposure). The ray through a pixel's centre at mid-exposure tells what the pixel shows, in
the picture and in its truth; more rays follow where the picture has edges or moves.

Source: Nagy (2020), 4.1.2 (FLIR Blackfly USB3, 1288 x 964, 25-30 pictures a second; N-201) and A.1.1 (six cameras on the
mapping vehicle).
"""

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numba
import numpy as np
from scipy.spatial.transform import Rotation

from streetscan.errors import BadInput
from streetscan.frames import CameraModel
from streetscan.simulation.daylight import Daylight, Lighting
from streetscan.simulation.raycasting import SceneCaster
from streetscan.simulation.recording import Trajectory

# Poses are laid down this often within one exposure, linear between.
_POSES_PER_EXPOSURE = 17
_CHUNK_RAYS = 1_300_000
# An edge fainter than this (difference over sum of both sides) is left as it is.
_LEAST_EDGE = 0.04
# R_vehicle_camera of a camera that looks forward: x right, y down, z forward in a frame of x forward, y left, z up.
_FORWARD = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])


@dataclass(frozen=True)
class Camera:
    """Lens, sensor and exposure of a camera; pixel centres at integers.

    Attributes:
        width, height: pixels.
        focal_px: focal length. ASSUME: 1000 pixels, 66 degrees wide; the thesis' zoom lens (15-50 mm) leaves it open.
        centre_px: (x, y) principal point; the middle of the picture when None.
        distortion: (k1, k2, p1, p2) of the plumb-bob model.
        exposure_s: (shortest, longest) exposure the automatic may choose; equal values fix it.
        largest_gain: of the amplifier, once the longest exposure is not enough.
        saturation_s: exposure in which a white board in the noon sun just saturates at gain 1.
        full_well: electrons at saturation.
        read_noise: electrons.
        target: mean of the linear picture the automatic aims at, 1 is saturation.
        edge_rays: more rays for a pixel on an edge.
        blur_rays: most rays more for a pixel that moves during the exposure, one for each pixel of the way.
    """

    width: int = 1288
    height: int = 964
    focal_px: float = 1000.0
    centre_px: tuple[float, float] | None = None
    distortion: tuple[float, float, float, float] = (-0.17, 0.05, 4e-4, -3e-4)
    exposure_s: tuple[float, float] = (5e-5, 8e-3)
    largest_gain: float = 16.0
    saturation_s: float = 1.2e-3
    full_well: float = 10_000.0
    read_noise: float = 12.0
    target: float = 0.20
    edge_rays: int = 3
    blur_rays: int = 8

    def __post_init__(self):
        if not 0 < self.exposure_s[0] <= self.exposure_s[1]:
            raise BadInput("camera.exposure_s", f"{list(self.exposure_s)}", "give the shortest exposure first, then the longest")
        corners = np.array([[0, 0], [1, 0], [0, 1], [1, 1]]) * [self.width - 1, self.height - 1]
        farthest = np.linalg.norm(corners - self.model.K[:2, 2], axis=1).max() / self.focal_px
        if farthest >= (reach := _lens_reach(*self.distortion[:2])):
            found = f"{list(self.distortion)} shows nothing beyond {reach * self.focal_px:.0f} pixels from the middle"
            raise BadInput("camera.distortion", found, "make the lens bend less, or focal_px longer")

    @property
    def model(self) -> CameraModel:
        """Its intrinsics; the rectified picture keeps the camera matrix."""
        cx, cy = self.centre_px or ((self.width - 1) / 2, (self.height - 1) / 2)
        K = np.array([[self.focal_px, 0, cx], [0, self.focal_px, cy], [0, 0, 1.0]])
        return CameraModel(
            self.width, self.height, K, np.array([*self.distortion, 0.0]), "plumb_bob", np.concatenate([K, np.zeros((3, 1))], axis=1)
        )


@dataclass
class AutoExposure:
    """What the camera's automatic has chosen for the next picture; `render` updates it.

    Attributes:
        exposure_s: time.
        gain: amplification, 1 or more.
        pace: share of the way to the right exposure (in logarithms) taken from one picture to the next.
    """

    exposure_s: float = 1.5e-3
    gain: float = 1.0
    pace: float = 0.35

    def adjust(self, factor: float, camera: Camera) -> None:
        """Multiply the exposure by a factor: with time as long as it lasts, then with gain."""
        light = self.exposure_s * self.gain * factor
        self.exposure_s = float(np.clip(light, *camera.exposure_s))
        self.gain = float(np.clip(light / self.exposure_s, 1.0, camera.largest_gain))


@dataclass
class RenderedImage:
    """A picture and its truth.

    Attributes:
        rgb: (H, W, 3) uint8, sRGB.
        instances: (H, W) uint32 object at each pixel's centre at mid-exposure, 0 for ground and sky.
        classes: (H, W) uint8 class of that object, moving or not; 255 for the sky and what no class describes.
        exposure_s, gain: what it was taken with.
    """

    rgb: np.ndarray
    instances: np.ndarray
    classes: np.ndarray
    exposure_s: float
    gain: float


def mount_camera(position_m: tuple[float, float, float], yaw_deg: float = 0.0, pitch_deg: float = 0.0, roll_deg: float = 0.0) -> np.ndarray:
    """T_vehicle_camera (4, 4) of a camera at a place on the vehicle.

    Args:
        position_m: in the vehicle frame.
        yaw_deg: of the viewing direction, counter-clockwise from forward.
        pitch_deg: downwards.
        roll_deg: about the viewing direction.
    """
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("ZYX", [yaw_deg, pitch_deg, roll_deg], degrees=True).as_matrix() @ _FORWARD
    T[:3, 3] = position_m
    return T


def _lens_reach(k1: float, k2: float) -> float:
    """How far from the middle, over the focal length, a lens shows anything before its distortion turns back; inf when it never does."""
    squares = np.roots([5 * k2, 3 * k1, 1.0])  # of the radius, where the distorted one stops growing
    turns = squares.real[(np.abs(squares.imag) < 1e-12) & (squares.real > 0)]
    if not len(turns):
        return np.inf
    square = turns.min()
    return float(np.sqrt(square) * (1 + square * (k1 + square * k2)))


def project(points_camera: np.ndarray, model: CameraModel) -> np.ndarray:
    """(n, 2) float64 distorted pixel coordinates of (n, 3) points in the camera frame; NaN for points not in front of it."""
    points = np.asarray(points_camera, np.float64)
    xy = np.full((len(points), 2), np.nan)
    ahead = points[:, 2] > 0
    xy[ahead] = points[ahead, :2] / points[ahead, 2:]
    return _distort(xy, model.D) * model.K[[0, 1], [0, 1]] + model.K[:2, 2]


def pixel_rays(pixels: np.ndarray, model: CameraModel) -> np.ndarray:
    """(n, 2) float64 x / z and y / z in the camera frame of distorted pixel coordinates (n, 2), exact to 1e-9."""
    distorted = (np.asarray(pixels, np.float64) - model.K[:2, 2]) / model.K[[0, 1], [0, 1]]
    xy = distorted.copy()
    step = 1e-6
    for _ in range(20):
        here = _distort(xy, model.D)
        right, down = ((_distort(xy + step * e, model.D) - here) / step for e in np.eye(2))
        error = distorted - here
        determinant = right[:, 0] * down[:, 1] - down[:, 0] * right[:, 1]
        xy[:, 0] += (error[:, 0] * down[:, 1] - down[:, 0] * error[:, 1]) / determinant
        xy[:, 1] += (right[:, 0] * error[:, 1] - error[:, 0] * right[:, 1]) / determinant
        if np.abs(error).max(initial=0.0) < 1e-10:
            break
    return xy


def _distort(xy: np.ndarray, D: np.ndarray) -> np.ndarray:
    """The plumb-bob model on (n, 2) normalised coordinates; D is k1, k2, p1, p2, k3."""
    k1, k2, p1, p2, k3 = D
    x, y = xy.T
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    return np.stack([x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y], axis=1)


@lru_cache(maxsize=8)
def _ray_table(camera: Camera) -> np.ndarray:
    """(H, W, 6) float64: x / z and y / z of each pixel's centre, and their changes per pixel to the right and down."""
    u, v = np.meshgrid(np.arange(-1, camera.width + 1), np.arange(-1, camera.height + 1))
    xy = pixel_rays(np.stack([u, v], axis=-1).reshape(-1, 2), camera.model).reshape(camera.height + 2, camera.width + 2, 2)
    right, down = (xy[1:-1, 2:] - xy[1:-1, :-2]) / 2, (xy[2:, 1:-1] - xy[:-2, 1:-1]) / 2
    return np.concatenate([xy[1:-1, 1:-1], right, down], axis=-1)


@dataclass
class _Poses:
    """Camera poses through one exposure."""

    start_s: float
    end_s: float
    origins: np.ndarray
    rotations: np.ndarray


def _poses(trajectory: Trajectory, T_vehicle_camera: np.ndarray, mid_exposure_s: float, exposure_s: float) -> _Poses:
    start_s, end_s = mid_exposure_s - exposure_s / 2, mid_exposure_s + exposure_s / 2
    positions, rotations = trajectory.at(np.linspace(start_s, end_s, _POSES_PER_EXPOSURE))
    return _Poses(start_s, end_s, positions + rotations @ T_vehicle_camera[:3, 3], rotations @ T_vehicle_camera[:3, :3])


def render(
    caster: SceneCaster,
    trajectory: Trajectory,
    T_vehicle_camera: np.ndarray,
    camera: Camera,
    mid_exposure_s: float,
    auto_exposure: AutoExposure,
    rng: np.random.Generator,
    daylight: Daylight | None = None,
) -> RenderedImage:
    """One picture, whose stamp is the middle of its exposure.

    Args:
        caster: the scene; its span of time holds the exposure.
        trajectory: of the vehicle.
        T_vehicle_camera: (4, 4) where the camera sits.
        camera: its settings.
        mid_exposure_s: the stamp, on the trajectory's clock.
        auto_exposure: exposure and gain of this picture; holds those of the next one afterwards.
        rng: of ray times and noise.
        daylight: sun and sky.
    """
    lighting = _lighting(caster, daylight or Daylight())
    exposure_s, gain = auto_exposure.exposure_s, auto_exposure.gain
    poses = _poses(trajectory, T_vehicle_camera, mid_exposure_s, exposure_s)
    linear, faces = _expose(lighting, camera, poses, rng)
    linear = linear / lighting.white * (exposure_s / camera.saturation_s)
    rgb = _develop(linear, gain, camera, rng)
    auto_exposure.adjust(_correction(linear * gain, camera.target) ** auto_exposure.pace, camera)
    shape = camera.height, camera.width
    hit = faces >= 0
    return RenderedImage(
        rgb,
        np.where(hit, caster.instances[faces], 0).astype(np.uint32).reshape(shape),
        np.where(hit, caster.labels[faces], 255).astype(np.uint8).reshape(shape),
        exposure_s,
        gain,
    )


def settle_exposure(
    caster: SceneCaster,
    trajectory: Trajectory,
    T_vehicle_camera: np.ndarray,
    camera: Camera,
    time_s: float,
    daylight: Daylight | None = None,
) -> AutoExposure:
    """The automatic as it stands after a while in front of this view, from every eighth pixel of every eighth row."""
    lighting = _lighting(caster, daylight or Daylight())
    poses = _poses(trajectory, T_vehicle_camera, time_s, 0.0)
    rows, columns = np.arange(4, camera.height, 8), np.arange(4, camera.width, 8)
    pixels = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2).astype(np.int32)
    seen = _trace(lighting, camera, poses, pixels, np.zeros((len(pixels), 2)), np.full(len(pixels), 0.5))[0]
    auto = AutoExposure()
    linear = seen.radiance / lighting.white / camera.saturation_s
    for _ in range(8):
        auto.adjust(_correction(linear * auto.exposure_s * auto.gain, camera.target), camera)
    return auto


def _lighting(caster: SceneCaster, daylight: Daylight) -> Lighting:
    """The caster's lighting, made once for each daylight."""
    known = caster.__dict__.setdefault("_lightings", {})
    if daylight not in known:
        known[daylight] = Lighting(caster, daylight)
    return known[daylight]


def _correction(linear: np.ndarray, target: float) -> float:
    """Factor that brings the mean of the picture, cut at saturation, to the target; at most 4 or a quarter."""
    mean = float(np.minimum(linear, 1.0).mean())
    return float(np.clip(target / max(mean, 1e-6), 0.25, 4.0))


def _expose(lighting: Lighting, camera: Camera, poses: _Poses, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Linear radiance (H, W, 3), and the triangle (H * W,) at each pixel's centre at mid-exposure."""
    shape = camera.height, camera.width
    pixels = np.stack(np.meshgrid(np.arange(camera.width), np.arange(camera.height)), axis=-1).reshape(-1, 2).astype(np.int32)
    n = len(pixels)
    seen, openness = _trace(lighting, camera, poses, pixels, np.zeros((n, 2)), np.full(n, 0.5), shape=shape)
    on_edges, on_ways = _count_rays(
        seen.hits.faces.reshape(shape),
        seen.hits.actors.reshape(shape),
        seen.hits.distances_m.reshape(shape),
        seen.points.reshape(*shape, 3),
        seen.normals.reshape(*shape, 3),
        seen.sunlit.reshape(shape),
        seen.radiance.reshape(*shape, 3),
        lighting.caster.instances,
        lighting.caster.materials,
        *(lighting.caster.own_poses(seen.hits, np.full(n, t)).reshape(*shape, 4) for t in (poses.start_s, poses.end_s)),
        poses.origins - lighting.caster.origin,
        poses.rotations,
        camera.focal_px,
        camera.edge_rays,
        camera.blur_rays,
    )
    faces, total = seen.hits.faces, seen.radiance.astype(np.float64)
    # The blur of a fast object reaches half its way beyond its mid-exposure outline.
    reach = int(on_ways.max()) // 2
    flat = np.maximum(on_edges, cv2.dilate(on_ways, np.ones((2 * reach + 1,) * 2, np.uint8))).ravel().astype(np.int64)
    order = _tiles(*shape)
    rows = np.repeat(order, flat[order])
    number = np.arange(len(rows)) - np.repeat(np.cumsum(flat[order]) - flat[order], flat[order])
    shifts = rng.random((n, 3))[rows]
    # Evenly spread in the pixel (the R2 sequence) and in time, shifted by chance from pixel to pixel.
    jitter = (shifts[:, :2] + np.outer(number, [0.7548776662, 0.5698402910])) % 1.0 - 0.5
    share = (shifts[:, 2] + number / flat[rows]) % 1.0
    for first in range(0, len(rows), _CHUNK_RAYS):
        part = slice(first, first + _CHUNK_RAYS)
        more = _trace(lighting, camera, poses, pixels[rows[part]], jitter[part], share[part], openness=openness)[0]
        for k in range(3):
            total[:, k] += np.bincount(rows[part], more.radiance[:, k], minlength=n)
    return (total / (1 + flat)[:, None]).reshape(*shape, 3), faces


@lru_cache(maxsize=8)
def _tiles(height: int, width: int, side: int = 16) -> np.ndarray:
    """(height * width,) pixels tile after tile: rays that follow one another then meet the same things, and are cheap to cast together."""
    i, j = np.divmod(np.arange(height * width), width)
    return np.lexsort((j, i, j // side, i // side))


def _trace(lighting: Lighting, camera: Camera, poses: _Poses, pixels, jitter, share, shape=None, openness=None):
    """What rays through pixels (n, 2) see, off-centre by `jitter` (n, 2), at a share (n,) of the exposure.

    With `shape` the rays are a whole picture, and the openness of its places is found and used.
    """
    origins, directions, times_s = _rays(
        pixels, jitter, share, _ray_table(camera), poses.start_s, poses.end_s, poses.origins, poses.rotations
    )
    spread = 1 / camera.focal_px
    if shape is not None:
        return lighting.see_picture(origins, directions, times_s, spread, pixels, shape)
    return lighting.see(origins, directions, times_s, spread, openness, pixels), openness


@numba.njit(cache=True, parallel=True)
def _rays(pixels, jitter, share, table, start_s, end_s, origins, rotations):
    n, last = len(pixels), len(origins) - 1
    starts, directions, times_s = np.empty((n, 3)), np.empty((n, 3), np.float32), np.empty(n)
    for r in numba.prange(n):
        t = table[pixels[r, 1], pixels[r, 0]]
        x = t[0] + jitter[r, 0] * t[2] + jitter[r, 1] * t[4]
        y = t[1] + jitter[r, 0] * t[3] + jitter[r, 1] * t[5]
        length = np.sqrt(x * x + y * y + 1)
        low = min(np.int64(share[r] * last), last - 1)
        f = share[r] * last - low
        times_s[r] = start_s + share[r] * (end_s - start_s)
        for k in range(3):
            starts[r, k] = origins[low, k] + f * (origins[low + 1, k] - origins[low, k])
            a = rotations[low, k, 0] * x + rotations[low, k, 1] * y + rotations[low, k, 2]
            b = rotations[low + 1, k, 0] * x + rotations[low + 1, k, 1] * y + rotations[low + 1, k, 2]
            directions[r, k] = (a + f * (b - a)) / length
    return starts, directions, times_s


@numba.njit(cache=True, parallel=True)
def _count_rays(
    faces,
    actors,
    distances_m,
    points,
    normals,
    sunlit,
    radiance,
    instances,
    materials,
    early,
    late,
    origins,
    rotations,
    focal_px,
    edge_rays,
    blur_rays,
):
    """Twice (H, W) uint8 further rays of each pixel: where it shows another surface than its neighbour, and for the way it moves."""
    height, width = faces.shape
    on_edges, on_ways = np.zeros((height, width), np.uint8), np.zeros((height, width), np.uint8)
    for i in numba.prange(height):
        for j in range(width):
            face, is_edge = faces[i, j], False
            for step in range(4):
                di, dj = ((0, 1), (1, 0), (0, -1), (-1, 0))[step]
                a, b = min(max(i + di, 0), height - 1), min(max(j + dj, 0), width - 1)
                other = faces[a, b]
                if other == face and sunlit[a, b] == sunlit[i, j]:
                    continue
                here, there = 0.0, 0.0
                for k in range(3):
                    here += radiance[i, j, k]
                    there += radiance[a, b, k]
                if abs(here - there) < _LEAST_EDGE * (here + there):
                    continue
                if face < 0 or other < 0 or sunlit[a, b] != sunlit[i, j] or materials[face] != materials[other]:
                    is_edge = True
                    break
                along, off = 0.0, 0.0
                for k in range(3):
                    along += normals[i, j, k] * normals[a, b, k]
                    off += normals[i, j, k] * (points[a, b, k] - points[i, j, k])
                if instances[face] != instances[other] or along < 0.95 or abs(off) > 0.01 + 0.003 * distances_m[i, j]:
                    is_edge = True
                    break
            if is_edge:
                on_edges[i, j] = edge_rays
            # How far the place moves in the picture from the exposure's start to its end.
            if face >= 0:
                ax, ay, az, bx, by, bz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
                for k in range(3):
                    half = 0.5 * (late[i, j, k] - early[i, j, k]) if actors[i, j] >= 0 else 0.0
                    first, last = points[i, j, k] - half - origins[0, k], points[i, j, k] + half - origins[-1, k]
                    ax, ay, az = ax + rotations[0, k, 0] * first, ay + rotations[0, k, 1] * first, az + rotations[0, k, 2] * first
                    bx, by, bz = bx + rotations[-1, k, 0] * last, by + rotations[-1, k, 1] * last, bz + rotations[-1, k, 2] * last
                az, bz = max(az, 0.1), max(bz, 0.1)
                moved = focal_px * np.sqrt((ax / az - bx / bz) ** 2 + (ay / az - by / bz) ** 2)
                # Up to a pixel's way the ray at mid-exposure does.
                on_ways[i, j] = min(np.int64(np.ceil(max(moved - 0.9, 0.0))), blur_rays)
    return on_edges, on_ways


def _develop(linear: np.ndarray, gain: float, camera: Camera, rng: np.random.Generator) -> np.ndarray:
    """(H, W, 3) uint8 sRGB of linear values, 1 is saturation at gain 1: shot noise, read noise, full well, 8 bits."""
    electrons = np.clip(linear.astype(np.float32), 0, 1) * np.float32(camera.full_well)
    electrons += np.sqrt(electrons + np.float32(camera.read_noise**2)) * rng.standard_normal(electrons.shape, np.float32)
    steps = np.clip(electrons * np.float32(gain / camera.full_well * (len(_LINEAR_TO_SRGB) - 1)) + 0.5, 0, len(_LINEAR_TO_SRGB) - 1)
    return _LINEAR_TO_SRGB[steps.astype(np.uint16)]


def _linear_to_srgb() -> np.ndarray:
    v = np.linspace(0, 1, 16_384)
    return np.round(255 * np.where(v <= 0.0031308, 12.92 * v, 1.055 * v ** (1 / 2.4) - 0.055)).astype(np.uint8)


_LINEAR_TO_SRGB = _linear_to_srgb()
