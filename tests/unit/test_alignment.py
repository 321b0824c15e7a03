"""Alignments of object sets and clouds: known transforms are found."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from streetscan.calibration.alignment import (
    AlignmentSettings,
    IcpSettings,
    find_compatible,
    match_objects,
    nearby_alignments,
    prepare_target,
    refine_alignment,
    scale_of,
    vote_alignments,
)
from streetscan.calibration.objects import FLAT, LINEAR, UNSHAPED, CloudObjects
from streetscan.geometry import apply, invert, rotation_angle, transform
from streetscan.localization.keypoints import describe_objects
from streetscan.localization.voting import Window


def objects_at(places: np.ndarray, sizes: np.ndarray, shapes: np.ndarray) -> CloudObjects:
    """Boxes of given sizes (M, 3) with their feet at places (M, 2), level frame."""
    rng = np.random.default_rng(0)
    unit = np.concatenate([rng.uniform(0, 1, (40, 3)), np.indices((2, 2, 2)).reshape(3, -1).T])
    members = np.concatenate([(unit - [0.5, 0.5, 0]) * size + [*place, 0.0] for place, size in zip(places, sizes, strict=True)])
    starts = np.arange(len(places) + 1) * len(unit)
    nothing = np.empty((0, 3))
    return CloudObjects(
        np.eye(4), members, members[:, 2], describe_objects(members, starts), shapes, members, starts, nothing.astype(np.int32),
        np.empty(0, np.uint8), 0.2,
    )  # fmt: skip


def moved(cloud: CloudObjects, T: np.ndarray) -> CloudObjects:
    """The same objects in another frame, T being a turn about the vertical, a shift and a scale."""
    members, scale = apply(T, cloud.members), scale_of(T)
    objects = describe_objects(members, cloud.starts)
    return CloudObjects(
        np.eye(4), members, cloud.heights_m * scale, objects, cloud.shapes, members, cloud.starts, cloud.voxels, cloud.voxel_shapes, 0.2
    )


def street(seed: int, n: int = 12) -> CloudObjects:
    """Objects of different sizes, no two within two metres."""
    rng, places = np.random.default_rng(seed), []
    while len(places) < n:
        place = rng.uniform(-12, 12, 2)
        if all(np.hypot(*(place - other)) > 2 for other in places):
            places.append(place)
    return objects_at(np.array(places), rng.uniform([0.2, 0.2, 1], [1.5, 1.5, 2.5], (n, 3)), rng.integers(0, 3, n).astype(np.uint8))


@given(st.integers(0, 1000), st.floats(-np.pi, np.pi), st.floats(-4, 4), st.floats(-4, 4), st.sampled_from([0.97, 1.0, 1.03]))
@settings(max_examples=12, deadline=None)
def test_the_vote_finds_any_turn_shift_and_scale(seed, yaw, x, y, scale):
    lidar = street(seed)
    T = transform([x, y, 0.1], (0, 0, yaw))
    T_sfm_lidar = np.diag([1 / scale] * 3 + [1]) @ T
    wide = AlignmentSettings(window=Window(180.0, 5.0, 1.0))
    best = max(vote_alignments(lidar, moved(lidar, T_sfm_lidar), wide), key=lambda a: a.n_pairs)
    error = invert(T_sfm_lidar) @ best.T_sfm_lidar
    assert best.n_pairs >= 8
    assert np.linalg.norm(apply(error, lidar.objects.centres) - lidar.objects.centres, axis=1).max() < 0.4


def test_objects_seen_by_one_sensor_alone_do_not_disturb():
    lidar = street(3, 16)
    T = transform([1.0, -2.0, 0], (0, 0, 2.0))
    sfm = moved(objects_at(lidar.objects.centres[:7, :2], lidar.objects.sizes_m[:7], lidar.shapes[:7]), T)
    best = max(vote_alignments(lidar, sfm, AlignmentSettings(scales=(1.0,))), key=lambda a: a.n_pairs)
    assert np.degrees(rotation_angle(invert(T) @ best.T_sfm_lidar)) < 2


def test_objects_all_alike_leave_the_vote_open():
    # Posts at the corners of a square: quarter turns fit as well.
    places = np.array([(5.0, 5), (5, -5), (-5, 5), (-5, -5)])
    posts = objects_at(places, np.tile([0.2, 0.2, 2.0], (4, 1)), np.full(4, LINEAR, np.uint8))
    found = vote_alignments(posts, posts, AlignmentSettings(scales=(1.0,)))
    assert sum(a.n_pairs == 4 for a in found) >= 2


def test_compatible_are_alike_boxes_of_one_shape():
    sizes = np.array([(0.4, 0.4, 2.0), (0.4, 0.4, 1.0), (2.0, 0.4, 2.0)])
    a = objects_at(np.array([(5.0, 0), (0, 5), (-5, 0)]), sizes, np.array([LINEAR, LINEAR, FLAT], np.uint8))
    pairs = find_compatible(a, a, 1.0, AlignmentSettings())
    np.testing.assert_array_equal(pairs, [(0, 0), (1, 1), (2, 2)])
    b = objects_at(np.array([(5.0, 0)]), sizes[:1], np.array([UNSHAPED], np.uint8))
    np.testing.assert_array_equal(find_compatible(a, b, 1.0, AlignmentSettings()), [(0, 0)])
    # 1.4 times as large is still alike, twice is not.
    assert len(find_compatible(b, b, 2.0, AlignmentSettings())) == 0


def test_no_objects_no_alignment():
    nothing = street(0).objects.select(np.zeros(12, bool))
    cloud = street(0)
    empty = CloudObjects(np.eye(4), cloud.points, cloud.heights_m, nothing, cloud.shapes[:0], cloud.members[:0], np.zeros(1, np.int64), cloud.voxels, cloud.voxel_shapes, 0.2)  # fmt: skip # noqa: E501
    assert vote_alignments(empty, cloud, AlignmentSettings(window=Window(180.0, 5.0, 1.0))) == []


def planes(n: int = 30_000, seed: int = 0) -> np.ndarray:
    """Road, two walls and a front: every direction is held."""
    rng = np.random.default_rng(seed)
    road = np.c_[rng.uniform(2, 25, n), rng.uniform(-8, 8, n), np.zeros(n)]
    walls = np.c_[rng.uniform(2, 25, n), rng.choice([-8.0, 8.0], n), rng.uniform(0, 5, n)]
    front = np.c_[np.full(n // 2, 25.0), rng.uniform(-8, 8, n // 2), rng.uniform(0, 5, n // 2)]
    return np.concatenate([road, walls, front])


@given(st.floats(-3, 3), st.floats(-0.25, 0.25), st.floats(-0.2, 0.2), st.floats(0.985, 1.015))
@settings(max_examples=8, deadline=None)
def test_icp_recovers_a_similarity(turn_deg, x, y, scale):
    T_true = np.diag([scale] * 3 + [1]) @ transform([x, y, 0.05], np.radians([0.5, -0.5, turn_deg]))
    cameras = np.array([(0.0, 0, 1.5), (2.0, 0.3, 1.5)])
    target = prepare_target(apply(T_true, planes()), cameras, 500.0)
    found = refine_alignment(planes(12_000, seed=1), target, np.eye(4), IcpSettings(reaches_m=(1.5, 0.5, 0.15)))
    assert found.is_converged
    error = apply(invert(T_true) @ found.T_sfm_lidar, planes(100)) - planes(100)
    assert np.linalg.norm(error, axis=1).max() < 0.03
    assert scale_of(found.T_sfm_lidar) == pytest.approx(scale, abs=2e-3)


def test_a_rigid_icp_keeps_the_scale():
    target = prepare_target(planes() * 1.01, np.array([(0.0, 0, 1.5), (2.0, 0, 1.5)]), 500.0)
    found = refine_alignment(planes(12_000, seed=1), target, np.eye(4), IcpSettings(is_scaled=False))
    assert scale_of(found.T_sfm_lidar) == pytest.approx(1.0)


def test_icp_without_correspondences_does_not_converge():
    target = prepare_target(planes(), np.array([(0.0, 0, 1.5), (2.0, 0, 1.5)]), 500.0)
    found = refine_alignment(planes(12_000, seed=1), target, transform([0, 0, 50]))
    assert not found.is_converged
    assert found.n_pairs == 0


def test_a_depth_from_images_is_worth_less_where_the_rays_hardly_part():
    target = prepare_target(planes(), np.array([(0.0, 0, 1.5), (2.0, 0, 1.5)]), 500.0)
    front = np.abs(target.points[:, 0] - 25) < 0.02
    road = (target.points[:, 2] < 0.01) & (target.points[:, 0] < 8)
    assert np.median(target.noise_m[front]) > 5 * np.median(target.noise_m[road])


def test_matched_objects_know_their_local_shift():
    cloud = street(5, 6)
    shift = np.array([0.06, -0.04, 0.0])
    rng = np.random.default_rng(0)
    # Each object is a box of surface points in the camera's cloud, shifted by the same way.
    surfaces = []
    for size, corners in zip(cloud.objects.sizes_m, cloud.objects.corners, strict=True):
        points = rng.uniform(-0.5, 0.5, (4000, 3))
        axis = rng.integers(0, 3, 4000)
        points[np.arange(4000), axis] = rng.choice([-0.5, 0.5], 4000)
        yaw = np.arctan2(*(corners[0, 1] - corners[0, 0])[[1, 0]])
        surfaces.append(apply(transform(corners.reshape(-1, 3).mean(axis=0), (0, 0, yaw)), points * size))
    surface = np.concatenate(surfaces)
    starts = np.arange(7) * 4000
    lidar = CloudObjects(
        np.eye(4), surface, surface[:, 2], describe_objects(surface, starts), cloud.shapes, surface, starts, cloud.voxels,
        cloud.voxel_shapes, 0.2,
    )  # fmt: skip
    target = prepare_target(surface + shift, np.array([(0.0, 0, 20.0), (5.0, 0, 20.0)]), 500.0)
    control = match_objects(lidar, target, np.eye(4))
    assert len(control.objects) == 6
    np.testing.assert_allclose(control.sfm - control.lidar, np.tile(shift, (6, 1)), atol=0.03)


def bent_planes(bend_deg: float) -> tuple[np.ndarray, np.ndarray]:
    """What a camera that goes along x makes of the planes when it believes to go to the left by some degrees, and its places."""
    points = planes(60_000)[:, :] - [0, 0, 1.5]
    away = points[np.hypot(points[:, 1], points[:, 2]) > 0.1 * points[:, 0]]
    rays = away / np.linalg.norm(away, axis=1, keepdims=True)
    believed = np.array([np.cos(np.radians(bend_deg)), np.sin(np.radians(bend_deg)), 0])
    depths = np.linalg.norm(np.cross(rays, believed), axis=1) / np.linalg.norm(np.cross(rays, [1.0, 0, 0]), axis=1)
    return away * depths[:, None], np.array([(0.0, 0, 0), 2 * believed])


def test_a_wrong_way_of_the_camera_is_known_from_what_it_does_to_the_lidar():
    cloud, cameras = bent_planes(0.3)
    lidar = planes(12_000, seed=1) - [0, 0, 1.5]
    # The frame `sfm` has y down, as cameras have.
    T_camera = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
    target = prepare_target(apply(T_camera, cloud), apply(T_camera, cameras), 500.0)
    # It went to the left by its own account, and in truth straight on.
    bend = np.radians(-0.3)
    # Where no error of the way is expected all of it goes into the lidar's place.
    trusting = IcpSettings(bend_std_deg=0.0)
    plain = refine_alignment(lidar, target, T_camera, trusting)
    turn = np.degrees(rotation_angle(invert(T_camera) @ plain.T_sfm_lidar))
    assert turn > 0.1
    assert np.degrees(rotation_angle(invert(T_camera) @ plain.bent(bend))) < turn / 2
    again = refine_alignment(lidar, target.straightened(bend), plain.bent(bend), trusting)
    assert np.degrees(rotation_angle(invert(T_camera) @ again.T_sfm_lidar)) < 0.05
    # Walls on both sides and ahead tell it, for it bends them.
    told = refine_alignment(lidar, target, T_camera)
    assert told.bend_rad == pytest.approx(bend, rel=0.3)
    assert np.degrees(rotation_angle(invert(T_camera) @ told.T_sfm_lidar)) < 0.05


def test_the_covariance_says_which_way_is_open():
    # A road and walls along x leave x open; the front closes it.
    cameras = np.array([(0.0, 0, 1.5), (2.0, 0.3, 1.5)])
    along = planes()[:60_000]
    ends = {}
    for name, cloud in (("open", along), ("closed", planes())):
        found = refine_alignment(cloud[::5], prepare_target(cloud, cameras, 500.0), np.eye(4))
        ends[name] = np.sqrt(np.diag(found.covariance)[3:])
    assert ends["open"][0] > 10 * ends["open"][1]
    assert ends["closed"][0] < 0.7 * ends["open"][0]


def test_sensors_of_one_vehicle_are_looked_for_near_each_other():
    # Level frames of different clouds; places are told in the camera's own frame.
    lidar, sfm = street(0), moved(street(0), np.eye(4))
    sfm.T_level_cloud = transform([0.3, 0, 1.5], (0.02, 0, 0.1))
    found = nearby_alignments(lidar, sfm)
    level = [sfm.T_level_cloud @ a.T_sfm_lidar @ invert(lidar.T_level_cloud) for a in found]
    assert min(np.linalg.norm(T - transform([0.5, -1.0, 0])) for T in level) < 1e-9
    assert max(np.hypot(*T[:2, 3]) for T in level) < 1.5
    assert {a.source for a in found} == {"nearby"}
