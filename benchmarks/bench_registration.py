"""Grid classes, registration of pairs (Józsa & Benedek 2013, Table 1), odometry against KISS-ICP and small_gicp, merging."""

import lzma
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import open3d as o3d

from benchmarks.bench_drives import peak_memory_mb
from streetscan.drives import Recording, read_drive_facts
from streetscan.frames import LidarFrame
from streetscan.geometry import transform
from streetscan.registration.evaluation import evaluate_chain, smooth_positions
from streetscan.registration.grid_classes import (
    GROUND,
    SETTINGS_OF_THE_REPORT,
    TALL_STRUCTURE,
    classify_points,
    segment_frame,
)
from streetscan.registration.grid_evaluation import GRID_CLASSES, count_confusion, score_grid
from streetscan.registration.merging import MergeFrame, merge_frames
from streetscan.registration.odometry import Frame, FramePose, OdometrySettings, make_odometry, register_drive, register_pair

ROOT = Path(__file__).resolve().parents[1]
SENSOR_HEIGHT_M = 1.73
SEMANTIC_IDS = GRID_CLASSES["semantickitti"]
PAPER_RATIO = "paper 11-46"
_PAIR_METRICS = ("pair_time_median", "pair_time_p95", "frame_rate", "failed_pairs", "rpe_rmse", "rpe_rotation_rmse", "ape_rmse", "drift")


def bench_registration(data_root: str | Path, n_repeats: int = 20) -> list[dict]:
    """All figures of registration on the recordings at hand.

    Args:
        data_root: folder of the recordings; those that are missing are left out.
        n_repeats: of the timing of the grid.
    Returns:
        rows benchmark, metric, value, unit, peer, n.
    """
    data_root = Path(data_root)
    scans = list(_labelled_scans(data_root / "semantickitti"))
    rows = _bench_grid(scans, n_repeats) + _bench_slope() if scans else []
    for name in ("kitti_0001", "kitti_0005", "muehlburger_tor"):
        drive = _load_drive(data_root, name)
        if drive is not None:
            rows += _bench_pairs(drive) + _bench_odometry(drive) + _bench_rates(drive) + _bench_no_prediction(drive)
    return rows + _bench_memory()


def _row(benchmark: str, metric: str, value: float, unit: str, peer: str = "", n: int = 1) -> dict:
    return {"benchmark": benchmark, "metric": metric, "value": float(value), "unit": unit, "peer": peer, "n": int(n)}


def _labelled_scans(root: Path) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    for path in sorted(root.glob("0[0125]/velodyne/*.bin.xz")):
        labels = path.parent.parent / "labels" / path.name.replace(".bin", ".label")
        with lzma.open(path) as scan, lzma.open(labels) as ids:
            points = np.frombuffer(scan.read(), np.float32).reshape(-1, 4)[:, :3]
            yield points, np.frombuffer(ids.read(), np.uint32) & 0xFFFF


def _bench_grid(scans: list, n_repeats: int) -> list[dict]:
    points = max((p for p, _ in scans), key=len)
    rows = []
    for metric, call in (
        ("classify_points", lambda: classify_points(points, SENSOR_HEIGHT_M)),
        ("segment_frame", lambda: segment_frame(points, SENSOR_HEIGHT_M)),
    ):
        call()
        times_ms = [1000 * _time(call) for _ in range(n_repeats)]
        rows.append(_row("grid_classes", metric, np.median(times_ms), "ms", n=len(points)))
    variants = {
        "default": lambda p: segment_frame(p, SENSOR_HEIGHT_M),
        "no_foot_correction": lambda p: segment_frame(p, SENSOR_HEIGHT_M, foot_method="none"),
        "thresholds_of_the_report": lambda p: segment_frame(p, SENSOR_HEIGHT_M, SETTINGS_OF_THE_REPORT, "none"),
    }
    for name, segment in variants.items():
        found = [(segment(p), ids) for p, ids in scans]
        for c, metric, value, unit, _ in score_grid(count_confusion(found, SEMANTIC_IDS)).itertuples(index=False):
            rows.append(_row(f"grid_classes_{name}", f"{c} {metric}", value, unit, n=len(scans)))
        sparse = np.concatenate([labels == 0 for labels, _ in found])
        rows.append(_row(f"grid_classes_{name}", "sparse share", 100 * sparse.mean(), "%", "paper <10", len(scans)))
    return rows + _bench_plane(scans)


def _plane_inliers(points: np.ndarray) -> np.ndarray:
    """(N,) bool: the points within 0.2 m of the plane RANSAC finds."""
    o3d.utility.random.seed(1)
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points.astype(np.float64)))
    _, rows = cloud.segment_plane(0.2, 3, 300)
    inside = np.zeros(len(points), np.bool_)
    inside[rows] = True
    return inside


def _rate_ground(benchmark: str, clouds: list) -> list[dict]:
    """Precision and recall of the grid's ground and of a RANSAC plane; `clouds`: points and whether each is ground, known ones only."""
    rows = []
    for peer, find in (("", lambda p: segment_frame(p, SENSOR_HEIGHT_M) == GROUND), ("open3d RANSAC plane", _plane_inliers)):
        hits = found = wanted = 0
        for points, is_ground, is_known in clouds:
            says = find(points)
            hits += (says & is_ground).sum()
            found += (says & is_known).sum()
            wanted += is_ground.sum()
        rows.append(_row(benchmark, "ground precision", 100 * hits / found, "%", peer, len(clouds)))
        rows.append(_row(benchmark, "ground recall", 100 * hits / wanted, "%", peer, len(clouds)))
    return rows


def _bench_plane(scans: list) -> list[dict]:
    clouds = [(p, np.isin(ids, SEMANTIC_IDS[GROUND]), np.isin(ids, sum(SEMANTIC_IDS.values(), ()))) for p, ids in scans]
    return _rate_ground("ground_semantickitti", clouds)


def _bench_slope(slope: float = 0.08) -> list[dict]:
    """A street that is level behind the vehicle and climbs ahead of it, with fronts along it."""
    rng = np.random.default_rng(1)
    xy = np.c_[rng.uniform(-45, 45, 80_000), rng.uniform(-8, 8, 80_000)]
    height = slope * np.maximum(xy[:, 0], 0)
    road = np.c_[xy, height + rng.normal(0, 0.01, len(xy))]
    wall = np.c_[xy[:30_000, 0], np.where(xy[:30_000, 1] > 0, 9.0, -9.0), height[:30_000] + rng.uniform(0, 4, 30_000)]
    points = np.concatenate([road, wall]) - [0, 0, SENSOR_HEIGHT_M]
    is_ground = np.arange(len(points)) < len(road)
    return _rate_ground("ground_on_a_slope", [(points, is_ground, np.ones(len(points), np.bool_))])


@dataclass
class _Drive:
    """A recording in memory with its reference."""

    name: str
    frames: list[LidarFrame]
    reference: np.ndarray
    is_planar: bool
    sensor_height_m: float

    def every(self, step: int) -> "_Drive":
        return replace(self, frames=self.frames[::step], reference=self.reference[::step])


def _load_drive(data_root: Path, name: str) -> _Drive | None:
    facts = read_drive_facts(ROOT / "config" / "drives" / f"{name}.yaml", ROOT / "config" / "drive.schema.yaml")
    if not (data_root / facts.root).exists():
        return None
    recording = Recording(facts, data_root)
    frames = [r for r in recording.records() if isinstance(r, LidarFrame)]
    truth = facts.truth.poses
    reference = np.array([recording.true_pose(f) for f in frames])
    reference = smooth_positions(np.array([f.time_ns / 1e9 for f in frames]), reference, truth.get("smoothing_s", 0.0))
    sensor_height_m = next(m.T_parent_child[2, 3] for m in recording.mountings if (m.parent, m.child) == ("vehicle", "lidar"))
    return _Drive(name, frames, reference, truth.get("is_planar", False), sensor_height_m)


def _time(call) -> float:
    start_s = time.perf_counter()
    call()
    return time.perf_counter() - start_s


def _run_chain(drive: _Drive, settings: OdometrySettings) -> tuple[list[FramePose], np.ndarray]:
    """Rows and seconds per frame; the grid's classes are part of a frame's time when they are used."""
    odometry, rows, seconds = make_odometry(settings), [], []
    for i, frame in enumerate(drive.frames):
        start_s = time.perf_counter()
        labels = segment_frame(frame.points, drive.sensor_height_m) if settings.classes else None
        offsets = frame.time_offset_s if frame.time_offset_s is not None and frame.time_offset_s.any() else None
        rows.append(odometry.add(Frame(i, frame.time_ns / 1e9, frame.points, labels, offsets)))
        seconds.append(time.perf_counter() - start_s)
    return rows, np.array(seconds)


def _score(drive: _Drive, rows: list[FramePose], seconds: np.ndarray) -> dict[str, tuple[float, str, int]]:
    table = evaluate_chain(rows, drive.reference, seconds, drive.is_planar)
    return {metric: (value, unit, n) for metric, value, unit, n in table.itertuples(index=False)}


def _bench_pairs(drive: _Drive) -> list[dict]:
    """Table 1: consecutive frames, with and without pre-segmentation, all else equal."""
    rows, medians = [], {}
    for variant, classes in (("presegmented", (TALL_STRUCTURE,)), ("raw", ())):
        scores = _score(drive, *_run_chain(drive, OdometrySettings(target="previous", classes=classes)))
        medians[variant] = scores["pair_time_median"][0]
        for metric in (
            "pair_time_median",
            "pair_time_p95",
            "frame_rate",
            "failed_pairs",
            "rpe_rmse",
            "rpe_rotation_rmse",
            "ape_rmse",
            "drift",
        ):
            value, unit, n = scores[metric]
            rows.append(_row(f"pairs_{drive.name}", f"{variant} {metric}", value, unit, n=n))
    ratio = medians["raw"] / medians["presegmented"]
    return [*rows, _row(f"pairs_{drive.name}", "raw / presegmented", ratio, "ratio", PAPER_RATIO, len(drive.frames) - 1)]


def _bench_odometry(drive: _Drive) -> list[dict]:
    """NDT on tall structure against the street so far, and its peers on all points."""
    rows = []
    chains = {
        "": lambda: _run_chain(drive, OdometrySettings()),
        "kiss-icp": lambda: _run_chain(drive, OdometrySettings("kiss_icp", "street", ())),
        "small_gicp GICP, pairs": lambda: _run_chain(drive, OdometrySettings("gicp", "previous", ())),
        "small_gicp VGICP, street": lambda: _run_chain(drive, OdometrySettings("vgicp", "street", ())),
    }
    for peer, run in chains.items():
        scores = _score(drive, *run())
        for metric in ("frame_rate", "failed_pairs", "ape_rmse", "rpe_rmse", "rpe_max", "rpe_rotation_rmse", "drift"):
            value, unit, n = scores[metric]
            rows.append(_row(f"odometry_{drive.name}", metric, value, unit, peer, n))
    return rows


def _bench_rates(drive: _Drive) -> list[dict]:
    """The same drive from a slower sensor: every second and third frame (10, 5 and 3.3 Hz)."""
    rows = []
    for step in (1, 2, 3):
        slower = drive.every(step)
        for variant, classes in (("presegmented", (TALL_STRUCTURE,)), ("raw", ())):
            scores = _score(slower, *_run_chain(slower, OdometrySettings(target="previous", classes=classes)))
            for metric in ("failed_pairs", "rpe_rmse", "rpe_max"):
                value, unit, n = scores[metric]
                rows.append(_row(f"rate_{drive.name}", f"every {step}: {variant} {metric}", value, unit, n=n))
    return rows


def _bench_no_prediction(drive: _Drive, max_distance_m: float = 0.5) -> list[dict]:
    """Pairs 1, 3, 5 and 10 frames apart started from no motion: how many are right, and how many wrong ones are taken for right."""
    rows, moving = [], [i for i in range(len(drive.frames)) if i >= (200 if drive.name == "muehlburger_tor" else 0)]
    for step in (1, 3, 5, 10):
        for variant, classes in (("presegmented", (TALL_STRUCTURE,)), ("raw", ())):
            n_right = n_taken = n = 0
            for i in moving[: -step or None : 5]:
                pair = []
                for j in (i, i + step):
                    frame = drive.frames[j]
                    pair.append(Frame(j, frame.time_ns / 1e9, frame.points, segment_frame(frame.points, drive.sensor_height_m)))
                result = register_pair(*pair, settings=OdometrySettings(classes=classes))
                truth = np.linalg.inv(drive.reference[i]) @ drive.reference[i + step]
                n += 1
                if result.is_posed:
                    is_right = np.linalg.norm((np.linalg.inv(truth) @ result.T_segment_lidar)[:2, 3]) <= max_distance_m
                    n_right, n_taken = n_right + is_right, n_taken + (not is_right)
            if n:
                rows.append(_row(f"no_prediction_{drive.name}", f"{step} apart: {variant} right", 100 * n_right / n, "%", n=n))
                rows.append(
                    _row(f"no_prediction_{drive.name}", f"{step} apart: {variant} wrong, taken for right", 100 * n_taken / n, "%", n=n)
                )
    return rows


def _bench_memory() -> list[dict]:
    """Peak memory of registering and merging 100 and 1000 frames along an endless street."""
    rows = []
    for step in _MANY:
        for n in (100, 1000):
            command = [sys.executable, "-m", "benchmarks.bench_registration", step, str(n)]
            output = subprocess.run(command, capture_output=True, text=True, cwd=ROOT)
            output.check_returncode()
            seconds, peak_mb = (float(v) for v in output.stdout.split())
            rows.append(_row(step, f"peak memory of {n} frames", peak_mb, "MB", n=n))
            rows.append(_row(step, f"frames per second of {n} frames", n / seconds, "fps", n=n))
    return rows


def _endless_street(n_frames: int) -> Callable[[int, int], Iterator[tuple[int, np.ndarray]]]:
    """Frames of 40 000 points, a metre apart, between two fronts with recesses of their own all along the way."""
    rng = np.random.default_rng(1)
    n = 200 * (n_frames + 100)
    x = np.sort(rng.uniform(-50, n_frames + 50, n))
    depth = rng.uniform(0, 2, n_frames + 102)[np.floor((x + 50) / 4).astype(int)]
    wall = np.stack([x, np.where(rng.random(n) < 0.5, -1, 1) * (10 + depth), rng.uniform(-SENSOR_HEIGHT_M, 4, n)], axis=1)
    ground = np.stack([x, rng.uniform(-9, 9, n), np.full(n, -SENSOR_HEIGHT_M)], axis=1)

    def read(first: int, last: int) -> Iterator[tuple[int, np.ndarray]]:
        for i in range(first, min(last, n_frames)):
            a, b = np.searchsorted(x, (i - 50, i + 50))
            yield i, (np.concatenate([wall[a:b], ground[a:b]]) - [i, 0, 0]).astype(np.float32)

    return read


def _merge_many(n_frames: int, folder: Path) -> None:
    read_points = _endless_street(n_frames)

    def read(first: int, last: int) -> Iterator[MergeFrame]:
        for i, points in read_points(first, last):
            yield MergeFrame(i, 0.1 * i, points, segment_frame(points, SENSOR_HEIGHT_M))

    poses = {i: FramePose(i, 0.1 * i, "ok", 0, transform([float(i), 0, 0])) for i in range(n_frames)}
    merge_frames(read, poses, folder / "tiles", folder / "work")


def _register_many(n_frames: int, folder: Path) -> None:
    read_points = _endless_street(n_frames)

    def read(first: int, last: int) -> Iterator[Frame]:
        for i, points in read_points(first, last):
            yield Frame(i, 0.1 * i, points, segment_frame(points, SENSOR_HEIGHT_M))

    poses, _ = register_drive(read, n_frames, folder)
    assert all(pose.is_posed for pose in poses)


_MANY = {"register_frames": _register_many, "merge_frames": _merge_many}


def _run_many(step: str, n_frames: int) -> None:
    """Prints the seconds and the peak memory in MB."""
    with tempfile.TemporaryDirectory() as folder:
        seconds = _time(lambda: _MANY[step](n_frames, Path(folder)))
    print(seconds, peak_memory_mb())


if __name__ == "__main__":
    _run_many(sys.argv[1], int(sys.argv[2]))
