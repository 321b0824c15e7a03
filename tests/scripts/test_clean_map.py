import numpy as np
import pytest

from scripts.clean_map import main
from streetscan.clouds import PointCloud
from streetscan.errors import BadInput
from streetscan.io.las import read_las, write_las

STATIC = ["ground", "facade", "vegetation", "column", "furniture"]


@pytest.fixture
def labelled_maps(tiny_world, tmp_path):
    """The tiny street in two parts with its true labels as predictions."""
    cloud = tiny_world.cloud
    fields = {**cloud.fields, "label": tiny_world.labels, "confidence": np.full(len(cloud), 0.5, np.float32)}
    labelled = PointCloud(cloud.points, fields, cloud.crs)
    half = np.arange(len(cloud)) < len(cloud) // 2
    paths = [tmp_path / "map_0of2.laz", tmp_path / "map_1of2.laz"]
    for path, part in zip(paths, (half, ~half), strict=True):
        write_las(path, labelled.select(part))
    return paths


def test_only_static_points_stay(tiny_world, labelled_maps, tmp_path):
    main(labelled_maps, tmp_path / "static.laz", STATIC)
    static = read_las(tmp_path / "static.laz")
    is_static = np.isin(tiny_world.labels, [0, 1, 6, 7, 8])
    np.testing.assert_allclose(static.points, tiny_world.cloud.points[is_static], atol=1e-6)
    np.testing.assert_array_equal(static.fields["label"], tiny_world.labels[is_static])
    np.testing.assert_array_equal(static.fields["rgb"], tiny_world.cloud.fields["rgb"][is_static])
    assert static.crs == "EPSG:23700"


def test_nothing_static_is_an_empty_map(labelled_maps, tmp_path):
    main(labelled_maps, tmp_path / "static.laz", [])
    assert len(read_las(tmp_path / "static.laz")) == 0


def test_a_typing_error_leaves_nothing(labelled_maps, tmp_path):
    with pytest.raises(BadInput, match="'grond'"):
        main(labelled_maps, tmp_path / "static.laz", ["grond"])
    assert not (tmp_path / "static.laz").exists()
