"""The step on the tiny street: every point and voxel labelled once over all groups of tiles."""

import numpy as np
import pytest

from scripts import label_map
from streetscan.classes import las_codes
from streetscan.errors import BadInput
from streetscan.io.label_tiles import read_label_tiles, read_labels_alone
from streetscan.io.las import read_crs, read_las
from streetscan.segmentation.c2cnn import C2CNN, Settings, save_network
from streetscan.voxels import voxelize


@pytest.fixture
def inputs(tiny_world, tiny_map, tmp_path):
    grid = voxelize([tiny_world.cloud.points], 0.2)
    grid.height_m = (grid.mean_z_m - tiny_world.ground_z_m(grid.centres)).astype(np.float32)
    grid.save(tmp_path / "voxels.npz")
    network_paths = [tmp_path / "weights.safetensors", tmp_path / "settings.yaml"]
    save_network(C2CNN(Settings(size_m=0.2, k=9, n_hidden=16), seed=1), *network_paths)
    return {"map_path": tiny_map, "voxels_path": tmp_path / "voxels.npz", "network_paths": network_paths}


def run(inputs, folder, tiles, expected=None, smoothing=None):
    expected = expected or {"k": 9, "n_hidden": 16}
    paths = folder / f"map_{tiles}.laz", folder / f"voxels_{tiles}.npz"
    outputs = {"labelled_map_path": paths[0], "labelled_voxels_path": paths[1]}
    settings = {"tile_m": 4.0, "n_turns": 1, "smoothing": smoothing, "n_threads": 1, "device": "cpu", "expected": expected}
    label_map.main(**inputs, **outputs, tiles=tiles, **settings)
    return paths


def test_points_keep_their_fields_and_gain_two(inputs, tiny_world, tmp_path):
    laz, npz = run(inputs, tmp_path / "out", "0of1")
    cloud, source = read_las(laz), tiny_world.cloud
    np.testing.assert_allclose(cloud.points, source.points, atol=1e-6)
    assert set(source.fields) | {"label", "confidence", "classification"} == set(cloud.fields)
    np.testing.assert_array_equal(cloud.fields["time_s"], source.fields["time_s"])
    np.testing.assert_array_equal(cloud.fields["classification"], las_codes(cloud.fields["label"]))
    assert cloud.fields["confidence"].dtype == np.float32
    assert read_crs(laz) == read_crs(inputs["map_path"])
    labels, confidence = read_label_tiles([npz], len(voxelize([source.points], 0.2)))
    assert ((confidence > 1 / 9) & (confidence <= 1)).all()
    assert labels.max() < 9


def test_groups_together_label_what_one_labels(inputs, tiny_world, tmp_path):
    n_voxels = len(voxelize([tiny_world.cloud.points], 0.2))
    parts = [run(inputs, tmp_path / "nine", f"{k}of9") for k in range(9)]
    whole = run(inputs, tmp_path / "one", "0of1")
    for a, b in zip(read_label_tiles([p[1] for p in parts], n_voxels), read_label_tiles([whole[1]], n_voxels), strict=True):
        np.testing.assert_array_equal(a, b)
    assert sum(len(read_las(p[0])) for p in parts) == len(tiny_world.cloud)


def test_a_smoothed_map_keeps_what_its_voxels_were_alone(inputs, tiny_world, tmp_path):
    n_voxels = len(voxelize([tiny_world.cloud.points], 0.2))
    _, smooth = run(inputs, tmp_path / "smooth", "0of1", smoothing={"cell_voxels": 2, "n_rounds": 4, "sharpness": 1.0})
    _, plain = run(inputs, tmp_path / "plain", "0of1")
    alone, smoothed = read_labels_alone([smooth], n_voxels), read_label_tiles([smooth], n_voxels)[0]
    np.testing.assert_array_equal(alone, read_label_tiles([plain], n_voxels)[0])
    assert (smoothed != alone).any()
    assert read_labels_alone([plain], n_voxels) is None


def test_nothing_is_left_behind_when_weights_do_not_fit(inputs, tmp_path):
    save_network(C2CNN(Settings(size_m=0.1, k=9)), *inputs["network_paths"])
    with pytest.raises(BadInput, match="other settings"):
        run(inputs, tmp_path / "out", "0of1")
    assert not (tmp_path / "out").exists()


def test_weights_of_other_channels_than_the_model_has_are_refused(inputs, tmp_path):
    with pytest.raises(BadInput, match="channels"):
        run(inputs, tmp_path / "out", "0of1", {"k": 9, "n_hidden": 16, "channels": ["occupancy"]})
    assert not (tmp_path / "out").exists()
