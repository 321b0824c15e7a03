"""The lidar frame in the frame of the camera's cloud: Algorithm 1 on objects, then ICP with a scale.

Source: Nagy (2020), 4.3.2.2, Algorithm 1, Eq. 4.2 (N-221 to N-225, N-230). The vote is the one localization uses (chapter 3), with object
centres as the only keypoints.

ASSUME (X-08): the turn is voted on in steps of 0.25 degrees (4.4.2), not of one degree as the loop of Algorithm 1 has it; the maximum gives
dz too; and it is the lidar (F2) that is moved into the frame of the camera's cloud (F1), as text and figures say, so T_R = T3 T2.

ASSUME: the two angles that the vote leaves out are those of the road: both clouds are laid level on it first.

ASSUME: sides of boxes are compared longer with longer, since a box along the axes changes with every turn, and one voxel is added to each:
below its size a side is noise.

ASSUME: the scale of a cloud of images is known within a few percent; the vote, which is rigid, is held at a few scales.

Beyond the thesis: with few objects in a camera's view the highest cell of the vote is often chance. Its best peaks, and places found by
laying what stands in both clouds on each other seen from above, are refined in short and ordered by how much of each cloud lies on the
other where both see. Where a bus or tram fills the view the most overlap is chance, too, so the first few are all calibrated and judged.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import open3d as o3d
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from streetscan.calibration.linear_projection import View, rigid_of
from streetscan.calibration.objects import UNSHAPED, CloudObjects, points_of_cloud
from streetscan.calibration.ways import TURN_OFF_PER_TURN, Way
from streetscan.geometry import apply, invert, rotation_angle, transform, transform_of_rotation
from streetscan.localization.keypoints import ObjectSet
from streetscan.localization.recovery import make_plane_map, search_plane
from streetscan.localization.reference import OccupancyGrid
from streetscan.localization.voting import Window, refine_peaks, vote
from streetscan.registration.ndt import thin_points


@dataclass(frozen=True)
class IcpSettings:
    """Similarity ICP of lidar points to the planes of the camera's cloud; lengths in metres.

    Attributes:
        reaches_m: farthest correspondence, from stage to stage.
        n_iterations: steps at each stage.
        thin_m: lidar points are averaged in cubes of this edge.
        target_thin_m: points of the camera's cloud likewise.
        normal_m: radius of the neighbourhood of a normal.
        noise_m: of both clouds, apart from the depths.
        noise_px: of a match between images, which makes depths the worse, the smaller the angle between the rays is.
        scale_std: deviation of the scale of the camera's cloud from 1, beside what the lidar's motion leaves open (KeyframeClouds); it
            holds the scale where the clouds do not tell it. Large for a cloud without unit.
        max_scale: largest deviation that is accepted (N-230).
        is_scaled: False keeps the scale of the start, as the thesis' standard ICP does.
        bend_std_deg: deviation of the direction structure from motion has the camera go in, on a way of a metre; the longer the way, the
            smaller. ASSUME: 0.4; KITTI's ways of 2.3 m, which edges corrected, were off by 0.23 degrees (root of the mean square), those of
            2 m on training and validation streets by 0.20, of 5 m by 0.02.
        way_std_m: deviation of where the lidar's way ends, to its side.
        way_std_s: of the times of images and lidar frames, which change the bearing of a way in a turn. ASSUME: 0.03; training and
            validation streets have no turn to set it by. Ways through turns of 5 to 17 degrees (KITTI, a crossroads of the test street)
            were off by 0.1 to 0.8.
        min_pairs: fewer correspondences are no registration.
    """

    reaches_m: tuple[float, ...] = (0.5, 0.25, 0.15)
    n_iterations: int = 12
    thin_m: float = 0.1
    target_thin_m: float = 0.05
    normal_m: float = 0.25
    noise_m: float = 0.02
    noise_px: float = 0.5
    scale_std: float = 0.003
    max_scale: float = 0.1
    is_scaled: bool = True
    bend_std_deg: float = 0.4
    way_std_m: float = 0.005
    way_std_s: float = 0.03
    min_pairs: int = 200

    def __post_init__(self):
        object.__setattr__(self, "reaches_m", tuple(self.reaches_m))


@dataclass(frozen=True)
class AlignmentSettings:
    """How the lidar frame is brought into the frame of the camera's cloud.

    Attributes:
        min_ratio, max_ratio: of the sides of boxes that may be one object (thesis: 0.7, 1.4).
        window: what is searched, in steps of 0.25 degrees and 0.2 m: the full circle and 15 m in the thesis. ASSUME: 3 m, because both
            frames begin at their sensors, which are on one car.
        scales: of the camera's cloud, tried one after the other.
        n_peaks: peaks of a vote, and places of a search by points, that are compared at each scale.
        reach_m: centres of objects that agree are this near after the vote.
        is_searched: compare places found by points too; thesis: no.
        cube_m: edge of the cubes in which clouds are compared.
        n_refined: candidates that are refined in short before they are compared.
        n_places: places that are calibrated and judged; thesis: one.
        min_overlap: least overlap of the clouds at a place; with less there is no match.
        icp: see IcpSettings.
    """

    min_ratio: float = 0.7
    max_ratio: float = 1.4
    window: Window = field(default_factory=lambda: Window(turn_deg=180.0, shift_m=3.0, rise_m=1.0))
    scales: tuple[float, ...] = (0.97, 1.0, 1.03)
    n_peaks: int = 12
    reach_m: float = 0.8
    is_searched: bool = True
    cube_m: float = 0.4
    n_refined: int = 12
    n_places: int = 4
    min_overlap: float = 0.05
    icp: IcpSettings = field(default_factory=IcpSettings)

    def __post_init__(self):
        object.__setattr__(self, "scales", tuple(self.scales))


@dataclass
class Alignment:
    """Where the lidar frame lies in the camera's cloud.

    Attributes:
        T_sfm_lidar: (4, 4) similarity.
        source: `objects` (the vote), `points`, or `nearby`.
        votes: of the peak's cell and its neighbours; 0 for a place found by points.
        n_pairs: objects that agree, likewise.
        overlap: how much of each cloud lies on the other, 0 to 1; NaN before it is measured.
    """

    T_sfm_lidar: np.ndarray
    source: str
    votes: int = 0
    n_pairs: int = 0
    overlap: float = np.nan


def find_compatible(lidar: CloudObjects, sfm: CloudObjects, scale: float, s: AlignmentSettings) -> np.ndarray:
    """Pairs (P, 2) int64 of lidar and camera object that may be the same: alike boxes and one shape category (N-222).

    Args:
        lidar, sfm: objects of the two clouds.
        scale: the camera's boxes are multiplied by it.
        s: `min_ratio` and `max_ratio`.
    """
    own, theirs = (
        np.concatenate([np.sort(o.sizes_m[:, :2], axis=1), o.sizes_m[:, 2:]], axis=1) * k + lidar.voxel_m
        for o, k in ((lidar.objects, 1.0), (sfm.objects, scale))
    )
    ratios = theirs[None] / own[:, None]
    is_alike = ((ratios >= s.min_ratio) & (ratios <= s.max_ratio)).all(axis=2)
    is_one_shape = lidar.shapes[:, None] == sfm.shapes[None]
    # A shape that is not known speaks for and against nothing.
    is_one_shape |= (lidar.shapes[:, None] == UNSHAPED) | (sfm.shapes[None] == UNSHAPED)
    return np.argwhere(is_alike & is_one_shape)


def vote_alignments(lidar: CloudObjects, sfm: CloudObjects, settings: AlignmentSettings) -> list[Alignment]:
    """Algorithm 1: alignments the objects of both clouds agree on, most votes first; their overlap is not measured yet.

    Args:
        lidar, sfm: objects of the two clouds.
        settings: see AlignmentSettings.
    """
    s, found = settings, []
    for scale in s.scales:
        pairs = find_compatible(lidar, sfm, scale, s)
        scaled = _scaled(sfm.objects, scale)
        peaks = vote(lidar.objects, scaled, pairs, 1, s.window, s.n_peaks)
        for peak in refine_peaks(peaks, lidar.objects, scaled, pairs, 1, s.reach_m):
            T_level_level = _similarity(1 / scale) @ transform(peak.shift_m, (0, 0, peak.turn_rad))
            found.append(Alignment(_between(lidar, sfm, T_level_level), "objects", peak.votes, len(peak.pairs)))
    return sorted(found, key=lambda a: -a.votes)


def search_alignments(lidar: CloudObjects, sfm: CloudObjects, settings: AlignmentSettings) -> list[Alignment]:
    """Alignments under which what stands in the camera's cloud, seen from above, lies on what stands around the lidar."""
    s = settings
    plane_map = make_plane_map(lidar.points, lidar.heights_m)
    standing = standing_points(sfm)
    if plane_map is None or len(standing) == 0:
        return []
    found = []
    for scale in s.scales:
        for shift, turn, _ in search_plane(plane_map, standing * scale, np.zeros(2), 0.0, s.window, s.n_peaks):
            T_lidar_sfm = transform((*shift, 0.0), (0, 0, turn)) @ _similarity(scale)
            found.append(Alignment(_between(lidar, sfm, invert(T_lidar_sfm)), "points"))
    return found


def nearby_alignments(lidar: CloudObjects, sfm: CloudObjects) -> list[Alignment]:
    """Alignments of sensors that look along the same way and sit near each other, as on any car; level frames have x along the way.

    ASSUME: within a metre, in steps of half a metre. Where traffic hides what stands, neither objects nor the view from above find it.
    """
    shifts = np.arange(-2, 3) * 0.5
    places = [transform((x, y, 0.0)) for x in shifts for y in shifts]
    return [Alignment(_between(lidar, sfm, T), "nearby") for T in places]


def find_places(
    voted: Sequence[Alignment], lidar: CloudObjects, sfm: CloudObjects, target: "PlaneTarget", view: View, settings: AlignmentSettings,
    is_one_way: bool = False,
) -> list[Alignment]:  # fmt: skip
    """The places within the window where most of both clouds lies on the other, best first and apart from each other.

    Args:
        voted: of `vote_alignments`.
        lidar, sfm: objects of the two clouds.
        target: the camera's cloud for ICP.
        view: the image, which tells what of the lidar's points the camera's cloud could hold.
        settings: see AlignmentSettings.
        is_one_way: whether x of both level frames is the way the vehicle goes.
    """
    s = settings
    candidates = [replace(a) for a in voted]
    if s.is_searched:
        candidates += search_alignments(lidar, sfm, s)
        candidates += nearby_alignments(lidar, sfm) if is_one_way else []
    comparison = _Comparison(lidar, sfm, view, s.cube_m)
    for c in candidates:
        c.overlap = comparison.overlap(c.T_sfm_lidar)
    chosen = _first_apart(candidates, s.n_refined, 0.4, np.radians(1.5))
    points, comparison = points_of_cloud(lidar), _Comparison(lidar, sfm, view, s.cube_m / 2)
    short = replace(s.icp, reaches_m=(0.8, 0.4, 0.2), n_iterations=12, thin_m=0.3, min_pairs=50)
    for c in chosen:
        c.T_sfm_lidar = refine_alignment(points, target, c.T_sfm_lidar, short).T_sfm_lidar
        c.overlap = comparison.overlap(c.T_sfm_lidar)
    inside = [c for c in chosen if np.abs(_shift(lidar, sfm, c.T_sfm_lidar)[:2]).max() <= s.window.shift_m]
    return _first_apart([c for c in inside if c.overlap >= s.min_overlap], s.n_places, 0.3, np.radians(1.0))


def _first_apart(candidates: Sequence[Alignment], n: int, shift_m: float, turn_rad: float) -> list[Alignment]:
    """At most n of the candidates, best overlap first, none nearer to another than a shift and a turn."""
    chosen: list[Alignment] = []
    for c in sorted(candidates, key=lambda c: -c.overlap):
        if len(chosen) < n and all(is_apart(c.T_sfm_lidar, other.T_sfm_lidar, shift_m, turn_rad) for other in chosen):
            chosen.append(c)
    return chosen


def _shift(lidar: CloudObjects, sfm: CloudObjects, T_sfm_lidar: np.ndarray) -> np.ndarray:
    """(3,) from the camera's cloud's origin to the lidar's, in the former's level frame."""
    return (sfm.T_level_cloud @ T_sfm_lidar @ invert(lidar.T_level_cloud))[:3, 3]


class _Comparison:
    """How much of each cloud lies on the other."""

    def __init__(self, lidar: CloudObjects, sfm: CloudObjects, view: View, cube_m: float):
        self._lidar, self._sfm = lidar, sfm
        self._standing = [thin_points(standing_points(c), cube_m / 2) for c in (lidar, sfm)]
        self._grids = [OccupancyGrid(points, cube_m) for points in self._standing]
        self._lidar_points, self._view = apply(invert(lidar.T_level_cloud), self._standing[0]), view

    def overlap(self, T_sfm_lidar: np.ndarray) -> float:
        """The geometric mean of two shares: of the camera's standing points on the lidar's, and of the lidar's in view on the camera's."""
        T = self._sfm.T_level_cloud @ T_sfm_lidar @ invert(self._lidar.T_level_cloud)
        seen = self._standing[0][self._view.sees(apply(T_sfm_lidar, self._lidar_points))]
        shares = self._grids[0].overlap(self._standing[1], invert(T)), self._grids[1].overlap(seen, T)
        return float(np.sqrt(np.prod(np.nan_to_num(shares))))


def is_apart(T_a: np.ndarray, T_b: np.ndarray, shift_m: float, turn_rad: float) -> bool:
    """Whether two places (4, 4) differ by more than a shift or a turn."""
    change = rigid_of(invert(T_b) @ T_a)
    return bool(np.linalg.norm(change[:3, 3]) > shift_m or rotation_angle(change) > turn_rad)


def standing_points(cloud: CloudObjects, low_m: float = 0.5, high_m: float = 3.0) -> np.ndarray:
    """(N, 3) points of a level cloud between two heights above its ground."""
    return cloud.points[(cloud.heights_m > low_m) & (cloud.heights_m < high_m)]


@dataclass
class PlaneTarget:
    """The camera's cloud prepared for ICP.

    Attributes:
        points, normals: (N, 3) float64, frame `sfm`.
        noise_m: (N,) expected error of each point.
        tree: of the points.
        bends: (N,) by how much, along its normal, each point is off for a radian of error of the way the camera goes, to its right.
        way: of both sensors, or None where it is not known.
    """

    points: np.ndarray
    normals: np.ndarray
    noise_m: np.ndarray
    tree: cKDTree
    bends: np.ndarray
    way: Way | None = None

    def straightened(self, bend_rad: float) -> "PlaneTarget":
        """The planes where they are when the way of the camera is wrong by so much."""
        points = self.points - self.normals * (self.bends * bend_rad)[:, None]
        way = None if self.way is None else self.way.straightened(bend_rad)
        return replace(self, points=points, tree=cKDTree(points), way=way)


def prepare_target(
    points_sfm: np.ndarray, cameras_sfm: np.ndarray, focal_px: float, settings: IcpSettings = IcpSettings(), way: Way | None = None
) -> PlaneTarget:
    """The camera's cloud with normals, and what each of its planes is worth.

    Args:
        points_sfm: (N, 3) static points, about metric.
        cameras_sfm: (n, 3) where the cameras stood; the first is the one that counts.
        focal_px: focal length of the images.
        settings: see IcpSettings.
        way: of both sensors, which holds the yaw.

    A depth from images is wrong along the ray, by `noise_px` over the parallax; a plane the ray grazes hardly moves by it.

    What structure from motion knows least is where the camera goes: a turn of all images and a way to the side look nearly alike, and a
    hundredth of a degree of the one is a tenth of the other. Parallax is measured about the point the camera goes to; when that is off,
    depths are too large on one side and too small on the other, and the street comes out turned.
    """
    s = settings
    thinned = thin_points(points_sfm, s.target_thin_m)
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(thinned))
    cloud.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(radius=s.normal_m, max_nn=40))
    normals = np.asarray(cloud.normals)
    rays = thinned[:, None] - cameras_sfm
    distances = np.linalg.norm(rays, axis=2)
    rays /= np.maximum(distances, 1e-6)[:, :, None]
    parallax = np.arccos(np.clip(np.einsum("ijk,ik->ij", rays, rays[:, 0]), -1, 1)).max(axis=1)
    depth_noise = distances[:, 0] * s.noise_px / focal_px / np.maximum(parallax, 1e-4)
    noise = np.hypot(s.noise_m, depth_noise * np.abs(np.einsum("ij,ij->i", normals, rays[:, 0])))
    return PlaneTarget(
        thinned, normals, noise, cKDTree(thinned), _bends(thinned - cameras_sfm[0], normals, cameras_sfm[-1] - cameras_sfm[0]), way
    )


# Rays nearer to the way of the camera than this (sine of the angle) have no depth worth speaking of.
_MIN_SINE = 0.05


def _bends(arms: np.ndarray, normals: np.ndarray, way: np.ndarray) -> np.ndarray:
    """`PlaneTarget.bends` of points at arms (N, 3) from the camera, x to its right and y down, that goes along a way (3,)."""
    right = np.cross([0.0, 1.0, 0.0], way)
    if np.linalg.norm(right) < 1e-6:
        return np.zeros(len(arms))
    way, right = way / np.linalg.norm(way), right / np.linalg.norm(right)
    rays = arms / np.maximum(np.linalg.norm(arms, axis=1, keepdims=True), 1e-9)
    off = np.cross(rays, way)
    # A depth is the parallax' inverse times the sine of the angle between ray and way.
    growths = np.einsum("ij,ij->i", off, np.cross(rays, right)) / np.maximum((off**2).sum(axis=1), _MIN_SINE**2)
    return np.einsum("ij,ij->i", normals, arms) * growths


@dataclass
class Registration:
    """Outcome of ICP.

    Attributes:
        T_sfm_lidar: (4, 4) similarity.
        n_pairs: correspondences of the last step.
        rmse_m: weighted root mean square of their distances from the planes.
        is_converged: the last steps moved nothing, the scale stayed within its bounds, and there were enough correspondences.
        response: (7,) turn (rotation vector), shift and growth about the origin of `sfm` that go with a radian of error of the way the
            camera goes.
        covariance: (6, 6) of a small turn about the origin of `sfm` (rotation vector, rad) and a shift (m), in its axes, the scale being
            as uncertain as it is; NaN without enough correspondences.
        bend_rad: the error of the way the camera goes, as planes and the lidar's way tell it.
    """

    T_sfm_lidar: np.ndarray
    n_pairs: int
    rmse_m: float
    is_converged: bool
    response: np.ndarray = field(default_factory=lambda: np.zeros(7))
    covariance: np.ndarray = field(default_factory=lambda: np.full((6, 6), np.nan))
    bend_rad: float = 0.0

    def bent(self, bend_rad: float) -> np.ndarray:
        """T_sfm_lidar (4, 4) as it would be found when the way of the camera is wrong by so much more than `bend_rad`."""
        return _step(self.response * bend_rad, np.zeros(3)) @ self.T_sfm_lidar


def refine_alignment(
    points_lidar: np.ndarray, target: PlaneTarget, T_sfm_lidar: np.ndarray, settings: IcpSettings = IcpSettings()
) -> Registration:
    """Similarity ICP from points to planes, robust and weighted by what a depth from images is worth (T_3, N-225).

    Args:
        points_lidar: (N, 3) static points, metres, frame `lidar`.
        target: of `prepare_target`.
        T_sfm_lidar: (4, 4) the start.
        settings: see IcpSettings.

    ASSUME: point to plane, where the thesis says standard ICP: rings of a lidar matched point to point pull towards the places between
    the rings, and with a free scale towards a smaller cloud. Our own lines, because the libraries' variants with a scale have no planes.
    """
    s, T, bend_rad = settings, np.array(T_sfm_lidar, np.float64), 0.0
    source = thin_points(points_lidar, s.thin_m)
    n, rmse, last_step = 0, np.nan, np.inf
    for reach in s.reaches_m:
        for _ in range(s.n_iterations):
            moved = apply(T, source)
            distances, rows = target.tree.query(moved, distance_upper_bound=reach)
            is_found = np.isfinite(distances)
            n = int(is_found.sum())
            if n < s.min_pairs:
                return Registration(T, n, np.nan, False)
            moved, rows = moved[is_found], rows[is_found]
            errors = np.einsum("ij,ij->i", moved - target.points[rows], target.normals[rows]) + target.bends[rows] * bend_rad
            weights = _weights(errors, target.noise_m[rows])
            rmse = float(np.sqrt((weights * errors**2).sum() / weights.sum()))
            step, bend_rad = _solve(_Linear(moved, target, rows, errors, weights), T, bend_rad, s)
            T = step @ T
            last_step = np.abs(apply(step, moved) - moved).max()
            if last_step < 1e-4:
                break
    is_bounded = abs(scale_of(T) - 1) <= s.max_scale
    response, covariance = _open_ways(_Linear(moved, target, rows, errors, weights), s)
    return Registration(T, n, rmse, bool(is_bounded and last_step < 0.02), response, covariance, bend_rad)


def _weights(errors: np.ndarray, noise_m: np.ndarray) -> np.ndarray:
    """Of the squares of the errors: by the noise, and by Geman and McClure's kernel for what is no counterpart."""
    scaled = errors / noise_m
    spread = max(1.4826 * float(np.median(np.abs(scaled))), 1.0)
    return 1 / noise_m**2 / (1 + (scaled / (2 * spread)) ** 2) ** 2


# ASSUME: neighbouring points share their errors, so a correspondence counts as one of so many. A round number that was not measured;
# of points 0.1 m apart it is a patch about 0.8 m wide.
_CORRELATED = 60.0


@dataclass
class _Linear:
    """Points moved onto the target, the planes they belong to, and by how much they are off; what the least squares are made of."""

    moved: np.ndarray
    target: PlaneTarget
    rows: np.ndarray
    errors: np.ndarray
    weights: np.ndarray

    def normal_equations(self, centre: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """H (8, 8) and b (8,) of the planes: a turn and a shift about a centre, a growth, and the camera's error of the way."""
        normals, bends = self.target.normals[self.rows], self.target.bends[self.rows]
        J = np.c_[_jacobian(self.moved - centre, normals), bends]
        return (J * self.weights[:, None]).T @ J / _CORRELATED, (J * self.weights[:, None]).T @ self.errors / _CORRELATED

    def add_way(self, H: np.ndarray, b: np.ndarray, T_sfm_lidar: np.ndarray, bend_rad: float) -> None:
        """Add what the way tells where it is known: the lidar's past the camera's, as far as the camera's is right."""
        way = self.target.way
        if way is not None:
            j = np.array([*TURN_OFF_PER_TURN, 0, 0, 0, 0, 1.0])
            H += np.outer(j, j) / way.std_rad**2
            b += j * (way.turn_off(T_sfm_lidar) + bend_rad) / way.std_rad**2


def _solve(linear: _Linear, T: np.ndarray, bend_rad: float, s: IcpSettings) -> tuple[np.ndarray, float]:
    """The small similarity (4, 4) that brings the weighted points onto the planes best, and the camera's error of the way.

    The scale is drawn towards 1, or stays as it is (`is_scaled`), and the error of the way, which planes tell a little and the lidar's way
    more, is drawn towards none.
    """
    centre = linear.moved.mean(axis=0)
    H, b = linear.normal_equations(centre)
    linear.add_way(H, b, T, bend_rad)
    # What the planes do not hold stays where it is.
    H[:7, :7] += 1e-6 * np.diag(np.diag(H)[:7]) + 1e-9 * np.trace(H[:7, :7]) * np.eye(7)
    scale, std_rad = scale_of(T), max(np.radians(s.bend_std_deg), 1e-6)
    H[6, 6] += (scale / s.scale_std) ** 2
    b[6] += scale * (scale - 1) / s.scale_std**2
    H[7, 7] += std_rad**-2
    b[7] += bend_rad / std_rad**2
    free = np.array([True] * 6 + [s.is_scaled, True])
    x = np.zeros(8)
    x[free] = np.linalg.solve(H[np.ix_(free, free)], -b[free])
    return _step(x[:7], centre), bend_rad + float(x[7])


def _step(x: np.ndarray, centre: np.ndarray) -> np.ndarray:
    """The similarity (4, 4) of a turn, a shift and a growth (7,) about a point."""
    step = transform_of_rotation(Rotation.from_rotvec(x[:3]).as_matrix() * (1 + x[6]))
    step[:3, 3] = centre + x[3:6] - step[:3, :3] @ centre
    return step


def _jacobian(arms: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """How distances from planes change with a turn (rotation vector), a shift and a growth about where the arms begin: (N, 7)."""
    return np.concatenate([np.cross(arms, normals), normals, np.einsum("ij,ij->i", arms, normals)[:, None]], axis=1)


def _open_ways(linear: _Linear, s: IcpSettings) -> tuple[np.ndarray, np.ndarray]:
    """`Registration.response` and `covariance`; a direction no plane holds is known to a kilometre."""
    H, b = linear.normal_equations(np.zeros(3))
    # How far the way is off does not change how much it tells.
    linear.add_way(H, b, np.eye(4), 0.0)
    known = H[:7, :7] + np.diag([*np.full(3, 1e-2), *np.full(3, 1e-6), s.scale_std**-2])
    response = -np.linalg.solve(known, H[:7, 7])
    H[:7, :7], H[7, 7] = known, H[7, 7] + max(np.radians(s.bend_std_deg), 1e-6) ** -2
    return response, np.linalg.inv(H)[:6, :6]


def scale_of(T: np.ndarray) -> float:
    """The scale of a similarity (4, 4)."""
    return float(np.cbrt(np.linalg.det(T[:3, :3])))


def _similarity(scale: float) -> np.ndarray:
    return np.diag([scale, scale, scale, 1.0])


def _scaled(objects: ObjectSet, scale: float) -> ObjectSet:
    """Objects of a cloud multiplied by a scale about the origin."""
    lengths = {name: getattr(objects, name) * scale for name in ("centres", "sizes_m", "corners", "parts")}
    return ObjectSet(objects.n_points, yaws_rad=objects.yaws_rad, **lengths)


def _between(lidar: CloudObjects, sfm: CloudObjects, T_level_level: np.ndarray) -> np.ndarray:
    """T_sfm_lidar of an alignment of the two level frames."""
    return invert(sfm.T_level_cloud) @ T_level_level @ lidar.T_level_cloud


@dataclass
class ControlPoints:
    """Objects of the lidar and where the camera's cloud has them.

    Attributes:
        objects: (C,) int64 numbers of the lidar's objects.
        lidar: (C, 3) their centroids, moved into the frame `sfm`.
        sfm: (C, 3) the centroids of their counterparts.
        weights: (C,) points that have a counterpart.
    """

    objects: np.ndarray
    lidar: np.ndarray
    sfm: np.ndarray
    weights: np.ndarray


def match_objects(
    lidar: CloudObjects, target: PlaneTarget, T_sfm_lidar: np.ndarray, reach_m: float = 0.4, min_share: float = 0.6, prior_m: float = 0.1
) -> ControlPoints:
    """The lidar's objects that stand in the camera's cloud too, and the shift of each from the one to the other.

    ASSUME: after T_R it is the place that tells which objects are the same, box and shape no longer; and a counterpart's centroid is that
    of the lidar's object, laid on the camera's points by a shift of its own. The plain centroids of two blobs, of which each sensor
    sees another part, differ by more than the distortion that is looked for.

    Args:
        lidar: objects of the lidar.
        target: the camera's cloud.
        T_sfm_lidar: (4, 4) after ICP.
        reach_m: farthest correspondence.
        min_share: least share of an object's points that have one.
        prior_m: expected size of the shifts; a direction no plane holds does not move.
    """
    to_lidar, rows = invert(lidar.T_level_cloud), []
    for m in range(len(lidar)):
        moved = apply(T_sfm_lidar @ to_lidar, lidar.members[lidar.starts[m] : lidar.starts[m + 1]])
        distances, nearest = target.tree.query(moved, distance_upper_bound=reach_m)
        is_found = np.isfinite(distances)
        if is_found.sum() < 5 or is_found.mean() < min_share:
            continue
        moved, nearest = moved[is_found], nearest[is_found]
        centre = moved.mean(axis=0)
        rows.append(
            (
                m,
                centre,
                centre + _fit_shift(moved, target.points[nearest], target.normals[nearest], target.noise_m[nearest], prior_m),
                len(moved),
            )
        )
    numbers, own, theirs, weights = zip(*rows, strict=True) if rows else ([], [], [], [])
    return ControlPoints(np.array(numbers, np.int64), np.reshape(own, (-1, 3)), np.reshape(theirs, (-1, 3)), np.array(weights, float))


def _fit_shift(points, counterparts, normals, noise_m, prior_m: float) -> np.ndarray:
    """The shift (3,) that lays points on planes, each object's points counting as few, since they share their error."""
    shift = np.zeros(3)
    for _ in range(4):
        errors = np.einsum("ij,ij->i", points + shift - counterparts, normals)
        weights = _weights(errors, noise_m) * min(1.0, _INDEPENDENT / len(points))
        H = (normals * weights[:, None]).T @ normals + np.eye(3) / prior_m**2
        shift = shift - np.linalg.solve(H, (normals * weights[:, None]).T @ errors + shift / prior_m**2)
    return shift


# Of an object's points so many are taken to be independent.
_INDEPENDENT = 10.0
