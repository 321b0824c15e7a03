"""Camera and lidar calibrated at one keyframe: objects, Algorithm 1, ICP, control curves, projection, and a verdict.

Source: Nagy (2020), 4.3.2 to 4.3.4, 4.4.2, Fig. 4.10.

Two results. `projection` is for the raw frame: one 3x4 matrix from its points to the image, which holds what the vehicle moved between the
lidar's stamp and the image's. `T_camera_lidar` is rigid, of the sensors on the vehicle: the frame is freed of its motion first, and the
motion between the stamps is taken out.

Both sensors see the vehicle move, and what they see is one way (`ways`): it holds the turn about the vertical in ICP, so that Algorithm 1
searches some degrees (`motion_turn_deg`), and the full circle only where the lidar's motion is not known.

ASSUME: `projection` is fitted to points freed of motion and aligned by ICP, where motion and firing times are known (`final`: motion). The
thesis' own chain, T1 T* T_R on the raw frame's object centroids, is the stage `curves`, and is what is left without motion.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from streetscan.calibration.alignment import (
    Alignment,
    AlignmentSettings,
    ControlPoints,
    IcpSettings,
    PlaneTarget,
    Registration,
    find_places,
    is_apart,
    match_objects,
    prepare_target,
    refine_alignment,
    scale_of,
    vote_alignments,
)
from streetscan.calibration.control_curves import ControlCurves, fit_curves
from streetscan.calibration.edges import EdgeCheck, Shot, find_bend, make_shot, paired_gain, sum_bundles
from streetscan.calibration.linear_projection import LinearProjection, View, camera_of, fit_projection, linear_of, rigid_of
from streetscan.calibration.motion import LidarMotion
from streetscan.calibration.objects import CloudObjects, ObjectSettings, count_columns, find_level, find_objects
from streetscan.calibration.quality import SURE, QualitySettings, hausdorff_distance, judge_gain, plane_distances
from streetscan.calibration.ways import MIN_WAY_M, LidarWay, Way, make_way
from streetscan.errors import BadInput
from streetscan.geometry import apply, check_rotation, invert, rotation_angle, steps_between, transform, transform_of_rotation
from streetscan.registration.ndt import thin_points

# The stages whose projections are kept, in their order.
STAGES = ("objects_raw", "objects", "place", "icp", "curves", "motion", "edges")
FINALS = ("curves", "motion", "edges")
# Camera axes to forward, left, up.
_UPRIGHT = transform_of_rotation(np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]))
# Points of the evidence at most, and of the fit of the raw projection.
_N_EVIDENCE, _N_FITTED = 2000, 3000


@dataclass(frozen=True)
class CalibrationSettings:
    """How a keyframe is calibrated.

    Attributes:
        objects, alignment, quality: see their classes.
        motion_turn_deg: the turn that the way tells is searched this far to either side; 180 leaves the way out, as the thesis does.
        n_bins: bins of a segment of the control curves.
        range_m: lidar points farther away do not take part in ICP.
        judged_m: matched objects are judged by their points within this distance, if they have any; farther depths of images are worse.
        final: stage that gives `projection`: `edges`, `motion`, or `curves` as in the thesis; without motion it is `curves` anyway.
        max_bend_deg: largest error of the way of the camera that image edges may correct, in the stage `edges`.
        with_raw: align without removing moving things too, for the first row of Table 4.2.
        with_parked: let points of things that could move take part in ICP. ASSUME: what lies in both clouds at the same place stood still;
            a street full of parked cars has little else, and what moves comes out of structure from motion at another place.
    """

    objects: ObjectSettings = field(default_factory=ObjectSettings)
    alignment: AlignmentSettings = field(default_factory=AlignmentSettings)
    quality: QualitySettings = field(default_factory=QualitySettings)
    motion_turn_deg: float = 15.0
    n_bins: int = 10
    range_m: float = 40.0
    judged_m: float = 30.0
    final: str = "edges"
    max_bend_deg: float = 2.5
    with_raw: bool = True
    with_parked: bool = True

    def __post_init__(self):
        if self.final not in FINALS:
            raise BadInput("calibrate_keyframe.settings.final", f"'{self.final}'", f"choose one of {', '.join(FINALS)}")


class CalibrationFailed(Exception):
    """A keyframe cannot be calibrated; `status` is a key of `quality.STATUSES`, the message says what was found."""

    def __init__(self, status: str, reason: str):
        super().__init__(reason)
        self.status = status


@dataclass
class KeyframeClouds:
    """What a keyframe is calibrated from.

    Attributes:
        points_lidar: (N, 3) raw points, metres, frame `lidar`.
        time_offset_s: (N,) firing minus stamp, or None.
        is_static: (N,) bool, False for points of moving things.
        points_sfm: (M, 3) dense points, metres, frame `sfm`.
        is_dynamic_sfm: (M,) bool, True for points of moving things.
        cameras_sfm: (n, 3) where the images were taken, the reference first, then all of them in the order of time.
        view: the reference image.
        image: (H, W, 3) uint8 RGB, rectified.
        motion: of the lidar, or None.
        T_initial: (4, 4) T_camera_lidar in force, or None.
        scale_std: deviation of the dense points' scale from 1, as the lidar's motion tells it; 0 adds nothing to that of the settings.
        image_times_ns: of `cameras_sfm` from the second on.
        way: of the lidar while the images were taken, or None.
        shots: lidar frames of the keyframe, each with the image nearest in time; empty where the lidar's motion is not known.
    """

    points_lidar: np.ndarray
    time_offset_s: np.ndarray | None
    is_static: np.ndarray
    points_sfm: np.ndarray
    is_dynamic_sfm: np.ndarray
    cameras_sfm: np.ndarray
    view: View
    image: np.ndarray
    motion: LidarMotion | None = None
    T_initial: np.ndarray | None = None
    scale_std: float = 0.0
    image_times_ns: tuple[int, ...] = ()
    way: LidarWay | None = None
    shots: tuple[Shot, ...] = ()

    @property
    def T_stamp_in_force(self) -> np.ndarray:
        """(4, 4) what `T_initial`, which must be given, makes of points freed of motion: from the lidar at its stamp to the image's."""
        return self.T_initial if self.motion is None else self.T_initial @ invert(self.motion.at([self.motion.image_s])[0])


@dataclass
class KeyframeCalibration:
    """What became of a keyframe; what its status did not let be found is None or NaN.

    Attributes:
        status: a key of `quality.STATUSES`, or of the keyframe's reconstruction.
        reason: what was found, with numbers.
        projection: (3, 4) of the raw lidar frame; given for refused ones too, where there is one.
        T_camera_lidar: (4, 4) rigid, of the sensors on the vehicle, the image's stamp taken as it is.
        T_camera_stamp: (4, 4) the same before the motion between the stamps was taken out.
        covariance: (6, 6) of T_camera_stamp as far as clouds and way tell: turn (rotation vector, rad) and shift (m) in the camera's axes.
        stages: name of a stage to its projection (3, 4).
        residuals_px: (N, 2) of the points the final projection was fitted to.
        figures: numbers by name, for the table.
        evidence: (P, 9) points of matched objects freed of motion (frame `lidar`), the camera's nearest points and their normals (frame
            of the camera at the reference image).
        bend_rad: error of the way of the camera, to its right, that its cloud was corrected by: of ICP and of edges.
        bend_response: (6,) turn (rotation vector) and shift (m) of T_camera_stamp in the camera's axes for each radian of such an error.
        lidar, sfm: objects of the two clouds.
        raw: the same with all that moves left in, and the T_sfm_lidar (4, 4) voted with them; None where there is nothing to compare.
        voted: Algorithm 1's peaks, most votes first.
        alignment: the place that was calibrated.
        T_icp: (4, 4) T_sfm_lidar of ICP on the raw frame, from which the curves go on.
        control, curves: of the stages.
        seconds: wall time of each stage.
    """

    status: str = "ok"
    reason: str = ""
    projection: np.ndarray | None = None
    T_camera_lidar: np.ndarray | None = None
    T_camera_stamp: np.ndarray | None = None
    covariance: np.ndarray = field(default_factory=lambda: np.full((6, 6), np.nan))
    stages: dict[str, np.ndarray] = field(default_factory=dict)
    residuals_px: np.ndarray = field(default_factory=lambda: np.empty((0, 2)))
    figures: dict[str, float] = field(default_factory=dict)
    evidence: np.ndarray = field(default_factory=lambda: np.empty((0, 9)))
    bend_rad: float = 0.0
    bend_response: np.ndarray = field(default_factory=lambda: np.zeros(6))
    lidar: CloudObjects | None = None
    sfm: CloudObjects | None = None
    raw: tuple[CloudObjects, CloudObjects, np.ndarray] | None = None
    voted: Sequence[Alignment] = ()
    alignment: Alignment | None = None
    T_icp: np.ndarray | None = None
    control: ControlPoints | None = None
    curves: ControlCurves | None = None
    seconds: dict[str, float] = field(default_factory=dict)


def calibrate_keyframe(clouds: KeyframeClouds, settings: CalibrationSettings = CalibrationSettings()) -> KeyframeCalibration:
    """The calibration at one keyframe; its status says whether to believe it.

    The places where the clouds lie on each other best are all calibrated and judged.

    Raises:
        BadInput: the calibration in force is no transform.
    """
    if clouds.T_initial is not None:
        if not np.isfinite(clouds.T_initial).all():
            raise BadInput("T_camera_lidar in force", "a value that is not finite", "give a rigid transform, or none")
        check_rotation(clouds.T_initial[:3, :3], "T_camera_lidar in force")
    made = KeyframeCalibration()
    clock = _Clock(made.seconds)
    settings = replace(settings, alignment=replace(settings.alignment, icp=_know_cloud(settings.alignment.icp, clouds)))
    try:
        scene = _prepare(clouds, settings, made, clock)
        made.voted = vote_alignments(made.lidar, made.sfm, scene.alignment)
        if made.voted:
            made.stages["objects"] = linear_of(clouds.view.T_camera_sfm @ made.voted[0].T_sfm_lidar, clouds.view.K)
        is_one_way = _bearings(clouds, settings) is not None
        places = find_places(made.voted, made.lidar, made.sfm, scene.target, clouds.view, scene.alignment, is_one_way)
        clock.stop("alignment")
        if not places:
            raise CalibrationFailed("no_match", f"the clouds overlap nowhere by {100 * scene.alignment.min_overlap:.0f} %")
    except CalibrationFailed as failure:
        made.status, made.reason = failure.status, str(failure)
        return made
    tried = [_calibrate_at(place, clouds, settings, scene, made, clock) for place in places]
    chosen = choose_place(tried, lambda a, b: _outdoes(clouds, settings, scene, a, b))
    if clouds.T_initial is not None and chosen.projection is not None:
        _compare_in_force(clouds, settings, scene, chosen)
    clock.stop("quality")
    return chosen


def _know_cloud(icp: IcpSettings, c: KeyframeClouds) -> IcpSettings:
    """The deviations of the camera's cloud: of its scale as the lidar's motion leaves it, and of a way as long as the camera's."""
    way_m = max(MIN_WAY_M, float(np.linalg.norm(c.cameras_sfm[-1] - c.cameras_sfm[1])))
    return replace(icp, scale_std=float(np.hypot(icp.scale_std, c.scale_std)), bend_std_deg=icp.bend_std_deg / way_m)


def choose_place(
    tried: Sequence[KeyframeCalibration], outdoes: Callable[[KeyframeCalibration, KeyframeCalibration], bool]
) -> KeyframeCalibration:
    """Of the places that pass the one whose edges lie nearest, refused if another is as good; where none passes, the first place's refusal.

    What clouds leave open where a place is right they may not where it is wrong, since less of them is compared there; so a place that is
    `uncertain` can be as good, too.

    Args:
        tried: the calibration at each place, the most overlap first.
        outdoes: whether the first calibration explains clouds and image clearly better than the second.
    """
    passing = [m for m in tried if m.status == "ok"]
    best = min(passing, key=lambda m: m.figures["edge_px"]) if passing else tried[0]
    others = [m for m in tried if passing and m.status in ("ok", "uncertain")]
    rivals = [m for m in others if is_apart(m.T_camera_stamp, best.T_camera_stamp, *_RIVAL) and not outdoes(best, m)]
    best.figures |= {"n_places": len(tried), "n_rivals": len(rivals)}
    if rivals:
        change = rigid_of(invert(best.T_camera_stamp) @ rivals[0].T_camera_stamp)
        away = f"{np.linalg.norm(change[:3, 3]):.1f} m and {np.degrees(rotation_angle(change)):.1f} degrees away"
        best.status, best.reason = "ambiguous", f"{away} the clouds and edges fit as well"
    return best


# Of two calibrations farther apart than this (m, rad) one is wrong.
_RIVAL = 0.3, np.radians(1.0)


def _outdoes(c: KeyframeClouds, s: CalibrationSettings, scene: "_Scene", a: KeyframeCalibration, b: KeyframeCalibration) -> bool:
    """Whether clouds or edges speak for calibration a over b by more than their noise, and neither against it."""
    is_straight = a.figures.get("bend_deg", 0.0) == b.figures.get("bend_deg", 0.0) == 0
    targets = [scene.target.straightened(m.bend_rad) for m in (b, a)]
    places = (b.T_camera_stamp, a.T_camera_stamp)
    told = _compare(c, s, scene, 1 / a.figures["scale"], places, targets, None if is_straight else True, np.logical_and)
    says = [(told["edge_gain_px"], SURE * told["edge_gain_std_px"])]
    # A cloud that edges have corrected has no say.
    if is_straight:
        says.append((told["gain_m"], SURE * told["gain_std_m"]))
    return any(gain > noise for gain, noise in says) and all(gain > -noise for gain, noise in says)


@dataclass
class _Scene:
    """What the places of a keyframe are calibrated with.

    Attributes:
        alignment: settings, the window as narrow as the motion allows.
        points: (N, 3) of the lidar, freed of motion where it is known.
        takes_part: (N,) bool, the points for ICP.
        target: the camera's cloud.
        raw_check: the image's edges against those of the raw points.
        check: edges of the keyframe's shots, freed of motion; `raw_check` where the motion is not known.
    """

    alignment: AlignmentSettings
    points: np.ndarray
    takes_part: np.ndarray
    target: PlaneTarget
    raw_check: EdgeCheck
    check: EdgeCheck


def _prepare(c: KeyframeClouds, s: CalibrationSettings, made: KeyframeCalibration, clock: "_Clock") -> _Scene:
    """The objects of both clouds, in `made`, and all else that is the same for every place."""
    a = _narrow(c, s)
    if s.with_raw and (c.is_dynamic_sfm.any() or not c.is_static.all()):
        _align_raw(c, s, a, made)
        clock.stop("raw")
    made.lidar, made.sfm = prepare_objects(c.points_lidar[c.is_static], c.points_sfm[~c.is_dynamic_sfm], c, s)
    made.figures |= {f"n_{name}_objects": len(cloud) for name, cloud in (("lidar", made.lidar), ("sfm", made.sfm))}
    made.figures |= {f"n_{name}_voxels": len(cloud.voxels) for name, cloud in (("lidar", made.lidar), ("sfm", made.sfm))}
    made.figures["n_lidar_columns"] = count_columns(made.lidar.objects)
    is_moving = c.motion is not None and c.time_offset_s is not None
    points = c.motion.deskew(c.points_lidar, c.time_offset_s) if is_moving else c.points_lidar
    near = np.linalg.norm(points, axis=1) < s.range_m
    target = prepare_target(c.points_sfm[~c.is_dynamic_sfm | s.with_parked], c.cameras_sfm, c.view.K[0, 0], a.icp, _way_of(c, s))
    raw_check = check = EdgeCheck([make_shot(c.image, c.points_lidar, np.eye(4))], np.eye(4), s.quality)
    if is_moving:
        T_stamp_image = c.motion.at([c.motion.image_s])[0]
        check = EdgeCheck(c.shots or [make_shot(c.image, points, invert(T_stamp_image))], T_stamp_image, s.quality)
    clock.stop("objects")
    return _Scene(a, points, (c.is_static | s.with_parked) & near, target, raw_check, check)


def _calibrate_at(
    place: Alignment, c: KeyframeClouds, s: CalibrationSettings, scene: _Scene, found: KeyframeCalibration, clock: "_Clock"
) -> KeyframeCalibration:
    """The calibration that begins at a place; `found` has the objects."""
    made = replace(found, alignment=place, figures=dict(found.figures), stages=dict(found.stages))
    try:
        _register(c, s, scene, made, clock)
        _judge(made, s.quality)
    except CalibrationFailed as failure:
        made.status, made.reason = failure.status, str(failure)
    return made


def _register(c: KeyframeClouds, s: CalibrationSettings, scene: _Scene, made: KeyframeCalibration, clock: "_Clock") -> None:
    """ICP, control curves and projections from the place of `made` on."""
    view, target, icp = c.view, scene.target, s.alignment.icp
    made.stages["place"] = linear_of(view.T_camera_sfm @ made.alignment.T_sfm_lidar, view.K)
    raw = refine_alignment(c.points_lidar[scene.takes_part], target, made.alignment.T_sfm_lidar, icp)
    made.T_icp, made.stages["icp"] = raw.T_sfm_lidar, linear_of(view.T_camera_sfm @ raw.T_sfm_lidar, view.K)
    clock.stop("icp")
    made.control = match_objects(made.lidar, target, raw.T_sfm_lidar)
    final = _fit_curves(c, s, made, raw.T_sfm_lidar)
    clock.stop("curves")
    registered, near = raw, scene.points[scene.takes_part]
    if scene.points is not c.points_lidar:
        registered = refine_alignment(near, target, raw.T_sfm_lidar, icp)
        moving = _fit_raw(c, scene.points, registered.T_sfm_lidar)
        if moving is not None:
            made.stages["motion"] = moving.projection
            final = moving if s.final != "curves" or final is None else final
        if s.final == "edges" and registered.is_converged:
            registered = _straighten(c, s, near, registered, scene, made)
            moving = _fit_raw(c, scene.points, registered.T_sfm_lidar)
            if moving is not None:
                made.stages["edges"], final = moving.projection, moving
    made.bend_rad, target = registered.bend_rad, target.straightened(registered.bend_rad)
    # What the clouds say of the scale when nothing else does: a wrong one that is held looks right, metres away.
    free = refine_alignment(near, target, registered.T_sfm_lidar, replace(icp, scale_std=icp.max_scale))
    made.figures["free_scale"] = 1 / scale_of(free.T_sfm_lidar)
    moved = camera_of(view, free.T_sfm_lidar)[:3, 3] - camera_of(view, registered.T_sfm_lidar)[:3, 3]
    made.figures["free_shift_m"] = float(np.linalg.norm(moved))
    made.figures["bend_icp_deg"] = float(np.degrees(registered.bend_rad)) - made.figures.get("bend_deg", 0.0)
    made.T_camera_stamp, made.covariance = camera_of(view, registered.T_sfm_lidar), _in_camera(registered.covariance, view)
    made.T_camera_lidar = made.T_camera_stamp if c.motion is None else c.motion.to_image(made.T_camera_stamp)
    bent = camera_of(view, registered.bent(_SMALL_RAD))
    made.bend_response = steps_between(made.T_camera_stamp, bent[None])[0] / _SMALL_RAD
    made.figures |= {"icp_rmse_m": registered.rmse_m, "n_icp": registered.n_pairs, "scale": 1 / scale_of(registered.T_sfm_lidar)}
    made.figures["n_matched"] = len(made.control.objects)
    if target.way is not None:
        made.figures["way_off_deg"] = float(np.degrees(target.way.turn_off(registered.T_sfm_lidar)))
    clock.stop("motion")
    if not registered.is_converged:
        raise CalibrationFailed("not_converged", f"{registered.n_pairs} correspondences, scale {scale_of(registered.T_sfm_lidar):.3f}")
    if final is None:
        raise CalibrationFailed("no_projection", f"{len(made.control.objects)} objects are matched")
    made.projection, made.residuals_px = final.projection, final.residuals_px
    _measure(c, s, made, registered.T_sfm_lidar, scene, target)
    clock.stop("quality")


def _straighten(
    c: KeyframeClouds, s: CalibrationSettings, near: np.ndarray, registered: Registration, scene: _Scene, made: KeyframeCalibration
) -> Registration:
    """The registration after the way of the camera is corrected by image edges, too; its `bend_rad` is the whole correction.

    Beyond the thesis. Structure from motion hardly tells a turn of all images from a way to the side; the street then comes out turned
    against the images, and registration of clouds sees little of it. In the image itself the sides of posts and houses do.

    A correction is made only where edges tell it from none; a street whose edges are everywhere has many places where some do.
    """
    found = find_bend(
        scene.check,
        lambda e: linear_of(c.view.T_camera_sfm @ registered.bent(e), c.view.K),
        np.radians(s.max_bend_deg),
        np.radians(_BEND_STEP_DEG),
    )
    made.figures |= {"bend_deg": 0.0, "bend_found_deg": float(np.degrees(found.rad)), "bend_std_deg": float(np.degrees(found.std_rad))}
    if abs(found.rad) <= SURE * found.std_rad:
        return registered
    start, icp = registered.bend_rad + found.rad, replace(s.alignment.icp, bend_std_deg=float(np.degrees(found.std_rad)))
    again = refine_alignment(near, scene.target.straightened(start), registered.bent(found.rad), icp)
    # What edges tell must hold for those that took no part, too.
    was, now = (scene.check.distance_px(linear_of(c.view.T_camera_sfm @ r.T_sfm_lidar, c.view.K), True) for r in (registered, again))
    if not (again.is_converged and now < was):
        return registered
    made.figures["bend_deg"] = float(np.degrees(found.rad + again.bend_rad))
    return replace(again, bend_rad=start + again.bend_rad)


# An error of the way of the camera by which others are seen to change.
_SMALL_RAD = 1e-4
# Step of the search for an error of the way of the camera.
_BEND_STEP_DEG = 0.05


def _in_camera(covariance: np.ndarray, view: View) -> np.ndarray:
    """A registration's covariance in the axes of the camera. ASSUME: the frame `sfm` begins at the camera, but for T1's small error."""
    turn = np.kron(np.eye(2), view.T_camera_sfm[:3, :3])
    return turn @ covariance @ turn.T


class _Clock:
    """Wall time by stage; a stage that comes again adds to it."""

    def __init__(self, seconds: dict[str, float]):
        self._seconds, self._last = seconds, time.perf_counter()

    def stop(self, stage: str) -> None:
        now = time.perf_counter()
        self._seconds[stage], self._last = self._seconds.get(stage, 0.0) + now - self._last, now


def prepare_objects(
    points_lidar: np.ndarray, points_sfm: np.ndarray, c: KeyframeClouds, s: CalibrationSettings
) -> tuple[CloudObjects, CloudObjects]:
    """Objects of both clouds, each level, x being the way the vehicle goes where it is known.

    Raises:
        CalibrationFailed: a cloud has no ground or no object. One of images without any may still be found by its points.
    """
    found, bearings = [], _bearings(c, s) or (None, None)
    clouds = ("lidar", points_lidar, np.eye(4)), ("camera's", points_sfm, _UPRIGHT @ c.view.T_camera_sfm)
    for (name, cloud, T_guess), bearing in zip(clouds, bearings, strict=True):
        n_near = int((np.linalg.norm(apply(T_guess, cloud)[:, :2], axis=1) < s.objects.range_m).sum())
        if n_near == 0:
            raise CalibrationFailed("too_few_objects", f"the {name} cloud has no point within {s.objects.range_m:g} m")
        T = find_level(cloud, T_guess, s.objects)
        if not np.isfinite(T).all():
            raise CalibrationFailed("no_ground", f"the {name} cloud has {n_near} points within {s.objects.range_m:g} m, none of them flat")
        # x of the level frame is the way both sensors go, so that what is left to turn is small.
        T = transform(rpy_rad=(0, 0, -_heading(T, bearing))) @ T if bearing is not None else T
        found.append(find_objects(cloud, T, s.objects))
        if len(found[-1]) == 0 and (name == "lidar" or not s.alignment.is_searched):
            raise CalibrationFailed("too_few_objects", f"no object in the {name} cloud within {s.objects.range_m:g} m")
    return tuple(found)


def _way_of(c: KeyframeClouds, s: CalibrationSettings) -> Way | None:
    """The way of both sensors; None where it is not known or not to be used."""
    icp = s.alignment.icp
    return make_way(c.way, c.cameras_sfm, icp.way_std_m, icp.way_std_s) if s.motion_turn_deg < 180 else None


def _bearings(c: KeyframeClouds, s: CalibrationSettings) -> tuple[np.ndarray, np.ndarray] | None:
    """Directions (3,) the vehicle goes in, frames `lidar` and `sfm`; None where they are not known or not to be used."""
    way = _way_of(c, s)
    if way is not None:
        return way.lidar.of(np.zeros(3)), way.bearing_sfm
    if c.motion is None or s.motion_turn_deg >= 180:
        return None
    # Frames are missing during the keyframe, not beside its lidar frame: that is enough to search in.
    before, after = c.motion.at([-0.1, 0.1])
    bearings = after[:3, 3] - before[:3, 3], c.cameras_sfm[-1] - c.cameras_sfm[1]
    return bearings if min(np.linalg.norm(b) for b in bearings) >= MIN_WAY_M else None


def _narrow(c: KeyframeClouds, s: CalibrationSettings) -> AlignmentSettings:
    """The alignment's settings, its window as narrow as the motion allows."""
    if _bearings(c, s) is None:
        return s.alignment
    window = replace(s.alignment.window, turn_deg=min(s.alignment.window.turn_deg, s.motion_turn_deg))
    return replace(s.alignment, window=window)


def _heading(T_level_cloud: np.ndarray, way: np.ndarray) -> float:
    """Azimuth in a level frame of a direction in the cloud's own frame."""
    x, y, _ = T_level_cloud[:3, :3] @ way
    return float(np.arctan2(y, x))


def _align_raw(c: KeyframeClouds, s: CalibrationSettings, a: AlignmentSettings, made: KeyframeCalibration) -> None:
    """The vote on the clouds with all that moves in them; a stage for the tables alone, and none where it finds nothing."""
    try:
        lidar, sfm = prepare_objects(c.points_lidar, c.points_sfm, c, s)
    except CalibrationFailed:
        return
    voted = vote_alignments(lidar, sfm, a)
    if voted:
        made.raw = lidar, sfm, voted[0].T_sfm_lidar
        made.stages["objects_raw"] = linear_of(c.view.T_camera_sfm @ voted[0].T_sfm_lidar, c.view.K)


def _fit_curves(c: KeyframeClouds, s: CalibrationSettings, made: KeyframeCalibration, T_sfm_lidar: np.ndarray) -> LinearProjection | None:
    """The thesis' chain: T1 T* T_R on the centroids of matched objects, then one projection."""
    control = made.control
    up = invert(made.sfm.T_level_cloud)[:3, 2]
    made.curves = fit_curves(control.lidar, control.sfm, control.weights, T_sfm_lidar[:3, 3], up, s.n_bins)
    if made.curves is None:
        return None
    own = apply(invert(T_sfm_lidar), control.lidar)
    pixels = c.view.project(made.curves.move(control.lidar))
    seen = c.view.contains(pixels)
    fitted = fit_projection(own[seen], pixels[seen], c.view.K)
    if fitted is not None:
        made.stages["curves"] = fitted.projection
    return fitted


def _fit_raw(c: KeyframeClouds, deskewed: np.ndarray, T_sfm_lidar: np.ndarray) -> LinearProjection | None:
    """The linear projection of the raw frame that comes closest to the pixels of its points freed of motion."""
    pixels = c.view.project(apply(T_sfm_lidar, deskewed))
    chosen = np.flatnonzero(c.view.contains(pixels) & c.is_static)
    chosen = chosen[:: max(1, len(chosen) // _N_FITTED)]
    return fit_projection(c.points_lidar[chosen], pixels[chosen], c.view.K)


def _measure(
    c: KeyframeClouds, s: CalibrationSettings, made: KeyframeCalibration, T_sfm_lidar: np.ndarray, scene: _Scene, straightened: PlaneTarget
) -> None:
    """Distances of the registered clouds and of edges, and the evidence other calibrations are compared on.

    `straightened` is the camera's cloud as edges have corrected it: what the registration lies on.
    """
    points, target = scene.points, scene.target
    lidar, numbers = made.lidar, made.control.objects
    members = np.concatenate([lidar.points_of(m) for m in numbers]) if len(numbers) else np.empty((0, 3))
    near = np.hypot(members[:, 0], members[:, 1]) < s.judged_m
    raw = apply(invert(lidar.T_level_cloud), members[near] if near.any() else members)
    own = _freed(c, raw)
    moved = apply(T_sfm_lidar, own)
    distances = plane_distances(moved, straightened, s.alignment.icp.reaches_m[1])
    made.figures["median_distance_m"] = float(np.nanmedian(distances)) if np.isfinite(distances).any() else float("nan")
    seen = c.view.sees(apply(T_sfm_lidar, points)) & c.is_static & (np.linalg.norm(points, axis=1) < s.objects.range_m)
    sigma_x, sigma_y = _pixel_sigmas(apply(made.T_camera_stamp, points[seen]), c.view.K, made.covariance)
    made.figures |= {"sigma_x_px": float(sigma_x), "sigma_y_px": float(sigma_y)}
    # Beyond the range of objects the camera's cloud has points, sky among them, that no lidar sees.
    is_near = np.linalg.norm(target.points - T_sfm_lidar[:3, 3], axis=1) < s.objects.range_m
    made.figures["hausdorff_m"] = hausdorff_distance(apply(T_sfm_lidar, points[seen]), target.points[is_near])
    found = np.isfinite(distances)
    rows = np.flatnonzero(found)[:: max(1, found.sum() // _N_EVIDENCE)]
    nearest = straightened.tree.query(moved[rows])[1]
    to_camera = c.view.T_camera_sfm
    # In the lidar's metres, as T_camera_stamp is.
    planes = apply(to_camera, straightened.points[nearest]) / scale_of(T_sfm_lidar)
    made.evidence = np.concatenate([own[rows], planes, straightened.normals[nearest] @ to_camera[:3, :3].T], axis=1)
    # The thesis' chain is of the raw frame alone; all else is judged on all shots.
    is_of_curves = s.final == "curves" or scene.check is scene.raw_check
    judged = made.projection if is_of_curves else linear_of(made.T_camera_stamp, c.view.K)
    # Edges that corrected the way of the camera cannot judge it.
    judges = True if made.figures.get("bend_deg", 0.0) != 0 else None
    check = scene.raw_check if is_of_curves else scene.check
    made.figures |= {
        "n_shots": check.n_shots,
        "edge_px": check.distance_px(judged),
        "edge_margin_px": check.margin_px(judged, c.view.K, judges),
    }


def _compare_in_force(c: KeyframeClouds, s: CalibrationSettings, scene: _Scene, made: KeyframeCalibration) -> None:
    """The last gate, of the place that was chosen: the calibration in force stays unless the new one is better by more than noise."""
    before = c.T_stamp_in_force
    check, cloud = scene.raw_check if s.final == "curves" else scene.check, scene.target.straightened(made.bend_rad)
    made.figures["edge_before_px"] = check.distance_px(linear_of(before, c.view.K))
    made.figures |= _compare(c, s, scene, 1 / made.figures["scale"], (before, made.T_camera_stamp), (cloud, cloud))
    f = made.figures
    if made.status == "ok" and not all(judge_gain(f, s.quality).values()):
        made.status = "not_better"
        made.reason = (
            f"{f['distance_after_m']:.3f} m from the clouds' planes, the one in force {f['distance_before_m']:.3f} m, asked for a gain of "
            f"{s.quality.min_gain_m:g} m; edges gain {f['edge_gain_px']:.2f} +- {f['edge_gain_std_px']:.2f} px"
        )


def _compare(
    c: KeyframeClouds, s: CalibrationSettings, scene: _Scene, scale: float, places: Sequence[np.ndarray], targets: Sequence[PlaneTarget],
    is_kept: bool | None = True, seen_by: np.ufunc = np.logical_or,
) -> dict[str, float]:  # fmt: skip
    """What speaks for one transform (4, 4) into the camera over another: distances of the clouds, and of edges (`is_kept` of EdgeCheck).

    Each is measured on a cloud of its own (`targets`): that of the camera as its registration has corrected it, or, of a calibration in
    force, as the new one has. The error is the cloud's, which a right calibration in force must not be blamed for.

    Neither may choose what it is measured on: the points are all static ones that one of the two has in view, the planes are sought anew
    under each, and a point without any counts as far as the reach. Of two places that both explain what they see, the one farther ahead
    sees more; between them it is what both have in view (`seen_by`). Edges are those both have in view; cameras that look different ways
    have none in common, and then those either has. Deviations are over bundles of directions, as neighbours err alike.
    """
    points, reach = scene.points, s.alignment.icp.reaches_m[1]
    near = thin_points(points[c.is_static & (np.linalg.norm(points, axis=1) < s.objects.range_m)], 0.1)
    both = [invert(c.view.T_camera_sfm) @ np.diag([scale, scale, scale, 1.0]) @ T for T in places]
    near = near[seen_by(*(c.view.sees(apply(T, near)) for T in both))]
    distances = np.stack(
        [np.fmin(plane_distances(apply(T, near), target, reach), reach) for T, target in zip(both, targets, strict=True)], axis=1
    )
    sums, counts = sum_bundles(near, distances)
    gain, std = paired_gain(sums, counts)
    projections = [linear_of(T, c.view.K) for T in places]
    edges = scene.check.sum_bundles(projections, is_kept)
    n_common = int(edges[1].sum())
    if n_common == 0 and seen_by is np.logical_or:
        edges = scene.check.sum_bundles(projections, is_kept, seen_by)
    edge_gain, edge_std = paired_gain(*edges)
    means = sums.sum(axis=0) / counts.sum() if len(counts) else np.full(2, np.nan)
    told = {"distance_before_m": means[0], "distance_after_m": means[1], "gain_m": gain, "gain_std_m": std, "n_common_edges": n_common}
    return {name: float(v) for name, v in (told | {"edge_gain_px": edge_gain, "edge_gain_std_px": edge_std}).items()}


def _pixel_sigmas(points_camera: np.ndarray, K: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """(2,) mean deviations in pixels of points (N, 3) in the camera, for a covariance of turn and shift (6, 6)."""
    if len(points_camera) == 0:
        return np.full(2, np.nan)
    x, y, z = points_camera[:: max(1, len(points_camera) // _N_EVIDENCE)].T
    zero, one = np.zeros_like(x), np.ones_like(x)
    # Columns: how the point moves with the three turns and the three shifts.
    ways = np.array([[zero, z, -y, one, zero, zero], [-z, zero, x, zero, one, zero], [y, -x, zero, zero, zero, one]])
    J = np.array([K[0, 0] * (ways[0] - x / z * ways[2]), K[1, 1] * (ways[1] - y / z * ways[2])]) / z
    return np.sqrt(np.einsum("akn,kl,aln->an", J, covariance, J)).mean(axis=1)


def _freed(c: KeyframeClouds, raw: np.ndarray) -> np.ndarray:
    """Thinned raw points of the frame freed of its motion; a thinned point moves with the azimuth of the points it came from."""
    if c.motion is None or c.time_offset_s is None or len(raw) == 0:
        return raw
    azimuths = np.arctan2(c.points_lidar[:, 1], c.points_lidar[:, 0])
    order = np.argsort(azimuths)
    at = np.searchsorted(azimuths[order], np.arctan2(raw[:, 1], raw[:, 0]))
    return c.motion.deskew(raw, c.time_offset_s[order][np.minimum(at, len(order) - 1)])


def evidence_distance(evidence: np.ndarray, T_camera_stamp: np.ndarray) -> float:
    """Median distance in m of the evidence's lidar points from the camera's planes under a transform (4, 4); NaN without evidence."""
    if len(evidence) == 0:
        return float("nan")
    moved = apply(T_camera_stamp, evidence[:, :3])
    return float(np.median(np.abs(np.einsum("ij,ij->i", moved - evidence[:, 3:6], evidence[:, 6:9]))))


def _judge(made: KeyframeCalibration, q: QualitySettings) -> None:
    """The gates; the first that fails is the status."""
    f = made.figures
    if f["n_matched"] < q.min_objects:
        raise CalibrationFailed("too_few_objects", f"{f['n_matched']} matched objects of at least {q.min_objects}")
    if not f["median_distance_m"] <= q.max_distance_m:
        raise CalibrationFailed("far_apart", f"a median distance of {f['median_distance_m']:.3f} m of at most {q.max_distance_m:g} m")
    if not f["sigma_x_px"] <= q.max_sigma_px:
        raise CalibrationFailed("uncertain", f"a deviation of {f['sigma_x_px']:.1f} px of at most {q.max_sigma_px:g} px")
    if not f["free_shift_m"] <= q.max_free_shift_m:
        found = f"with the scale left free, {f['free_scale']:.3f}, the lidar moves by {f['free_shift_m']:.2f} m"
        raise CalibrationFailed("scale_open", f"{found}, asked for at most {q.max_free_shift_m:g} m")
    if not f["edge_px"] < q.max_edge_px:
        raise CalibrationFailed("no_edges", "no image edge is near any edge that the lidar sees, or it sees none")
    least_px = q.least_margin_px(f["n_shots"])
    if not f["edge_margin_px"] >= least_px:
        found = f"turned one way, edges lie {f['edge_margin_px']:.2f} px farther, asked for {least_px:g} px"
        raise CalibrationFailed("edges_disagree", found)
