"""Velodyne captures: UDP packets to revolutions that start at the rear, through velodyne-decoder."""

import struct
from collections.abc import Iterator
from decimal import Decimal
from pathlib import Path

import dpkt
import numpy as np
import velodyne_decoder as vd

from streetscan.errors import BadInput
from streetscan.frames import LEAST_COVERED, GpsFix, LidarFrame, drop_non_finite, nanoseconds
from streetscan.io.point_columns import LidarConventions, stamp_forward

MODELS = {
    "hdl32e": vd.Model.HDL32E, "hdl64e_s1": vd.Model.HDL64E_S1, "hdl64e_s2": vd.Model.HDL64E_S2, "hdl64e_s3": vd.Model.HDL64E_S3,
    "puck_hi_res": vd.Model.PuckHiRes, "vlp16": vd.Model.VLP16, "vlp32a": vd.Model.VLP32A, "vlp32b": vd.Model.VLP32B,
    "vlp32c": vd.Model.VLP32C, "vls128": vd.Model.VLS128,
}  # fmt: skip
# Velodyne gives the intensity in one byte.
_INTENSITY_MAX = 255.0
_CUT_DEG = 180.0
# ASSUME: packets are less than 10 degrees apart (0.2 to 0.5 are usual); a larger step is a gap.
_LARGEST_STEP_DEG = 10.0


class PacketDecoder:
    """Turns the packets of one Velodyne into revolutions cut at the rear, in the order they arrive."""

    def __init__(
        self,
        model: str,
        calibration: str | Path | None = None,
        where: object = "packets",
        fov_deg: float = 360.0,
        min_range_m: float = 0.1,
        max_range_m: float = 300.0,
    ):
        """
        Args:
            model: a key of MODELS.
            calibration: a unit's calibration (YAML as ROS and velodyne-decoder write it); None: the model's bundled one.
            where: the recording, named in errors.
            fov_deg: horizontal field of view the sensor was set to.
            min_range_m, max_range_m: returns outside are left out by the decoder.
        Raises:
            BadInput: a model we do not know, a HDL-64E without calibration, or a calibration that cannot be read.
        """
        if model not in MODELS:
            raise BadInput(where, f"'{model}' is no Velodyne we know", f"write lidar.model as one of {', '.join(MODELS)}")
        config = vd.Config(model=MODELS[model], cut_angle=_CUT_DEG, min_range=min_range_m, max_range=max_range_m)
        if calibration is not None:
            config.calibration = _read_calibration(calibration)
        elif model.startswith("hdl64e"):
            raise BadInput(where, "a HDL-64E without its unit's calibration", "name the unit's file in lidar.calibration")
        self._where, self._fov_deg = where, fov_deg
        self._decoder = vd.StreamDecoder(config)
        self._covered_deg = 0.0
        self._last_azimuth_deg: float | None = None
        self._n_packets = 0
        self._n_frames = 0

    def push(self, time_s: float, data: bytes) -> LidarFrame | None:
        """Take one packet (1206 bytes) received at `time_s`; the revolution it ends, or None.

        Raises:
            BadInput: the packet is not of this model, or cannot be decoded.
        """
        azimuths_deg = [struct.unpack_from("<H", data, 100 * block + 2)[0] / 100 for block in range(12)]
        result = self._decode(time_s, data)
        frame = None if result is None else self._frame(result, self._covered_deg)
        if result is not None:
            self._covered_deg = 0.0
        self._n_packets += 1
        for azimuth_deg in azimuths_deg:
            if self._last_azimuth_deg is not None:
                step_deg = (azimuth_deg - self._last_azimuth_deg) % 360
                self._covered_deg += step_deg if step_deg < _LARGEST_STEP_DEG else 0.0
            self._last_azimuth_deg = azimuth_deg
        return frame

    def finish(self) -> LidarFrame | None:
        """The revolution the recording ended in, or None; BadInput like push."""
        result = self._decode()
        return None if result is None else self._frame(result, self._covered_deg)

    def _decode(self, *packet: float | bytes) -> tuple | None:
        try:
            return self._decoder.decode(*packet) if packet else self._decoder.finish()
        except (RuntimeError, ValueError, IndexError, MemoryError) as error:
            raise BadInput(self._where, f"a packet cannot be decoded ({error})", "check lidar.model in the drive's file") from error

    def _frame(self, result: tuple, covered_deg: float) -> LidarFrame:
        stamp, cloud = result
        frame = LidarFrame(
            nanoseconds(stamp.host),
            np.ascontiguousarray(cloud[:, :3]),
            cloud[:, 3] / np.float32(_INTENSITY_MAX),
            cloud[:, 6].astype(np.uint16),
            number=self._n_frames,
        )
        self._n_frames += 1
        frame = stamp_forward(frame, cloud[:, 4].astype(np.float64), LidarConventions(stamp="end"))
        frame = drop_non_finite(frame)
        if frame.status == "ok" and covered_deg < LEAST_COVERED * self._fov_deg:
            frame.status = "partial"
        return frame


def iterate_pcap(path: str | Path, decoder: PacketDecoder) -> Iterator[LidarFrame | GpsFix]:
    """The revolutions and positions of a Velodyne capture (pcap or pcapng), in constant memory.

    Args:
        path: the capture.
        decoder: for the sensor's model.
    Yields:
        frames cut at the rear; the first and the last have status `partial` unless complete, the last `truncated` when
        the file ends within a packet. A GpsFix for each new NMEA sentence of the sensor's GPS receiver, without altitude.
    Raises:
        BadInput: no such file, no capture, no lidar packet in it.
    """
    path = Path(path)
    if not path.is_file():
        raise BadInput(path, "no such file", "check the drive's file and data_root")
    n_packets, is_cut, sentence = 0, False, None
    with path.open("rb") as stream:
        packets = _open_capture(stream, path)
        held = None
        while True:
            try:
                time_s, buffer = next(packets)
            except StopIteration:
                break
            except (dpkt.dpkt.UnpackError, ValueError, struct.error, IndexError):
                is_cut = True
                break
            payload, is_whole = _udp_payload(buffer)
            if not is_whole:
                is_cut = True
                continue
            if payload is None:
                continue
            if len(payload) == vd.PACKET_SIZE:
                n_packets += 1
                if (frame := decoder.push(float(time_s), payload)) is not None:
                    yield frame
            elif len(payload) == vd.TELEMETRY_PACKET_SIZE:
                fix, sentence = _fix(payload, float(time_s), sentence)
                if fix is not None:
                    yield fix
    if n_packets == 0:
        raise BadInput(path, "holds no Velodyne data packet (1206 bytes)", "give a capture of the sensor's UDP port 2368")
    held = decoder.finish()
    if held is not None:
        if is_cut:
            held.status = "truncated"
        yield held


def _open_capture(stream: object, path: Path) -> Iterator[tuple[float | Decimal, bytes]]:
    try:
        return iter(dpkt.pcap.UniversalReader(stream))
    except (ValueError, dpkt.dpkt.UnpackError, struct.error, IndexError, KeyError) as error:
        raise BadInput(path, f"is no pcap or pcapng capture ({error})", "record it with tcpdump or Wireshark") from error


def _udp_payload(buffer: bytes) -> tuple[bytes | None, bool]:
    """The UDP payload of an Ethernet frame, or None for other traffic; and whether the packet is whole."""
    try:
        packet = dpkt.ethernet.Ethernet(buffer)
    except (dpkt.dpkt.UnpackError, struct.error, IndexError, ValueError):
        return None, len(buffer) >= 14
    ip = packet.data
    if isinstance(ip, dpkt.ip.IP) and ip.len > len(buffer) - 14:
        return None, False
    udp = getattr(ip, "data", None)
    if not isinstance(udp, dpkt.udp.UDP):
        return None, True
    payload = bytes(udp.data)
    return payload, len(payload) >= udp.ulen - 8


def _fix(payload: bytes, time_s: float, last_sentence: str | None) -> tuple[GpsFix | None, str | None]:
    """A position packet's fix, when its NMEA sentence is a new one (the sensor repeats each for a second)."""
    try:
        telemetry = vd.TelemetryPacket(payload)
        position, sentence = telemetry.gps_position, telemetry.nmea_sentence
    except (RuntimeError, ValueError, IndexError, UnicodeDecodeError):
        return None, last_sentence
    if position is None or sentence == last_sentence or not np.isfinite(position[:2]).all():
        return None, last_sentence
    longitude_deg, latitude_deg = position[:2]
    altitude_m = float(position[2]) if sentence and "GGA" in sentence[:6] else float("nan")
    return GpsFix(nanoseconds(time_s), latitude_deg, longitude_deg, altitude_m), sentence


def _read_calibration(path: str | Path) -> vd.Calibration:
    if not Path(path).is_file():
        raise BadInput(path, "no such file", "check lidar.calibration in the drive's file")
    try:
        return vd.Calibration.read(str(path))
    except (RuntimeError, ValueError, IndexError, MemoryError) as error:
        raise BadInput(path, f"is no Velodyne calibration ({error})", "give the YAML with the 'lasers' of the unit") from error
