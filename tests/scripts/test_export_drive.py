import logging

import cv2
import numpy as np
import pytest
import yaml
from toy_recordings import SCHEMA, START_NS, kitti_facts, png, revolution, write_facts, write_kitti

from scripts.export_drive import main
from scripts.import_drive import main as import_main
from streetscan import geometry
from streetscan.errors import BadInput
from streetscan.frames import CameraImage, LidarFrame
from streetscan.io import kitti, trajectories
from streetscan.io.exports import CONTENTS, KEPT
from streetscan.io.images import encode_png
from streetscan.io.mcap import iterate_drive, iterate_lidar, open_drive_writer, read_metadata, read_topics
from streetscan.io.pcd_sequence import read_pcd_columns


@pytest.fixture
def drive(tmp_path):
    folder = write_kitti(tmp_path / "data" / "drive")
    (folder / "labels").mkdir()
    for i in range(5):
        (folder / "labels" / f"{i:06d}.label").write_bytes(np.arange(360, dtype="<u4").tobytes())
    facts = kitti_facts()
    facts["truth"]["labels"] = {"files": "labels/*.label", "ids": "semantickitti"}
    path = write_facts(tmp_path / "data" / "toy.yaml", facts)
    import_main(path, SCHEMA, tmp_path / "data", "toy", tmp_path / "drive.mcap", tmp_path / "frames.csv", tmp_path / "truth")
    return tmp_path


def test_kitti_odometry_with_truth(drive):
    main(drive / "drive.mcap", drive / "out", "kitti_odometry", drive / "truth")
    for i in range(5):
        points, intensity = kitti.read_scan(drive / "out" / "velodyne" / f"{i:06d}.bin")
        np.testing.assert_array_equal(points, revolution(seed=i)[0])
        np.testing.assert_array_equal(intensity, revolution(seed=i)[1])
        assert (drive / "out" / "image_2" / f"{i:06d}.png").read_bytes() == png(i)
        assert kitti.read_labels(drive / "out" / "labels" / f"{i:06d}.label").tolist() == list(range(360))
    assert kitti.read_times(drive / "out" / "times.txt").tolist() == [i * 100_000_000 for i in range(5)]
    # poses.txt are those of the camera; brought back to the lidar they are the truth from its first frame on.
    T = kitti.read_rigid(drive / "out" / "calib.txt", "Tr")
    lidar = geometry.invert(T) @ trajectories.read_kitti_poses(drive / "out" / "poses.txt") @ T
    truth = trajectories.read_poses_csv(drive / "truth" / "poses.csv")[2]
    np.testing.assert_allclose(lidar, geometry.invert(truth[0]) @ truth, atol=1e-5)
    assert kitti.read_camera(drive / "out" / "calib.txt", 2, 64, 32)[0].K[0, 0] == 50


def test_what_a_format_with_one_place_of_the_camera_cannot_tell_is_said_to_be_lost(drive, caplog):
    path = drive / "truth" / "truth.yaml"
    truth = yaml.safe_load(path.read_text())
    truth["extrinsics"]["shift"] = {"from_image_time_ns": START_NS, "T_camera_lidar": np.eye(4).tolist()}
    path.write_text(yaml.safe_dump(truth))
    with caplog.at_level(logging.WARNING, "streetscan"):
        main(drive / "drive.mcap", drive / "out", "kitti_odometry", drive / "truth")
    assert "shifted extrinsics 1" in {" ".join(line.split()) for line in caplog.text.splitlines()}


def test_an_export_is_imported_again(drive):
    main(drive / "drive.mcap", drive / "data" / "again", "kitti_odometry", drive / "truth")
    facts = {
        "description": "d", "source": "s", "reader": "folder", "root": "again", "rate_hz": 10,
        "lidar": {"files": "velodyne/*.bin", "times": "times.txt"},
        "truth": {"poses": {"format": "kitti", "file": "poses.txt", "lidar_to_camera": {"file": "calib.txt", "key": "Tr"}, "source": "s"}},
    }  # fmt: skip
    path = write_facts(drive / "data" / "again.yaml", facts)
    import_main(path, SCHEMA, drive / "data", "again", drive / "b.mcap", drive / "b.csv", drive / "b_truth")
    for a, b in zip(iterate_lidar(drive / "drive.mcap"), iterate_lidar(drive / "b.mcap"), strict=True):
        np.testing.assert_array_equal(a.points, b.points)
        np.testing.assert_allclose(a.time_offset_s, b.time_offset_s, atol=1e-7)


def test_pcd_sequence(drive):
    main(drive / "drive.mcap", drive / "out", "pcd_sequence", first=1, n_frames=2)
    assert sorted(p.name for p in (drive / "out").iterdir()) == ["000000.pcd", "000001.pcd", "times.txt"]
    columns = read_pcd_columns(drive / "out" / "000000.pcd")
    points, intensity, times = revolution(seed=1)
    np.testing.assert_array_equal(np.stack([columns[a] for a in "xyz"], axis=1), points)
    np.testing.assert_array_equal(columns["intensity"], intensity)
    np.testing.assert_allclose(columns["time_offset_s"], times, atol=1e-6)
    assert kitti.read_times(drive / "out" / "times.txt").tolist() == [START_NS + 100_000_000, START_NS + 200_000_000]


def test_mcap_of_a_part(drive):
    main(drive / "drive.mcap", drive / "part.mcap", "mcap", first=2, n_frames=2)
    records = list(iterate_drive(drive / "part.mcap"))
    assert [r.time_ns for r in records if isinstance(r, LidarFrame)] == [START_NS + i * 100_000_000 for i in (2, 3)]
    assert {type(r).__name__ for r in records} == {"LidarFrame", "CameraImage", "CameraModel", "GpsFix", "Mounting"}


def test_what_is_dropped_is_said(drive, caplog):
    with caplog.at_level(logging.WARNING, "streetscan"):
        main(drive / "drive.mcap", drive / "out", "kitti_odometry", drive / "truth")
    assert "kitti_odometry has no place for" in caplog.text
    lines = {" ".join(line.split()) for line in caplog.text.splitlines()}
    assert {"firing times 5", "image stamps 5", "gps 5", "mounting 1"} <= lines
    caplog.clear()
    with caplog.at_level(logging.WARNING, "streetscan"):
        main(drive / "drive.mcap", drive / "b.mcap", "mcap")
    assert "no place" not in caplog.text


def test_where_a_drive_comes_from_is_kept_or_said_to_be_lost(tmp_path, caplog):
    with open_drive_writer(tmp_path / "d.mcap") as writer:
        writer.write_lidar(LidarFrame(START_NS, *revolution(seed=0)[:2]))
        writer.write_metadata("streetscan", {"drive": "d", "description": "a street", "source": "us, CC0", "n_ok": "1"})
    with caplog.at_level(logging.WARNING, "streetscan"):
        for format in ("kitti_odometry", "pcd_sequence"):
            caplog.clear()
            main(tmp_path / "d.mcap", tmp_path / format, format)
            assert "origin 1" in {" ".join(line.split()) for line in caplog.text.splitlines()}
        caplog.clear()
        main(tmp_path / "d.mcap", tmp_path / "copy.mcap", "mcap")
    assert "origin" not in caplog.text
    assert read_metadata(tmp_path / "copy.mcap", "streetscan") == {"drive": "d", "description": "a street", "source": "us, CC0"}


def test_every_format_speaks_of_the_same_contents():
    for kept in KEPT.values():
        assert set(kept) <= set(CONTENTS)


def test_nothing_of_truth_without_asking(drive):
    main(drive / "drive.mcap", drive / "out", "kitti_odometry")
    assert {p.name for p in (drive / "out").iterdir()} == {"velodyne", "image_2", "times.txt", "calib.txt"}
    assert "Tr" not in (drive / "out" / "calib.txt").read_text()


def test_further_cameras_stay_in_mcap_and_are_said_to_be_lost_elsewhere(tmp_path, caplog):
    with open_drive_writer(tmp_path / "d.mcap") as writer:
        writer.write_lidar(LidarFrame(START_NS, *revolution()[:2]))
        for i, camera in enumerate(("camera", "camera_2", "camera_3")):
            writer.write_image(CameraImage(START_NS + i, png(i), "png", camera=camera))
    with caplog.at_level(logging.WARNING, "streetscan"):
        main(tmp_path / "d.mcap", tmp_path / "out", "kitti_odometry")
    assert "further cameras 2" in {" ".join(line.split()) for line in caplog.text.splitlines()}
    assert [p.read_bytes() for p in (tmp_path / "out" / "image_2").iterdir()] == [png(0)]
    main(tmp_path / "d.mcap", tmp_path / "copy.mcap", "mcap")
    assert read_topics(tmp_path / "copy.mcap") == read_topics(tmp_path / "d.mcap")


def test_jpeg_becomes_png_and_goes_to_its_nearest_frame(tmp_path):
    pixels = np.full((8, 8, 3), 90, np.uint8)
    jpeg = cv2.imencode(".jpg", pixels)[1].tobytes()
    with open_drive_writer(tmp_path / "d.mcap") as writer:
        for i in range(3):
            writer.write_lidar(LidarFrame(START_NS + i * 100_000_000, *revolution(seed=i)[:2]))
            if i < 2:
                writer.write_image(CameraImage(START_NS + i * 100_000_000 + 70_000_000, jpeg, "jpeg"))
    main(tmp_path / "d.mcap", tmp_path / "out", "kitti_odometry")
    assert sorted(p.name for p in (tmp_path / "out" / "image_2").iterdir()) == ["000001.png", "000002.png"]
    assert np.abs(cv2.imread(str(tmp_path / "out" / "image_2" / "000001.png")).astype(int) - 90).max() <= 2
    assert encode_png(pixels[..., 0])[:4] == b"\x89PNG"


def test_a_fast_camera_gives_each_frame_its_nearest_image(tmp_path, caplog):
    with open_drive_writer(tmp_path / "d.mcap") as writer:
        for i in range(31):
            writer.write_image(CameraImage(START_NS + i * 10_000_000 + 1, png(i), "png"))
            if i % 10 == 0:
                writer.write_lidar(LidarFrame(START_NS + i * 10_000_000, *revolution(seed=i)[:2]))
    with caplog.at_level(logging.WARNING, "streetscan"):
        main(tmp_path / "d.mcap", tmp_path / "out", "kitti_odometry")
    for number in range(4):
        assert (tmp_path / "out" / "image_2" / f"{number:06d}.png").read_bytes() == png(number * 10)
    assert "further images 27" in {" ".join(line.split()) for line in caplog.text.splitlines()}


@pytest.mark.parametrize(("format", "first", "found"), [("ply", 0, "choose one of"), ("pcd_sequence", 9, "no lidar frame")])
def test_what_cannot_be_exported(drive, format, first, found):
    with pytest.raises(BadInput, match=found):
        main(drive / "drive.mcap", drive / "out", format, first=first)
    assert not (drive / "out").exists()


def test_statuses_and_dates_that_are_lost_are_said(drive, caplog):
    rows = (drive / "frames.csv").read_text().splitlines()
    rows[2] = rows[2].replace(",ok,", ",partial,", 1)
    (drive / "frames.csv").write_text("\n".join(rows))
    for format, expected in (("kitti_odometry", {"date 5", "frame status 1"}), ("pcd_sequence", {"frame status 1"})):
        caplog.clear()
        with caplog.at_level(logging.WARNING, "streetscan"):
            main(drive / "drive.mcap", drive / "out", format)
        lines = {" ".join(line.split()) for line in caplog.text.splitlines()}
        assert expected <= lines
        assert ("date 5" in lines) == (format == "kitti_odometry")
