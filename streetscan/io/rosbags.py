"""ROS bags, without ROS: rosbag2 (sqlite and MCAP) and ROS 1, through `rosbags`; and ROS messages as our records."""

import functools
import sqlite3
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from mcap.records import Channel, Message, Schema
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from streetscan.errors import BadInput
from streetscan.frames import CameraImage, CameraModel, GpsFix, LidarFrame, camera_model
from streetscan.io.images import check_image, png_of_raw
from streetscan.io.mcap import iterate_mcap
from streetscan.io.pcap import PacketDecoder
from streetscan.io.point_columns import LidarConventions, frame_of_columns

Record = LidarFrame | CameraImage | CameraModel | GpsFix
_NS = 1_000_000_000
# PointField.msg, datatypes 1 to 8.
_POINT_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
# velodyne_msgs is no part of ROS itself, and rosbag2 files before ROS 2 Iron do not carry their definitions.
_VELODYNE = {
    "velodyne_msgs/msg/VelodynePacket": "builtin_interfaces/Time stamp\nuint8[1206] data\n",
    "velodyne_msgs/msg/VelodyneScan": "std_msgs/Header header\nvelodyne_msgs/VelodynePacket[] packets\n",
}
_NEEDED_TYPES = (
    "builtin_interfaces/msg/Time", "std_msgs/msg/Header", "sensor_msgs/msg/PointField", "sensor_msgs/msg/PointCloud2",
    "sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/Image", "sensor_msgs/msg/RegionOfInterest", "sensor_msgs/msg/CameraInfo",
    "sensor_msgs/msg/NavSatStatus", "sensor_msgs/msg/NavSatFix",
)  # fmt: skip


@dataclass
class MessageConverter:
    """Turns the ROS messages of a recording's topics into records.

    Attributes:
        where: the recording, named in errors.
        conventions: what the numbers of point clouds mean.
        packets: decoder for VelodyneScan messages, or None.
        n_without_position: fixes without a position (NavSatStatus -1), left out.
    """

    where: object
    conventions: LidarConventions
    packets: PacketDecoder | None = None
    n_without_position: int = 0
    n_clouds: int = 0

    def convert(self, msgtype: str, message: Any) -> Iterator[Record]:
        """The records one message holds; a VelodyneScan may end none or one revolution.

        Raises:
            BadInput: a type we do not know, or contents that contradict themselves.
        """
        match msgtype.replace("/msg/", "/"):
            case "sensor_msgs/PointCloud2":
                yield self._cloud(message)
            case "velodyne_msgs/VelodyneScan":
                yield from self._scan(message)
            case "sensor_msgs/CompressedImage":
                yield check_image(CameraImage(_stamp_ns(message), bytes(message.data), message.format))
            case "sensor_msgs/Image":
                pixels = png_of_raw(
                    message.data, message.width, message.height, message.step, message.encoding, bool(message.is_bigendian), self.where
                )
                yield CameraImage(_stamp_ns(message), pixels, "png")
            case "sensor_msgs/CameraInfo":
                yield _camera_model(message, self.where)
            case "sensor_msgs/NavSatFix":
                yield from self._fix(message)
            case _:
                raise BadInput(
                    self.where,
                    f"messages of type {msgtype}",
                    "name topics of PointCloud2, VelodyneScan, CompressedImage, Image, CameraInfo or NavSatFix",
                )

    def finish(self) -> Iterator[LidarFrame]:
        """The revolution the recording ended in."""
        frame = self.packets.finish() if self.packets is not None else None
        if frame is not None:
            yield frame

    def _cloud(self, message: Any) -> LidarFrame:
        columns = _columns(message, self.where)
        frame = frame_of_columns(columns, _stamp_ns(message), self.conventions, self.where)
        frame.number = self.n_clouds
        self.n_clouds += 1
        return frame

    def _scan(self, message: Any) -> Iterator[LidarFrame]:
        if self.packets is None:
            raise BadInput(self.where, "VelodyneScan packets of an unnamed sensor", "write lidar.model into the drive's file")
        for packet in message.packets:
            stamp = packet.stamp
            frame = self.packets.push(stamp.sec + stamp.nanosec * 1e-9, packet.data.tobytes())
            if frame is not None:
                yield frame

    def _fix(self, message: Any) -> Iterator[GpsFix]:
        is_on_earth = abs(message.latitude) <= 90 and abs(message.longitude) <= 360
        if message.status.status < 0 or not is_on_earth:
            self.n_without_position += 1
            return
        known = message.position_covariance_type > 0
        covariance = np.array(message.position_covariance, np.float64).reshape(3, 3) if known else None
        yield GpsFix(_stamp_ns(message), message.latitude, message.longitude, message.altitude, covariance)


def iterate_bag(path: str | Path, topics: tuple[str, ...], converter: MessageConverter) -> Iterator[Record]:
    """The records of a bag's topics in the order of recording, in constant memory.

    Args:
        path: a rosbag2 folder or `.db3`, or a ROS 1 `.bag`.
        topics: each must exist.
        converter: for the messages.
    Raises:
        BadInput: no such bag, not a whole bag, a topic is missing, or a message cannot be decoded.
    """
    path = Path(path)
    with _open_bag(path) as (available, messages, deserialize):
        if missing := [t for t in topics if t not in available]:
            found = ", ".join(f"{t} ({available[t]})" for t in sorted(available)) or "no topic"
            raise BadInput(path, f"has no topic '{missing[0]}' (found: {found})", "name one of its topics in the drive's file")
        for msgtype, topic, data in _guarded(messages(topics), path):
            try:
                message = deserialize(data, msgtype)
            # rosbags raises struct.error, IndexError, ValueError, UnicodeDecodeError, ... on damaged bytes.
            except Exception as error:
                raise BadInput(path, f"a message of topic '{topic}' cannot be decoded ({error})", "record the bag again") from error
            yield from converter.convert(msgtype, message)
    yield from converter.finish()


def iterate_ros_mcap(path: str | Path, topics: tuple[str, ...], converter: MessageConverter) -> Iterator[Record]:
    """The records of an MCAP file with Foxglove (protobuf), ROS 2 (cdr) or ROS 1 messages; see iterate_bag."""
    store = get_typestore(Stores.EMPTY)
    known: dict[int, str] = {}

    def convert(channel: Channel, schema: Schema | None, message: Message) -> Iterator[Record]:
        where = f"{path}, topic {channel.topic}"
        if channel.message_encoding not in ("cdr", "ros1") or schema is None:
            raise BadInput(where, f"messages encoded as '{channel.message_encoding}'", "record protobuf, cdr or ros1 messages")
        try:
            if schema.id not in known:
                known[schema.id] = _register(store, schema)
            read = store.deserialize_cdr if channel.message_encoding == "cdr" else store.deserialize_ros1
            decoded = read(message.data, known[schema.id])
        except Exception as error:
            raise BadInput(where, f"a message cannot be decoded ({error})", "record the file again") from error
        yield from converter.convert(known[schema.id], decoded)

    yield from iterate_mcap(path, topics, converter.conventions, convert_ros=convert)
    yield from converter.finish()


@functools.cache
def velodyne_typestore() -> Typestore:
    """The types of the messages we convert, as in ROS 2 Humble, and of velodyne_msgs; the whole of ROS would take 0.2 s to build."""
    humble, store = get_typestore(Stores.ROS2_HUMBLE), get_typestore(Stores.EMPTY)
    store.register({name: humble.fielddefs[name] for name in _NEEDED_TYPES})
    for name, definition in _VELODYNE.items():
        store.register(get_types_from_msg(definition, name))
    return store


def _register(store: Typestore, schema: Schema) -> str:
    """Register a schema's message definition; returns the name rosbags gives it."""
    name = schema.name if "/msg/" in schema.name else schema.name.replace("/", "/msg/")
    types = get_types_from_msg(schema.data.decode(), name)
    store.register({k: v for k, v in types.items() if k not in store.types})
    return name


@contextmanager
def _open_bag(path: Path) -> Iterator[tuple[dict[str, str], Callable, Callable]]:
    """Topics with their types, a function topics -> (type, topic, bytes), and one (bytes, type) -> message."""
    if not path.exists():
        raise BadInput(path, "no such bag", "check the drive's file and data_root")
    store = velodyne_typestore()
    if databases := _databases_without_format(path):
        with _open_databases(databases) as (available, messages):
            yield available, messages, store.deserialize_cdr
        return
    if path.is_dir() and not (path / "metadata.yaml").is_file():
        found = ", ".join(sorted(p.name for p in [*path.glob("*.db3"), *path.glob("*.mcap")]))
        if not found:
            raise BadInput(path, "is a folder without a ROS bag", "check root in the drive's file")
        remedy = "copy it too, run `ros2 bag reindex`, or write the .db3 file itself as root (a .mcap with reader: mcap)"
        raise BadInput(path, f"lacks the bag's metadata.yaml beside {found}", remedy)
    try:
        reader = AnyReader([path], default_typestore=store)
        reader.open()
    # Besides its own errors rosbags passes on those of YAML, SQLite, struct and zlib.
    except Exception as error:
        raise BadInput(path, f"is no whole ROS bag ({error})", "copy it again, or reindex it with the ROS tools") from error
    try:

        def messages(topics: tuple[str, ...]) -> Iterator[tuple[str, str, bytes]]:
            chosen = [c for c in reader.connections if c.topic in topics]
            for connection, _, data in reader.messages(connections=chosen):
                yield connection.msgtype, connection.topic, data

        yield {c.topic: c.msgtype for c in reader.connections}, messages, reader.deserialize
    finally:
        reader.close()


def _databases_without_format(path: Path) -> list[Path]:
    """The SQLite files of a bag whose topics do not say how they are serialized, which rosbags refuses; early rosbag2 wrote such."""
    paths = [path] if path.suffix == ".db3" else sorted(path.glob("*.db3")) if path.is_dir() else []
    return [p for p in paths if _lacks_format(p)]


def _lacks_format(path: Path) -> bool:
    try:
        with closing(sqlite3.connect(f"file:{path}?immutable=1", uri=True)) as database:
            return any(row[0] == "" for row in database.execute("SELECT serialization_format FROM topics"))
    except (sqlite3.Error, UnicodeDecodeError):
        return False  # rosbags will say what is wrong with it


@contextmanager
def _open_databases(paths: list[Path]) -> Iterator[tuple[dict[str, str], Callable]]:
    databases = [sqlite3.connect(f"file:{p}?immutable=1", uri=True) for p in paths]
    try:
        try:
            available = {name: kind for d in databases for name, kind in d.execute("SELECT name, type FROM topics")}
        except (sqlite3.Error, UnicodeDecodeError) as error:
            raise BadInput(paths[0], f"is no whole ROS bag ({error})", "copy it again, or reindex it with the ROS tools") from error

        # ASSUME: an empty format is CDR, the only one rosbag2 has ever written.
        def messages(topics: tuple[str, ...]) -> Iterator[tuple[str, str, bytes]]:
            marks = ",".join("?" * len(topics))
            query = (
                "SELECT topics.type, topics.name, messages.data FROM messages JOIN topics ON messages.topic_id = topics.id "
                f"WHERE topics.name IN ({marks}) ORDER BY messages.timestamp"
            )
            for database in databases:
                yield from database.execute(query, topics)

        yield available, messages
    finally:
        for database in databases:
            database.close()


def _guarded(messages: Iterator, path: Path) -> Iterator:
    while True:
        try:
            item = next(messages)
        except StopIteration:
            return
        except Exception as error:
            raise BadInput(path, f"is damaged or cut short ({error})", "copy it again, or reindex it with the ROS tools") from error
        yield item


def _columns(message: Any, where: object) -> dict[str, np.ndarray]:
    """The fields of a PointCloud2 by name, rows of an organized cloud one after the other."""
    fields = [f for f in message.fields if f.count == 1]
    itemsize, n_points = message.point_step, message.width * message.height
    fits = all(f.datatype in _POINT_TYPES and f.offset + np.dtype(_POINT_TYPES[f.datatype]).itemsize <= itemsize for f in fields)
    is_full = len(message.data) >= message.row_step * max(message.height, 1) and message.row_step >= message.width * itemsize
    if n_points and not (fits and is_full and itemsize):
        raise BadInput(
            where,
            f"a cloud of {message.width} x {message.height} points of {itemsize} bytes does not fit its {len(message.data)} bytes",
            "record it again",
        )
    order = ">" if message.is_bigendian else "<"
    names = [f.name for f in fields]
    if len(set(names)) < len(names):
        raise BadInput(where, f"two point fields share a name ({', '.join(names)})", "rename one in the driver")
    if n_points == 0:
        return {f.name: np.empty(0, order + _POINT_TYPES.get(f.datatype, "f4")) for f in fields}
    dtype = np.dtype(
        {
            "names": names,
            "formats": [order + _POINT_TYPES[f.datatype] for f in fields],
            "offsets": [f.offset for f in fields],
            "itemsize": itemsize,
        }
    )
    data = np.asarray(message.data, np.uint8)
    if message.row_step != message.width * itemsize:
        data = data[: message.row_step * message.height].reshape(message.height, -1)[:, : message.width * itemsize]
    points = np.frombuffer(np.ascontiguousarray(data).tobytes(), dtype, n_points)
    return {name: points[name] for name in names}


def _camera_model(message: Any, where: object) -> CameraModel:
    # ROS 1 names the matrices D, K, P, ROS 2 d, k, p.
    K, D, P = (np.array(getattr(message, n, None) if hasattr(message, n) else getattr(message, n.upper())) for n in "kdp")
    if not K.any():
        raise BadInput(where, "an uncalibrated camera (K is zero)", "calibrate the camera, or leave out camera.info_topic")
    P, K = P.reshape(3, 4), K.reshape(3, 3)
    P = P if P[0, 0] > 0 else np.c_[K, np.zeros(3)]
    return camera_model(message.width, message.height, K, D, message.distortion_model, P, where)


def _stamp_ns(message: Any) -> int:
    stamp = message.header.stamp
    return stamp.sec * _NS + stamp.nanosec
