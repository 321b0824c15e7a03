"""Calibrations on disk: what a keyframe is calibrated from is read, what was found is written as YAML and as one row.

Frames and directions are written out in each file, for they are what users ask first.
"""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd
import yaml

from streetscan.calibration.drive_calibration import DriveCalibration, KeyframeResult
from streetscan.calibration.edges import Bend, Shot, make_shot
from streetscan.calibration.keyframe_calibration import STAGES, KeyframeCalibration, KeyframeClouds
from streetscan.calibration.keyframes import Keyframe, read_keyframe_images, read_keyframe_lidar
from streetscan.calibration.linear_projection import View, linear_of
from streetscan.calibration.motion import motion_of
from streetscan.calibration.ways import lidar_way
from streetscan.errors import BadInput
from streetscan.frames import CameraModel, Mounting
from streetscan.geometry import invert
from streetscan.io.arrays import load_npz
from streetscan.io.atomic import atomic_path
from streetscan.io.files import find_file, read_yaml
from streetscan.io.las import read_las
from streetscan.io.mcap import TF, iterate_drive, iterate_lidar
from streetscan.registration.odometry import FramePose

# Numbers of a keyframe in its row; those its status did not let be found are empty.
FIGURES = (
    "n_lidar_objects", "n_sfm_objects", "n_lidar_voxels", "n_sfm_voxels", "n_lidar_columns", "n_places", "n_rivals", "n_matched", "n_icp",
    "icp_rmse_m", "scale", "free_scale", "free_shift_m", "way_off_deg", "bend_icp_deg", "bend_deg", "bend_found_deg", "bend_std_deg",
    "median_distance_m", "hausdorff_m", "sigma_x_px", "sigma_y_px", "n_shots", "edge_px", "edge_before_px", "edge_margin_px",
    "distance_before_m", "distance_after_m", "gain_m", "gain_std_m", "edge_gain_px", "edge_gain_std_px",
    "n_common_edges",
)  # fmt: skip
SECONDS = ("raw", "objects", "alignment", "icp", "curves", "motion", "quality")
_MEANING = {
    "projection": "pixel (homogeneous, rectified image, centres at integers) = projection @ (point, 1), raw points of this lidar frame",
    "T_camera_lidar": "p_camera = T_camera_lidar @ p_lidar, sensors as mounted, metres; where the lidar's motion is not known (no stage "
    "motion), with what the vehicle moved between the stamps",
    "T_camera_stamp": "the same for the lidar at its stamp and the camera at the image's: with the motion between them",
}
_COVARIANCE = "of T_camera_stamp as far as clouds and way tell: rotation vector (rad) and shift (m) in the camera's axes"
_BEND_RESPONSE = (
    "turn (rotation vector) and shift (m) of T_camera_stamp, in the camera's axes, for each radian that the way of the camera is off"
)
# What edges tell of an error of the way of the camera, and what holds where they tell nothing.
_BEND_FIGURES = {"bend_found_deg": 0.0, "bend_std_deg": np.inf, "bend_deg": 0.0}


def read_clouds(
    drive_path: str | Path, keyframe: Keyframe, model_folder: str | Path, poses: list[FramePose], dynamic_folder: str | Path | None
) -> KeyframeClouds:
    """What a reconstructed keyframe is calibrated from.

    Args:
        drive_path: drive.mcap.
        keyframe: a usable one.
        model_folder: of reconstruct_keyframe.
        poses: of register_frames.
        dynamic_folder: points of moving things in lidar frames, as detect_dynamic wrote them; None takes none for moving.
    Raises:
        BadInput: a file is missing, damaged, or belongs to another keyframe.
    """
    cameras = read_yaml(Path(model_folder) / "cameras.yaml")
    frame, reference, scale = read_keyframe_lidar(drive_path, keyframe), cameras["reference"], cameras.get("scale")
    K = np.array(cameras["camera_matrix"])
    T_camera_sfm = np.eye(4)
    T_camera_sfm[:3] = np.linalg.solve(K, np.array(cameras["projection"]))
    dense = read_las(Path(model_folder) / "dense.laz")
    is_dynamic = dense.fields["is_dynamic"].astype(bool)
    registered = [i for i in cameras["images"] if i["T_image_camera"] is not None]
    T_image_camera, times_ns = [np.array(i["T_image_camera"]) for i in registered], tuple(i["time_ns"] for i in registered)
    images = read_keyframe_images(drive_path, keyframe)
    return KeyframeClouds(
        frame.points, frame.time_offset_s, read_static(dynamic_folder, keyframe.index, len(frame)), dense.points, is_dynamic,
        # The reference comes first: depths are told from there.
        np.concatenate([np.zeros((1, 3)), [invert(T)[:3, 3] for T in T_image_camera]]),
        View(T_camera_sfm, K, cameras["image_width"], cameras["image_height"]),
        images[reference],
        motion_of(poses, keyframe.lidar_time_ns, keyframe.image_times_ns[reference]),
        read_initial(drive_path),
        scale["std"] / scale["metres_per_unit"] if scale else 0.0,
        times_ns, lidar_way(poses, keyframe.lidar_time_ns, times_ns, keyframe.image_times_ns[reference]),
        read_shots(drive_path, keyframe, images, poses),
    )  # fmt: skip


def read_shots(drive_path: str | Path, keyframe: Keyframe, images: Sequence[np.ndarray], poses: list[FramePose]) -> tuple[Shot, ...]:
    """Each lidar frame taken during a keyframe, with the image nearest in time; those whose motion is known.

    Args:
        drive_path: drive.mcap.
        keyframe: a usable one.
        images: of `read_keyframe_images`.
        poses: of register_frames.
    """
    times_ns, shots = np.array(keyframe.image_times_ns), []
    for frame in iterate_lidar(drive_path, int(times_ns[0] - _BESIDE_NS), int(times_ns[-1] + _BESIDE_NS + 1)):
        nearest = int(np.abs(times_ns - frame.time_ns).argmin())
        motion, way = motion_of(poses, frame.time_ns, int(times_ns[nearest])), motion_of(poses, keyframe.lidar_time_ns, frame.time_ns)
        is_beside = abs(times_ns[nearest] - frame.time_ns) <= _BESIDE_NS
        if not is_beside or motion is None or way is None or frame.time_offset_s is None:
            continue
        points = motion.deskew(frame.points, frame.time_offset_s)
        shots.append(make_shot(images[nearest], points, invert(motion.at([motion.image_s])[0]), way.at([way.image_s])[0]))
    return tuple(shots)


# A lidar frame belongs to an image that is at most so far off in time: half of what a frame lasts.
_BESIDE_NS = 50_000_000


def read_static(folder: str | Path | None, keyframe: int, n_points: int) -> np.ndarray:
    """(N,) bool: the points of a keyframe's lidar frame that belong to nothing that moves; all of them without a folder.

    Raises:
        BadInput: no file for this keyframe, or of another frame.
    """
    if folder is None:
        return np.ones(n_points, bool)
    path = find_file(Path(folder) / f"{keyframe:02d}.npz")
    (is_dynamic,) = load_npz(path, ("is_dynamic",), "detect_dynamic")
    if is_dynamic.shape != (n_points,):
        raise BadInput(path, f"{len(is_dynamic)} points for a frame of {n_points}", "run detect_dynamic again")
    return ~is_dynamic.astype(bool)


def read_initial(drive_path: str | Path) -> np.ndarray | None:
    """T_camera_lidar (4, 4) from the mountings the user gave; None where they do not tell it."""
    found = {(m.parent, m.child): m.T_parent_child for m in iterate_drive(drive_path, (TF,)) if isinstance(m, Mounting)}
    if ("camera", "lidar") in found:
        return found["camera", "lidar"]
    if ("lidar", "camera") in found:
        return invert(found["lidar", "camera"])
    if {("vehicle", "camera"), ("vehicle", "lidar")} <= set(found):
        return invert(found["vehicle", "camera"]) @ found["vehicle", "lidar"]
    return None


def describe_camera(camera: CameraModel | None) -> dict:
    """ROS camera_info fields of the rectified images as plain values; empty without usable intrinsics."""
    if camera is None:
        return {}
    return {
        "image_width": camera.width, "image_height": camera.height, "distortion_model": "plumb_bob", "distortion_coefficients": [0.0] * 5,
        "camera_matrix": camera.K.tolist(), "rectification_matrix": np.eye(3).tolist(), "pixel_centres": "at integers",
    }  # fmt: skip


def write_calibration(path: str | Path, made: KeyframeCalibration, keyframe: Keyframe, reference: int, camera: CameraModel | None) -> None:
    """Write a keyframe's calibration as YAML, `reference` being its image that counts (-1: none); what was not found is null."""
    image_time_ns = keyframe.image_times_ns[reference] if reference >= 0 else None
    found = describe_camera(camera) | {"status": made.status, "reason": made.reason}
    found |= {"lidar_frame": keyframe.lidar_frame, "lidar_time_ns": keyframe.lidar_time_ns, "image_time_ns": image_time_ns}
    for name, meaning in _MEANING.items():
        value = getattr(made, name)
        found |= {name: None if value is None else value.tolist(), f"{name}_is": meaning}
    is_known = np.isfinite(made.covariance).all()
    found |= {"covariance": made.covariance.tolist() if is_known else None, "covariance_is": _COVARIANCE}
    found |= {"bend_response": made.bend_response.tolist(), "bend_response_is": _BEND_RESPONSE}
    found["stages"] = {name: made.stages[name].tolist() for name in STAGES if name in made.stages}
    if len(made.residuals_px):
        lengths = np.hypot(*made.residuals_px.T)
        found["residuals_px"] = {"n": len(lengths), "mean": float(lengths.mean()), "median": float(np.median(lengths))}
    found["figures"] = {name: float(value) for name, value in made.figures.items()}
    write_yaml(path, found)


def read_results(
    calibration_paths: Sequence[str | Path], evidence_paths: Sequence[str | Path], keyframes: list[Keyframe], poses: list[FramePose]
) -> list[KeyframeResult]:
    """What calibrate_keyframe wrote of each keyframe of a drive, with the lidar's motion.

    Args:
        calibration_paths, evidence_paths: one of each per keyframe.
        keyframes: of the drive.
        poses: of register_frames.
    Raises:
        BadInput: a file is missing or damaged.
    """
    results = []
    for keyframe, path, evidence_path in zip(keyframes, calibration_paths, evidence_paths, strict=True):
        found = read_yaml(path)
        T = None if found["T_camera_stamp"] is None else np.array(found["T_camera_stamp"])
        (evidence,) = load_npz(evidence_path, ("evidence",), "calibrate_keyframe")
        motion = motion_of(poses, found["lidar_time_ns"], found["image_time_ns"]) if T is not None else None
        covariance = np.zeros((6, 6)) if found["covariance"] is None else np.array(found["covariance"])
        figures = {name: np.radians(found["figures"].get(name, unknown)) for name, unknown in _BEND_FIGURES.items()}
        bend = Bend(float(figures["bend_found_deg"]), float(figures["bend_std_deg"]))
        response = np.array(found["bend_response"])
        told = bend, float(figures["bend_deg"]), response, found["reason"]
        result = KeyframeResult(keyframe.index, found["status"], T, motion, evidence, covariance, *told)
        results.append(result)
    return results


def write_drive_calibration(
    path: str | Path, made: DriveCalibration, results: Sequence[KeyframeResult], camera: CameraModel | None
) -> None:
    """Write a drive's calibration as YAML; null where no keyframe was accepted and none was in force."""
    is_found, is_known = made.status == "ok", made.status in ("ok", "kept")
    sigmas = np.sqrt(np.diag(made.covariance))
    found = describe_camera(camera) | {
        "status": made.status,
        "keyframes": dict(Counter(r.status for r in results)),
        "used": {f"{k:02d}": round(float(w), 4) for k, w in zip(made.used, made.weights, strict=True)},
        "T_camera_lidar": made.T_camera_lidar.tolist() if is_known else None,
        "T_camera_lidar_is": _MEANING["T_camera_lidar"],
        "projection": linear_of(made.T_camera_lidar, camera.K).tolist() if is_known and camera is not None else None,
        "projection_is": "K T_camera_lidar: of points freed of motion, measured from where the lidar was when the image was taken",
        "time_offset_s": made.time_offset_s if is_found else None,
        "time_offset_is": "what the images' stamps are ahead of the lidar's clock",
    }  # fmt: skip
    if is_found:
        is_told = np.isfinite(made.bend.std_rad)
        found |= {
            "bend": {
                "found_deg": float(np.degrees(made.bend.rad)) if is_told else None,
                "std_deg": float(np.degrees(made.bend.std_rad)) if is_told else None,
                "is_corrected": bool(made.is_straightened),
            },
            "bend_is": "error of the way of the camera, to its right, that all keyframes' image edges tell together",
            "std": {"x_y_z_m": sigmas[:3].tolist(), "turn_deg": np.degrees(sigmas[3:6]).tolist(), "time_offset_s": float(sigmas[6])},
            "covariance": made.covariance.tolist(),
            "covariance_is": "x, y, z of T_camera_lidar (m), rotation vector about the lidar's axes (rad), time offset (s)",
        }
    write_yaml(path, found)


def write_yaml(path: str | Path, found: dict) -> None:
    """Write plain values, short lists in one line."""
    with atomic_path(path) as partial:
        partial.write_text(yaml.safe_dump(found, sort_keys=False, default_flow_style=None, width=140))


def summarize(made: KeyframeCalibration, keyframe: int) -> pd.DataFrame:
    """One row: status, reason, how the clouds were aligned, figures, seconds."""
    a = made.alignment
    row = {"keyframe": f"{keyframe:02d}", "status": made.status, "reason": made.reason, "source": a.source if a else ""}
    row |= {"votes": a.votes if a else 0, "overlap": a.overlap if a else np.nan}
    row |= {name: made.figures.get(name, np.nan) for name in FIGURES}
    return pd.DataFrame([row | {f"{name}_s": round(made.seconds.get(name, np.nan), 2) for name in SECONDS}])
