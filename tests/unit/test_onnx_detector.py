"""ONNX detectors: adapters on tiny networks whose answers are known, and on real weights where they are at hand."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from onnx_files import write_constant_network

from streetscan.calibration.detectors.image_detections import paint_objects
from streetscan.calibration.detectors.onnx import OnnxDetector, OnnxSettings, join_boxes_and_pixels, read_onnx_settings
from streetscan.calibration.detectors.opening import open_image_detector
from streetscan.classes import CAR, PEDESTRIAN, TRAM_BUS
from streetscan.errors import BadInput
from streetscan.frames import CameraImage
from streetscan.io.images import decode_image

PICTURE = np.zeros((60, 120, 3), np.uint8)
WEIGHTS = Path(__file__).resolve().parents[3] / "shared" / "weights"


def extent(mask):
    """First and last row and column of a mask."""
    rows, columns = np.nonzero(mask)
    return rows.min(), rows.max(), columns.min(), columns.max()


def mask_rcnn(path, masks, **outputs):
    known = {
        "boxes": np.array([[10, 20, 30, 50], [60, 5, 100, 25], [0, 0, 9, 9]], np.float32),
        "labels": np.array([1, 3, 16], np.int64),  # person, car, bird
        "scores": np.array([0.9, 0.8, 0.95], np.float32),
        "masks": masks.astype(np.float32),
    }
    return write_constant_network(path, known | outputs, shape=(3, "height", "width"))


class TestMaskRcnn:
    def test_masks_of_the_picture(self, tmp_path):
        masks = np.zeros((3, 1, 60, 120))
        masks[0, 0, 20:51, 10:31] = masks[1, 0, 5:26, 60:101] = masks[2, 0, :9, :9] = 1
        found = OnnxDetector("mask_rcnn", [mask_rcnn(tmp_path / "n.onnx", masks)], OnnxSettings(class_ids="coco_81")).detect(PICTURE)
        assert extent(found.classes == PEDESTRIAN) == (20, 50, 10, 30)
        assert extent(found.classes == CAR) == (5, 25, 60, 100)
        assert np.array_equal(np.unique(found.classes), [0, PEDESTRIAN, CAR])
        assert found.scores == pytest.approx([0.9, 0.8])
        assert np.array_equal(found.instances == 1, found.classes == PEDESTRIAN)

    def test_masks_of_boxes_in_an_input_of_twice_the_size(self, tmp_path):
        masks = np.zeros((3, 1, 28, 28))
        masks[:, :, :, :14] = 1  # the left half of each box
        path = mask_rcnn(tmp_path / "n.onnx", masks)
        found = OnnxDetector("mask_rcnn", [path], OnnxSettings(class_ids="coco_81", size=(120, 240))).detect(PICTURE)
        assert extent(found.classes == PEDESTRIAN) == (10, 25, 5, 9)
        assert extent(found.classes == CAR)[2:] == (30, 39)

    def test_a_network_with_other_outputs(self, tmp_path):
        path = write_constant_network(tmp_path / "n.onnx", {"pixels": np.zeros((1, 8, 8), np.int64)})
        with pytest.raises(BadInput, match="give a network with boxes, labels, scores and masks"):
            OnnxDetector("mask_rcnn", [path], OnnxSettings()).detect(PICTURE)


def yolo_outputs(kind):
    """A car in the middle of an input of 64 x 64 and the same again a bit aside, its mask the left half of the input."""
    prototypes = np.zeros((1, 32, 16, 16), np.float32)
    prototypes[0, 0] = np.where(np.arange(16) < 8, 10, -10)
    rows = np.zeros((40, 4 + 80 + 32), np.float32)
    rows[:, :4] = 32, 32, 4, 4
    rows[0, :4], rows[1, :4] = (32, 32, 40, 20), (33, 32, 40, 20)
    rows[:2, 4 + 2] = 0.8, 0.7
    rows[:2, 84] = 1
    if kind == "v8":
        return {"proposals": np.repeat(rows.T[None], 1, 0), "prototypes": prototypes}
    rows = np.repeat(rows, 4, axis=0)  # more proposals than columns
    rows = np.concatenate([rows[:, :4], np.full((len(rows), 1), 0.9, np.float32), rows[:, 4:]], axis=1)
    return {"proposals": rows[None], "prototypes": prototypes}


class TestYolo:
    @pytest.mark.parametrize(("kind", "score"), [("v8", 0.8), ("v5", 0.72)])
    def test_one_car_in_a_letterbox(self, tmp_path, kind, score):
        outputs = yolo_outputs(kind)
        if kind == "v8":
            outputs["proposals"] = np.concatenate([outputs["proposals"], np.zeros((1, 116, 200), np.float32)], axis=2)
        path = write_constant_network(tmp_path / "n.onnx", outputs, shape=(1, 3, 64, 64))
        found = OnnxDetector("yolo_instances", [path], OnnxSettings()).detect(PICTURE)
        # The picture of 120 x 60 lies in 64 x 32 of the input, 16 rows from its top: the box's left half is columns 22.5 to 59.
        assert extent(found.classes == CAR) == (12, 48, 23, 59)
        assert found.scores == pytest.approx([score])
        assert found.instances.max() == 1

    def test_a_network_without_prototypes(self, tmp_path):
        path = write_constant_network(tmp_path / "n.onnx", {"proposals": np.zeros((1, 84, 200), np.float32)})
        with pytest.raises(BadInput, match="proposals and prototype masks"):
            OnnxDetector("yolo_instances", [path], OnnxSettings()).detect(PICTURE)


class TestBoxesAndPixels:
    def test_two_networks(self, tmp_path):
        # YOLOX of 128 x 128: a car at cell (8, 3) of stride 8 whose sides are exp(1) cells.
        proposals = np.zeros((1, 256 + 64 + 16, 85), np.float32)
        proposals[0, 3 * 16 + 8, :5] = 0.5, 0.5, 1.0, 1.0, 0.9
        proposals[0, 3 * 16 + 8, 5 + 2] = 1.0
        pixels = np.full((1, 32, 32), 2, np.int64)
        pixels[0, :, 16:] = 13
        paths = [
            write_constant_network(tmp_path / "boxes.onnx", {"output": proposals}, shape=(1, 3, 128, 128)),
            write_constant_network(tmp_path / "pixels.onnx", {"output": pixels}, shape=(1, 32, 32, 3), dtype=np.uint8),
        ]
        found = OnnxDetector("boxes_and_pixels", paths, OnnxSettings(fit="corner", colours="bgr")).detect(PICTURE)
        # The box is 68 +- 10.9 by 28 +- 10.9 in the input, 16 / 15 as large as the picture; moving are columns from 60 on.
        rows, columns = extent(found.classes == CAR)[:2], extent(found.classes == CAR)[2:]
        assert columns == (60, 73)
        assert rows == (17, 36)
        assert found.scores == pytest.approx([0.9])

    def test_only_what_both_say(self):
        pixels = np.zeros((20, 40), np.uint8)
        pixels[5:10, 5:10], pixels[5:10, 30:35] = CAR, PEDESTRIAN
        boxes = np.array([[0, 0, 20, 20], [0, 0, 7, 20], [22, 0, 25, 20]], float)
        found = join_boxes_and_pixels(boxes, np.array([CAR, CAR, PEDESTRIAN]), np.array([0.6, 0.9, 0.8]), pixels)
        assert np.array_equal(found.classes > 0, pixels == CAR)  # the person has no box, the third box no pixels
        assert (found.instances[5:10, 5:8] == 1).all()
        assert (found.instances[5:10, 8:10] == 2).all()
        assert found.scores == pytest.approx([0.9, 0.6])

    def test_real_weights(self, shared_data):
        paths = [*(WEIGHTS / "yolox_nano").glob("*.onnx"), *(WEIGHTS / "deeplab_cityscapes").glob("*.onnx")]
        pictures = sorted((shared_data / "kitti_2011_09_26_drive_0005" / "image_02" / "data").glob("*.png"))
        if len(paths) < 2 or not pictures:
            pytest.skip(f"no weights in {WEIGHTS} or no pictures of KITTI")
        detector = open_image_detector("boxes_and_pixels", [str(p) for p in paths], {"fit": "corner", "colours": "bgr"})
        image = decode_image(CameraImage(0, pictures[0].read_bytes(), "png"))
        found = detector.detect(image)
        # The van ahead and the cyclist, not the empty road before them.
        assert (found.classes[170:270, 320:430] == CAR).mean() > 0.8
        assert (found.classes[180:300, 790:870] == PEDESTRIAN).mean() > 0.3
        assert (found.classes[300:, 100:700] == 0).mean() > 0.97


class TestBadInput:
    def test_files(self, tmp_path):
        (tmp_path / "n.onnx").write_bytes(b"no network")
        with pytest.raises(BadInput, match="no ONNX network"):
            OnnxDetector("mask_rcnn", [tmp_path / "n.onnx"], OnnxSettings())
        with pytest.raises(BadInput, match="give 2"):
            OnnxDetector("boxes_and_pixels", [tmp_path / "n.onnx"], OnnxSettings())
        with pytest.raises(BadInput):
            OnnxDetector("mask_rcnn", [tmp_path / "absent.onnx"], OnnxSettings())

    def test_settings(self):
        with pytest.raises(BadInput, match="'colour' is unknown"):
            read_onnx_settings({"colour": "bgr"})
        with pytest.raises(BadInput, match="use one of coco_80"):
            OnnxSettings(class_ids="pascal")

    def test_pictures(self, tmp_path):
        path = write_constant_network(tmp_path / "n.onnx", {"a": np.zeros((1, 2), np.float32)})
        with pytest.raises(BadInput, match=r"give an \(H, W, 3\) uint8"):
            OnnxDetector("mask_rcnn", [path], OnnxSettings()).detect(PICTURE[..., 0])

    def test_a_size_the_network_does_not_take(self, tmp_path):
        path = write_constant_network(tmp_path / "n.onnx", {"a": np.zeros((1, 2), np.float32)}, shape=(1, 3, 32, 32))
        detector = OnnxDetector("mask_rcnn", [path], replace(OnnxSettings(), size=(64, 64)))
        with pytest.raises(BadInput, match="boxes, labels"):
            detector.detect(PICTURE)  # a fixed size is kept whatever the settings say


def test_painting_keeps_the_better_object_on_top():
    masks = [np.zeros((4, 4), bool) for _ in range(3)]
    masks[0][:2], masks[1][1:], masks[2][3:] = True, True, True
    found = paint_objects(masks, np.array([CAR, PEDESTRIAN, TRAM_BUS]), np.array([0.5, 0.9, 0.4]), (4, 4))
    assert found.classes.tolist() == [[CAR] * 4] + [[PEDESTRIAN] * 4] * 3
    assert found.scores == pytest.approx([0.9, 0.5])  # nothing shows of the third
    assert set(np.unique(found.instances)) == {1, 2}
    nothing = paint_objects([], np.zeros(0, np.uint8), np.zeros(0), (4, 4))
    assert not nothing.classes.any()
    assert len(nothing.scores) == 0
