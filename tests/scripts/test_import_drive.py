"""import_drive on toy and on real recordings, against independent readers."""

import lzma
import sqlite3
import subprocess
import sys
from contextlib import closing

import cv2
import laspy
import numpy as np
import pandas as pd
import pypcd4
import pytest
import velodyne_decoder as vd
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from packet_counts import count_all, nebula_count
from scipy.spatial import cKDTree
from toy_recordings import ROOT, SCHEMA, kitti_facts, ros_store, write_facts, write_kitti

from scripts.import_drive import main
from streetscan.frames import GpsFix
from streetscan.inspection import fix_track_m
from streetscan.io.mcap import iterate_drive, iterate_lidar
from streetscan.io.pcap import MODELS
from streetscan.sweeps import deskew


def run(tmp_path, facts, data_root):
    main(facts, SCHEMA, data_root, facts.stem, tmp_path / "drive.mcap", tmp_path / "frames.csv", tmp_path / "truth")
    return pd.read_csv(tmp_path / "frames.csv")


def run_real(tmp_path, shared_data, name):
    return run(tmp_path, ROOT / "config" / "drives" / f"{name}.yaml", shared_data)


def points_by_the_mcap_library(path):
    """Points per message of /lidar, read by the library alone with every checksum checked."""
    counts = []
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        for _, _, _, cloud in reader.iter_decoded_messages(topics=["/lidar"]):
            assert cloud.point_stride * (len(cloud.data) // cloud.point_stride) == len(cloud.data)
            counts.append(len(cloud.data) // cloud.point_stride)
    return counts


def test_toy(tmp_path):
    write_kitti(tmp_path / "drive")
    frames = run(tmp_path, write_facts(tmp_path / "toy.yaml", kitti_facts()), tmp_path)
    assert points_by_the_mcap_library(tmp_path / "drive.mcap") == frames["n_points"].tolist() == [360] * 5


def test_kitti_0005(tmp_path, shared_data):
    frames = run_real(tmp_path, shared_data, "kitti_0005")
    paths = sorted((shared_data / "kitti_2011_09_26_drive_0005" / "velodyne_points" / "data").iterdir())
    independent = [len(np.fromfile(p, np.float32)) // 4 for p in paths]
    assert frames["n_points"].tolist() == independent == points_by_the_mcap_library(tmp_path / "drive.mcap")
    assert (frames["status"] == "ok").all()
    assert (frames["image_status"] == "ok").all()
    first = np.fromfile(paths[0], np.float32).reshape(-1, 4)
    frame = next(iterate_lidar(tmp_path / "drive.mcap"))
    np.testing.assert_array_equal(np.c_[frame.points, frame.intensity], first)


def test_kitti_0001(tmp_path, shared_data):
    # A tenth of the drive keeps the test short; the counts of the whole are the same by the same code.
    root = shared_data / "kitti_2011_09_26_drive_0001"
    facts = (ROOT / "config" / "drives" / "kitti_0001.yaml").read_text() + "frames: [0, 1, 2, 50, 106]\n"
    (tmp_path / "kitti_0001.yaml").write_text(facts)
    frames = run(tmp_path, tmp_path / "kitti_0001.yaml", shared_data)
    independent = [laspy.open(root / "velodyne_laz" / f"{n:010d}.laz").header.point_count for n in (0, 1, 2, 50, 106)]
    assert frames["n_points"].tolist() == independent
    poses = pd.read_csv(tmp_path / "truth" / "poses.csv")
    step = np.linalg.norm(np.diff(poses[["x_m", "y_m"]].to_numpy()[:3], axis=0), axis=1)
    speed = step / np.diff(poses["time_s"].to_numpy()[:3])
    assert np.abs(speed - 13.17).max() < 0.5  # vel_forward of the INS, 0.3 m/s of jitter in the 0.1 s between fixes
    assert frames["image_status"].tolist() == ["ok"] * 5


@pytest.mark.parametrize(("name", "sequence", "numbers"), [("semantickitti", "00", range(10)), ("semantickitti_05", "05", (0, 5, 9))])
def test_semantickitti(tmp_path, shared_data, name, sequence, numbers):
    frames = run_real(tmp_path, shared_data, name)
    folder = shared_data / "semantickitti" / sequence
    for row, number in enumerate(numbers):
        n = len(lzma.decompress((folder / "velodyne" / f"{number:06d}.bin.xz").read_bytes())) // 16
        assert frames["n_points"][row] == n
        labels = np.frombuffer(lzma.decompress((folder / "labels" / f"{number:06d}.label.xz").read_bytes()), np.uint32)
        np.testing.assert_array_equal(np.load(tmp_path / "truth" / "labels" / f"{row:06d}.npy"), labels)
    times = np.array(lzma.decompress((folder / "times.txt.xz").read_bytes()).split(), float)
    np.testing.assert_allclose(frames["time_s"], times[list(numbers)], atol=1e-7)
    with (tmp_path / "drive.mcap").open("rb") as stream:
        assert "/gps" not in {c.topic for c in make_reader(stream).get_summary().channels.values()}


def test_muehlburger_tor(tmp_path, shared_data):
    facts = (ROOT / "config" / "drives" / "muehlburger_tor.yaml").read_text() + "frames: [0, 203, 250, 500]\n"
    (tmp_path / "muehlburger_tor.yaml").write_text(facts)
    frames = run(tmp_path, tmp_path / "muehlburger_tor.yaml", shared_data)
    folder = shared_data / "kit_hdl64_muehlburgertor" / "velodyne_dist"
    independent = [int((cv2.imread(str(folder / "data" / f"{n:010d}.png"), cv2.IMREAD_UNCHANGED) > 0).sum()) for n in (0, 203, 250, 500)]
    assert frames["n_points"].tolist() == independent
    # A quarter of revolution 203 was lost.
    assert frames["status"].tolist() == ["ok", "partial", "ok", "ok"]
    # Ranges come back to the multiplier's step of 2 mm.
    image = cv2.imread(str(folder / "data" / "0000000000.png"), cv2.IMREAD_UNCHANGED)
    ranges = np.linalg.norm(next(iterate_lidar(tmp_path / "drive.mcap")).points, axis=1)
    np.testing.assert_allclose(ranges, image[image > 0] / 500, rtol=1e-5)


def test_hdl32_capture(tmp_path, shared_data):
    frames = run_real(tmp_path, shared_data, "hdl32_capture")
    config = vd.Config(model=MODELS["hdl32e"], max_range=300)
    independent = [len(p) for _, p in vd.read_pcap(shared_data / "velodyne_pcap" / "hdl32_example.pcap", config)]
    assert frames["n_points"].sum() == sum(independent)
    assert frames["status"].tolist() == ["partial", "ok", "ok", "ok", "ok", "partial"]
    # Revolutions begin and end at the rear, forward is in their middle.
    whole = list(iterate_lidar(tmp_path / "drive.mcap"))[1:5]
    assert all(abs(f.time_offset_s.min() + f.time_offset_s.max()) < 2e-3 for f in whole)
    # The receiver itself gives 28.8 and 29.5 knots (14.8 and 15.2 m/s) at its two fixes, which speak of whole seconds.
    fixes = [r for r in iterate_drive(tmp_path / "drive.mcap", ("/gps",)) if isinstance(r, GpsFix)]
    duration_s = (fixes[1].time_ns - fixes[0].time_ns) * 1e-9
    assert duration_s == pytest.approx(1, abs=1e-3)
    track = pd.DataFrame({"latitude_deg": [f.latitude_deg for f in fixes], "longitude_deg": [f.longitude_deg for f in fixes]})
    assert np.linalg.norm(fix_track_m(track)[1]) / duration_s == pytest.approx(15.0, abs=0.3)


@pytest.mark.parametrize(
    ("name", "folder", "n_whole", "model"),
    [("nebula_vlp16", "vlp16", 3, "vlp16"), ("nebula_vlp32", "vlp32", 5, "vlp32c"), ("nebula_vls128", "vls128", 3, "vls128")],
)
def test_nebula(tmp_path, shared_data, name, folder, n_whole, model):
    frames = run_real(tmp_path, shared_data, name)
    assert (frames["status"] == "ok").sum() == n_whole
    folder = shared_data / "ros2bag_velodyne_nebula" / folder
    # The packets taken out of the SQLite file by hand and decoded scan by scan hold exactly as many points.
    with closing(sqlite3.connect(f"file:{next(folder.glob('*/*.db3'))}?immutable=1", uri=True)) as database:
        scans = list(database.execute("SELECT timestamp, data FROM messages ORDER BY timestamp"))
    decoder, store, n_points, messages = vd.ScanDecoder(vd.Config(model=MODELS[model], max_range=300)), ros_store(), 0, []
    for _, data in scans:
        packets = store.deserialize_cdr(data, "velodyne_msgs/msg/VelodyneScan").packets
        messages.append([p.data for p in packets])
        stamped = [vd.VelodynePacket(p.stamp.sec + p.stamp.nanosec * 1e-9, p.data.tobytes()) for p in packets]
        n_points += len(decoder.decode(vd.PacketVector(stamped))[1])
    assert frames["n_points"].sum() == n_points
    # So do the bytes of the packets, counted without any decoder.
    assert frames["n_points"].sum() == sum(count_all(packet) for message in messages for packet in message)
    # Nebula's truth is the cloud of one message: exactly those bytes, less what its settings leave out.
    path = next(folder.glob("*.pcd"))
    truth = pypcd4.PointCloud.from_path(path).numpy(("x", "y", "z"))
    assert len(truth) == nebula_count(messages, [str(time_ns) for time_ns, _ in scans].index(path.stem), model)
    # Its points are ours. It leaves out the 4 cm between the axis and the lasers, which is 5 cm at most, and takes azimuths 0.2 degrees
    # otherwise.
    ours = np.concatenate([f.points for f in iterate_lidar(tmp_path / "drive.mcap")])
    sample = truth[:: max(len(truth) // 5000, 1)]
    distances, _ = cKDTree(ours).query(sample)
    assert (distances < 0.05 + np.radians(0.2) * np.linalg.norm(sample, axis=1)).mean() > 0.998


def test_de_skewed_scans_fit_better(tmp_path, shared_data):
    """Two scans of a car at 13 m/s, 0.8 s apart: undoing the motion within them brings their walls together."""
    facts = (ROOT / "config" / "drives" / "kitti_0001.yaml").read_text() + "frames: [5, 13]\n"
    (tmp_path / "kitti_0001.yaml").write_text(facts)
    run(tmp_path, tmp_path / "kitti_0001.yaml", shared_data)
    path = shared_data / "kitti_2011_09_26_drive_0001" / "derived" / "velo_poses_from_icp_107.txt"
    poses = np.tile(np.eye(4), (107, 1, 1))
    poses[:, :3] = np.loadtxt(path).reshape(-1, 3, 4)
    T_a_b = np.linalg.inv(poses[5]) @ poses[13]
    step = np.linalg.inv(poses[5]) @ poses[6]
    velocity = step[:3, 3] / 0.1
    share = {}
    for is_undone in (False, True):
        clouds = []
        for frame in iterate_lidar(tmp_path / "drive.mcap"):
            points = deskew(frame.points, frame.time_offset_s, velocity, np.zeros(3)) if is_undone else frame.points.astype(float)
            ranges = np.linalg.norm(points[:, :2], axis=1)
            clouds.append(points[(ranges > 3) & (ranges < 40) & (points[:, 2] > -1.2)][::4])
        target = cKDTree(clouds[0])
        # The poses are good to centimetres along the street, so a small search takes their error out of the comparison.
        moved = clouds[1] @ T_a_b[:3, :3].T + T_a_b[:3, 3]
        share[is_undone] = max(
            (target.query(moved + np.array([dx, dy, 0]), distance_upper_bound=0.1)[0] < 0.1).mean()
            for dx in (-0.1, 0, 0.1)
            for dy in (-0.1, 0, 0.1)
        )
    assert share[True] > share[False] + 0.01


def test_memory_does_not_grow_with_the_drive(tmp_path):
    """Peak memory of whole processes over 15 and over 150 frames of 40 000 points."""
    write_kitti(tmp_path / "drive", 150, 40_000, with_images=False)
    facts = kitti_facts()
    del facts["camera"], facts["truth"]
    peaks = []
    for n in (15, 150):
        path = write_facts(tmp_path / f"toy_{n}.yaml", facts | {"frames": list(range(n))})
        arguments = [str(a) for a in (path, SCHEMA, tmp_path, "toy", tmp_path / "d.mcap", tmp_path / "f.csv", tmp_path / "t")]
        code = f"from benchmarks.bench_drives import peak_memory_mb; from scripts.import_drive import main; main(*{arguments!r}); "
        code += "print(peak_memory_mb())"
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=True)
        peaks.append(float(done.stdout))
    assert peaks[1] < 1.1 * peaks[0]
