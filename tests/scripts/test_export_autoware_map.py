"""export_autoware_map: equal square tiles whose points lie in them, and a place for the large coordinates."""

import numpy as np
import pytest
import yaml

from scripts import export_autoware_map
from streetscan.clouds import PointCloud
from streetscan.errors import BadInput
from streetscan.io.las import write_las
from streetscan.io.pcd import read_pcd


def test_tiles_hold_all_points_once(tmp_path):
    rng = np.random.default_rng(0)
    points = np.round(rng.uniform(-35, 35, (5000, 3)) * [1, 1, 0.1] + [456_000, 5_428_000, 115], 3)
    write_las(tmp_path / "static.laz", PointCloud(points, {"intensity": np.arange(5000, dtype=np.uint16)}, "EPSG:32632"))
    export_autoware_map.main(tmp_path / "static.laz", tmp_path / "map", 20.0)
    metadata = yaml.safe_load((tmp_path / "map" / "pointcloud_map_metadata.yaml").read_text())
    assert metadata.pop("x_resolution") == metadata.pop("y_resolution") == 20
    origin = yaml.safe_load((tmp_path / "map" / "origin.yaml").read_text())
    assert origin["crs"] == "EPSG:32632"
    assert sorted(metadata) == sorted(p.name for p in (tmp_path / "map").glob("*.pcd"))
    assert not (tmp_path / "map" / "spool").exists()
    together = []
    for name, corner in metadata.items():
        tile = read_pcd(tmp_path / "map" / name)
        assert (tile.points[:, :2] >= np.array(corner) - 1e-3).all()
        assert (tile.points[:, :2] <= np.array(corner) + 20.001).all()
        together.append(np.c_[tile.points + [origin["x_m"], origin["y_m"], origin["z_m"]], tile.fields["intensity"]])
    together = np.concatenate(together)
    together = together[np.argsort(together[:, 3])]
    assert np.allclose(together[:, :3], points, atol=1e-3)


def test_an_empty_map_and_an_edge_of_nothing_are_refused(tmp_path):
    write_las(tmp_path / "static.laz", PointCloud(np.empty((0, 3))))
    with pytest.raises(BadInput, match="holds no point"):
        export_autoware_map.main(tmp_path / "static.laz", tmp_path / "map", 20.0)
    with pytest.raises(BadInput, match="tile_m"):
        export_autoware_map.main(tmp_path / "static.laz", tmp_path / "map", 0.0)
