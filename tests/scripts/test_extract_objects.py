import geopandas
import numpy as np
import pytest

from scripts.extract_objects import main
from streetscan.io.label_tiles import write_label_tile
from streetscan.segmentation.ground import add_heights
from streetscan.segmentation.samples import vote_labels
from streetscan.voxels import voxelize

GROUND = {"cell_m": 0.5, "max_object_m": 20.0, "max_slope": 0.15, "step_m": 0.2, "min_patch_m2": 4.0}


@pytest.fixture
def label_map(tiny_world, tmp_path):
    """The tiny street's voxels and, in two parts, their true labels as predictions."""
    points = tiny_world.cloud.points
    grid = add_heights(voxelize([points], 0.1), **GROUND)
    grid.save(tmp_path / "voxels.npz")
    labels = vote_labels(grid, [(points, tiny_world.labels)])
    labels[labels == 255] = 0
    parts = np.array_split(np.arange(len(grid)), 2)
    paths = [tmp_path / "voxels_0of2.npz", tmp_path / "voxels_1of2.npz"]
    for path, rows in zip(paths, parts, strict=True):
        write_label_tile(path, rows, labels[rows], np.full(len(rows), 0.75))
    return tmp_path / "voxels.npz", paths


def test_objects_of_the_tiny_street(tiny_world, tiny_map, label_map, tmp_path):
    main(tiny_map, *label_map, tmp_path / "objects.gpkg", class_names=["car", "tram_bus", "pedestrian", "column"], min_voxels=30)
    layer = geopandas.read_file(tmp_path / "objects.gpkg", layer="objects")
    assert layer["class"].value_counts().to_dict() == {"column": 3, "car": 2, "pedestrian": 2, "tram_bus": 1}
    assert layer.crs.to_epsg() == 23700
    assert layer["id"].is_unique
    cars = layer[layer["class"] == "car"]
    np.testing.assert_allclose(cars["length_m"], 4.2, atol=0.3)
    np.testing.assert_allclose(cars["width_m"], 1.8, atol=0.3)
    np.testing.assert_allclose(cars["yaw_rad"], np.radians(30), atol=0.05)
    np.testing.assert_allclose(cars["base_m"], 0.25, atol=0.12)
    np.testing.assert_allclose(layer["confidence"], 0.75)
    middles = geopandas.points_from_xy(layer["x_m"], layer["y_m"], crs=layer.crs)
    assert layer.geometry.contains(geopandas.GeoSeries(middles)).all()
    # No time of writing in the file.
    main(tiny_map, *label_map, tmp_path / "again.gpkg", class_names=["car", "tram_bus", "pedestrian", "column"], min_voxels=30)
    assert (tmp_path / "again.gpkg").read_bytes() == (tmp_path / "objects.gpkg").read_bytes()


def test_no_object_is_a_valid_layer(tiny_map, label_map, tmp_path):
    main(tiny_map, *label_map, tmp_path / "objects.gpkg", class_names=["car"], min_voxels=10**6)
    layer = geopandas.read_file(tmp_path / "objects.gpkg", layer="objects")
    assert len(layer) == 0
    assert layer.crs.to_epsg() == 23700
    assert {"id", "class", "length_m", "geometry"} <= set(layer.columns)
