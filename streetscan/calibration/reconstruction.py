"""One keyframe from its images to a dense cloud in metres: structure from motion, scale, T1, densification.

Everything is given in the frame `camera` of the reference image, the one nearest in time to the lidar frame (Nagy 2020, 4.3.1 (5), N-210).
"""

import logging
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from streetscan.calibration.densification import DenseCloud, DensificationSettings, densify
from streetscan.calibration.dynamic_objects import DynamicPixels
from streetscan.calibration.keyframes import Keyframe
from streetscan.calibration.projection import SELECTIONS, Projection, ProjectionSettings, estimate_projection
from streetscan.calibration.scale import NoScale, Scale, ScaleSettings, estimate_scale
from streetscan.calibration.sfm import ReconstructionFailed, SfmSettings, SparseModel, reconstruct
from streetscan.frames import CameraModel
from streetscan.localization.settings import build
from streetscan.registration.odometry import FramePose

logger = logging.getLogger(__name__)

# What can be the matter with a reconstruction, beside the statuses of keyframes.
STATUSES = {
    "ok": "accepted",
    "bad_detector": "the detectors of moving things cannot be used",
    "bad_images": "fewer than three images, or of different sizes",
    "not_matched": "the images have nothing in common",
    "not_registered": "no cameras can be found",
    "no_reference": "the image nearest to the lidar frame was not registered, or observes too few static points",
    "no_scale": "the lidar's motion does not tell the scale; the clouds have no unit",
    "disagrees": "the cameras turned otherwise than the lidar",
    "not_dense": "too few images see enough static points to begin from",
    "inaccurate": "the points do not lie where the image shows them",
}


@dataclass(frozen=True)
class ReconstructionSettings:
    """The settings of the stages; see each."""

    sfm: SfmSettings = field(default_factory=SfmSettings)
    projection: ProjectionSettings = field(default_factory=ProjectionSettings)
    scale: ScaleSettings = field(default_factory=ScaleSettings)
    densification: DensificationSettings = field(default_factory=DensificationSettings)


@dataclass
class Reconstruction:
    """What became of a keyframe; what its status did not let be made is None.

    Attributes:
        status: `ok`, another key of STATUSES or of `keyframes.STATUSES`.
        reason: what was found, with numbers.
        reference: the image of T1.
        sparse: cameras and points, frame `camera` of the reference image, metres (no unit for `no_scale`).
        dense: the fused cloud in the same frame.
        projection: T1.
        selection_errors_px: mean error of T1 from points chosen in each way of `projection.SELECTIONS`, for comparison.
        scale: metres per unit of structure from motion; None for `no_scale`.
        seconds: wall time of each stage.
    """

    status: str = "ok"
    reason: str = ""
    reference: int = -1
    sparse: SparseModel | None = None
    dense: DenseCloud | None = None
    projection: Projection | None = None
    selection_errors_px: dict[str, float] = field(default_factory=dict)
    scale: Scale | None = None
    seconds: dict[str, float] = field(default_factory=dict)

    def refuse(self, status: str, reason: str) -> None:
        """Something is the matter; what was found first stays the status, and every reason is kept."""
        self.status = status if self.status == "ok" else self.status
        self.reason = "; ".join(filter(None, (self.reason, reason)))


def make_reconstruction_settings(values: Mapping[str, Any]) -> ReconstructionSettings:
    """Settings from plain values; BadInput for an unknown key."""
    return build(ReconstructionSettings, values, "reconstruct_keyframe")


def reconstruct_keyframe(
    images: Sequence[np.ndarray],
    image_times_ns: Sequence[int],
    lidar_time_ns: int,
    camera: CameraModel,
    lidar_poses: list[FramePose],
    masks: np.ndarray | None = None,
    settings: ReconstructionSettings = ReconstructionSettings(),
    seed: int = 0,
    n_threads: int = 1,
) -> Reconstruction:
    """A keyframe's clouds and projection.

    Args:
        images: n of (H, W, 3) uint8 RGB, rectified, in the order of time.
        image_times_ns: their stamps.
        lidar_time_ns: of the lidar frame.
        camera: intrinsics.
        lidar_poses: of register_frames; empty leaves the scale open.
        masks: (n, H, W) uint8 class of the moving thing at each pixel, 0 for none; None marks nothing.
        settings: see ReconstructionSettings.
        seed: of every random draw.
        n_threads: of the densification; structure from motion takes one, so that equal seeds give equal numbers.
    """
    made = Reconstruction()

    def timed(stage: str, function: Callable, *arguments):
        start = time.perf_counter()
        try:
            return function(*arguments)
        finally:
            made.seconds[stage] = time.perf_counter() - start

    try:
        model = timed("sfm", reconstruct, images, camera, masks, settings.sfm, seed, 1)
        made.reference = int(np.argmin(np.abs(np.asarray(image_times_ns, np.int64) - lidar_time_ns)))
        model = timed("scale", _make_metric, made, model, np.asarray(image_times_ns) / 1e9, lidar_poses, settings.scale)
        made.sparse = model
        timed("projection", _project, made, model, camera, settings.projection)
        made.dense = timed("densification", densify, images, camera.K, model, masks, settings.densification, seed, n_threads)
    except ReconstructionFailed as failure:
        made.refuse(failure.status, str(failure))
    stages = ", ".join(f"{stage} {seconds:.1f} s" for stage, seconds in made.seconds.items())
    logger.info("%s%s; %s", made.status, f" ({made.reason})" if made.reason else "", stages)
    return made


def begin(keyframe: Keyframe, masks_folder: str | Path | None) -> Reconstruction:
    """Nothing made yet of a keyframe; the status says whether there is anything to make it of.

    Args:
        keyframe: of choose_keyframes.
        masks_folder: of detect_dynamic; None marks nothing.
    """
    made = Reconstruction(keyframe.status, keyframe.reason)
    if made.status == "ok" and masks_folder is not None:
        problem = DynamicPixels.load(Path(masks_folder) / f"{keyframe.index:02d}.npz").problem
        if problem:
            made.refuse("bad_detector", problem)
    return made


def read_masks(folder: str | Path | None, keyframe: int) -> np.ndarray | None:
    """Classes (n, H, W) uint8 of moving things on a keyframe's images, 0 for none, as detect_dynamic wrote them; None without a folder.

    Raises:
        BadInput: no file for this keyframe, or one without masks.
    """
    if folder is None:
        return None
    return DynamicPixels.load(Path(folder) / f"{keyframe:02d}.npz").classes


def _make_metric(made: Reconstruction, model: SparseModel, times_s: np.ndarray, poses: list[FramePose], s: ScaleSettings) -> SparseModel:
    """The model in the frame of the reference camera, in metres where the scale can be told."""
    if not model.is_registered[made.reference]:
        raise ReconstructionFailed("no_reference", f"image {made.reference}, the nearest to the lidar frame, was not registered")
    factor = 1.0
    try:
        made.scale = estimate_scale(model.T_camera_sfm, times_s, poses, s)
        factor = made.scale.value
        if made.scale.turn_off_deg > s.max_turn_deg:
            found = f"between two images the turns of cameras and lidar differ by {made.scale.turn_off_deg:.2f} deg"
            made.refuse("disagrees", f"{found} of at most {s.max_turn_deg:g}")
    except NoScale as reason:
        made.refuse("no_scale", str(reason))
    T = model.T_camera_sfm[made.reference].copy()
    T[:3] *= factor
    return model.transformed(T)


def _project(made: Reconstruction, model: SparseModel, camera: CameraModel, s: ProjectionSettings) -> None:
    """Find T1 and judge it."""
    rows = (model.image_of == made.reference) & (model.labels[model.point_of] == 0)
    try:
        found = {
            selection: estimate_projection(
                model.points[model.point_of[rows]], model.pixels[rows], camera.K, replace(s, selection=selection)
            )
            for selection in SELECTIONS
        }
    except ValueError as error:
        raise ReconstructionFailed("no_reference", str(error)) from error
    made.projection = found[s.selection]
    made.selection_errors_px = {selection: projection.mean_error_px for selection, projection in found.items()}
    if not made.projection.mean_error_px < s.max_error_px:
        made.refuse("inaccurate", f"a mean reprojection error of {made.projection.mean_error_px:.2f} px of at most {s.max_error_px:g}")
