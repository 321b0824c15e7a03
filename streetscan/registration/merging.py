"""Registered frames as one cloud: transforms applied, points concatenated, in tiles, in memory that does not grow with the drive.

Source: Józsa & Benedek (2013), 6.2 and 8.2.1 (J-16, J-19), moving objects 7.4.1 (J-27), elevation map 8.3 (J-37).

Two passes. The first takes the frames in groups and leaves, per group, one LAZ file per tile and a raster of what was seen
where; a finished group is never done again. The second joins the parts of a tile, thins them, and tells moving from standing.

What moves: a short object's place is found empty in other frames. A ray that ends on the ground crossed the height of
a car's doors on its way; that place was empty then. The raster counts, per cell of the map, the frames that looked through it and those
that saw an object in it; what was often looked through came or went. (Ground seen in a cell says less: one sees below parked cars.)
ASSUME: the report's own criterion, the spread of an object's centroids over 10-30 frames, needs the objects first; this one needs only
the grid.
"""

import hashlib
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from streetscan.clouds import PointCloud
from streetscan.errors import BadInput
from streetscan.geometry import apply
from streetscan.io.arrays import load_npz, save_npz
from streetscan.io.atomic import atomic_folder, atomic_path
from streetscan.io.las import iterate_las, open_las_writer
from streetscan.registration.grid_classes import GROUND, NAMES, SHORT_OBJECT, TALL_STRUCTURE, classes_of_names, estimate_normals
from streetscan.registration.odometry import FramePose
from streetscan.sweeps import deskew
from streetscan.voxels import find_sorted, pack_keys, unpack_keys

MOVING_CHOICES = ("keep", "leave_out")
_NORMALS = ("normal_x", "normal_y", "normal_z")


@dataclass(frozen=True)
class MergeSettings:
    """What goes into the merged cloud.

    Attributes:
        tile_m: edge of a tile.
        group_frames: frames of a group; the work a killed run repeats at most.
        classes: grid classes that are merged.
        max_range_m: points farther from the sensor are left out.
        min_range_m: ... and nearer ones (the vehicle itself).
        thin_m: the first point of each cube of this edge stays; 0 keeps all.
        moving: `keep` or `leave_out` the points of moving objects.
        raster_m: edge of the cells in which moving is told, and of the elevation map.
        min_free_frames: what stood in a place that fewer frames looked through is standing.
        free_share: ... and it moved when at least this share of the frames that saw the place looked through it.
        segment: which segment of the chain; null takes the longest.
        normal_neighbours: neighbours in its frame from which a point's normal is estimated; 0 writes none.
    """

    tile_m: float = 50.0
    group_frames: int = 25
    classes: tuple[int, ...] = tuple(range(len(NAMES)))
    max_range_m: float = 60.0
    min_range_m: float = 2.5
    thin_m: float = 0.05
    moving: str = "keep"
    raster_m: float = 0.3
    min_free_frames: int = 3
    free_share: float = 0.4
    segment: int | None = None
    normal_neighbours: int = 0

    def __post_init__(self):
        if self.moving not in MOVING_CHOICES:
            raise BadInput("merge_frames.moving", f"'{self.moving}'", f"choose one of {', '.join(MOVING_CHOICES)}")
        for name in ("tile_m", "group_frames", "max_range_m", "raster_m"):
            if not getattr(self, name) > 0:
                raise BadInput(f"merge_frames.{name}", f"{getattr(self, name)} is not above 0", "give a positive number")


def make_merge_settings(values: Mapping[str, Any]) -> MergeSettings:
    """Settings from plain values: `classes` are names. BadInput for an unknown key."""
    values = dict(values)
    if "classes" in values:
        values["classes"] = classes_of_names(values["classes"], "merge_frames.classes")
    try:
        return MergeSettings(**values)
    except TypeError as error:
        raise BadInput("merge_frames", f"{error}", "correct the key in the config") from error


@dataclass
class MergeFrame:
    """A frame to merge.

    Attributes:
        index: number in the drive.
        time_s: stamp.
        points: (N, 3) float32 or float64, metres, frame `lidar`.
        labels: (N,) uint8 grid classes.
        time_offset_s: (N,) or None.
        intensity: (N,) 0..1 or None.
    """

    index: int
    time_s: float
    points: np.ndarray
    labels: np.ndarray
    time_offset_s: np.ndarray | None = None
    intensity: np.ndarray | None = None


def choose_segment(poses: Iterable[FramePose], segment: int | None = None) -> dict[int, FramePose]:
    """The posed frames of one segment of a chain, by frame number; the segment with most frames when none is named.

    Raises:
        BadInput: nothing was registered, or there is no such segment.
    """
    posed = [p for p in poses if p.is_posed]
    if not posed:
        raise BadInput("the poses", "no frame was registered", "look at the statuses in poses.csv")
    numbers = np.array([p.segment for p in posed])
    chosen = int(np.bincount(numbers).argmax()) if segment is None else segment
    rows = {p.index: p for p in posed if p.segment == chosen}
    if not rows:
        raise BadInput("merge_frames.segment", f"{segment}", f"choose among 0..{numbers.max()}")
    return rows


def leave_out(poses: dict[int, FramePose], first: int, every: int) -> dict[int, FramePose]:
    """The frames of a segment but every `every`-th from `first` on, by frame number: those to be localized on the others' street.

    Raises:
        BadInput: none is left.
    """
    kept = {i: pose for i, pose in poses.items() if i < first or (i - first) % every}
    if not kept:
        raise BadInput("registrars.left_out", f"all {len(poses)} frames are left out", "leave out fewer")
    return kept


def merge_frames(
    read_frames: Callable[[int, int], Iterator[MergeFrame]],
    poses: dict[int, FramePose],
    folder: str | Path,
    work_folder: str | Path,
    settings: MergeSettings = MergeSettings(),
    T_map_segment: np.ndarray | None = None,
    crs: str | None = None,
    elevation_path: str | Path | None = None,
) -> dict[str, int]:
    """Merge the frames of one segment into LAZ tiles.

    Args:
        read_frames: the frames with numbers in [first, last), in order; called once per group.
        poses: from `choose_segment`.
        folder: gets `<x>_<y>.laz`, named by the tile's corner in tiles: points, time_s, intensity, grid_class, frame, is_moving, and
            normal_x, normal_y, normal_z where they are wanted. It appears when all of them are written.
        work_folder: keeps the finished groups of a run that was stopped; deleted at the end.
        settings: see MergeSettings.
        T_map_segment: (4, 4) places the segment in a map; identity: the map is the frame of the segment's first frame.
        crs: of that map.
        elevation_path: also write the height of the ground as an ESRI ASCII grid.
    Returns:
        counts: frames, tiles, points_read, points_written, points_moving, groups_reused.
    Raises:
        BadInput: a frame's arrays do not fit each other.
    """
    s = settings
    T_map_segment = np.eye(4) if T_map_segment is None else np.asarray(T_map_segment, np.float64)
    numbers = sorted(poses)
    # Groups of another chain or of other settings are of no use.
    digest = hashlib.sha256(repr((s, crs)).encode() + T_map_segment.tobytes())
    for number in numbers:
        digest.update(poses[number].T_segment_lidar.tobytes() + poses[number].velocity_mps.tobytes())
    base_folder = Path(work_folder)
    work_folder = base_folder / digest.hexdigest()[:16]
    counts = {"frames": 0, "tiles": 0, "points_read": 0, "points_written": 0, "points_moving": 0, "groups_reused": 0}
    groups = [(first, first + s.group_frames) for first in range(numbers[0], numbers[-1] + 1, s.group_frames)]
    for first, last in groups:
        done = work_folder / f"{first:06d}"
        if done.is_dir():
            counts["groups_reused"] += 1
            continue
        with atomic_folder(done) as partial:
            _spool_group(read_frames(first, last), poses, partial, s, T_map_segment)
    parts = [work_folder / f"{first:06d}" for first, _ in groups]
    raster = SightRaster(s.raster_m)
    for part in parts:
        keys, values, n_frames = load_npz(part / "raster.npz", ("keys", "values", "n_frames"), "merge_frames")
        raster.add_rows(keys, values)
        counts["frames"] += int(n_frames)
    names = sorted({path.name for part in parts for path in part.glob("*.laz")})
    counts["tiles"] = len(names)
    with atomic_folder(folder) as partial:
        for name in names:
            n_read, n_written, n_moving = _join_tile([part / name for part in parts], partial / name, raster, s, crs)
            counts["points_read"] += n_read
            counts["points_written"] += n_written
            counts["points_moving"] += n_moving
    if elevation_path is not None:
        write_elevation(elevation_path, raster)
    shutil.rmtree(base_folder)
    return counts


def place_points(frame: MergeFrame, pose: FramePose, T_map_segment: np.ndarray) -> np.ndarray:
    """(N, 3) float64 points of a frame in the map, freed of the motion within the revolution where it is known."""
    points = np.asarray(frame.points, np.float64)
    if frame.time_offset_s is not None and np.isfinite(pose.velocity_mps).all():
        points = deskew(points, frame.time_offset_s, pose.velocity_mps, pose.turn_rate_radps)
    return apply(T_map_segment @ pose.T_segment_lidar, points)


def _spool_group(frames, poses, folder, s, T_map_segment):
    """Every point of a group into its tile's part, and the group's raster."""
    writers, raster, n_frames = {}, SightRaster(s.raster_m), 0
    try:
        for frame in frames:
            if (pose := poses.get(frame.index)) is None:
                continue
            n_frames += 1
            frame = _trim_frame(frame, s)
            cloud = _cloud_of_frame(frame, pose, T_map_segment, s.normal_neighbours)
            # ASSUME: a tree's crown over the road hides nothing below the sensor's height less 0.5 m, a tram does.
            is_low = np.asarray(frame.points)[:, 2] < -0.5
            is_obstacle = (frame.labels == SHORT_OBJECT) | ((frame.labels == TALL_STRUCTURE) & is_low)
            empty_points = place_points(look_through(frame), pose, T_map_segment)
            raster.add(cloud.points[is_obstacle], empty_points, cloud.points[frame.labels == GROUND])
            cloud = cloud.select(np.isin(cloud.fields["grid_class"], s.classes))
            for name, part in _split_by_tile(cloud, s.tile_m):
                if name not in writers:
                    context = open_las_writer(folder / name)
                    writers[name] = (context, context.__enter__())
                writers[name][1].write(part)
    finally:
        for context, _ in writers.values():
            context.__exit__(None, None, None)
    save_npz(folder / "raster.npz", n_frames=np.array(n_frames), **raster.arrays())


def _trim_frame(frame: MergeFrame, s: MergeSettings) -> MergeFrame:
    """The points within the ranges, without NaN."""
    points = np.asarray(frame.points)
    if len(frame.labels) != len(points):
        raise BadInput(f"frame {frame.index}", f"{len(frame.labels)} classes for {len(points)} points", "run segment_frames again")
    range_m = np.hypot(points[:, 0], points[:, 1])
    # Comparisons with NaN are false.
    return _select(frame, np.flatnonzero((range_m <= s.max_range_m) & (range_m >= s.min_range_m) & np.isfinite(points[:, 2])))


def _select(frame: MergeFrame, rows: np.ndarray) -> MergeFrame:
    optional = [None if a is None else a[rows] for a in (frame.time_offset_s, frame.intensity)]
    return MergeFrame(frame.index, frame.time_s, np.asarray(frame.points)[rows], frame.labels[rows], *optional)


def look_through(frame: MergeFrame, height_m: float = 0.7) -> MergeFrame:
    """Where the rays that ended on the ground crossed a height above it: empty places, as points of the frame.

    ASSUME: at 0.7 m a car has doors and a walker legs; the ground is taken as level between the crossing and the ray's end.
    """
    frame = _select(frame, np.flatnonzero((frame.labels == GROUND) & (np.asarray(frame.points)[:, 2] < -1.2 * height_m)))
    share = 1 - height_m / -frame.points[:, 2:]
    frame.points = frame.points * share
    return frame


def _cloud_of_frame(frame: MergeFrame, pose: FramePose, T_map_segment: np.ndarray, normal_neighbours: int) -> PointCloud:
    n, offsets = len(frame.points), frame.time_offset_s
    intensity = np.zeros(n) if frame.intensity is None else np.clip(np.nan_to_num(frame.intensity), 0, 1)
    fields = {
        "intensity": np.round(intensity * 65535).astype(np.uint16),
        "time_s": frame.time_s + (np.zeros(n) if offsets is None else offsets.astype(np.float64)),
        "grid_class": frame.labels.astype(np.uint8),
        "frame": np.full(n, frame.index, np.uint32),
    }
    if normal_neighbours:
        normals = estimate_normals(frame.points, normal_neighbours) @ (T_map_segment @ pose.T_segment_lidar)[:3, :3].T
        fields |= dict(zip(_NORMALS, normals.T.astype(np.float32), strict=True))
    return PointCloud(place_points(frame, pose, T_map_segment), fields)


def _split_by_tile(cloud: PointCloud, tile_m: float) -> Iterator[tuple[str, PointCloud]]:
    tiles = np.floor(cloud.points[:, :2] / tile_m).astype(np.int64)
    corners, inverse = np.unique(tiles, axis=0, return_inverse=True)
    for i, (x, y) in enumerate(corners):
        yield f"{x}_{y}.laz", cloud.select(np.flatnonzero(inverse.reshape(-1) == i))


class SightRaster:
    """Per cell of the map: frames that looked through it, frames that saw an object in it, and the ground's height."""

    def __init__(self, size_m: float):
        self.size_m = size_m
        self._keys = np.empty(0, np.int64)
        # Columns: frames that looked through, frames with an object, sum of ground heights, ground points.
        self._values = np.empty((0, 4))

    def _keys_of(self, points: np.ndarray) -> np.ndarray:
        cells = np.zeros((len(points), 3), np.int64)
        cells[:, :2] = np.floor(points[:, :2] / self.size_m)
        return pack_keys(cells)

    def add(self, objects: np.ndarray, empty_points: np.ndarray, ground: np.ndarray) -> None:
        """Count one frame: points on objects, places it looked through and points on the ground, (N, 3) each, in the map."""
        object_keys = np.unique(self._keys_of(objects))
        # Beside an object rays pass through the same cell; such a frame counts for the object.
        empty_keys = np.setdiff1d(self._keys_of(empty_points), object_keys)
        ground_keys, inverse, n_points = np.unique(self._keys_of(ground), return_inverse=True, return_counts=True)
        heights = np.bincount(inverse.reshape(-1), ground[:, 2], len(ground_keys))
        keys = np.concatenate([empty_keys, object_keys, ground_keys])
        values = np.zeros((len(keys), 4))
        a, b = len(empty_keys), len(empty_keys) + len(object_keys)
        values[:a, 0], values[a:b, 1], values[b:, 2], values[b:, 3] = 1, 1, heights, n_points
        self.add_rows(keys, values)

    def add_rows(self, keys: np.ndarray, values: np.ndarray) -> None:
        """Add what another raster counted (`arrays`)."""
        keys, values = np.concatenate([self._keys, keys]), np.concatenate([self._values, values])
        self._keys, inverse = np.unique(keys, return_inverse=True)
        columns = [np.bincount(inverse.reshape(-1), values[:, i], len(self._keys)) for i in range(4)]
        self._values = np.stack(columns, axis=1).reshape(-1, 4)

    def arrays(self) -> dict[str, np.ndarray]:
        return {"keys": self._keys, "values": self._values}

    def is_left(self, points: np.ndarray, min_free_frames: int, free_share: float) -> np.ndarray:
        """(N,) bool: whatever stood at these places of the map came or went."""
        if len(self._keys) == 0:
            return np.zeros(len(points), np.bool_)
        rows = find_sorted(self._keys, self._keys_of(points))
        n_free, n_object = (np.where(rows >= 0, self._values[rows, i], 0) for i in range(2))
        return (n_object > 0) & (n_free >= min_free_frames) & (n_free >= free_share * (n_free + n_object))

    def elevation(self) -> tuple[np.ndarray, np.ndarray]:
        """Cells (E, 2) that hold ground and its mean height (E,) there."""
        rows = np.flatnonzero(self._values[:, 3] > 0)
        return unpack_keys(self._keys[rows])[:, :2], self._values[rows, 2] / self._values[rows, 3]


def _join_tile(paths: list[Path], target: Path, raster: SightRaster, s: MergeSettings, crs: str | None) -> tuple[int, int, int]:
    """The parts of one tile in the order of recording; memory grows with the occupied cubes of the tile."""
    seen = np.empty(0, np.int64)
    n_read = n_written = n_moving = 0
    with open_las_writer(target, crs) as writer:
        for path in paths:
            if not path.exists():
                continue
            for cloud in iterate_las(path):
                n_read += len(cloud)
                fields = {k: cloud.fields[k] for k in ("intensity", "time_s", "grid_class", "frame", *_NORMALS) if k in cloud.fields}
                is_object = (fields["grid_class"] == SHORT_OBJECT) | (fields["grid_class"] == TALL_STRUCTURE)
                fields["is_moving"] = np.zeros(len(cloud), np.uint8)
                fields["is_moving"][is_object] = raster.is_left(cloud.points[is_object], s.min_free_frames, s.free_share)
                cloud = PointCloud(cloud.points, fields)
                if s.moving == "leave_out":
                    cloud = cloud.select(fields["is_moving"] == 0)
                if s.thin_m > 0:
                    keys = pack_keys(np.floor(cloud.points / s.thin_m).astype(np.int64))
                    new, first = np.unique(keys, return_index=True)
                    fresh = find_sorted(seen, new) < 0
                    cloud = cloud.select(np.sort(first[fresh]))
                    seen = np.sort(np.concatenate([seen, new[fresh]]), kind="stable")
                if len(cloud) == 0:
                    continue
                writer.write(cloud)
                n_written += len(cloud)
                n_moving += int(cloud.fields["is_moving"].sum())
    return n_read, n_written, n_moving


def write_elevation(path: str | Path, raster: SightRaster) -> None:
    """The ground's height as an ESRI ASCII grid, -9999 where no ground was seen; opens in QGIS."""
    cells, heights = raster.elevation()
    size_m = raster.size_m
    if len(cells) == 0:
        cells, heights = np.zeros((1, 2), np.int32), np.array([np.nan])
    low, high = cells.min(axis=0), cells.max(axis=0)
    grid = np.full((high[1] - low[1] + 1, high[0] - low[0] + 1), -9999.0)
    grid[high[1] - cells[:, 1], cells[:, 0] - low[0]] = np.nan_to_num(heights, nan=-9999.0)
    header = (
        f"ncols {grid.shape[1]}\nnrows {grid.shape[0]}\nxllcorner {low[0] * size_m:.3f}\n"
        f"yllcorner {low[1] * size_m:.3f}\ncellsize {size_m:.3f}\nNODATA_value -9999"
    )
    with atomic_path(path) as partial:
        np.savetxt(partial, grid, fmt="%.3f", header=header, comments="")
