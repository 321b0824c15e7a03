"""merge_frames on a tiny drive: the street is a map."""

import cv2
import numpy as np
from street_frames import SENSOR_HEIGHT_M
from toy_drives import RegisteredDrive, write_drive

from scripts import import_map, merge_frames, segment_frames
from streetscan.clouds import check_points
from streetscan.frames import Mounting
from streetscan.geometry import transform
from streetscan.io.las import read_las
from streetscan.io.mcap import iterate_lidar
from streetscan.registration.pose_tables import read_pose_table


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


def test_a_tilted_lidar_gives_the_same_street(registered_drive, tmp_path):
    """The same frames in the axes of a lidar that looks up by 45 degrees: poses are the lidar's, the street stands upright."""
    tilt = transform([0.8, 0.0, SENSOR_HEIGHT_M], [0, -np.pi / 4, 0])
    frames = [f.points @ tilt[:3, :3].astype(np.float32) for f in iterate_lidar(registered_drive.paths["drive_path"])]
    write_drive(tmp_path / "drive.mcap", frames, (Mounting("vehicle", "lidar", tilt),))
    tilted = RegisteredDrive(len(frames), tmp_path)
    segment_frames.main(
        **tilted.paths, summary_path=tmp_path / "classes.csv", timings_path=tmp_path / "grid.csv", grid={}, foot_method="reclassify",
        foot_m=0.1, outlier_neighbours=0,
    )  # fmt: skip
    tilted.register(tmp_path, target="street")
    merge_frames.main(
        **tilted.paths, poses_path=tmp_path / "poses.csv", tiles_folder=tmp_path / "tiles", elevation_path=tmp_path / "elevation.asc",
        picture_path=tmp_path / "street.png", classes=["ground", "tall_structure"], group_frames=3,
    )  # fmt: skip
    level = read_pose_table(registered_drive.folder / "poses.csv")
    for a, b in zip(level, read_pose_table(tmp_path / "poses.csv"), strict=True):
        assert a.status == b.status
        assert np.allclose(a.T_segment_lidar @ transform([0, 0, 0], [0, -np.pi / 4, 0]), b.T_segment_lidar, atol=0.02, equal_nan=True)
    heights = [
        np.concatenate([read_las(p).points[:, 2] for p in f.glob("*.laz")]) for f in (registered_drive.folder / "tiles", tmp_path / "tiles")
    ]
    assert np.allclose(*(np.percentile(z, [1, 50, 99]) for z in heights), atol=0.03)
