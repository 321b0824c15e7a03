import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from streetscan.errors import BadInput
from streetscan.frames import BadRecord
from streetscan.io.range_images import read_layout, read_range_image

CONFIG = "# multiplier columns rows start stop pitches\n500 4 2 180 -180 -10 20\n"


@pytest.fixture
def layout(tmp_path):
    (tmp_path / "config.txt").write_text(CONFIG)
    return read_layout(tmp_path / "config.txt")


def test_azimuths_are_those_of_the_middles_of_columns(layout):
    np.testing.assert_allclose(np.degrees(layout.azimuths_rad), [135, 45, -45, -135])
    # Pitches count downwards in the file.
    np.testing.assert_allclose(np.degrees(layout.elevations_rad), [10, -20])


def test_pixels_become_points(tmp_path, layout):
    image = np.zeros((2, 4), np.uint16)
    image[0, 1], image[1, 3] = 5000, 1000
    cv2.imwrite(str(tmp_path / "0.png"), image)
    points, ring, azimuths, covered = read_range_image(tmp_path / "0.png", layout)
    c10, c20, h = np.cos(np.radians(10)), np.cos(np.radians(20)), np.sqrt(0.5)
    expected = [[10 * c10 * h, 10 * c10 * h, 10 * np.sin(np.radians(10))], [-2 * c20 * h, -2 * c20 * h, -2 * np.sin(np.radians(20))]]
    np.testing.assert_allclose(points, expected, rtol=1e-6)
    assert ring.tolist() == [0, 1]
    assert covered == 0.5
    np.testing.assert_allclose(azimuths, np.arctan2(points[:, 1], points[:, 0]), rtol=1e-6)


def test_two_pitches_are_the_borders_of_many_rows(tmp_path):
    (tmp_path / "config.txt").write_text("500 4 10 180 -180 0 10\n")
    np.testing.assert_allclose(np.degrees(read_layout(tmp_path / "config.txt").elevations_rad), -np.arange(0.5, 10))


@pytest.mark.parametrize(
    "text", ["", "# only\n", "500 4 3 180 -180 1 2 3 4\n", "a b c d e\n", "500 4 2\n", "0 4 2 180 -180 1 2\n", "500 -4 2 180 -180 1 2\n"]
)
def test_bad_layouts(tmp_path, text):
    (tmp_path / "config.txt").write_text(text)
    with pytest.raises(BadInput):
        read_layout(tmp_path / "config.txt")


@pytest.mark.parametrize("image", [np.zeros((2, 5), np.uint16), np.zeros((2, 4), np.uint8), np.zeros((2, 4, 3), np.uint16)])
def test_pictures_of_another_kind(tmp_path, layout, image):
    cv2.imwrite(str(tmp_path / "0.png"), image)
    with pytest.raises(BadRecord):
        read_range_image(tmp_path / "0.png", layout)


def test_an_image_without_return_is_no_point(tmp_path, layout):
    cv2.imwrite(str(tmp_path / "0.png"), np.zeros((2, 4), np.uint16))
    assert len(read_range_image(tmp_path / "0.png", layout)[0]) == 0


@settings(deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_damaged_pictures(tmp_path, layout, data):
    good = bytearray(cv2.imencode(".png", np.arange(8, dtype=np.uint16).reshape(2, 4))[1].tobytes())
    for _ in range(data.draw(st.integers(0, 5))):
        good[data.draw(st.integers(0, len(good) - 1))] = data.draw(st.integers(0, 255))
    (tmp_path / "0.png").write_bytes(good[: data.draw(st.integers(0, len(good)))])
    try:
        points, *_ = read_range_image(tmp_path / "0.png", layout)
    except BadRecord as error:
        assert error.status == "unreadable"  # noqa: PT017
    else:
        assert points.shape[1] == 3
