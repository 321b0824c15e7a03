"""One self-contained HTML page per drive: its numbers, tracks, time line, frames as pictures, images, lidar in the image."""

import base64
import html
import io
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

from streetscan.classes import CLASSES, colours
from streetscan.errors import BadInput
from streetscan.frames import CAMERA, STATUSES, LidarFrame
from streetscan.inspection import Inspection, fix_track_m, project_points
from streetscan.io.atomic import atomic_path
from streetscan.io.images import decode_image

_STATUS_COLOURS = dict(zip(STATUSES, ("#2a7f3f", "#8c8c8c", "#d9a400", "#c0392b", "#8e44ad", "#1f1f1f", "#1f6fb2", "#e67e22"), strict=True))
# ASSUME: what a street map is about lies within 40 m of the sensor; indoors, where nearly all is nearer, the view is as wide as that.
_VIEW_M = 40.0
_PAGE_INCHES = 10.0
_SMALLEST_VIEW_M, _VIEW_STEP_M = 10.0, 5.0
_CHANGES = {
    "same": ("#b5b5b5", "."), "moved": ("#d9a400", "^"), "other": ("#1f6fb2", "s"), "new": ("#2a7f3f", "P"), "gone": ("#c0392b", "x"),
}  # fmt: skip
_STYLE = """
body{font:15px/1.45 system-ui,sans-serif;color:#222;max-width:1080px;margin:2em auto;padding:0 1em}
h1{font-size:1.5em;margin-bottom:.1em} h2{font-size:1.1em;margin:1.6em 0 .4em;border-bottom:1px solid #ccc}
table{border-collapse:collapse} td{padding:.15em .9em .15em 0;vertical-align:top} td:first-child{color:#666;white-space:nowrap}
img{max-width:100%} figure{margin:.6em 0} figcaption{color:#555;font-size:.9em}
"""


def write_drive_sheet(path: str | Path, name: str, description: str, source: str, inspection: Inspection) -> None:
    """Write the page of a drive.

    Args:
        path: the HTML file; pictures are inside it.
        name, description, source: of the drive's file.
        inspection: what to show.
    """
    parts = [f"<h1>{html.escape(name)}</h1><p>{html.escape(description)}<br><small>{html.escape(source)}</small></p>", _numbers(inspection)]
    caption = "Where the drive went: GPS fixes, and the true positions where they are known."
    parts.append("<h2>Tracks</h2>" + _figure(_tracks(inspection), caption, "The drive holds neither GPS fixes nor true positions."))
    parts.append(
        "<h2>Time line</h2>" + _figure(_time_line(inspection), "Points of each frame over time; colours are statuses, bands are gaps.")
    )
    shades = "true class" if inspection.labels else "height"
    caption = f"Lidar frames from above, {_view_m(inspection):.0f} m to each side, coloured by {shades}; forward is up."
    parts.append("<h2>Frames</h2>" + _figure(_frames(inspection), caption, "No frame holds a point."))
    if inspection.changes is not None:
        caption = "What became of the objects since the day of the map, with the true track."
        parts.append("<h2>Changes</h2>" + _figure(_changes(inspection), caption))
    if inspection.images:
        parts.append("<h2>Images</h2>" + _images(inspection))
    page = f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{html.escape(name)}</title><style>{_STYLE}</style></head>'
    with atomic_path(path) as partial:
        partial.write_text(f"{page}<body>{''.join(parts)}</body></html>\n", encoding="utf-8")


def _numbers(inspection: Inspection) -> str:
    rows = "".join(f"<tr><td>{html.escape(k)}</td><td>{html.escape(v)}</td></tr>" for k, v in inspection.numbers().items())
    statuses = [s for s in inspection.frames["status"].unique() if s != "ok"]
    notes = "".join(f"<li><b>{s}</b>: {STATUSES.get(s, s)}</li>" for s in statuses)
    return f"<table>{rows}</table>" + (f"<ul>{notes}</ul>" if notes else "")


def _tracks(inspection: Inspection) -> plt.Figure | None:
    fixes = fix_track_m(inspection.fixes)
    positions = None if inspection.poses is None else inspection.poses[np.isfinite(inspection.poses).all(axis=(1, 2)), :3, 3]
    has_poses = positions is not None and len(positions) > 0
    if not len(fixes) and not has_poses:
        return None
    in_map = inspection.fixes_in_map if has_poses else None
    if in_map is not None:
        # One panel: the fixes in the map of the truth.
        figure, axes = plt.subplots(figsize=(10, 5), squeeze=False, layout="constrained")
        _draw_truth(axes[0, 0], positions)
        _draw_fixes(axes[0, 0], in_map - positions[0, :2], inspection)
    else:
        figure, axes = plt.subplots(1, int(len(fixes) > 0) + int(has_poses), figsize=(10, 4.2), squeeze=False, layout="constrained")
        if len(fixes):
            _draw_fixes(axes[0, 0], fixes, inspection)
            axes[0, 0].set(xlabel="east [m]", ylabel="north [m]")
        if has_poses:
            _draw_truth(axes[0, -1], positions)
    for axis in axes[0]:
        axis.legend(fontsize=8)
        axis.set_aspect("equal", adjustable="datalim")
        axis.grid(alpha=0.3)
    return figure


def _draw_fixes(axis: plt.Axes, fixes: np.ndarray, inspection: Inspection) -> None:
    inside = _during(inspection, inspection.fixes["time_s"].to_numpy())
    axis.plot(*fixes.T, "-", color="#999", lw=1)
    axis.plot(*fixes[~inside].T, ".", color="#bbb", ms=3)
    if inside.any():
        axis.plot(*fixes[inside].T, ".", color="#1f6fb2", ms=4, label=f"GPS, {inside.sum()} of {len(fixes)} fixes while the lidar ran")
    axis.plot(*fixes[0], "o", color="#1f6fb2", label="its start")


def _draw_truth(axis: plt.Axes, positions: np.ndarray) -> None:
    local = positions - positions[0]
    axis.plot(local[:, 0], local[:, 1], ".-", color="#c0392b", ms=3, lw=1, label=f"truth, {len(positions)} poses")
    axis.plot(*local[0, :2], "o", color="#2a7f3f", label="start")
    axis.set(xlabel="x of the map from the start [m]", ylabel="y [m]")


def _during(inspection: Inspection, times_s: np.ndarray) -> np.ndarray:
    frames = inspection.frames["time_s"]
    return (times_s >= frames.min() - 0.1) & (times_s <= frames.max() + 0.1)


def _time_line(inspection: Inspection) -> plt.Figure:
    frames = inspection.frames
    start = frames["time_s"].min()
    rows = {"lidar": frames["time_s"], **inspection.image_times_s}
    if len(inspection.fixes):
        rows["gps"] = inspection.fixes["time_s"]
    figure, (axis, lower) = plt.subplots(
        2, 1, figsize=(10, 3.2 + 0.2 * len(rows)), sharex=True, height_ratios=(4, 0.33 * len(rows)), layout="constrained"
    )
    for status, group in frames.groupby("status"):
        axis.plot(
            group["time_s"] - start, group["n_points"], ".", ms=4, color=_STATUS_COLOURS.get(status, "k"), label=f"{status} ({len(group)})"
        )
    axis.set(ylabel="points per frame", ylim=(0, 1.1 * max(frames["n_points"].max(), 1)))
    axis.legend(fontsize=8, ncols=8, loc="lower right", bbox_to_anchor=(1, 1), frameon=False)
    axis.grid(alpha=0.3)
    for gap in inspection.gaps.itertuples():
        for a in (axis, lower):
            a.axvspan(gap.start_s - start, gap.start_s - start + gap.duration_s, color="#c0392b", alpha=0.18, lw=0)
    for i, times in enumerate(rows.values()):
        lower.plot(times - start, np.full(len(times), i), "|", color="#333", ms=9)
    lower.set(
        yticks=range(len(rows)),
        yticklabels=list(rows),
        ylim=(-0.6, len(rows) - 0.4),
        xlabel="time since the first frame [s]",
    )
    return figure


def _frames(inspection: Inspection) -> plt.Figure | None:
    if not inspection.pictured:
        return None
    figure, axes = plt.subplots(
        1, len(inspection.pictured), figsize=(3.6 * len(inspection.pictured), 3.9), squeeze=False, layout="constrained"
    )
    for axis, (row, frame) in zip(axes[0], inspection.pictured.items(), strict=True):
        drawn = _draw_from_above(axis, frame, _view_m(inspection), inspection.labels.get(row))
        axis.set_title(f"frame {row}: {len(frame)} points", fontsize=9)
    if inspection.labels:
        present = np.unique(np.concatenate(list(inspection.labels.values())))
        keys = [plt.Line2D([], [], ls="", marker="o", color=np.array(c.colour) / 255, label=c.title) for c in CLASSES if c.label in present]
        figure.legend(handles=keys, loc="outside lower center", ncols=len(keys), fontsize=8, frameon=False)
    else:
        figure.colorbar(drawn, ax=axes[0], label="height over the sensor [m]", shrink=0.8)
    return figure


def _view_m(inspection: Inspection) -> float:
    """How far the frames are shown to each side, metres: 99 of 100 points are in it, or _VIEW_M."""
    reaches_m = [np.quantile(np.abs(f.points[:, :2]).max(axis=1), 0.99) for f in inspection.pictured.values()]
    return float(np.clip(_VIEW_STEP_M * np.ceil(max(reaches_m, default=_VIEW_M) / _VIEW_STEP_M), _SMALLEST_VIEW_M, _VIEW_M))


def _draw_from_above(axis: plt.Axes, frame: LidarFrame, view_m: float, labels: np.ndarray | None):
    is_near = (np.abs(frame.points[:, :2]) < view_m).all(axis=1)
    near = frame.points[is_near]
    shades = {"c": near[:, 2], "cmap": "viridis", "vmin": -2.5, "vmax": 4} if labels is None else {"c": colours(labels[is_near]) / 255}
    drawn = axis.scatter(-near[:, 1], near[:, 0], s=0.15, linewidths=0, rasterized=True, **shades)
    axis.plot(0, 0, "^", color="#c0392b", ms=6)
    axis.set(xlim=(-view_m, view_m), ylim=(-view_m, view_m), aspect="equal", facecolor="#f4f4f4")
    axis.tick_params(labelsize=7)
    return drawn


def _changes(inspection: Inspection) -> plt.Figure:
    figure, axis = plt.subplots(figsize=(10, 6), layout="constrained")
    start = inspection.poses[np.isfinite(inspection.poses).all(axis=(1, 2)), :2, 3]
    axis.plot(*(start - start[0]).T, "-", color="#c0392b", lw=1.5, label="true track")
    for change, (colour, marker) in _CHANGES.items():
        rows = inspection.changes[inspection.changes["change"] == change]
        place = rows[["x_m", "y_m"]].to_numpy() - start[0]
        axis.plot(*place.T, marker, color=colour, ms=4 if change == "same" else 6, label=f"{change} ({len(rows)})", ls="")
    axis.set(xlabel="x of the map from the start of the drive [m]", ylabel="y [m]", aspect="equal")
    axis.legend(fontsize=8, loc="center left", bbox_to_anchor=(1, 0.5))
    axis.grid(alpha=0.3)
    return figure


def _images(inspection: Inspection) -> str:
    """The images of each pictured frame, those of several cameras side by side."""
    parts = []
    for row, images in inspection.images.items():
        pixels = {}
        for name, image in sorted(images.items()):
            try:
                pixels[name] = decode_image(image)
            except BadInput as error:
                parts.append(f"<p>Frame {row}: {html.escape(str(error))}</p>")
        if not pixels:
            continue
        figure, axes = _image_axes([p.shape[1] / p.shape[0] for p in pixels.values()])
        drawn = [_draw_image(axis, inspection, row, name, pixels[name]) for axis, name in zip(axes, pixels, strict=True)]
        gap_ms = (images[next(iter(pixels))].time_ns * 1e-9 - inspection.frames["time_s"].iloc[row]) * 1e3
        is_one = len(pixels) == 1
        caption = f"{'Image' if is_one else 'Images'} of frame {row} ({gap_ms:+.1f} ms)" + ("" if is_one else f": {', '.join(pixels)}")
        if any(n is not None for n in drawn):
            n_points = sum(n or 0 for n in drawn)
            caption += f", {n_points} lidar points in {'it' if is_one else 'them'}, coloured by depth (red near, blue 50 m)"
            if inspection.points_at_image(row, next(iter(pixels)))[1]:
                caption += ", carried to its moment by the true poses; what moves by itself is not"
        parts.append(_figure(figure, caption + "."))
    return "".join(parts)


def _image_axes(ratios: list[float]) -> tuple[plt.Figure, list[plt.Axes]]:
    """Places for images of these widths over heights, at most three beside one another."""
    n_columns = min(len(ratios), 3)
    n_rows = -(-len(ratios) // n_columns)
    size = _PAGE_INCHES, n_rows * _PAGE_INCHES / n_columns / min(ratios)
    figure, axes = plt.subplots(n_rows, n_columns, figsize=size, squeeze=False, layout="constrained")
    for axis in axes.flat[len(ratios) :]:
        axis.set_axis_off()
    return figure, list(axes.flat[: len(ratios)])


def _draw_image(axis: plt.Axes, inspection: Inspection, row: int, name: str, pixels: np.ndarray) -> int | None:
    """An image, and the points of its frame where model and place of the camera are known; how many they are."""
    axis.imshow(pixels)
    n_points, model = None, inspection.camera_models.get(name)
    T = inspection.T_camera_lidar_at(row, name)
    if T is None and name == CAMERA:
        T = _mounted_camera(inspection)
    if model is not None and T is not None:
        uv, depths = project_points(inspection.points_at_image(row, name)[0], T, model)
        n_points, scale = len(uv), pixels.shape[1] / model.width
        # As wide on the page as a point of a single image, and less where several share it.
        size = (2.0 if pixels.shape[1] > 800 else 3.0) * (axis.get_position().width / 0.9) ** 2
        axis.scatter(*(uv * scale).T, s=size, c=depths, cmap="turbo_r", vmin=0, vmax=50, linewidths=0, alpha=0.8)
    axis.set_axis_off()
    axis.set(xlim=(-0.5, pixels.shape[1] - 0.5), ylim=(pixels.shape[0] - 0.5, -0.5))
    return n_points


def _mounted_camera(inspection: Inspection) -> np.ndarray | None:
    """T_camera_lidar where the user's own mountings tell it."""
    known = {(m.parent, m.child): m.T_parent_child for m in inspection.mountings}
    if ("lidar", "camera") in known:
        return np.linalg.inv(known["lidar", "camera"])
    if ("camera", "lidar") in known:
        return known["camera", "lidar"]
    if ("vehicle", "camera") in known and ("vehicle", "lidar") in known:
        return np.linalg.inv(known["vehicle", "camera"]) @ known["vehicle", "lidar"]
    return None


def _figure(figure: plt.Figure | None, caption: str, missing: str = "") -> str:
    if figure is None:
        return f"<p>{html.escape(missing)}</p>"
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=110)
    plt.close(figure)
    data, text = base64.b64encode(stream.getvalue()).decode(), html.escape(caption)
    return f'<figure><img alt="{text}" src="data:image/png;base64,{data}"><figcaption>{text}</figcaption></figure>'
