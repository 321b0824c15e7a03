"""One frame on the map: ground, objects, vote, refinement, verdict.

Source: Nagy (2020), 3.3 (N-103). The frame is made level with its own road, the start is tilted as the map's road is; what is left to
find is a shift and a turn about the road's normal (N-114).
"""

import time
from dataclasses import dataclass, field

import numpy as np

from streetscan.geometry import apply, invert, transform
from streetscan.localization.ground import FrameGround, GroundSettings, find_ground, has_finite
from streetscan.localization.keypoints import ObjectSet
from streetscan.localization.objects import ObjectSettings, find_objects
from streetscan.localization.recovery import HIGH_M, LOW_M, search_plane
from streetscan.localization.reference import Reference
from streetscan.localization.refinement import RefinementSettings, Refiner
from streetscan.localization.verdict import Evidence, VerdictSettings, is_agreed, judge
from streetscan.localization.voting import Compatibility, Peak, Window, count_pairs, find_compatible, refine_peaks, vote
from streetscan.registration.ndt import thin_points


@dataclass(frozen=True)
class LocalizerSettings:
    """How a frame is localized by voting.

    Attributes:
        n_keypoints: 1, 4, 8 or 16.
        window: searched around a start with a heading.
        wide_window: searched without one.
        ground, objects, compatibility, refinement, verdict: see their classes.
        is_refined: choose among the peaks of the vote, refine and judge by points too.
        is_recovered: search the window by points when the objects do not decide.
        n_peaks: peaks of the vote that are compared.
    """

    n_keypoints: int = 8
    window: Window = field(default_factory=Window)
    wide_window: Window = field(default_factory=lambda: Window(turn_deg=180.0, shift_m=60.0, turn_step_deg=0.5))
    ground: GroundSettings = field(default_factory=GroundSettings)
    objects: ObjectSettings = field(default_factory=ObjectSettings)
    compatibility: Compatibility = field(default_factory=Compatibility)
    refinement: RefinementSettings = field(default_factory=RefinementSettings)
    verdict: VerdictSettings = field(default_factory=VerdictSettings)
    is_refined: bool = True
    is_recovered: bool = True
    n_peaks: int = 24


@dataclass
class Start:
    """Where the search begins: position (2,) in `map`, metres, and heading, radians counter-clockwise from easting.

    NaN for a heading that is not known; `window` other than the settings' own.
    """

    xy_m: np.ndarray
    yaw_rad: float = np.nan
    window: Window | None = None


@dataclass
class Location:
    """What was found for a frame.

    Attributes:
        status: a key of `verdict.VERDICTS`.
        T_map_lidar: (4, 4) float64; NaN unless something was found, believed (`ok`) or not.
        T_vote: (4, 4) the pose of the vote alone.
        consensus, margin, n_objects, n_landmarks, n_inliers: of the vote.
        overlap_start, overlap: share of the frame on the map, at the start and at the pose.
        fit: how well the frame lies on the map's surfaces at the pose, 0 to 1.
        plane_margin: lead of the best place over the next in the search by points, as a share; NaN where objects decided.
        source: what the pose comes from: `objects` (the vote), `points` (the search without objects), or empty.
        is_refined: the pose was refined on points.
        covariance: (6, 6) x y z roll pitch yaw, m and rad, axes of `map`.
        seconds: (3,) of detection (what freed the frame of motion included, once `localize_drive` has added it), vote, refinement.
    """

    status: str
    T_map_lidar: np.ndarray = field(default_factory=lambda: np.full((4, 4), np.nan))
    T_vote: np.ndarray = field(default_factory=lambda: np.full((4, 4), np.nan))
    consensus: float = 0.0
    margin: float = np.nan
    n_objects: int = 0
    n_landmarks: int = 0
    n_inliers: int = 0
    overlap_start: float = np.nan
    overlap: float = np.nan
    fit: float = np.nan
    plane_margin: float = np.nan
    source: str = ""
    is_refined: bool = False
    covariance: np.ndarray = field(default_factory=lambda: np.full((6, 6), np.nan))
    seconds: np.ndarray = field(default_factory=lambda: np.zeros(3))


# Points of the overlap: above the ground by this, where the map's shape is, and thinned.
_ABOVE_M, _THIN_M = 0.3, 0.4
# Nearer points are the vehicle's own.
_OWN_M = 2.0
# ASSUME: the tilt of the road within the window differs by a degree from that at the start.
_TILT_SIGMA_RAD = np.radians(1.0)


class VotingLocalizer:
    """The thesis' localizer on one map."""

    def __init__(self, reference: Reference, settings: LocalizerSettings = LocalizerSettings()):
        self._reference, self._settings = reference, settings
        self._refiner = Refiner(reference, settings.refinement)

    def locate(self, points: np.ndarray, start: Start) -> Location:
        """The pose of a frame.

        Args:
            points: (N, 3) float, metres, frame `lidar`, freed of motion where it is known; NaN points are left out.
            start: in `map`.
        """
        s, reference = self._settings, self._reference
        clock = [time.perf_counter()]
        if not has_finite(points):
            return Location("no_points")
        xy = np.asarray(start.xy_m, np.float64)[:2] - reference.origin[:2]
        window = start.window or (s.window if np.isfinite(start.yaw_rad) else s.wide_window)
        if not reference.contains(xy, window.shift_m):
            return Location("off_map")
        ground = find_ground(points, s.ground)
        if not ground.has_plane:
            return Location("no_ground")
        T_level_lidar = level_of(ground)
        observed = find_objects(ground, s.objects, T_level_lidar)
        clock.append(time.perf_counter())
        T_start = place_start(reference, xy, 0.0 if np.isnan(start.yaw_rad) else start.yaw_rad, -ground.plane[2])
        peaks, n_objects, n_landmarks = self.search(observed.objects, T_start, window)
        clock.append(time.perf_counter())
        found = Location("too_few_objects", n_objects=n_objects, n_landmarks=n_landmarks)
        frame = _LevelFrame(points, ground, T_level_lidar)
        self._refiner.move_to(xy)
        if s.is_refined:
            found.overlap_start = self._refiner.coarse.overlap(frame.standing, T_start @ T_level_lidar)
        self._choose(found, frame, peaks, xy, T_start, window)
        for T in (found.T_map_lidar, found.T_vote):
            T[:3, 3] += reference.origin
        clock.append(time.perf_counter())
        found.seconds = np.diff(clock)
        return found

    def search(self, observed: ObjectSet, T_start: np.ndarray, window: Window) -> tuple[list[Peak], int, int]:
        """Peaks of the vote, best first, most pairs that can be true at once, and landmarks in range.

        Args:
            observed: blobs in the level frame.
            T_start: (4, 4) T_origin_start.
            window: what is searched.
        """
        s, landmarks = self._settings, self._reference.landmarks
        reach = s.ground.range_m + window.shift_m * np.sqrt(2)
        rows = landmarks.near(T_start[:2, 3], reach)
        near = landmarks.objects.select(rows).transformed(invert(T_start))
        pairs = find_compatible(observed, near, landmarks.kinds[rows], s.compatibility)
        peaks = vote(observed, near, pairs, s.n_keypoints, window, s.n_peaks)
        return refine_peaks(peaks, observed, near, pairs, s.n_keypoints), count_pairs(pairs), len(rows)

    def _choose(
        self, found: Location, frame: "_LevelFrame", peaks: list[Peak], xy: np.ndarray, T_start: np.ndarray, window: Window
    ) -> None:
        """Fill in the pose: of the objects where they decide, else of the search by points, else whichever lies better on the map."""
        s = self._settings
        poses = [T_start @ transform(p.shift_m, (0, 0, p.turn_rad)) @ frame.T_level_lidar for p in peaks]
        if peaks:
            found.T_vote = poses[0].copy()
            is_decided = is_agreed(self._weigh(found, peaks, 0), s.verdict)
            if is_decided or not s.is_refined:
                self._take_peak(found, frame, peaks, poses, 0, T_start)
        if not s.is_refined or found.status == "ok":
            return
        trial = self._search_plane(found, frame, xy, T_start, window) if s.is_recovered else None
        if peaks and not is_decided and (trial is None or trial.status != "ok"):
            # Where objects do not decide, points choose among what they propose.
            best = int(np.argmax(np.nan_to_num([self._refiner.coarse.overlap(frame.standing, T) for T in poses])))
            self._take_peak(found, frame, peaks, poses, best, T_start)
        if trial is not None and (trial.status == "ok" or not trial.fit <= found.fit):
            for name in ("status", "T_map_lidar", "overlap", "fit", "source", "is_refined", "covariance"):
                setattr(found, name, getattr(trial, name))

    def _weigh(self, found: Location, peaks: list[Peak], best: int) -> Evidence:
        """What a peak of the vote has for it, noted in what is found."""
        peak = peaks[best]
        found.consensus, found.n_inliers, found.margin = peak.consensus, len(peak.pairs), _margin(peaks, best)
        return Evidence(True, found.n_objects, found.n_inliers, found.consensus, found.margin)

    def _take_peak(
        self, found: Location, frame: "_LevelFrame", peaks: list[Peak], poses: list[np.ndarray], best: int, T_start: np.ndarray
    ) -> None:
        """Fill in the pose of a peak of the vote, refined, and whether it is believed."""
        evidence = self._weigh(found, peaks, best)
        self._finish(found, frame, poses[best], _vote_covariance(peaks[best], T_start), evidence, "objects")

    def _search_plane(self, found: Location, frame: "_LevelFrame", xy: np.ndarray, T_start: np.ndarray, window: Window) -> Location | None:
        """The best pose of the search by points, refined, and whether it is believed; None without one."""
        if self._refiner.plane_map is None:
            return None
        yaw, min_lead = float(np.arctan2(T_start[1, 0], T_start[0, 0])), self._settings.verdict.min_plane_margin
        places = search_plane(self._refiner.plane_map, frame.low_points, xy, yaw, window, n_peaks=2, least=1 - min_lead)
        if not places:
            return None
        shift, turn, share = places[0]
        found.plane_margin = 1 - (places[1][2] / share if len(places) > 1 else 0.0)
        T = place_start(self._reference, xy + shift, yaw + turn, frame.sensor_height_m) @ frame.T_level_lidar
        trial = Location(found.status)
        self._finish(trial, frame, T, np.full((6, 6), np.nan), Evidence(True, found.n_objects, plane_margin=found.plane_margin), "points")
        return trial

    def _finish(
        self, found: Location, frame: "_LevelFrame", T: np.ndarray, covariance: np.ndarray, evidence: Evidence, source: str
    ) -> None:
        """Refine a pose, relative to the reference's origin, and judge it."""
        found.source, found.covariance = source, covariance
        if self._settings.is_refined:
            refined = self._refiner.refine(frame.near_points(self._settings.refinement.range_m), T)
            if refined.is_accepted:
                T, found.is_refined, found.covariance = refined.T_map_lidar, True, refined.covariance
            evidence.fit = found.fit = refined.fit
            found.overlap = self._refiner.fine.overlap(frame.standing, T)
        evidence.is_on_map = self._reference.contains(T[:2, 3], 1.0)
        found.T_map_lidar = T.copy()
        found.status = judge(evidence, self._settings.verdict)


def _margin(peaks: list[Peak], best: int) -> float:
    """Lead of a peak over the best other one, as a share of its consensus."""
    others = max((p.consensus for i, p in enumerate(peaks) if i != best), default=0.0)
    return 1 - others / max(peaks[best].consensus, 1e-9)


class _LevelFrame:
    """A frame with what the steps after the vote need of it."""

    def __init__(self, points: np.ndarray, ground: FrameGround, T_level_lidar: np.ndarray):
        self._points, self._ground = points, ground
        self.T_level_lidar = T_level_lidar
        self.sensor_height_m = -float(ground.plane[2])
        # (N, 3) what stands above the ground, thinned, frame `lidar`.
        self.standing = thin_points(ground.points[ground.heights_m > _ABOVE_M], _THIN_M)

    @property
    def low_points(self) -> np.ndarray:
        """(N, 3) points of the heights the map is compared at from above, level."""
        heights = self._ground.heights_m
        return apply(self.T_level_lidar, self._ground.points[(heights > LOW_M) & (heights < HIGH_M)])

    def near_points(self, range_m: float) -> np.ndarray:
        """(N, 3) float64 finite points within a distance, frame `lidar`, without the vehicle's own."""
        # Comparisons with NaN are false.
        range_2 = self._points[:, 0] ** 2 + self._points[:, 1] ** 2
        near = (range_2 < range_m**2) & (range_2 > _OWN_M**2) & (np.abs(self._points[:, 2]) < range_m)
        return self._points[near].astype(np.float64)


def place_start(reference: Reference, xy: np.ndarray, yaw_rad: float, sensor_height_m: float) -> np.ndarray:
    """T_origin_start (4, 4): on the map's road at a position, tilted as the road is, at the height of the sensor above it.

    Args:
        reference: the map.
        xy: (>=2,) relative to its origin.
        yaw_rad: heading.
        sensor_height_m: of the sensor above the road.
    """
    plane = reference.plane_at(xy)
    normal = np.array([-plane[0], -plane[1], 1.0]) / np.sqrt(plane[0] ** 2 + plane[1] ** 2 + 1)
    T = np.eye(4)
    T[:3, :3] = _tilt(normal) @ transform(rpy_rad=(0, 0, yaw_rad))[:3, :3]
    T[:3, 3] = np.array([*xy, plane[2]]) + normal * sensor_height_m
    return T


def level_of(ground: FrameGround) -> np.ndarray:
    """T_level_lidar (4, 4): turns the normal of the frame's road upright."""
    a, b, _ = ground.plane
    T = np.eye(4)
    T[:3, :3] = _tilt(np.array([-a, -b, 1.0]) / np.sqrt(a * a + b * b + 1)).T
    return T


def _tilt(normal: np.ndarray) -> np.ndarray:
    """The shortest rotation (3, 3) of z onto a unit normal that points upwards."""
    x, y, z = normal
    return np.array(
        [
            (1 - x * x / (1 + z), -x * y / (1 + z), x),
            (-x * y / (1 + z), 1 - y * y / (1 + z), y),
            (-x, -y, z),
        ]
    )


def _vote_covariance(peak: Peak, T_origin_start: np.ndarray) -> np.ndarray:
    """Of a vote (6, 6) x y z roll pitch yaw, from the start's axes to the map's."""
    covariance = np.full((6, 6), np.nan)
    if np.isfinite(peak.covariance).all():
        covariance[:] = 0
        covariance[np.ix_([0, 1, 2, 5], [0, 1, 2, 5])] = peak.covariance
        yaw = np.arctan2(T_origin_start[1, 0], T_origin_start[0, 0])
        turn = np.eye(6)
        turn[:2, :2] = [(np.cos(yaw), -np.sin(yaw)), (np.sin(yaw), np.cos(yaw))]
        covariance = turn @ covariance @ turn.T
        covariance[3, 3] = covariance[4, 4] = _TILT_SIGMA_RAD**2
    return covariance
