"""Drives as MCAP with Foxglove schemas: the one form every recording is brought into, and other people's MCAP files.

Topics: `/lidar` foxglove.PointCloud (x, y, z, and as known intensity, time_offset_s, ring), `/camera/image` foxglove.CompressedImage,
`/camera/calibration` foxglove.CameraCalibration, `/gps` foxglove.LocationFix, `/tf` foxglove.FrameTransform. Where there are
several cameras, each has its own name in place of `camera`: `/camera_1/image`, `/camera_1/calibration`.
"""

import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.LocationFix_pb2 import LocationFix
from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.Pose_pb2 import Pose
from foxglove_schemas_protobuf.Quaternion_pb2 import Quaternion
from foxglove_schemas_protobuf.Vector3_pb2 import Vector3
from google.protobuf.timestamp_pb2 import Timestamp
from mcap.reader import make_reader
from mcap.records import Channel, Message, Schema
from mcap_protobuf.decoder import DecoderFactory
from mcap_protobuf.writer import Writer

from streetscan import geometry
from streetscan.errors import BadInput
from streetscan.frames import CAMERA, CameraImage, CameraModel, GpsFix, LidarFrame, Mounting, camera_model
from streetscan.io.atomic import atomic_path
from streetscan.io.files import open_binary
from streetscan.io.images import check_image
from streetscan.io.point_columns import LidarConventions, frame_of_columns

LIDAR, IMAGE, CALIBRATION, GPS, TF = "/lidar", f"/{CAMERA}/image", f"/{CAMERA}/calibration", "/gps", "/tf"
_OF_CAMERA = re.compile(rf"/({CAMERA}\w*)/(image|calibration)")
Record = LidarFrame | CameraImage | CameraModel | GpsFix | Mounting

_N = PackedElementField
_NUMPY_TYPES = {
    _N.UINT8: "<u1", _N.INT8: "<i1", _N.UINT16: "<u2", _N.INT16: "<i2",
    _N.UINT32: "<u4", _N.INT32: "<i4", _N.FLOAT32: "<f4", _N.FLOAT64: "<f8",
}  # fmt: skip
_IDENTITY = Pose(position=Vector3(), orientation=Quaternion(w=1.0))


class DriveWriter:
    """Appends records to an open drive; made by `open_drive_writer`. BadInput for stamps before 1970, which MCAP cannot hold."""

    def __init__(self, writer: Writer):
        self._writer = writer
        self._n_lidar = 0
        self._last_lidar_ns = 0

    def write_lidar(self, frame: LidarFrame) -> None:
        """Append a lidar frame to `/lidar`, with the columns it has; a frame without points becomes a message without points."""
        columns = {"x": frame.points[:, 0], "y": frame.points[:, 1], "z": frame.points[:, 2]}
        columns |= {n: getattr(frame, n) for n in ("intensity", "time_offset_s", "ring") if getattr(frame, n) is not None}
        names = list(columns)
        formats = ["<u2" if name == "ring" else "<f4" for name in names]
        offsets = [4 * i for i in range(len(names))]
        # Every field starts on a multiple of four bytes, so viewers read it without copying.
        packed = np.zeros(len(frame), np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": 4 * len(names)}))
        for name, values in columns.items():
            packed[name] = values
        fields = [
            PackedElementField(name=name, offset=offset, type=_N.UINT16 if name == "ring" else _N.FLOAT32)
            for name, offset in zip(names, offsets, strict=True)
        ]
        message = PointCloud(
            timestamp=_timestamp(frame.time_ns),
            frame_id="lidar",
            pose=_IDENTITY,
            point_stride=packed.itemsize,
            fields=fields,
            data=packed.tobytes(),
        )
        # Readers sort by log time: a stamp that runs backwards must not change the order of the frames.
        self._last_lidar_ns = max(self._last_lidar_ns, frame.time_ns) if frame.time_ns >= 0 else frame.time_ns
        self._write(LIDAR, message, self._last_lidar_ns, self._n_lidar)
        self._n_lidar += 1

    def write_image(self, image: CameraImage) -> None:
        """Append an image to `/camera/image`, or the topic of its own camera, its bytes as they are."""
        message = CompressedImage(timestamp=_timestamp(image.time_ns), frame_id=image.camera, data=image.data, format=image.format)
        self._write(f"/{image.camera}/image", message, image.time_ns)

    def write_calibration(self, model: CameraModel, time_ns: int) -> None:
        """Append a camera's intrinsics to `/camera/calibration`, or the topic of its own."""
        message = CameraCalibration(
            timestamp=_timestamp(time_ns),
            frame_id=model.camera,
            width=model.width,
            height=model.height,
            distortion_model=model.distortion_model,
            D=np.asarray(model.D, float).tolist(),
            K=np.asarray(model.K, float).ravel().tolist(),
            R=np.eye(3).ravel().tolist(),
            P=np.asarray(model.P, float).ravel().tolist(),
        )
        self._write(f"/{model.camera}/calibration", message, time_ns)

    def write_fix(self, fix: GpsFix) -> None:
        """Append a position to `/gps`, with the heading where the receiver tells one."""
        message = LocationFix(
            timestamp=_timestamp(fix.time_ns),
            frame_id="gps",
            latitude=fix.latitude_deg,
            longitude=fix.longitude_deg,
            altitude=fix.altitude_m,
        )
        if fix.heading_rad is not None:
            message.heading = fix.heading_rad
        if fix.covariance_m2 is not None:
            message.position_covariance.extend(np.asarray(fix.covariance_m2, float).ravel().tolist())
            message.position_covariance_type = LocationFix.APPROXIMATED
        self._write(GPS, message, fix.time_ns)

    def write_mounting(self, mounting: Mounting, time_ns: int) -> None:
        """Append a mounting the user gave to `/tf`."""
        T = mounting.T_parent_child
        x, y, z, w = geometry.quaternion_of_transform(T)
        message = FrameTransform(
            timestamp=_timestamp(time_ns),
            parent_frame_id=mounting.parent,
            child_frame_id=mounting.child,
            translation=Vector3(x=T[0, 3], y=T[1, 3], z=T[2, 3]),
            rotation=Quaternion(x=x, y=y, z=z, w=w),
        )
        self._write(TF, message, time_ns)

    def write_cloud(self, topic: str, frame_id: str, points: np.ndarray, time_ns: int) -> None:
        """Append a cloud that is no frame of the lidar, such as a map: points (N, 3) metres, float32, in a frame of that name."""
        fields = [PackedElementField(name=name, offset=4 * i, type=_N.FLOAT32) for i, name in enumerate("xyz")]
        data = np.ascontiguousarray(points, "<f4").tobytes()
        stamp = _timestamp(time_ns)
        self._write(
            topic, PointCloud(timestamp=stamp, frame_id=frame_id, pose=_IDENTITY, point_stride=12, fields=fields, data=data), time_ns
        )

    def write_metadata(self, name: str, values: dict[str, str]) -> None:
        """Add a named record of text values (shown by every MCAP tool)."""
        self._writer.add_metadata(name, {k: str(v) for k, v in values.items()})

    def _write(self, topic: str, message: object, time_ns: int, sequence: int = 0) -> None:
        if not 0 <= time_ns < 2**63:
            raise BadInput(topic, f"a stamp of {time_ns * 1e-9:.3f} s since 1970", "correct the recording's clock, or set start_time_s")
        self._writer.write_message(topic, message, log_time=time_ns, publish_time=time_ns, sequence=sequence)


@contextmanager
def open_drive_writer(path: str | Path) -> Iterator[DriveWriter]:
    """A writer that streams records into an indexed MCAP with checksums; the file appears when the block ends without an error."""
    with atomic_path(path) as partial, partial.open("wb") as stream:
        writer = Writer(stream, enable_crcs=True)
        yield DriveWriter(writer)
        writer.finish()


def iterate_drive(
    path: str | Path, topics: tuple[str, ...] = (LIDAR, IMAGE, CALIBRATION, GPS, TF), start_ns: int | None = None, end_ns: int | None = None
) -> Iterator[Record]:
    """The records of a drive in the order of time, in constant memory, with every checksum checked.

    Args:
        path: a drive's MCAP file.
        topics: which of its topics; `read_topics` lists those of further cameras too.
        start_ns, end_ns: only records from `start_ns` on and before `end_ns`; found through the index.
    Raises:
        BadInput: no such file, no MCAP, cut short or damaged.
    """
    return iterate_mcap(path, topics, LidarConventions(), start_ns, end_ns)


def iterate_lidar(path: str | Path, start_ns: int | None = None, end_ns: int | None = None) -> Iterator[LidarFrame]:
    """The lidar frames of a drive; see `iterate_drive`."""
    return iterate_drive(path, (LIDAR,), start_ns, end_ns)


def iterate_images(path: str | Path, start_ns: int | None = None, end_ns: int | None = None) -> Iterator[CameraImage]:
    """The images of a drive; see `iterate_drive`."""
    return iterate_drive(path, (IMAGE,), start_ns, end_ns)


def read_camera_model(path: str | Path) -> CameraModel | None:
    """The camera's intrinsics in a drive, or None when it has none."""
    return next(iterate_drive(path, (CALIBRATION,)), None)


def read_topics(path: str | Path) -> tuple[str, ...]:
    """The topics of a drive that `iterate_drive` reads, those of all its cameras among them; BadInput when the file is damaged."""
    with open_mcap(Path(path), ()) as reader:
        present = {channel.topic for channel in reader.get_summary().channels.values()}
    return tuple(sorted(topic for topic in present if topic in (LIDAR, GPS, TF) or _OF_CAMERA.fullmatch(topic)))


def read_metadata(path: str | Path, name: str) -> dict[str, str]:
    """The first record of `DriveWriter.write_metadata` under a name; empty without one. BadInput when the file is damaged."""
    path = Path(path)
    with open_mcap(path, ()) as reader:
        try:
            return next((record.metadata for record in reader.iter_metadata() if record.name == name), {})
        except Exception as error:
            raise _damaged(path, error) from error


def iterate_mcap(
    path: str | Path,
    topics: tuple[str, ...],
    conventions: LidarConventions,
    start_ns: int | None = None,
    end_ns: int | None = None,
    convert_ros: Callable[[Channel, Schema | None, Message], Iterator[Record]] | None = None,
) -> Iterator[Record]:
    """The records of an MCAP file with Foxglove (protobuf) messages, or with any messages a converter understands.

    Args:
        path: the file.
        topics: wanted topics; each must exist unless it is one of a drive's own.
        conventions: what the numbers of the lidar messages mean.
        start_ns, end_ns: only messages logged from `start_ns` on and before `end_ns`.
        convert_ros: for messages that are no protobuf: (channel, schema, message) to the records it holds. With it the file is
            somebody else's, and each image is checked.
    Yields:
        records; the number of a lidar frame is its count from the first one read.
    Raises:
        BadInput: no such file, no MCAP, cut short, damaged, a wanted topic is missing, or a message of a type we do not know.
    """
    path = Path(path)
    factory = DecoderFactory()
    decoders: dict[int, Callable] = {}
    n_frames = 0
    with open_mcap(path, topics) as reader:
        for schema, channel, message in _messages(reader, path, topics, start_ns, end_ns):
            if channel.message_encoding != "protobuf":
                if convert_ros is None:
                    found = f"topic '{channel.topic}' is encoded as '{channel.message_encoding}'"
                    raise BadInput(path, found, "import it with a drive's file whose reader is 'mcap'")
                yield from convert_ros(channel, schema, message)
                continue
            try:
                decode = decoders.get(channel.id) or factory.decoder_for(channel.message_encoding, schema)
                decoders[channel.id] = decode
                record = record_of_message(schema.name, decode(message.data), conventions, f"{path}, topic {channel.topic}")
            except BadInput:
                raise
            except Exception as error:
                raise BadInput(path, f"a message of topic '{channel.topic}' cannot be decoded ({error})", "record it again") from error
            if isinstance(record, LidarFrame):
                record.number = n_frames
                n_frames += 1
            elif isinstance(record, CameraImage | CameraModel) and (named := _OF_CAMERA.fullmatch(channel.topic)) and convert_ros is None:
                record.camera = named[1]
            # A drive's own images were looked at when it was imported.
            yield check_image(record) if isinstance(record, CameraImage) and convert_ros is not None else record


@contextmanager
def open_mcap(path: Path, topics: tuple[str, ...]) -> Iterator[object]:
    """A reader of an MCAP file with checksums on; BadInput when the file is missing, unreadable, damaged, cut short or lacks a topic."""
    with open_binary(path) as stream:
        try:
            reader = make_reader(stream, validate_crcs=True)
            summary = reader.get_summary()
        except Exception as error:
            raise _damaged(path, error) from error
        if summary is None:
            raise BadInput(path, "has no summary at its end: it was cut short", "run `mcap recover` on it")
        present = {channel.topic for channel in summary.channels.values()}
        own = {LIDAR, IMAGE, CALIBRATION, GPS, TF}
        if missing := [t for t in topics if t not in present and t not in own]:
            found = ", ".join(sorted(present)) or "no topic"
            raise BadInput(path, f"has no topic '{missing[0]}' (found: {found})", "name one of its topics in the drive's file")
        yield reader


def _messages(
    reader: object, path: Path, topics: tuple[str, ...], start_ns: int | None, end_ns: int | None
) -> Iterator[tuple[Schema, Channel, Message]]:
    try:
        yield from reader.iter_messages(topics=list(topics), starting_at=start_ns, ending_before=end_ns)
    except BadInput:
        raise
    except Exception as error:
        # The reader raises struct.error, ValueError, zstd and protobuf errors of its parts on damaged bytes.
        raise _damaged(path, error) from error


def _damaged(path: Path, error: Exception) -> BadInput:
    return BadInput(path, f"not a whole MCAP file ({type(error).__name__}: {error})", "copy it again or run `mcap recover` on it")


def record_of_message(schema: str, message: object, conventions: LidarConventions, where: object) -> Record:
    """The record of a decoded Foxglove message.

    Raises:
        BadInput: a schema that is none of ours, or contents that contradict themselves.
    """
    if schema == "foxglove.PointCloud":
        return _lidar_frame(message, conventions, where)
    if schema == "foxglove.CompressedImage":
        return CameraImage(_time_ns(message.timestamp), message.data, message.format)
    if schema == "foxglove.LocationFix":
        covariance = None
        if message.position_covariance_type != LocationFix.UNKNOWN and len(message.position_covariance) == 9:
            covariance = np.array(message.position_covariance).reshape(3, 3)
        # Messages of before 2025 know no heading.
        has_heading = "heading" in message.DESCRIPTOR.fields_by_name and message.HasField("heading")
        heading_rad = message.heading if has_heading else None
        return GpsFix(_time_ns(message.timestamp), message.latitude, message.longitude, message.altitude, covariance, heading_rad)
    if schema == "foxglove.CameraCalibration":
        K, P = np.array(message.K), np.array(message.P)
        if len(K) != 9:
            raise BadInput(where, f"the camera matrix K has {len(K)} of 9 numbers", "record the calibration again")
        P = P.reshape(3, 4) if len(P) == 12 else np.c_[K.reshape(3, 3), np.zeros(3)]
        return camera_model(message.width, message.height, K.reshape(3, 3), np.array(message.D), message.distortion_model, P, where)
    if schema == "foxglove.FrameTransform":
        t, q = message.translation, message.rotation
        T = geometry.transform_of_quaternion([t.x, t.y, t.z], [q.x, q.y, q.z, q.w])
        return Mounting(message.parent_frame_id, message.child_frame_id, T)
    raise BadInput(where, f"messages of type '{schema}'", "name a topic with one of the types the page on own drives lists")


def _lidar_frame(message: PointCloud, conventions: LidarConventions, where: object) -> LidarFrame:
    names = [f.name for f in message.fields]
    known = all(
        f.type in _NUMPY_TYPES and f.offset + np.dtype(_NUMPY_TYPES[f.type]).itemsize <= message.point_stride for f in message.fields
    )
    if not known or len(set(names)) < len(names) or message.point_stride == 0 or len(message.data) % message.point_stride:
        raise BadInput(
            where,
            f"{len(message.data)} bytes of points do not fit the stride of {message.point_stride} bytes and the fields {names}",
            "record it again",
        )
    dtype = np.dtype(
        {
            "names": names,
            "formats": [_NUMPY_TYPES[f.type] for f in message.fields],
            "offsets": [f.offset for f in message.fields],
            "itemsize": message.point_stride,
        }
    )
    packed = np.frombuffer(message.data, dtype)
    return frame_of_columns({name: packed[name] for name in names}, _time_ns(message.timestamp), conventions, where)


def _timestamp(time_ns: int) -> Timestamp:
    return Timestamp(seconds=time_ns // 1_000_000_000, nanos=time_ns % 1_000_000_000)


def _time_ns(timestamp: Timestamp) -> int:
    return timestamp.seconds * 1_000_000_000 + timestamp.nanos
