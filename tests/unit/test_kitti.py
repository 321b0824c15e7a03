import lzma

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from toy_recordings import CAM_TO_CAM, VELO_TO_CAM, revolution

from streetscan import geometry
from streetscan.errors import BadInput
from streetscan.frames import BadRecord
from streetscan.io import kitti


def test_a_scan_is_what_numpy_reads(tmp_path):
    points, intensity, _ = revolution()
    np.c_[points, intensity].astype(np.float32).tofile(tmp_path / "0.bin")
    (tmp_path / "0.bin.xz").write_bytes(lzma.compress((tmp_path / "0.bin").read_bytes()))
    for name in ("0.bin", "0.bin.xz"):
        got, reflectance = kitti.read_scan(tmp_path / name)
        np.testing.assert_array_equal(got, points)
        np.testing.assert_array_equal(reflectance, intensity)
    assert kitti.scan_bytes(points, intensity) == (tmp_path / "0.bin").read_bytes()


@pytest.mark.parametrize(("n_bytes", "status"), [(17, "truncated"), (15, "truncated"), (4, "truncated"), (3, "truncated")])
def test_a_scan_cut_within_a_point(tmp_path, n_bytes, status):
    (tmp_path / "0.bin").write_bytes(b"\0" * n_bytes)
    with pytest.raises(BadRecord) as caught:
        kitti.read_scan(tmp_path / "0.bin")
    assert caught.value.status == status


def test_an_empty_scan_holds_no_point(tmp_path):
    (tmp_path / "0.bin").write_bytes(b"")
    assert len(kitti.read_scan(tmp_path / "0.bin")[0]) == 0


def test_a_broken_xz_is_unreadable(tmp_path):
    (tmp_path / "0.bin.xz").write_bytes(lzma.compress(b"\0" * 64)[:-9])
    with pytest.raises(BadRecord) as caught:
        kitti.read_scan(tmp_path / "0.bin.xz")
    assert caught.value.status == "unreadable"


def test_without_intensity_the_column_is_unknown():
    scan = np.frombuffer(kitti.scan_bytes(np.zeros((2, 3)), None), np.float32).reshape(-1, 4)
    assert np.isnan(scan[:, 3]).all()


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("2011-09-26 13:02:25.964389445\n", [1_317_042_145_964_389_445]),
        ("0.000000e+00\n1.036224e-01\n", [0, 103_622_400]),
        ("1317042145.123456789\n", [1_317_042_145_123_456_789]),
        ("frame,unix_time\n0,10.5\n1,10.625\n", [10_500_000_000, 10_625_000_000]),
        ("time_s,lat_deg\n1.5,2\n", [1_500_000_000]),
        ("2011-09-26 13:02:25\n", [1_317_042_145_000_000_000]),
    ],
)
def test_times_are_exact_to_the_nanosecond(tmp_path, text, expected):
    (tmp_path / "times.txt").write_text(text)
    assert kitti.read_times(tmp_path / "times.txt").tolist() == expected


@pytest.mark.parametrize(
    "text",
    [
        "",
        "\n",
        "abc\n",
        "1.0\nx\n",
        "a,b\n1,2\n",
        "2011-13-26 13:02:25.9\n",
        "frame,time_s\n1,2\n",
        "1e300\n",
        "nan\n",
        "-1.5\n",
        "-0.1e1\n",
    ],
)
def test_what_is_no_list_of_times(tmp_path, text):
    (tmp_path / "times.txt").write_text(text)
    with pytest.raises(BadInput, match=r"times\.txt"):
        kitti.read_times(tmp_path / "times.txt")


def test_the_camera_sits_where_the_projection_says(tmp_path):
    """K (R_rect T_velo_cam p) + P[:, 3] must be the pixel of P_rect R_rect T_velo_cam p."""
    rotation = geometry.transform(rpy_rad=[0.01, -0.02, 0.03])[:3, :3]
    text = CAM_TO_CAM.replace("R_rect_00: 1 0 0 0 1 0 0 0 1", "R_rect_00: " + " ".join(map(str, rotation.ravel())))
    (tmp_path / "cam.txt").write_text(text)
    (tmp_path / "velo.txt").write_text(VELO_TO_CAM)
    model, T_camera_reference = kitti.read_camera(tmp_path / "cam.txt", 2)
    T_camera_lidar = T_camera_reference @ kitti.read_rigid(tmp_path / "velo.txt")
    point = np.array([12.0, 1.5, -0.4])
    P = np.array([[50, 0, 31.5, 5], [0, 50, 15.5, 0], [0, 0, 1, 0]])
    rectified = geometry.transform_of_rotation(rotation) @ kitti.read_rigid(tmp_path / "velo.txt")
    u, v, w = P @ np.r_[geometry.apply(rectified, point[None])[0], 1]
    got = model.K @ geometry.apply(T_camera_lidar, point[None])[0]
    np.testing.assert_allclose(got[:2] / got[2], [u / w, v / w], atol=1e-9)
    assert (model.width, model.height) == (64, 32)


def test_a_smaller_image_keeps_its_corner(tmp_path):
    (tmp_path / "cam.txt").write_text(CAM_TO_CAM)
    full, half = kitti.read_camera(tmp_path / "cam.txt", 2)[0], kitti.read_camera(tmp_path / "cam.txt", 2, 32, 16)[0]
    assert half.K[0, 0] == full.K[0, 0] / 2
    assert half.K[0, 2] == (full.K[0, 2] + 0.5) / 2 - 0.5


@pytest.mark.parametrize(
    ("old", "new", "found"),
    [
        ("R_rect_00: 1 0 0", "R_rect_00: 1 0 0.3", "no rotation"),
        ("R_rect_00: 1 0 0", "R_rect_00: -1 0 0", "no rotation"),
        ("R_rect_00: 1 0 0", "R_rect_00: nan 0 0", "finite"),
        ("P_rect_02: 50", "P_rect_02: 50 1", "13 numbers"),
        ("P_rect_02:", "P_rect_03:", "P2"),
        ("P_rect_02: 50 0 31.5 5 0 50", "P_rect_02: 0 0 0 5 0 0", "singular"),
    ],
)
def test_bad_calibrations_are_named(tmp_path, old, new, found):
    (tmp_path / "cam.txt").write_text(CAM_TO_CAM.replace(old, new))
    with pytest.raises(BadInput, match=found):
        kitti.read_camera(tmp_path / "cam.txt", 2)


def test_odometry_calibration_needs_the_size(tmp_path):
    (tmp_path / "calib.txt").write_text("P2: 50 0 31.5 5 0 50 15.5 0 0 0 1 0\nTr: 0 -1 0 0 0 0 -1 0 1 0 0 0\n")
    assert kitti.read_camera(tmp_path / "calib.txt", 2, 64, 32)[0].width == 64
    assert kitti.read_rigid(tmp_path / "calib.txt", "Tr")[2, 0] == 1
    with pytest.raises(BadInput, match="how large"):
        kitti.read_camera(tmp_path / "calib.txt", 2)
    with pytest.raises(BadInput, match="no line 'Tr2:'"):
        kitti.read_rigid(tmp_path / "calib.txt", "Tr2")


def test_calibration_is_written_as_it_is_read(tmp_path):
    (tmp_path / "cam.txt").write_text(CAM_TO_CAM)
    model, _ = kitti.read_camera(tmp_path / "cam.txt", 2)
    T = geometry.transform([0.1, 0.2, 0.3], [0.4, 0.5, 0.6])
    (tmp_path / "calib.txt").write_text(kitti.calibration_text(model, T))
    np.testing.assert_allclose(kitti.read_rigid(tmp_path / "calib.txt", "Tr"), T, atol=1e-11)
    np.testing.assert_allclose(kitti.read_camera(tmp_path / "calib.txt", 2, 64, 32)[0].K, model.K)


def test_labels_of_a_cut_file(tmp_path):
    (tmp_path / "0.label").write_bytes(np.array([70, 259 | 3 << 16], "<u4").tobytes())
    assert kitti.read_labels(tmp_path / "0.label").tolist() == [70, 259 | 3 << 16]
    (tmp_path / "0.label").write_bytes(b"12345")
    with pytest.raises(BadInput, match="5 bytes"):
        kitti.read_labels(tmp_path / "0.label")


@pytest.mark.parametrize("row", ["1 2 3", "91", "0" + " 0" * 30, "x " * 30, "99 8 " + "0 " * 28, "nan " * 30])
def test_bad_oxts_rows(tmp_path, row):
    (tmp_path / "0.txt").write_text(row)
    with pytest.raises(BadInput):
        kitti.read_oxts([tmp_path / "0.txt"], np.array([0]))


@settings(deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.one_of(st.binary(max_size=300), st.text("0123456789.e+- \n:,PRTframe_unix", max_size=300).map(str.encode)))
@example(b"")
@example(b"\xff\xfe")
@example(b"nan\n")
@example(b"1e400\n")
@example(b"frame,unix_time\n1,0\n")
@example(b"2020-13-01 00:00:00.0\n")
@example(b"P2: 1 2 x\n")
@example(b"R: 0 0 0 0 0 0 0 0 0\nT: 0 0 0\n")
def test_any_bytes_give_a_value_or_a_clear_error(tmp_path, data):
    path = tmp_path / "file.txt"
    path.write_bytes(data)
    for read in (
        kitti.read_times, kitti.read_calibration, kitti.read_rigid, kitti.read_gnss_csv, kitti.read_scan, kitti.read_labels,
        lambda p: kitti.read_camera(p, 2), lambda p: kitti.read_oxts([p], np.array([0])),
    ):  # fmt: skip
        try:
            read(path)
        except (BadInput, BadRecord) as error:
            assert "file.txt" in str(error)  # noqa: PT017
