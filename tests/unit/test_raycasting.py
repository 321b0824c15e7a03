"""Rays against surfaces whose hits are known by hand."""

import numpy as np
import pytest

from streetscan.classes import CAR, FACADE, GROUND, PHANTOM
from streetscan.simulation.meshes import Surface, box, ellipsoid, quads
from streetscan.simulation.raycasting import SceneCaster
from streetscan.simulation.scene import Actor, Mesh, Scene, join_meshes

OFFSET = np.array([650_000.0, 240_000.0, 100.0])


def ground(half_m: float = 50.0) -> Mesh:
    corners = [[[-half_m, -half_m, 0], [half_m, -half_m, 0], [half_m, half_m, 0], [-half_m, half_m, 0]]]
    return quads(np.array(corners), Surface(GROUND, "asphalt", (90, 90, 90)))


def car(instance: int = 7) -> Mesh:
    mesh = box((-2, -1, 0), (2, 1, 1.5), Surface(CAR, "paint_white", (200, 20, 20)))
    mesh.instances[:] = instance
    return mesh


def shifted(mesh: Mesh, offset: np.ndarray) -> Mesh:
    return Mesh(mesh.vertices + offset, mesh.triangles, mesh.labels, mesh.instances, mesh.materials, mesh.colours)


def straight(mesh: Mesh, start, velocity, yaw_rad: float = 0.0, duration_s: float = 100.0) -> Actor:
    ends = np.array([start, np.add(start, np.multiply(velocity, duration_s))], np.float64)
    return Actor(mesh, np.array([0.0, duration_s]), ends, np.full(2, yaw_rad))


def cast(caster: SceneCaster, origin, direction, time_s: float = 0.0):
    direction = np.array([direction], np.float32)
    return caster.cast(np.array([origin], np.float64), direction / np.linalg.norm(direction), np.array([time_s]))


def test_a_plane_far_from_the_origin_is_hit_to_a_tenth_of_a_millimetre():
    caster = SceneCaster(Scene(shifted(ground(), OFFSET)))
    hits = cast(caster, OFFSET + np.array([1.25, -3.5, 2.0]), (0, 3, -4))
    assert hits.distances_m[0] == pytest.approx(2.5, abs=1e-4)
    assert hits.cos_incidence[0] == pytest.approx(0.8, abs=1e-5)
    assert caster.labels[hits.faces[0]] == GROUND


def test_a_ray_into_the_sky_hits_nothing():
    caster = SceneCaster(Scene(ground()))
    hits = cast(caster, (0, 0, 2), (0, 0, 1))
    assert np.isinf(hits.distances_m[0])
    assert hits.faces[0] == -1
    assert hits.actors[0] == -1
    assert caster.labels_at(hits, np.zeros(1))[0] == 255
    assert len(caster.cast(np.empty((0, 3)), np.empty((0, 3), np.float32), np.empty(0))) == 0


def test_a_ball_is_hit_at_its_radius_from_every_side():
    ball = ellipsoid((2, 2, 2), (0, 0, 0), Surface(FACADE, "stone", (1, 2, 3)), n_sides=96, n_rings=96)
    caster = SceneCaster(Scene(ball))
    directions = np.random.default_rng(0).normal(size=(500, 3)).astype(np.float32)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    hits = caster.cast(-10.0 * directions.astype(np.float64), directions, np.zeros(500))
    np.testing.assert_allclose(hits.distances_m, 8.0, atol=0.01)
    assert hits.cos_incidence.min() > 0.99


def test_two_pulses_see_a_moving_box_where_it_is_at_their_own_times():
    caster = SceneCaster(Scene(ground(), [straight(car(), (0, 0, 0), (10, 0, 0))]), 0.0, 10.0)
    # Its front stands at x = 2 at 0 s and at x = 7 at 0.5 s; a ray along -x from x = 20.
    assert cast(caster, (20, 0, 1), (-1, 0, 0), 0.0).distances_m[0] == pytest.approx(18, abs=1e-4)
    assert cast(caster, (20, 0, 1), (-1, 0, 0), 0.5).distances_m[0] == pytest.approx(13, abs=1e-4)


def test_a_turned_actor_is_hit_on_its_side():
    caster = SceneCaster(Scene(ground(), [straight(car(), (0, 0, 0), (0, 5, 0), yaw_rad=np.pi / 2)]), 0.0, 10.0)
    # Heading north: 1 m half width along x, 2 m half length along y.
    assert cast(caster, (5, 0, 1), (-1, 0, 0), 0.0).distances_m[0] == pytest.approx(4, abs=1e-4)
    assert cast(caster, (0, 10, 1), (0, -1, 0), 0.0).distances_m[0] == pytest.approx(8, abs=1e-4)


@pytest.mark.parametrize(("speed_mps", "label"), [(0.0, CAR), (0.29, CAR), (0.31, PHANTOM), (12.0, PHANTOM)])
def test_what_moves_faster_than_the_threshold_is_a_phantom(speed_mps, label):
    caster = SceneCaster(Scene(ground(), [straight(car(), (0, 0, 0), (speed_mps, 0, 0))]), 0.0, 10.0)
    hits = cast(caster, (5, 0, 1), (-1, 0, 0), 0.0)
    assert caster.labels_at(hits, np.zeros(1))[0] == label
    assert caster.speeds_mps(hits, np.zeros(1))[0] == pytest.approx(speed_mps)
    assert caster.instances[hits.faces[0]] == 7


def test_an_actor_is_a_phantom_only_while_it_moves():
    actor = Actor(car(), np.array([0.0, 1.0, 2.0]), np.array([[0, 0, 0], [0, 0, 0], [5.0, 0, 0]]), np.zeros(3))
    caster = SceneCaster(Scene(ground(), [actor]), 0.0, 5.0)
    times = np.array([0.5, 1.5, 3.0])
    hits = caster.cast(np.tile([20.0, 0, 1], (3, 1)), np.tile(np.float32([-1, 0, 0]), (3, 1)), times)
    assert caster.labels_at(hits, times).tolist() == [CAR, PHANTOM, CAR]
    np.testing.assert_allclose(hits.distances_m, [18, 15.5, 13], atol=1e-4)


def test_what_stands_still_during_the_span_is_static_and_seen_the_same():
    actor = Actor(car(), np.array([0.0, 10.0, 20.0]), np.array([[0, 0, 0], [50.0, 0, 0], [50, 0, 0]]), np.zeros(3))
    caster = SceneCaster(Scene(ground(), [actor]), 11.0, 19.0)
    assert caster.moving == []
    assert cast(caster, (60, 0, 1), (-1, 0, 0), 15.0).distances_m[0] == pytest.approx(8, abs=1e-4)


def test_the_nearest_of_all_surfaces_wins():
    wall = box((3, -5, 0), (3.2, 5, 3), Surface(FACADE, "brick", (0, 0, 0)))
    moving = [straight(car(1), (8, 0, 0), (0, 1, 0)), straight(car(2), (-6, 0, 0), (0, 1, 0))]
    caster = SceneCaster(Scene(join_meshes([ground(), wall]), moving), 0.0, 1.0)
    east, west = cast(caster, (0, 0, 1), (1, 0, 0)), cast(caster, (0, 0, 1), (-1, 0, 0))
    assert caster.labels_at(east, np.zeros(1))[0] == FACADE
    assert east.distances_m[0] == pytest.approx(3, abs=1e-4)
    assert caster.instances[west.faces[0]] == 2
    assert west.distances_m[0] == pytest.approx(4, abs=1e-4)


def test_rays_in_a_crowd_hit_what_a_frozen_world_shows():
    rng = np.random.default_rng(1)
    actors = [
        straight(car(i + 1), (*rng.uniform(-30, 30, 2), 0), (*rng.uniform(-9, 9, 2), 0), rng.uniform(0, 6), duration_s=5.0)
        for i in range(12)
    ]
    scene = Scene(ground(), actors)
    n = 400
    origins = np.c_[rng.uniform(-5, 5, (n, 2)), np.full(n, 2.0)]
    directions = np.c_[rng.normal(size=(n, 2)), rng.uniform(-0.3, 0.0, n)].astype(np.float32)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    times = rng.uniform(0, 5, n)
    hits = SceneCaster(scene, 0, 5).cast(origins, directions, times)
    # Ray by ray into a static world made for the ray's time: no fans, no gallery.
    expected = np.empty(n, np.float32)
    for i in range(n):
        standing = [
            Actor(a.mesh, np.array([0.0, 1.0]), np.repeat(a.pose_at(times[i : i + 1])[0], 2, axis=0), np.full(2, a.yaws_rad[0]))
            for a in actors
        ]
        frozen = SceneCaster(Scene(ground(), standing), 0, 1, n_threads=1)
        expected[i] = frozen.cast(origins[i : i + 1], directions[i : i + 1], np.zeros(1)).distances_m[0]
    assert (hits.actors >= 0).sum() > n / 20
    np.testing.assert_allclose(hits.distances_m, expected, atol=2e-4)


def test_threads_change_nothing():
    scene = Scene(ground(), [straight(car(), (0, 0, 0), (5, 0, 0))])
    rays = np.tile([20.0, 0, 1], (1000, 1)), np.tile(np.float32([-1, 0, 0]), (1000, 1)), np.linspace(0, 1, 1000)
    one, all_cores = (SceneCaster(scene, 0, 5, n_threads=k).cast(*rays) for k in (1, 0))
    np.testing.assert_array_equal(one.distances_m, all_cores.distances_m)
