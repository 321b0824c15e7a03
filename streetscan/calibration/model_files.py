"""A reconstructed keyframe on disk: clouds as LAZ, cameras in COLMAP's text form and as YAML, observations, and one row of facts."""

from pathlib import Path

import numpy as np
import pandas as pd
import yaml

from streetscan.calibration.projection import SELECTIONS
from streetscan.calibration.reconstruction import Reconstruction
from streetscan.calibration.sfm import HALF_PX, SparseModel
from streetscan.classes import UNLABELLED, las_codes
from streetscan.clouds import PointCloud
from streetscan.frames import CameraModel
from streetscan.geometry import quaternion_of_transform
from streetscan.io.las import write_las

STAGES = ("sfm", "scale", "projection", "densification")


def write_model(folder: Path, made: Reconstruction, camera: CameraModel, image_times_ns: list[int]) -> None:
    """Write into an existing folder what was made of a keyframe; what its status did not let be made is not there.

    `sparse.laz` and `dense.laz` (frame `camera` of the reference image; class of moving things, `is_dynamic`, `n_views`), `colmap/`
    (cameras, images and points as text), `cameras.yaml` (camera_info fields, poses, T1, scale), `observations.npz` (which feature of which
    image saw which point).
    """
    if made.sparse is None:
        return
    s = made.sparse
    write_las(
        folder / "sparse.laz", PointCloud(s.points, _fields(s.labels, s.colours, s.n_views) | {"error_px": s.errors_px.astype(np.float32)})
    )
    if made.dense is not None:
        write_las(folder / "dense.laz", PointCloud(made.dense.points, _fields(made.dense.labels, made.dense.colours, made.dense.n_views)))
    write_colmap(folder / "colmap", s, camera)
    with (folder / "observations.npz").open("wb") as stream:
        np.savez(stream, point=s.point_of, image=s.image_of, feature=s.feature_of, pixel=s.pixels)
    (folder / "cameras.yaml").write_text(
        yaml.safe_dump(describe_cameras(made, camera, image_times_ns), sort_keys=False, default_flow_style=None)
    )


def describe_cameras(made: Reconstruction, camera: CameraModel, image_times_ns: list[int]) -> dict:
    """Cameras as plain values: ROS camera_info fields of the rectified images, T_image_camera of each image, T1, scale."""
    poses = [T.tolist() if np.isfinite(T).all() else None for T in made.sparse.T_camera_sfm]
    found = {
        "image_width": camera.width, "image_height": camera.height, "distortion_model": "plumb_bob", "distortion_coefficients": [],
        "camera_matrix": camera.K.tolist(), "pixel_centres": "at integers",
        "frame": f"camera of image {made.reference}; {'metres' if made.scale else 'no unit'}",
        "reference": made.reference,
        "images": [{"time_ns": int(t), "T_image_camera": pose} for t, pose in zip(image_times_ns, poses, strict=True)],
    }  # fmt: skip
    if made.projection is not None:
        found["projection"] = made.projection.matrix(camera.K).tolist()
        found["projection_error_px"] = made.projection.mean_error_px
    if made.scale is not None:
        scale = {
            "metres_per_unit": made.scale.value,
            "std": made.scale.std,
            "lever_m": made.scale.lever_m.tolist(),
            "way_m": made.scale.way_m,
            "misfit_m": made.scale.misfit_m,
            "turn_off_deg": made.scale.turn_off_deg,
        }
        found["scale"] = scale
    return found


def summarize(made: Reconstruction, keyframe: int, n_images: int) -> pd.DataFrame:
    """One row: status, reason and numbers of a keyframe; empty where its status did not let them be found."""
    s, nan = made.sparse, float("nan")
    row = {
        "keyframe": f"{keyframe:02d}", "status": made.status, "reason": made.reason, "reference": made.reference, "n_images": n_images,
        "n_registered": int(s.is_registered.sum()) if s else 0,
        "n_sparse": len(s.points) if s else 0, "n_sparse_dynamic": int((s.labels > 0).sum()) if s else 0,
        "sfm_error_px": float(s.errors_px.mean()) if s else nan,
        "projection_error_px": made.projection.mean_error_px if made.projection else nan,
        **{f"{selection}_error_px": made.selection_errors_px.get(selection, nan) for selection in SELECTIONS},
        "n_dense": len(made.dense) if made.dense else 0, "n_dense_dynamic": int((made.dense.labels > 0).sum()) if made.dense else 0,
        "scale_std": made.scale.std / made.scale.value if made.scale else nan, "way_m": made.scale.way_m if made.scale else nan,
        "way_misfit": made.scale.misfit_m / made.scale.way_m if made.scale else nan,
        "turn_off_deg": made.scale.turn_off_deg if made.scale else nan,
    }  # fmt: skip
    return pd.DataFrame([row | {f"{stage}_s": round(made.seconds.get(stage, nan), 2) for stage in STAGES}])


def write_colmap(folder: Path, model: SparseModel, camera: CameraModel) -> None:
    """Write cameras.txt, images.txt and points3D.txt as COLMAP does, pixel centres at halves; images are named by their number."""
    folder.mkdir(parents=True)
    K = camera.K
    params = (K[0, 0], K[1, 1], K[0, 2] + HALF_PX, K[1, 2] + HALF_PX)
    text = f"1 PINHOLE {camera.width} {camera.height} {' '.join(repr(float(p)) for p in params)}\n"
    (folder / "cameras.txt").write_text("# CAMERA_ID MODEL WIDTH HEIGHT PARAMS\n" + text)
    place = np.empty(len(model.point_of), np.int64)
    lines = ["# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME", "# X Y POINT3D_ID"]
    for i in np.flatnonzero(model.is_registered):
        rows = np.flatnonzero(model.image_of == i)
        place[rows] = np.arange(len(rows))
        x, y, z, w = quaternion_of_transform(model.T_camera_sfm[i])
        pose = " ".join(f"{value:.12g}" for value in (w, x, y, z, *model.T_camera_sfm[i, :3, 3]))
        lines.append(f"{i + 1} {pose} 1 {i:06d}.png")
        lines.append(
            " ".join(
                f"{u + HALF_PX:.4f} {v + HALF_PX:.4f} {p + 1}" for (u, v), p in zip(model.pixels[rows], model.point_of[rows], strict=True)
            )
        )
    (folder / "images.txt").write_text("\n".join(lines) + "\n")
    order = np.argsort(model.point_of, kind="stable")
    bounds = np.searchsorted(model.point_of[order], np.arange(len(model.points) + 1))
    lines = ["# POINT3D_ID X Y Z R G B ERROR TRACK (IMAGE_ID POINT2D_IDX)"]
    for p, (point, colour, error) in enumerate(zip(model.points, model.colours, model.errors_px, strict=True)):
        track = " ".join(f"{model.image_of[r] + 1} {place[r]}" for r in order[bounds[p] : bounds[p + 1]])
        lines.append(f"{p + 1} {' '.join(f'{c:.9g}' for c in point)} {' '.join(map(str, colour))} {error:.4f} {track}")
    (folder / "points3D.txt").write_text("\n".join(lines) + "\n")


def _fields(labels: np.ndarray, colours: np.ndarray, n_views: np.ndarray) -> dict[str, np.ndarray]:
    """The fields both clouds have; a point on nothing that moves has no class."""
    codes = las_codes(np.where(labels > 0, labels, UNLABELLED).astype(np.uint8))
    return {"rgb": colours, "classification": codes, "is_dynamic": labels > 0, "n_views": n_views.astype(np.uint8)}
