import numpy as np
import pytest

from scripts.voxelize_map import main
from streetscan.errors import BadInput
from streetscan.io import las
from streetscan.voxels import VoxelGrid

GROUND = {"cell_m": 0.5, "max_object_m": 20.0, "max_slope": 0.15, "step_m": 0.2, "min_patch_m2": 4.0}


def test_voxels_of_the_tiny_street(tiny_world, tiny_map, tmp_path):
    main(tiny_map, tmp_path / "voxels.npz", size_m=0.1, ground=GROUND)
    grid = VoxelGrid.load(tmp_path / "voxels.npz")
    assert grid.counts.sum() == len(tiny_world.cloud)
    error = grid.height_m - (grid.mean_z_m - tiny_world.ground_z_m(grid.centres))
    assert np.percentile(np.abs(error), 95) < 0.05


def test_labels_are_never_seen(tiny_world, tiny_map, tmp_path):
    main(tiny_map, tmp_path / "a.npz", size_m=0.2, ground=GROUND)
    labels = np.load(tiny_map.parent / "truth" / "labels.npy")
    np.save(tiny_map.parent / "truth" / "labels.npy", labels[::-1])
    main(tiny_map, tmp_path / "b.npz", size_m=0.2, ground=GROUND)
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()


def test_a_missing_map_leaves_nothing(tmp_path):
    with pytest.raises(BadInput, match="no such file"):
        main(tmp_path / "map.laz", tmp_path / "voxels.npz", size_m=0.1, ground=GROUND)
    assert list(tmp_path.iterdir()) == []


def test_an_empty_map_is_refused(tmp_path):
    with las.open_las_writer(tmp_path / "map.laz"):
        pass
    with pytest.raises(BadInput, match="no point"):
        main(tmp_path / "map.laz", tmp_path / "voxels.npz", size_m=0.1, ground=GROUND)
