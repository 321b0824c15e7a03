"""Merged frames: placement, tiles, thinning, what moves, resumption."""

from dataclasses import replace

import numpy as np
import pytest
from street_frames import PERIOD_S, pose, scan, street_boxes

from streetscan.errors import BadInput
from streetscan.geometry import invert, transform
from streetscan.io.frame_arrays import FrameArrays, open_frame_arrays_writer
from streetscan.io.las import count_points, read_las
from streetscan.registration.grid_classes import GROUND, SHORT_OBJECT, TALL_STRUCTURE, segment_frame
from streetscan.registration.merging import (
    MergeFrame,
    MergeSettings,
    SightRaster,
    choose_segment,
    leave_out,
    look_through,
    make_merge_settings,
    merge_frames,
    place_points,
)
from streetscan.registration.odometry import FramePose

SETTINGS = MergeSettings(group_frames=3, thin_m=0.0)


def posed(index, T, segment=0):
    return FramePose(index, index * PERIOD_S, "ok", segment, T)


@pytest.fixture(scope="module")
def street():
    """Eight frames of a street with parked cars, and one car that drives ahead of the recording one, away from it."""
    rng, boxes = np.random.default_rng(0), street_boxes()
    frames, poses = [], {}
    for i in range(8):
        T = pose(0.2 * i)
        x = 5 + 3.0 * i
        car = np.array([[x, -0.9, 0.25, x + 4.2, 0.9, 1.45]])
        points, _ = scan(T, np.concatenate([boxes, car]), rng, n_beams=64, n_azimuths=400)
        frames.append(MergeFrame(i, i * PERIOD_S, points, segment_frame(points, 1.8), None, np.full(len(points), 0.5)))
        poses[i] = posed(i, invert(pose(0)) @ T)
    return frames, poses


def reader(frames, asked=None):
    def read(first, last):
        if asked is not None:
            asked.append(first)
        yield from (f for f in frames if first <= f.index < last)

    return read


def read_tiles(folder):
    clouds = {path.stem: read_las(path) for path in sorted(folder.glob("*.laz"))}
    return clouds, np.concatenate([c.points for c in clouds.values()])


def test_every_point_lands_where_it_belongs(street, tmp_path):
    frames, poses = street
    T_map_segment = transform([1000, 2000, 100], [0, 0, 0.7])
    counts = merge_frames(reader(frames), poses, tmp_path / "tiles", tmp_path / "work", SETTINGS, T_map_segment, "EPSG:32632")
    tiles, points = read_tiles(tmp_path / "tiles")
    kept = [f.points[(np.hypot(*f.points[:, :2].T) <= 60) & (np.hypot(*f.points[:, :2].T) >= 2.5)] for f in frames]
    expected = np.concatenate(
        [place_points(replace(f, points=p), poses[f.index], T_map_segment) for f, p in zip(frames, kept, strict=True)]
    )
    assert counts["points_written"] == len(points) == len(expected)
    assert np.allclose(points[np.lexsort(points.round(3).T)], expected[np.lexsort(expected.round(3).T)], atol=0.0011)
    for name, cloud in tiles.items():
        corner = np.array([int(v) for v in name.split("_")]) * 50.0
        assert (cloud.points[:, :2] >= corner - 0.001).all()
        assert (cloud.points[:, :2] <= corner + 50.001).all()
        assert cloud.crs == "EPSG:32632"
    cloud = next(iter(tiles.values()))
    assert set(np.unique(cloud.fields["frame"])) <= set(range(8))
    assert {"intensity", "time_s", "grid_class", "frame", "is_moving"} <= set(cloud.fields)
    assert not (tmp_path / "work").exists()


def test_normals_turn_with_the_frames(street, tmp_path):
    frames, poses = street
    T_map_segment = transform([0, 0, 0], [0, 0, np.pi / 2])
    settings = replace(SETTINGS, normal_neighbours=12, classes=(GROUND, TALL_STRUCTURE))
    merge_frames(reader(frames[:3]), {i: poses[i] for i in range(3)}, tmp_path / "t", tmp_path / "w", settings, T_map_segment)
    clouds, _ = read_tiles(tmp_path / "t")
    normals = np.concatenate([np.stack([c.fields[f"normal_{a}"] for a in "xyz"], axis=1) for c in clouds.values()])
    labels = np.concatenate([c.fields["grid_class"] for c in clouds.values()])
    assert np.allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-3)
    assert np.median(normals[labels == GROUND, 2]) > 0.95
    # The street runs along y of the map, so its fronts look along x.
    fronts = np.abs(normals[labels == TALL_STRUCTURE])
    assert (fronts[:, 0] > 0.9).mean() > 2 * (fronts[:, 1] > 0.9).mean()


def test_thinning_keeps_one_point_per_cube(street, tmp_path):
    frames, poses = street
    merge_frames(reader(frames), poses, tmp_path / "t", tmp_path / "w", replace(SETTINGS, thin_m=0.2))
    _, points = read_tiles(tmp_path / "t")
    keys = np.floor(points / 0.2 + 1e-9)
    # Millimetre steps may move a point over a border.
    assert len(np.unique(keys, axis=0)) > 0.99 * len(points)


def test_what_moves_is_told_from_what_stands(street, tmp_path):
    frames, poses = street
    settings = replace(SETTINGS, raster_m=0.5)
    merge_frames(reader(frames), poses, tmp_path / "keep", tmp_path / "w", settings)
    merge_frames(reader(frames), poses, tmp_path / "out", tmp_path / "w", replace(settings, moving="leave_out"))
    clouds, points = read_tiles(tmp_path / "keep")
    moving = np.concatenate([c.fields["is_moving"] for c in clouds.values()])
    labels = np.concatenate([c.fields["grid_class"] for c in clouds.values()])
    z = points[:, 2] + 1.8
    body = (labels == SHORT_OBJECT) & (z > 0.3)
    # This piece of the lane was looked at after the car had left it.
    lane = body & (np.abs(points[:, 1]) < 1.1) & (points[:, 0] > 5) & (points[:, 0] < 10)
    parked = body & (np.abs(points[:, 1]) > 4) & (np.abs(points[:, 1]) < 6) & (np.abs(points[:, 0]) < 25)
    assert lane.sum() > 200
    assert moving[lane].mean() > 0.7
    assert moving[parked].mean() < 0.05
    _, left = read_tiles(tmp_path / "out")
    assert len(left) == len(points) - moving.sum()


def test_looking_through_a_place():
    labels = np.array([GROUND, GROUND, TALL_STRUCTURE], np.uint8)
    frame = MergeFrame(0, 0.0, np.array([[10.0, 0, -2.0], [0, -4, -0.3], [5, 5, -2]]), labels)
    seen = look_through(frame, 0.7)
    # 0.7 of 2 m up the ray from the ground.
    assert np.allclose(seen.points, [[6.5, 0, -1.3]])


def test_raster_counts_frames():
    raster = SightRaster(1.0)
    place, elsewhere = np.array([[0.5, 0.5, 0.7]]), np.array([[3.5, 0.5, 0.7]])
    nothing = np.empty((0, 3))
    for i in range(6):
        raster.add(place if i < 2 else nothing, elsewhere if i < 2 else np.concatenate([place, place]), np.array([[-0.5, 0.5, float(i)]]))
    assert raster.is_left(np.concatenate([place, elsewhere, [[9.0, 9, 9]]]), 3, 0.4).tolist() == [True, False, False]
    assert raster.is_left(place, 5, 0.4).tolist() == [False]
    cells, heights = raster.elevation()
    assert cells.tolist() == [[-1, 0]]
    assert heights.tolist() == [2.5]
    assert SightRaster(1.0).is_left(place, 1, 0.1).tolist() == [False]


def test_a_killed_run_repeats_no_finished_group(street, tmp_path):
    frames, poses = street
    merge_frames(reader(frames), poses, tmp_path / "whole", tmp_path / "w0", SETTINGS)

    def dies(first, last):
        if first >= 3:
            raise KeyboardInterrupt
        yield from reader(frames)(first, last)

    with pytest.raises(KeyboardInterrupt):
        merge_frames(dies, poses, tmp_path / "t", tmp_path / "w", SETTINGS)
    assert not (tmp_path / "t").exists()
    asked = []
    counts = merge_frames(reader(frames, asked), poses, tmp_path / "t", tmp_path / "w", SETTINGS)
    assert asked == [3, 6]
    assert counts["groups_reused"] == 1
    for path in (tmp_path / "whole").glob("*.laz"):
        assert np.array_equal(read_las(path).points, read_las(tmp_path / "t" / path.name).points)
    assert counts["frames"] == 8
    # Groups of other settings are not taken.
    with pytest.raises(KeyboardInterrupt):
        merge_frames(dies, poses, tmp_path / "u", tmp_path / "w", SETTINGS)
    asked.clear()
    merge_frames(reader(frames, asked), poses, tmp_path / "u", tmp_path / "w", replace(SETTINGS, max_range_m=30.0))
    assert asked == [0, 3, 6]


def test_classes_and_elevation(street, tmp_path):
    frames, poses = street
    settings = replace(SETTINGS, classes=(TALL_STRUCTURE,), thin_m=0.1)
    merge_frames(reader(frames), poses, tmp_path / "t", tmp_path / "w", settings, elevation_path=tmp_path / "e.asc")
    clouds, _ = read_tiles(tmp_path / "t")
    assert all((c.fields["grid_class"] == TALL_STRUCTURE).all() for c in clouds.values())
    lines = (tmp_path / "e.asc").read_text().splitlines()
    grid = np.loadtxt(tmp_path / "e.asc", skiprows=6)
    assert grid.shape == (int(lines[1].split()[1]), int(lines[0].split()[1]))
    assert np.median(grid[grid > -9999]) == pytest.approx(-1.8, abs=0.03)


def test_nothing_to_merge(tmp_path):
    empty = MergeFrame(0, 0.0, np.empty((0, 3), np.float32), np.empty(0, np.uint8))
    counts = merge_frames(reader([empty]), {0: posed(0, np.eye(4))}, tmp_path / "t", tmp_path / "w", elevation_path=tmp_path / "e.asc")
    assert counts["points_written"] == 0
    assert (tmp_path / "t").is_dir()
    broken = replace(empty, labels=np.zeros(3, np.uint8))
    with pytest.raises(BadInput, match="3 classes for 0 points"):
        merge_frames(reader([broken]), {0: posed(0, np.eye(4))}, tmp_path / "t", tmp_path / "w")


def test_segments_are_not_mixed():
    rows = [posed(0, np.eye(4)), posed(1, np.eye(4)), posed(5, np.eye(4), 1), FramePose(6, 0.6, "empty", 1)]
    assert list(choose_segment(rows)) == [0, 1]
    assert list(choose_segment(rows, 1)) == [5]
    for bad in (lambda: choose_segment(rows, 4), lambda: choose_segment(rows[3:])):
        with pytest.raises(BadInput):
            bad()


def test_frames_are_left_out():
    poses = {i: FramePose(i, i / 10, "ok", 0) for i in range(3, 12)}
    assert list(leave_out(poses, 5, 3)) == [3, 4, 6, 7, 9, 10]
    with pytest.raises(BadInput, match="left_out"):
        leave_out({5: poses[5]}, 5, 2)


@pytest.mark.parametrize("bad", [{"moving": "blur"}, {"tile_m": 0}, {"classes": ["x"]}, {"size": 1}])
def test_bad_settings(bad):
    with pytest.raises(BadInput):
        make_merge_settings(bad)


def test_frame_arrays(tmp_path):
    arrays = [np.arange(5, dtype=np.uint8), np.empty(0, np.uint8)]
    with open_frame_arrays_writer(tmp_path / "a.npz") as writer:
        for i, array in enumerate(arrays):
            writer.write(i, array)
    stored = FrameArrays(tmp_path / "a.npz", "segment_frames")
    assert len(stored) == 2
    assert (stored.read(0, 5) == arrays[0]).all()
    assert stored.read(1, 0).shape == (0,)
    for bad in (lambda: stored.read(0, 4), lambda: stored.read(7, 1), lambda: FrameArrays(__file__, "x"), lambda: FrameArrays("no", "x")):
        with pytest.raises(BadInput):
            bad()


def test_counts_are_of_the_files(street, tmp_path):
    frames, poses = street
    counts = merge_frames(reader(frames), poses, tmp_path / "t", tmp_path / "w", SETTINGS)
    paths = list((tmp_path / "t").glob("*.laz"))
    assert counts["tiles"] == len(paths)
    assert counts["points_written"] == sum(count_points(p) for p in paths)
