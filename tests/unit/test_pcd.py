"""PCD in its three encodings, written by its library, comes back; damaged files are named."""

import numpy as np
import pypcd4
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from streetscan.errors import BadInput
from streetscan.io.pcd import read_pcd

FIELDS = ("x", "y", "z", "intensity", "label")
TYPES = (np.float64, np.float64, np.float64, np.float32, np.uint32)


def write_pcd(path, points, intensity, label, encoding, types=TYPES):
    columns = [np.asarray(c, t) for c, t in zip((*points.T, intensity, label), types, strict=True)]
    pypcd4.PointCloud.from_points(columns, FIELDS, types).save(path, encoding)
    return path


@pytest.mark.parametrize("encoding", [pypcd4.Encoding.ASCII, pypcd4.Encoding.BINARY, pypcd4.Encoding.BINARY_COMPRESSED])
@settings(max_examples=20, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data(), n=st.integers(1, 20))
def test_fields_survive(tmp_path, encoding, data, n):
    # The library writes ASCII with 10 decimals.
    points = np.round(data.draw(arrays(np.float64, (n, 3), elements=st.floats(-6e6, 6e6))), 3)
    intensity = data.draw(arrays(np.float32, n, elements=st.integers(0, 1000)))
    label = data.draw(arrays(np.uint32, n, elements=st.integers(0, 2**32 - 1)))
    cloud = read_pcd(write_pcd(tmp_path / "a.pcd", points, intensity, label, encoding))
    np.testing.assert_allclose(cloud.points, points, rtol=0, atol=1e-9)
    np.testing.assert_array_equal(cloud.fields["intensity"], intensity)
    np.testing.assert_array_equal(cloud.fields["label"], label)
    assert cloud.fields["label"].dtype == np.uint32


@pytest.mark.parametrize("encoding", [pypcd4.Encoding.ASCII, pypcd4.Encoding.BINARY, pypcd4.Encoding.BINARY_COMPRESSED])
def test_truncated_anywhere(tmp_path, encoding):
    rng = np.random.default_rng(0)
    path = write_pcd(tmp_path / "a.pcd", rng.random((30, 3)), rng.random(30), np.arange(30), encoding)
    data = path.read_bytes()
    for length in range(0, len(data) - 4, 11):
        cut = tmp_path / "cut.pcd"
        cut.write_bytes(data[:length])
        with pytest.raises(BadInput, match=r"cut\.pcd"):
            read_pcd(cut)


def test_missing_axis_bad_coordinates_and_no_point(tmp_path):
    no_z = pypcd4.PointCloud.from_points([np.zeros(2), np.zeros(2)], ("x", "y"), (np.float64, np.float64))
    no_z.save(tmp_path / "a.pcd")
    with pytest.raises(BadInput, match=r"no field 'z' \(it has x, y\)"):
        read_pcd(tmp_path / "a.pcd")
    points = np.array([[1.0, 2, 3], [np.nan, 0, 0]])
    with pytest.raises(BadInput, match="NaN or infinite"):
        read_pcd(write_pcd(tmp_path / "a.pcd", points, [0, 0], [0, 0], pypcd4.Encoding.BINARY))
    with pytest.raises(BadInput, match="holds no point"):
        read_pcd(write_pcd(tmp_path / "a.pcd", np.empty((0, 3)), [], [], pypcd4.Encoding.BINARY))


def test_utm_in_32_bits_is_refused(tmp_path):
    types = (np.float32, np.float32, np.float32, np.float32, np.uint32)
    path = write_pcd(tmp_path / "a.pcd", np.array([[650_000, 5_260_000, 100]]), [0], [0], pypcd4.Encoding.BINARY, types)
    with pytest.raises(BadInput, match="32-bit floats"):
        read_pcd(path)


def test_missing_and_foreign_files_are_named(tmp_path):
    with pytest.raises(BadInput, match=r"no\.pcd: no such file"):
        read_pcd(tmp_path / "no.pcd")
    (tmp_path / "a.pcd").write_bytes(bytes(range(256)))
    with pytest.raises(BadInput, match="not a complete PCD file"):
        read_pcd(tmp_path / "a.pcd")


def test_a_real_file(shared_data):
    paths = sorted((shared_data / "ros2bag_velodyne_nebula").rglob("*.pcd"))
    assert paths
    for path in paths:
        assert len(read_pcd(path)) > 1000


@pytest.mark.parametrize("dtype", [np.float32, np.uint32])
def test_packed_colours_are_taken_apart(tmp_path, dtype):
    packed = np.array([0x00FF8001, 0x0012_3456], np.uint32)
    columns = [np.zeros(2), np.arange(2.0), np.zeros(2), packed.view(dtype)]
    types = (np.float64, np.float64, np.float64, dtype)
    pypcd4.PointCloud.from_points(columns, ("x", "y", "z", "rgb"), types).save(tmp_path / "a.pcd", pypcd4.Encoding.BINARY)
    fields = read_pcd(tmp_path / "a.pcd").fields
    np.testing.assert_array_equal(np.stack([fields[c] for c in ("red", "green", "blue")], axis=1), [[255, 128, 1], [0x12, 0x34, 0x56]])
