"""Small synthetic recordings in every format the drives come in, with everything known about them."""

import functools
import operator
import struct
from pathlib import Path

import cv2
import dpkt
import numpy as np
import yaml
from rosbags.rosbag1 import Writer as Bag1Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Bag2Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

ROOT = Path(__file__).resolve().parents[1]
SCHEMA = ROOT / "config" / "drive.schema.yaml"
# 2020-01-01; the first revolution's middle.
START_NS = 1_577_836_800_000_000_000
PERIOD_S = 0.1
VELO_TO_CAM = "R: 0 -1 0 0 0 -1 1 0 0\nT: 0.1 -0.2 -0.3\n"
CAM_TO_CAM = (
    "calib_time: 09-Jan-2012 13:57:47\nS_rect_02: 64 32\nR_rect_00: 1 0 0 0 1 0 0 0 1\nP_rect_02: 50 0 31.5 5 0 50 15.5 0 0 0 1 0\n"
)
_VELODYNE = {
    "velodyne_msgs/msg/VelodynePacket": "builtin_interfaces/Time stamp\nuint8[1206] data\n",
    "velodyne_msgs/msg/VelodyneScan": "std_msgs/Header header\nvelodyne_msgs/VelodynePacket[] packets\n",
}


def revolution(n_points: int = 360, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points (N, 3) float32 of a clockwise revolution from the rear, intensities 0..1, firing times about forward."""
    rng = np.random.default_rng(seed)
    times = ((np.arange(n_points) + 0.5) / n_points - 0.5) * PERIOD_S
    azimuths = -2 * np.pi * times / PERIOD_S
    ranges = rng.uniform(3, 40, n_points)
    points = np.stack([ranges * np.cos(azimuths), ranges * np.sin(azimuths), rng.uniform(-2, 3, n_points)], axis=1)
    return points.astype(np.float32), rng.random(n_points).astype(np.float32), times


def png(seed: int = 0, width: int = 64, height: int = 32) -> bytes:
    pixels = np.random.default_rng(seed).integers(0, 255, (height, width, 3), np.uint8)
    return cv2.imencode(".png", pixels)[1].tobytes()


def write_kitti(root: Path, n_frames: int = 5, n_points: int = 360, with_images: bool = True) -> Path:
    """A folder in KITTI raw layout: one metre per frame to the true east."""
    scans, images, oxts = root / "velodyne_points" / "data", root / "image_02" / "data", root / "oxts" / "data"
    for folder in (scans, images, oxts):
        folder.mkdir(parents=True)
    stamps = []
    for i in range(n_frames):
        points, intensity, _ = revolution(n_points, seed=i)
        np.c_[points, intensity].astype(np.float32).tofile(scans / f"{i:010d}.bin")
        if with_images:
            (images / f"{i:010d}.png").write_bytes(png(i))
        row = np.zeros(30)
        row[:3] = 49.0, 8.4 + i / 73_000, 110.0
        row[23] = 0.05
        (oxts / f"{i:010d}.txt").write_text(" ".join(map(repr, row.tolist())))
        stamps.append(f"2020-01-01 00:00:{i // 10:02d}.{i % 10}00000000")
    for folder in (scans.parent, images.parent, oxts.parent):
        (folder / "timestamps.txt").write_text("\n".join(stamps) + "\n")
    (root / "calib_velo_to_cam.txt").write_text(VELO_TO_CAM)
    (root / "calib_cam_to_cam.txt").write_text(CAM_TO_CAM)
    (root / "calib_imu_to_velo.txt").write_text("R: 1 0 0 0 1 0 0 0 1\nT: -0.8 0.3 -0.8\n")
    return root


def kitti_facts(root: str = "drive", **changes) -> dict:
    """The facts of `write_kitti`'s folder."""
    facts = {
        "description": "toy", "source": "made for tests", "reader": "folder", "root": root, "rate_hz": 10, "crs": "EPSG:32632",
        "lidar": {"files": "velodyne_points/data/*.bin", "times": "velodyne_points/timestamps.txt"},
        "camera": {"files": "image_02/data/*.png", "calibration": {"file": "calib_cam_to_cam.txt", "camera": 2}},
        "gps": {"format": "oxts", "files": "oxts/data", "times": "oxts/timestamps.txt"},
        "mounting": [{"parent": "vehicle", "child": "lidar", "xyz_m": [0.8, 0, 1.7], "rpy_deg": [0, 0, 0], "source": "tape"}],
        "truth": {
            "poses": {"format": "gnss", "imu_to_lidar": {"file": "calib_imu_to_velo.txt"}, "source": "made"},
            "extrinsics": {"lidar_to_camera": {"file": "calib_velo_to_cam.txt"}, "source": "made"},
        },
    }  # fmt: skip
    return facts | changes


def write_facts(path: Path, facts: dict) -> Path:
    path.write_text(yaml.safe_dump(facts, sort_keys=False))
    return path


def vlp16_packet(azimuth_deg: float, step_deg: float, range_m: float, timestamp_us: int) -> bytes:
    """A VLP-16 data packet: twelve blocks of two firings of sixteen beams, every return at one range with reflectivity 100."""
    blocks = b""
    for block in range(12):
        azimuth = round((azimuth_deg + block * step_deg) % 360 * 100) % 36000
        blocks += struct.pack("<HH", 0xEEFF, azimuth) + struct.pack("<HB", round(range_m / 0.002), 100) * 32
    return blocks + struct.pack("<IBB", timestamp_us, 0x37, 0x22)


def vlp16_packets(n_revolutions: float = 3.0, first_deg: float = 180.0, range_m: float = 10.0) -> list[tuple[float, bytes]]:
    """Stamped packets of a VLP-16 at 10 Hz; 0.4 degrees per block, 75 packets per revolution."""
    step_deg, n = 0.4, round(n_revolutions * 75)
    start = START_NS * 1e-9
    return [
        (start + i * PERIOD_S / 75, vlp16_packet(first_deg + i * 12 * step_deg, step_deg, range_m, round(i * PERIOD_S / 75 * 1e6)))
        for i in range(n)
    ]


def position_packet(sentence: str) -> bytes:
    """A Velodyne position packet (512 bytes) with an NMEA sentence, given from `$` to before `*`."""
    checksum = functools.reduce(operator.xor, sentence[1:].encode())
    return (b"\0" * 206 + f"{sentence}*{checksum:02X}\r\n".encode()).ljust(512, b"\0")


def write_pcap(path: Path, packets: list[tuple[float, bytes]]) -> Path:
    """Packets as a capture of the sensor's UDP port."""
    with path.open("wb") as stream:
        writer = dpkt.pcap.Writer(stream)
        for time_s, payload in packets:
            port = 2368 if len(payload) == 1206 else 8308
            udp = dpkt.udp.UDP(sport=port, dport=port, data=payload)
            udp.ulen = len(udp)
            ip = dpkt.ip.IP(src=b"\xc0\xa8\x01\xc9", dst=b"\xff" * 4, p=dpkt.ip.IP_PROTO_UDP, data=udp, ttl=64)
            ip.len = len(ip)
            writer.writepkt(dpkt.ethernet.Ethernet(src=b"\1" * 6, dst=b"\xff" * 6, data=ip), time_s)
    return path


def ros_store(ros1: bool = False):
    """Typestore of ROS 1 Noetic or ROS 2 Humble with velodyne_msgs."""
    store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
    for name, definition in _VELODYNE.items():
        store.register(get_types_from_msg(definition.replace("builtin_interfaces/Time", "time") if ros1 else definition, name))
    return store


class Messages:
    """Makes ROS messages of one typestore."""

    def __init__(self, store, ros1: bool = False):
        self._types, self._ros1 = store.types, ros1

    def header(self, time_ns: int, frame_id: str):
        stamp = self._types["builtin_interfaces/msg/Time"](time_ns // 10**9, time_ns % 10**9)
        first = (0,) if self._ros1 else ()
        return self._types["std_msgs/msg/Header"](*first, stamp, frame_id)

    def cloud(self, time_ns: int, columns: dict[str, np.ndarray], big_endian: bool = False, n_rows: int = 1, padding: int = 0):
        kinds = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}
        order = ">" if big_endian else "<"
        dtype = np.dtype([(k, v.dtype.newbyteorder(order)) for k, v in columns.items()])
        n = len(next(iter(columns.values())))
        packed = np.zeros(n, dtype)
        for k, v in columns.items():
            packed[k] = v
        field = self._types["sensor_msgs/msg/PointField"]
        fields = [field(k, dtype.fields[k][1], kinds[v.dtype.str[1:]], 1) for k, v in columns.items()]
        width = n // n_rows
        rows = np.frombuffer(packed.tobytes(), np.uint8).reshape(n_rows, width * dtype.itemsize)
        data = np.pad(rows, ((0, 0), (0, padding))).ravel()
        make = self._types["sensor_msgs/msg/PointCloud2"]
        return make(self.header(time_ns, "lidar"), n_rows, width, fields, big_endian, dtype.itemsize, rows.shape[1] + padding, data, True)

    def compressed(self, time_ns: int, data: bytes, kind: str = "png"):
        return self._types["sensor_msgs/msg/CompressedImage"](self.header(time_ns, "camera"), kind, np.frombuffer(data, np.uint8))

    def image(self, time_ns: int, pixels: np.ndarray, encoding: str, padding: int = 0):
        rows = pixels.reshape(len(pixels), -1).view(np.uint8)
        data = np.pad(rows, ((0, 0), (0, padding))).ravel()
        header = self.header(time_ns, "camera")
        return self._types["sensor_msgs/msg/Image"](header, pixels.shape[0], pixels.shape[1], encoding, 0, rows.shape[1] + padding, data)

    def camera_info(self, time_ns: int, model: str, D: list[float]):
        info, roi = self._types["sensor_msgs/msg/CameraInfo"], self._types["sensor_msgs/msg/RegionOfInterest"]
        K = np.array([50, 0, 31.5, 0, 50, 15.5, 0, 0, 1.0])
        P = np.c_[K.reshape(3, 3), np.zeros(3)].ravel()
        return info(self.header(time_ns, "camera"), 32, 64, model, np.array(D), K, np.eye(3).ravel(), P, 0, 0, roi(0, 0, 0, 0, False))

    def fix(self, time_ns: int, latitude: float, longitude: float, altitude: float, status: int = 0):
        state = self._types["sensor_msgs/msg/NavSatStatus"](status, 1)
        make = self._types["sensor_msgs/msg/NavSatFix"]
        return make(self.header(time_ns, "gps"), state, latitude, longitude, altitude, np.eye(3).ravel(), 2)

    def scan(self, time_ns: int, packets: list[tuple[float, bytes]]):
        packet, time = self._types["velodyne_msgs/msg/VelodynePacket"], self._types["builtin_interfaces/msg/Time"]
        made = [packet(time(int(t), round(t % 1 * 1e9)), np.frombuffer(d, np.uint8)) for t, d in packets]
        return self._types["velodyne_msgs/msg/VelodyneScan"](self.header(time_ns, "velodyne"), made)


def write_bag(path: Path, items: list[tuple[str, int, object]], kind: str = "sqlite3") -> Path:
    """Messages (topic, time_ns, message) as a bag: `sqlite3`, `mcap` (both rosbag2) or `ros1`."""
    store = ros_store(kind == "ros1")
    if kind == "ros1":
        writer, serialize = Bag1Writer(path), store.serialize_ros1
    else:
        plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
        writer, serialize = Bag2Writer(path, version=9, storage_plugin=plugin), store.serialize_cdr
    with writer:
        connections = {}
        for topic, time_ns, message in items:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, message.__msgtype__, typestore=store)
            writer.write(connections[topic], time_ns, serialize(message, message.__msgtype__))
    return path
