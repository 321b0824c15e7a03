"""Frames of real drives on maps made of their other frames: success, errors, rates, memory, and the reference methods beside them.

A sanity check rather than an accuracy, for map and frames share the sensor and the day, and the "true" poses are those of the drive's own
registration (Nagy 2020 had neither: his map is another sensor's). Starts have errors like a GPS receiver's between houses.
"""

import itertools
import tempfile
import time
import tracemalloc
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml

from streetscan.drives import Recording, read_drive_facts
from streetscan.frames import LidarFrame
from streetscan.io.las import iterate_las
from streetscan.landmarks import cluster_landmarks, euclidean_clusters, mean_points
from streetscan.localization.baselines.kiss_matcher import KissMatcherLocalizer
from streetscan.localization.baselines.registration import GicpLocalizer, NdtLocalizer
from streetscan.localization.drive import Localizer
from streetscan.localization.evaluation import SUCCESS_DEG, SUCCESS_M, pose_error
from streetscan.localization.ground import find_ground
from streetscan.localization.localizer import LocalizerSettings, Location, Start, VotingLocalizer
from streetscan.localization.objects import find_objects
from streetscan.localization.reference import Reference, make_reference
from streetscan.registration.grid_classes import GROUND, SHORT_OBJECT, TALL_STRUCTURE, segment_frame
from streetscan.registration.merging import MergeFrame, MergeSettings, merge_frames
from streetscan.registration.odometry import Frame, FramePose, register_frames
from streetscan.segmentation.c2cnn import load_network
from streetscan.segmentation.ground import add_heights
from streetscan.segmentation.inference import label_voxels
from streetscan.sweeps import deskew
from streetscan.voxels import voxelize

ROOT = Path(__file__).resolve().parents[1]
SENSOR_HEIGHT_M = 1.73
# Drive: first frame, and which frames (every, offset) are localized; the rest is the map. The second stands until frame 190.
DRIVES = {"kitti_0001": (0, 2, 1), "muehlburger_tor": (201, 10, 5)}
# Errors of the starts: deviation per axis (m) and of the heading (degrees), cut inside the thesis' window.
_GPS_M, _HEADING_DEG, _LIMIT_M, _LIMIT_DEG = 4.0, 8.0, 11.0, 40.0
_N_PEER_FRAMES, _N_CLUSTERED = 25, 5


def bench_localization(data_root: str | Path) -> list[dict]:
    """All figures of localization on the recordings at hand.

    Args:
        data_root: folder of the recordings; those that are missing are left out.
    Returns:
        rows benchmark, metric, value, unit, peer, n.
    """
    rows, cases = [], {}
    for name in DRIVES:
        facts = read_drive_facts(ROOT / "config" / "drives" / f"{name}.yaml", ROOT / "config" / "drive.schema.yaml")
        if (Path(data_root) / facts.root).exists():
            cases[name] = _prepare(name, Recording(facts, data_root))
            rows += _bench_drive(name, cases[name])
    for name, other in itertools.permutations(cases, 2):
        rows.append(_bench_other_map(f"localization_{name}", cases[name], other, cases[other]))
    return rows


@dataclass
class _Case:
    """A map, and the frames to find on it: points freed of motion, true poses, starts."""

    reference: Reference
    points: list[np.ndarray]
    truth: np.ndarray
    starts: list[Start]


def _prepare(name: str, recording: Recording) -> _Case:
    first, every, offset = DRIVES[name]
    frames = [f for f in recording.records() if isinstance(f, LidarFrame)][first:]
    labels = [segment_frame(f.points, SENSOR_HEIGHT_M) for f in frames]
    offsets = [f.time_offset_s if f.time_offset_s is not None and f.time_offset_s.any() else None for f in frames]
    chain = list(
        register_frames(Frame(i, f.time_ns / 1e9, f.points, labels[i], offsets[i]) for i, f in enumerate(frames))
    )  # fmt: skip
    is_wanted = {p.index for p in chain if p.is_posed and p.index % every == offset}
    on_map = {p.index: p for p in chain if p.is_posed and p.index not in is_wanted}

    def read(first: int, last: int) -> Iterator[MergeFrame]:
        for i in range(first, min(last, len(frames))):
            if i in on_map:
                yield MergeFrame(i, frames[i].time_ns / 1e9, frames[i].points, labels[i], offsets[i])

    reference = _make_map(read, on_map)
    rng, found = np.random.default_rng(3), sorted(is_wanted)
    starts = []
    for i in found:
        T = chain[i].T_segment_lidar
        error = np.clip(rng.normal(0, _GPS_M, 2), -_LIMIT_M, _LIMIT_M)
        turn = np.radians(np.clip(rng.normal(0, _HEADING_DEG), -_LIMIT_DEG, _LIMIT_DEG))
        starts.append(Start(T[:2, 3] + error, float(np.arctan2(T[1, 0], T[0, 0]) + turn)))
    points = [_freed(frames[i], chain[i]) for i in found]
    return _Case(reference, points, np.array([chain[i].T_segment_lidar for i in found]), starts)


def _freed(frame: LidarFrame, pose: FramePose) -> np.ndarray:
    known = frame.time_offset_s is not None and np.isfinite(pose.velocity_mps).all()
    return deskew(frame.points, frame.time_offset_s, pose.velocity_mps, pose.turn_rate_radps) if known else frame.points.astype(float)


def _make_map(read, poses: Mapping[int, FramePose]) -> Reference:
    """Merge frames, label them with the shipped network, and make landmarks: what the workflow does step by step."""
    settings = yaml.safe_load((ROOT / "config" / "default.yaml").read_text())
    with tempfile.TemporaryDirectory() as folder:
        # What the grid calls sparse holds echoes of mirrors below the road, which a map must not have.
        chosen = MergeSettings(thin_m=0.03, classes=(GROUND, SHORT_OBJECT, TALL_STRUCTURE))
        merge_frames(read, dict(poses), Path(folder) / "tiles", Path(folder) / "work", chosen)
        paths = sorted((Path(folder) / "tiles").glob("*.laz"))
        grid = voxelize((c.points for p in paths for c in iterate_las(p)), settings["voxelize_map"]["size_m"])
        grid = add_heights(grid, **settings["voxelize_map"]["ground"])
        means = mean_points(grid, (c.points for p in paths for c in iterate_las(p)))
    network = load_network(ROOT / "weights" / "c2cnn" / "weights.safetensors", ROOT / "weights" / "c2cnn" / "settings.yaml")
    rows, predicted, _ = label_voxels(network, grid, settings["label_map"]["tile_m"])[:3]
    labels = np.zeros(len(grid), np.uint8)
    labels[rows] = predicted
    return make_reference(grid, means, labels, cluster_landmarks(means, grid.height_m, labels), None)


def _bench_drive(name: str, case: _Case) -> list[dict]:
    localizer = VotingLocalizer(case.reference)
    localizer.locate(case.points[0], case.starts[0])  # compiles, and prepares the map
    found = [localizer.locate(p, s) for p, s in zip(case.points, case.starts, strict=True)]
    bench, n = f"localization_{name}", len(found)
    rows = _rates(bench, "refined", found, case.truth, "T_map_lidar") + _rates(bench, "vote", found, case.truth, "T_vote")
    seconds = np.array([f.seconds for f in found])
    rows.append(_row(bench, "detection", 1000 * np.median(seconds[:, 0]), "ms", n=n))
    rows.append(_row(bench, "vote, 8 keypoints", 1000 * np.median(seconds[:, 1]), "ms", n=n))
    rows.append(_row(bench, "detection and vote", 1 / np.median(seconds[:, :2].sum(axis=1)), "fps", "paper 15", n))
    by_points = np.array([f.source == "points" for f in found])
    for which, chosen in (("refined", by_points | True), ("refined, by objects", ~by_points), ("refined, by points", by_points)):
        totals = seconds[chosen].sum(axis=1)
        rows.append(_row(bench, which, 1 / np.median(totals) if len(totals) else np.nan, "fps", n=len(totals)))
    rows.append(_row(bench, "found by points", 100 * by_points.mean(), "%", n=n))
    return (
        rows
        + _bench_no_guess(bench, localizer, case)
        + _bench_memory(bench, case)
        + _bench_clustering(bench, case)
        + _bench_peers(bench, case, float(np.median(seconds[:, :2].sum(axis=1))))
    )


def _rates(bench: str, which: str, found: list[Location], truth: np.ndarray, pose: str) -> list[dict]:
    """Success over all frames; medians over those called ok, for `refined`, or over the successful ones."""
    errors = np.array([pose_error(getattr(f, pose), T) for f, T in zip(found, truth, strict=True)])
    is_right = (errors[:, 0] < SUCCESS_M) & (errors[:, 1] < SUCCESS_DEG)
    is_ok = np.array([f.status == "ok" for f in found]) if which == "refined" else is_right
    rows = [_row(bench, f"{which} success", 100 * is_right.mean(), "%", n=len(found))]
    if which == "refined":
        rows.append(_row(bench, "ok", 100 * is_ok.mean(), "%", n=len(found)))
        rows.append(_row(bench, "wrong but ok", (is_ok & ~is_right).sum(), "frames", n=len(found)))
    for k, unit in enumerate(("m", "deg")):
        rows.append(_row(bench, f"{which} median error", np.median(errors[is_ok, k]) if is_ok.any() else np.nan, unit, n=int(is_ok.sum())))
    return rows


def _bench_no_guess(bench: str, localizer: VotingLocalizer, case: _Case) -> list[dict]:
    """Full circle and 60 m around a place that far off."""
    rng, found, seconds = np.random.default_rng(5), [], []
    chosen = range(0, len(case.points), max(1, len(case.points) // 10))
    for i in itertools.chain(chosen[:1], chosen):  # the first one compiles
        start = Start(case.truth[i, :2, 3] + rng.uniform(-40, 40, 2))
        begun = time.perf_counter()
        found.append(localizer.locate(case.points[i], start))
        seconds.append(time.perf_counter() - begun)
    errors = np.array([pose_error(f.T_map_lidar, case.truth[i]) for f, i in zip(found[1:], chosen, strict=True)])
    right = (errors[:, 0] < SUCCESS_M) & (errors[:, 1] < SUCCESS_DEG)
    wrong = sum(f.status == "ok" and not r for f, r in zip(found[1:], right, strict=True))
    return [
        _row(bench, "no guess success", 100 * right.mean(), "%", n=len(right)),
        _row(bench, "no guess wrong but ok", wrong, "frames", n=len(right)),
        _row(bench, "no guess time", np.median(seconds[1:]), "s", n=len(right)),
    ]


def _bench_other_map(bench: str, case: _Case, other: str, other_case: _Case) -> dict:
    """Frames looked for on the map of another street, where every pose that is believed is wrong."""
    localizer = VotingLocalizer(other_case.reference)
    starts = itertools.cycle(other_case.starts)
    chosen = np.unique(np.linspace(0, len(case.points) - 1, _N_PEER_FRAMES).astype(int))
    found = [localizer.locate(case.points[i], start) for i, start in zip(chosen, starts, strict=False)]
    return _row(bench, "believed on another map", sum(f.status == "ok" for f in found), "frames", other, len(found))


def _bench_memory(bench: str, case: _Case) -> list[dict]:
    """What detection and vote allocate at most, beside the thesis' dense array of 16-bit votes."""
    localizer = VotingLocalizer(case.reference, LocalizerSettings(is_refined=False))
    tracemalloc.start()
    localizer.locate(case.points[0], case.starts[0])
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    n_cells = np.prod(LocalizerSettings().window.shape, dtype=np.int64) * len(LocalizerSettings().window.turns_rad)
    return [
        _row(bench, "vote memory", peak / 2**20, "MiB", f"dense {2 * n_cells / 2**20:.0f}"),
        _row(bench, "cells of the dense array", n_cells / 1e6, "M"),
    ]


def _bench_clustering(bench: str, case: _Case) -> list[dict]:
    """Region growing on cells against Euclidean clustering with a kd-tree, on the same points above the ground (thesis: 100 times)."""
    ratios, milliseconds = [], []
    for points in case.points[:: max(1, len(case.points) // _N_CLUSTERED)]:
        ground = find_ground(points)
        standing = ground.points[(ground.heights_m > 0.1) & (ground.heights_m < 2.5)].astype(np.float64)
        times = [_time(lambda g=ground: find_objects(g)) for _ in range(3)]
        ratios.append(_time(lambda p=standing: euclidean_clusters(p, 0.3, 8)) / min(times))
        milliseconds.append(1000 * min(times))
    return [
        _row(bench, "region growing", np.median(milliseconds), "ms", n=len(ratios)),
        _row(bench, "kd-tree clustering / region growing", np.median(ratios), "ratio", "paper 100", len(ratios)),
    ]


def _bench_peers(bench: str, case: _Case, own_s: float) -> list[dict]:
    """The reference methods on the same frames and starts; ratios to detection and vote."""
    chosen = np.unique(np.linspace(0, len(case.points) - 1, _N_PEER_FRAMES).astype(int))
    peers: dict[str, Localizer] = {
        "KISS-Matcher": KissMatcherLocalizer(case.reference),
        "GICP from GPS": GicpLocalizer(case.reference),
        "NDT from GPS": NdtLocalizer(case.reference),
    }
    rows = []
    for name, peer in peers.items():
        found = [peer.locate(case.points[i], case.starts[i]) for i in chosen]
        errors = np.array([pose_error(f.T_map_lidar, T) for f, T in zip(found, case.truth[chosen], strict=True)])
        right = (errors[:, 0] < SUCCESS_M) & (errors[:, 1] < SUCCESS_DEG)
        seconds = float(np.median([f.seconds.sum() for f in found]))
        rows.append(_row(bench, "success", 100 * right.mean(), "%", name, len(chosen)))
        rows.append(_row(bench, "median time", seconds, "s", name, len(chosen)))
        rows.append(_row(bench, "time / detection and vote", seconds / own_s, "ratio", name, len(chosen)))
    return rows


def _time(call) -> float:
    begun = time.perf_counter()
    call()
    return time.perf_counter() - begun


def _row(benchmark: str, metric: str, value: float, unit: str, peer: str = "", n: int = 1) -> dict:
    return {"benchmark": benchmark, "metric": metric, "value": float(value), "unit": unit, "peer": peer, "n": int(n)}
