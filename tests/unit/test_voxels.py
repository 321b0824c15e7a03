import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from streetscan.errors import BadInput
from streetscan.voxels import VoxelGrid, find_sorted, pack_keys, unpack_keys, voxelize

KEYS = hnp.arrays(np.int32, st.tuples(st.integers(0, 50), st.just(3)), elements=st.integers(-(2**20), 2**20 - 1))


@given(KEYS)
def test_packed_keys_come_back(keys):
    np.testing.assert_array_equal(unpack_keys(pack_keys(keys)), keys)


@given(KEYS)
def test_packed_keys_sort_like_rows(keys):
    by_packed = keys[np.argsort(pack_keys(keys), kind="stable")]
    np.testing.assert_array_equal(by_packed, keys[np.lexsort(keys.T[::-1])])


@pytest.mark.parametrize("key", [2**20, -(2**20) - 1])
def test_keys_out_of_range_are_refused(key):
    with pytest.raises(ValueError, match="origin"):
        pack_keys(np.array([[0, key, 0]]))


def test_hand_computed_cells():
    points = np.array([[0.05, 0.05, 0.01], [0.09, 0.01, 0.03], [-0.01, 0.05, 0.05], [0.05, 0.05, -0.01]])
    grid = voxelize([points], 0.1)
    np.testing.assert_array_equal(grid.origin, [0, 0, 0])
    np.testing.assert_array_equal(grid.keys, [[-1, 0, 0], [0, 0, -1], [0, 0, 0]])
    np.testing.assert_array_equal(grid.counts, [1, 1, 2])
    np.testing.assert_allclose(grid.mean_z_m, [0.05, -0.01, 0.02])
    assert np.isnan(grid.height_m).all()
    np.testing.assert_allclose(grid.centres[2], 0.05)
    np.testing.assert_array_equal(grid.find(np.array([[0, 0, 0], [5, 5, 5], [-1, 0, 0]])), [2, -1, 0])


@given(st.integers(1, 12), st.integers(0, 2**32 - 1))
def test_chunks_do_not_matter(n_chunks, seed):
    points = np.random.default_rng(seed).uniform(-1, 1, (60, 3)) + np.array([650_000, 240_000, -30])
    whole, parts = voxelize([points], 0.25), voxelize(np.array_split(points, n_chunks), 0.25)
    for name, values in vars(whole).items():
        np.testing.assert_allclose(vars(parts)[name], values, rtol=0, atol=1e-9, err_msg=name)


def test_every_point_is_counted_once_in_the_voxel_that_holds_it(tiny_world):
    points = tiny_world.cloud.points
    grid = voxelize(np.array_split(points, 23), 0.1)
    rows = grid.find(grid.keys_of(points))
    assert (rows >= 0).all()
    np.testing.assert_array_equal(np.bincount(rows, minlength=len(grid)), grid.counts)
    assert (np.abs(points - grid.centres[rows]) <= 0.05 + 1e-6).all()
    sums = np.bincount(rows, points[:, 2])
    np.testing.assert_allclose(grid.mean_z_m, sums / grid.counts, atol=1e-6)


@pytest.mark.parametrize("n_chunks", [1, 2, 5])
def test_seconds_between_the_points_of_a_voxel(n_chunks):
    points = np.array(
        [[0.05, 0.05, 0.05, 7.0], [0.15, 0.05, 0.05, 3.0], [0.06, 0.05, 0.05, 9.5], [0.15, 0.05, 0.05, 3.0], [0.07, 0.05, 0.05, 8.0]]
    )
    grid = voxelize(np.array_split(points, n_chunks), 0.1)
    np.testing.assert_array_equal(grid.spread_s, [2.5, 0.0])


def test_times_that_are_all_alike_or_missing_are_unknown():
    points = np.random.default_rng(0).uniform(0, 1, (50, 3))
    assert np.isnan(voxelize([points], 0.1).spread_s).all()
    assert np.isnan(voxelize([np.column_stack([points, np.full(50, 4.0)])], 0.1).spread_s).all()


def test_one_point_and_empty_chunks():
    grid = voxelize([np.empty((0, 3)), np.array([[5.0, -5.0, 3.0]]), np.empty((0, 3))], 1.0)
    assert len(grid) == 1
    assert grid.mean_z_m[0] == 3.0


@pytest.mark.parametrize("chunks", [[], [np.empty((0, 3))]])
def test_no_point_is_refused(chunks):
    with pytest.raises(BadInput, match="no point"):
        voxelize(chunks, 0.1)


@pytest.mark.parametrize("size_m", [0.0, -0.1, np.nan])
def test_a_voxel_has_an_edge(size_m):
    with pytest.raises(BadInput, match="size_m"):
        voxelize([np.zeros((1, 3))], size_m)


def test_select_keeps_the_order(tiny_world):
    grid = voxelize([tiny_world.cloud.points], 0.5)
    part = grid.select(grid.keys[:, 2] % 2 == 0)
    np.testing.assert_array_equal(part.find(part.keys), np.arange(len(part)))


def test_find_in_nothing():
    np.testing.assert_array_equal(find_sorted(np.empty(0, np.int64), np.array([1, 2])), [-1, -1])


def test_saved_grid_comes_back(tmp_path):
    grid = voxelize([np.random.default_rng(0).normal(size=(100, 3))], 0.3)
    grid.save(tmp_path / "deep" / "voxels.npz")
    again = VoxelGrid.load(tmp_path / "deep" / "voxels.npz")
    for name, values in vars(grid).items():
        np.testing.assert_array_equal(vars(again)[name], values)
        assert np.asarray(vars(again)[name]).dtype == np.asarray(values).dtype
    assert [p.name for p in (tmp_path / "deep").iterdir()] == ["voxels.npz"]


def test_other_files_are_refused(tmp_path):
    path = tmp_path / "voxels.npz"
    voxelize([np.zeros((1, 3))], 0.3).save(path)
    whole = path.read_bytes()
    np.savez(tmp_path / "other.npz", a=1)
    np.save(tmp_path / "array.npy", np.zeros(3))
    contents = [b"", b"text", whole[:100], whole[:-30], (tmp_path / "other.npz").read_bytes(), (tmp_path / "array.npy").read_bytes()]
    for content in contents:
        path.write_bytes(content)
        with pytest.raises(BadInput, match="voxelize_map"):
            VoxelGrid.load(path)
    with pytest.raises(BadInput, match="voxelize_map"):
        VoxelGrid.load(tmp_path / "missing.npz")


def test_whole_millimetres_on_a_face_belong_to_the_upper_voxel():
    steps = np.arange(-5000, 5000)
    exact = np.repeat(650_000 + steps[:, None] / 10, 3, axis=1)
    for points in (exact, np.nextafter(exact, 0), np.nextafter(exact, 1e9)):
        grid = voxelize([exact[:1], points], 0.1)
        np.testing.assert_array_equal(np.diff(grid.keys_of(points), axis=0), 1)
