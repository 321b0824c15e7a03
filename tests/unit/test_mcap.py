import io
import json
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.reader import NonSeekingReader, make_reader
from toy_recordings import START_NS, png, revolution

from streetscan import geometry
from streetscan.errors import BadInput
from streetscan.frames import CameraImage, CameraModel, GpsFix, LidarFrame, Mounting, empty_frame
from streetscan.io import mcap


def frame(i=0, n=360, **changes):
    points, intensity, times = revolution(n, seed=i)
    ring = np.arange(n, dtype=np.uint16) % 64
    values = {"intensity": intensity, "ring": ring, "time_offset_s": times.astype(np.float32)} | changes
    return LidarFrame(START_NS + i * 100_000_000, points, **values)


def read_with_mcap_core(path):
    """What @mcap/core, a reader with which ours shares no code, finds in a file; skipped where Node.js or the reader is missing."""
    if shutil.which("node") is None:
        pytest.skip("no Node.js to run @mcap/core with")
    done = subprocess.run(["node", Path(__file__).parents[1] / "read_mcap.cjs", path], capture_output=True, text=True, check=False)
    if "Cannot find module" in done.stderr:
        pytest.skip("no @mcap/core and fzstd: npm install --no-save @mcap/core@2.2.2 fzstd@0.1.1")
    if done.returncode:
        raise RuntimeError(done.stderr)
    return json.loads(done.stdout)


@pytest.fixture
def drive(tmp_path):
    model = CameraModel(
        64, 32, np.array([[50.0, 0, 31.5], [0, 50, 15.5], [0, 0, 1]]), np.array([0.1, -0.2, 0.0, 0.001]), "plumb_bob", np.eye(3, 4)
    )
    with mcap.open_drive_writer(tmp_path / "drive.mcap") as writer:
        writer.write_mounting(Mounting("vehicle", "lidar", geometry.transform([1, 2, 3], [0.1, 0.2, 0.3])), START_NS)
        writer.write_calibration(model, START_NS)
        for i in range(4):
            writer.write_lidar(frame(i))
            writer.write_image(CameraImage(START_NS + i * 100_000_000 + 1, png(i), "png"))
            writer.write_fix(GpsFix(START_NS + i * 100_000_000 + 2, 49.0, 8.4, 110.0, np.eye(3) * 4))
        writer.write_metadata("streetscan", {"n_frames": 4})
    return tmp_path / "drive.mcap"


def test_everything_comes_back_exactly(drive):
    records = list(mcap.iterate_drive(drive))
    frames = [r for r in records if isinstance(r, LidarFrame)]
    assert [len(f) for f in frames] == [360] * 4
    for i, got in enumerate(frames):
        wanted = frame(i)
        assert got.time_ns == wanted.time_ns
        for name in ("points", "intensity", "ring", "time_offset_s"):
            np.testing.assert_array_equal(getattr(got, name), getattr(wanted, name))
    images = [r for r in records if isinstance(r, CameraImage)]
    assert [(r.time_ns, r.data, r.format) for r in images] == [(START_NS + i * 100_000_000 + 1, png(i), "png") for i in range(4)]
    fix = next(r for r in records if isinstance(r, GpsFix))
    assert (fix.latitude_deg, fix.longitude_deg, fix.altitude_m, fix.covariance_m2[1, 1]) == (49.0, 8.4, 110.0, 4.0)
    mounting = next(r for r in records if isinstance(r, Mounting))
    np.testing.assert_allclose(mounting.T_parent_child, geometry.transform([1, 2, 3], [0.1, 0.2, 0.3]), atol=1e-12)
    model = mcap.read_camera_model(drive)
    assert (model.width, model.height, model.distortion_model) == (64, 32, "plumb_bob")
    np.testing.assert_array_equal(model.D, [0.1, -0.2, 0.0, 0.001])


def test_schemas_index_and_checksums(drive):
    with drive.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        summary = reader.get_summary()
        names = {c.topic: summary.schemas[c.schema_id].name for c in summary.channels.values()}
        assert names == {
            "/lidar": "foxglove.PointCloud",
            "/camera/image": "foxglove.CompressedImage",
            "/camera/calibration": "foxglove.CameraCalibration",
            "/gps": "foxglove.LocationFix",
            "/tf": "foxglove.FrameTransform",
        }
        assert summary.statistics.message_count == 14
        assert sum(1 for _ in reader.iter_messages()) == 14
        assert all(c.message_index_length > 0 for c in summary.chunk_indexes)
        assert next(iter(reader.iter_metadata())).metadata == {"n_frames": "4"}
    # A second reader, which goes from the front and uses no index, finds the same.
    with drive.open("rb") as stream:
        assert sum(1 for _ in NonSeekingReader(stream, validate_crcs=True).iter_messages()) == 14


def test_another_reader_finds_every_message_index_and_checksum(drive):
    found = read_with_mcap_core(drive)
    counts = {"/lidar": 4, "/camera/image": 4, "/camera/calibration": 1, "/gps": 4, "/tf": 1}
    assert found["isWhole"]
    assert found["streamed"] == found["indexed"] == counts
    assert found["chunks"] == found["chunksWithCrc"] > 0
    assert found["schemas"] == {
        "/lidar": "foxglove.PointCloud",
        "/camera/image": "foxglove.CompressedImage",
        "/camera/calibration": "foxglove.CameraCalibration",
        "/gps": "foxglove.LocationFix",
        "/tf": "foxglove.FrameTransform",
    }
    content = bytearray(drive.read_bytes())
    content[len(content) // 3] ^= 0xFF
    drive.write_bytes(content)
    with pytest.raises(RuntimeError):
        read_with_mcap_core(drive)


def test_images_of_several_cameras_have_topics_of_their_own(tmp_path):
    path = tmp_path / "drive.mcap"
    with mcap.open_drive_writer(path) as writer:
        writer.write_lidar(frame())
        for i, camera in enumerate(("camera", "camera_2")):
            writer.write_image(CameraImage(START_NS + i, png(i), "png", camera=camera))
    assert mcap.read_topics(path) == ("/camera/image", "/camera_2/image", "/lidar")
    assert [i.camera for i in mcap.iterate_images(path)] == ["camera"]
    images = [r for r in mcap.iterate_drive(path, mcap.read_topics(path)) if isinstance(r, CameraImage)]
    assert [(i.camera, i.data) for i in images] == [("camera", png(0)), ("camera_2", png(1))]


def test_only_what_is_known_is_written(tmp_path):
    with mcap.open_drive_writer(tmp_path / "d.mcap") as writer:
        writer.write_lidar(frame(0, intensity=None, ring=None, time_offset_s=None))
    got = next(mcap.iterate_lidar(tmp_path / "d.mcap"))
    assert got.intensity is None
    assert got.ring is None
    assert got.status == "ok"


def test_a_part_is_found_by_time(drive):
    got = list(mcap.iterate_lidar(drive, START_NS + 100_000_000, START_NS + 300_000_000))
    assert [f.time_ns for f in got] == [START_NS + 100_000_000, START_NS + 200_000_000]


def test_an_empty_frame_is_kept(tmp_path):
    with mcap.open_drive_writer(tmp_path / "d.mcap") as writer:
        writer.write_lidar(empty_frame(START_NS, "truncated", 0))
    got = list(mcap.iterate_lidar(tmp_path / "d.mcap"))
    assert [len(f) for f in got] == [0]


def test_stamps_that_run_backwards_keep_the_order(tmp_path):
    with mcap.open_drive_writer(tmp_path / "d.mcap") as writer:
        for i in (0, 2, 1):
            writer.write_lidar(frame(i))
    assert [f.time_ns for f in mcap.iterate_lidar(tmp_path / "d.mcap")] == [frame(i).time_ns for i in (0, 2, 1)]


def test_stamps_before_1970_are_refused(tmp_path):
    with pytest.raises(BadInput, match="since 1970"), mcap.open_drive_writer(tmp_path / "d.mcap") as writer:
        writer.write_lidar(empty_frame(-1, "empty", 0))


def test_nothing_is_left_when_writing_fails(tmp_path):
    with pytest.raises(AttributeError), mcap.open_drive_writer(tmp_path / "d.mcap") as writer:
        writer.write_lidar("no frame")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("part", [0.0, 0.1, 0.5, 0.9, 0.999])
def test_cut_short_is_said(drive, tmp_path, part):
    data = drive.read_bytes()
    (tmp_path / "cut.mcap").write_bytes(data[: int(len(data) * part)])
    with pytest.raises(BadInput, match="MCAP"):
        list(mcap.iterate_drive(tmp_path / "cut.mcap"))


def test_a_changed_byte_is_found(drive, tmp_path):
    data = bytearray(drive.read_bytes())
    data[len(data) // 3] ^= 0xFF
    (tmp_path / "bad.mcap").write_bytes(data)
    with pytest.raises(BadInput):
        list(mcap.iterate_drive(tmp_path / "bad.mcap"))


def test_missing_file_and_topic(drive, tmp_path):
    with pytest.raises(BadInput, match="no such file"):
        list(mcap.iterate_drive(tmp_path / "none.mcap"))
    with pytest.raises(BadInput, match=r"no topic '/points' \(found: .*/lidar"):
        list(mcap.iterate_mcap(drive, ("/points",), mcap.LidarConventions()))


@settings(deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_damaged_files_never_pass_silently(drive, tmp_path, data):
    original = drive.read_bytes()
    wanted = [len(f) for f in mcap.iterate_lidar(drive)]
    damaged = bytearray(original)
    for _ in range(data.draw(st.integers(1, 4))):
        damaged[data.draw(st.integers(0, len(original) - 1))] = data.draw(st.integers(0, 255))
    path = tmp_path / "fuzz.mcap"
    path.write_bytes(damaged[: data.draw(st.integers(len(original) // 2, len(original)))])
    try:
        got = [len(r) for r in mcap.iterate_drive(path) if isinstance(r, LidarFrame)]
    except BadInput:
        return
    assert got == wanted


def test_a_cloud_that_contradicts_itself(tmp_path):
    from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
    from mcap_protobuf.writer import Writer

    stream = io.BytesIO()
    writer = Writer(stream)
    writer.write_message("/lidar", PointCloud(point_stride=12, data=b"0" * 13), 1, 1)
    writer.finish()
    (tmp_path / "d.mcap").write_bytes(stream.getvalue())
    with pytest.raises(BadInput, match="13 bytes"):
        list(mcap.iterate_lidar(tmp_path / "d.mcap"))


def refuse(*_, **__):
    raise PermissionError(13, "Permission denied")


def test_a_file_nobody_may_read(drive, monkeypatch):
    monkeypatch.setattr(type(drive), "open", refuse)
    with pytest.raises(BadInput, match="Permission denied"):
        list(mcap.iterate_drive(drive))
