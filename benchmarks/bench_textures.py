"""Whether rendered streets hold what structure from motion needs: how many places of eight pictures each COLMAP reconstructs whole."""

import tempfile
from pathlib import Path

import cv2
import numpy as np
import pycolmap

from streetscan.simulation.camera import Camera, mount_camera, render, settle_exposure
from streetscan.simulation.changes import Day
from streetscan.simulation.layout import build_street
from streetscan.simulation.raycasting import SceneCaster
from streetscan.simulation.recording import drive_road, without_collisions

# Where is looked: split, kind of place, its number, metres along it, season. None is of a test street.
PLACES = (
    ("train", "main_road", 0, 20.0, "summer"),
    ("train", "main_road", 0, 50.0, "summer"),
    ("train", "main_road", 0, 80.0, "summer"),
    ("train", "narrow_road", 0, 15.0, "autumn"),
    ("train", "square", 0, 5.0, "autumn"),
    ("validation", "main_road", 0, 25.0, "winter"),
    ("validation", "main_road", 0, 55.0, "winter"),
    ("validation", "main_road", 0, 85.0, "winter"),
    ("validation", "narrow_road", 0, 15.0, "spring"),
    ("validation", "crossroads", 0, 10.0, "spring"),
)
N_PICTURES, SPACING_M, SPEED_KMH = 8, 0.6, 25.0
LEAST_POINTS = 1500
_LEAST_ANGLE_DEG = 0.4


def bench_textures() -> list[dict]:
    """Rows of how many places are whole (all eight pictures registered, 1500 points or more), and of points and pictures in the middle."""
    found = np.array([reconstruct(*take_pictures(*place)) for place in PLACES])
    is_whole = (found[:, 0] == N_PICTURES) & (found[:, 1] >= LEAST_POINTS)
    figures = (
        ("places reconstructed whole", is_whole.sum(), ""),
        ("pictures registered, fewest of a place", found[:, 0].min(), ""),
        ("points of a place, median", np.median(found[:, 1]), ""),
        ("points of a place, fewest", found[:, 1].min(), ""),
    )
    return [
        {"benchmark": "textures", "metric": metric, "value": float(value), "unit": unit, "peer": "COLMAP", "n": len(PLACES)}
        for metric, value, unit in figures
    ]


def take_pictures(split: str, place: str, number: int, start_m: float, season: str) -> tuple[list[np.ndarray], Camera]:
    """Eight grey pictures (H, W) uint8 of a place, 0.6 m apart, and their camera.

    Args:
        split, place, number: which stretch of the city's streets of 120 m.
        start_m: where on it the first is taken.
        season: of the day.
    """
    span_s = start_m / (SPEED_KMH / 3.6) + N_PICTURES
    scene = build_street(120.0, split, 1, day=Day(season=season), time_span_s=(-10.0, span_s))
    trajectory = drive_road(scene.places[place][number], SPEED_KMH, scene.lane_offset_m, 0.0, np.random.default_rng(1))
    along = np.append(0, np.cumsum(np.linalg.norm(np.diff(trajectory.positions, axis=0), axis=1)))
    stations = start_m + SPACING_M * np.arange(N_PICTURES)
    times_s = trajectory.start_s + np.interp(stations, along, np.arange(len(along))) / trajectory.rate_hz
    caster = SceneCaster(without_collisions(scene, trajectory), 0.0, span_s)
    camera, view = Camera(), (caster, trajectory, mount_camera((1.25, 0.08, 1.58), pitch_deg=1.5))
    auto_exposure = settle_exposure(*view, camera, times_s[0])
    pictures = [render(*view, camera, t, auto_exposure, np.random.default_rng([1, i])).rgb for i, t in enumerate(times_s)]
    return [cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY) for picture in pictures], camera


def reconstruct(pictures: list[np.ndarray], camera: Camera) -> tuple[int, int]:
    """How many of the pictures COLMAP registers with the known lens, and how many points it finds.

    ASSUME: features of the image's own size, and points whose rays meet under 0.4 degrees or more, since a camera that drives
    forward sees most of the street under small angles.
    """
    K, D = camera.model.K, camera.model.D
    # COLMAP's pixel centres lie at halves.
    lens = [K[0, 0], K[1, 1], K[0, 2] + 0.5, K[1, 2] + 0.5, *D[:4]]
    reader = pycolmap.ImageReaderOptions(camera_model="OPENCV", camera_params=",".join(repr(float(v)) for v in lens))
    extraction = pycolmap.FeatureExtractionOptions(num_threads=1, use_gpu=False)
    extraction.sift.first_octave = 0
    matching = pycolmap.FeatureMatchingOptions(num_threads=1, use_gpu=False)
    mapping = pycolmap.IncrementalPipelineOptions(num_threads=1, random_seed=1, multiple_models=False, extract_colors=False)
    mapping.ba_refine_focal_length = mapping.ba_refine_principal_point = mapping.ba_refine_extra_params = False
    mapping.mapper.init_max_forward_motion = 1.0
    mapping.mapper.init_min_tri_angle, mapping.mapper.ba_local_min_tri_angle = 2 * _LEAST_ANGLE_DEG, _LEAST_ANGLE_DEG
    mapping.mapper.filter_min_tri_angle = mapping.triangulation.min_angle = _LEAST_ANGLE_DEG
    pycolmap.logging.minloglevel = pycolmap.logging.Level.ERROR.value
    pycolmap.set_random_seed(1)
    with tempfile.TemporaryDirectory() as folder:
        database, images, sparse = (Path(folder) / name for name in ("database.db", "images", "sparse"))
        images.mkdir()
        for i, picture in enumerate(pictures):
            cv2.imwrite(str(images / f"{i}.png"), picture)
        options = {"camera_mode": pycolmap.CameraMode.SINGLE, "device": pycolmap.Device.cpu}
        pycolmap.extract_features(database, images, reader_options=reader, extraction_options=extraction, **options)
        pycolmap.match_exhaustive(database, matching_options=matching, device=pycolmap.Device.cpu)
        models = pycolmap.incremental_mapping(database, images, sparse, mapping)
    return max(((m.num_reg_images(), m.num_points3D()) for m in models.values()), default=(0, 0))
