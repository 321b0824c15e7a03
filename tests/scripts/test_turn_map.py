"""scripts/turn_map.py on the tiny street."""

import numpy as np

from scripts import label_voxels, turn_map, voxelize_map
from streetscan.voxels import VoxelGrid

GROUND = {"cell_m": 0.5, "max_object_m": 20.0, "max_slope": 0.15, "step_m": 0.2, "min_patch_m2": 4.0}


def test_turned_map_has_every_class_in_every_copy(tiny_map, tmp_path):
    voxels, labels = tmp_path / "voxels.npz", tmp_path / "labels.npy"
    voxelize_map.main(tiny_map, voxels, 0.1, GROUND)
    label_voxels.main(tiny_map, tiny_map.parent / "truth" / "labels.npy", voxels, labels)
    turn_map.main(tiny_map, voxels, labels, tmp_path / "turned.npz", tmp_path / "turned.npy", n_yaws=2)
    turned, turned_labels = VoxelGrid.load(tmp_path / "turned.npz"), np.load(tmp_path / "turned.npy")
    grid, original = VoxelGrid.load(voxels), np.load(labels)
    assert len(turned) == len(turned_labels)
    assert turned.counts.sum() == 2 * grid.counts.sum()
    is_second = turned.keys[:, 0] > grid.keys[:, 0].max()
    shares = [np.bincount(part[part < 9], minlength=9) / len(part) for part in (original, turned_labels[is_second])]
    np.testing.assert_allclose(shares[0], shares[1], atol=0.03)
