import struct

import dpkt
import numpy as np
import pytest
import velodyne_decoder as vd
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from toy_recordings import PERIOD_S, START_NS, position_packet, vlp16_packets, write_pcap

from streetscan.errors import BadInput
from streetscan.frames import STATUSES, GpsFix, LidarFrame
from streetscan.io.pcap import PacketDecoder, iterate_pcap

SENTENCE = "$GPGGA,120000,4900.0000,N,00830.0000,E,1,08,0.9,120.5,M,46.9,M,,"


def frames_of(path, model="vlp16", **settings):
    return [r for r in iterate_pcap(path, PacketDecoder(model, **settings)) if isinstance(r, LidarFrame)]


def fixes_of(path):
    return [r for r in iterate_pcap(path, PacketDecoder("vlp16")) if isinstance(r, GpsFix)]


def test_revolutions_start_at_the_rear_and_are_stamped_forward(tmp_path):
    frames = frames_of(write_pcap(tmp_path / "a.pcap", vlp16_packets(3)))
    assert [f.status for f in frames] == ["ok"] * 3
    # Cuts fall between packets, so a revolution may have one more or less.
    assert sum(len(f) for f in frames) == 3 * 75 * 12 * 32
    assert max(abs(len(f) - 75 * 12 * 32) for f in frames) <= 12 * 32
    for i, frame in enumerate(frames):
        # Packets are stamped when they are complete; forward is half a revolution after the rear.
        assert (frame.time_ns - START_NS) * 1e-9 == pytest.approx((i + 0.5) * PERIOD_S, abs=2e-3)
        assert frame.time_offset_s.min() == pytest.approx(-PERIOD_S / 2, abs=2e-3)
        assert frame.time_offset_s.max() == pytest.approx(PERIOD_S / 2, abs=2e-3)
        azimuths = np.degrees(np.arctan2(frame.points[:, 1], frame.points[:, 0]))
        assert np.abs(azimuths[:16] - 180).max() % 360 < 5
        forward = np.abs(azimuths) < 0.3
        assert np.abs(frame.time_offset_s[forward]).max() < 3e-4
        # Clockwise: the left is seen before forward.
        assert frame.time_offset_s[(azimuths > 10) & (azimuths < 170)].max() < 0
        np.testing.assert_allclose(np.linalg.norm(frame.points, axis=1), 10, atol=0.1)
        assert frame.intensity[0] == np.float32(100 / 255)
        assert frame.ring.max() == 15


def test_incomplete_revolutions_are_partial(tmp_path):
    frames = frames_of(write_pcap(tmp_path / "a.pcap", vlp16_packets(2.5, first_deg=90)))
    assert [f.status for f in frames] == ["partial", "ok", "ok", "partial"]
    assert sum(len(f) for f in frames) == round(2.5 * 75) * 12 * 32


def test_a_sector_is_whole_when_it_was_set(tmp_path):
    packets = [
        p
        for p in vlp16_packets(3)
        if struct.unpack_from("<H", p[1], 2)[0] / 100 % 360 < 90 or struct.unpack_from("<H", p[1], 2)[0] / 100 > 270
    ]
    path = write_pcap(tmp_path / "a.pcap", packets)
    assert {f.status for f in frames_of(path)} == {"partial"}
    assert {f.status for f in frames_of(path, fov_deg=175)} == {"ok"}


def test_a_gap_in_the_packets_is_partial(tmp_path):
    packets = vlp16_packets(3)
    frames = frames_of(write_pcap(tmp_path / "a.pcap", packets[:90] + packets[110:]))
    assert [f.status for f in frames] == ["ok", "partial", "ok"]


def test_positions_come_once_per_sentence(tmp_path):
    packets = vlp16_packets(1)
    mixed = (
        [(packets[0][0], position_packet(SENTENCE))] * 2 + packets + [(packets[-1][0], position_packet(SENTENCE.replace("4900", "4800")))]
    )
    fixes = fixes_of(write_pcap(tmp_path / "a.pcap", mixed))
    assert [(round(f.latitude_deg, 6), round(f.longitude_deg, 6)) for f in fixes] == [(49.0, 8.5), (48.0, 8.5)]
    assert fixes[0].altitude_m == pytest.approx(120.5 + 46.9)


@pytest.mark.parametrize(("clock_s", "age_s"), [(1.5, 1.5), (0.2, 0.2), (700.0, 0.0)])
def test_a_fix_is_stamped_with_the_moment_it_speaks_of(tmp_path, clock_s, age_s):
    """The sentence is of 12:00:00; the sensor's clock, set by the receiver, says how old it is. A clock of its own says nothing."""
    packet = bytearray(position_packet(SENTENCE))
    packet[198:202] = struct.pack("<I", round(clock_s * 1e6))
    packets = vlp16_packets(1)
    fix = fixes_of(write_pcap(tmp_path / "a.pcap", [*packets, (packets[-1][0], bytes(packet))]))[0]
    assert packets[-1][0] - fix.time_ns * 1e-9 == pytest.approx(age_s, abs=1e-5)


# One byte each of: data, UDP header, IP header, Ethernet header, the record's own header.
@pytest.mark.parametrize("n_cut", [1, 500, 1200, 1207, 1213, 1230, 1241, 1247, 1255])
def test_cut_within_a_packet(tmp_path, n_cut):
    path = write_pcap(tmp_path / "a.pcap", vlp16_packets(2))
    path.write_bytes(path.read_bytes()[:-n_cut])
    assert [f.status for f in frames_of(path)] == ["ok", "truncated"]


def test_equal_to_the_library_itself(tmp_path):
    path = write_pcap(tmp_path / "a.pcap", vlp16_packets(2.3, first_deg=33))
    n_library = sum(len(p) for _, p in vd.read_pcap(path, vd.Config(model=vd.Model.VLP16)))
    assert sum(len(f) for f in frames_of(path)) == n_library > 0


@pytest.mark.parametrize(
    ("content", "found"),
    [(b"", "no pcap"), (b"no capture at all", "no pcap"), ("other traffic", "no Velodyne data packet"), (None, "no such file")],
)
def test_what_is_no_capture_of_the_sensor(tmp_path, content, found):
    path = tmp_path / "a.pcap"
    if content == "other traffic":
        write_pcap(path, [(0.0, b"x" * 100)])
    elif content is not None:
        path.write_bytes(content)
    with pytest.raises(BadInput, match=found):
        frames_of(path)


def test_another_model_is_said(tmp_path):
    path = write_pcap(tmp_path / "a.pcap", vlp16_packets(1))
    with pytest.raises(BadInput, match=r"packets of vlp16, not of 'hdl32e'; correct lidar\.model"):
        frames_of(path, "hdl32e")
    with pytest.raises(BadInput, match="no Velodyne we know"):
        PacketDecoder("hdl999")
    with pytest.raises(BadInput, match="calibration"):
        PacketDecoder("hdl64e_s3")


def test_a_calibration_that_is_none(tmp_path):
    (tmp_path / "unit.yaml").write_text("lasers: 3\n")
    with pytest.raises(BadInput, match=r"unit\.yaml"):
        PacketDecoder("hdl64e_s3", tmp_path / "unit.yaml")


def hdl64_packet(azimuth_deg, range_m):
    """Six firings of both blocks of a HDL-64E."""
    data = b""
    for i in range(12):
        header = 0xEEFF if i % 2 == 0 else 0xDDFF
        azimuth = round((azimuth_deg + i // 2 * 0.17) % 360 * 100) % 36000
        data += struct.pack("<HH", header, azimuth) + struct.pack("<HB", round(range_m / 0.002), 80) * 32
    return data + struct.pack("<IBB", 0, 0, 0)


def write_unit(path, n_lasers, elevation_rad=0.0):
    """A calibration whose beams all point alike."""
    zeros = ("rot_correction", "dist_correction", "dist_correction_x", "dist_correction_y", "vert_offset_correction")
    zeros += ("horiz_offset_correction", "focal_distance", "focal_slope")
    laser = dict.fromkeys(zeros, 0.0) | {"vert_correction": elevation_rad, "min_intensity": 0, "max_intensity": 255}
    lasers = [laser | {"laser_id": i} for i in range(n_lasers)]
    path.write_text(yaml.safe_dump({"lasers": lasers, "num_lasers": n_lasers, "distance_resolution": 0.002}))


def test_a_units_own_calibration_is_used(tmp_path):
    """Every beam of the made unit points 10 degrees down; the bundled tables would spread them."""
    write_unit(tmp_path / "unit.yaml", 64, -np.radians(10).item())
    packets = [(START_NS * 1e-9 + i * 2.9e-4, hdl64_packet(180 + i * 6 * 0.17, 10.0)) for i in range(400)]
    frames = frames_of(write_pcap(tmp_path / "a.pcap", packets), "hdl64e_s3", calibration=tmp_path / "unit.yaml")
    assert frames[0].status == "ok"
    assert set(frames[0].ring.tolist()) == set(range(64))
    elevations = np.degrees(np.arcsin(frames[0].points[:, 2] / np.linalg.norm(frames[0].points, axis=1)))
    np.testing.assert_allclose(elevations, -10, atol=1e-3)


# A part of the usual number of examples: each one writes and reads files. A profile with more scales along.
@settings(max_examples=settings.default.max_examples // 2, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_damaged_captures(tmp_path, data):
    path = write_pcap(tmp_path / "a.pcap", vlp16_packets(1.2))
    damaged = bytearray(path.read_bytes())
    for _ in range(data.draw(st.integers(0, 6))):
        at = data.draw(st.one_of(st.integers(0, 200), st.integers(0, len(damaged) - 1)))
        damaged[at] = data.draw(st.integers(0, 255))
    path.write_bytes(damaged[: data.draw(st.integers(0, len(damaged)))])
    try:
        frames = frames_of(path)
    except BadInput as error:
        assert "a.pcap" in str(error) or "packets" in str(error)  # noqa: PT017
    else:
        assert all(f.status in STATUSES and np.isfinite(f.points).all() for f in frames)


def test_single_lost_packets_add_up(tmp_path, caplog):
    packets = vlp16_packets(3)
    assert [f.status for f in frames_of(write_pcap(tmp_path / "a.pcap", packets[::2]))] == ["partial"] * 3
    # One packet of 75 is within what a revolution may lack, and is said.
    with caplog.at_level("WARNING"):
        assert [f.status for f in frames_of(write_pcap(tmp_path / "a.pcap", packets[:30] + packets[31:]))] == ["ok"] * 3
    assert "1 gaps between 224 packets" in caplog.text


def shorten(path, n_every):
    """The capture with every n-th packet as a short snap length would leave it."""
    with path.open("rb") as stream:
        packets = list(dpkt.pcap.Reader(stream))
    with path.open("wb") as stream:
        writer = dpkt.pcap.Writer(stream)
        for i, (time_s, data) in enumerate(packets):
            writer.writepkt(data[:600] if i % n_every == 1 % n_every else data, time_s)
    return path


def test_cut_packets_leave_their_mark(tmp_path, caplog):
    with caplog.at_level("WARNING"):
        frames = frames_of(shorten(write_pcap(tmp_path / "a.pcap", vlp16_packets(3)), 4))
    assert [f.status for f in frames] == ["partial"] * 3
    assert "56 packets are cut short" in caplog.text
    # A single one: only its own revolution.
    frames = frames_of(shorten(write_pcap(tmp_path / "a.pcap", vlp16_packets(3)), 10_000))
    assert [f.status for f in frames] == ["partial", "ok", "ok"]
    with pytest.raises(BadInput, match="no whole packet"):
        frames_of(shorten(write_pcap(tmp_path / "a.pcap", vlp16_packets(1)), 1))


@pytest.mark.parametrize("link", [113, 276, 228])
def test_captures_of_any_card(tmp_path, link):
    path = write_pcap(tmp_path / "a.pcap", vlp16_packets(1))
    with path.open("rb") as stream:
        packets = list(dpkt.pcap.Reader(stream))
    n_header = {113: 16, 276: 20, 228: 0}[link]
    header = b"\x08\x00".ljust(n_header, b"\0") if link == 276 else b"\x08\x00".rjust(n_header, b"\0")
    with path.open("wb") as stream:
        writer = dpkt.pcap.Writer(stream, linktype=link)
        for time_s, data in packets:
            writer.writepkt((header if n_header else b"") + data[14:], time_s)
    if link == 228:
        with pytest.raises(BadInput, match="link type 228"):
            frames_of(path)
    else:
        assert sum(len(f) for f in frames_of(path)) == 75 * 12 * 32


def test_packets_of_another_sensor_are_no_hdl64(tmp_path):
    write_unit(tmp_path / "unit.yaml", 64)
    path = write_pcap(tmp_path / "a.pcap", vlp16_packets(1))
    with pytest.raises(BadInput, match="another sensor"):
        frames_of(path, "hdl64e_s3", calibration=tmp_path / "unit.yaml")


def refuse(*_, **__):
    raise PermissionError(13, "Permission denied")


def test_a_capture_nobody_may_read(tmp_path, monkeypatch):
    path = write_pcap(tmp_path / "a.pcap", vlp16_packets(1))
    monkeypatch.setattr(type(path), "open", refuse)
    with pytest.raises(BadInput, match="Permission denied"):
        frames_of(path)


def test_a_calibration_of_another_sensor(tmp_path):
    write_unit(tmp_path / "unit.yaml", 32)
    with pytest.raises(BadInput, match=r"unit\.yaml: has 32 lasers, a 'vlp16' has 16"):
        PacketDecoder("vlp16", tmp_path / "unit.yaml")


def test_an_ip_length_that_is_wrong_cuts_nothing(tmp_path):
    """Old firmware writes the IP length of data packets into position packets."""
    packets = vlp16_packets(2)
    path = write_pcap(tmp_path / "a.pcap", [*packets[:30], (packets[30][0], position_packet(SENTENCE)), *packets[30:]])
    right, wrong = struct.pack(">H", 512 + 28), struct.pack(">H", 1206 + 28)
    data = path.read_bytes()
    assert data.count(b"\x45\x00" + right) == 1
    path.write_bytes(data.replace(b"\x45\x00" + right, b"\x45\x00" + wrong))
    assert [f.status for f in frames_of(path)] == ["ok", "ok"]
    assert len(fixes_of(path)) == 1


def test_packets_captured_twice_are_taken_once(tmp_path, caplog):
    packets = vlp16_packets(2)
    with caplog.at_level("WARNING"):
        frames = frames_of(write_pcap(tmp_path / "a.pcap", [p for packet in packets for p in (packet, packet)]))
    assert sum(len(f) for f in frames) == 2 * 75 * 12 * 32
    assert "150 of 300 packets repeat the one before" in caplog.text
    assert "lost" not in caplog.text


@pytest.mark.parametrize("n_revolutions", [2, 6])
def test_a_record_of_absurd_length_ends_the_capture(tmp_path, caplog, n_revolutions):
    path = write_pcap(tmp_path / "a.pcap", vlp16_packets(n_revolutions))
    data = bytearray(path.read_bytes())
    size = (len(data) - 24) // (75 * n_revolutions)
    at = 24 + 100 * size
    data[at + 8 : at + 12] = struct.pack("<I", 2**31)
    path.write_bytes(data)
    with caplog.at_level("WARNING"):
        assert [f.status for f in frames_of(path)] == ["ok", "truncated"]
    assert "damaged or cut after 100 packets" in caplog.text
