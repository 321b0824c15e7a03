import itertools

import numpy as np
import open3d as o3d
import pytest

from streetscan import classes
from streetscan.errors import BadInput
from streetscan.simulation import shapes
from streetscan.simulation.appearance import MATERIALS
from streetscan.simulation.meshes import Surface, box, make_mesh, sample_surface, triangle_areas

NAMES = [(kind, name) for kind, names in shapes.BASE_SHAPES.items() for name in names]


def make(name, design=0, seed=0):
    return shapes.make_object(name, design, np.random.default_rng(seed))


@pytest.mark.parametrize(("kind", "name"), NAMES)
def test_object_stands_on_the_ground_with_its_class_and_valid_triangles(kind, name):
    mesh = make(name)
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    assert -0.35 <= low[2] <= 0.1
    assert high[2] > 0.35
    # The origin lies within the footprint.
    assert (low[:2] < 0.1).all()
    assert (high[:2] > -0.1).all()
    assert classes.LABELS[kind] in mesh.labels
    extra = set(np.unique(mesh.labels)) - {classes.LABELS[kind]}
    assert extra <= {classes.COLUMN} if kind == "vegetation" else extra <= {classes.VEGETATION}
    assert mesh.triangles.min() >= 0
    assert mesh.triangles.max() < len(mesh.vertices)
    assert mesh.materials.max() < len(MATERIALS)
    assert np.isfinite(mesh.vertices).all()
    assert (triangle_areas(mesh) > 1e-12).mean() > 0.85


def test_every_object_class_has_five_base_shapes_and_no_other_class_has_any():
    assert set(shapes.BASE_SHAPES) == {c.name for c in classes.CLASSES if c.is_object and c.name != "phantom"}
    assert all(len(set(names)) >= 5 for names in shapes.BASE_SHAPES.values())


def hausdorff_m(a, b, size):
    """Hausdorff distance of two meshes scaled to one box: samples of each against the other's triangles."""
    scaled = [(m.vertices - m.vertices.min(axis=0)) / np.ptp(m.vertices, axis=0) * size for m in (a, b)]
    distances = []
    for i, j in ((0, 1), (1, 0)):
        tree = o3d.t.geometry.RaycastingScene(nthreads=1)
        triangles = (a, b)[j].triangles.astype(np.uint32)
        tree.add_triangles(o3d.core.Tensor(scaled[j].astype(np.float32)), o3d.core.Tensor(triangles))
        mesh = type(a)(scaled[i], *((a, b)[i].__dict__[n] for n in ("triangles", "labels", "instances", "materials", "colours")))
        points, _ = sample_surface(mesh, 800, np.random.default_rng(0))
        distances.append(tree.compute_distance(o3d.core.Tensor(points.astype(np.float32))).numpy().max())
    return max(distances)


def test_hausdorff_of_boxes_and_a_pyramid():
    metal = Surface(classes.FURNITURE, "metal", (90, 90, 90))
    cube, plank = box((0, 0, 0), (1, 1, 1), metal), box((0, 0, 0), (0.2, 3, 0.1), metal)
    base = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0.5, 0.5, 1]]
    pyramid = make_mesh(base, [[0, 2, 1], [0, 3, 2], [0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]], metal)
    # Scaled to one box, all boxes are one shape.
    assert hausdorff_m(cube, plank, [1.0, 1.0, 1.0]) < 1e-4
    # A cube's upper corner is sqrt(1/3) from the pyramid's edge; samples come near it, from below.
    assert hausdorff_m(cube, pyramid, [1.0, 1.0, 1.0]) == pytest.approx(np.sqrt(1 / 3), rel=0.1)


@pytest.mark.parametrize("kind", shapes.BASE_SHAPES)
def test_base_shapes_of_a_class_differ_by_more_than_a_decimetre_in_one_box(kind):
    meshes = {name: make(name, design=1, seed=5) for name in shapes.BASE_SHAPES[kind]}
    size = np.mean([np.ptp(m.vertices, axis=0) for m in meshes.values()], axis=0)
    for a, b in itertools.combinations(meshes, 2):
        assert hausdorff_m(meshes[a], meshes[b], size) > 0.10, f"{a} and {b} are the same shape"


@pytest.mark.parametrize("name", ["sedan", "tram_low_floor", "person_walking", "lamp_arm", "bench", "kiosk"])
def test_design_fixes_the_size_and_the_instance_varies_within_it(name):
    first, second, other = make(name, 3, 0), make(name, 3, 1), make(name, 4, 0)
    again = make(name, 3, 0)
    assert np.array_equal(first.vertices, again.vertices)
    assert np.array_equal(first.colours, again.colours)
    sizes = [np.ptp(m.vertices, axis=0) for m in (first, second, other)]
    assert not np.array_equal(first.vertices, second.vertices)
    assert abs(sizes[0][2] / sizes[1][2] - 1) < 0.08
    assert np.abs(sizes[0] / sizes[2] - 1).max() > 0.005


def test_splits_draw_from_disjoint_designs():
    drawn = {split: {shapes.draw_design(split, np.random.default_rng(i)) for i in range(200)} for split in shapes.DESIGNS}
    for a, b in itertools.combinations(drawn, 2):
        assert not drawn[a] & drawn[b]
    assert all(len(d) >= 15 for d in drawn.values())


def test_two_trees_of_one_design_do_not_share_a_leaf():
    a, b = make("lime", 0, 0), make("lime", 0, 1)
    leaves_a, leaves_b = (m.vertices[m.triangles[m.labels == classes.VEGETATION][-100:, 0]] for m in (a, b))
    assert np.linalg.norm(leaves_a[:, None] - leaves_b[None], axis=2).min() > 1e-6


def test_crown_lets_pulses_through_and_returns_at_several_depths():
    mesh = make("lime", 0, 0)
    tree = o3d.t.geometry.RaycastingScene(nthreads=1)
    tree.add_triangles(o3d.core.Tensor(mesh.vertices.astype(np.float32)), o3d.core.Tensor(mesh.triangles.astype(np.uint32)))
    crown = mesh.vertices[mesh.triangles[mesh.labels == classes.VEGETATION]].mean(axis=1)
    middle, half = crown.mean(axis=0), crown.std(axis=0)
    y, z = np.random.default_rng(0).uniform(-1, 1, (2, 2000))
    origins = np.stack([np.full(2000, -20.0), middle[1] + half[1] * y, middle[2] + half[2] * z], axis=1)
    rays = np.concatenate([origins, np.tile([1.0, 0, 0], (2000, 1))], axis=1).astype(np.float32)
    distances = tree.cast_rays(o3d.core.Tensor(rays))["t_hit"].numpy()
    hit = np.isfinite(distances)
    assert 0.3 < hit.mean() < 0.98
    assert distances[hit].std() > 0.3


def test_unknown_names_are_refused():
    with pytest.raises(BadInput, match="no base shape 'spaceship'"):
        make("spaceship")
    with pytest.raises(BadInput, match="'dev' is unknown"):
        shapes.draw_design("dev", np.random.default_rng(0))
