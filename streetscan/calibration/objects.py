"""Objects of a cloud, lidar or camera alike: ground, sparse voxel structure, connected components, shape categories.

Source: Nagy (2020), 4.3.2.1 (N-214 to N-220). A voxel exists only where a point is; voxels above each other form a pillar. Pillars that
touch are merged, and the blobs are then split where their voxels do not touch, such as a crown above a post; what is left are the
components of touching voxels, which we find at once.

ASSUME: the spatially adaptive terrain filter is the one that localization uses (`streetscan.localization.ground`), on a cloud that was
made level. It serves both clouds: one of images is thinned and may be rougher, and neither has to be about level at first.

ASSUME: principal components are those of a voxel and its neighbours together. In a single voxel of 0.2 m most lidar points lie on one
ring, which would make walls linear in one cloud and flat in the other.

ASSUME: the thesis' conditions overlap (flatness above 0.6 holds wherever the third share is below 0.4, scatter is asked above 0.1), so
they are asked in the order linear, scattered, flat, on eigenvalues that sum to 1.
"""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from streetscan.errors import BadInput
from streetscan.geometry import apply, invert
from streetscan.localization.ground import GroundSettings, find_ground
from streetscan.localization.keypoints import ObjectSet, describe_objects
from streetscan.localization.localizer import level_of
from streetscan.registration.ndt import thin_points
from streetscan.voxels import pack_keys

# Shape categories of objects and voxels; of an object whose voxels have too few points for any, UNSHAPED.
LINEAR, FLAT, SCATTERED, UNSHAPED = 0, 1, 2, 3
SHAPES = {LINEAR: "linear", FLAT: "flat", SCATTERED: "scattered", UNSHAPED: "unshaped"}


@dataclass(frozen=True)
class ObjectSettings:
    """Which blobs of a cloud are objects; lengths in metres.

    Attributes:
        range_m: horizontal distance within which a cloud is used. ASSUME: 50, where the thesis takes 15; in a wide street nothing stands
            nearer than 30 in a camera's view.
        thin_m: points are averaged in cubes of this edge first, so that both clouds have about the same density.
        flat_m: cells of 0.2 m whose heights differ by less are ground candidates (thesis ch. 3: 0.1).
        above_m: points lower above the ground are ground.
        max_height_m: points higher above the ground are left out. ASSUME: what both sensors see of a column nearby; a lidar on a car
            looks up by 2 degrees only.
        voxel_m: edge of a voxel (thesis: 0.2).
        is_split: split blobs of pillars along the height; without, Fig. 4.5(d).
        min_voxels: smaller blobs are noise.
        min_height_m: lower blobs are kerbs and low plants.
        max_size_m: longer blobs are walls, of which each sensor sees another part, so that their centres do not correspond.
        min_linearity, min_flatness, min_scatter: shares of the eigenvalues (thesis: 0.7, 0.6, 0.1).
        min_points: a voxel and its neighbours with fewer points have no shape.
    """

    range_m: float = 50.0
    thin_m: float = 0.05
    flat_m: float = 0.15
    above_m: float = 0.2
    max_height_m: float = 2.5
    voxel_m: float = 0.2
    is_split: bool = True
    min_voxels: int = 4
    min_height_m: float = 0.5
    max_size_m: float = 6.0
    min_linearity: float = 0.7
    min_flatness: float = 0.6
    min_scatter: float = 0.1
    min_points: int = 5

    def __post_init__(self):
        for name in ("range_m", "thin_m", "flat_m", "voxel_m", "max_size_m"):
            if not getattr(self, name) > 0:
                raise BadInput(f"objects.{name}", f"{getattr(self, name)} is not above 0", "give a positive number")
        if not 0 < self.above_m < self.max_height_m:
            raise BadInput("objects.above_m", f"{self.above_m} with max_height_m {self.max_height_m}", "let 0 < above_m < max_height_m")


@dataclass
class CloudObjects:
    """A level cloud and its objects: z is up, z = 0 the ground below the origin.

    Attributes:
        T_level_cloud: (4, 4) from the cloud's own frame; rigid.
        points: (N, 3) float64 thinned points within range, ground too, frame `level`.
        heights_m: (N,) above the local ground.
        objects: boxes and centres of M objects, frame `level`.
        shapes: (M,) uint8 their categories.
        members: (K, 3) float64 points of the objects, grouped, frame `level`.
        starts: (M + 1,) int64 first row of each object in `members`, and K.
        voxels: (V, 3) int32 occupied voxels above the ground, `floor(p / voxel_m)`.
        voxel_shapes: (V,) uint8.
        voxel_m: their edge.
    """

    T_level_cloud: np.ndarray
    points: np.ndarray
    heights_m: np.ndarray
    objects: ObjectSet
    shapes: np.ndarray
    members: np.ndarray
    starts: np.ndarray
    voxels: np.ndarray
    voxel_shapes: np.ndarray
    voxel_m: float

    def __len__(self) -> int:
        return len(self.objects)

    def points_of(self, m: int) -> np.ndarray:
        """(n, 3) the points of an object, frame `level`."""
        return self.members[self.starts[m] : self.starts[m + 1]]


def find_level(points: np.ndarray, T_guess_cloud: np.ndarray, settings: ObjectSettings = ObjectSettings()) -> np.ndarray:
    """The rigid transform T_level_cloud (4, 4) that lays the ground around the origin into z = 0; NaN where no ground is found.

    Args:
        points: (N, 3), metres, frame of the cloud.
        T_guess_cloud: (4, 4) into a frame with its origin at the sensor, x forward and z up within some degrees.
        settings: `range_m`, `thin_m` and `flat_m`.

    The guess is corrected twice: flat cells are few where the guess is degrees off.
    """
    T = np.asarray(T_guess_cloud, np.float64)
    for flat_m in (3 * settings.flat_m, settings.flat_m):
        ground = find_ground(_thinned(apply(T, points), settings), _ground_settings(settings, flat_m))
        if not ground.has_plane:
            return np.full((4, 4), np.nan)
        T = level_of(ground) @ T
        T[2, 3] -= _height_at_origin(ground.plane)
    return T


def _height_at_origin(plane: np.ndarray) -> float:
    """Height of a plane z = a x + b y + c at the origin, along its own normal."""
    return float(plane[2] / np.sqrt(plane[0] ** 2 + plane[1] ** 2 + 1))


def _ground_settings(s: ObjectSettings, flat_m: float) -> GroundSettings:
    return GroundSettings(range_m=s.range_m, flat_m=flat_m)


def _thinned(points: np.ndarray, s: ObjectSettings) -> np.ndarray:
    near = points[np.isfinite(points).all(axis=1)]
    return thin_points(near[np.hypot(near[:, 0], near[:, 1]) < s.range_m], s.thin_m)


def find_objects(points: np.ndarray, T_level_cloud: np.ndarray, settings: ObjectSettings = ObjectSettings()) -> CloudObjects:
    """Objects of a cloud.

    Args:
        points: (N, 3) float, metres, without the points of moving things; NaN points are left out.
        T_level_cloud: (4, 4) of `find_level`.
        settings: see ObjectSettings.
    """
    s = settings
    level = _thinned(apply(T_level_cloud, points), s)
    ground = find_ground(level, _ground_settings(s, s.flat_m))
    near, heights = ground.points.astype(np.float64), ground.heights_m.astype(np.float64)
    standing = near[(heights > s.above_m) & (heights < s.max_height_m)]
    keys, voxel_of = voxelize(standing, s.voxel_m)
    blobs = connect(keys if s.is_split else keys * [1, 1, 0])
    shapes = shape_voxels(standing, keys, voxel_of, s)
    order, starts, chosen = _group(standing, blobs[voxel_of], np.bincount(blobs, minlength=1), s)
    members = standing[order]
    categories = [majority_shape(shapes[blobs == blob]) for blob in chosen]
    return CloudObjects(
        T_level_cloud, near, heights, describe_objects(members, starts), np.array(categories, np.uint8), members, starts, keys, shapes,
        s.voxel_m,
    )  # fmt: skip


def voxelize(points: np.ndarray, size_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Occupied voxels (V, 3) int32, sorted, and the voxel (N,) int64 of each point (N, 3)."""
    if len(points) == 0:
        return np.empty((0, 3), np.int32), np.empty(0, np.int64)
    keys, voxel_of = np.unique(np.floor(points / size_m).astype(np.int32), axis=0, return_inverse=True)
    return keys, voxel_of.reshape(-1)


def connect(keys: np.ndarray) -> np.ndarray:
    """Component (V,) int64 of each voxel (V, 3): voxels that touch by a face, an edge or a corner belong together."""
    if len(keys) == 0:
        return np.empty(0, np.int64)
    unique, own = np.unique(pack_keys(keys), return_inverse=True)
    first, second = neighbour_pairs(unique)
    links = coo_matrix((np.ones(len(first), bool), (first, second)), shape=(len(unique), len(unique)))
    return connected_components(links, directed=False)[1].astype(np.int64)[own.reshape(-1)]


def neighbour_pairs(packed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows of touching voxels among sorted packed keys (V,), each pair once; a voxel touches no fewer than none and at most 26 others."""
    first, second = [], []
    # Half of the 26 offsets; packed keys add like vectors.
    for step in [(0, 0, 1), *((0, 1, z) for z in (-1, 0, 1)), *((1, y, z) for y in (-1, 0, 1) for z in (-1, 0, 1))]:
        wanted = packed + (pack_keys(np.array(step)) - pack_keys(np.zeros(3, np.int64)))
        at = np.searchsorted(packed, wanted)
        is_there = packed[np.minimum(at, len(packed) - 1)] == wanted
        first.append(np.flatnonzero(is_there))
        second.append(at[is_there])
    return np.concatenate(first), np.concatenate(second)


def shape_voxels(points: np.ndarray, keys: np.ndarray, voxel_of: np.ndarray, settings: ObjectSettings = ObjectSettings()) -> np.ndarray:
    """Shape category (V,) uint8 of voxels, from the principal components of the points in them and their neighbours.

    Args:
        points: (N, 3).
        keys, voxel_of: of `voxelize`.
        settings: `min_points` and the thresholds.
    Source: Nagy (2020), 4.3.2.1, its [92].
    """
    if len(keys) == 0:
        return np.empty(0, np.uint8)
    centred = points - points.mean(axis=0)
    products = (centred[:, :, None] * centred[:, None, :]).reshape(-1, 9)
    columns = np.concatenate([np.ones((len(points), 1)), centred, products], axis=1)
    sums = np.stack([np.bincount(voxel_of, c, minlength=len(keys)) for c in columns.T], axis=1)
    first, second = neighbour_pairs(pack_keys(keys))
    total = sums.copy()
    np.add.at(total, first, sums[second])
    np.add.at(total, second, sums[first])
    n, mean = total[:, 0], total[:, 1:4] / total[:, :1]
    covariances = total[:, 4:].reshape(-1, 3, 3) / n[:, None, None] - mean[:, :, None] * mean[:, None, :]
    values = np.maximum(np.linalg.eigvalsh(covariances)[:, ::-1], 0)
    shares = values / np.maximum(values.sum(axis=1, keepdims=True), 1e-12)
    shapes = classify_shapes(shares, settings)
    shapes[n < settings.min_points] = UNSHAPED
    return shapes


def classify_shapes(shares: np.ndarray, settings: ObjectSettings = ObjectSettings()) -> np.ndarray:
    """Category (V,) uint8 of eigenvalues (V, 3), largest first, that sum to 1."""
    s = settings
    shapes = np.full(len(shares), UNSHAPED, np.uint8)
    shapes[1 - shares[:, 2] > s.min_flatness] = FLAT
    shapes[shares[:, 2] > s.min_scatter] = SCATTERED
    shapes[shares[:, 0] > s.min_linearity] = LINEAR
    return shapes


def majority_shape(shapes: np.ndarray) -> int:
    """The category most voxels have; UNSHAPED only where all are."""
    counts = np.bincount(shapes, minlength=4)
    return int(counts[:UNSHAPED].argmax()) if counts[:UNSHAPED].any() else UNSHAPED


def _group(points, blob_of_point, n_voxels, s: ObjectSettings) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows of the points of the blobs that are objects, grouped; where each begins; the blobs' numbers."""
    if len(points) == 0:
        return np.empty(0, np.int64), np.zeros(1, np.int64), np.empty(0, np.int64)
    order = np.argsort(blob_of_point, kind="stable")
    firsts = np.searchsorted(blob_of_point[order], np.arange(len(n_voxels) + 1))
    low = np.minimum.reduceat(points[order], firsts[:-1])
    high = np.maximum.reduceat(points[order], firsts[:-1])
    is_object = (n_voxels >= s.min_voxels) & (high[:, 2] - low[:, 2] >= s.min_height_m)
    is_object &= np.hypot(*(high - low)[:, :2].T) <= s.max_size_m
    chosen = np.flatnonzero(is_object)
    rows = [order[firsts[b] : firsts[b + 1]] for b in chosen]
    starts = np.concatenate([[0], np.cumsum([len(r) for r in rows])]).astype(np.int64)
    return np.concatenate(rows) if rows else np.empty(0, np.int64), starts, chosen


def count_columns(objects: ObjectSet, column_ratio: float = 2.0, min_height_m: float = 1.0) -> int:
    """Objects at least so many times as high as wide: what the thesis wants more than three of (N-234)."""
    width = objects.sizes_m[:, :2].max(axis=1, initial=0)
    return int(((objects.sizes_m[:, 2] >= min_height_m) & (objects.sizes_m[:, 2] >= column_ratio * width)).sum())


def points_of_cloud(found: CloudObjects) -> np.ndarray:
    """(N, 3) the thinned points of a cloud in its own frame."""
    return apply(invert(found.T_level_cloud), found.points)
