"""Velodyne captures: UDP packets to revolutions that start at the rear, through velodyne-decoder."""

import itertools
import logging
import struct
from collections.abc import Iterator
from decimal import Decimal
from pathlib import Path

import dpkt
import numpy as np
import velodyne_decoder as vd
import yaml

from streetscan.errors import BadInput
from streetscan.frames import LEAST_COVERED, GpsFix, LidarFrame, drop_non_finite, nanoseconds
from streetscan.io.files import open_binary
from streetscan.io.point_columns import LidarConventions, stamp_forward

logger = logging.getLogger(__name__)
MODELS = {
    "hdl32e": vd.Model.HDL32E, "hdl64e_s1": vd.Model.HDL64E_S1, "hdl64e_s2": vd.Model.HDL64E_S2, "hdl64e_s3": vd.Model.HDL64E_S3,
    "puck_hi_res": vd.Model.PuckHiRes, "vlp16": vd.Model.VLP16, "vlp32a": vd.Model.VLP32A, "vlp32b": vd.Model.VLP32B,
    "vlp32c": vd.Model.VLP32C, "vls128": vd.Model.VLS128,
}  # fmt: skip
_N_LASERS = {"hdl32e": 32, "puck_hi_res": 16, "vlp16": 16, "vlp32a": 32, "vlp32b": 32, "vlp32c": 32, "vls128": 128}
_N_LASERS |= dict.fromkeys(("hdl64e_s1", "hdl64e_s2", "hdl64e_s3"), 64)
# The last byte of a packet names the product; a HDL-64E has its own use for it.
_PRODUCTS = {33: "hdl32e", 34: "vlp16", 35: "vlp32a or vlp32b", 36: "puck_hi_res", 40: "vlp32c", 161: "vls128"}
# Velodyne gives the intensity in one byte.
_INTENSITY_MAX = 255.0
_CUT_DEG = 180.0
# ASSUME: from one packet to the next the sensor turns as far as between the firings within one; 2.5 times as far is a gap. The
# smallest packet holds three firings, so one that is lost makes the step four times as long.
_LARGEST_STEP = 2.5
_LOWER_BLOCK = 0xDDFF
# Flag and azimuth of each of a packet's twelve blocks.
_HEADERS = struct.Struct("<" + "HH96x" * 12)
# Short packets are filled up to 60 bytes, and some cards add a checksum. A record that is longer than its packet by more than this
# has a damaged length, and where the next record begins is unknown.
_MOST_PADDING = 64
# ASSUME: a receiver's sentence reaches the sensor within a second, and the sensor repeats it until the next, a second later.
# An age beyond this comes from a sensor whose clock the receiver does not set.
_OLDEST_FIX_S = 3.0
# Kinds of captures: the parser of a packet and the bytes before its IP header.
_LINKS = {
    dpkt.pcap.DLT_EN10MB: (dpkt.ethernet.Ethernet, 14),
    dpkt.pcap.DLT_LINUX_SLL: (dpkt.sll.SLL, 16),
    dpkt.pcap.DLT_LINUX_SLL2: (dpkt.sll2.SLL2, 20),
}


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
            config.calibration = _read_calibration(calibration, model)
        elif model.startswith("hdl64e"):
            raise BadInput(where, "a HDL-64E without its unit's calibration", "name the unit's file in lidar.calibration")
        self._where, self._fov_deg, self._model = where, fov_deg, model
        self._decoder = vd.StreamDecoder(config)
        self._covered_deg = 0.0
        self._last_azimuth: int | None = None
        self._step = 0
        self._n_gaps = 0
        self._is_damaged = False
        self._n_packets = 0
        self._n_frames = 0

    def push(self, time_s: float, data: bytes) -> LidarFrame | None:
        """Take one packet (1206 bytes) received at `time_s`; the revolution it ends, or None.

        Raises:
            BadInput: the packet is not of this model, or cannot be decoded.
        """
        headers = _HEADERS.unpack_from(data)
        # Only a HDL-64E has a lower block of lasers; the decoder would turn the packets of any sensor into points of it.
        if self._model.startswith("hdl64e") and _LOWER_BLOCK not in headers[::2]:
            raise BadInput(self._where, f"packets of another sensor than '{self._model}'", "correct lidar.model in the drive's file")
        product = _PRODUCTS.get(data[-1], f"a product of number {data[-1]}")
        if not self._model.startswith("hdl64e") and self._model not in product:
            raise BadInput(self._where, f"packets of {product}, not of '{self._model}'", "correct lidar.model in the drive's file")
        result = self._decode(time_s, data)
        frame = None if result is None else self._frame(result, self._covered_deg)
        if result is not None:
            self._covered_deg = 0.0
        self._n_packets += 1
        self._cover(headers[1::2])
        return frame

    def lose(self) -> None:
        """A packet of the revolution under way was damaged: it will be `partial` at best."""
        self._is_damaged = True

    def finish(self) -> LidarFrame | None:
        """The revolution the recording ended in, or None; BadInput like push."""
        if self._n_gaps:
            logger.warning("%s: %d gaps between %d packets; packets were lost", self._where, self._n_gaps, self._n_packets)
        result = self._decode()
        return None if result is None else self._frame(result, self._covered_deg)

    def _cover(self, azimuths: tuple[int, ...]) -> None:
        """Add what a packet's firings and the step to them cover; a step over lost packets covers nothing.

        Args:
            azimuths: of the packet's blocks, hundredths of a degree. There are a dozen, for which plain numbers beat arrays.
        """
        steps = [(b - a) % 36_000 for a, b in itertools.pairwise(azimuths)]
        if turning := sorted(step for step in steps if step):
            self._step = turning[len(turning) // 2]
        if self._last_azimuth is not None:
            steps.append((azimuths[0] - self._last_azimuth) % 36_000)
        for step in steps:
            if step <= _LARGEST_STEP * self._step:
                self._covered_deg += step / 100
            # A sensor set to a sector jumps over the rest of the circle.
            elif self._fov_deg == 360 or step / 100 <= 0.9 * (360 - self._fov_deg):
                self._n_gaps += 1
        self._last_azimuth = azimuths[-1]

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
        if frame.status == "ok" and (self._is_damaged or covered_deg < LEAST_COVERED * self._fov_deg):
            frame.status = "partial"
        self._is_damaged = False
        return frame


def iterate_pcap(path: str | Path, decoder: PacketDecoder) -> Iterator[LidarFrame | GpsFix]:
    """The revolutions and positions of a Velodyne capture (pcap or pcapng), in constant memory.

    Args:
        path: the capture.
        decoder: for the sensor's model.
    Yields:
        frames cut at the rear; `partial` when azimuths are missing (the first, the last, lost packets) or a packet was cut,
        the last `truncated` when the file ends within a packet. A GpsFix for each new NMEA sentence
        of the sensor's GPS receiver, without altitude.
    Raises:
        BadInput: no such file, no capture, no lidar packet in it.
    """
    path = Path(path)
    n_packets, n_cut, n_repeated, is_cut, sentence, last = 0, 0, 0, False, None, None
    with open_binary(path) as stream:
        packets, link = _open_capture(stream, path)
        held = None
        while True:
            try:
                time_s, buffer = next(packets)
                payload, is_whole = _udp_payload(buffer, *link)
            except StopIteration:
                break
            except (dpkt.dpkt.UnpackError, ValueError, struct.error, IndexError) as error:
                logger.warning("%s: is damaged or cut after %d packets (%s); nothing more can be read", path, n_packets, error)
                is_cut = True
                break
            is_cut = not is_whole
            if is_cut:
                n_cut += 1
                decoder.lose()
                continue
            if payload is None:
                continue
            if len(payload) == vd.PACKET_SIZE:
                n_packets += 1
                # A capture of two cards, or of a mirrored port, has every packet twice.
                if payload == last:
                    n_repeated += 1
                    continue
                last = payload
                if (frame := decoder.push(float(time_s), payload)) is not None:
                    yield frame
            elif len(payload) == vd.TELEMETRY_PACKET_SIZE:
                fix, sentence = _fix(payload, float(time_s), sentence)
                if fix is not None:
                    yield fix
    if n_cut:
        logger.warning("%s: %d packets are cut short; capture whole packets (tcpdump -s 0)", path, n_cut)
    if n_repeated:
        logger.warning("%s: %d of %d packets repeat the one before and were left out", path, n_repeated, n_packets)
    if n_packets == 0 and n_cut:
        raise BadInput(path, f"holds no whole packet, {n_cut} are cut short", "capture whole packets (tcpdump -s 0)")
    if n_packets == 0:
        raise BadInput(path, "holds no Velodyne data packet (1206 bytes)", "give a capture of the sensor's UDP port 2368")
    held = decoder.finish()
    if held is not None:
        if is_cut:
            held.status = "truncated"
        yield held


def _open_capture(stream: object, path: Path) -> tuple[Iterator[tuple[float | Decimal, bytes]], tuple[type[dpkt.Packet], int]]:
    """The stamped packets of a capture, and how they are read: see _LINKS."""
    try:
        reader = dpkt.pcap.UniversalReader(stream)
        link = reader.datalink()
        packets = iter(reader)
    except (ValueError, dpkt.dpkt.UnpackError, struct.error, IndexError, KeyError) as error:
        raise BadInput(path, f"is no pcap or pcapng capture ({error})", "record it with tcpdump or Wireshark") from error
    if link not in _LINKS:
        raise BadInput(path, f"a capture of link type {link}", "capture the network card the sensor is on (tcpdump -i <card>)")
    return packets, _LINKS[link]


def _udp_payload(buffer: bytes, kind: type[dpkt.Packet], n_header: int) -> tuple[bytes | None, bool]:
    """The UDP payload of a captured frame, or None for other traffic; and whether the packet is whole.

    Raises:
        ValueError: the frame is longer than the packet in it.
    """
    try:
        packet = kind(buffer)
    except (dpkt.dpkt.UnpackError, struct.error, IndexError, ValueError):
        return None, len(buffer) >= n_header
    ip = packet.data
    if isinstance(ip, dpkt.ip.IP) and ip.len and len(buffer) - n_header - ip.len > _MOST_PADDING:
        raise ValueError(f"a record of {len(buffer)} bytes for a packet of {ip.len}")
    udp = getattr(ip, "data", None)
    if isinstance(udp, dpkt.udp.UDP):
        payload = bytes(udp.data)
        return payload, len(payload) >= udp.ulen - 8
    if isinstance(ip, dpkt.ip.IP):
        return None, ip.len <= len(buffer) - n_header
    # An IP header that is not all there stays bytes.
    return None, _link_type(packet) != dpkt.ethernet.ETH_TYPE_IP


def _link_type(packet: dpkt.Packet) -> int:
    return packet.type if isinstance(packet, dpkt.ethernet.Ethernet) else packet.ethtype


def _fix(payload: bytes, time_s: float, last_sentence: str | None) -> tuple[GpsFix | None, str | None]:
    """A position packet's fix, when its NMEA sentence is a new one (the sensor repeats each for a second).

    It is stamped with the moment the sentence speaks of: the packet's arrival less the age of the sentence on the sensor's clock,
    which the receiver sets. At 15 m/s the arrival alone would be wrong by up to 20 m.
    """
    try:
        telemetry = vd.TelemetryPacket(payload)
        position, sentence = telemetry.gps_position, telemetry.nmea_sentence
    except (RuntimeError, ValueError, IndexError, UnicodeDecodeError):
        return None, last_sentence
    if position is None or sentence == last_sentence or not np.isfinite(position[:2]).all():
        return None, last_sentence
    longitude_deg, latitude_deg = position[:2]
    altitude_m = float(position[2]) if sentence and "GGA" in sentence[:6] else float("nan")
    return GpsFix(nanoseconds(time_s - _age_s(telemetry)), latitude_deg, longitude_deg, altitude_m), sentence


def _age_s(telemetry: vd.TelemetryPacket) -> float:
    """Seconds from the moment a position packet's sentence speaks of to the packet; 0 when the sensor's clock is not the receiver's."""
    moment = telemetry.parse_nmea()
    age_s = (telemetry.usec_since_toh * 1e-6 - 60 * moment.utc_minutes - moment.utc_seconds) % 3600
    return age_s if age_s <= _OLDEST_FIX_S else 0.0


def _read_calibration(path: str | Path, model: str) -> vd.Calibration:
    if not Path(path).is_file():
        raise BadInput(path, "no such file", "check lidar.calibration in the drive's file")
    try:
        calibration = vd.Calibration.read(str(path))
        n_lasers = len(yaml.safe_load(calibration.to_string())["lasers"])
    except (RuntimeError, ValueError, IndexError, MemoryError) as error:
        raise BadInput(path, f"is no Velodyne calibration ({error})", "give the YAML with the 'lasers' of the unit") from error
    if n_lasers != _N_LASERS[model]:
        raise BadInput(path, f"has {n_lasers} lasers, a '{model}' has {_N_LASERS[model]}", "give the calibration of this very unit")
    return calibration
