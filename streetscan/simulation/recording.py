"""A mobile mapper drives through a scene: its path, what its navigation believes of it, and the map that comes out.

The truth casts the rays; the believed pose puts the points into the map. So drift, and the offset between two passes
along one street, show in the map as they do in real ones.
"""

import itertools
import logging
import time
import zlib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from streetscan.classes import GROUND
from streetscan.clouds import PointCloud
from streetscan.errors import BadInput
from streetscan.io.las import open_las_writer
from streetscan.io.npy import open_npy_writer
from streetscan.simulation.colouring import Cameras, colour_points
from streetscan.simulation.layout import build_street, count_blocks
from streetscan.simulation.raycasting import SceneCaster
from streetscan.simulation.receiver import Receiver, Returns, measure
from streetscan.simulation.scene import Actor, Scene
from streetscan.simulation.sensors import ProfileScanner, StaticScanner, hits_own_vehicle

logger = logging.getLogger(__name__)

# Poses are stored this often; linear interpolation between them is exact to 0.01 mm and 0.001 degrees on a road vehicle.
_POSE_RATE_HZ = 200.0
_ROAD_STEP_M = 0.25
# Corners of a road's centre line are rounded over about this length.
_ROUNDING_M = 2.0
_CHUNK_PULSES = 250_000
_LOG_POINTS = 5_000_000
# Each block of a street draws its drives and their errors from seeds of its own.
BLOCK_SEED = 7919


@dataclass
class Trajectory:
    """Poses of the vehicle (x forward, y left, z up, origin on the road) in `map`, evenly spaced in time.

    Attributes:
        start_s: time of the first pose.
        positions: (K, 3) float64.
        rotations: (K, 3, 3) float64, R_map_vehicle.
    """

    start_s: float
    positions: np.ndarray
    rotations: np.ndarray

    rate_hz = _POSE_RATE_HZ

    @property
    def end_s(self) -> float:
        """Time of the last pose."""
        return self.start_s + (len(self.positions) - 1) / _POSE_RATE_HZ

    def at(self, times_s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Positions (n, 3) and rotations (n, 3, 3) at times, linear between poses; the nearest end outside."""
        steps = np.clip((times_s - self.start_s) * _POSE_RATE_HZ, 0, len(self.positions) - 1)
        low = np.minimum(steps.astype(np.int64), max(len(self.positions) - 2, 0))
        high = np.minimum(low + 1, len(self.positions) - 1)
        table = np.concatenate([self.positions, self.rotations.reshape(-1, 9)], axis=1)
        rows = table[low] + (steps - low)[:, None] * (table[high] - table[low])
        return rows[:, :3], rows[:, 3:].reshape(-1, 3, 3)


@dataclass(frozen=True)
class Errors:
    """What the navigation gets wrong (anchors: published checks of such systems find 3-5 cm, 10 cm in plan).

    Attributes:
        drift_m: standard deviation, per axis, of the slowly varying position error.
        pass_offset_m: (least, most) length of the constant horizontal offset of every pass after the first.
        attitude_deg: standard deviation, per axis, of the slowly varying attitude error.
        boresight_deg: standard deviation, per axis, of the constant error of how each scanner is mounted.
    """

    drift_m: float = 0.03
    pass_offset_m: tuple[float, float] = (0.02, 0.10)
    attitude_deg: float = 0.01
    boresight_deg: float = 0.01

    def __post_init__(self):
        least, most = self.pass_offset_m
        if not 0 <= least <= most:
            raise BadInput("simulation.errors.pass_offset_m", f"[{least:g}, {most:g}]", "give the least offset in m first, then the most")


@dataclass
class Pass:
    """One drive along one road.

    Attributes:
        index: number in the recording.
        truth: where the vehicle was.
        believed: where its navigation says it was.
    """

    index: int
    truth: Trajectory
    believed: Trajectory


def drive_road(road: np.ndarray, speed_kmh: float, lane_offset_m: float, start_s: float, rng: np.random.Generator) -> Trajectory:
    """A drive along a centre line in the right-hand lane.

    The speed swings by some 12 %, the van wanders by a decimetre in its lane and rolls and pitches by fractions of a degree.

    Args:
        road: (K, 3) float64 centre line in driving direction, metres, frame `map`.
        speed_kmh: mean speed.
        lane_offset_m: distance of the lane's middle to the right of the centre line.
        start_s: when it begins.
        rng: the swings' phases.
    Raises:
        ValueError: the road has no length.
    """
    legs = np.linalg.norm(np.diff(road, axis=0), axis=1)
    length = legs.sum()
    if len(road) < 2 or length <= 0:
        raise ValueError("a road needs two different points")
    stations = np.linspace(0, length, max(int(length / _ROAD_STEP_M), 2) + 1)
    line = np.stack([np.interp(stations, np.append(0, np.cumsum(legs)), road[:, i]) for i in range(3)], axis=1)
    line = _smooth(line, _ROUNDING_M / (stations[1] - stations[0]))
    forward = np.gradient(line, stations, axis=0)
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)

    speed = speed_kmh / 3.6 * (1 + 0.12 * np.sin(2 * np.pi * stations / 90 + rng.uniform(0, 2 * np.pi)))
    arrival = np.append(0, np.cumsum(np.diff(stations) * (1 / speed[1:] + 1 / speed[:-1]) / 2))
    times = np.arange(0, arrival[-1], 1 / _POSE_RATE_HZ)
    s = np.interp(times, arrival, stations)
    centre, ahead = (np.stack([np.interp(s, stations, v[:, i]) for i in range(3)], axis=1) for v in (line, forward))
    right = np.stack([ahead[:, 1], -ahead[:, 0], np.zeros(len(s))], axis=1)
    phase = 2 * np.pi * s / 60 + rng.uniform(0, 2 * np.pi)
    wander = 0.1 * np.sin(phase)
    heave = 0.01 * np.sin(2 * np.pi * 1.3 * times + rng.uniform(0, 2 * np.pi))
    positions = centre + right * (lane_offset_m + wander)[:, None]
    positions[:, 2] += heave
    yaw = np.unwrap(np.arctan2(ahead[:, 1], ahead[:, 0])) - 0.1 * 2 * np.pi / 60 * np.cos(phase)
    pitch = -np.arcsin(np.clip(ahead[:, 2], -1, 1)) + np.radians(0.3) * np.sin(2 * np.pi * 1.1 * times + rng.uniform(0, 2 * np.pi))
    roll = np.radians(0.4) * np.sin(2 * np.pi * 0.7 * times + rng.uniform(0, 2 * np.pi))
    return Trajectory(start_s, positions, _rotations(roll, pitch, yaw))


def seed_of_recording(split: str, seed: int) -> int:
    """The seed of a split's drives, their errors, noise and exposures: no two streets of a city share them."""
    return int(np.random.default_rng([seed, zlib.crc32(split.encode()), 20]).integers(2**31))


def plan_passes(scene: Scene, errors: Errors, seed: int, n_rounds: int = 1, start_s: float = 0.0, pause_s: float = 5.0) -> list[Pass]:
    """Every road of a scene driven in both directions, `n_rounds` times, one pass after the other.

    Source: Nagy (2020), 2.3: "usually scans are performed in both directions for a two-way road".

    Args:
        scene: its `roads`, `speeds_kmh` and `lane_offset_m` are used.
        errors: of the navigation.
        seed: of the drives and their errors.
        n_rounds: drives per direction.
        start_s: time of the first pulse.
        pause_s: time between two passes (turning round).
    """
    passes = []
    for _ in range(n_rounds):
        for road, speed_kmh in zip(scene.roads, scene.speeds_kmh, strict=True):
            for line in (road, road[::-1]):
                rng = np.random.default_rng([seed, 1, len(passes)])
                truth = drive_road(np.asarray(line, np.float64), speed_kmh, scene.lane_offset_m, start_s, rng)
                passes.append(Pass(len(passes), truth, _misjudge(truth, errors, is_first=not passes, rng=rng)))
                start_s = truth.end_s + pause_s
    return passes


@dataclass
class Record:
    """A piece of a map and, apart from it, its truth.

    Attributes:
        cloud: points in `map` as the navigation places them; fields intensity uint16, time_s float64, rgb (n, 3) uint8,
            return_number and n_returns uint8.
        labels: (n,) uint8 class of the object most of the echo came from; an object in motion is a phantom.
        instances: (n,) uint32.
    """

    cloud: PointCloud
    labels: np.ndarray
    instances: np.ndarray


def record_map(
    scenes: Iterable[Scene],
    scanners: tuple[ProfileScanner, ...],
    receiver: Receiver,
    cameras: Cameras,
    errors: Errors,
    seed: int,
    n_rounds: int = 1,
    chunk_pulses: int = _CHUNK_PULSES,
) -> Iterator[Record]:
    """The map of a mobile mapper that drives every road of every scene, in pieces of some 100 000 points.

    Args:
        scenes: streets, recorded one after the other; may be a generator, only one is held at a time.
        scanners: on the vehicle's roof.
        receiver, cameras: of both scanners, of the vehicle.
        errors: of the navigation.
        seed: of everything random. Each piece draws from its own generator: pieces do not depend on one another.
        n_rounds: drives per direction.
        chunk_pulses: pulses of one scanner worked on together; the random draws depend on it, memory grows with it.
    Yields:
        records in order of time.
    """
    chunk_s = chunk_pulses / max(s.pulses_per_s for s in scanners)
    mounts = [_misjudged_mount(errors, np.random.default_rng([seed, 6, k])) for k in range(len(scanners))]
    clock_s = 0.0
    for i, scene in enumerate(scenes):
        passes = plan_passes(scene, errors, seed + BLOCK_SEED * i, n_rounds)
        for drive in passes:
            caster, of_block = caster_of_drive(scene, drive), seed + BLOCK_SEED * i
            for c in range(int(np.ceil((drive.truth.end_s - drive.truth.start_s) / chunk_s))):
                for record in _record_chunk(caster, scene.crs, drive, c, chunk_s, scanners, mounts, receiver, cameras, of_block):
                    record.cloud.fields["time_s"] += clock_s
                    yield record
        # Each scene has a clock of its own; the map has one.
        clock_s = np.ceil(clock_s + max((p.truth.end_s for p in passes), default=0.0)) + 60.0


def caster_of_drive(scene: Scene, drive: Pass) -> SceneCaster:
    """What a drive's pulses are cast at: the scene without whoever the vehicle would run into."""
    return SceneCaster(without_collisions(scene, drive.truth), drive.truth.start_s, drive.truth.end_s)


def _record_chunk(caster, crs, drive: Pass, chunk: int, chunk_s: float, scanners, mounts, receiver, cameras, seed: int) -> Iterator[Record]:
    for number, scanner in enumerate(scanners):
        rng = np.random.default_rng([seed, 2, drive.index, chunk, number])
        start_s, end_s = drive.truth.start_s, drive.truth.end_s
        first, last = (int(np.ceil(k * chunk_s * scanner.pulses_per_s)) for k in (chunk, chunk + 1))
        # The scanners take turns: neither fires at the other's moments.
        times_s = start_s + (np.arange(first, last) + number / len(scanners)) / scanner.pulses_per_s
        times_s = times_s[times_s < end_s]
        body = scanner.directions(times_s - start_s)
        seen = ~hits_own_vehicle(scanner.position_m, body)
        times_s, body = times_s[seen], body[seen]
        origins, directions = _place(drive.truth, times_s, scanner.position_m, body)
        returns = measure(caster, origins, directions, times_s, receiver, rng)
        if len(returns) == 0:
            continue
        rows, ranges = returns.pulses, returns.ranges_m[:, None]
        believed_origins, believed_directions = _place(drive.believed, times_s[rows], scanner.position_m, body[rows] @ mounts[number].T)
        rgb = _colour(caster, drive, origins[rows] + ranges * directions[rows], times_s[rows], cameras, seed, rng)
        yield _as_record(caster, returns, believed_origins + ranges * believed_directions, times_s[rows], rgb, crs)


def _colour(caster, drive: Pass, points: np.ndarray, times_s: np.ndarray, cameras: Cameras, seed: int, rng) -> np.ndarray:
    pictures = np.floor((times_s - drive.truth.start_s) / cameras.picture_interval_s).astype(np.int64)
    all_times_s = drive.truth.start_s + (np.arange(pictures.max() + 1) + 0.5) * cameras.picture_interval_s
    positions, rotations = drive.truth.at(all_times_s)
    positions = positions + rotations @ np.asarray(cameras.position_m)
    yaws = np.arctan2(rotations[:, 1, 0], rotations[:, 0, 0])
    seeds = [seed, 3, drive.index]
    return colour_points(caster, points, positions[pictures], yaws[pictures], all_times_s[pictures], pictures, cameras, seeds, rng)


def draw_bursts(
    drive: Pass, scanner: ProfileScanner, n_bursts: int, n_pulses: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pulses a scanner fires during a drive, in bursts of consecutive ones at random moments.

    Returns:
        origins (n, 3) float64 and directions (n, 3) float32, frame `map`, and times (n,) float64, without those that hit the own roof.
    """
    span_s = n_pulses / scanner.pulses_per_s
    starts = np.sort(rng.uniform(drive.truth.start_s, max(drive.truth.end_s - span_s, drive.truth.start_s), n_bursts))
    times_s = (starts[:, None] + np.arange(n_pulses) / scanner.pulses_per_s).ravel()
    body = scanner.directions(times_s - drive.truth.start_s)
    seen = ~hits_own_vehicle(scanner.position_m, body)
    return *_place(drive.truth, times_s[seen], scanner.position_m, body[seen]), times_s[seen]


def record_street(
    split: str,
    seed: int,
    street: dict,
    scanners: tuple[ProfileScanner, ...],
    receiver: Receiver,
    cameras: Cameras,
    errors: Errors,
    n_rounds: int = 1,
) -> Iterator[Record]:
    """The map of the simulated city's street of one split, built and recorded block by block in constant memory.

    Args:
        split: train, validation, test or all.
        seed: of the city and of the recording.
        street: settings of `streetscan.simulation.layout.build_street`: `length_m` and what differs from its defaults.
        scanners, receiver, cameras, errors, n_rounds: see `record_map`.
    Yields:
        records in order of time.
    Raises:
        BadInput: settings no street can have.
    """
    blocks = range(count_blocks(street["length_m"]))
    scenes = (build_street(split=split, seed=seed, n_rounds=n_rounds, block=b, **street) for b in blocks)
    return record_map(scenes, scanners, receiver, cameras, errors, seed_of_recording(split, seed), n_rounds)


def replay_pass(split: str, seed: int, street: dict, block: int) -> tuple[Scene, Trajectory]:
    """A block of a street on the day of its map, and where the mapping vehicle truly was on its first drive along the main road.

    Args:
        split, seed, street: as `record_street` had them; its `n_rounds`, which shape the traffic, among the street's settings.
        block: its number.
    """
    scene = build_street(split=split, seed=seed, block=block, **street)
    return scene, plan_passes(scene, Errors(), seed_of_recording(split, seed) + BLOCK_SEED * block)[0].truth


def record_static(
    scene: Scene, positions: np.ndarray, scanner: StaticScanner, receiver: Receiver, seed: int, start_s: float = 0.0
) -> Iterator[Record]:
    """Panoramas of a scanner on a tripod (thesis Fig. 2.3), without colours.

    Args:
        scene: the street.
        positions: (P, 3) float64 tripod positions on the ground, metres, frame `map`.
        scanner, receiver: their settings.
        seed: of noise and each panorama's heading.
        start_s: time of the first pulse; panoramas follow one another.
    Yields:
        records in order of time; `cloud` has no rgb.
    """
    n_columns = max(_CHUNK_PULSES // scanner.n_rows, 1)
    turn_s = scanner.panorama_s
    for p, position in enumerate(np.asarray(positions, np.float64)):
        heading = np.random.default_rng([seed, 4, p]).uniform(0, 2 * np.pi)
        rotation = _rotations(np.zeros(1), np.zeros(1), np.array([heading]))[0].astype(np.float32)
        caster = SceneCaster(scene, start_s + p * turn_s, start_s + (p + 1) * turn_s)
        for first in range(0, scanner.n_columns, n_columns):
            count = min(n_columns, scanner.n_columns - first)
            directions = scanner.directions(first, count) @ rotation.T
            pulses = first * scanner.n_rows + np.arange(count * scanner.n_rows)
            times_s = start_s + p * turn_s + pulses / scanner.pulses_per_s
            origins = np.tile(position + np.array([0, 0, scanner.height_m]), (len(directions), 1))
            returns = measure(caster, origins, directions, times_s, receiver, np.random.default_rng([seed, 5, p, first]))
            rows = returns.pulses
            points = origins[rows] + returns.ranges_m[:, None] * directions[rows]
            yield _as_record(caster, returns, points, times_s[rows], None, scene.crs)


def record_static_street(
    split: str, seed: int, street: dict, scanner: StaticScanner, receiver: Receiver, spacing_m: float
) -> Iterator[Record]:
    """The map of a tripod carried along the simulated city's street of one split, block by block in constant memory.

    Args:
        split, seed, street: as for `record_street`; what stands is the same, the traffic is that of its own hour.
        scanner, receiver: their settings.
        spacing_m: between neighbouring positions along the street.
    Yields:
        records in order of time; `cloud` has no rgb.
    """
    clock_s = 0.0
    for b in range(count_blocks(street["length_m"])):
        n = len(_tripod_stations(street, b, spacing_m))
        span_s = n * scanner.panorama_s
        scene = build_street(split=split, seed=seed, block=b, time_span_s=(-10.0, span_s), **street)
        positions = tripod_positions(scene, street, b, spacing_m)
        for record in record_static(scene, positions, scanner, receiver, seed_of_recording(split, seed) + BLOCK_SEED * b):
            record.cloud.fields["time_s"] += clock_s
            yield record
        clock_s += span_s


def tripod_positions(scene: Scene, street: dict, block: int, spacing_m: float) -> np.ndarray:
    """(P, 3) places for a tripod in a block: on the sidewalk, on the left and the right in turn, where nothing stands.

    ASSUME: a panorama every `spacing_m`, 12.3 m from the street's axis between the rows of furniture; where something stands within
    0.8 m, further along or on the other side, as an operator would choose.
    """
    road = scene.roads[0]
    along = np.append(0, np.cumsum(np.linalg.norm(np.diff(road, axis=0), axis=1)))
    solid = scene.static.vertices[np.unique(scene.static.triangles[scene.static.labels != GROUND])]
    positions = []
    for k, station in enumerate(_tripod_stations(street, block, spacing_m)):
        first_side = 1 - 2 * (k % 2)
        best_m, best = -1.0, None
        for step, side in itertools.product(np.arange(0.0, spacing_m / 2, 0.5), (first_side, -first_side)):
            place = _beside(road, along, min(station + step, along[-1] - 0.5), 12.3 * side)
            above = solid[:, 2] - place[2]
            around = np.hypot(*(solid[(above > 0.3) & (above < 2.2), :2] - place[:2]).T)
            clearance_m = float(around.min(initial=np.inf))
            if clearance_m > best_m:
                best_m, best = clearance_m, place
            if best_m >= 0.8:
                break
        positions.append(best)
    return np.array(positions)


def _beside(road: np.ndarray, along: np.ndarray, s: float, t: float) -> np.ndarray:
    """(3,) place t metres to the left of a centre line (K, 3) at s metres along it, as high as the line."""
    behind, ahead = (np.array([np.interp(s + d, along, road[:, i]) for i in range(3)]) for d in (-0.5, 0.5))
    forward = (ahead - behind)[:2] / np.linalg.norm((ahead - behind)[:2])
    return (behind + ahead) / 2 + np.array([-t * forward[1], t * forward[0], 0])


def _tripod_stations(street: dict, block: int, spacing_m: float) -> np.ndarray:
    """Distances along a block's road, evenly spread."""
    length_m = street["length_m"] / count_blocks(street["length_m"])
    n = max(1, round(length_m / spacing_m))
    return (np.arange(n) + 0.5) * length_m / n


def write_map(records: Iterable[Record], map_path: str | Path, labels_path: str | Path, instances_path: str | Path) -> int:
    """Stream a recording to disk: the map as LAZ without any truth, and the truth as two arrays in the same order.

    Args:
        records: of `record_map`, `record_street` or `record_static`.
        map_path: LAZ with intensity, time_s, rgb (if there), return_number, n_returns.
        labels_path: `.npy` (N,) uint8.
        instances_path: `.npy` (N,) uint32.
    Returns:
        the number of points.
    Raises:
        BadInput: the recording holds no point. No file is left.
    """
    n_points, n_logged, started = 0, 0, time.perf_counter()
    records = (record for record in records if len(record.labels))
    first = next(records, None)
    if first is None:
        raise BadInput(map_path, "the scanners hit nothing", "check the scene's roads and the receiver's ranges")
    with (
        open_las_writer(map_path, first.cloud.crs) as las,
        open_npy_writer(labels_path, np.uint8) as labels,
        open_npy_writer(instances_path, np.uint32) as instances,
    ):
        for record in itertools.chain([first], records):
            las.write(record.cloud)
            labels.write(record.labels)
            instances.write(record.instances)
            n_points += len(record.labels)
            if n_points - n_logged >= _LOG_POINTS:
                n_logged = n_points
                logger.info("%.1f million points in %.0f s", n_points / 1e6, time.perf_counter() - started)
    seconds = time.perf_counter() - started
    logger.info("%d points in %.1f s, %.2f s per million", n_points, seconds, seconds / n_points * 1e6)
    return n_points


def _as_record(caster: SceneCaster, returns: Returns, points: np.ndarray, times_s: np.ndarray, rgb, crs: str | None) -> Record:
    fields = {"intensity": returns.intensities, "time_s": times_s}
    if rgb is not None:
        fields["rgb"] = rgb
    fields |= {"return_number": returns.return_numbers, "n_returns": returns.n_returns}
    return Record(PointCloud(points, fields, crs), caster.labels_at(returns, times_s), caster.instances[returns.faces])


def _place(trajectory: Trajectory, times_s: np.ndarray, mount_m, body: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Origins (n, 3) float64 and directions (n, 3) float32 in `map` of rays given in the vehicle frame."""
    positions, rotations = trajectory.at(times_s)
    return positions + rotations @ np.asarray(mount_m), np.einsum("nij,nj->ni", rotations.astype(np.float32), body)


def _misjudge(truth: Trajectory, errors: Errors, is_first: bool, rng: np.random.Generator) -> Trajectory:
    """The trajectory the navigation reports: smooth drift, a little attitude error, an offset against the first pass."""
    times = np.arange(len(truth.positions)) / _POSE_RATE_HZ
    drift = errors.drift_m * _slow_noise(times, rng)
    attitude = np.radians(errors.attitude_deg) * _slow_noise(times, rng)
    bearing, length = rng.uniform(0, 2 * np.pi), rng.uniform(*errors.pass_offset_m)
    offset = np.zeros(3) if is_first else length * np.array([np.cos(bearing), np.sin(bearing), 0.3 * rng.standard_normal()])
    turned = _rotations(*attitude.T) @ truth.rotations
    return replace(truth, positions=truth.positions + drift + offset, rotations=turned)


def _misjudged_mount(errors: Errors, rng: np.random.Generator) -> np.ndarray:
    """(3, 3) float32 small rotation between how a scanner is mounted and how it is believed to be."""
    return _rotations(*np.radians(errors.boresight_deg * rng.standard_normal((3, 1))))[0].astype(np.float32)


def _slow_noise(times: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """(n, 3) smooth noise of unit standard deviation: four waves of 8 to 60 s per axis."""
    periods = rng.uniform(8, 60, (4, 3))
    phases = rng.uniform(0, 2 * np.pi, (4, 3))
    return np.sin(2 * np.pi * times[:, None, None] / periods + phases).sum(axis=1) / np.sqrt(2)


def _rotations(roll: np.ndarray, pitch: np.ndarray, yaw: np.ndarray) -> np.ndarray:
    """(n, 3, 3) rotations Rz(yaw) Ry(pitch) Rx(roll)."""
    return Rotation.from_euler("ZYX", np.stack([yaw, pitch, roll], axis=1)).as_matrix()


def _smooth(line: np.ndarray, sigma: float) -> np.ndarray:
    """A polyline with its corners rounded; reflected through its end points so that straight lines stay as they are."""
    n = min(int(4 * sigma) + 1, len(line) - 1)
    padded = np.pad(line, ((n, n), (0, 0)), mode="reflect", reflect_type="odd")
    return gaussian_filter1d(padded, sigma, axis=0, mode="nearest")[n:-n]


def without_collisions(scene: Scene, truth: Trajectory) -> Scene:
    """The scene without the actors that would run into the mapping vehicle during this drive.

    ASSUME: other traffic keeps 1.5 m away from the van; whoever does not, because a scene's traffic knows nothing of
    the van, was not there.
    """
    times = np.arange(truth.start_s, truth.end_s, 0.05)
    van, _ = truth.at(times)
    return replace(scene, actors=[a for a in scene.actors if not _comes_close(a, times, van)])


def _comes_close(actor: Actor, times: np.ndarray, van: np.ndarray) -> bool:
    positions, yaws = actor.pose_at(times)
    dx, dy = (van - positions)[:, :2].T
    ahead, aside = np.cos(yaws) * dx + np.sin(yaws) * dy, -np.sin(yaws) * dx + np.cos(yaws) * dy
    low, high = actor.mesh.vertices[:, :2].min(axis=0), actor.mesh.vertices[:, :2].max(axis=0)
    margin_m = 1.5
    inside = (ahead > low[0] - 2.5 - margin_m) & (ahead < high[0] + 2.5 + margin_m)
    inside &= (aside > low[1] - 1.0 - 0.2) & (aside < high[1] + 1.0 + 0.2)
    return bool(inside.any())
