"""Keyframes of tiny drives: what is chosen, and what is said where nothing can be."""

from dataclasses import replace

import numpy as np
import pytest
from street_frames import SENSOR_HEIGHT_M, pose, scan
from street_frames import drive as lidar_drive
from toy_camera import camera_images, toy_camera
from toy_drives import LEVEL

from streetscan.calibration.keyframes import (
    KeyframeSettings,
    choose_keyframes,
    count_columns,
    find_camera,
    measure_movement,
    read_keyframe_images,
    read_keyframe_lidar,
    read_keyframes,
    saturated_share,
    tabulate_keyframes,
)
from streetscan.errors import BadInput
from streetscan.frames import CameraImage, LidarFrame, Mounting
from streetscan.geometry import transform
from streetscan.io.mcap import open_drive_writer
from streetscan.io.tables import save_tables

CAMERA = toy_camera()
START_NS = 1_700_000_000_000_000_000
STEP_NS = 100_000_000
FEW = KeyframeSettings(n_images=3, min_columns=0, min_movement_px=2.0)


@pytest.fixture(scope="module")
def lidar_frames():
    return lidar_drive(2, n_beams=64, n_azimuths=1800)[0]


def write(path, images: list[CameraImage], frames: list[np.ndarray], camera=CAMERA, lidar_ns=START_NS + 20_000_000, mounting=LEVEL):
    with open_drive_writer(path) as writer:
        writer.write_mounting(mounting, START_NS)
        if camera is not None:
            writer.write_calibration(camera, START_NS)
        for i, points in enumerate(frames):
            writer.write_lidar(LidarFrame(lidar_ns + i * STEP_NS, points))
        for image in images:
            writer.write_image(image)
    return path


def moving(toy_street, n: int = 5) -> list[CameraImage]:
    return camera_images(toy_street.images[:n], [START_NS + i * STEP_NS for i in range(n)])


def test_images_and_the_lidar_frame_beside_the_first(toy_street, lidar_frames, tmp_path):
    path = write(tmp_path / "drive.mcap", moving(toy_street), lidar_frames)
    found = choose_keyframes(path, 3, FEW)
    assert [k.status for k in found] == ["ok"] * 3
    assert [k.images for k in found] == [[0, 1, 2], [1, 2, 3], [2, 3, 4]]
    assert [k.lidar_frame for k in found] == [0, 1, 1]
    assert all(m > 2 for k in found for m in k.movements_px)
    images = read_keyframe_images(path, found[1])
    assert np.array_equal(images[0], toy_street.images[1])
    assert len(read_keyframe_lidar(path, found[1])) == len(lidar_frames[1])


def test_the_table_keeps_everything(toy_street, lidar_frames, tmp_path):
    path = write(tmp_path / "drive.mcap", moving(toy_street), lidar_frames)
    found = choose_keyframes(path, 4, FEW)
    assert [k.status for k in found] == ["ok", "ok", "ok", "no_images"]
    save_tables({tmp_path / "keyframes.csv": tabulate_keyframes(found)})
    again = read_keyframes(tmp_path / "keyframes.csv")
    assert [(k.index, k.status, k.reason, k.images, k.image_times_ns, k.lidar_time_ns) for k in again] == [
        (k.index, k.status, k.reason, k.images, k.image_times_ns, k.lidar_time_ns) for k in found
    ]
    (tmp_path / "other.csv").write_text("a,b\n1,2\n")
    with pytest.raises(BadInput, match="no table of keyframes"):
        read_keyframes(tmp_path / "other.csv")


def test_images_that_hardly_moved_are_skipped(toy_street, lidar_frames, tmp_path):
    times = [START_NS + i * STEP_NS for i in range(6)]
    doubled = camera_images([toy_street.images[i // 2] for i in range(6)], times)
    path = write(tmp_path / "drive.mcap", doubled, lidar_frames)
    assert choose_keyframes(path, 1, FEW)[0].images == [0, 2, 4]


def test_what_makes_no_keyframe_says_why(toy_street, lidar_frames, tmp_path):
    times = [START_NS + i * STEP_NS for i in range(5)]
    white = [np.full_like(image, 255) for image in toy_street.images]
    damaged = moving(toy_street)
    damaged[2].data = b"nothing"
    cases = {
        "no_images": (moving(toy_street, 2), lidar_frames, FEW),
        "no_motion": (camera_images([toy_street.images[0]] * 5, times), lidar_frames, FEW),
        "saturated": (camera_images(white, times), lidar_frames, FEW),
        "bad_images": (damaged, lidar_frames, FEW),
        "no_lidar": (moving(toy_street), [], FEW),
        "few_columns": (moving(toy_street), lidar_frames, KeyframeSettings(n_images=3, min_columns=99, min_movement_px=2.0)),
    }
    for status, (images, frames, settings) in cases.items():
        found = choose_keyframes(write(tmp_path / f"{status}.mcap", images, frames), 2, settings)
        assert [k.status for k in found] == [status] * 2, status
        assert all(k.reason for k in found)


def test_gaps_part_images(toy_street, lidar_frames, tmp_path):
    images = moving(toy_street)
    for i in (3, 4):
        images[i].time_ns += 1_000_000_000
    found = choose_keyframes(write(tmp_path / "drive.mcap", images, lidar_frames), 1, FEW)
    assert found[0].images == [0, 1, 2]


def test_unusable_intrinsics_are_a_status(toy_street, lidar_frames, tmp_path):
    """A row for every place, and the drive goes on; a damaged drive stops."""
    flat = replace(CAMERA, K=np.diag([0.0, 0.0, 1.0]))
    odd = replace(CAMERA, distortion_model="mirror", D=np.ones(4))
    for name, camera, reason in (("none", None, "no intrinsics"), ("flat", flat, "no camera matrix"), ("odd", odd, "'mirror'")):
        path = write(tmp_path / f"{name}.mcap", moving(toy_street), lidar_frames, camera)
        found = choose_keyframes(path, 2, FEW)
        assert [k.status for k in found] == ["bad_intrinsics"] * 2
        assert all(reason in k.reason for k in found)
        assert read_keyframe_images(path, found[0]) == []
        assert find_camera(path) is None
    (tmp_path / "cut.mcap").write_bytes(path.read_bytes()[:2000])
    with pytest.raises(BadInput, match="not a whole MCAP file"):
        choose_keyframes(tmp_path / "cut.mcap", 2, FEW)


def test_movement_and_saturation_by_hand(toy_street):
    grey = toy_street.images[0][..., 0]
    assert measure_movement(grey, grey) < 0.1
    shifted = np.roll(grey, 6, axis=1)
    assert measure_movement(grey, shifted) == pytest.approx(6, abs=1.5)
    image = np.full((10, 10, 3), 100, np.uint8)
    image[:3] = 255
    image[3] = 0
    assert saturated_share(image) == pytest.approx(0.4)


def street_with(boxes: list) -> np.ndarray:
    """Points of a lidar frame on a bare road with these boxes (low x, y, z, high x, y, z), the vehicle at its start."""
    road = np.array([(-60, 30, 0, 60, 31, 6), *boxes], np.float64)
    return scan(pose(0.0), road, np.random.default_rng(0), n_beams=64, n_azimuths=3600)[0]


def post(x: float, y: float, width: float = 0.2, top: float = 5.0, base: float = 0.0) -> tuple:
    return (x, y - width / 2, base, x + width, y + width / 2, top)


def test_columns_in_view_are_counted():
    """Posts ahead; not those beside and behind, beyond the range, nor what is wide, low or hangs."""
    ahead = [post(8, -3), post(12, 4), post(18, -5)]
    others = [
        post(2, 6), post(-10, 3), post(45, 2), post(14, -7, width=1.2), post(10, 0, top=1.7), (20, 2, 1.6, 20.2, 2.2, 5),
        (9, 7, 0, 13, 9, 1.5),
    ]  # fmt: skip
    assert count_columns(street_with(ahead), CAMERA) == 3
    assert count_columns(street_with(ahead + others), CAMERA) == 3
    assert count_columns(street_with(others), CAMERA) == 0
    assert count_columns(street_with(ahead), CAMERA, KeyframeSettings(column_range_m=10.0)) == 1
    assert count_columns(street_with([post(2, 6)]), CAMERA, KeyframeSettings(margin_deg=90.0)) == 1
    assert count_columns(np.empty((0, 3)), CAMERA) == 0


def test_a_frame_without_columns_makes_no_keyframe(toy_street, tmp_path):
    """By the settings as they are; the lidar is turned on its mounting, and looked at as the vehicle goes."""
    turned = Mounting("vehicle", "lidar", transform([0.8, 0.0, SENSOR_HEIGHT_M], [0, 0, np.pi / 2]))
    for boxes, status in (([(9, 7, 0, 13, 9, 1.5)], "few_columns"), ([post(10, 2)], "ok")):
        points = street_with(boxes) @ turned.T_parent_child[:3, :3]
        path = write(tmp_path / f"{status}.mcap", moving(toy_street), [points], mounting=turned)
        found = choose_keyframes(path, 1, KeyframeSettings(n_images=3, min_movement_px=2.0))[0]
        assert (found.status, found.n_columns) == (status, int(status == "ok"))


def test_settings_are_checked():
    with pytest.raises(BadInput, match="min_images"):
        KeyframeSettings(min_images=9)
