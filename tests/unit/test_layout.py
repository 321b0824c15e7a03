import zlib
from itertools import combinations, pairwise
from pathlib import Path

import numpy as np
import open3d as o3d
import pytest
import yaml
from scipy.spatial import cKDTree

from streetscan import classes
from streetscan.errors import BadInput
from streetscan.simulation import shapes, terrain
from streetscan.simulation.blocks import Plan, plan_block
from streetscan.simulation.layout import build_street, count_blocks
from streetscan.simulation.meshes import triangle_areas


@pytest.fixture(scope="module")
def tiny():
    return {split: build_street(28.0, split, 0) for split in ("train", "validation", "test")}


@pytest.fixture(scope="module")
def designs():
    """Base shape and design of everything that stands or moves in each split's street."""
    drawn, make = {}, shapes.make_object
    with pytest.MonkeyPatch.context() as patch:
        for split in ("train", "validation", "test"):
            used = drawn[split] = set()

            def make_and_note(name, design, rng, used=used):
                used.add((name, design))
                return make(name, design, rng)

            patch.setattr(shapes, "make_object", make_and_note)
            build_street(28.0, split, 0)
    return drawn


@pytest.fixture(scope="module")
def city():
    return build_street(120.0, "train", 1, traffic_density=0.6)


def centre_xy(mesh):
    return mesh.vertices[mesh.triangles].mean(axis=1)[:, :2]


def near_roads(scene, mesh, reach_m):
    distances, _ = cKDTree(np.concatenate(scene.roads)[:, :2]).query(centre_xy(mesh))
    return distances < reach_m


def test_tiny_street_holds_every_class_within_sight_of_the_road(tiny):
    for split, scene in tiny.items():
        near = near_roads(scene, scene.static, 16)
        areas = triangle_areas(scene.static)
        for label in set(range(classes.N_CLASSES)) - {classes.PHANTOM}:
            assert areas[near & (scene.static.labels == label)].sum() > 3, (split, classes.NAMES[label])
        # What moves becomes phantom.
        start, end = 0.0, 3.0
        moving = [a for a in scene.actors if a.speed_at(np.array([start, end])).max() > 1.0]
        places = np.array([a.pose_at(np.array([1.5]))[0][0] for a in moving])
        distances, _ = cKDTree(np.concatenate(scene.roads)[:, :2]).query(places[:, :2])
        assert (distances < 12).sum() >= 3, split


def test_splits_share_no_place_no_instance_and_no_facade(tiny):
    ids = {
        s: set(np.unique(c.static.instances)) - {0} | {i for a in c.actors for i in np.unique(a.mesh.instances)} for s, c in tiny.items()
    }
    for a, b in (("train", "validation"), ("train", "test"), ("validation", "test")):
        assert not ids[a] & ids[b]
        # No triangle of one facade has the side lengths of the other's facades in bulk: compare sorted areas of whole houses.
        houses = []
        for split in (a, b):
            mesh = tiny[split].static
            is_facade = mesh.labels == classes.FACADE
            areas = triangle_areas(mesh)
            houses.append({round(float(areas[is_facade & (mesh.instances == i)].sum()), 3) for i in np.unique(mesh.instances[is_facade])})
        assert not houses[0] & houses[1]
        boxes = [tiny[s].static.vertices for s in (a, b)]
        assert np.linalg.norm(boxes[0].mean(axis=0) - boxes[1].mean(axis=0)) > 1000


def test_splits_share_no_design_of_what_stands_or_moves(designs):
    for a, b in combinations(designs, 2):
        assert not designs[a] & designs[b]
    for used in designs.values():
        names = {name for name, _ in used}
        # The layout's standing objects and the traffic's moving ones have both gone through the same door.
        assert names & set(shapes.LAMPS)
        assert names & set(shapes.WALKERS)
        assert "cyclist" in names


def test_same_seed_gives_the_same_street_and_another_seed_another():
    a, b, c = (build_street(28.0, "train", seed, time_span_s=(0.0, 2.0)) for seed in (0, 0, 1))
    assert np.array_equal(a.static.vertices, b.static.vertices)
    assert np.array_equal(a.static.colours, b.static.colours)
    assert len(a.actors) == len(b.actors)
    assert all(np.array_equal(x.positions, y.positions) for x, y in zip(a.actors, b.actors, strict=True))
    assert len(a.static.vertices) != len(c.static.vertices)


@pytest.mark.parametrize("split", ["train", "validation", "test"])
def test_city_has_all_kinds_of_place_and_a_narrow_road(split):
    plan = plan_block(0, 0.0, 120.0, True, True, split, 1, 1.0, 30.0)
    kinds = {k for z in plan.zones for k in (z.left, z.right)}
    assert kinds == {"buildings", "square", "park", "bridge"}
    assert len(plan.crossings) == 1
    edges = [(z.s0, z.s1) for z in plan.zones]
    assert edges[0][0] == 0
    assert edges[-1][1] == 120
    assert all(a[1] == b[0] for a, b in pairwise(edges))


@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.parametrize("split", ["train", "validation", "test"])
def test_stops_of_the_city_have_shelters_and_signs_and_its_square_a_kiosk(split, seed):
    plan = plan_block(0, 0.0, 120.0, True, True, split, seed, 1.0, 30.0)
    assert [i.name for i in plan.items].count("bus_shelter") == len(plan.stops) == 2
    for side, stop in plan.stops:
        signs = [i for i in plan.items if i.name == "sign_single" and np.sign(i.t) == side and abs(abs(i.s - stop) - 4.5) < 1e-6]
        assert len(signs) == 1
    square, side = next((z, 1 if z.left == "square" else -1) for z in plan.zones if "square" in (z.left, z.right))
    assert any(i.name == "kiosk" and square.s0 < i.s < square.s1 and np.sign(i.t) == side for i in plan.items)


def test_what_touches_has_room_and_what_overlaps_has_none():
    half = shapes.HALF_SIZES_M["bus_shelter"][1]
    for start in np.random.default_rng(0).uniform(5, 100, 200):
        plan = Plan(0.0, 120.0, "train", np.random.default_rng(0))
        assert plan.add("bus_shelter", 60.0, start, 0.0, 0.0, gap=0.05)
        assert not plan.add("bus_shelter", 60.0, start + 2 * half + 0.05 - 1e-3, 0.0, np.pi)
        assert plan.add("bus_shelter", 60.0, start + 2 * half + 0.05, 0.0, np.pi)


def test_city_mesh_is_valid_and_not_too_large(city):
    mesh = city.static
    n = len(mesh.triangles)
    assert n < 2_000_000
    assert all(len(getattr(mesh, name)) == n for name in ("labels", "instances", "materials", "colours"))
    assert mesh.triangles.max() < len(mesh.vertices)
    assert np.isfinite(mesh.vertices).all()
    assert set(np.unique(mesh.labels)) == set(range(classes.N_CLASSES)) - {classes.PHANTOM} | {classes.UNLABELLED}
    # An instance is of one class.
    pairs = np.unique(np.stack([mesh.instances, mesh.labels]), axis=1)
    own = pairs[:, pairs[0] > 0]
    assert len(np.unique(own[0])) == own.shape[1]
    n_objects = {c: len(np.unique(mesh.instances[mesh.labels == c])) for c in range(9)}
    assert n_objects[classes.CAR] >= 15
    assert n_objects[classes.PEDESTRIAN] >= 20
    assert n_objects[classes.COLUMN] >= 30
    assert n_objects[classes.FURNITURE] >= 60
    assert n_objects[classes.TRAM_BUS] >= 2


def test_roads_lie_on_the_ground(city):
    assert len(city.roads) == 2
    assert city.speeds_kmh == [40.0, 30.0]
    assert city.crs == "EPSG:23700"
    ground = city.static.labels == classes.GROUND
    origin = city.roads[0][0]
    tree = o3d.t.geometry.RaycastingScene(nthreads=1)
    tree.add_triangles(
        o3d.core.Tensor((city.static.vertices - origin).astype(np.float32)),
        o3d.core.Tensor(city.static.triangles[ground].astype(np.uint32)),
    )
    for road in city.roads:
        up = np.concatenate([road - origin + [0, 0, 3.0], np.tile([0, 0, -1.0], (len(road), 1))], axis=1).astype(np.float32)
        depths = tree.cast_rays(o3d.core.Tensor(up))["t_hit"].numpy()
        assert np.abs(depths - 3.0).max() < 0.03


def test_lanes_of_the_mapping_vehicle_are_free_of_what_stands(city):
    mesh = city.static
    solid = ~np.isin(mesh.labels, (classes.GROUND, classes.UNLABELLED))
    points = mesh.vertices[mesh.triangles[solid]].mean(axis=1)
    for road in city.roads:
        direction = np.gradient(road, axis=0)[:, :2]
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        for side in (-1, 1):
            lane = road[:, :2] + side * city.lane_offset_m * np.stack([-direction[:, 1], direction[:, 0]], axis=1)
            distances, rows = cKDTree(lane).query(points[:, :2])
            height = points[:, 2] - road[rows, 2]
            assert not ((distances < 1.1) & (height < 3.0)).any()


def test_walls_reach_below_the_ground_and_objects_stand_on_it(city):
    mesh = city.static
    origin = city.roads[0][0]
    ground = mesh.triangles[mesh.labels == classes.GROUND]
    tree = o3d.t.geometry.RaycastingScene(nthreads=1)
    tree.add_triangles(o3d.core.Tensor((mesh.vertices - origin).astype(np.float32)), o3d.core.Tensor(ground.astype(np.uint32)))
    checked = 0
    for label in (classes.CAR, classes.PEDESTRIAN, classes.COLUMN, classes.FURNITURE, classes.FACADE):
        for instance in np.unique(mesh.instances[mesh.labels == label])[:40]:
            corners = mesh.vertices[mesh.triangles[mesh.instances == instance]].reshape(-1, 3)
            foot = corners[corners[:, 2] < corners[:, 2].min() + 0.05].mean(axis=0)
            ray = np.append(foot[:2] - origin[:2], [100.0, 0, 0, -1.0]).astype(np.float32)
            depth = float(tree.cast_rays(o3d.core.Tensor(ray[None]))["t_hit"].numpy()[0])
            ground_z = origin[2] + 100 - depth
            above = corners[:, 2].min() - ground_z
            if label == classes.FACADE:
                assert above < -0.3
            else:
                # Statues' and riders' parts aside, nothing floats: poles are let into the ground.
                assert -0.6 < above < 0.35, (classes.NAMES[label], instance, above)
            checked += 1
    assert checked > 100


def test_slopes_and_relief_of_a_long_street():
    axis = terrain.draw_axis(2600.0, 0.08, 50.0, (650_000.0, 240_000.0, 110.0), np.random.default_rng(0))
    s = np.arange(0, 2600.0, 1.0)
    z = axis.profile(s)
    assert 45 < np.ptp(z) < 60
    assert 0.06 < np.abs(np.gradient(z, s)).max() <= 0.0801
    # s is the arc length of the axis.
    xy = axis.to_map(s, 0 * s)[:, :2]
    assert np.abs(np.linalg.norm(np.diff(xy, axis=0), axis=1) - 1).max() < 0.01


def test_the_paper_size_city_climbs_fifty_metres_at_slopes_of_eight_per_cent():
    folder = Path(__file__).parents[2] / "config"
    facts = yaml.safe_load((folder / "datasets" / "city_paper.yaml").read_text())
    seed = yaml.safe_load((folder / "default.yaml").read_text())["seed"]
    street, heights, slopes = facts["simulation"]["street"], [], []
    for split, part in facts["parts"].items():
        rng = np.random.default_rng([seed, zlib.crc32(split.encode()), 10])
        axis = terrain.draw_axis(part["length_m"], street["max_slope"], street["relief_m"], (0.0, 0.0, 110.0), rng)
        s = np.arange(0, part["length_m"], 1.0)
        heights.append(np.ptp(axis.profile(s)))
        slopes.append(np.abs(np.gradient(axis.profile(s), s)).max())
    assert max(heights) > 50
    assert 0.07 < min(slopes) <= max(slopes) <= 0.0801


def test_street_coordinates_of_the_axis_start_and_sides():
    axis = terrain.draw_axis(100.0, 0.0, 0.0, (1000.0, 2000.0, 50.0), np.random.default_rng(3))
    start, left = axis.to_map(np.zeros(1), np.zeros(1))[0], axis.to_map(np.zeros(1), np.ones(1))[0]
    assert np.allclose(start[:2], [1000, 2000], atol=1e-6)
    yaw = float(axis.yaw_at(0.0))
    assert np.allclose(left[:2] - start[:2], [-np.sin(yaw), np.cos(yaw)], atol=1e-6)
    along, across = axis.slope_at(50.0, 0.0, 0.0)
    assert abs(along) < 0.01
    assert abs(across) < 0.03


def test_blocks_of_a_long_street_fit_together():
    settings = {
        "length_m": 360.0,
        "split": "test",
        "seed": 5,
        "max_slope": 0.08,
        "relief_m": 50.0,
        "time_span_s": (0.0, 1.0),
        "traffic_density": 0.3,
    }
    assert count_blocks(360.0) == 3
    first, second = (build_street(**settings, block=i) for i in (0, 1))
    assert np.allclose(first.roads[0][-1], second.roads[0][0])
    # An object of the margin is the same in both, and has the same id.
    shared = np.intersect1d(first.static.instances, second.static.instances)
    common = [i for i in shared if i > 0 and i % 100_000 > 999]
    assert len(common) > 20
    for i in common:
        a, b = (m.vertices[np.unique(m.triangles[m.instances == i])] for m in (first.static, second.static))
        assert np.array_equal(a, b)
    # Two blocks in one piece: their objects are those of each alone.
    both = build_street(**settings, block=(0, 1))
    assert np.allclose(both.roads[0][[0, -1]], [first.roads[0][0], second.roads[0][-1]])
    assert set(np.unique(first.static.instances[first.static.instances % 100_000 > 999])) <= set(np.unique(both.static.instances))
    # Blocks other than neighbours share nothing.
    third = build_street(**settings, block=2)
    ids = np.intersect1d(first.static.instances, third.static.instances)
    assert set(ids) <= {0}


def test_bad_settings_are_refused():
    with pytest.raises(BadInput, match="'dev' is unknown"):
        build_street(120.0, "dev", 0)
    with pytest.raises(BadInput, match="20 m or longer"):
        build_street(5.0, "train", 0)
    with pytest.raises(BadInput, match="slope"):
        build_street(120.0, "train", 0, max_slope=0.5)
    with pytest.raises(BadInput, match="block 3 of a street of 1 blocks"):
        build_street(120.0, "train", 0, block=3)
