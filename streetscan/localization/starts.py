"""Where the search for each frame begins, and how the vehicle moves meanwhile, from GPS.

Source: Nagy (2020), 3.3.3 (N-102, N-113, N-115): GPS gives the position within metres and about the driving direction.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.stats import qmc

from streetscan import geodesy
from streetscan.errors import BadInput
from streetscan.frames import GpsFix, Mounting
from streetscan.io.mcap import GPS, TF, iterate_drive, iterate_lidar
from streetscan.io.trajectories import read_poses_csv
from streetscan.localization.voting import Window
from streetscan.registration.merging import choose_segment
from streetscan.registration.pose_tables import read_pose_table
from streetscan.sweeps import velocity_between

# ASSUME: a position is good for a start for so long after a fix; in it a car in a street moves the width of the search window.
_MAX_GAP_S = 1.5
# Motion is the line through the fixes this long before and after.
_MOTION_S = 1.5
# A vehicle that moved less within that time does not show its heading.
_MIN_WAY_M = 3.0


@dataclass
class Starts:
    """Start of each of F frames.

    Attributes:
        xy_m: (F, 2) float64 position of the lidar, axes of `map`; NaN where there is none.
        yaw_rad: (F,) heading, counter-clockwise from easting; NaN where not known.
        speed_mps: (F,) forwards; NaN where not known.
        turn_rate_radps: (F,) counter-clockwise; NaN where not known.
    """

    xy_m: np.ndarray
    yaw_rad: np.ndarray
    speed_mps: np.ndarray
    turn_rate_radps: np.ndarray


def read_poses_on_map(path: str | Path) -> tuple[np.ndarray, np.ndarray]:
    """Stamps (F,) and poses T_map_lidar (F, 4, 4) of a drive's frames by number, NaN where they are not known.

    Args:
        path: folder truth/ of the drive; or, for a map merged from the drive's own frames, poses.csv of register_frames, of which the
            segment with most frames is the map.
    Raises:
        BadInput: the table is something else.
    """
    path = Path(path)
    if path.is_dir():
        return read_poses_csv(path / "poses.csv")[1:]
    rows = read_pose_table(path)
    n = max((row.index for row in rows), default=-1) + 1
    times_s, poses = np.full(n, np.nan), np.full((n, 4, 4), np.nan)
    for index, row in choose_segment(rows).items():
        times_s[index], poses[index] = row.time_s, row.T_segment_lidar
    return times_s, poses


def read_starts(drive_path: str | Path, crs: str | None, where: object, truth_path: str | Path | None, mode: str, seed: int) -> Starts:
    """Starts of a drive's frames, as its localizer's mode wants them.

    Args:
        drive_path: drive.mcap.
        crs, where: of the map, and the map, named in errors.
        truth_path: of `read_poses_on_map`, for mode `even`.
        mode: of `streetscan.localization.drive.MODES`.
        seed: of the spread of mode `even`.
    Raises:
        BadInput: mode `even` without truth; any other mode, a drive with GPS and a map without a reference system.
    """
    times_s = np.array([frame.time_ns / 1e9 for frame in iterate_lidar(drive_path)])
    records = list(iterate_drive(drive_path, (GPS, TF)))
    fixes, mountings = ([r for r in records if isinstance(r, kind)] for kind in (GpsFix, Mounting))
    if mode != "even":
        return starts_of_fixes(fixes, times_s, crs, mountings, where)
    if truth_path is None:
        raise BadInput("localizers.start", "even starts of a drive without true poses", "choose gps, tracking or none")
    spread = even_starts(*read_poses_on_map(truth_path), Window(), seed)
    # Motion is no part of the error that is spread: GPS tells it where it has a place on the map.
    measured = starts_of_fixes(fixes if crs else [], times_s, crs, mountings, where)
    n = len(spread.xy_m)
    measured.xy_m[:n], measured.yaw_rad[:n] = spread.xy_m[: len(times_s)], spread.yaw_rad[: len(times_s)]
    for name in ("speed_mps", "turn_rate_radps"):
        own, other = getattr(measured, name)[:n], getattr(spread, name)[: len(times_s)]
        own[np.isnan(own)] = other[np.isnan(own)]
    return measured


def starts_of_fixes(
    fixes: Sequence[GpsFix], times_s: np.ndarray, crs: str | None, mountings: Sequence[Mounting] = (), where: object = "the map"
) -> Starts:
    """Starts from GPS.

    Args:
        fixes: of the drive, in any order; those without finite coordinates are left out.
        times_s: (F,) stamps of the frames.
        crs: of the map.
        mountings: T_vehicle_gps and T_vehicle_lidar give the lidar's place beside the antenna, where both are known.
        where: the map, named in errors.
    Raises:
        BadInput: there are fixes and the map has no reference system.
    """
    n = len(times_s)
    nothing = Starts(np.full((n, 2), np.nan), np.full(n, np.nan), np.full(n, np.nan), np.full(n, np.nan))
    fixes = [f for f in fixes if np.isfinite([f.latitude_deg, f.longitude_deg]).all()]
    if not fixes:
        return nothing
    if crs is None:
        raise BadInput(where, "has no reference system, so GPS positions have no place on it", "give crs in the data set's file")
    fixes = sorted(fixes, key=lambda f: f.time_ns)
    first_ns = fixes[0].time_ns
    at_s = np.array([(f.time_ns - first_ns) / 1e9 for f in fixes])
    frame_s = np.asarray(times_s, np.float64) - first_ns / 1e9
    latitude, longitude = (np.array([getattr(f, name) for f in fixes]) for name in ("latitude_deg", "longitude_deg"))
    xy = geodesy.project(latitude, longitude, crs)
    if not np.isfinite(xy).all():
        raise BadInput(where, f"GPS positions lie outside the area of {crs}", "check the reference system of the map")
    headings = np.array([np.nan if f.heading_rad is None else f.heading_rad for f in fixes])
    yaws = np.pi / 2 - headings + geodesy.grid_turn(latitude, longitude, crs)
    lever = _lever(mountings)
    for i, t in enumerate(frame_s):
        _fill(nothing, i, t, at_s, xy, yaws)
        if np.isfinite(nothing.yaw_rad[i]):
            c, s = np.cos(nothing.yaw_rad[i]), np.sin(nothing.yaw_rad[i])
            nothing.xy_m[i] += (c * lever[0] - s * lever[1], s * lever[0] + c * lever[1])
    return nothing


def _fill(starts: Starts, i: int, t: float, at_s: np.ndarray, xy: np.ndarray, yaws: np.ndarray) -> None:
    """Position, heading and motion at a moment, from the fixes around it."""
    nearest = int(np.argmin(np.abs(at_s - t)))
    near = np.flatnonzero(np.abs(at_s - t) <= _MOTION_S)
    velocity = None
    if len(near) >= 3 and np.ptp(at_s[near]) > 0.5 * _MOTION_S:
        velocity = np.polyfit(at_s[near] - t, xy[near] - xy[nearest], 1)[0]
        way_m = np.linalg.norm(velocity) * np.ptp(at_s[near])
    if abs(at_s[nearest] - t) <= _MAX_GAP_S:
        inside = at_s[0] <= t <= at_s[-1]
        starts.xy_m[i] = [np.interp(t, at_s, xy[:, k]) for k in range(2)] if inside else xy[nearest]
    known = near[np.isfinite(yaws[near])]
    if len(known):
        starts.yaw_rad[i] = np.angle(np.exp(1j * yaws[known]).mean())
        if len(known) >= 3 and np.ptp(at_s[known]) > 0.5 * _MOTION_S:
            starts.turn_rate_radps[i] = np.polyfit(at_s[known], np.unwrap(yaws[known]), 1)[0]
    elif velocity is not None and way_m > _MIN_WAY_M:
        starts.yaw_rad[i] = np.arctan2(velocity[1], velocity[0])
    if velocity is not None:
        forward = np.array([np.cos(starts.yaw_rad[i]), np.sin(starts.yaw_rad[i])])
        starts.speed_mps[i] = velocity @ forward


def _lever(mountings: Sequence[Mounting]) -> np.ndarray:
    """(2,) from the antenna to the lidar, axes of the vehicle; 0 where a mounting is missing."""
    places = {m.child: m.T_parent_child[:2, 3] for m in mountings if m.parent == "vehicle"}
    return places["lidar"] - places["gps"] if {"lidar", "gps"} <= set(places) else np.zeros(2)


def even_starts(times_s: np.ndarray, poses: np.ndarray, window: Window, seed: int) -> Starts:
    """Starts spread evenly over the search window around true poses: the second set of starts of the evaluation.

    Args:
        times_s: (F,) stamps.
        poses: (F, 4, 4) true T_map_lidar, NaN where unknown; from one to the next they tell the motion, too.
        window: seen from the starts, in their own axes, the true poses lie all over it.
        seed: of the spread (scrambled Halton).
    """
    units = 2 * qmc.Halton(3, rng=np.random.default_rng(seed)).random(len(poses)) - 1
    # A cell's width inside, for the truth on the very border is in no cell.
    turn = np.radians(max(window.turn_deg - 2 * window.turn_step_deg, 0)) * units[:, 2]
    yaw = np.arctan2(poses[:, 1, 0], poses[:, 0, 0]) + turn
    ahead, left = (units[:, :2] * (window.shift_m - 2 * window.step_m)).T
    xy = poses[:, :2, 3] - np.c_[np.cos(yaw) * ahead - np.sin(yaw) * left, np.sin(yaw) * ahead + np.cos(yaw) * left]
    starts = Starts(xy, yaw, np.full(len(poses), np.nan), np.full(len(poses), np.nan))
    for i in range(1, len(poses)):
        if np.isfinite(poses[i - 1 : i + 1]).all():
            velocity, turn = velocity_between(poses[i - 1], poses[i], times_s[i] - times_s[i - 1])
            starts.speed_mps[i], starts.turn_rate_radps[i] = velocity[0], turn[2]
    return starts
