"""A dense cloud from images whose cameras are known: PatchMatch stereo on the CPU, consistency over the views, fusion.

Source: Nagy (2020), 4.3.1 (6) (PatchMatch, N-212); Barnes et al. (2009) and Bleyer et al. (2011) for the method.

A pixel's hypothesis is a plane, held as inverse depth and its slope along the image's axes: inverse depth of a plane is linear in the
pixel, so a neighbour's plane is carried over by two products, and a pixel x of the patch with inverse depth w lies in another image at
A x + w b with A = K R K^-1 and b = K t. Bleyer's normals would say the same at the cost of a homography per hypothesis.

ASSUME: hypotheses start from the sparse points (inverse depth linear over their Delaunay triangles), not from chance: a camera that drives
forward has its far points in the middle of the image, where a random depth hardly ever is the right one.

ASSUME: a hypothesis' cost is the mean over all chosen images that see the patch of 1 - NCC, truncated. The mean of the best alone
would prefer the nearest images, which tell depth worst.

Equal inputs give equal outputs for any number of threads: pixels of one colour of a chessboard depend on the other colour alone.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numba
import numpy as np
from numba import njit, prange
from scipy.interpolate import LinearNDInterpolator, NearestNDInterpolator
from scipy.spatial import QhullError

from streetscan.calibration.sfm import ReconstructionFailed, SparseModel
from streetscan.errors import BadInput

# Costs above this count as this: a patch that is hidden in an image says nothing more than that.
_TRUNCATED = 0.9
_BAD = 2.0
# Neighbours whose planes are tried, in grid steps; all are of the other colour of the chessboard.
_NEIGHBOURS = np.array([(0, 1), (0, -1), (1, 0), (-1, 0), (0, 5), (0, -5), (5, 0), (-5, 0)])


@dataclass(frozen=True)
class DensificationSettings:
    """How dense clouds are made.

    Attributes:
        n_maps: depth maps, of images spread evenly over the keyframe.
        n_sources: other images each map is compared with.
        step_px: distance of the pixels that get a depth.
        patch_radius: samples of a patch to either side of its middle.
        patch_step_px: distance of its samples.
        n_iterations: rounds of spreading and changing planes.
        min_texture: least deviation of the grey levels of a patch; sky and white walls have less.
        max_cost: largest cost that is believed.
        max_error_px: largest way between a pixel and its point seen by way of another map.
        max_difference: largest relative difference of two maps' depths of a point.
        min_views: maps that must agree on a point, its own included.
        min_parallax_px: a point that moves by less between the first and the last camera is too far to be placed.
    """

    n_maps: int = 4
    n_sources: int = 4
    step_px: int = 2
    patch_radius: int = 3
    patch_step_px: int = 2
    n_iterations: int = 3
    min_texture: float = 2.0
    max_cost: float = 0.4
    max_error_px: float = 1.0
    max_difference: float = 0.01
    min_views: int = 2
    min_parallax_px: float = 8.0

    def __post_init__(self):
        if not 2 <= self.min_views <= self.n_maps:
            found = f"{self.min_views} of n_maps {self.n_maps}"
            raise BadInput("reconstruct_keyframe.densification.min_views", found, "let 2 <= min_views <= n_maps")


@dataclass
class DenseCloud:
    """Fused points.

    Attributes:
        points: (N, 3) float64, frame `sfm`.
        colours: (N, 3) uint8, RGB.
        n_views: (N,) uint8 maps that agree.
        labels: (N,) uint8: 0 static, else the class of the moving thing.
    """

    points: np.ndarray
    colours: np.ndarray
    n_views: np.ndarray
    labels: np.ndarray

    def __len__(self) -> int:
        return len(self.points)


@dataclass
class DepthMap:
    """Depths of one image on a grid: inverse (h, w) float32 (0: none), cost (h, w) float32; row i, column j is pixel (j, i) * step_px."""

    image: int
    inverse: np.ndarray
    cost: np.ndarray


def densify(
    images: Sequence[np.ndarray],
    K: np.ndarray,
    model: SparseModel,
    masks: np.ndarray | None = None,
    settings: DensificationSettings = DensificationSettings(),
    seed: int = 0,
    n_threads: int = 1,
) -> DenseCloud:
    """The dense cloud of a keyframe.

    Args:
        images: n of (H, W, 3) uint8 RGB, rectified.
        K: (3, 3) camera matrix, pixel centres at integers.
        model: their cameras and sparse points; images that were not registered are left out.
        masks: (n, H, W) uint8 class of the moving thing at each pixel, 0 for none; None marks nothing.
        settings: see DensificationSettings.
        seed: of the changes that are tried.
        n_threads: of the depth maps; changes no number.
    Raises:
        ReconstructionFailed: `not_dense` when fewer maps than must agree on a point can be started, since images see too few static points.
    """
    numba.set_num_threads(min(n_threads, numba.config.NUMBA_NUM_THREADS))
    used = np.flatnonzero(model.is_registered)
    greys = np.stack([cv2.cvtColor(images[i], cv2.COLOR_RGB2GRAY) for i in used]).astype(np.float32)
    poses = model.T_camera_sfm[used]
    places = np.unique(np.linspace(0, len(used) - 1, settings.n_maps).round().astype(int))
    starts = {int(place): _start_planes(place, greys.shape[1:], poses, used, model, settings) for place in places}
    maps = [_depth_map(place, greys, K, poses, *start, settings, seed) for place, start in starts.items() if start is not None]
    if len(maps) < settings.min_views:
        found = f"{len(maps)} of {len(places)} images see enough static points; {settings.min_views} or more are needed"
        raise ReconstructionFailed("not_dense", found)
    return _fuse(maps, [images[i] for i in used], K, poses, None if masks is None else masks[used], settings)


def _sources(place: int, n: int, n_sources: int) -> np.ndarray:
    """Images a map is compared with: spread over the others from the farthest to the nearest."""
    others = sorted((i for i in range(n) if i != place), key=lambda i: (abs(i - place), i))
    chosen = np.unique(np.linspace(0, len(others) - 1, min(n_sources, len(others))).round().astype(int))
    # The farthest first: it tells soonest that a plane is wrong.
    return np.array([others[i] for i in chosen[::-1]])


def _projection(K: np.ndarray, T_source: np.ndarray, T_reference: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A (3, 3) and b (3,): pixel x of the reference with inverse depth w lies at A x + w b in the source."""
    T = T_source @ np.linalg.inv(T_reference)
    return K @ T[:3, :3] @ np.linalg.inv(K), K @ T[:3, 3]


def _depth_map(place: int, greys, K, poses, planes, limit: float, s: DensificationSettings, seed: int) -> DepthMap:
    """PatchMatch of one image from its first planes; `place` counts the registered images."""
    sources = _sources(place, len(poses), s.n_sources)
    pairs = [_projection(K, poses[i], poses[place]) for i in sources]
    A, b = (np.ascontiguousarray(np.stack(m), np.float64) for m in zip(*pairs, strict=True))
    is_textured = _texture(greys[place], s)
    cost = np.full(planes.shape[:2], _BAD, np.float32)
    arguments = (greys[place], greys[sources], A, b, s.step_px, s.patch_radius, s.patch_step_px)
    _score(planes, cost, is_textured, *arguments)
    for iteration in range(s.n_iterations):
        for colour in range(2):
            _improve(planes, cost, is_textured, *arguments, colour, iteration, limit, seed + place, _NEIGHBOURS)
    _sharpen(planes, cost, is_textured, *arguments, limit)
    inverse = np.where((cost <= s.max_cost) & is_textured, planes[..., 0], 0).astype(np.float32)
    # From the first to the last camera, a point at inverse depth w moves by about w times this.
    ends = [_projection(K, poses[i], poses[place]) for i in (0, len(poses) - 1) if i != place]
    return DepthMap(place, _drop_far(inverse, ends, s), cost)


def _drop_far(inverse: np.ndarray, pairs, s: DensificationSettings) -> np.ndarray:
    """The map without the points that move by less than `min_parallax_px` to the farthest camera because of their depth."""
    v, u = np.mgrid[: inverse.shape[0], : inverse.shape[1]] * s.step_px
    x = np.stack([u, v, np.ones_like(u)]).reshape(3, -1).astype(np.float64)
    parallax = np.zeros(x.shape[1])
    for A, b in pairs:
        infinite = A @ x
        here = infinite + inverse.ravel() * b[:, None]
        with np.errstate(divide="ignore", invalid="ignore"):
            way = np.linalg.norm(here[:2] / here[2] - infinite[:2] / infinite[2], axis=0)
        parallax = np.fmax(parallax, way)
    return np.where(parallax.reshape(inverse.shape) >= s.min_parallax_px, inverse, 0).astype(np.float32)


def _start_planes(place: int, size, poses, used, model: SparseModel, s: DensificationSettings) -> tuple[np.ndarray, float] | None:
    """Planes (h, w, 3) float32 from the sparse points the image observes, and the largest inverse depth that is tried.

    None where the points in front of the camera are fewer than three, or lie on one line of the image.
    """
    rows = (model.image_of == used[place]) & (model.labels[model.point_of] == 0)
    pixels, points = model.pixels[rows], model.points[model.point_of[rows]]
    depths = points @ poses[place][2, :3] + poses[place][2, 3]
    pixels, inverse = pixels[depths > 0], 1 / depths[depths > 0]
    if len(pixels) < 3:
        return None
    try:
        interpolate = LinearNDInterpolator(pixels, inverse)
    except QhullError:
        return None
    grid = np.mgrid[0 : size[0] : s.step_px, 0 : size[1] : s.step_px]
    where = np.stack([grid[1], grid[0]], axis=-1).astype(np.float64)
    values = NearestNDInterpolator(pixels, inverse)(where)
    linear = interpolate(where)
    values = np.where(np.isnan(linear), values, linear)
    slopes = np.gradient(values, s.step_px)
    planes = np.stack([values, slopes[1], slopes[0]], axis=-1).astype(np.float32)
    # ASSUME: nothing is more than three times as near as the nearest sparse points.
    return planes, float(3 * np.quantile(inverse, 0.99))


def _texture(grey: np.ndarray, s: DensificationSettings) -> np.ndarray:
    """Whether the patch of each pixel of the grid has texture, (h, w) bool."""
    side = 2 * s.patch_radius * s.patch_step_px + 1
    mean, square = (cv2.blur(image, (side, side)) for image in (grey, grey * grey))
    return (np.sqrt(np.maximum(square - mean * mean, 0)) >= s.min_texture)[:: s.step_px, :: s.step_px]


@njit(inline="always")
def _next(state):
    """The next state of a 64-bit xorshift generator."""
    state ^= state << np.uint64(13)
    state ^= state >> np.uint64(7)
    state ^= state << np.uint64(17)
    return state


@njit(inline="always")
def _uniform(state):
    """A state as a number in [-1, 1)."""
    return (np.float64(state >> np.uint64(11)) / 9007199254740992.0) * 2.0 - 1.0


@njit(cache=True, nogil=True, fastmath=True)
def _weigh(grey, u, v, radius, step, values, weights):
    """Grey levels of a patch and their weights, which fall off with distance and difference from the middle. False at the border."""
    height, width = grey.shape
    if u < radius * step or v < radius * step or u >= width - radius * step or v >= height - radius * step:
        return False
    middle, total, mean = grey[v, u], 0.0, 0.0
    n = 0
    for i in range(-radius, radius + 1):
        for j in range(-radius, radius + 1):
            value = grey[v + i * step, u + j * step]
            # ASSUME: deviations of a patch radius and 20 grey levels.
            weight = np.exp(-0.5 * (i * i + j * j) / (radius * radius) - abs(value - middle) / 40.0)
            values[n], weights[n] = value, weight
            total += weight
            mean += weight * value
            n += 1
    mean /= total
    for k in range(n):
        weights[k] /= total
        values[k] -= mean
    return True


@njit(cache=True, nogil=True, fastmath=True)
def _cost(sources, A, b, u, v, w, wu, wv, radius, step, values, weights, limit):
    """Mean truncated 1 - NCC of a plane over the sources that see the patch; _BAD when fewer than two (or all) do.

    What can no longer come below `limit` is given up and _BAD, too.
    """
    n_sources, height, width = sources.shape
    variance = 0.0
    for k in range(len(values)):
        variance += weights[k] * values[k] * values[k]
    reach = radius * step
    total, n_seen = 0.0, 0
    for s in range(n_sources):
        # On a plane, numerators and denominator of the source's pixel are linear in the pixel.
        xu, xv = A[s, 0, 0] + wu * b[s, 0], A[s, 0, 1] + wv * b[s, 0]
        yu, yv = A[s, 1, 0] + wu * b[s, 1], A[s, 1, 1] + wv * b[s, 1]
        zu, zv = A[s, 2, 0] + wu * b[s, 2], A[s, 2, 1] + wv * b[s, 2]
        x0 = A[s, 0, 0] * u + A[s, 0, 1] * v + A[s, 0, 2] + w * b[s, 0]
        y0 = A[s, 1, 0] * u + A[s, 1, 1] * v + A[s, 1, 2] + w * b[s, 1]
        z0 = A[s, 2, 0] * u + A[s, 2, 1] * v + A[s, 2, 2] + w * b[s, 2]
        # A patch whose corners are seen is seen.
        is_seen = True
        for i in (-reach, reach):
            for j in (-reach, reach):
                z = z0 + zu * j + zv * i
                x, y = x0 + xu * j + xv * i, y0 + yu * j + yv * i
                if z < 1e-6 or not (x >= 0.0 and y >= 0.0 and x < (width - 1.001) * z and y < (height - 1.001) * z):
                    is_seen = False
        if not is_seen:
            continue
        mean, square, product = 0.0, 0.0, 0.0
        k = 0
        for i in range(-radius, radius + 1):
            xi, yi, zi = x0 + xv * i * step, y0 + yv * i * step, z0 + zv * i * step
            for j in range(-radius, radius + 1):
                scale = 1.0 / (zi + zu * j * step)
                px, py = (xi + xu * j * step) * scale, (yi + yu * j * step) * scale
                cx, cy = int(px), int(py)
                fx, fy = px - cx, py - cy
                top = sources[s, cy, cx] * (1 - fx) + sources[s, cy, cx + 1] * fx
                bottom = sources[s, cy + 1, cx] * (1 - fx) + sources[s, cy + 1, cx + 1] * fx
                value = top * (1 - fy) + bottom * fy
                weighted = weights[k] * value
                mean += weighted
                square += weighted * value
                product += weighted * values[k]
                k += 1
        spread = (square - mean * mean) * variance
        ncc = product / np.sqrt(spread) if spread > 1e-6 else 0.0
        total += min(1.0 - ncc, _TRUNCATED)
        n_seen += 1
        if total >= limit * (n_seen + n_sources - 1 - s):
            return _BAD
    return total / n_seen if n_seen >= min(2, n_sources) else _BAD


@njit(cache=True, nogil=True, parallel=True)
def _score(planes, cost, is_textured, grey, sources, A, b, grid, radius, step):
    """Costs of the planes as they are."""
    size = (2 * radius + 1) ** 2
    for i in prange(planes.shape[0]):
        values, weights = np.empty(size), np.empty(size)
        for j in range(planes.shape[1]):
            if is_textured[i, j] and _weigh(grey, j * grid, i * grid, radius, step, values, weights):
                w, wu, wv = planes[i, j]
                cost[i, j] = _cost(sources, A, b, j * grid, i * grid, w, wu, wv, radius, step, values, weights, _BAD)


@njit(cache=True, nogil=True, parallel=True)
def _improve(planes, cost, is_textured, grey, sources, A, b, grid, radius, step, colour, iteration, limit, seed, neighbours):
    """Try the neighbours' planes and changes of the own one, on the pixels of one colour."""
    rows, columns = cost.shape
    size = (2 * radius + 1) ** 2
    for i in prange(rows):
        values, weights = np.empty(size), np.empty(size)
        for j in range((i + colour) % 2, columns, 2):
            u, v = j * grid, i * grid
            if not (is_textured[i, j] and _weigh(grey, u, v, radius, step, values, weights)):
                continue
            best, (w, wu, wv) = cost[i, j], planes[i, j]
            for n in range(len(neighbours)):
                a, c = i + neighbours[n, 0], j + neighbours[n, 1]
                if a < 0 or c < 0 or a >= rows or c >= columns or cost[a, c] >= _BAD:
                    continue
                tu, tv = planes[a, c, 1], planes[a, c, 2]
                t = planes[a, c, 0] + tu * (j - c) * grid + tv * (i - a) * grid
                if not 0.0 < t < limit:
                    continue
                new = _cost(sources, A, b, u, v, t, tu, tv, radius, step, values, weights, best)
                if new < best:
                    best, w, wu, wv = new, t, tu, tv
            state = np.uint64(seed * 1000003 + iteration * 7919 + 1) * np.uint64(0x9E3779B97F4A7C15)
            state = _next(_next(state ^ np.uint64(i * columns + j + 1) * np.uint64(0xBF58476D1CE4E5B9)))
            reach = 0.1
            for n in range(3):
                # Depth, slope and both in turn, ever finer.
                state = _next(state)
                t = w * (1 + reach * 0.5**iteration * _uniform(state)) if n != 1 else w
                tu, tv = wu, wv
                if n != 0:
                    state = _next(state)
                    tu = wu + w * reach * 0.5**iteration * _uniform(state) / 12.0
                    state = _next(state)
                    tv = wv + w * reach * 0.5**iteration * _uniform(state) / 12.0
                if 0.0 < t < limit:
                    new = _cost(sources, A, b, u, v, t, tu, tv, radius, step, values, weights, best)
                    if new < best:
                        best, w, wu, wv = new, t, tu, tv
                reach *= 0.3
            cost[i, j], planes[i, j, 0], planes[i, j, 1], planes[i, j, 2] = best, w, wu, wv


@njit(cache=True, nogil=True, parallel=True)
def _sharpen(planes, cost, is_textured, grey, sources, A, b, grid, radius, step, limit):
    """Move every inverse depth to the bottom of the parabola through its cost and those beside it, twice."""
    size = (2 * radius + 1) ** 2
    for i in prange(planes.shape[0]):
        values, weights = np.empty(size), np.empty(size)
        for j in range(planes.shape[1]):
            u, v = j * grid, i * grid
            if cost[i, j] >= _BAD or not _weigh(grey, u, v, radius, step, values, weights):
                continue
            w, wu, wv = planes[i, j]
            best = float(cost[i, j])
            # A step of a third of a pixel in the source where the point moves most.
            most = 1e-9
            for s in range(len(sources)):
                z = A[s, 2, 0] * u + A[s, 2, 1] * v + A[s, 2, 2]
                x, y = A[s, 0, 0] * u + A[s, 0, 1] * v + A[s, 0, 2], A[s, 1, 0] * u + A[s, 1, 1] * v + A[s, 1, 2]
                zw = z + w * b[s, 2]
                du, dv = (b[s, 0] * z - b[s, 2] * x) / (zw * zw), (b[s, 1] * z - b[s, 2] * y) / (zw * zw)
                most = max(most, np.hypot(du, dv))
            h = 0.33 / most
            for _ in range(2):
                if not h < w < limit - h:
                    break
                below = _cost(sources, A, b, u, v, w - h, wu, wv, radius, step, values, weights, _BAD)
                above = _cost(sources, A, b, u, v, w + h, wu, wv, radius, step, values, weights, _BAD)
                bend = below + above - 2 * best
                if bend <= 1e-9 or below >= _BAD or above >= _BAD:
                    break
                t = w + min(max(0.5 * h * (below - above) / bend, -h), h)
                new = _cost(sources, A, b, u, v, t, wu, wv, radius, step, values, weights, _BAD)
                if new > best:
                    break
                w, best, h = t, new, h * 0.5
            planes[i, j, 0], cost[i, j] = w, best


def _fuse(maps: list[DepthMap], images, K, poses, masks, s: DensificationSettings) -> DenseCloud:
    """Points on which maps agree, each once."""
    n, places = len(maps), [m.image for m in maps]
    A, b = np.zeros((n, n, 3, 3)), np.zeros((n, n, 3))
    for i in range(n):
        for j in range(n):
            A[i, j], b[i, j] = _projection(K, poses[places[j]], poses[places[i]])
    inverse = np.stack([m.inverse for m in maps])
    T_sfm_camera = np.linalg.inv(poses[places])
    rays = T_sfm_camera[:, :3, :3] @ np.linalg.inv(K)
    colours = np.stack([images[p][:: s.step_px, :: s.step_px] for p in places])
    labels = np.zeros(inverse.shape, np.uint8) if masks is None else np.stack([masks[p][:: s.step_px, :: s.step_px] for p in places])
    found = _fuse_maps(
        inverse, A, b, rays, T_sfm_camera[:, :3, 3].copy(), colours, labels, s.step_px, s.max_error_px, s.max_difference, s.min_views
    )
    return DenseCloud(*found)


@njit(cache=True, nogil=True)
def _fuse_maps(inverse, A, b, rays, centres, colours, labels, grid, max_error, max_difference, min_views):
    n_maps, rows, columns = inverse.shape
    is_used = np.zeros(inverse.shape, np.bool_)
    capacity = inverse.size
    points, rgb = np.empty((capacity, 3)), np.empty((capacity, 3), np.uint8)
    views, classes = np.empty(capacity, np.uint8), np.empty(capacity, np.uint8)
    n_points = 0
    at = np.empty((n_maps, 2), np.int64)
    for m in range(n_maps):
        for i in range(rows):
            for j in range(columns):
                w = inverse[m, i, j]
                if w <= 0 or is_used[m, i, j]:
                    continue
                x, y = j * grid, i * grid
                n_views = 1
                at[:, 0] = -1
                at[m] = i, j
                for k in range(n_maps):
                    if k == m:
                        continue
                    q = A[m, k] @ np.array([x, y, 1.0]) + w * b[m, k]
                    if q[2] <= 0:
                        continue
                    c, a = int(np.rint(q[0] / q[2] / grid)), int(np.rint(q[1] / q[2] / grid))
                    if a < 0 or c < 0 or a >= rows or c >= columns or inverse[k, a, c] <= 0:
                        continue
                    # Depth in the other camera, q[2] / w with K's last row (0, 0, 1), against what that map says.
                    if abs(q[2] / w * inverse[k, a, c] - 1) > max_difference:
                        continue
                    back = A[k, m] @ np.array([q[0] / q[2], q[1] / q[2], 1.0]) + inverse[k, a, c] * b[k, m]
                    if np.hypot(back[0] / back[2] - x, back[1] / back[2] - y) > max_error:
                        continue
                    at[k] = a, c
                    n_views += 1
                if n_views < min_views:
                    continue
                point, colour, n_moving = np.zeros(3), np.zeros(3), 0
                label = 0
                for k in range(n_maps):
                    if at[k, 0] < 0:
                        continue
                    a, c = at[k]
                    is_used[k, a, c] = True
                    # The maps' points lie side by side on the surface, less than a pixel of the grid apart.
                    point += centres[k] + rays[k] @ np.array([c * grid, a * grid, 1.0]) / inverse[k, a, c]
                    for d in range(3):
                        colour[d] += colours[k, a, c, d]
                    if labels[k, a, c] > 0:
                        n_moving += 1
                        label = labels[k, a, c]
                points[n_points] = point / n_views
                for d in range(3):
                    rgb[n_points, d] = np.uint8(colour[d] / n_views + 0.5)
                views[n_points], classes[n_points] = n_views, label if 2 * n_moving >= n_views else 0
                n_points += 1
    return points[:n_points].copy(), rgb[:n_points].copy(), views[:n_points].copy(), classes[:n_points].copy()
