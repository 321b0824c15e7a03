"""Scores of the detectors on every image with a true mask and every lidar frame with true labels of a drive."""

import logging
from pathlib import Path

from streetscan.calibration.detection_evaluation import ImageScores, PointScores, tabulate_scores
from streetscan.calibration.detectors.drive_truth import iterate_true_labels, iterate_true_masks
from streetscan.calibration.detectors.opening import CheckedDetector, UnusableDetector, open_image_detector, open_lidar_detector
from streetscan.calibration.dynamic_objects import find_dynamic_points
from streetscan.calibration.rectification import rectify_image, rectify_labels
from streetscan.io.files import read_yaml
from streetscan.io.images import decode_image
from streetscan.io.mcap import read_camera_model
from streetscan.io.tables import save_tables
from streetscan.logs import logged

logger = logging.getLogger(__name__)


def main(
    drive: str, truth: str, image_files: list[str], lidar_files: list[str], image_detector: dict, lidar_detector: dict,
    margin_m: float, foot_m: float, n_threads: int, min_pixels: int, range_m: float, scores: str,
) -> None:  # fmt: skip
    """
    Args:
        drive, truth: drive.mcap and its truth/; a sensor without truth there, or whose detector cannot be used, is left out.
        image_files, lidar_files, image_detector, lidar_detector, margin_m, foot_m, n_threads: as in detect_dynamic.
        min_pixels, range_m: of `ImageScores` and `PointScores`.
        scores: table to write, `.csv`.
    """
    known, results = read_yaml(Path(truth) / "truth.yaml"), []

    def score_images() -> ImageScores:
        method, settings = image_detector["method"], image_detector["settings"]
        detector = CheckedDetector(lambda: open_image_detector(method, image_files, settings, n_threads))
        camera, of_images = read_camera_model(drive), ImageScores(min_pixels)
        for image, labels, instances in iterate_true_masks(drive, truth):
            found = detector.detect(rectify_image(decode_image(image), camera, drive))
            of_images.add(found, rectify_labels(labels, camera, drive), rectify_labels(instances, camera, drive))
        return of_images

    def score_frames() -> PointScores:
        method, choice = lidar_detector["method"], lidar_detector["choice"]
        detector = CheckedDetector(lambda: open_lidar_detector(method, lidar_files, choice, n_threads))
        of_points = PointScores(range_m, known["labels"]["ids"])
        for frame, ids in iterate_true_labels(drive, truth):
            of_points.add(frame.points, find_dynamic_points(detector, frame.points, frame.intensity, margin_m, foot_m), ids)
        return of_points

    for score in [score_images] * ("masks" in known) + [score_frames] * ("labels" in known):
        try:
            results.append(score())
        except UnusableDetector as problem:
            logger.warning("no scores: %s", problem)
    save_tables({scores: tabulate_scores(results)})


if __name__ == "__main__":
    with logged(snakemake.log[0]):
        main(**{k: v for k, v in snakemake.input.items() if k != "code"}, scores=snakemake.output.scores, **snakemake.params)
