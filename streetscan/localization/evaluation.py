"""Localized frames against true poses: errors, the thesis' metric, verdicts, covariances, and the floor no method can pass.

Source: Nagy (2020), 3.4 (N-121): "the average distance of the keypoints after the optimal point cloud alignment"; 3.3.3.2 (N-119): 20-40 %
of the objects of a scene are good landmarks.
"""

from collections.abc import Iterable, Sequence

import numpy as np
import pandas as pd
from scipy.spatial import cKDTree

from streetscan.classes import MOVABLE_LABELS, PHANTOM
from streetscan.errors import BadInput
from streetscan.frames import LidarFrame
from streetscan.geometry import angle_difference, apply, invert, rotation_angle, rpy_of_transform, transform
from streetscan.landmarks import Landmarks
from streetscan.localization.drive import FrameLocation
from streetscan.localization.ground import find_ground
from streetscan.localization.localizer import LocalizerSettings, level_of
from streetscan.localization.objects import find_objects
from streetscan.localization.reference import Reference
from streetscan.localization.refinement import Refiner
from streetscan.localization.voting import find_compatible
from streetscan.sweeps import deskew, velocity_between
from streetscan.voxels import VoxelGrid

# A pose within both is a success; the others are wrong (a metre is another lane).
SUCCESS_M, SUCCESS_DEG = 1.0, 5.0
# An object is a good landmark when a compatible one of the map stands where the true pose puts it, within this.
_GOOD_M = 0.5
# ASSUME: the yardstick is the corners of the boxes, whatever keypoints a method votes with: the thesis does not say, and distances of mass
# centres would be smaller at equal poses.
_N_MEASURED = 8
# Share of phantoms around a frame above which its scene counts as having many (thesis 3.4.1 does not say where it cuts).
# ASSUME: 3 % of the voxels that stand above the ground.
MANY_PHANTOMS = 0.03
_PHANTOM_RANGE_M = 30.0
COLUMNS = (
    "frame", "status", "found_m", "found_deg", "vote_m", "vote_deg", "start_m", "start_deg", "floor_m", "floor_deg", "keypoint_m",
    "vote_keypoint_m", "n_objects", "n_good", "n_landmarks", "n_movable", "nees", "phantom_share",
    "detection_s", "vote_s", "refinement_s", "source",
)  # fmt: skip


def evaluate_drive(
    rows: Sequence[FrameLocation],
    frames: Iterable[tuple[int, LidarFrame]],
    times_s: np.ndarray,
    truth: np.ndarray,
    reference: Reference,
    phantoms: "PhantomMap | None" = None,
    settings: LocalizerSettings | None = None,
    with_floor: bool = True,
) -> pd.DataFrame:
    """One row per localized frame with the columns of COLUMNS; what does not exist is NaN.

    Args:
        rows: of localize_frames.
        frames: of the drive, with their numbers, in order.
        times_s: (F,) stamps of all frames of the drive.
        truth: (F, 4, 4) their true T_map_lidar, NaN where unknown.
        reference: the map they were localized on.
        phantoms: of the same map; None where the truth of its points is not known.
        settings: how the objects of a frame are found and compared, for the thesis' metric.
        with_floor: refine the true poses too.
    Raises:
        BadInput: a row is of a frame the truth does not have.
    """
    settings = settings or LocalizerSettings()
    wanted = {row.index: row for row in rows}
    if wanted and max(wanted) >= len(truth):
        raise BadInput("the truth", f"{len(truth)} poses, while frame {max(wanted)} was localized", "give the truth of the same drive")
    refiner, landmarks = Refiner(reference), reference.landmarks
    is_movable = phantoms.are_movable(landmarks.moved(reference.origin)) if phantoms is not None else None
    table = []
    for index, frame in frames:
        if (row := wanted.get(index)) is None:
            continue
        T = truth[index]
        found = row.location
        errors = [*pose_error(found.T_map_lidar, T), *pose_error(found.T_vote, T)]
        start_m = float(np.hypot(*(row.start.xy_m[:2] - T[:2, 3])))
        start_deg = float(np.degrees(np.abs(angle_difference(row.start.yaw_rad, np.arctan2(T[1, 0], T[0, 0])))))
        points = freed_of_motion(frame, index, times_s, truth)
        floor = (np.nan, np.nan)
        if with_floor and np.isfinite(T).all() and len(points):
            near = points[(points[:, :2] ** 2).sum(axis=1) < refiner.range_m**2]
            floor = pose_error(_moved(refiner.refine(near, _moved(T, -reference.origin), is_gated=False).T_map_lidar, reference.origin), T)
        distances_m, n_objects, n_good = match_objects(points, (found.T_map_lidar, found.T_vote), T, reference, settings)
        share, n_movable, near = np.nan, np.nan, np.empty(0, np.int64)
        if np.isfinite(T).all():
            near = landmarks.near(T[:2, 3] - reference.origin[:2], settings.ground.range_m)
            if phantoms is not None:
                share, n_movable = phantoms.share_at(T[:2, 3]), int(is_movable[near].sum())
        table.append(
            (index, found.status, *errors, start_m, start_deg, *floor, *distances_m, n_objects, n_good, len(near), n_movable)
            + (normalized_error(found.T_map_lidar, T, found.covariance), share, *found.seconds, found.source)
        )
    return pd.DataFrame(table, columns=COLUMNS)


def pose_error(T: np.ndarray, T_true: np.ndarray) -> tuple[float, float]:
    """Distance in metres and angle in degrees between two poses; NaN when one is unknown."""
    if not (np.isfinite(T).all() and np.isfinite(T_true).all()):
        return np.nan, np.nan
    difference = invert(T_true) @ T
    return float(np.linalg.norm(difference[:3, 3])), float(np.degrees(rotation_angle(difference)))


def normalized_error(T: np.ndarray, T_true: np.ndarray, covariance: np.ndarray) -> float:
    """Normalized estimation error squared of x y z roll pitch yaw: 6 on average when the covariance is true; NaN when unknown."""
    if not (np.isfinite(T).all() and np.isfinite(T_true).all() and np.isfinite(covariance).all()):
        return np.nan
    error = np.concatenate([T[:3, 3] - T_true[:3, 3], angle_difference(rpy_of_transform(T), rpy_of_transform(T_true))])
    return float(error @ np.linalg.solve(covariance, error))


def freed_of_motion(frame: LidarFrame, index: int, times_s: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """(N, 3) finite points of a frame, freed of the true motion where its neighbours' true poses are known."""
    points = np.asarray(frame.points, np.float64)
    before, after = max(index - 1, 0), min(index + 1, len(truth) - 1)
    offsets = frame.time_offset_s
    if offsets is not None and offsets.any() and after > before and np.isfinite(truth[[before, after]]).all():
        points = deskew(points, offsets, *velocity_between(truth[before], truth[after], times_s[after] - times_s[before]))
    return points[np.isfinite(points).all(axis=1)]


def match_objects(
    points: np.ndarray,
    poses: Sequence[np.ndarray],
    T_true: np.ndarray,
    reference: Reference,
    settings: LocalizerSettings,
) -> tuple[list[float], int, int]:
    """The thesis' metric and how many objects could serve it.

    Args:
        points: (N, 3) finite, frame `lidar`, freed of motion.
        poses: found T_map_lidar (4, 4) each.
        T_true: (4, 4) the true one.
        reference, settings: the map, and how objects are found and compared.
    Returns:
        per pose the mean distance of the keypoints of the good objects from those of their landmarks, NaN for an unknown pose; the number
        of objects that may be some landmark in range and so take part in the vote; of good ones: where the true pose puts them stands
        such a landmark.
    """
    unknown = [np.nan] * len(poses)
    ground = find_ground(points, settings.ground)
    if not ground.has_plane or not np.isfinite(T_true).all():
        return unknown, 0, 0
    level = level_of(ground)
    observed = find_objects(ground, settings.objects, level).objects
    landmarks = reference.landmarks.select(reference.landmarks.near(T_true[:2, 3] - reference.origin[:2], settings.ground.range_m + 5))
    if len(observed) == 0 or len(landmarks) == 0:
        return unknown, 0, 0
    T = _moved(T_true, -reference.origin) @ invert(level)
    placed = observed.transformed(T)
    pairs = find_compatible(placed, landmarks.objects, landmarks.kinds, settings.compatibility)
    n_objects = len(np.unique(pairs[:, 0]))
    distances = np.linalg.norm(placed.centres[pairs[:, 0], :2] - landmarks.objects.centres[pairs[:, 1], :2], axis=1)
    order = np.argsort(distances, kind="stable")
    order = order[distances[order] < _GOOD_M]
    _, first = np.unique(pairs[order, 0], return_index=True)
    good = pairs[order[np.sort(first)]]
    if len(good) == 0:
        return unknown, n_objects, 0
    own, their = observed.select(good[:, 0]), landmarks.objects.select(good[:, 1])
    quarters = np.rint((placed.yaws_rad[good[:, 0]] - their.yaws_rad) / (np.pi / 2)).astype(np.int64)
    theirs = np.stack([np.roll(t, -q, axis=1) for t, q in zip(their.keypoints(_N_MEASURED), quarters, strict=True)])

    def distance_at(T: np.ndarray) -> float:
        if not np.isfinite(T).all():
            return np.nan
        moved = own.transformed(_moved(T, -reference.origin) @ invert(level))
        return float(np.linalg.norm(moved.keypoints(_N_MEASURED) - theirs, axis=-1).mean())

    return [distance_at(T) for T in poses], n_objects, len(good)


class PhantomMap:
    """What of the map was never there or has left: phantoms around a place, landmarks that are vehicles or people."""

    def __init__(self, grid: VoxelGrid, labels: np.ndarray, min_height_m: float = 0.3):
        """
        Args:
            grid: voxels of the map, with heights.
            labels: (V,) uint8 their true classes.
            min_height_m: lower voxels are ground.
        """
        standing = grid.height_m > min_height_m
        self._centres, labels = grid.centres[standing], labels[standing]
        self._xy, self._is_phantom, self._is_movable = self._centres[:, :2], labels == PHANTOM, np.isin(labels, MOVABLE_LABELS)

    def share_at(self, xy: np.ndarray) -> float:
        """Share of phantoms among the standing voxels within 30 m; NaN where nothing stands."""
        near = ((self._xy - xy) ** 2).sum(axis=1) < _PHANTOM_RANGE_M**2
        return float(self._is_phantom[near].mean()) if near.any() else np.nan

    def are_movable(self, landmarks: Landmarks) -> np.ndarray:
        """(M,) bool, landmarks in frame `map` most of whose voxels are phantoms, vehicles or people: not there on another day."""
        o, found = landmarks.objects, np.zeros(len(landmarks), bool)
        if len(self._xy) == 0:
            return found
        middles, origin = o.corners.mean(axis=(1, 2)), self._centres[0]
        tree = cKDTree(self._xy - origin[:2])
        for i, rows in enumerate(tree.query_ball_point(middles[:, :2] - origin[:2], np.hypot(*o.sizes_m[:, :2].T) / 2 + 0.1)):
            turn = transform(middles[i], (0, 0, o.yaws_rad[i]))
            inside = (np.abs(apply(invert(turn), self._centres[rows])) < o.sizes_m[i] / 2 + 0.1).all(axis=1)
            found[i] = inside.any() and self._is_movable[rows][inside].mean() > 0.5
        return found


def summarize(errors: pd.DataFrame) -> pd.DataFrame:
    """The figures of one drive, map and localizer: `metric, value, unit, n`.

    Rates are over all frames, means and medians over frames called `ok`, those of the vote alone over frames called `ok` for what their
    objects say; `n` says how many those are.
    """
    is_ok = errors["status"] == "ok"
    is_right = (errors["found_m"] < SUCCESS_M) & (errors["found_deg"] < SUCCESS_DEG)
    vote_right = (errors["vote_m"] < SUCCESS_M) & (errors["vote_deg"] < SUCCESS_DEG)
    n, ok = len(errors), errors[is_ok]
    rows = [
        ("success", _percent(is_right), "%", n),
        ("vote_success", _percent(vote_right), "%", n),
        ("ok", _percent(is_ok), "%", n),
        ("wrong_but_ok", _percent(is_ok & ~is_right), "%", n),
        ("n_wrong_but_ok", float((is_ok & ~is_right).sum()), "frames", n),
        ("by_points", _percent(errors["source"] == "points"), "%", n),
    ]
    for name, column, unit in (
        ("vote_translation", "vote_m", "m"),
        ("vote_rotation", "vote_deg", "deg"),
        ("translation", "found_m", "m"),
        ("rotation", "found_deg", "deg"),
        ("floor_translation", "floor_m", "m"),
        ("floor_rotation", "floor_deg", "deg"),
        ("keypoint_distance", "keypoint_m", "m"),
        ("vote_keypoint_distance", "vote_keypoint_m", "m"),
        ("nees", "nees", ""),
    ):
        chosen = ok[ok["source"] == "objects"] if name.startswith("vote") else ok
        values = chosen[column].dropna()
        rows += [(f"{name}_mean", _of(np.mean, values), unit, len(values)), (f"{name}_median", _of(np.median, values), unit, len(values))]
    good = errors[errors["n_objects"] > 0]
    rows.append(("good_landmarks", _of(np.mean, 100 * good["n_good"] / good["n_objects"]), "%", len(good)))
    rows.append(("landmarks", _of(np.mean, errors["n_landmarks"]), "", n))
    known = errors[(errors["n_landmarks"] > 0) & errors["n_movable"].notna()]
    rows.append(("movable_landmarks", _of(np.mean, 100 * known["n_movable"] / known["n_landmarks"]), "%", len(known)))
    seconds = errors["detection_s"] + errors["vote_s"]
    rows.append(("detection_vote_rate", 1 / max(_of(np.median, seconds), 1e-9), "fps", n))
    rows.append(("frame_rate", 1 / max(_of(np.median, seconds + errors["refinement_s"]), 1e-9), "fps", n))
    for status, count in errors["status"].value_counts().sort_index().items():
        right = int((is_right & (errors["status"] == status)).sum())
        rows += [(f"{status}_right", right, "frames", int(count)), (f"{status}_wrong", int(count) - right, "frames", int(count))]
    return pd.DataFrame(rows, columns=("metric", "value", "unit", "n"))


def _percent(flags: pd.Series) -> float:
    return float(100 * flags.mean()) if len(flags) else float("nan")


def _of(statistic, values) -> float:
    return float(statistic(values)) if len(values) else float("nan")


def _moved(T: np.ndarray, shift: np.ndarray) -> np.ndarray:
    moved = np.array(T, np.float64)
    moved[:3, 3] += shift
    return moved
