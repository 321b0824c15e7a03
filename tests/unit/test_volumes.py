"""Pictures of training volumes: telling cubes, the voxel in question red, density from green to red."""

import numpy as np

from streetscan.benchmarks.volumes import choose_volumes, density_colours, draw_volumes
from streetscan.classes import CAR, GROUND, PHANTOM
from streetscan.voxels import VoxelGrid


def make_scene():
    """A floor with a car at one end and a phantom at the other."""
    floor = np.stack(np.meshgrid(np.arange(80), np.arange(20), [0], indexing="ij"), axis=-1).reshape(-1, 3)
    box = np.stack(np.meshgrid(np.arange(10), np.arange(8), np.arange(1, 8), indexing="ij"), axis=-1).reshape(-1, 3)
    keys = np.concatenate([floor, box + [5, 5, 0], box + [60, 5, 0]]).astype(np.int32)
    labels = np.repeat([GROUND, CAR, PHANTOM], [len(floor), len(box), len(box)]).astype(np.uint8)
    counts = np.repeat([20, 30, 2], [len(floor), len(box), len(box)]).astype(np.uint32)
    order = np.lexsort(keys.T[::-1])
    height = (0.1 * keys[order, 2]).astype(np.float32)
    return VoxelGrid(np.zeros(3), 0.1, keys[order], counts[order], height.astype(np.float64), height), labels[order]


def test_one_volume_of_each_shown_class_that_sees_more_than_itself():
    grid, labels = make_scene()
    rows = choose_volumes(grid, labels, 11)
    assert [int(labels[r]) for r in rows] == [PHANTOM, CAR]
    for row in rows:
        near = (np.abs(grid.keys - grid.keys[row]) <= 5).all(axis=1)
        assert GROUND in labels[near]


def test_a_map_of_ground_alone_has_no_volume():
    grid, labels = make_scene()
    assert choose_volumes(grid, np.zeros_like(labels), 11) == []
    draw_volumes(grid, np.zeros_like(labels), 11)


def test_the_voxel_in_question_is_red():
    grid, labels = make_scene()
    figure = draw_volumes(grid, labels, 11)
    pictures = [np.asarray(axes.images[0].get_array()) for axes in figure.axes if axes.images]
    assert len(pictures) == 4
    headings = [axes.get_title(loc="left") for axes in figure.axes if axes.get_title(loc="left")]
    assert headings[0].startswith("Phantom: ")
    # Eye-dome lighting darkens edges; the hue stays.
    by_class = pictures[0].astype(int)
    assert ((by_class[..., 0] > 100) & (by_class[..., 1] == 0) & (by_class[..., 2] == 0)).any()


def test_density_goes_from_green_to_red():
    sparse, _, dense = density_colours(np.array([1, 5, 40])).tolist()
    assert sparse == [0, 204, 0]
    assert dense == [255, 0, 0]
    assert density_colours(np.array([1, 1])).tolist() == [[0, 204, 0]] * 2
