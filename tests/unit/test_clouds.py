import numpy as np
import pytest

from streetscan.clouds import PointCloud, check_points, concatenate
from streetscan.errors import BadInput


def cloud(n, crs="EPSG:23700", **fields):
    return PointCloud(np.arange(3.0 * n).reshape(n, 3), fields, crs)


def test_points_become_float64_rows():
    made = PointCloud(np.array([[1, 2, 3]], np.int16))
    assert made.points.dtype == np.float64
    assert len(made) == 1
    assert PointCloud(np.empty(0)).points.shape == (0, 3)


def test_fields_have_the_clouds_length():
    with pytest.raises(ValueError, match="intensity"):
        cloud(3, intensity=np.zeros(2))


@pytest.mark.parametrize("index", [np.array([False, True, True]), np.array([1, 2])])
def test_select(index):
    part = cloud(3, id=np.arange(3)).select(index)
    np.testing.assert_array_equal(part.fields["id"], [1, 2])
    np.testing.assert_array_equal(part.points[0], [3, 4, 5])
    assert part.crs == "EPSG:23700"


def test_concatenate_keeps_common_fields():
    both = concatenate(iter([cloud(2, a=np.zeros(2), b=np.zeros(2)), cloud(1, b=np.ones(1)), cloud(0, b=np.zeros(0))]))
    assert len(both) == 3
    assert list(both.fields) == ["b"]
    np.testing.assert_array_equal(both.fields["b"], [0, 0, 1])


def test_concatenate_refuses_nothing_and_different_systems():
    with pytest.raises(ValueError, match="nothing"):
        concatenate([])
    with pytest.raises(ValueError, match="reference systems"):
        concatenate([cloud(1), cloud(1, crs=None)])


def test_good_points_pass():
    check_points(np.array([[650_000.0, 240_000.0, 100.0]]), "map.laz")
    check_points(np.array([[500.0, -240.0, 100.0]]), "map.laz", stored_as_float32=True)


@pytest.mark.parametrize(
    ("points", "is_float32", "message"),
    [
        (np.empty((0, 3)), False, "holds no point"),
        ([[0, 0, 0], [np.nan, 0, 0], [0, np.inf, 0]], False, r"2 points .* \(first: point 1\)"),
        ([[0, 5_000_000, 0]], True, "step by 0.500 m"),
    ],
)
def test_bad_points_are_named(points, is_float32, message):
    with pytest.raises(BadInput, match=message) as error:
        check_points(np.asarray(points, float), "map.laz", is_float32)
    assert str(error.value).startswith("map.laz: ")
