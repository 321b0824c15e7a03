"""What a ray meets in a scene: the static mesh through Open3D's (Embree's) ray caster, and every moving actor in its own frame.

An actor's mesh never moves: the ray is carried into the actor's frame at the ray's own time, so that each pulse of a
sensor sees the scene as it was when the pulse left. Float32 rays are relative to a local origin (0.1 mm steps at 1 km).
"""

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property

import numba
import numpy as np
import open3d as o3d

from streetscan.classes import PHANTOM
from streetscan.simulation.scene import Actor, Mesh, Scene, join_meshes

# ASSUME: the slowest thing an annotator would call moving; standing traffic and people shifting their weight stay below.
MOVING_SPEED_MPS = 0.3
# Consecutive rays tested together against an actor; at 1-2 mrad between pulses a fan of some 5 degrees.
_BLOCK_RAYS = 64
# Poses of all actors are looked up anew after this time; between, their top speeds bound where they are.
_KEPT_POSES_S = 0.002
# Rays one thread looks after at a time.
_PART_RAYS = 64 * 1024
_TABLES = ("labels", "instances", "materials", "colours")


@dataclass
class Hits:
    """The nearest surface along each ray; all arrays (n,).

    Attributes:
        distances_m: float32 distance along the ray, inf where nothing is hit.
        faces: int32 row of the triangle in the caster's tables, -1 where nothing is hit.
        actors: int16 index into the caster's `moving` actors, -1 for what stands still.
        cos_incidence: float32 absolute cosine between ray and surface normal, 0 where nothing is hit.
    """

    distances_m: np.ndarray
    faces: np.ndarray
    actors: np.ndarray
    cos_incidence: np.ndarray

    def __len__(self) -> int:
        return len(self.faces)


@dataclass
class OwnFrames:
    """Frames in which objects keep their shape and their pattern, whatever moves.

    A moving actor's frame is its own. What stands still has its lowest corner as origin and the map's axes, an actor that
    stands its own frame, the ground (instance 0) the map's.

    Attributes:
        normals: (T, 3) float32 unit normals, in the actor's frame for moving actors, in `map` otherwise.
        numbers: (T,) int32 row of `poses` of each triangle.
        poses: (F, 4) float64 x, y, z relative to the caster's origin, and yaw in radians; of moving actors zeros.
        seeds: (F,) int64, the object's instance.
    """

    normals: np.ndarray
    numbers: np.ndarray
    poses: np.ndarray
    seeds: np.ndarray


class SceneCaster:
    """Casts rays into a scene during one span of time.

    All moving actors stand in one more tree, the gallery, each in a cell of its own, so far apart that their bounding spheres
    do not touch. A ray that may meet an actor enters its cell at the sphere; what it hits there is the actor, or a neighbour
    behind it, which does not count.

    Attributes:
        origin: (3,) float64, the local origin, frame `map`.
        moving: the actors that move during the span.
        labels, instances, materials, colours: of all triangles, rows as in `Hits.faces`.
    """

    def __init__(self, scene: Scene, start_s: float = -np.inf, end_s: float = np.inf, n_threads: int = 0):
        """
        Args:
            scene: what is there.
            start_s, end_s: rays have times in this span; actors that stand still all the while join the static mesh.
            n_threads: of the ray caster; 0 takes all cores. The result does not depend on it.
        """
        moves = [_moves(a, start_s, end_s) for a in scene.actors]
        self.moving = [a for a, m in zip(scene.actors, moves, strict=True) if m]
        self._standing = [a for a, m in zip(scene.actors, moves, strict=True) if not m]
        self._start_s = start_s
        static = join_meshes([scene.static, *(_mesh_in_map(a, start_s) for a in self._standing)])
        self.origin = np.round((static.vertices.min(axis=0) + static.vertices.max(axis=0)) / 2)
        self._n_threads = n_threads
        self._n_static = len(static.triangles)
        self._static_mesh = static
        self._static = _embree_scene(static.vertices - self.origin, static.triangles)
        meshes = [a.mesh for a in self.moving]
        self._paths = np.zeros((0, 5)), np.zeros(1, np.int64)
        if self.moving:
            self._spheres = _bounding_spheres(meshes)
            # A millimetre more on all sides, so that rounding loses no hit on an actor's outermost faces.
            self._boxes = np.array([[*(m.vertices.min(axis=0) - 1e-3), *(m.vertices.max(axis=0) + 1e-3)] for m in meshes])
            self._cells = _gallery_cells(len(meshes), float(self._spheres[:, 3].max()))
            hung = [
                Mesh(m.vertices + c, *(getattr(m, n) for n in ("triangles", *_TABLES))) for m, c in zip(meshes, self._cells, strict=True)
            ]
            gallery = join_meshes(hung)
            self._gallery = _embree_scene(gallery.vertices, gallery.triangles)
            self._actor_of_face = np.repeat(np.arange(len(meshes), dtype=np.int16), [len(m.triangles) for m in meshes])
            self._paths = _pack_paths(self.moving, self.origin)
            self._top_speeds_mps = np.array([_top_speed_mps(a) for a in self.moving])
        self.labels, self.instances, self.materials, self.colours = (
            np.concatenate([getattr(m, n) for m in (static, *meshes)]) for n in _TABLES
        )

    def cast(self, origins: np.ndarray, directions: np.ndarray, times_s: np.ndarray, reach_m: float = np.inf) -> Hits:
        """The nearest hit of each ray at its own time.

        Args:
            origins: (n, 3) float64, metres, frame `map`.
            directions: (n, 3) float32 unit vectors, frame `map`.
            times_s: (n,) float64.
            reach_m: moving actors beyond it may be left out, which is cheaper; what is nearer is exact.
        """
        local = origins - self.origin
        rays = np.concatenate([local.astype(np.float32), directions], axis=1, dtype=np.float32)
        distances, faces, cosines = self._cast_tree(self._static, rays)
        hits = Hits(distances, faces, np.full(len(rays), -1, np.int16), cosines)
        if self.moving and len(rays):
            self._cast_actors(local, rays[:, 3:], np.asarray(times_s, np.float64), hits, reach_m)
        return hits

    def is_blocked(self, origins: np.ndarray, directions: np.ndarray, times_s: np.ndarray) -> np.ndarray:
        """(n,) bool: whether rays, as those of `cast`, meet anything at all; half the price of `cast`."""
        local = origins - self.origin
        rays = np.concatenate([local.astype(np.float32), directions], axis=1, dtype=np.float32)
        if len(rays) == 0:
            return np.zeros(0, bool)
        blocked = self._static.test_occlusions(o3d.core.Tensor.from_numpy(rays), nthreads=self._n_threads).numpy()
        free = np.flatnonzero(~blocked)
        if self.moving and len(free):
            hits = Hits(np.full(len(free), np.inf, np.float32), *(np.full(len(free), -1, t) for t in (np.int32, np.int16, np.float32)))
            self._cast_actors(local[free], rays[free, 3:], np.asarray(times_s, np.float64)[free], hits)
            blocked[free] = hits.faces >= 0
        return blocked

    @cached_property
    def own_frames(self) -> OwnFrames:
        """The frames of all objects; made when first asked for."""
        static, n_standing = self._static_mesh, [len(a.mesh.triangles) for a in self._standing]
        normals = [_normals(m) for m in (static, *(a.mesh for a in self.moving))]
        n_fixed = self._n_static - sum(n_standing)
        seeds, numbers = np.unique(static.instances[:n_fixed], return_inverse=True)
        corners = static.vertices[static.triangles[:n_fixed]].min(axis=1) - self.origin
        lowest = np.full((len(seeds), 3), np.inf)
        order = np.argsort(numbers, kind="stable")
        if n_fixed:
            lowest = np.minimum.reduceat(corners[order], np.searchsorted(numbers[order], np.arange(len(seeds))))
        lowest[seeds == 0] = -self.origin
        others = [*self._standing, *self.moving]
        standing = [a.pose_at(np.array([np.clip(self._start_s, a.times_s[0], a.times_s[-1])])) for a in self._standing]
        poses = np.concatenate(
            [
                np.column_stack([lowest, np.zeros(len(lowest))]),
                *(np.column_stack([position - self.origin, yaw]) for position, yaw in standing),
                np.zeros((len(self.moving), 4)),
            ]
        )
        more = np.repeat(np.arange(len(others)) + len(seeds), [len(a.mesh.triangles) for a in others])
        own_seeds = [int(a.mesh.instances[0]) if len(a.mesh.instances) else 0 for a in others]
        return OwnFrames(
            np.concatenate(normals),
            np.concatenate([numbers, more]).astype(np.int32),
            poses,
            np.concatenate([seeds.astype(np.int64), np.array(own_seeds, np.int64)]),
        )

    def own_poses(self, hits: Hits, times_s: np.ndarray) -> np.ndarray:
        """(n, 4) float64 pose in which each ray's object was at the ray's time: x, y, z from the origin, and yaw; 0 without a hit."""
        own = self.own_frames
        return _hit_poses(hits.faces, hits.actors, np.asarray(times_s, np.float64), own.numbers, own.poses, *self._paths)

    def speeds_mps(self, hits: Hits, times_s: np.ndarray) -> np.ndarray:
        """(n,) float32 speed of what each ray hit, at the ray's time; 0 for what stands still and where nothing is hit."""
        speeds = np.zeros(len(hits), np.float32)
        for i in np.unique(hits.actors[hits.actors >= 0]):
            rows = np.flatnonzero(hits.actors == i)
            speeds[rows] = self.moving[i].speed_at(times_s[rows])
        return speeds

    def labels_at(self, hits: Hits, times_s: np.ndarray) -> np.ndarray:
        """(n,) uint8 classes of what was hit: an actor faster than 0.3 m/s at that moment is a phantom; 255 where nothing is hit.

        Source: Nagy (2020), 2.1.1: the phantom effect comes from objects moving while they are scanned (N-005).
        """
        labels = np.where(hits.faces >= 0, self.labels[hits.faces], 255).astype(np.uint8)
        labels[self.speeds_mps(hits, times_s) > MOVING_SPEED_MPS] = PHANTOM
        return labels

    def _cast_tree(self, tree: o3d.t.geometry.RaycastingScene, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Distances, faces and |cos incidence| of (n, 6) float32 rays in a tree's own frame."""
        if len(rays) == 0:
            return np.empty(0, np.float32), np.empty(0, np.int32), np.empty(0, np.float32)
        found = tree.cast_rays(o3d.core.Tensor.from_numpy(rays), nthreads=self._n_threads)
        faces = found["primitive_ids"].numpy().view(np.int32)  # Embree's "no triangle" is 2^32 - 1, that is -1.
        cosines = np.abs(np.einsum("ij,ij->i", found["primitive_normals"].numpy(), rays[:, 3:]))
        cosines[faces < 0] = 0
        return found["t_hit"].numpy(), faces, cosines

    def _cast_actors(self, local: np.ndarray, directions: np.ndarray, times_s: np.ndarray, hits: Hits, reach_m: float = np.inf) -> None:
        """Put the hits on moving actors into `hits` where they are nearer; those beyond `reach_m` may be left out."""
        tables = *self._paths, self._spheres, self._boxes, self._cells, self._top_speeds_mps
        starts = range(0, len(local), _PART_RAYS)
        limits_m = np.minimum(hits.distances_m, np.float32(reach_m))
        parts = [tuple(v[i : i + _PART_RAYS] for v in (local, directions, times_s, limits_m)) for i in starts]
        with ThreadPoolExecutor(self._n_threads or os.cpu_count()) as pool:
            entered = list(pool.map(lambda part: _enter_gallery(*part, *tables), parts))
        rows = np.concatenate([e[0] + i for e, i in zip(entered, starts, strict=True)])
        actors, entries, rays = (np.concatenate([e[k] for e in entered]) for k in (1, 2, 3))
        distances, faces, cosines = self._cast_tree(self._gallery, rays)
        distances += entries
        own = (faces >= 0) & (self._actor_of_face[faces] == actors) & (distances < hits.distances_m[rows])
        # Of several actors along one ray the nearest: written last.
        own = np.flatnonzero(own)
        own = own[np.argsort(-distances[own], kind="stable")]
        rows = rows[own]
        hits.distances_m[rows], hits.cos_incidence[rows] = distances[own], cosines[own]
        hits.faces[rows], hits.actors[rows] = faces[own] + self._n_static, actors[own]


@numba.njit(cache=True)
def _pose(path, bounds, actor, time_s):
    """x, y, z, yaw of an actor at a time, linear between samples, standing before and after."""
    low, high = bounds[actor], bounds[actor + 1] - 1
    if time_s <= path[low, 0]:
        return path[low, 1], path[low, 2], path[low, 3], path[low, 4]
    if time_s >= path[high, 0]:
        return path[high, 1], path[high, 2], path[high, 3], path[high, 4]
    while high - low > 1:
        middle = (low + high) // 2
        if path[middle, 0] <= time_s:
            low = middle
        else:
            high = middle
    f = (time_s - path[low, 0]) / (path[high, 0] - path[low, 0])
    a, b = path[low], path[high]
    return a[1] + f * (b[1] - a[1]), a[2] + f * (b[2] - a[2]), a[3] + f * (b[3] - a[3]), a[4] + f * (b[4] - a[4])


@numba.njit(cache=True, parallel=True)
def _hit_poses(faces, actors, times_s, numbers, poses, path, bounds):
    found = np.zeros((len(faces), 4))
    for r in numba.prange(len(faces)):
        if actors[r] >= 0:
            found[r, 0], found[r, 1], found[r, 2], found[r, 3] = _pose(path, bounds, actors[r], times_s[r])
        elif faces[r] >= 0:
            found[r] = poses[numbers[faces[r]]]
    return found


@numba.njit(cache=True)
def _reaches_box(ox, oy, oz, dx, dy, dz, box, limit_m):
    """Whether a ray meets a box before the limit."""
    entry, leave = 0.0, np.inf
    for k in range(3):
        o, d = (ox, dx) if k == 0 else (oy, dy) if k == 1 else (oz, np.float64(dz))
        if abs(d) < 1e-12:
            if o < box[k] or o > box[k + 3]:
                return False
            continue
        a, b = (box[k] - o) / d, (box[k + 3] - o) / d
        entry, leave = max(entry, min(a, b)), min(leave, max(a, b))
    return entry <= leave and entry < limit_m


@numba.njit(cache=True, nogil=True)
def _enter_gallery(origins, directions, times_s, limits_m, path, bounds, spheres, boxes, cells, top_speeds_mps):
    """Pairs of rays and actors they may meet before `limits_m`: rows, actors, distances to the sphere, rays in the gallery.

    Fans of consecutive rays are tested against each actor's sphere first, then every ray of the fans that remain against its box.
    """
    known_s, poses, middles = np.nan, np.empty((len(spheres), 5)), np.empty((len(spheres), 3))
    n, capacity, count = len(origins), 1024, 0
    rows, actors = np.empty(capacity, np.int64), np.empty(capacity, np.int16)
    entries, rays = np.empty(capacity, np.float32), np.empty((capacity, 6), np.float32)
    for first in range(0, n, _BLOCK_RAYS):
        last = min(first + _BLOCK_RAYS, n)
        axis, low, high = np.zeros(3), origins[first].copy(), origins[first].copy()
        start_s, end_s, farthest = times_s[first], times_s[first], 0.0
        for r in range(first, last):
            for k in range(3):
                axis[k] += directions[r, k]
                low[k], high[k] = min(low[k], origins[r, k]), max(high[k], origins[r, k])
            start_s, end_s, farthest = min(start_s, times_s[r]), max(end_s, times_s[r]), max(farthest, limits_m[r])
        axis /= max(np.sqrt((axis**2).sum()), 1e-9)
        narrowest = 1.0
        for r in range(first, last):
            narrowest = min(narrowest, directions[r, 0] * axis[0] + directions[r, 1] * axis[1] + directions[r, 2] * axis[2])
        half_angle = np.arccos(max(narrowest, -1.0)) + 1e-4
        sin_half, cos_half = np.sin(half_angle), np.cos(half_angle)
        apex, spread = (low + high) / 2, np.sqrt(((high - low) ** 2).sum()) / 2
        # Where the actors' middles were a moment ago tells enough to rule most of them out.
        middle_s = (start_s + end_s) / 2
        if not abs(middle_s - known_s) < _KEPT_POSES_S:
            known_s = middle_s
            for i in range(len(spheres)):
                x, y, z, yaw = _pose(path, bounds, i, known_s)
                cos, sin = np.cos(yaw), np.sin(yaw)
                poses[i, 0], poses[i, 1], poses[i, 2], poses[i, 3], poses[i, 4] = x, y, z, cos, sin
                middles[i, 0] = x + cos * spheres[i, 0] - sin * spheres[i, 1]
                middles[i, 1] = y + sin * spheres[i, 0] + cos * spheres[i, 1]
                middles[i, 2] = z + spheres[i, 2]
        late_s = abs(middle_s - known_s) + (end_s - start_s) / 2
        for i in range(len(spheres)):
            cx, cy, cz = middles[i, 0] - apex[0], middles[i, 1] - apex[1], middles[i, 2] - apex[2]
            square = cx * cx + cy * cy + cz * cz
            reach = spheres[i, 3] + spread + top_speeds_mps[i] * late_s + 1e-3
            if square > (farthest + reach) ** 2:
                continue
            # The sphere is seen under asin(reach / distance). It is passed by when the fan's axis is farther from its middle than
            # that and half the fan together, a sum whose cosine and sine need no further function of an angle.
            tangent = np.sqrt(max(square - reach * reach, 0.0))
            is_below_half_turn = tangent > 0 and tangent * sin_half + reach * cos_half > 0
            if is_below_half_turn and cx * axis[0] + cy * axis[1] + cz * axis[2] < tangent * cos_half - reach * sin_half:
                continue
            radius = spheres[i, 3] + top_speeds_mps[i] * late_s + 1e-3
            for r in range(first, last):
                # The ray against the sphere, before the actor's pose at the ray's own time is looked up.
                tx, ty, tz = middles[i, 0] - origins[r, 0], middles[i, 1] - origins[r, 1], middles[i, 2] - origins[r, 2]
                along = tx * directions[r, 0] + ty * directions[r, 1] + tz * directions[r, 2]
                if along < -radius or tx * tx + ty * ty + tz * tz - along * along > radius * radius:
                    continue
                x, y, z, cos, sin = poses[i, 0], poses[i, 1], poses[i, 2], poses[i, 3], poses[i, 4]
                if times_s[r] != known_s:
                    x, y, z, yaw = _pose(path, bounds, i, times_s[r])
                    cos, sin = np.cos(yaw), np.sin(yaw)
                ox, oy, oz = origins[r, 0] - x, origins[r, 1] - y, origins[r, 2] - z
                ox, oy = cos * ox + sin * oy, -sin * ox + cos * oy
                dx, dy, dz = directions[r, 0], directions[r, 1], directions[r, 2]
                dx, dy = cos * dx + sin * dy, -sin * dx + cos * dy
                if not _reaches_box(ox, oy, oz, dx, dy, dz, boxes[i], limits_m[r]):
                    continue
                tx, ty, tz = spheres[i, 0] - ox, spheres[i, 1] - oy, spheres[i, 2] - oz
                along = tx * dx + ty * dy + tz * dz
                entry = max(along - np.sqrt(max(spheres[i, 3] ** 2 - (tx * tx + ty * ty + tz * tz - along * along), 0.0)), 0.0)
                if count == capacity:
                    capacity *= 2
                    rows, actors = _grown(rows, capacity), _grown(actors, capacity)
                    entries, old = _grown(entries, capacity), rays
                    rays = np.empty((capacity, 6), np.float32)
                    rays[:count] = old
                rows[count], actors[count], entries[count] = r, i, entry
                rays[count, 0] = ox + entry * dx + cells[i, 0]
                rays[count, 1] = oy + entry * dy + cells[i, 1]
                rays[count, 2] = oz + entry * dz + cells[i, 2]
                rays[count, 3], rays[count, 4], rays[count, 5] = dx, dy, dz
                count += 1
    return rows[:count], actors[:count], entries[:count], rays[:count]


@numba.njit(cache=True)
def _grown(array, capacity):
    grown = np.empty(capacity, array.dtype)
    grown[: len(array)] = array
    return grown


def _bounding_spheres(meshes: list[Mesh]) -> np.ndarray:
    """(A, 4): centre and radius in each mesh's own frame, a millimetre of air around it."""
    rows = []
    for mesh in meshes:
        centre = (mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0)) / 2
        rows.append([*centre, np.linalg.norm(mesh.vertices - centre, axis=1).max() + 1e-3])
    return np.array(rows)


def _gallery_cells(n: int, radius_m: float) -> np.ndarray:
    """(n, 3) origins of cells on a cubic lattice about 0, near enough to it for float32."""
    side = int(np.ceil(n ** (1 / 3)))
    lattice = np.stack(np.unravel_index(np.arange(n), (side, side, side)), axis=1) - (side - 1) / 2
    # A mesh's own origin may lie anywhere in its sphere.
    return np.round(lattice * (4 * radius_m + 1))


def _pack_paths(actors: list[Actor], origin: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """All paths one after another, rows time, x, y, z, yaw relative to the origin; and where each begins."""
    rows = [np.concatenate([a.times_s[:, None], a.positions - origin, a.yaws_rad[:, None]], axis=1) for a in actors]
    return np.concatenate(rows), np.cumsum([0, *(len(r) for r in rows)])


def _embree_scene(vertices: np.ndarray, triangles: np.ndarray) -> o3d.t.geometry.RaycastingScene:
    tree = o3d.t.geometry.RaycastingScene()
    tree.add_triangles(
        o3d.core.Tensor.from_numpy(np.ascontiguousarray(vertices, np.float32)),
        o3d.core.Tensor.from_numpy(np.ascontiguousarray(triangles, np.uint32)),
    )
    return tree


def _normals(mesh: Mesh) -> np.ndarray:
    """(T, 3) float32 unit normals; of a triangle without area zeros."""
    a, b, c = (mesh.vertices[mesh.triangles[:, i]] for i in range(3))
    normals = np.cross(b - a, c - a)
    return (normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)).astype(np.float32)


def _rotate(vectors: np.ndarray, yaws_rad: np.ndarray) -> np.ndarray:
    """Vectors (n or 1, 3) turned counter-clockwise about the vertical by (n,) angles."""
    cos, sin = np.cos(yaws_rad), np.sin(yaws_rad)
    x, y = vectors[:, 0], vectors[:, 1]
    return np.stack([cos * x - sin * y, sin * x + cos * y, np.broadcast_to(vectors[:, 2], cos.shape)], axis=1)


def _top_speed_mps(actor: Actor) -> float:
    """Upper bound of how fast any point of the actor moves: of the path, and of turning."""
    *centre, radius = _bounding_spheres([actor.mesh])[0]
    spans = np.diff(actor.times_s)
    speeds = np.linalg.norm(np.diff(actor.positions, axis=0), axis=1) / spans
    turning = np.abs(np.diff(actor.yaws_rad)) / spans * (np.hypot(*centre[:2]) + radius)
    return float((speeds + turning).max(initial=0.0))


def _moves(actor: Actor, start_s: float, end_s: float) -> bool:
    inside = (actor.times_s > start_s) & (actor.times_s < end_s)
    ends = np.clip([start_s, end_s], actor.times_s[0], actor.times_s[-1])
    positions, yaws = actor.pose_at(np.concatenate([ends, actor.times_s[inside]]))
    return bool(np.ptp(positions, axis=0).max() > 1e-6 or np.ptp(yaws) > 1e-6)


def _mesh_in_map(actor: Actor, time_s: float) -> Mesh:
    position, yaw = actor.pose_at(np.array([np.clip(time_s, actor.times_s[0], actor.times_s[-1])]))
    mesh = actor.mesh
    vertices = _rotate(mesh.vertices, np.full(len(mesh.vertices), yaw[0])) + position
    return Mesh(vertices, mesh.triangles, *(getattr(mesh, n) for n in _TABLES))
