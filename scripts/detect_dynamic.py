"""What could move at each keyframe of a drive: masks of its rectified images, points and boxes of its lidar frame, a picture."""

from streetscan.calibration.detectors.opening import open_image_detector, open_lidar_detector
from streetscan.calibration.dynamic_objects import KeyframeDetector, draw_keyframe
from streetscan.calibration.keyframes import read_keyframe_images, read_keyframe_lidar, read_keyframes
from streetscan.frames import empty_frame
from streetscan.io.atomic import atomic_folder
from streetscan.io.images import encode_png
from streetscan.logs import logged


def main(
    drive: str, keyframes: str, image_files: list[str], lidar_files: list[str], image_detector: dict, lidar_detector: dict,
    margin_m: float, foot_m: float, n_threads: int, masks: str, lidar: str, pictures: str,
) -> None:  # fmt: skip
    """
    Args:
        drive: drive.mcap.
        keyframes: the table of choose_keyframes.
        image_files, lidar_files: the detectors' weights.
        image_detector, lidar_detector: method and settings; see `detectors.opening`.
        margin_m, foot_m: of `points_in_boxes`.
        n_threads: of the networks.
        masks, lidar, pictures: folders to write, with <keyframe>.npz, .npz and .png.
    """

    def open_detectors():
        of_images = open_image_detector(image_detector["method"], image_files, image_detector["settings"], n_threads)
        return of_images, open_lidar_detector(lidar_detector["method"], lidar_files, lidar_detector["choice"], n_threads)

    detector = KeyframeDetector(open_detectors, margin_m, foot_m)
    with atomic_folder(masks) as of_masks, atomic_folder(lidar) as of_lidar, atomic_folder(pictures) as of_pictures:
        for keyframe in read_keyframes(keyframes):
            images, name = read_keyframe_images(drive, keyframe), f"{keyframe.index:02d}"
            frame = read_keyframe_lidar(drive, keyframe) if keyframe.lidar_frame >= 0 else empty_frame(0, "missing", -1)
            pixels, points = detector.detect(images, frame.points, frame.intensity)
            pixels.save(of_masks / f"{name}.npz")
            points.save(of_lidar / f"{name}.npz")
            (of_pictures / f"{name}.png").write_bytes(encode_png(draw_keyframe(images, pixels, frame.points, points)))


if __name__ == "__main__":
    with logged(snakemake.log[0]):
        main(**{k: v for k, v in snakemake.input.items() if k != "code"}, **dict(snakemake.output.items()), **snakemake.params)
