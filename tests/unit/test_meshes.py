import numpy as np
import pytest

from streetscan.simulation.meshes import (
    Relief,
    Surface,
    box,
    ellipsoid,
    empty_mesh,
    join,
    loft,
    revolve,
    sample_surface,
    transform,
    triangle_areas,
    tube,
    with_instances,
)

STONE, GLASS = Surface(1, "stone", (10, 20, 30)), Surface(8, "glass", (200, 0, 0))


def volume(mesh):
    """Signed volume: positive when the triangles face outwards."""
    a, b, c = (mesh.vertices[mesh.triangles[:, i]] for i in range(3))
    return np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6


def test_solids_face_outwards_with_their_volume():
    assert volume(box((-1, 0, 2), (1, 3, 5), STONE)) == pytest.approx(18)
    assert triangle_areas(box((0, 0, 0), (1, 2, 3), STONE)).sum() == pytest.approx(22)
    assert volume(revolve(np.array([[1, 0], [1, 2.0]]), STONE, 200)) == pytest.approx(2 * np.pi, rel=1e-3)
    assert volume(ellipsoid((1, 2, 3), (5, 5, 5), STONE, 60, 60)) == pytest.approx(8 * np.pi, rel=0.01)
    for end in ([3.0, 0, 0], [0, 3.0, 0], [0, 0, 3.0], [-1.0, 2, 2]):
        assert abs(volume(tube(np.array([[0, 0, 0], end]), 0.5, STONE, 100))) == pytest.approx(0.75 * np.pi, rel=1e-2)
    square = np.array([[0, 0], [1, 0], [1, 1], [0, 1.0]])
    sections = np.stack([np.column_stack([square, np.full(4, z)]) for z in (0, 1, 4.0)])
    assert volume(loft(sections, STONE)) == pytest.approx(4)


def test_transform_shears_turns_and_moves():
    mesh = transform(box((0, 0, 0), (2, 1, 1), STONE), np.pi / 2, (10, 20, 30), slope=(0.1, 0))
    assert np.allclose(mesh.vertices.min(axis=0), [9, 20, 30])
    assert np.allclose(mesh.vertices.max(axis=0), [10, 22, 31.2])


def test_instances_count_one_per_class():
    mesh = join([box((0, 0, 0), (1, 1, 1), STONE), box((0, 0, 0), (1, 1, 1), GLASS)])
    numbered, following = with_instances(mesh, 50)
    assert following == 52
    assert [set(numbered.instances[numbered.labels == i]) for i in (1, 8)] == [{50}, {51}]
    assert not mesh.instances.any()


def test_samples_are_uniform_on_the_surface():
    points, rows = sample_surface(box((0, 0, 0), (1, 1, 4), STONE), 9000, np.random.default_rng(0))
    assert len(rows) == 9000
    on_face = np.isclose(points, 0) | np.isclose(points, [1, 1, 4])
    assert on_face.any(axis=1).all()
    # The two square ends have 2 of 18 square metres.
    assert np.isclose(on_face[:, 2].mean(), 2 / 18, atol=0.01)


@pytest.mark.parametrize("steps", [(np.inf, np.inf), (0.3, 0.7)])
def test_relief_of_one_raised_cell_has_its_walls(steps):
    relief = Relief((0, 4), (0, 3), 0.0, STONE)
    relief.paint(1, 2, 1, 2, 0.5, GLASS)
    relief.paint(3.5, 9, -5, 9, 0.0, STONE)
    mesh = relief.build(lambda a, b, d: np.stack([a, b, d], -1), steps)
    areas = triangle_areas(mesh)
    assert areas.sum() == pytest.approx(12 + 4 * 0.5)
    assert areas[mesh.labels == 8].sum() == pytest.approx(1 + 4 * 0.5)
    # Closed below, it is a solid whose triangles face outwards.
    bottom = np.array([[0, 0, 0], [0, 3, 0], [4, 3, 0], [4, 0, 0.0]])
    assert volume(mesh) - 0 == pytest.approx(0.5)
    assert np.allclose(mesh.vertices.min(axis=0), bottom.min(axis=0))


def test_relief_outside_its_borders_is_cut_off():
    relief = Relief((0, 1), (0, 1), 0.0, STONE)
    relief.paint(2, 3, 0, 1, 1.0, GLASS)
    assert len(relief.rectangles) == 1


def test_nothing_joined_is_nothing():
    assert len(join([]).triangles) == 0
    assert len(join([empty_mesh(), box((0, 0, 0), (1, 1, 1), STONE)]).triangles) == 12
