"""Detectors by the names of their methods."""

from collections.abc import Callable, Sequence
from typing import Any

import torch

from streetscan.calibration.detectors.city import CityDetector
from streetscan.calibration.detectors.image_detections import ImageDetector
from streetscan.calibration.detectors.lidar_boxes import LidarDetector
from streetscan.calibration.detectors.onnx import METHODS, OnnxDetector, read_onnx_settings
from streetscan.calibration.detectors.pointpillars import Choice, PillarDetector
from streetscan.errors import BadInput


class UnusableDetector(Exception):
    """Files of another network, or a network that cannot take what it is given; the message is that of the BadInput behind it."""


class CheckedDetector:
    """A detector whose own bad input is an UnusableDetector, so that it is told from that of a drive."""

    def __init__(self, open_detector: Callable[[], Any]):
        self._detector = self._checked(open_detector)

    def detect(self, *inputs):
        """What the detector itself detects."""
        return self._checked(lambda: self._detector.detect(*inputs))

    @staticmethod
    def _checked(act: Callable[[], Any]) -> Any:
        try:
            return act()
        except BadInput as error:
            raise UnusableDetector(str(error)) from error


def open_image_detector(method: str, files: Sequence[str], settings: dict, n_threads: int = 1) -> ImageDetector:
    """A detector of moving things in images.

    Args:
        method: `city`, or one of `onnx.METHODS`.
        files: weights and settings of `city`, or ONNX files.
        settings: what differs from `onnx.OnnxSettings`.
        n_threads: of the network.
    Raises:
        BadInput: an unknown method, the wrong number of files, or files of another network.
    """
    torch.set_num_threads(n_threads)
    if method in METHODS:
        return OnnxDetector(method, files, read_onnx_settings(settings), n_threads)
    if method != "city":
        raise BadInput("image_detectors", f"method '{method}'", f"use city or one of {', '.join(METHODS)}")
    _check_count(files, 2, method)
    return CityDetector.load(*files)


def open_lidar_detector(method: str, files: Sequence[str], choice: dict, n_threads: int = 1) -> LidarDetector:
    """A detector of moving things in lidar frames.

    Args:
        method: `street`, or `kitti` with the public weights.
        files: weights and settings, or the public weights.
        choice: of `pointpillars.Choice`.
        n_threads: of the network.
    Raises:
        BadInput: an unknown method, the wrong number of files, or files of another network.
    """
    torch.set_num_threads(n_threads)
    if method not in ("street", "kitti"):
        raise BadInput("lidar_detectors", f"method '{method}'", "use street or kitti")
    _check_count(files, 2 if method == "street" else 1, method)
    load = PillarDetector.load if method == "street" else PillarDetector.load_kitti
    return load(*files, Choice(**choice))


def _check_count(files: Sequence[str], n: int, method: str) -> None:
    if len(files) != n:
        raise BadInput("files of a detector", f"{len(files)} for method '{method}'", "give weights and settings" if n == 2 else "give one")
