import numpy as np
import open3d as o3d

from streetscan import classes
from streetscan.simulation.appearance import MATERIAL_IDS
from streetscan.simulation.buildings import FOUNDATION_M, make_building, make_garden_wall


def cast(mesh, origins, direction):
    tree = o3d.t.geometry.RaycastingScene(nthreads=1)
    tree.add_triangles(o3d.core.Tensor(mesh.vertices.astype(np.float32)), o3d.core.Tensor(mesh.triangles.astype(np.uint32)))
    rays = np.concatenate([origins, np.broadcast_to(direction, origins.shape)], axis=1).astype(np.float32)
    hits = tree.cast_rays(o3d.core.Tensor(rays))
    return hits["t_hit"].numpy(), hits["primitive_ids"].numpy().astype(np.int64)


def test_front_has_no_holes_and_windows_lie_behind_the_wall():
    rng = np.random.default_rng(0)
    for seed in range(12):
        mesh = make_building(13.0, 12.0, (True, False), np.random.default_rng(seed))
        assert set(np.unique(mesh.labels)) == {classes.FACADE}
        top = mesh.vertices[:, 2].max()
        origins = np.stack([rng.uniform(0.05, 12.95, 3000), np.full(3000, -30.0), rng.uniform(-2, min(top, 6.0), 3000)], axis=1)
        distances, rows = cast(mesh, origins, [0, 1.0, 0])
        assert np.isfinite(distances).all()
        is_glass = mesh.materials[rows] == MATERIAL_IDS["glass"]
        assert 0.02 < is_glass.mean() < 0.6
        assert np.median(distances[is_glass]) > 30.05
        # Behind the glass is a room, not the sky.
        behind = origins[is_glass] + [0, 1, 0] * (distances[is_glass, None] + 0.01)
        inside, _ = cast(mesh, behind, [0, 1.0, 0])
        assert np.isfinite(inside).all()
        assert inside.max() > 2.5


def test_house_fills_its_plan_and_has_foundations():
    mesh = make_building(10.0, 12.0, (True, True), np.random.default_rng(1))
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    assert low[2] == -FOUNDATION_M
    assert -1.6 < low[0] < 0.01
    assert 9.99 < high[0] < 11.6
    assert -2.0 < low[1] < 0
    assert 11.99 < high[1] < 12.6


def test_houses_of_two_seeds_differ():
    sizes = {make_building(12.0, 12.0, (False, False), np.random.default_rng(i)).vertices[:, 2].max() for i in range(20)}
    assert len(sizes) == 20


def test_garden_wall_is_closed():
    mesh = make_garden_wall(4.0, np.random.default_rng(0))
    height = mesh.vertices[:, 2].max()
    assert 1.8 < height < 3.0
    x, z = np.random.default_rng(0).uniform([0.05, 0], [3.95, 1], (500, 2)).T
    distances, _ = cast(mesh, np.stack([x, np.full(500, -5.0), z * (height - 0.05)], axis=1), [0, 1.0, 0])
    assert np.isfinite(distances).all()
