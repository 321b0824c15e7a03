"""PointPillars: its geometry, its features against a plain reading of the paper, the public layout, and that it learns."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from streetscan.calibration.detectors.drive_truth import TrueBoxes
from streetscan.calibration.detectors.lidar_boxes import overlap_from_above, points_in_boxes
from streetscan.calibration.detectors.opening import open_lidar_detector
from streetscan.calibration.detectors.pointpillars import (
    KITTI,
    Choice,
    PillarDetector,
    PointPillars,
    boxes_for_network,
    boxes_of_network,
    decode_boxes,
    encode_boxes,
    make_anchors,
    point_features,
    street_settings,
)
from streetscan.calibration.detectors.pointpillars_training import LidarSchedule, assign_anchors, make_frame, train_pointpillars, vary_frame
from streetscan.classes import CAR, PEDESTRIAN
from streetscan.errors import BadInput
from streetscan.io.weights import save_settings, save_weights

CHOICE = {"min_score": 0.3, "max_overlap": 0.1, "n_looked_at": 100, "max_boxes": 20}
TINY = replace(
    street_settings(), range_m=(-8.0, -8.0, -3.0, 8.0, 8.0, 2.6), pillar_m=0.25, pillar_channels=8, channels=(8, 16, 16),
    n_layers=(1, 1, 1), neck_channels=8,
)  # fmt: skip
BOXES = np.array([[3.0, -2.0, -0.9, 4.4, 1.85, 1.55, 0.4], [-4.0, 5.0, -0.8, 0.6, 0.5, 1.75, -2.9]], np.float32)
LABELS = np.array([CAR, PEDESTRIAN], np.uint8)


def scene(seed: int, boxes=BOXES):
    """Points on a flat road and on the sides of boxes, and the truth."""
    rng = np.random.default_rng(seed)
    parts = [np.c_[rng.uniform(-8, 8, (1500, 2)), rng.normal(-1.7, 0.02, 1500)]]
    for box in boxes:
        unit = rng.uniform(-0.5, 0.5, (200, 3))
        face = rng.integers(0, 2, 200)
        unit[np.arange(200), face] = np.sign(unit[np.arange(200), face]) / 2
        shift = unit * box[3:6] * 0.98
        c, s = np.cos(box[6]), np.sin(box[6])
        parts.append(np.c_[c * shift[:, 0] - s * shift[:, 1], s * shift[:, 0] + c * shift[:, 1], shift[:, 2]] + box[:3])
    return np.concatenate(parts).astype(np.float32), TrueBoxes(boxes.astype(float), LABELS[: len(boxes)], np.full(len(boxes), 200))


class TestGeometry:
    def test_boxes_there_and_back(self):
        assert boxes_of_network(boxes_for_network(BOXES)) == pytest.approx(BOXES, abs=1e-6)
        # KITTI's angle 0: the length points against y, and z is the lower face.
        assert boxes_of_network(np.array([1.0, 2, -1.5, 1.6, 4.0, 1.5, 0.0]))[0] == pytest.approx([1, 2, -0.75, 4.0, 1.6, 1.5, -np.pi / 2])

    def test_deltas_there_and_back(self):
        anchors = make_anchors(TINY)[[7, 500]]
        true = boxes_for_network(BOXES).astype(np.float32)
        assert decode_boxes(encode_boxes(true, anchors), anchors) == pytest.approx(true, abs=1e-5)

    def test_anchors_lie_in_the_middle_of_their_cells(self):
        anchors = make_anchors(KITTI).reshape(248, 216, 3, 2, 7)
        assert anchors[0, 0, 2, 0] == pytest.approx([0.16, -39.52, -1.78, 1.6, 3.9, 1.56, 0.0], abs=1e-5)
        assert anchors[-1, -1, 0, 1] == pytest.approx([68.96, 39.52, -0.6, 0.6, 0.8, 1.73, 1.57], abs=1e-4)


class TestFeatures:
    def test_against_a_loop(self):
        points = np.concatenate([scene(1)[0], [[100, 0, 0], [0, 0, 50]]]).astype(np.float32)
        points = np.c_[points, np.linspace(0, 1, len(points), dtype=np.float32)]
        settings = replace(TINY, max_points=3, uses_intensity=True)
        features, pillars = point_features(points, settings)
        held = {}
        for p in points:
            if all(low <= v < high for low, v, high in zip(settings.range_m[:3], p[:3], settings.range_m[3:], strict=True)):
                cell = tuple(int(np.floor((p[k] - settings.range_m[k]) / 0.25)) for k in (0, 1))
                if len(held.setdefault(cell, [])) < 3:
                    held[cell].append(p)
        assert len(features) == sum(map(len, held.values()))
        for (x, y), inside in held.items():
            mine = features[pillars == y * settings.shape[1] + x]
            off = [[p[0] - (-8 + (x + 0.5) * 0.25), p[1] - (-8 + (y + 0.5) * 0.25)] for p in inside]
            mean = np.mean(inside, axis=0)[:3]
            wanted = [[*o, p[2], p[3], *(p[:3] - mean), *o] for o, p in zip(off, inside, strict=True)]
            assert mine == pytest.approx(np.array(wanted), abs=1e-4)

    def test_empty_places_of_a_pillar_count_as_in_the_published_code(self):
        torch.manual_seed(0)
        network = PointPillars(replace(TINY, has_empty_places=True)).eval()
        encoder = network.pillar_encoder
        with torch.no_grad():
            encoder.bn.bias.fill_(0.7)  # what a place of zeros answers
        points = np.c_[scene(2)[0], np.zeros(1900, np.float32)]
        features, pillars = point_features(points, TINY)
        counts = torch.from_numpy(np.bincount(pillars, minlength=64 * 64))
        with torch.inference_mode():
            picture = encoder(torch.from_numpy(features), torch.from_numpy(pillars), counts, 1)[0].reshape(8, -1)
            padded = torch.zeros(1, 9, TINY.max_points)
            one = int(pillars[-1])
            n = int(counts[one])
            padded[0, :, :n] = torch.from_numpy(features[pillars == one].T)
            wanted = torch.relu(encoder.bn(encoder.conv(padded))).amax(2)[0]
        assert 0 < n < TINY.max_points
        assert picture[:, one] == pytest.approx(wanted, abs=1e-5)
        assert (picture[:, counts == 0] == 0).all()


class TestPublicLayout:
    def test_names_and_shapes(self):
        shapes = {name: tuple(t.shape) for name, t in PointPillars(KITTI).state_dict().items() if "num_batches" not in name}
        wanted = {"pillar_encoder.conv.weight": (64, 9, 1)} | norm("pillar_encoder.bn", 64)
        n_in = 64
        for block, (n_out, n_layers) in enumerate(((64, 3), (128, 5), (256, 5))):
            for layer in range(n_layers + 1):
                wanted[f"backbone.multi_blocks.{block}.{3 * layer}.weight"] = (n_out, n_in if layer == 0 else n_out, 3, 3)
                wanted |= norm(f"backbone.multi_blocks.{block}.{3 * layer + 1}", n_out)
            n_in = n_out
            wanted[f"neck.decoder_blocks.{block}.0.weight"] = (n_out, 128, 2**block, 2**block)
            wanted |= norm(f"neck.decoder_blocks.{block}.1", 128)
        for name, n in (("cls", 18), ("reg", 42), ("dir_cls", 12)):
            wanted |= {f"head.conv_{name}.weight": (n, 384, 1, 1), f"head.conv_{name}.bias": (n,)}
        assert shapes == wanted

    def test_a_file_of_that_layout(self, tmp_path):
        torch.manual_seed(1)
        network = PointPillars(KITTI)
        torch.save(network.state_dict(), tmp_path / "epoch_160.pth")
        detector = open_lidar_detector("kitti", [str(tmp_path / "epoch_160.pth")], CHOICE | {"min_score": 0.0, "max_boxes": 5})
        found = detector.detect(scene(3)[0] + np.array([20, 0, 0], np.float32), np.full(1900, 0.3, np.float32))
        assert found.boxes.shape == (5, 7)
        assert set(found.labels) <= {CAR, PEDESTRIAN}
        assert (np.diff(found.scores) <= 0).all()
        assert (found.boxes[:, 0] > -2).all()

    def test_other_files(self, tmp_path):
        torch.save(PointPillars(TINY).state_dict(), tmp_path / "tiny.pth")
        torch.save([1, 2], tmp_path / "list.pth")
        (tmp_path / "text.pth").write_text("no weights")
        for name, match in (("tiny.pth", "asks for"), ("list.pth", "no table of weights"), ("text.pth", "no file of weights")):
            with pytest.raises(BadInput, match=match):
                PillarDetector.load_kitti(tmp_path / name, Choice())


def norm(name, n):
    return {f"{name}.{part}": (n,) for part in ("weight", "bias", "running_mean", "running_var")}


class TestTraining:
    def test_it_learns_a_car(self, tmp_path):
        frames = [make_frame(points, None, truth, TINY, 5) for points, truth in map(scene, range(4))]
        schedule = LidarSchedule(n_steps=260, batch=1, learning_rate=1e-2, turn_rad=0.0, scale=0.0, height_m=0.0, averaging=0.9, seed=3)
        network, history = train_pointpillars(frames, TINY, schedule, 1)
        assert history[-1]["score_loss"] < history[0]["score_loss"] / 2
        save_weights(network, tmp_path / "w.safetensors")
        save_settings(TINY, tmp_path / "s.yaml")
        found = open_lidar_detector(
            "street", [str(tmp_path / "w.safetensors"), str(tmp_path / "s.yaml")], CHOICE | {"min_score": 0.15}
        ).detect(scene(9)[0])
        car = found.boxes[found.labels == CAR][:1]
        assert overlap_from_above(BOXES[0], car)[0] > 0.6

    def test_same_seed_same_numbers(self):
        frames = [make_frame(points, None, truth, TINY, 5) for points, truth in map(scene, range(2))]
        a, b = (train_pointpillars(frames, TINY, LidarSchedule(n_steps=3), 1)[0].state_dict() for _ in range(2))
        assert all(torch.equal(a[name], b[name]) for name in a)

    def test_every_true_box_has_an_anchor(self):
        points, truth = scene(0)
        frame, anchors = make_frame(points, None, truth, TINY, 5), make_anchors(TINY)
        classes, deltas = assign_anchors(frame, TINY, anchors, LidarSchedule())
        decoded = boxes_of_network(decode_boxes(deltas, anchors))
        for number, label in ((0, PEDESTRIAN), (2, CAR)):
            of_class = decoded[classes == number]
            assert len(of_class) > 0
            assert of_class == pytest.approx(np.repeat(BOXES[label == LABELS], len(of_class), 0), abs=1e-4)
        assert (classes == -1).mean() > 0.9

    def test_varied_points_stay_in_their_boxes(self):
        points, truth = scene(5)
        frame = make_frame(points, None, truth, TINY, 5)
        for seed in range(6):
            varied = vary_frame(frame, LidarSchedule(thinning=1.0), np.random.default_rng(seed))
            assert points_in_boxes(varied.points, varied.boxes, 0.02).any(axis=1).sum() == pytest.approx(402, abs=8)  # some of the road

    def test_objects_with_few_points_and_out_of_range_are_left_out(self):
        points, truth = scene(5)
        assert len(make_frame(points, None, replace_points(truth, [200, 3]), TINY, 5).boxes) == 1
        truth.boxes[0, 0] = 30.0
        assert make_frame(points, None, truth, TINY, 5).labels.tolist() == [PEDESTRIAN]


def replace_points(truth, n_points):
    return TrueBoxes(truth.boxes, truth.labels, np.array(n_points))


def test_bad_settings():
    with pytest.raises(BadInput, match="multiples of 8"):
        replace(TINY, pillar_m=0.3)
    with pytest.raises(BadInput, match="'facade' cannot move"):
        replace(TINY, classes=("pedestrian", "facade", "car"))
    with pytest.raises(BadInput, match="no lidar frame"):
        train_pointpillars([], TINY, LidarSchedule(), 1)


def test_an_empty_frame(tmp_path):
    detector = PillarDetector(PointPillars(TINY), Choice())
    assert len(detector.detect(np.zeros((0, 3), np.float32)).boxes) == 0
