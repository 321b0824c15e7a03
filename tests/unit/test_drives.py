import csv
import lzma

import cv2
import laspy
import numpy as np
import pandas as pd
import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from toy_recordings import ROOT, SCHEMA, START_NS, Messages, kitti_facts, png, revolution, ros_store, write_bag, write_facts, write_kitti

from streetscan import geometry
from streetscan.datasets import load_dataset
from streetscan.drives import FRAME_COLUMNS, Recording, import_drive, read_drive_facts
from streetscan.errors import BadInput
from streetscan.frames import STATUSES, CameraImage, CameraModel, LidarFrame
from streetscan.inspection import inspect_drive, project_points
from streetscan.io.mcap import iterate_drive, iterate_lidar, open_drive_writer
from streetscan.io.pcd_sequence import write_pcd_frame
from streetscan.io.trajectories import read_poses_csv
from streetscan.simulation.drives import read_simulation


def run(tmp_path, facts):
    recording = Recording(read_drive_facts(write_facts(tmp_path / "toy.yaml", facts), SCHEMA), tmp_path)
    counts = import_drive(recording, "toy", tmp_path / "drive.mcap", tmp_path / "frames.csv", tmp_path / "truth")
    return counts, pd.read_csv(tmp_path / "frames.csv")


@pytest.fixture
def kitti(tmp_path):
    return write_kitti(tmp_path / "drive")


def test_a_whole_drive(tmp_path, kitti):
    counts, frames = run(tmp_path, kitti_facts())
    assert counts == {"ok": 5}
    assert tuple(frames) == FRAME_COLUMNS
    assert frames["n_points"].tolist() == [360] * 5
    np.testing.assert_allclose(frames["time_s"] - START_NS * 1e-9, np.arange(5) * 0.1, atol=1e-6)
    assert (frames["image_time_s"] == frames["time_s"]).all()
    for i, frame in enumerate(iterate_lidar(tmp_path / "drive.mcap")):
        points, intensity, times = revolution(seed=i)
        assert frame.time_ns == START_NS + i * 100_000_000
        np.testing.assert_array_equal(frame.points, points)
        np.testing.assert_array_equal(frame.intensity, intensity)
        np.testing.assert_allclose(frame.time_offset_s, times, atol=1e-6)


def test_truth_stays_apart(tmp_path, kitti):
    run(tmp_path, kitti_facts())
    # Neither a pose nor the camera's place: /tf holds the one mounting the user gave.
    records = list(iterate_drive(tmp_path / "drive.mcap"))
    kinds = {type(r).__name__ for r in records}
    assert kinds == {"LidarFrame", "CameraImage", "CameraModel", "GpsFix", "Mounting"}
    assert [r.child for r in records if type(r).__name__ == "Mounting"] == ["lidar"]
    assert {f.name for f in (tmp_path / "truth").iterdir()} == {"poses.csv", "poses.tum", "truth.yaml"}


def test_true_poses_are_those_of_the_lidar_in_the_grid(tmp_path, kitti):
    run(tmp_path, kitti_facts())
    _, _, poses = read_poses_csv(tmp_path / "truth" / "poses.csv")
    steps = np.diff(poses[:, :2, 3], axis=0)
    # One frame is 1/73000 degree of longitude at 49 degrees north: almost exactly a metre to the east.
    np.testing.assert_allclose(np.linalg.norm(steps, axis=1), 1.0, atol=0.01)
    # The imu's yaw is 0 against true east; the grid's own east differs by the meridian convergence of -0.45 degrees.
    yaw = geometry.rpy_of_transform(poses)[0, 2]
    assert np.degrees(yaw) == pytest.approx((8.4 - 9) * np.sin(np.radians(49)), abs=1e-3)
    # T_lidar_imu = (-0.8, 0.3, -0.8): the lidar is 0.8 m above the imu.
    assert poses[0, 2, 3] == pytest.approx(110.8, abs=1e-6)


def test_everything_wrong_at_once_is_counted(tmp_path, kitti):
    scans, images = kitti / "velodyne_points" / "data", kitti / "image_02" / "data"
    (scans / "0000000001.bin").write_bytes((scans / "0000000001.bin").read_bytes()[:-5])
    (scans / "0000000002.bin").unlink()
    (scans / "0000000003.bin").write_bytes(b"")
    (images / "0000000004.png").unlink()
    (images / "0000000000.png").write_bytes(png(0)[:-30])
    counts, frames = run(tmp_path, kitti_facts())
    assert frames["status"].tolist() == ["ok", "truncated", "missing", "empty", "ok"]
    assert counts == {"ok": 2, "truncated": 1, "missing": 1, "empty": 1}
    assert frames["n_points"].tolist() == [360, 0, 0, 0, 360]
    assert frames["image_status"].tolist() == ["unreadable", "ok", "ok", "ok", "missing"]
    assert [len(f) for f in iterate_lidar(tmp_path / "drive.mcap")] == [360, 0, 0, 0, 360]


def test_points_without_coordinates_are_left_out_and_counted(tmp_path, kitti):
    points, intensity, _ = revolution()
    points[3], points[7, 1] = np.nan, np.inf
    np.c_[points, intensity].astype(np.float32).tofile(kitti / "velodyne_points" / "data" / "0000000000.bin")
    _, frames = run(tmp_path, kitti_facts())
    assert (frames["n_points"][0], frames["n_dropped"][0]) == (358, 2)


def test_time_running_backwards_is_said_and_kept(tmp_path, kitti):
    path = kitti / "velodyne_points" / "timestamps.txt"
    lines = path.read_text().splitlines()
    lines[2], lines[3] = lines[3], lines[2]
    path.write_text("\n".join(lines))
    _, frames = run(tmp_path, kitti_facts())
    assert frames["status"].tolist() == ["ok", "ok", "ok", "time_backwards", "ok"]
    assert frames["n_points"].tolist() == [360] * 5


def test_labels_stay_with_their_points(tmp_path, kitti):
    points, intensity, _ = revolution()
    points[3] = np.nan
    np.c_[points, intensity].astype(np.float32).tofile(kitti / "velodyne_points" / "data" / "0000000000.bin")
    (kitti / "labels").mkdir()
    labels = np.arange(360, dtype="<u4")
    (kitti / "labels" / "000000.label").write_bytes(labels.tobytes())
    (kitti / "labels" / "000001.label.xz").write_bytes(lzma.compress(labels.tobytes()))
    (kitti / "labels" / "000002.label").write_bytes(labels[:-1].tobytes())
    facts = kitti_facts()
    facts["truth"]["labels"] = {"files": "labels/*.label", "ids": "semantickitti"}
    _, frames = run(tmp_path, facts)
    assert frames["status"].tolist() == ["ok", "ok", "labels_do_not_fit", "ok", "ok"]
    np.testing.assert_array_equal(np.load(tmp_path / "truth" / "labels" / "000000.npy"), np.delete(labels, 3))
    np.testing.assert_array_equal(np.load(tmp_path / "truth" / "labels" / "000001.npy"), labels)
    assert not (tmp_path / "truth" / "labels" / "000002.npy").exists()


def test_a_de_skewed_recording_has_one_time(tmp_path, kitti):
    facts = kitti_facts()
    facts["lidar"]["points"] = "de_skewed"
    _, frames = run(tmp_path, facts)
    assert (frames[["first_offset_s", "last_offset_s"]] == 0).all(axis=None)


def test_starts_and_ends_of_revolutions_are_used(tmp_path, kitti):
    folder = kitti / "velodyne_points"
    lines = (folder / "timestamps.txt").read_text().splitlines()
    for name, shift in (("timestamps_start.txt", -0.06), ("timestamps_end.txt", 0.04)):
        (folder / name).write_text("\n".join(str(pd.Timestamp(line) + pd.Timedelta(shift, "s")) for line in lines))
    facts = kitti_facts()
    facts["lidar"] |= {"times_start": "velodyne_points/timestamps_start.txt", "times_end": "velodyne_points/timestamps_end.txt"}
    _, frames = run(tmp_path, facts)
    np.testing.assert_allclose(frames[["first_offset_s", "last_offset_s"]], [[-0.06, 0.04]] * 5, atol=3e-4)


def test_only_the_wanted_frames(tmp_path, kitti):
    _, frames = run(
        tmp_path,
        kitti_facts(frames=[1, 3, 7]) | {"lidar": {"files": "velodyne_points/data/*.bin"}, "camera": {"files": "image_02/data/*.png"}},
    )
    assert frames["number"].tolist() == [1, 3, 7]
    assert frames["status"].tolist() == ["ok", "ok", "missing"]


@pytest.mark.parametrize("suffix", [".pcd", ".laz"])
def test_other_scans(tmp_path, suffix):
    (tmp_path / "drive").mkdir()
    for i in range(3):
        points, intensity, times = revolution(seed=i)
        if suffix == ".pcd":
            frame = LidarFrame(0, points, intensity, np.full(360, i, np.uint16), times.astype(np.float32))
            write_pcd_frame(tmp_path / "drive" / f"{i:06d}.pcd", frame)
        else:
            las = laspy.LasData(laspy.LasHeader(version="1.4", point_format=6))
            las.header.scales = [0.001] * 3
            las.x, las.y, las.z = points.T.astype(float)
            las.intensity = np.round(intensity * 65535)
            las.write(tmp_path / "drive" / f"{i:06d}.laz")
    facts = {"description": "d", "source": "s", "reader": "folder", "root": "drive", "rate_hz": 10, "lidar": {"files": f"*{suffix}"}}
    facts["lidar"]["intensity_max"] = 65535 if suffix == ".laz" else 1
    counts, _ = run(tmp_path, facts)
    assert counts == {"ok": 3}
    for i, frame in enumerate(iterate_lidar(tmp_path / "drive.mcap")):
        points, intensity, times = revolution(seed=i)
        np.testing.assert_allclose(frame.points, points, atol=1e-3)
        np.testing.assert_allclose(frame.intensity, intensity, atol=1e-4)
        np.testing.assert_allclose(frame.time_offset_s, times, atol=1e-4)
        assert frame.time_ns == i * 100_000_000


def test_damaged_scans_of_every_kind_are_counted(tmp_path):
    (tmp_path / "drive").mkdir()
    points, intensity, times = revolution()
    frame = LidarFrame(0, points, intensity, None, times.astype(np.float32))
    for i in range(4):
        write_pcd_frame(tmp_path / "drive" / f"{i}.pcd", frame)
    (tmp_path / "drive" / "1.pcd").write_bytes((tmp_path / "drive" / "1.pcd").read_bytes()[:-40])
    (tmp_path / "drive" / "2.pcd").write_bytes(b"")
    text = (tmp_path / "drive" / "3.pcd").read_bytes().replace(b"FIELDS x y z", b"FIELDS a b c")
    (tmp_path / "drive" / "3.pcd").write_bytes(text)
    facts = {"description": "d", "source": "s", "reader": "folder", "root": "drive", "rate_hz": 10, "lidar": {"files": "*.pcd"}}
    _, frames = run(tmp_path, facts)
    assert frames["status"].tolist() == ["ok", "truncated", "unreadable", "unreadable"]


def test_files_named_by_their_time(tmp_path):
    (tmp_path / "drive").mkdir()
    points, intensity, times = revolution()
    for i in range(3):
        write_pcd_frame(
            tmp_path / "drive" / f"{START_NS + i * 100_000_001}.pcd", LidarFrame(0, points, intensity, None, times.astype(np.float32))
        )
    lidar = {"files": "*.pcd", "times": "file_names"}
    counts, _ = run(tmp_path, {"description": "d", "source": "s", "reader": "folder", "root": "drive", "rate_hz": 10, "lidar": lidar})
    assert counts == {"ok": 3}
    assert [f.time_ns for f in iterate_lidar(tmp_path / "drive.mcap")] == [START_NS + i * 100_000_001 for i in range(3)]


def test_range_images(tmp_path):
    (tmp_path / "drive").mkdir()
    (tmp_path / "drive" / "config.txt").write_text("500 36 2 180 -180 -2 10\n")
    for i in range(2):
        cv2.imwrite(str(tmp_path / "drive" / f"{i}.png"), np.full((2, 36), 5000, np.uint16))
    lacking = np.full((2, 36), 5000, np.uint16)
    lacking[:, 10:14] = 0
    cv2.imwrite(str(tmp_path / "drive" / "2.png"), lacking)
    lidar = {"files": "*.png", "layout": "config.txt"}
    facts = {"description": "d", "source": "s", "reader": "folder", "root": "drive", "rate_hz": 10, "lidar": lidar}
    counts, frames = run(tmp_path, facts)
    assert counts == {"ok": 2, "partial": 1}
    assert frames["n_points"].tolist() == [72, 72, 64]
    frame = next(iterate_lidar(tmp_path / "drive.mcap"))
    assert frame.intensity is None
    assert frame.ring.max() == 1


def test_a_bag(tmp_path):
    make, items = Messages(ros_store()), []
    for i in range(3):
        points, intensity, _ = revolution(seed=i)
        columns = {"x": points[:, 0], "y": points[:, 1], "z": points[:, 2], "intensity": intensity * 255}
        stamp = START_NS + i * 100_000_000
        items += [("/points", stamp, make.cloud(stamp, columns)), ("/fix", stamp, make.fix(stamp, 49.0, 8.4, 1.0))]
        if i != 1:
            items.append(("/image", stamp, make.compressed(stamp + 40_000_000, png(i))))
    write_bag(tmp_path / "bag", items)
    calibration = {"width": 64, "height": 32, "K": [50, 0, 31.5, 0, 50, 15.5, 0, 0, 1]}
    facts = {
        "description": "d", "source": "s", "reader": "bag", "root": "bag", "rate_hz": 10,
        "lidar": {"topic": "/points", "stamp": "start", "intensity_max": 255},
        "camera": {"topic": "/image", "stamp_offset_s": 0.01, "calibration": calibration},
        "gps": {"topic": "/fix"},
    }  # fmt: skip
    counts, frames = run(tmp_path, facts)
    assert counts == {"ok": 3}
    assert frames["image_status"].tolist() == ["ok", "missing", "ok"]
    np.testing.assert_allclose(frames["image_time_s"][[0, 2]], frames["time_s"][[0, 2]], atol=1e-6)
    assert next(iterate_lidar(tmp_path / "drive.mcap")).intensity.max() <= 1


def test_a_bag_whose_first_message_is_the_cameras(tmp_path):
    """Intrinsics before the first cloud, and again with every image: written once, at the time of what follows."""
    make, items = Messages(ros_store()), []
    for i in range(3):
        points, _, _ = revolution(seed=i)
        stamp = START_NS + i * 100_000_000
        items.append(("/info", stamp, make.camera_info(stamp, "equidistant", [0.01, 0.0, 0.0, 0.0])))
        items.append(("/points", stamp, make.cloud(stamp, {"x": points[:, 0], "y": points[:, 1], "z": points[:, 2]})))
        items.append(("/image", stamp, make.compressed(stamp, png(i))))
    write_bag(tmp_path / "bag", items)
    facts = {
        "description": "d", "source": "s", "reader": "bag", "root": "bag", "rate_hz": 10, "lidar": {"topic": "/points"},
        "camera": {"topic": "/image", "info_topic": "/info"},
        "mounting": [{"parent": "vehicle", "child": "lidar", "xyz_m": [0.8, 0, 1.7], "rpy_deg": [0, 0, 0], "source": "tape"}],
    }  # fmt: skip
    assert run(tmp_path, facts)[0] == {"ok": 3}
    records = list(iterate_drive(tmp_path / "drive.mcap"))
    assert [type(r).__name__ for r in records[:2]] == ["Mounting", "CameraModel"]
    models = [r for r in records if isinstance(r, CameraModel)]
    assert len(models) == 1
    # ROS calls this model of a fisheye lens by another name.
    assert models[0].distortion_model == "kannala_brandt"
    with (tmp_path / "drive.mcap").open("rb") as stream:
        assert make_reader(stream).get_summary().statistics.message_start_time == START_NS


def test_damaged_labels_leave_the_frame(tmp_path, kitti):
    (kitti / "labels").mkdir()
    for i in range(5):
        (kitti / "labels" / f"{i:06d}.label").write_bytes(np.arange(360, dtype="<u4").tobytes()[: -2 if i == 2 else None])
    facts = kitti_facts()
    facts["truth"]["labels"] = {"files": "labels/*.label", "ids": "semantickitti"}
    assert run(tmp_path, facts)[0] == {"ok": 4, "labels_do_not_fit": 1}


def test_nothing_is_left_when_the_truth_cannot_be_written(tmp_path, kitti, monkeypatch):
    def fail(*_):
        raise OSError("No space left on device")

    monkeypatch.setattr("streetscan.drives.trajectories.write_tum", fail)
    with pytest.raises(OSError, match="No space"):
        run(tmp_path, kitti_facts())
    assert {p.name for p in tmp_path.iterdir()} == {"drive", "toy.yaml"}


def test_a_drive_is_imported_as_it_is(tmp_path, kitti):
    run(tmp_path, kitti_facts())
    (tmp_path / "drive.mcap").rename(tmp_path / "copy.mcap")
    facts = {
        "description": "d", "source": "s", "reader": "mcap", "root": "copy.mcap", "rate_hz": 10, "lidar": {"topic": "/lidar"},
        "camera": {"topic": "/camera/image", "info_topic": "/camera/calibration"}, "gps": {"topic": "/gps"},
    }  # fmt: skip
    counts, _ = run(tmp_path, facts)
    assert counts == {"ok": 5}
    for a, b in zip(iterate_lidar(tmp_path / "copy.mcap"), iterate_lidar(tmp_path / "drive.mcap"), strict=True):
        assert a.time_ns == b.time_ns
        np.testing.assert_array_equal(a.points, b.points)
        np.testing.assert_array_equal(a.time_offset_s, b.time_offset_s)


@pytest.mark.parametrize(
    ("change", "found"),
    [
        ({"root": "elsewhere"}, "no such file or folder"),
        ({"lidar": {"files": "scans/*.bin"}}, "right data set"),
        ({"lidar": {"files": "velodyne_points/data/*.xyz"}}, "right data set"),
        ({"lidar": {"files": "velodyne_points/data/*.bin", "times": "oxts/data/0000000000.txt"}}, "no list of times"),
        ({"camera": {"files": "image_02/data/*.png", "calibration": {"file": "calib_velo_to_cam.txt", "camera": 2}}}, "no line 'P2:'"),
        ({"gps": {"format": "oxts", "files": "image_02/data"}}, r"gps\.files"),
        ({"crs": "EPSG:4326"}, "projected"),
        ({"camera": {"files": "image_02/data/*.png", "calibration": {"width": 1, "height": 1, "K": [0] * 9}}}, "no camera matrix"),
        (
            {"truth": {"extrinsics": {"lidar_to_camera": {"xyz_m": [0, 0, 0], "rotation": [2, 0, 0, 0, 1, 0, 0, 0, 1]}, "source": "s"}}},
            "no rotation",
        ),
        ({"truth": {"poses": {"format": "tum", "file": "none.tum", "source": "s"}}}, "no such file"),
    ],
)
def test_what_cannot_be_read_is_said_and_leaves_nothing(tmp_path, kitti, change, found):
    with pytest.raises(BadInput, match=found):
        run(tmp_path, kitti_facts(**change))
    assert not (tmp_path / "drive.mcap").exists()
    assert not (tmp_path / "frames.csv").exists()
    assert {p.name for p in tmp_path.iterdir()} == {"drive", "toy.yaml"}


def test_not_one_usable_frame(tmp_path, kitti):
    for path in (kitti / "velodyne_points" / "data").iterdir():
        path.write_bytes(b"12345")
    with pytest.raises(BadInput, match=r"not one usable frame \(5 truncated"):
        run(tmp_path, kitti_facts())


@pytest.mark.parametrize(
    ("change", "found"),
    [
        ({"reader": "magic"}, "reader"),
        ({"rate_hz": "10"}, "rate_hz"),
        ({"rate_hz": 0}, "rate_hz"),
        ({"lidar": {"file": "*.bin"}}, "file"),
        ({"lidar": {}}, r"lidar\.files is missing"),
        ({"lidar": {"files": "*.bin", "topic": "/points"}}, r"lidar\.topic"),
        ({"lidar": {"files": "*.bin", "times_start": "t"}}, "times_start"),
        ({"reader": "pcap", "lidar": {"model": "vlp16"}}, "section camera"),
        ({"mounting": [{"parent": "vehicle", "child": "lidar", "xyz_m": [0, 0], "rpy_deg": [0, 0, 0], "source": ""}]}, "xyz_m"),
        ({"truth": {"poses": {"format": "kitti", "source": "s"}}}, r"truth\.poses\.file"),
        ({"crs": None}, "crs"),
        ({"rate_hz": float("nan")}, "rate_hz is no finite number"),
        ({"start_time_s": 1.5e18}, "start_time_s"),
        ({"camera": {"files": "*.png", "stamp_offset_s": float("inf")}}, r"camera\.stamp_offset_s is no finite number"),
        (
            {"mounting": [{"parent": "vehicle", "child": "lidar", "xyz_m": [0, 0, float("nan")], "rpy_deg": [0, 0, 0], "source": ""}]},
            r"0\.xyz_m\.2",
        ),
        ({"camera": {"files": "*.png", "info_topic": "/info"}}, r"camera\.info_topic"),
    ],
)
def test_wrong_keys_are_named(tmp_path, change, found):
    with pytest.raises(BadInput, match=found):
        read_drive_facts(write_facts(tmp_path / "toy.yaml", kitti_facts(**change)), SCHEMA)


@pytest.mark.parametrize("key", ["root", "camera", "gps", "frames"])
def test_what_a_simulated_drive_would_not_read_is_refused(tmp_path, key):
    facts = yaml.safe_load((ROOT / "config" / "drives" / "city_tiny_main_road.yaml").read_text())
    facts[key] = {"root": "drive", "camera": {"n_keyframes": 3}, "gps": {"topic": "/fix"}, "frames": [1]}[key]
    with pytest.raises(BadInput, match=f"a key {key}; remove it"):
        read_drive_facts(write_facts(tmp_path / "toy.yaml", facts), SCHEMA)


def test_a_recording_is_not_simulated(tmp_path):
    simulation = yaml.safe_load((ROOT / "config" / "drives" / "city_tiny_main_road.yaml").read_text())["simulation"]
    with pytest.raises(BadInput, match="a section simulation beside reader 'folder'"):
        read_drive_facts(write_facts(tmp_path / "toy.yaml", kitti_facts(simulation=simulation)), SCHEMA)


def test_no_yaml_at_all(tmp_path):
    (tmp_path / "toy.yaml").write_text("a: [")
    with pytest.raises(BadInput, match="YAML"):
        read_drive_facts(tmp_path / "toy.yaml", SCHEMA)


@pytest.mark.parametrize(
    ("change", "found"),
    [
        ({"D": [0.1, 0.2, 0.3]}, r"D = \[0\.1, 0\.2, 0\.3\] for distortion model 'plumb_bob'; give 0 or 4 or 5"),
        ({"D": [0.1] * 5, "distortion_model": "kannala_brandt"}, "give 0 or 4 finite"),
        ({"K": [50, 0, 32, 0, 50, 16, 0, 0, 2]}, "no camera matrix"),
    ],
)
def test_a_calibration_that_is_none(tmp_path, kitti, change, found):
    calibration = {"width": 64, "height": 32, "K": [50, 0, 31.5, 0, 50, 15.5, 0, 0, 1]} | change
    with pytest.raises(BadInput, match=rf"toy\.yaml, camera\.calibration: .*{found}"):
        run(tmp_path, kitti_facts(camera={"files": "image_02/data/*.png", "calibration": calibration}))


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("frame,time_s\n0,1\n1,\n2,3\n3,4\n4,5\n", "row 1 holds no time_s"),
        ("frame,time_s\n0,1\n2,2\n3,3\n4,4\n5,5\n", "does not count"),
        ("1\n2\nnan\n4\n5\n", "NaN"),
    ],
)
def test_lists_of_times_that_are_none(tmp_path, kitti, text, found):
    (kitti / "times.csv").write_text(text)
    with pytest.raises(BadInput, match=rf"times\.csv: no list of times .*{found}"):
        run(tmp_path, kitti_facts(lidar={"files": "velodyne_points/data/*.bin", "times": "times.csv"}))


def test_a_list_of_times_with_a_byte_order_mark(tmp_path, kitti):
    (kitti / "times.txt").write_bytes(b"\xef\xbb\xbf1\n2\n3\n4\n5\n")
    _, frames = run(tmp_path, kitti_facts(lidar={"files": "velodyne_points/data/*.bin", "times": "times.txt"}))
    assert frames["time_s"].tolist() == [1, 2, 3, 4, 5]


def test_revolutions_that_end_before_they_start(tmp_path, kitti):
    for name, offset in (("middle", 0.0), ("start", 0.05), ("end", -0.05)):
        (kitti / f"{name}.txt").write_text("".join(f"{1 + i + offset}\n" for i in range(5)))
    lidar = {"files": "velodyne_points/data/*.bin", "times": "middle.txt", "times_start": "start.txt", "times_end": "end.txt"}
    with pytest.raises(BadInput, match="row 0 of the three lists is not in the order start, forward, end"):
        run(tmp_path, kitti_facts(lidar=lidar))


@pytest.mark.parametrize("path", sorted((ROOT / "config" / "drives").rglob("*.yaml")), ids=lambda p: p.stem)
def test_every_drives_file_fits_the_schema(path):
    assert read_drive_facts(path, SCHEMA).rate_hz > 0


def test_inspection_finds_the_gap(tmp_path):
    write_kitti(tmp_path / "drive", 6)
    path = tmp_path / "drive" / "velodyne_points" / "timestamps.txt"
    lines = path.read_text().splitlines()
    path.write_text("\n".join(lines[:3] + [line.replace("00:00:00", "00:00:02") for line in lines[3:]]))
    run(tmp_path, kitti_facts())
    found = inspect_drive(tmp_path / "drive.mcap", tmp_path / "frames.csv", tmp_path / "truth")
    assert found.gaps["after"].tolist() == [2]
    assert found.gaps["duration_s"].iloc[0] == pytest.approx(2.1, abs=1e-6)
    numbers = found.numbers()
    assert numbers["frames"] == "6 (6 ok)"
    assert numbers["points in all"] == "2,160"
    assert numbers["GPS track"] == "5.0 m"
    assert sorted(found.pictured) == [0, 1, 2] or len(found.pictured) == 3
    assert len(found.images) == 3


def test_inspection_of_another_table(tmp_path, kitti):
    run(tmp_path, kitti_facts())
    rows = list(csv.reader((tmp_path / "frames.csv").open()))
    with (tmp_path / "frames.csv").open("w", newline="") as stream:
        csv.writer(stream).writerows(rows[:-1])
    with pytest.raises(BadInput, match="4 rows for 5 frames"):
        inspect_drive(tmp_path / "drive.mcap", tmp_path / "frames.csv", None)


def test_a_point_is_projected_by_hand():
    from streetscan.frames import CameraModel

    model = CameraModel(64, 32, np.array([[50.0, 0, 31.5], [0, 50, 15.5], [0, 0, 1]]), np.zeros(0), "plumb_bob", np.eye(3, 4))
    T = geometry.transform_of_rotation(np.array([[0, -1, 0], [0, 0, -1], [1, 0, 0]]))
    points = np.array([[10.0, 2, 1], [-10, 0, 0], [10, 100, 0], [10.0, 0, 0]])
    pixels, depths = project_points(points, T, model)
    np.testing.assert_allclose(pixels, [[21.5, 10.5], [31.5, 15.5]])
    np.testing.assert_allclose(depths, 10)
    assert len(project_points(np.empty((0, 3)), T, model)[0]) == 0


# A part of the usual number of examples: each one writes and reads files. A profile with more scales along.
@settings(max_examples=settings.default.max_examples // 3, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_damaged_folders(tmp_path, data):
    if not (tmp_path / "drive").exists():
        write_kitti(tmp_path / "drive", 3, 40)
    targets = sorted(p for p in (tmp_path / "drive").rglob("*") if p.is_file())
    target = data.draw(st.sampled_from(targets))
    original = target.read_bytes()
    damaged = bytearray(original)
    for _ in range(data.draw(st.integers(1, 8))):
        damaged[data.draw(st.integers(0, len(damaged) - 1))] = data.draw(st.integers(0, 255))
    target.write_bytes(damaged[: data.draw(st.one_of(st.just(len(damaged)), st.integers(0, len(damaged))))])
    try:
        counts, frames = run(tmp_path, kitti_facts())
        assert sum(counts.values()) == len(frames) == 3
        assert set(frames["status"]) <= set(STATUSES)
    except BadInput:
        pass
    finally:
        target.write_bytes(original)


def test_file_numbers_are_respected_however_sparse(tmp_path):
    (tmp_path / "drive" / "image").mkdir(parents=True)
    points, intensity, _ = revolution(20)
    for i in range(301):
        np.c_[points, intensity].astype(np.float32).tofile(tmp_path / "drive" / f"{i:06d}.bin")
    for i in (0, 300):
        (tmp_path / "drive" / "image" / f"{i:06d}.png").write_bytes(png(i))
    facts = {"description": "d", "source": "s", "reader": "folder", "root": "drive", "rate_hz": 10, "lidar": {"files": "*.bin"}}
    _, frames = run(tmp_path, facts | {"camera": {"files": "image/*.png"}})
    assert np.flatnonzero(frames["image_status"] == "ok").tolist() == [0, 300]
    for i in set(range(301)) - {0, 200}:
        (tmp_path / "drive" / f"{i:06d}.bin").unlink()
    (tmp_path / "drive" / "times.txt").write_text("".join(f"{i / 10 + (i > 100)}\n" for i in range(250)))
    facts["lidar"]["times"] = "times.txt"
    counts, frames = run(tmp_path, facts)
    assert counts == {"ok": 2, "missing": 248}
    assert frames.loc[frames["status"] == "ok", "time_s"].tolist() == [0.0, 21.0]
    _, frames = run(tmp_path, facts | {"frames": [0, 200]})
    assert frames["time_s"].tolist() == [0.0, 21.0]
    with pytest.raises(BadInput, match="no time for frame 250"):
        run(tmp_path, facts | {"frames": [0, 250]})


def test_numbers_that_count_nothing(tmp_path):
    (tmp_path / "drive").mkdir()
    for name in ("1000", "43200123"):
        (tmp_path / "drive" / f"{name}.bin").write_bytes(b"")
    facts = {"description": "d", "source": "s", "reader": "folder", "root": "drive", "rate_hz": 10, "lidar": {"files": "*.bin"}}
    with pytest.raises(BadInput, match="no count of frames"):
        run(tmp_path, facts)


def test_frames_missing_at_either_end_keep_their_rows(tmp_path, kitti):
    path = kitti / "velodyne_points" / "timestamps.txt"
    path.write_text(path.read_text() + "2020-01-01 00:00:00.500000000\n2020-01-01 00:00:00.600000000\n")
    (kitti / "velodyne_points" / "data" / "0000000000.bin").unlink()
    _, frames = run(tmp_path, kitti_facts())
    assert frames["number"].tolist() == list(range(7))
    assert frames["status"].tolist() == ["missing", "ok", "ok", "ok", "ok", "missing", "missing"]


def test_a_missing_oxts_file_moves_no_other(tmp_path, kitti):
    run(tmp_path, kitti_facts())
    whole = read_poses_csv(tmp_path / "truth" / "poses.csv")[2]
    (kitti / "oxts" / "data" / "0000000001.txt").unlink()
    run(tmp_path, kitti_facts())
    np.testing.assert_allclose(read_poses_csv(tmp_path / "truth" / "poses.csv")[2], whole, atol=1e-5)


def test_an_mcap_numbers_its_frames_and_checks_its_images(tmp_path):
    with open_drive_writer(tmp_path / "other.mcap") as writer:
        for i in range(4):
            writer.write_lidar(LidarFrame(START_NS + i * 100_000_000, revolution(seed=i)[0]))
            data = png(i) if i != 1 else b"no picture" * 20
            writer.write_image(CameraImage(START_NS + i * 100_000_000, data, "png"))
    (tmp_path / "poses.txt").write_text("".join(f"1 0 0 {i} 0 1 0 0 0 0 1 0\n" for i in range(4)))
    facts = {
        "description": "d", "source": "s", "reader": "mcap", "root": "other.mcap", "rate_hz": 10,
        "lidar": {"topic": "/lidar"}, "camera": {"topic": "/camera/image"},
        "truth": {"poses": {"format": "kitti", "file": "poses.txt", "source": "s"}},
    }  # fmt: skip
    _, frames = run(tmp_path, facts)
    assert frames["number"].tolist() == [0, 1, 2, 3]
    assert frames["image_status"].tolist() == ["ok", "unreadable", "ok", "ok"]
    assert read_poses_csv(tmp_path / "truth" / "poses.csv")[2][:, 0, 3].tolist() == [0, 1, 2, 3]
    with pytest.raises(BadInput, match="CameraImage, for which"):
        run(tmp_path, {k: v for k, v in facts.items() if k != "camera"} | {"lidar": {"topic": "/camera/image"}})


@pytest.mark.parametrize("pattern", ["/abs/*.laz", "**.bin"])
def test_patterns_that_are_none(tmp_path, kitti, pattern):
    with pytest.raises(BadInput, match=r"lidar\.files relative to root"):
        run(tmp_path, kitti_facts(lidar={"files": pattern}))


@pytest.mark.parametrize("kind", ["five columns", "random"])
def test_a_bin_of_something_else(tmp_path, kitti, kind):
    points, intensity, times = revolution()
    five = np.c_[points, intensity * 255, times].astype(np.float32).tobytes()
    data = five if kind == "five columns" else np.random.default_rng(0).bytes(16_000)
    (kitti / "velodyne_points" / "data" / "0000000002.bin").write_bytes(data)
    _, frames = run(tmp_path, kitti_facts())
    assert frames["status"].tolist() == ["ok", "ok", "unreadable", "ok", "ok"]


def test_one_wrong_stamp_condemns_no_other_frame(tmp_path, kitti):
    path = kitti / "velodyne_points" / "timestamps.txt"
    lines = path.read_text().splitlines()
    lines[2] = lines[2].replace("2020", "2030")
    path.write_text("\n".join(lines))
    counts, frames = run(tmp_path, kitti_facts())
    assert frames["status"].tolist() == ["ok", "ok", "time_backwards", "ok", "ok"]
    assert counts == {"ok": 4, "time_backwards": 1}


def test_missing_labels_and_images_of_another_size_are_said(tmp_path, kitti, caplog):
    (kitti / "labels").mkdir()
    for i in (0, 1, 2, 4):
        (kitti / "labels" / f"{i:06d}.label").write_bytes(np.zeros(360, "<u4").tobytes())
    (kitti / "image_02" / "data" / "0000000001.png").write_bytes(png(1, 32, 32))
    facts = kitti_facts()
    facts["truth"]["labels"] = {"files": "labels/*.label", "ids": "semantickitti"}
    with caplog.at_level("WARNING"):
        _, frames = run(tmp_path, facts)
    assert "1 of 5 frames hold points and have no true labels" in caplog.text
    assert "1 images are of another size" in caplog.text
    assert frames["image_status"].tolist() == ["ok", "other_size", "ok", "ok", "ok"]


def test_a_folder_nobody_may_read(tmp_path, kitti, monkeypatch):
    monkeypatch.setattr("streetscan.io.files.os.access", lambda *_: False)
    with pytest.raises(BadInput, match="drive: must not be read by you"):
        run(tmp_path, kitti_facts())


def test_every_simulated_drive_has_a_street_and_settings_that_are_known():
    n = 0
    for path in (ROOT / "config" / "drives").glob("*.yaml"):
        facts = read_drive_facts(path, SCHEMA)
        if facts.reader == "simulate":
            drive = read_simulation(facts.simulation)
            dataset = load_dataset(ROOT / "config" / "datasets" / f"{drive.dataset}.yaml")
            assert dataset.source == "simulate", path
            assert drive.split in dataset.parts, path
            assert facts.crs == dataset.crs, path
            n += 1
    assert n >= 10
