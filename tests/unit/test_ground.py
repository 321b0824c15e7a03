import lzma

import numpy as np
import pytest

from streetscan.segmentation import ground
from streetscan.segmentation.ground import add_heights, estimate_ground, fill_holes
from streetscan.voxels import voxelize

ORIGIN = np.array([650_000.0, 240_000.0, 0.0])
SETTINGS = {"cell_m": 0.5, "max_object_m": 20.0, "max_slope": 0.15, "step_m": 0.2, "min_patch_m2": 4.0}


def plane(slope_x, slope_y, size_x=60.0, size_y=30.0, step=0.1, seed=0):
    """Points of a noisy plane at the coordinates of a national grid, and the plane's height."""
    rng = np.random.default_rng(seed)
    x, y = (a.ravel() for a in np.meshgrid(np.arange(0, size_x, step), np.arange(0, size_y, step)))
    z = slope_x * x + slope_y * y + rng.normal(0, 0.01, len(x))
    return np.stack(
        [x + 650_000, y + 240_000, z + 100], axis=1
    ), lambda p: slope_x * (p[:, 0] - 650_000) + slope_y * (p[:, 1] - 240_000) + 100


def box(x, y, bottom, top, length=4.2, width=1.8, step=0.1):
    """Points on the surface of a box at (x, y) of the local frame; z counts from 0."""
    a, b, c = (np.arange(0, n + step / 2, step) for n in (length, width, top - bottom))
    long_side = np.stack(np.meshgrid(a, [0, width], c), axis=-1).reshape(-1, 3)
    short_side = np.stack(np.meshgrid([0, length], b, c), axis=-1).reshape(-1, 3)
    roof = np.stack(np.meshgrid(a, b, [top - bottom]), axis=-1).reshape(-1, 3)
    return np.concatenate([long_side, short_side, roof]) + ORIGIN + np.array([x - length / 2, y - width / 2, bottom])


def hide(points, x, y, length, width):
    inside = (np.abs(points[:, 0] - 650_000 - x) < length / 2) & (np.abs(points[:, 1] - 240_000 - y) < width / 2)
    return points[~inside]


def on_plane(points, height):
    return points + np.c_[np.zeros((len(points), 2)), height(points)]


@pytest.mark.parametrize("slopes", [(0.0, 0.0), (0.08, 0.0), (-0.1, 0.05), (0.2, -0.2)])
def test_bare_slopes_up_to_the_border(slopes):
    points, height = plane(*slopes)
    raster = estimate_ground(points, **SETTINGS)
    error = raster.heights_at(points) - height(points)
    # Half a cell beyond the outermost centres the raster is level.
    assert np.abs(error).max() < 0.06
    assert raster.is_measured.mean() > 0.95


@pytest.mark.parametrize("slope", [0.0, 0.1])
def test_parked_cars_and_a_tram_hide_the_ground(slope):
    points, height = plane(slope, 0.02)
    things = []
    for x in np.arange(8, 55, 5.2):
        points = hide(points, x, 8, 4.2, 1.8)
        things.append(on_plane(box(x, 8, 0.25, 1.5), height))
    points = hide(points, 30, 15, 35, 2.6)
    things.append(on_plane(box(30, 15, 0.35, 3.4, 35, 2.6), height))
    things = np.concatenate(things)
    raster = estimate_ground(np.concatenate([points, things]), **SETTINGS)
    error = raster.heights_at(things) - height(things)
    assert np.abs(error).max() < 0.08


def test_crowns_and_facades_at_the_border_of_the_map():
    points, height = plane(0.08, 0.0)
    rng = np.random.default_rng(1)
    crowns = []
    for x, y in ((10, 0), (30, 30), (60, 15)):
        points = hide(points, x, y, 9, 9)
        crown = rng.normal(size=(6000, 3))
        crown *= 4 / np.linalg.norm(crown, axis=1)[:, None]
        crowns.append(crown + ORIGIN + np.array([x, y, 6]))
    wall = np.stack(np.meshgrid(np.arange(0, 60, 0.1), [30.2], np.arange(0, 12, 0.1)), axis=-1).reshape(-1, 3) + ORIGIN
    # Depth behind the windows of the upper floors, 5 m from any ground.
    room = rng.uniform([0, 31, 2.5], [60, 35, 10], (3000, 3)) + ORIGIN
    things = on_plane(np.concatenate([*crowns, wall, room]), height)
    raster = estimate_ground(np.concatenate([points, things]), **SETTINGS)
    error = raster.heights_at(things) - height(things)
    assert np.abs(error).max() < 0.15


def test_stray_points_below_the_ground():
    points, height = plane(0.06, 0.0)
    rng = np.random.default_rng(2)
    single = np.c_[rng.uniform(0, 60, 150) + 650_000, rng.uniform(0, 30, 150) + 240_000, rng.uniform(-3, -0.35, 150)]
    # A mirror image in a shop window: a patch of 1.5 x 1.5 m, 2 m too deep.
    patch = rng.uniform([20, 10, -2.05], [21.5, 11.5, -1.95], (300, 3)) + ORIGIN
    stray = on_plane(np.concatenate([single, patch]), height)
    raster = estimate_ground(np.concatenate([points, stray]), **SETTINGS)
    error = raster.heights_at(points) - height(points)
    assert np.abs(error).max() < 0.1


def test_a_kerb_keeps_its_step():
    points, height = plane(0.05, 0.0)
    is_sidewalk = points[:, 1] > 240_020
    points[is_sidewalk, 2] += 0.15
    raster = estimate_ground(points, **SETTINGS)
    error = raster.heights_at(points) - height(points) - 0.15 * is_sidewalk
    far = np.abs(points[:, 1] - 240_020) > 0.5
    assert np.abs(error[far]).max() < 0.05
    assert np.abs(error).max() < 0.16


def test_a_terrace_and_its_bank_are_ground():
    points, _ = plane(0.0, 0.0)
    y = points[:, 1] - 240_000
    points[:, 2] += 1.5 * np.clip((y - 12) / 4, 0, 1)
    raster = estimate_ground(points, **SETTINGS)
    assert np.abs(raster.heights_at(points) - points[:, 2]).max() < 0.12


def test_below_a_bridge_the_street_is_the_ground():
    points, _ = plane(0.0, 0.0)
    deck = box(30, 15, 5.0, 5.6, length=12, width=30)
    deck[:, 2] += 100
    raster = estimate_ground(np.concatenate([points, deck]), **SETTINGS)
    assert np.abs(raster.heights_at(deck) - 100).max() < 0.05


def test_heights_above_ground_of_the_tiny_street(tiny_world):
    grid = voxelize([tiny_world.cloud.points], 0.1)
    heights = add_heights(grid, **SETTINGS)
    assert heights.height_m.dtype == np.float32
    error = heights.height_m - (grid.mean_z_m - tiny_world.ground_z_m(grid.centres))
    assert np.median(np.abs(error)) < 0.01
    assert np.percentile(np.abs(error), 95) < 0.05
    # The kerb's step is the largest error there can be.
    assert np.abs(error).max() < 0.15


def test_blocks_agree_with_one_raster(tiny_world, monkeypatch):
    grid = voxelize([tiny_world.cloud.points], 0.1)
    whole = add_heights(grid, **SETTINGS).height_m
    monkeypatch.setattr(ground, "_BLOCK_M", 9.0)
    monkeypatch.setattr(ground, "_HALO_M", 8.0)
    blocks = add_heights(grid, **SETTINGS).height_m
    assert np.isfinite(blocks).all()
    assert np.percentile(np.abs(blocks - whole), 99) < 0.05


@pytest.mark.parametrize(
    "points",
    [[[650_000.0, 240_000.0, 99.0]], [[-1.0, -2.0, -3.0]] * 5, np.c_[np.arange(-20.0, 20), np.zeros(40), 0.1 * np.arange(-20.0, 20)]],
    ids=["one point", "one place", "one line"],
)
def test_few_points(points):
    points = np.asarray(points)
    raster = estimate_ground(points, **SETTINGS)
    assert np.abs(raster.heights_at(points) - points[:, 2]).max() < 0.12
    assert np.isfinite(raster.heights_m).all()


def test_a_map_without_voxels_has_no_heights():
    grid = voxelize([np.zeros((1, 3))], 0.1).select(np.array([False]))
    assert len(add_heights(grid, **SETTINGS)) == 0


def test_holes_are_filled_between_their_rims():
    rows = np.arange(37.0)[:, None] * np.ones(23)
    values = rows.copy()
    values[10:20, 5:15] = np.nan
    filled = fill_holes(values)
    known = ~np.isnan(values)
    np.testing.assert_array_equal(filled[known], values[known])
    assert np.abs(filled - rows).max() < 3
    np.testing.assert_array_equal(fill_holes(np.full((3, 2), np.nan)), np.zeros((3, 2)))
    np.testing.assert_array_equal(fill_holes(np.array([[np.nan, 2.0]])), [[2.0, 2.0]])


@pytest.mark.parametrize("name", ["ac", "ah", "ao"])
def test_hand_labelled_ground_of_oakland(shared_data, name):
    with lzma.open(shared_data / "oakland" / f"oakland_part2_{name}.xyz_label_conf.xz", "rt") as stream:
        table = np.loadtxt(stream, comments="#")
    points, ids = table[:, :3], table[:, 3].astype(int)
    raster = estimate_ground(points, **SETTINGS)
    is_ground = (ids >= 1200) & (ids <= 1206)
    error = np.abs(points[:, 2] - raster.heights_at(points))[is_ground]
    assert np.median(error) < 0.01
    assert np.percentile(error, 95) < 0.06
