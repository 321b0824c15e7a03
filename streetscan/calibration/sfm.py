"""Structure from motion: cameras and a sparse cloud from the images of one keyframe, by COLMAP.

Every 3-D point keeps its observations, each with a number of its own, and a label from the masks of moving things (Nagy 2020, 4.3.1
(3)-(4), N-206 to N-208). Features on moving things are matched, but cameras are found without them; their points are triangulated
afterwards.

ASSUME: the thesis' global mapper is one choice (`mapper: global`), COLMAP's incremental one the other.

ASSUME: all pairs of a keyframe's images are matched, not only neighbours: with eight images that costs little, and forward motion needs
the long base lines.

COLMAP puts the centre of the upper left pixel at (0.5, 0.5), we at (0, 0): `HALF_PX` is added on the way in and taken off on the way out.
"""

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pycolmap

from streetscan.errors import BadInput
from streetscan.frames import CameraModel

HALF_PX = 0.5
MAPPERS = ("incremental", "global")


class ReconstructionFailed(Exception):
    """A keyframe cannot be reconstructed; `status` names the stage, the message says what was found."""

    def __init__(self, status: str, reason: str):
        super().__init__(reason)
        self.status = status


@dataclass(frozen=True)
class SfmSettings:
    """How cameras and sparse points are found.

    Attributes:
        mapper: `incremental` or `global`.
        max_features: SIFT features of an image at most.
        first_octave: of SIFT; 0 is the image's own size.
        min_angle_deg: least angle between the rays of a point. A camera that drives forward sees the scene under small angles.
        max_error_px: largest reprojection error of an observation.
        min_matches: fewer verified matches do not connect two images.
        min_points: a sparse cloud with fewer points is none.
    """

    mapper: str = "incremental"
    max_features: int = 8192
    first_octave: int = 0
    min_angle_deg: float = 0.4
    max_error_px: float = 2.0
    min_matches: int = 15
    min_points: int = 100

    def __post_init__(self):
        if self.mapper not in MAPPERS:
            raise BadInput("reconstruct_keyframe.sfm.mapper", f"'{self.mapper}'", f"choose one of {', '.join(MAPPERS)}")


@dataclass
class SparseModel:
    """Cameras and points; the frame `sfm` and its unit are free until they are chosen.

    Attributes:
        T_camera_sfm: (n, 4, 4) float64 of the n images, NaN where an image was not registered.
        points: (P, 3) float64, frame `sfm`.
        colours: (P, 3) uint8, RGB.
        labels: (P,) uint8: 0 static, else the class of the moving thing.
        errors_px: (P,) float64 mean reprojection error.
        point_of, image_of, feature_of: (M,) int64 point, image and feature of each observation; image and feature make it unique.
        pixels: (M, 2) float64 where it was observed, centres at integers.
    """

    T_camera_sfm: np.ndarray
    points: np.ndarray
    colours: np.ndarray
    labels: np.ndarray
    errors_px: np.ndarray
    point_of: np.ndarray
    image_of: np.ndarray
    feature_of: np.ndarray
    pixels: np.ndarray

    @property
    def is_registered(self) -> np.ndarray:
        """(n,) bool."""
        return np.isfinite(self.T_camera_sfm).all(axis=(1, 2))

    @property
    def n_views(self) -> np.ndarray:
        """(P,) int64 images that observe a point."""
        return np.bincount(self.point_of, minlength=len(self.points))

    def transformed(self, T_new_sfm: np.ndarray) -> "SparseModel":
        """The model in another frame, T_new_sfm (4, 4) being a similarity; cameras stay rigid."""
        scale = np.cbrt(np.linalg.det(T_new_sfm[:3, :3]))
        poses = self.T_camera_sfm @ np.linalg.inv(T_new_sfm)
        poses[:, :3] *= scale
        return replace(self, T_camera_sfm=poses, points=self.points @ T_new_sfm[:3, :3].T + T_new_sfm[:3, 3])


def reconstruct(
    images: Sequence[np.ndarray],
    camera: CameraModel,
    masks: np.ndarray | None = None,
    settings: SfmSettings = SfmSettings(),
    seed: int = 0,
    n_threads: int = 1,
) -> SparseModel:
    """Cameras and points of rectified images.

    Args:
        images: n of (H, W, 3) uint8 RGB, rectified, in the order of time.
        camera: intrinsics; its distortion is taken to be undone.
        masks: (n, H, W) uint8, 0 where static, else the class of the moving thing; None marks nothing.
        settings: see SfmSettings.
        seed: of every random draw of COLMAP.
        n_threads: 1 makes equal seeds give equal numbers; COLMAP differs in the last digits between runs with more.
    Returns:
        the model with the most images.
    Raises:
        ReconstructionFailed: `bad_images` (fewer than three, or of different sizes), `not_matched`, `not_registered`.
    """
    _check_images(images, camera, masks)
    with tempfile.TemporaryDirectory() as folder:
        work = _Colmap(Path(folder), images, camera, settings, seed, n_threads)
        features = work.extract()
        labels = [_labels_at(masks[i] if masks is not None else None, xy) for i, xy in enumerate(features)]
        moving = [label > 0 for label in labels]
        matches = work.match()
        work.verify({pair: m[~(moving[pair[0]][m[:, 0]] | moving[pair[1]][m[:, 1]])] for pair, m in matches.items()})
        model = work.map()
        if any(m.any() for m in moving):
            work.verify(matches)
            model = work.triangulate(model)
        return _read_model(model, images, labels, settings)


def intrinsics(camera: CameraModel) -> pycolmap.Camera:
    """The rectified camera as COLMAP's PINHOLE."""
    K = camera.K
    return pycolmap.Camera(
        model="PINHOLE",
        width=camera.width,
        height=camera.height,
        params=[K[0, 0], K[1, 1], K[0, 2] + HALF_PX, K[1, 2] + HALF_PX],
        camera_id=1,
    )


def _check_images(images: Sequence[np.ndarray], camera: CameraModel, masks: np.ndarray | None) -> None:
    if len(images) < 3:
        raise ReconstructionFailed("bad_images", f"{len(images)} images; three or more are needed")
    shapes = {image.shape[:2] for image in images} | {(camera.height, camera.width)}
    if len(shapes) > 1:
        sizes = ", ".join(f"{w} x {h}" for h, w in sorted(shapes))
        raise ReconstructionFailed("bad_images", f"images and intrinsics of different sizes: {sizes}")
    if masks is not None and masks.shape != (len(images), camera.height, camera.width):
        raise BadInput(
            "masks", f"shape {masks.shape} for {len(images)} images of {camera.width} x {camera.height}", "run detect_dynamic again"
        )


def _labels_at(mask: np.ndarray | None, pixels: np.ndarray) -> np.ndarray:
    """The mask's class (n,) uint8 at pixels (n, 2)."""
    if mask is None:
        return np.zeros(len(pixels), np.uint8)
    u, v = np.rint(pixels).astype(int).T
    return mask[np.clip(v, 0, mask.shape[0] - 1), np.clip(u, 0, mask.shape[1] - 1)]


class _Colmap:
    """COLMAP's steps on a database in a folder of its own."""

    def __init__(self, folder: Path, images: Sequence[np.ndarray], camera: CameraModel, s: SfmSettings, seed: int, n_threads: int):
        self._folder, self._images, self._database = folder / "images", len(images), folder / "database.db"
        self._settings, self._seed, self._n_threads = s, seed, n_threads
        self._camera, self._output = intrinsics(camera), folder / "sparse"
        self._folder.mkdir()
        self._output.mkdir()
        for i, image in enumerate(images):
            grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
            cv2.imwrite(str(self._folder / f"{i:06d}.png"), grey, [cv2.IMWRITE_PNG_COMPRESSION, 1])
        pycolmap.logging.minloglevel = pycolmap.logging.Level.ERROR.value
        pycolmap.set_random_seed(seed)

    def extract(self) -> list[np.ndarray]:
        """SIFT features: (k, 2) float64 pixels of each image, centres at integers."""
        reader = pycolmap.ImageReaderOptions(camera_model="PINHOLE", camera_params=",".join(repr(float(p)) for p in self._camera.params))
        options = pycolmap.FeatureExtractionOptions(num_threads=self._n_threads, use_gpu=False)
        options.sift.max_num_features, options.sift.first_octave = self._settings.max_features, self._settings.first_octave
        pycolmap.extract_features(
            self._database, self._folder, camera_mode=pycolmap.CameraMode.SINGLE, reader_options=reader, extraction_options=options,
            device=pycolmap.Device.cpu,
        )  # fmt: skip
        with pycolmap.Database.open(self._database) as database:
            self._ids = [database.read_image_with_name(f"{i:06d}.png").image_id for i in range(self._images)]
            return [np.asarray(database.read_keypoints(i))[:, :2].astype(np.float64) - HALF_PX for i in self._ids]

    def match(self) -> dict[tuple[int, int], np.ndarray]:
        """Matches (k, 2) of features of each pair of images; ReconstructionFailed when there are none."""
        options = pycolmap.FeatureMatchingOptions(num_threads=self._n_threads, use_gpu=False, skip_geometric_verification=True)
        pycolmap.match_exhaustive(self._database, matching_options=options, device=pycolmap.Device.cpu)
        pairs = [(i, j) for i in range(self._images) for j in range(i + 1, self._images)]
        with pycolmap.Database.open(self._database) as database:
            matches = {(i, j): np.asarray(database.read_matches(self._ids[i], self._ids[j])).reshape(-1, 2) for i, j in pairs}
        if not any(len(m) >= self._settings.min_matches for m in matches.values()):
            most = max(len(m) for m in matches.values())
            raise ReconstructionFailed("not_matched", f"no two images have more than {most} features in common")
        return matches

    def verify(self, matches: dict[tuple[int, int], np.ndarray]) -> None:
        """Let these matches be the database's, and keep those that fit the geometry of two views."""
        with pycolmap.Database.open(self._database) as database:
            database.clear_matches()
            database.clear_two_view_geometries()
            for (i, j), m in matches.items():
                database.write_matches(self._ids[i], self._ids[j], np.ascontiguousarray(m, np.uint32))
        options = pycolmap.TwoViewGeometryOptions(min_num_inliers=self._settings.min_matches)
        options.ransac.random_seed, options.ransac.num_threads = self._seed, 1
        options.ransac.max_error = self._settings.max_error_px
        verifier = pycolmap.GeometricVerifierOptions(num_threads=self._n_threads)
        pycolmap.geometric_verification(self._database, verifier_options=verifier, two_view_geometry_options=options)

    def map(self) -> pycolmap.Reconstruction:
        """The reconstruction with the most images; ReconstructionFailed when there is none."""
        if self._settings.mapper == "global":
            models = list(pycolmap.global_mapping(self._database, self._folder, self._output, self._global_options()).values())
        else:
            models = self._map_incrementally()
        if not models:
            raise ReconstructionFailed("not_registered", "no two images make a start: they hardly move or have too little in common")
        model = max(models, key=lambda m: (m.num_reg_images(), m.num_points3D()))
        if model.num_reg_images() < 3 or model.num_points3D() < self._settings.min_points:
            found = f"{model.num_reg_images()} of {self._images} images registered, {model.num_points3D()} points"
            raise ReconstructionFailed("not_registered", found)
        return model

    def _map_incrementally(self) -> list[pycolmap.Reconstruction]:
        """Reconstructions that begin with the first and the last image, or with COLMAP's choice where that does not take in all images.

        ASSUME: the widest base line first. Two neighbours of a forward drive leave the direction of motion open, and the adjustment of
        all cameras stays in the wrong valley they begin in.
        """
        models = []
        for pair in ((self._ids[0], self._ids[-1]), (-1, -1)):
            options = self._incremental_options()
            options.init_image_id1, options.init_image_id2 = pair
            models += pycolmap.incremental_mapping(self._database, self._folder, self._output, options).values()
            if any(m.num_reg_images() == self._images for m in models):
                break
        return models

    def triangulate(self, model: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
        """The model with the points of all verified matches, its cameras as they are."""
        return pycolmap.triangulate_points(
            model, self._database, self._folder, self._output, clear_points=True, options=self._incremental_options()
        )

    def _incremental_options(self) -> pycolmap.IncrementalPipelineOptions:
        s = self._settings
        o = pycolmap.IncrementalPipelineOptions(num_threads=self._n_threads, random_seed=self._seed, min_num_matches=s.min_matches)
        o.ba_refine_focal_length = o.ba_refine_principal_point = o.ba_refine_extra_params = o.ba_refine_sensor_from_rig = False
        o.multiple_models, o.min_model_size, o.extract_colors, o.structure_less_registration_fallback = False, 3, False, False
        o.mapper.num_threads, o.mapper.random_seed = self._n_threads, self._seed
        o.mapper.init_max_forward_motion = 1.0
        o.mapper.init_min_tri_angle, o.mapper.ba_local_min_tri_angle = 2 * s.min_angle_deg, s.min_angle_deg
        o.mapper.filter_min_tri_angle, o.mapper.filter_max_reproj_error = s.min_angle_deg, s.max_error_px
        o.mapper.abs_pose_refine_focal_length = o.mapper.abs_pose_refine_extra_params = False
        o.triangulation.random_seed, o.triangulation.min_angle = self._seed, s.min_angle_deg
        o.triangulation.merge_max_reproj_error = o.triangulation.complete_max_reproj_error = s.max_error_px
        return o

    def _global_options(self) -> pycolmap.GlobalPipelineOptions:
        s = self._settings
        o = pycolmap.GlobalPipelineOptions(num_threads=self._n_threads, random_seed=self._seed, min_num_matches=s.min_matches)
        o.multiple_models = False
        m = o.mapper
        m.num_threads, m.random_seed, m.min_tri_angle_deg, m.track_min_num_views_per_track = self._n_threads, self._seed, s.min_angle_deg, 2
        m.refine_sensor_from_rig = False
        m.rotation_averaging.random_seed = m.global_positioning.random_seed = m.retriangulation.random_seed = self._seed
        m.global_positioning.use_gpu = m.bundle_adjustment.ceres.use_gpu = False
        m.bundle_adjustment.refine_focal_length = m.bundle_adjustment.refine_extra_params = False
        m.bundle_adjustment.refine_sensor_from_rig = False
        m.bundle_adjustment.ceres.solver_options.num_threads = self._n_threads
        m.retriangulation.min_angle = s.min_angle_deg
        return o


def _read_model(model: pycolmap.Reconstruction, images: Sequence[np.ndarray], labels: list[np.ndarray], s: SfmSettings) -> SparseModel:
    """The model in our terms; points whose rays meet under too small an angle are left out by COLMAP already."""
    numbers = {image_id: int(image.name.split(".")[0]) for image_id, image in model.images.items()}
    poses = np.full((len(images), 4, 4), np.nan)
    for image_id in model.reg_image_ids():
        poses[numbers[image_id]] = np.vstack([model.image(image_id).cam_from_world().matrix(), [0, 0, 0, 1]])
    ids = sorted(model.points3D)
    points = np.array([model.point3D(i).xyz for i in ids]).reshape(-1, 3)
    rows = [(p, numbers[e.image_id], e.point2D_idx) for p, i in enumerate(ids) for e in model.point3D(i).track.elements]
    point_of, image_of, feature_of = np.array(rows, np.int64).reshape(-1, 3).T
    images_by_number = {number: model.image(image_id) for image_id, number in numbers.items()}
    pixels = np.array([images_by_number[i].points2D[f].xy for i, f in zip(image_of, feature_of, strict=True)]).reshape(-1, 2) - HALF_PX
    seen = np.array([labels[i][f] for i, f in zip(image_of, feature_of, strict=True)], np.uint8)
    colours = _mean_colours(images, point_of, image_of, pixels, len(points))
    errors = np.array([model.point3D(i).error for i in ids])
    return SparseModel(poses, points, colours, majority_labels(point_of, seen, len(points)), errors, point_of, image_of, feature_of, pixels)


def majority_labels(point_of: np.ndarray, labels: np.ndarray, n_points: int) -> np.ndarray:
    """The label of each point, (P,) uint8: the most frequent moving class when half of its observations or more are on moving things.

    Args:
        point_of: (M,) the point of each observation.
        labels: (M,) uint8 the mask's class there, 0 for none.
        n_points: P.
    """
    n_moving = np.bincount(point_of[labels > 0], minlength=n_points)
    votes = np.stack([np.bincount(point_of[labels == c], minlength=n_points) for c in range(1, int(labels.max(initial=0)) + 2)])
    is_moving = (n_moving > 0) & (2 * n_moving >= np.bincount(point_of, minlength=n_points))
    return np.where(is_moving, votes.argmax(axis=0) + 1, 0).astype(np.uint8)


def _mean_colours(images, point_of, image_of, pixels, n_points: int) -> np.ndarray:
    u, v = np.rint(pixels).astype(int).T
    height, width = images[0].shape[:2]
    colours = np.array([images[i][min(max(y, 0), height - 1), min(max(x, 0), width - 1)] for i, x, y in zip(image_of, u, v, strict=True)])
    counts = np.bincount(point_of, minlength=n_points)
    sums = np.stack([np.bincount(point_of, colours.reshape(-1, 3)[:, c], minlength=n_points) for c in range(3)], axis=1)
    return np.rint(sums / np.maximum(counts, 1)[:, None]).astype(np.uint8)
