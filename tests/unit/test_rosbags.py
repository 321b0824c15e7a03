import shutil
import sqlite3

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from toy_recordings import PERIOD_S, START_NS, Messages, png, revolution, ros_store, vlp16_packets, write_bag

from streetscan.errors import BadInput
from streetscan.frames import CameraImage, GpsFix, LidarFrame
from streetscan.io.images import decode_image
from streetscan.io.pcap import PacketDecoder
from streetscan.io.point_columns import LidarConventions
from streetscan.io.rosbags import MessageConverter, iterate_bag, iterate_ros_mcap

KINDS = ("sqlite3", "mcap", "ros1")
TOPICS = ("/points", "/image", "/raw", "/fix")
START = LidarConventions(stamp="start")


def items_of(kind, n_frames=3):
    """One cloud, compressed image, raw image and fix per revolution; the clouds are stamped at the start of their revolution."""
    make = Messages(ros_store(kind == "ros1"), kind == "ros1")
    items = []
    for i in range(n_frames):
        points, intensity, times = revolution(seed=i)
        start_ns = START_NS + i * 100_000_000
        columns = {"x": points[:, 0], "y": points[:, 1], "z": points[:, 2], "intensity": intensity}
        columns |= {"ring": np.full(len(points), i, np.uint16), "time": (times + PERIOD_S / 2).astype(np.float32)}
        items.append(("/points", start_ns, make.cloud(start_ns, columns)))
        items.append(("/image", start_ns + 1, make.compressed(start_ns + 1, png(i))))
        pixels = np.random.default_rng(i).integers(0, 255, (8, 10, 3), np.uint8)
        items.append(("/raw", start_ns + 2, make.image(start_ns + 2, pixels, "rgb8", padding=2)))
        items.append(("/fix", start_ns + 3, make.fix(start_ns + 3, 49.0 + i, 8.4, 110.0, status=-1 if i == 1 else 0)))
    return items


def read(path, topics=TOPICS, conventions=START, packets=None):
    converter = MessageConverter(path, conventions, packets)
    iterate = iterate_ros_mcap if path.suffix == ".mcap" else iterate_bag
    return list(iterate(path, topics, converter)), converter


@pytest.mark.parametrize("kind", KINDS)
def test_everything_comes_out(tmp_path, kind):
    path = write_bag(tmp_path / ("toy.bag" if kind == "ros1" else "toy"), items_of(kind), kind)
    check_contents(*read(path))


def test_a_single_mcap_with_ros_messages(tmp_path):
    write_bag(tmp_path / "toy", items_of("mcap"), "mcap")
    check_contents(*read(next((tmp_path / "toy").glob("*.mcap"))))


def check_contents(records, converter):
    frames = [r for r in records if isinstance(r, LidarFrame)]
    assert [f.number for f in frames] == [0, 1, 2]
    for i, frame in enumerate(frames):
        points, intensity, times = revolution(seed=i)
        np.testing.assert_array_equal(frame.points, points)
        np.testing.assert_array_equal(frame.intensity, intensity)
        np.testing.assert_allclose(frame.time_offset_s, times, atol=2e-6)
        assert abs(frame.time_ns - (START_NS + i * 100_000_000 + 50_000_000)) < 3000
        assert (frame.ring == i).all()
    images = [r for r in records if isinstance(r, CameraImage)]
    assert [im.status for im in images] == ["ok"] * 6
    assert images[0].data == png(0)
    pixels = np.random.default_rng(0).integers(0, 255, (8, 10, 3), np.uint8)
    np.testing.assert_array_equal(decode_image(images[1]), pixels)
    fixes = [r for r in records if isinstance(r, GpsFix)]
    assert [f.latitude_deg for f in fixes] == [49.0, 51.0]
    assert converter.n_without_position == 1
    assert fixes[0].covariance_m2[0, 0] == 1


@pytest.mark.parametrize(
    ("name", "dtype", "scale", "absolute"),
    [
        ("t", np.uint32, 1e9, False),
        ("timestamp", np.float64, 1, True),
        ("offset_time", np.uint32, 1e9, False),
        ("time", np.float32, 1, False),
    ],
)
def test_times_as_drivers_write_them(tmp_path, name, dtype, scale, absolute):
    points, _, times = revolution()
    values = (times + PERIOD_S / 2 + (START_NS * 1e-9 if absolute else 0)) * scale
    make = Messages(ros_store())
    columns = {"x": points[:, 0], "y": points[:, 1], "z": points[:, 2], name: values.astype(dtype)}
    path = write_bag(tmp_path / "toy", [("/points", START_NS, make.cloud(START_NS, columns))])
    frame = read(path, ("/points",))[0][0]
    np.testing.assert_allclose(frame.time_offset_s, times, atol=2e-6)
    assert abs(frame.time_ns - START_NS - 50_000_000) < 3000


@pytest.mark.parametrize(("stamp", "shift_ns"), [("start", 50_000_000), ("end", -50_000_000), ("forward", 0)])
def test_without_times_the_azimuth_tells(tmp_path, stamp, shift_ns):
    points, _, times = revolution()
    make = Messages(ros_store())
    cloud = make.cloud(START_NS, {"x": points[:, 0], "y": points[:, 1], "z": points[:, 2]})
    frame = read(write_bag(tmp_path / "toy", [("/points", START_NS, cloud)]), ("/points",), LidarConventions(stamp=stamp))[0][0]
    assert frame.time_ns == START_NS + shift_ns
    np.testing.assert_allclose(frame.time_offset_s, times, atol=1e-6)
    assert frame.intensity is None


def test_organized_big_endian_clouds_with_missing_returns(tmp_path):
    points, _, _ = revolution(360)
    points[5] = np.nan
    make = Messages(ros_store())
    columns = {"x": points[:, 0], "y": points[:, 1], "z": points[:, 2]}
    cloud = make.cloud(START_NS, columns, big_endian=True, n_rows=4, padding=7)
    frame = read(write_bag(tmp_path / "toy", [("/points", START_NS, cloud)]), ("/points",))[0][0]
    assert (len(frame), frame.n_dropped, frame.status) == (359, 1, "ok")
    np.testing.assert_array_equal(frame.points, np.delete(points, 5, axis=0))


def test_returns_without_a_time_are_left_out(tmp_path):
    points, _, times = revolution()
    times = (times + PERIOD_S / 2).astype(np.float64)
    times[4], times[9], times[11] = np.nan, np.inf, 1e30
    cloud = Messages(ros_store()).cloud(START_NS, {"x": points[:, 0], "y": points[:, 1], "z": points[:, 2], "time": times})
    frame = read(write_bag(tmp_path / "toy", [("/points", START_NS, cloud)]), ("/points",))[0][0]
    assert (len(frame), frame.n_dropped) == (357, 3)
    assert abs(frame.time_ns - START_NS - 50_000_000) < 3000
    assert np.abs(frame.time_offset_s).max() < 0.051


def test_an_empty_cloud_is_an_empty_frame(tmp_path):
    make = Messages(ros_store())
    cloud = make.cloud(START_NS, {axis: np.empty(0, np.float32) for axis in "xyz"})
    frame = read(write_bag(tmp_path / "toy", [("/points", START_NS, cloud)]), ("/points",))[0][0]
    assert (len(frame), frame.status) == (0, "empty")


@pytest.mark.parametrize(
    ("encoding", "pixels", "expected"),
    [
        ("mono8", np.full((4, 6), 9, np.uint8), (9, 9, 9)),
        ("bgr8", np.full((4, 6, 3), (1, 2, 3), np.uint8), (3, 2, 1)),
        ("rgba8", np.full((4, 6, 4), (1, 2, 3, 255), np.uint8), (1, 2, 3)),
        ("mono16", np.full((4, 6), 256 * 7, np.uint16), (7, 7, 7)),
        ("bayer_rggb8", np.tile(np.array([[200, 50], [50, 10]], np.uint8), (4, 4)), (200, 50, 10)),
    ],
)
def test_raw_images(tmp_path, encoding, pixels, expected):
    path = write_bag(tmp_path / "toy", [("/raw", START_NS, Messages(ros_store()).image(START_NS, pixels, encoding))])
    image = read(path, ("/raw",))[0][0]
    assert tuple(decode_image(image)[2, 2]) == expected
    assert image.format == "png"


def test_packets_become_revolutions(tmp_path):
    make, packets = Messages(ros_store()), vlp16_packets(3)
    items = [("/packets", START_NS + i, make.scan(START_NS, packets[i : i + 40])) for i in range(0, len(packets), 40)]
    path = write_bag(tmp_path / "toy", items)
    frames, _ = read(path, ("/packets",), packets=PacketDecoder("vlp16"))
    assert [f.status for f in frames] == ["ok"] * 3
    assert sum(len(f) for f in frames) == 3 * 75 * 12 * 32
    with pytest.raises(BadInput, match=r"lidar\.model"):
        read(path, ("/packets",))


def test_a_bag_without_serialization_format(tmp_path):
    path = write_bag(tmp_path / "toy", items_of("sqlite3"))
    with sqlite3.connect(next(path.glob("*.db3"))) as database:
        database.execute("UPDATE topics SET serialization_format = ''")
    (path / "metadata.yaml").write_text(
        (path / "metadata.yaml").read_text().replace("serialization_format: cdr", "serialization_format: ''")
    )
    check_contents(*read(path))


@pytest.mark.parametrize("kind", KINDS)
def test_a_missing_topic_is_named(tmp_path, kind):
    path = write_bag(tmp_path / ("toy.bag" if kind == "ros1" else "toy"), items_of(kind, 1), kind)
    with pytest.raises(BadInput, match=r"no topic '/velodyne' \(found: .*/points"):
        read(path, ("/velodyne",))


def test_a_topic_of_another_type(tmp_path):
    store = ros_store()
    message = store.types["std_msgs/msg/String"]("hello")
    path = write_bag(tmp_path / "toy", [("/chat", START_NS, message)])
    with pytest.raises(BadInput, match="std_msgs/msg/String"):
        read(path, ("/chat",))


def test_a_cloud_without_coordinates(tmp_path):
    cloud = Messages(ros_store()).cloud(START_NS, {"range": np.ones(3, np.float32)})
    with pytest.raises(BadInput, match=r"no field 'x' \(found: range\)"):
        read(write_bag(tmp_path / "toy", [("/points", START_NS, cloud)]), ("/points",))


def test_an_unreadable_image_keeps_its_place(tmp_path):
    path = write_bag(tmp_path / "toy", [("/image", START_NS, Messages(ros_store()).compressed(START_NS, png(0)[:-20], "png"))])
    assert [im.status for im in read(path, ("/image",))[0]] == ["unreadable"]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("part", [0.0, 0.3, 0.9])
def test_cut_short_is_said(tmp_path, kind, part):
    path = write_bag(tmp_path / ("toy.bag" if kind == "ros1" else "toy"), items_of(kind), kind)
    target = path if kind == "ros1" else next(p for p in path.iterdir() if p.suffix in (".db3", ".mcap"))
    data = target.read_bytes()
    target.write_bytes(data[: int(len(data) * part)])
    with pytest.raises(BadInput):
        read(path)


@pytest.mark.parametrize("content", [None, "empty folder", "text"])
def test_what_is_no_bag(tmp_path, content):
    path = tmp_path / "toy.bag"
    if content == "empty folder":
        path.mkdir()
    elif content:
        path.write_text(content)
    with pytest.raises(BadInput):
        read(path)


@pytest.mark.parametrize("kind", KINDS)
# A part of the usual number of examples: each one writes and reads files. A profile with more scales along.
@settings(max_examples=settings.default.max_examples // 4, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_damaged_bags(tmp_path, kind, data):
    path = tmp_path / ("toy.bag" if kind == "ros1" else "toy")
    if not path.exists():
        write_bag(path, items_of(kind, 1), kind)
    source = path if kind == "ros1" else next(p for p in path.iterdir() if p.suffix in (".db3", ".mcap"))
    folder = tmp_path / "fuzz"
    shutil.rmtree(folder, ignore_errors=True)
    if kind == "ros1":
        folder.mkdir()
        damaged_path = target = folder / "toy.bag"
    else:
        shutil.copytree(path, folder)
        damaged_path, target = folder, folder / source.name
    damaged = bytearray(source.read_bytes())
    for _ in range(data.draw(st.integers(0, 6))):
        at = data.draw(st.one_of(st.integers(0, 400), st.integers(0, len(damaged) - 1)))
        damaged[at] = data.draw(st.integers(0, 255))
    target.write_bytes(damaged[: data.draw(st.one_of(st.just(len(damaged)), st.integers(0, len(damaged))))])
    try:
        records, _ = read(damaged_path)
    except BadInput:
        return
    assert all(np.isfinite(r.points).all() for r in records if isinstance(r, LidarFrame))


def test_a_database_with_text_that_is_none(tmp_path):
    write_bag(tmp_path / "toy", items_of("sqlite3", 1), "sqlite3")
    source = next((tmp_path / "toy").glob("*.db3"))
    content = source.read_bytes()
    # Every cell that says how a topic is serialized begins with a byte that begins no letter.
    assert b"cdr" in content
    source.write_bytes(content.replace(b"cdr", b"\x80dr"))
    with pytest.raises(BadInput, match="toy"):
        read(tmp_path / "toy")


def test_jpeg_is_recognized():
    from streetscan.io.images import check_image

    data = cv2.imencode(".jpg", np.zeros((8, 8, 3), np.uint8))[1].tobytes()
    assert check_image(CameraImage(0, data, "rgb8; jpeg compressed bgr8")).format == "jpeg"
    assert check_image(CameraImage(0, data[:-2], "jpeg")).status == "unreadable"


def test_a_folder_that_lacks_its_metadata(tmp_path):
    path = write_bag(tmp_path / "toy", items_of("sqlite3", 1), "sqlite3")
    (path / "metadata.yaml").unlink()
    with pytest.raises(BadInput, match=r"lacks the bag's metadata\.yaml beside toy\.db3"):
        read(path)


def test_times_in_another_unit_are_said(tmp_path):
    points, _, times = revolution()
    columns = {"x": points[:, 0], "y": points[:, 1], "z": points[:, 2], "time": ((times + PERIOD_S / 2) * 1e6).astype(np.float32)}
    path = write_bag(tmp_path / "toy", [("/points", START_NS, Messages(ros_store()).cloud(START_NS, columns))])
    with pytest.raises(BadInput, match=r"times \('time'\) lie .* apart, in revolutions of 0\.1 s; write their unit as lidar\.time_unit_s"):
        read(path, ("/points",))


@pytest.mark.parametrize(
    ("model", "D", "found"), [("double_sphere", [0.1, 0.2], "'double_sphere'"), ("plumb_bob", [0.1, 0.2, 0.3], "give 0 or 4 or 5")]
)
def test_intrinsics_nobody_can_use(tmp_path, model, D, found):
    info = Messages(ros_store()).camera_info(START_NS, model, D)
    with pytest.raises(BadInput, match=found):
        read(write_bag(tmp_path / "toy", [("/info", START_NS, info)]), ("/info",))


def test_places_that_are_not_on_earth_are_no_fixes(tmp_path):
    make = Messages(ros_store())
    fixes = [make.fix(START_NS + i, latitude, 8.4, 1.0) for i, latitude in enumerate((49.0, 91.0, np.nan))]
    path = write_bag(tmp_path / "toy", [("/fix", START_NS + i, fix) for i, fix in enumerate(fixes)])
    assert [r.latitude_deg for r in read(path, ("/fix",))[0]] == [49.0]
