import numpy as np
import pytest

from scripts.label_voxels import main
from streetscan.errors import BadInput
from streetscan.voxels import voxelize


def test_labels_of_the_tiny_street(tiny_world, tiny_map, tmp_path):
    grid = voxelize([tiny_world.cloud.points], 0.1)
    grid.save(tmp_path / "voxels.npz")
    main(tiny_map, tiny_map.parent / "truth" / "labels.npy", tmp_path / "voxels.npz", tmp_path / "labels.npy")
    labels = np.load(tmp_path / "labels.npy")
    assert labels.dtype == np.uint8
    assert len(labels) == len(grid)
    assert set(np.unique(labels)) == {*range(9), 255}
    own = labels[grid.find(grid.keys_of(tiny_world.cloud.points))]
    assert (own == tiny_world.labels)[tiny_world.labels != 255].mean() > 0.98


def test_a_map_without_truth_has_no_labels(tiny_world, tiny_map, tmp_path):
    voxelize([tiny_world.cloud.points], 0.5).save(tmp_path / "voxels.npz")
    np.save(tmp_path / "none.npy", np.full(len(tiny_world.labels), 255, np.uint8))
    main(tiny_map, tmp_path / "none.npy", tmp_path / "voxels.npz", tmp_path / "labels.npy")
    assert (np.load(tmp_path / "labels.npy") == 255).all()


def test_voxels_of_another_map_are_refused(tiny_world, tiny_map, tmp_path):
    voxelize([tiny_world.cloud.points[:1000]], 0.1).save(tmp_path / "voxels.npz")
    with pytest.raises(BadInput, match="no voxel at"):
        main(tiny_map, tiny_map.parent / "truth" / "labels.npy", tmp_path / "voxels.npz", tmp_path / "labels.npy")
    assert not (tmp_path / "labels.npy").exists()
