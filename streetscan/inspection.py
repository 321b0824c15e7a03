"""What an imported drive holds, in numbers: counts, gaps, rates, tracks; and lidar points in an image."""

from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
import pandas as pd

from streetscan import geodesy, geometry
from streetscan.errors import BadInput
from streetscan.extrinsics import extrinsics_at
from streetscan.frames import CAMERA, CameraImage, CameraModel, GpsFix, LidarFrame, Mounting
from streetscan.io.arrays import load_npy
from streetscan.io.files import find_file, read_yaml
from streetscan.io.mcap import iterate_drive, read_topics
from streetscan.io.trajectories import read_poses_csv
from streetscan.sweeps import deskew_along

# ASSUME: a pause of more than one and a half frames is a gap; jitter of a spinning lidar stays below a tenth.
_GAP_FACTOR = 1.5
_EARTH_M = 6_371_000.0


@dataclass
class Inspection:
    """One drive in numbers.

    Attributes:
        frames: frames.csv, one row per lidar frame.
        fixes: table time_s, latitude_deg, longitude_deg, altitude_m.
        poses: (n, 4, 4) true poses in their map, NaN where unknown, or None.
        camera_models: intrinsics by the name of the camera.
        mountings: what the user gave.
        extrinsics: true places of the cameras by name, as far as known; see `streetscan.extrinsics.extrinsics_at`.
        labels_ids: whose label ids the truth has, or None.
        crs: of the true poses, or None.
        labels: true classes (N,) uint8 of the pictured frames, by their row, where the truth has ours.
        changes: what became of each object of the street since the map's day (class, change, x_m, y_m), or None.
        pictured: a few whole lidar frames, evenly spread, by their row.
        images: of each of them that has one its nearest image by the name of the camera.
        image_times_s: stamps (n,) of all images by the name of the camera.
    """

    frames: pd.DataFrame
    fixes: pd.DataFrame
    poses: np.ndarray | None
    camera_models: dict[str, CameraModel]
    mountings: list[Mounting]
    extrinsics: dict[str, dict]
    labels_ids: str | None
    pictured: dict[int, LidarFrame]
    images: dict[int, dict[str, CameraImage]]
    crs: str | None = None
    labels: dict[int, np.ndarray] = field(default_factory=dict)
    changes: pd.DataFrame | None = None
    image_times_s: dict[str, np.ndarray] = field(default_factory=dict)

    def points_at_image(self, row: int, camera: str) -> tuple[np.ndarray, bool]:
        """Points (N, 3) of a pictured frame in frame `lidar` at the moment of its image, and whether the true poses carried them there.

        Without poses, and where they do not reach, each point stays in the frame of its own firing.
        """
        frame = self.pictured[row]
        times_s = self.frames["time_s"].to_numpy(np.float64)
        known = np.zeros(len(times_s), bool) if self.poses is None else np.isfinite(self.poses).all(axis=(1, 2))
        known[1:] &= times_s[1:] > np.maximum.accumulate(times_s)[:-1]
        # What its stamps are ahead of the lidar's clock is in a simulated drive's truth.
        image_s = self.images[row][camera].time_ns * 1e-9 - self.extrinsics.get(camera, {}).get("time_offset_s", 0.0)
        if known.sum() < 2 or not times_s[known][0] <= image_s <= times_s[known][-1]:
            return frame.points, False
        offsets_s = np.zeros(len(frame)) if frame.time_offset_s is None else frame.time_offset_s.astype(np.float64)
        carried = deskew_along(frame.points, offsets_s + times_s[row] - image_s, image_s, times_s[known], self.poses[known])
        return np.where(np.isfinite(carried), carried, frame.points), True

    def T_camera_lidar_at(self, row: int, camera: str) -> np.ndarray | None:
        """The true one (4, 4) of a pictured frame's image, or None."""
        return extrinsics_at(self.extrinsics[camera], self.images[row][camera].time_ns) if camera in self.extrinsics else None

    @property
    def gaps(self) -> pd.DataFrame:
        """Pauses between frames: columns after (row), start_s, duration_s."""
        times = self.frames["time_s"].to_numpy(np.float64)
        steps = np.diff(times)
        usual = float(np.median(steps)) if len(steps) else np.nan
        rows = np.flatnonzero(steps > _GAP_FACTOR * usual)
        return pd.DataFrame({"after": rows, "start_s": times[rows], "duration_s": steps[rows]})

    @property
    def fixes_in_map(self) -> np.ndarray | None:
        """Easting and northing (n, 2) of the fixes in the map of the true poses, or None without a CRS."""
        if self.crs is None or not len(self.fixes):
            return None
        return geodesy.project(self.fixes["latitude_deg"], self.fixes["longitude_deg"], self.crs)

    @property
    def gps_errors_m(self) -> np.ndarray | None:
        """Distances of the fixes during the drive from where the lidar truly was (the antenna's place left aside), or None."""
        fixes, frame_times = self.fixes_in_map, self.frames["time_s"].to_numpy(np.float64)
        if fixes is None or self.poses is None:
            return None
        times = self.fixes["time_s"].to_numpy()
        inside = (times >= frame_times.min()) & (times <= frame_times.max())
        order = np.argsort(frame_times, kind="stable")
        truth = np.stack([np.interp(times[inside], frame_times[order], self.poses[order, i, 3]) for i in (0, 1)], axis=1)
        errors = np.linalg.norm(fixes[inside] - truth, axis=1)
        return errors[np.isfinite(errors)]

    def numbers(self) -> dict[str, str]:
        """The numbers a reader wants first, as text with units."""
        frames = self.frames
        times = frames["time_s"].to_numpy(np.float64)
        good = frames["status"].isin(["ok", "partial", "time_backwards"])
        n_points = frames.loc[good, "n_points"]
        steps = np.diff(times)
        numbers = {"frames": f"{len(frames)} ({_counts(frames['status'])})"}
        numbers["duration"] = f"{times.max() - times.min():.3f} s from {_date(times.min())}"
        numbers["rate"] = f"{1 / np.median(steps):.3f} Hz" if len(steps) and np.median(steps) > 0 else "one frame"
        gaps = self.gaps
        numbers["gaps"] = f"{len(gaps)}, longest {gaps['duration_s'].max():.3f} s" if len(gaps) else "none"
        numbers["points per frame"] = f"{n_points.min()} / {n_points.median():.0f} / {n_points.max()} (least, median, most)"
        numbers["points in all"] = f"{frames['n_points'].sum():,}"
        numbers["returns without coordinates"] = str(frames["n_dropped"].sum())
        offsets = frames[["first_offset_s", "last_offset_s"]].median()
        is_de_skewed = (offsets == 0).all()
        numbers["firing times"] = (
            "0: the source is de-skewed" if is_de_skewed else f"{offsets.iloc[0]:.4f} to {offsets.iloc[1]:.4f} s about forward (median)"
        )
        has_camera = (frames["image_status"] != "none").any()
        numbers["images"] = "none: there is no camera"
        if has_camera:
            all_in_all = ", ".join(f"{len(times)} of {name}" for name, times in self.image_times_s.items()) or "none"
            numbers["images"] = f"{all_in_all}; beside the frames: {_counts(frames['image_status'])}"
        numbers["fixes"] = str(len(self.fixes)) if len(self.fixes) else "none: there is no /gps"
        if len(self.fixes) > 1:
            numbers["GPS track"] = f"{path_length_m(fix_track_m(self.fixes)):.1f} m"
        if self.poses is not None:
            positions = self.poses[:, :3, 3]
            known = np.isfinite(positions).all(axis=1)
            numbers["true track"] = f"{path_length_m(positions[known]):.1f} m, {int(known.sum())} of {len(known)} poses known"
        if (error_m := self.gps_errors_m) is not None and len(error_m):
            numbers["GPS from the true track"] = f"{np.median(error_m):.1f} m, at most {error_m.max():.1f} m"
        numbers["true labels"] = self.labels_ids or "none"
        if self.changes is not None:
            numbers["objects since the map's day"] = _counts(self.changes["change"])
        for mounting in self.mountings:
            x, y, z = mounting.T_parent_child[:3, 3]
            roll, pitch, yaw = np.degrees(geometry.rpy_of_transform(mounting.T_parent_child))
            numbers[f"{mounting.child} in {mounting.parent}"] = f"{x:.3f}, {y:.3f}, {z:.3f} m; {roll:.2f}, {pitch:.2f}, {yaw:.2f} deg"
        for name, model in self.camera_models.items():
            K = model.K
            numbers[name] = (
                f"{model.width} x {model.height}, f {K[0, 0]:.1f}, {K[1, 1]:.1f}, "
                f"centre {K[0, 2]:.1f}, {K[1, 2]:.1f} px, {'distorted' if np.any(model.D) else 'no distortion'}"
            )
        return numbers


def inspect_drive(mcap_path: str | Path, frames_path: str | Path, truth_folder: str | Path | None, n_pictured: int = 3) -> Inspection:
    """Look through a drive once, streaming; only the pictured frames and images stay in memory.

    Args:
        mcap_path, frames_path: drive.mcap and frames.csv.
        truth_folder: truth/, or None.
        n_pictured: frames to keep.
    Raises:
        BadInput: the drive is damaged, or its table has another number of frames.
    """
    frames = _read_frames(frames_path)
    rows = _pictured_rows(frames, n_pictured)
    pictured, images, fixes, mountings, models, image_times_s = {}, {}, [], [], {}, {}
    # An image farther away than half a revolution shows another place.
    rows_with_image = [row for row in rows if frames["image_status"].iloc[row] == "ok"]
    stamps = {row: round(frames["time_s"].iloc[row] * 1e9) for row in rows}
    row = 0
    for record in iterate_drive(mcap_path, read_topics(mcap_path)):
        match record:
            case LidarFrame():
                if row in stamps:
                    pictured[row] = record
                row += 1
            case CameraImage():
                image_times_s.setdefault(record.camera, []).append(record.time_ns * 1e-9)
                for wanted in rows_with_image:
                    of_frame, stamp = images.setdefault(wanted, {}), stamps[wanted]
                    nearest = of_frame.get(record.camera)
                    if nearest is None or abs(record.time_ns - stamp) < abs(nearest.time_ns - stamp):
                        of_frame[record.camera] = record
            case GpsFix():
                fixes.append([record.time_ns * 1e-9, record.latitude_deg, record.longitude_deg, record.altitude_m])
            case Mounting():
                mountings.append(record)
            case CameraModel():
                models[record.camera] = record
    if row != len(frames):
        raise BadInput(frames_path, f"has {len(frames)} rows for {row} frames of {mcap_path}", "import the drive again")
    truth = read_yaml(Path(truth_folder) / "truth.yaml") if truth_folder is not None else {}
    poses = read_poses_csv(Path(truth_folder) / "poses.csv")[2] if truth.get("poses") else None
    places = (truth.get("cameras") or {}) | ({CAMERA: truth["extrinsics"]} if truth.get("extrinsics") else {})
    ids = (truth.get("labels") or {}).get("ids")
    changes = None if truth_folder is None else Path(truth_folder) / "changes.csv"
    return Inspection(
        frames,
        pd.DataFrame(fixes, columns=["time_s", "latitude_deg", "longitude_deg", "altitude_m"]),
        poses,
        models,
        mountings,
        places,
        ids,
        pictured,
        images,
        (truth.get("poses") or {}).get("crs"),
        {row: load_npy(Path(truth_folder) / "labels" / f"{row:06d}.npy", "simulate_drive").astype(np.uint8) for row in pictured}
        if ids == "streetscan"
        else {},
        _read_changes(changes) if changes is not None and changes.is_file() else None,
        {name: np.array(times_s) for name, times_s in sorted(image_times_s.items())},
    )


def _read_changes(path: Path) -> pd.DataFrame | None:
    """The table of changes; None where nothing can have changed, on the day of the map."""
    changes = pd.read_csv(path)
    return changes if len(changes) else None


def project_points(points_lidar: np.ndarray, T_camera_lidar: np.ndarray, model: CameraModel) -> tuple[np.ndarray, np.ndarray]:
    """Lidar points in an image, distortion included.

    Args:
        points_lidar: (N, 3) metres.
        T_camera_lidar: (4, 4).
        model: the camera.
    Returns:
        pixels (M, 2) float64, x right and y down, of the points ahead of the camera and inside the image, and their depths (M,) in metres.
    """
    points = geometry.apply(T_camera_lidar, points_lidar)
    # Points beyond 80 degrees off the axis would be folded back into the picture by a polynomial.
    points = points[points[:, 2] > 0.1 + 0.17 * np.linalg.norm(points[:, :2], axis=1)]
    if not len(points):
        return np.empty((0, 2)), np.empty(0)
    if model.distortion_model == "kannala_brandt":
        pixels = cv2.fisheye.distortPoints((points[:, :2] / points[:, 2:])[:, None], model.K, np.asarray(model.D, float))[:, 0]
    else:
        pixels = cv2.projectPoints(points, np.zeros(3), np.zeros(3), model.K, np.asarray(model.D, float))[0][:, 0]
    inside = (pixels > -0.5).all(axis=1) & (pixels < np.array([model.width, model.height]) - 0.5).all(axis=1)
    return pixels[inside], points[inside, 2]


def fix_track_m(fixes: pd.DataFrame) -> np.ndarray:
    """East and north (n, 2) in metres of fixes relative to the first, on the sphere; good to 0.5 % for a look at a street."""
    latitude, longitude = np.radians(fixes["latitude_deg"].to_numpy()), np.radians(fixes["longitude_deg"].to_numpy())
    if not len(latitude):
        return np.empty((0, 2))
    return _EARTH_M * np.stack([(longitude - longitude[0]) * np.cos(latitude[0]), latitude - latitude[0]], axis=1)


def path_length_m(positions: np.ndarray) -> float:
    """Length of the polyline through positions (n, d); 0 for fewer than two."""
    return float(np.linalg.norm(np.diff(positions, axis=0), axis=1).sum())


def _read_frames(path: str | Path) -> pd.DataFrame:
    try:
        frames = pd.read_csv(find_file(path))
        frames[["time_s", "n_points", "status", "image_status"]]
    except (KeyError, ValueError, UnicodeDecodeError) as error:
        raise BadInput(path, f"is no table of frames ({error})", "import the drive again") from error
    if not len(frames):
        raise BadInput(path, "has no row", "import the drive again")
    return frames


def _pictured_rows(frames: pd.DataFrame, n: int) -> list[int]:
    """Rows spread evenly over whole frames that have an image; where those are too few also others that are whole, then any with points."""
    has_points, is_whole = frames["n_points"].to_numpy() > 0, (frames["status"] == "ok").to_numpy()
    has_image = (frames["image_status"] == "ok").to_numpy()
    chosen: list[int] = []
    for wanted in (has_points & is_whole & has_image, has_points & is_whole, has_points):
        candidates = np.setdiff1d(np.flatnonzero(wanted), chosen)
        places = np.linspace(0, len(candidates) - 1, n - len(chosen)).round().astype(int)
        chosen += [int(row) for row in candidates[np.unique(places)]] if len(candidates) else []
    return sorted(chosen)


def _counts(values: pd.Series) -> str:
    return ", ".join(f"{n} {value}" for value, n in values.value_counts().items())


def _date(time_s: float) -> str:
    return pd.Timestamp(time_s, unit="s", tz="UTC").strftime("%Y-%m-%d %H:%M:%S UTC") if time_s > 1e6 else f"{time_s:.3f} s (no date)"
