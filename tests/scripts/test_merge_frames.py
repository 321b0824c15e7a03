"""merge_frames on a tiny drive: the street is a map."""

import cv2
import numpy as np

from scripts import import_map
from streetscan.clouds import check_points
from streetscan.io.las import read_las


def test_merged_street_is_a_map(registered_drive, tmp_path):
    folder = registered_drive.folder
    tiles = [read_las(path) for path in sorted((folder / "tiles").glob("*.laz"))]
    n_points = sum(len(t) for t in tiles)
    assert n_points > 10_000
    for tile in tiles:
        check_points(tile.points, "tile")
        assert set(np.unique(tile.fields["grid_class"])) <= {1, 3}
        assert 4 not in tile.fields["frame"]
    reader = {
        "format": "las", "fields": {"intensity": "intensity", "time_s": "time_s"}, "label": None, "label_suffix": None,
        "intensity_range": None, "offset_m": [0, 0, 0], "spacing_m": 0,
    }  # fmt: skip
    facts = {"name": "street", "title": "Street", "source": "merge", "truth": "none", "reader": reader, "parts": {"all": {"n_tiles": 1}}}
    import_map.main([str(folder / "tiles")], str(tmp_path / "map.laz"), str(tmp_path / "labels.npy"), facts)
    imported = read_las(tmp_path / "map.laz")
    assert len(imported) == n_points
    assert set(imported.fields) >= {"intensity", "time_s"}
    assert "grid_class" not in imported.fields


def test_picture_and_elevation(registered_drive):
    image = cv2.imread(str(registered_drive.folder / "street.png"))
    assert image.shape == (900, 1600, 3)
    assert 0.02 < (image != 255).any(axis=2).mean() < 1
    assert "NODATA_value" in (registered_drive.folder / "elevation.asc").read_text()
