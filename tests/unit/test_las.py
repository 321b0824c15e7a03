import laspy
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from streetscan.clouds import PointCloud
from streetscan.errors import BadInput
from streetscan.io.las import count_points, iterate_labelled_las, iterate_las, open_las_writer, read_crs, read_las, write_las


def test_a_map_comes_back(tiny_world, tiny_map):
    cloud = read_las(tiny_map)
    assert np.abs(cloud.points - tiny_world.cloud.points).max() < 1e-6
    for name, values in tiny_world.cloud.fields.items():
        np.testing.assert_array_equal(cloud.fields[name], values, err_msg=name)
    assert cloud.crs == "EPSG:23700" == read_crs(tiny_map)
    assert count_points(tiny_map) == len(cloud)


def test_the_format_is_the_promised_one(tmp_path):
    labels = np.array([0, 2, 255], np.uint8)
    fields = {"label": labels, "confidence": np.array([0.5, 0.25, 1], np.float32)}
    write_las(tmp_path / "a.laz", PointCloud(np.eye(3) + 650_000, fields, "EPSG:23700"))
    with laspy.open(tmp_path / "a.laz") as reader:
        assert str(reader.header.version) == "1.4"
        assert reader.header.point_format.id == 6
        np.testing.assert_array_equal(reader.header.scales, 0.001)
        record = reader.read()
    np.testing.assert_array_equal(record.classification, [2, 64, 1])
    np.testing.assert_array_equal(record.label, labels)
    np.testing.assert_array_equal(record.confidence, fields["confidence"])


def test_chunks_hold_the_file_in_order(tiny_world, tiny_map):
    clouds = list(iterate_las(tiny_map, 10_000))
    assert max(len(c) for c in clouds) == 10_000
    np.testing.assert_array_equal(np.concatenate([c.fields["rgb"] for c in clouds]), tiny_world.cloud.fields["rgb"])


def test_positions_alone_are_the_same_positions(tiny_map):
    whole, bare = (list(iterate_las(tiny_map, 10_000, with_fields)) for with_fields in (True, False))
    assert len(whole) == len(bare) > 1
    for a, b in zip(whole, bare, strict=True):
        np.testing.assert_array_equal(a.points, b.points)
        assert a.fields
        assert not b.fields
        assert a.crs == b.crs


@pytest.mark.parametrize("point_format", [0, 3, 6, 7])
@pytest.mark.parametrize("name", ["map.las", "map.laz"])
def test_positions_alone_are_read_from_every_format(tmp_path, point_format, name):
    las = laspy.create(point_format=point_format, file_version="1.4")
    las.header.scales = [0.001] * 3
    las.x, las.y, las.z = np.random.default_rng(0).uniform(-100, 100, (3, 50)).round(3)
    las.write(tmp_path / name)
    (cloud,) = iterate_las(tmp_path / name, with_fields=False)
    np.testing.assert_allclose(cloud.points, np.stack([las.x, las.y, las.z], axis=1))


def test_labels_come_with_their_points(tiny_world, tiny_map):
    pairs = list(iterate_labelled_las(tiny_map, tiny_map.parent / "truth" / "labels.npy"))
    assert sum(len(cloud) for cloud, _ in pairs) == len(tiny_world.labels)
    np.testing.assert_array_equal(np.concatenate([labels for _, labels in pairs]), tiny_world.labels)


def test_labels_of_another_map_are_refused(tiny_map):
    path = tiny_map.parent / "truth" / "labels.npy"
    np.save(path, np.load(path)[:-1])
    with pytest.raises(BadInput, match=r"labels\.npy"):
        next(iterate_labelled_las(tiny_map, path))


@settings(max_examples=30)
@given(st.lists(st.tuples(*[st.integers(-(10**6), 10**6)] * 3), min_size=1, max_size=20), st.sampled_from([0, 650_000, 5_250_000]))
def test_millimetres_survive_everywhere(tmp_path_factory, millimetres, northing):
    path = tmp_path_factory.mktemp("las") / "a.laz"
    points = np.array(millimetres) / 1000 + np.array([northing, northing, 0])
    write_las(path, PointCloud(points))
    assert np.abs(read_las(path).points - points).max() < 1e-6


def test_an_empty_first_part_does_not_spoil_the_file(tmp_path):
    cloud = PointCloud(np.full((2, 3), 5_250_000.123), {"label": np.array([5, 7], np.uint8)}, "EPSG:32633")
    with open_las_writer(tmp_path / "a.laz", cloud.crs) as writer:
        for part in (cloud.select(np.zeros(2, bool)), cloud, cloud.select(np.zeros(2, bool))):
            writer.write(part)
    again = read_las(tmp_path / "a.laz")
    np.testing.assert_allclose(again.points, cloud.points, atol=1e-6)
    np.testing.assert_array_equal(again.fields["label"], [5, 7])


@pytest.mark.parametrize("write", [False, True])
def test_an_empty_file_is_a_file(tmp_path, write):
    with open_las_writer(tmp_path / "a.laz", "EPSG:23700") as writer:
        if write:
            writer.write(PointCloud(np.empty((0, 3)), {"label": np.empty(0, np.uint8)}))
    assert count_points(tmp_path / "a.laz") == 0
    assert len(read_las(tmp_path / "a.laz")) == 0
    assert read_crs(tmp_path / "a.laz") == "EPSG:23700"
    with laspy.open(tmp_path / "a.laz") as reader:
        assert ("label" in reader.header.point_format.dimension_names) == write


def test_a_part_without_a_field_is_refused_and_nothing_stays(tmp_path):
    parts = [PointCloud(np.zeros((1, 3)), {"label": np.zeros(1, np.uint8)}), PointCloud(np.zeros((1, 3)))]
    with pytest.raises(ValueError, match="label"), open_las_writer(tmp_path / "a.laz") as writer:
        list(map(writer.write, parts))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("read", [read_las, count_points, read_crs])
def test_missing_and_foreign_files_are_named(tmp_path, read):
    with pytest.raises(BadInput, match="no such file"):
        read(tmp_path / "a.laz")
    for content in (b"", b"x y z\n1 2 3\n", bytes(1000)):
        (tmp_path / "a.laz").write_bytes(content)
        with pytest.raises(BadInput, match=r"a\.laz"):
            read(tmp_path / "a.laz")


@pytest.mark.parametrize("share", [0.001, 0.3, 0.7, 0.999])
def test_truncated_files_are_named(tiny_map, share):
    content = tiny_map.read_bytes()
    tiny_map.write_bytes(content[: int(share * len(content))])
    with pytest.raises(BadInput, match=r"map\.laz"):
        read_las(tiny_map)


def test_fields_of_a_real_map(shared_data):
    cloud = read_las(shared_data / "amsterdam" / "road_ground_labelled_2293_9698.laz")
    assert len(cloud) > 0
    assert "label" in cloud.fields
    assert np.abs(cloud.points[:, 1]).min() > 400_000
