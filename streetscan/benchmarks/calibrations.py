"""Reconstructed keyframes in the tables and the report, beside the thesis' figures.

Source: Nagy (2020), 4.3.1 (points of Fig. 4.2, reprojection error), Figs. 4.2-4.4.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

from streetscan.benchmarks.published import title
from streetscan.benchmarks.report import Gallery, Part, Section, embed
from streetscan.benchmarks.scores import make_score
from streetscan.io.tables import read_csv

# Metric of evaluate_reconstruction to row and metric of the thesis' single figures.
_TEXT = {
    "n_sparse": ("sfm_sparse", "n_points"), "n_dense": ("sfm_dense", "n_points"), "projection_error": ("sfm_reprojection", "error"),
}  # fmt: skip
_PICTURES = {
    "images": "Images", "sparse": "Sparse", "dense": "Dense", "masks": "Moving", "dynamic": "Moving in 3-D", "points": "Points",
    "features": "Their features", "errors": "Errors x 10",
}  # fmt: skip


def calibration_scores(inputs: Mapping[str, Sequence[str]]) -> list[dict]:
    """Rows of the tidy scores of `reconstructions` (evaluate_reconstruction) and `detections` (evaluate_detections)."""
    return reconstruction_scores(inputs["reconstructions"]) + detection_scores(inputs["detections"])


def reconstruction_scores(paths: Sequence[str]) -> list[dict]:
    """Rows of the tidy scores: one row per drive in the table `reconstruction`, and the thesis' single figures.

    Args:
        paths: `evaluate_reconstruction/<drive>/scores.csv`, one per drive.
    """
    rows = []
    for path in paths:
        drive = Path(path).parent.name
        found = read_csv(path, ("metric", "value", "unit", "n"), "evaluate_reconstruction")
        found["unit"] = found["unit"].fillna("")
        for r in found.to_dict("records"):
            rows.append(make_score("reconstruction", drive, "", r["metric"], r["value"], r["unit"], r["n"], drive, "sfm"))
            if r["metric"] in _TEXT:
                row, metric = _TEXT[r["metric"]]
                rows.append(make_score("nagy_text", row, "proposed", metric, r["value"], r["unit"], r["n"], drive, "sfm"))
    return rows


def detection_scores(paths: Sequence[str]) -> list[dict]:
    """Rows of the tidy scores: what could move, found in images and lidar frames, per drive and class.

    Args:
        paths: `evaluate_detections/<drive>/scores.csv`.
    """
    rows = []
    for path in paths:
        drive = Path(path).parent.name
        for r in read_csv(path, ("sensor", "class", "metric", "value", "unit", "n"), "evaluate_detections").to_dict("records"):
            row = f"{drive}/{r['class']}"
            # What n counts differs from metric to metric; evaluate_detections has each.
            rows.append(make_score("detection", row, "", r["metric"], r["value"], r["unit"], dataset=drive, method=r["sensor"]))
    return rows


def draw_reconstructions(models: Sequence[str]) -> list[Section]:
    """A section per drive with the pictures of its keyframes.

    Args:
        models: folders of reconstruct_keyframe, `<drive>/<keyframe>/model`, one per keyframe.
    """
    sections, keyframes = [], [Path(path).parts[-3:-1] for path in models]
    for drive in dict.fromkeys(d for d, _ in keyframes):
        parts = []
        for folder, (of, keyframe) in zip(map(Path, models), keyframes, strict=True):
            files = [(name, folder / f"{kind}.png") for kind, name in _PICTURES.items() if (folder / f"{kind}.png").is_file()]
            if of == drive and files:
                who = f"keyframe {keyframe} of {title(drive)}"
                caption = f"{who.capitalize()}: images, clouds from behind and above the camera, points and the features that saw them."
                gallery = Gallery(f"keyframe-{drive}-{keyframe}", [(name, embed(path, f"{name}, {who}")) for name, path in files], caption)
                parts.append(Part(f"reconstructed-{drive}-{keyframe}", f"Keyframe {keyframe}", "", [gallery]))
        if parts:
            sections.append(Section(f"reconstructed-{drive}", f"{title(drive)} from images", "", [], parts))
    return sections
