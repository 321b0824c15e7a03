"""detect_dynamic on a tiny drive: its files, bad places of a drive, other networks' files."""

import cv2
import numpy as np
import pytest
from toy_detections import HEIGHT, START_NS, WIDTH

from scripts import detect_dynamic
from streetscan.calibration.dynamic_objects import DynamicPixels, DynamicPoints, draw_keyframe
from streetscan.calibration.keyframes import Keyframe, tabulate_keyframes


@pytest.fixture
def keyframes(tmp_path):
    """A table of one place with three images and a lidar frame, and of one with nothing."""
    times_ns = [START_NS, START_NS + 100_000_000, START_NS + 200_000_000]
    good = Keyframe(0, "ok", "", 1, times_ns[1], [0, 1, 2], times_ns, [10.0, 10.0], 5)
    path = tmp_path / "keyframes.csv"
    tabulate_keyframes([good, Keyframe(1)]).to_csv(path, index=False)
    return str(path)


def run(drive, keyframes, detectors, folder):
    outputs = {name: folder / name for name in ("masks", "lidar", "pictures")}
    detect_dynamic.main(drive.mcap, keyframes, **detectors, margin_m=0.1, foot_m=0.1, n_threads=1, **outputs)
    return outputs


def test_files_of_every_keyframe(detection_drive, keyframes, detectors, tmp_path):
    outputs = run(detection_drive, keyframes, detectors, tmp_path / "a")
    pixels, points = DynamicPixels.load(outputs["masks"] / "00.npz"), DynamicPoints.load(outputs["lidar"] / "00.npz")
    assert pixels.classes.shape == pixels.instances.shape == (3, HEIGHT, WIDTH)
    assert pixels.classes.dtype == np.uint8
    assert pixels.instances.dtype == np.uint16
    assert pixels.instances.max() == len(pixels.scores)
    assert pixels.problem == ""
    assert points.is_dynamic.shape == (3680,)
    assert points.boxes.shape == (len(points.labels), 7)
    picture = cv2.imread(str(outputs["pictures"] / "00.png"))
    assert picture.shape[0] == 840
    again = run(detection_drive, keyframes, detectors, tmp_path / "b")
    for name in ("masks", "lidar"):
        assert (outputs[name] / "00.npz").read_bytes() == (again[name] / "00.npz").read_bytes()


def test_a_place_without_images_has_empty_files(detection_drive, keyframes, detectors, tmp_path):
    outputs = run(detection_drive, keyframes, detectors, tmp_path)
    assert DynamicPixels.load(outputs["masks"] / "01.npz").classes.shape == (0, 0, 0)
    assert len(DynamicPoints.load(outputs["lidar"] / "01.npz").is_dynamic) == 0
    assert (outputs["pictures"] / "01.png").is_file()


def test_weights_of_another_network_are_a_problem_of_every_keyframe(detection_drive, keyframes, detectors, tmp_path):
    swapped = detectors | {"image_files": detectors["lidar_files"]}
    mixed = detectors | {"lidar_files": [detectors["image_files"][0], detectors["lidar_files"][1]]}
    for name, files, reason in (("a", swapped, "keys missing or unknown"), ("b", mixed, "weights made with other settings")):
        outputs = run(detection_drive, keyframes, files, tmp_path / name)
        for keyframe in ("00", "01"):
            assert reason in DynamicPixels.load(outputs["masks"] / f"{keyframe}.npz").problem
            assert not DynamicPoints.load(outputs["lidar"] / f"{keyframe}.npz").is_dynamic.any()
            assert (outputs["pictures"] / f"{keyframe}.png").is_file()
    assert DynamicPoints.load(outputs["lidar"] / "00.npz").is_dynamic.shape == (3680,)


def test_moving_things_are_red_and_boxed():
    points = np.array([[10.0, 0, 0], [0, 10, 0]])
    box = np.array([[10.0, 0, 0, 4, 2, 1.5, 0]], np.float32)
    found = DynamicPoints(np.array([True, False]), box, np.array([5], np.uint8), np.ones(1, np.float32))
    nothing = DynamicPixels.nothing()
    picture = draw_keyframe([], nothing, points, found)[:, 1:]
    assert picture[420 - 140, 420].tolist() == [220, 20, 60]
    assert picture[420, 420 - 140].tolist() == [150, 150, 150]
    assert (picture[420 - 168, 420] != 255).any()  # the box's front
