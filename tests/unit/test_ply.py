"""PLY keeps every scalar property in its type, in all three encodings, and damaged files are named."""

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from streetscan.clouds import concatenate
from streetscan.errors import BadInput
from streetscan.io.ply import iterate_ply

NAMES = {"i1": "char", "u1": "uchar", "i2": "short", "u2": "ushort", "i4": "int", "u4": "uint32", "f4": "float", "f8": "double"}
ENCODINGS = ("ascii", "binary_little_endian", "binary_big_endian")
XYZ = [("x", "f8"), ("y", "f8"), ("z", "f8")]
EVERY_TYPE = np.dtype([*XYZ, *((f"field_{code}", code) for code in NAMES)])


def write_ply(path, records, encoding="binary_little_endian", before="", after="", data_before=b"", data_after=b""):
    """A PLY file by hand: elements `before` and `after` the vertices come with their data."""
    properties = "".join(f"property {NAMES[records.dtype[name].str[1:]]} {name}\n" for name in records.dtype.names)
    vertex = f"element vertex {len(records)}\n{properties}"
    header = f"ply\nformat {encoding} 1.0\ncomment by hand\nobj_info none\n{before}{vertex}{after}end_header\n"
    if encoding == "ascii":
        data = "".join(" ".join(repr(value.item()) for value in record) + "\n" for record in records).encode()
    else:
        data = records.astype(records.dtype.newbyteorder("<" if "little" in encoding else ">")).tobytes()
    path.write_bytes(header.encode() + data_before + data + data_after)
    return path


def read_all(path, **options):
    return concatenate(iterate_ply(path, **options))


def elements_of(code):
    if code[0] == "f":
        return st.floats(-6_000_000, 6_000_000, allow_nan=False, width=8 * int(code[1]))
    limits = np.iinfo(code)
    return st.integers(int(limits.min), int(limits.max))


@st.composite
def record_arrays(draw, dtype=EVERY_TYPE):
    n = draw(st.integers(1, 12))
    records = np.empty(n, dtype)
    for name in dtype.names:
        records[name] = draw(arrays(dtype[name], n, elements=elements_of(dtype[name].str[1:])))
    return records


@pytest.mark.parametrize("encoding", ENCODINGS)
@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(records=record_arrays(), chunk=st.integers(1, 15))
def test_every_type_survives(tmp_path, encoding, records, chunk):
    cloud = read_all(write_ply(tmp_path / "a.ply", records, encoding), chunk_points=chunk)
    for i, axis in enumerate("xyz"):
        np.testing.assert_array_equal(cloud.points[:, i], records[axis])
    assert set(cloud.fields) == {name for name in records.dtype.names if name not in "xyz"}
    for name, values in cloud.fields.items():
        assert values.dtype == records.dtype[name]
        np.testing.assert_array_equal(values, records[name])


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_faces_behind_and_plain_elements_before_the_vertices(tmp_path, encoding):
    records = np.array([(1, 2, 3), (4, 5, 6)], XYZ)
    order = "<" if "little" in encoding else ">"
    data_before = b"9 8\n" if encoding == "ascii" else np.array([9, 8], f"{order}i4").tobytes()
    data_after = b"3 0 1 1\n" if encoding == "ascii" else b"\x03" + np.array([0, 1, 1], f"{order}i4").tobytes()
    before = "element camera 1\nproperty int u\nproperty int v\n"
    after = "element face 1\nproperty list uchar int vertex_indices\n"
    path = write_ply(tmp_path / "a.ply", records, encoding, before, after, data_before, data_after)
    np.testing.assert_array_equal(read_all(path).points, [[1, 2, 3], [4, 5, 6]])


def test_one_point_and_no_other_field(tmp_path):
    cloud = read_all(write_ply(tmp_path / "a.ply", np.array([(-1, -2, -3)], XYZ)))
    assert len(cloud) == 1
    assert cloud.fields == {}


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_truncated_anywhere(tmp_path, encoding):
    records = np.zeros(20, EVERY_TYPE)
    data = write_ply(tmp_path / "a.ply", records, encoding).read_bytes()
    # An ASCII file may end without a line feed.
    for length in range(0, len(data) - 2, 7):
        path = tmp_path / "cut.ply"
        path.write_bytes(data[:length])
        with pytest.raises(BadInput, match=r"cut\.ply"):
            read_all(path)


@pytest.mark.parametrize(
    ("header", "message"),
    [
        ("plyx\n", "not a PLY file"),
        ("ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nend_header\n1 2\n", "no property 'z'"),
        ("ply\nformat ascii 1.0\nelement face 1\nproperty float x\nend_header\n1\n", "no element 'vertex'"),
        ("ply\nformat binary 1.0\nelement vertex 1\nproperty float x\nend_header\n1\n", "unknown PLY format 'binary'"),
        ("ply\nformat ascii 1.0\nelement vertex 1\nproperty quad x\nend_header\n1\n", "line 4 of the header is not PLY"),
        ("ply\nformat ascii 1.0\nelement vertex many\nend_header\n", "line 3 of the header is not PLY"),
        ("ply\nformat ascii 1.0\nproperty float x\nend_header\n", "line 3 of the header is not PLY"),
        ("ply\n" + "comment c\n" * 2000, "no end within 1000 lines"),
    ],
)
def test_wrong_headers_are_named(tmp_path, header, message):
    path = tmp_path / "a.ply"
    path.write_text(header)
    with pytest.raises(BadInput) as error:
        read_all(path)
    assert message in str(error.value)


def test_lists_before_the_vertices_are_refused(tmp_path):
    before = "element face 1\nproperty list uchar int vertex_indices\n"
    path = write_ply(tmp_path / "a.ply", np.zeros(1, XYZ), "ascii", before, data_before=b"1 0\n")
    with pytest.raises(BadInput, match="list properties"):
        read_all(path)


def test_a_property_twice_is_refused(tmp_path):
    path = tmp_path / "a.ply"
    properties = "".join(f"property float {name}\n" for name in "xyzz")
    path.write_text(f"ply\nformat ascii 1.0\nelement vertex 1\n{properties}end_header\n1 2 3 4\n")
    with pytest.raises(BadInput, match="the same name"):
        read_all(path)


def test_bad_coordinates_and_bad_text(tmp_path):
    with pytest.raises(BadInput, match="holds no point"):
        read_all(write_ply(tmp_path / "a.ply", np.zeros(0, XYZ)))
    records = np.zeros(6, XYZ)
    records["y"][4] = np.inf
    with pytest.raises(BadInput, match=r"NaN or infinite coordinates \(first: point 4\)"):
        read_all(write_ply(tmp_path / "a.ply", records), chunk_points=3)
    path = write_ply(tmp_path / "a.ply", np.zeros(2, XYZ), "ascii")
    path.write_text(path.read_text().replace("0.0 0.0 0.0\n", "0.0 zero 0.0\n", 1))
    with pytest.raises(BadInput, match="line 10 holds 'zero', which is no number"):
        read_all(path)


def test_utm_in_32_bits_is_refused_in_binary_and_kept_in_text(tmp_path):
    records = np.array([(627_285.1, 4_841_948.2, 150)], [("x", "f4"), ("y", "f4"), ("z", "f4")])
    with pytest.raises(BadInput, match="32-bit floats"):
        read_all(write_ply(tmp_path / "a.ply", records))
    properties = "".join(f"property float {name}\n" for name in "xyz")
    (tmp_path / "b.ply").write_text(f"ply\nformat ascii 1.0\nelement vertex 1\n{properties}end_header\n627285.123 4841948.456 1\n")
    np.testing.assert_array_equal(read_all(tmp_path / "b.ply").points, [[627285.123, 4841948.456, 1]])


def test_missing_file_is_named(tmp_path):
    with pytest.raises(BadInput, match=r"no\.ply: no such file"):
        read_all(tmp_path / "no.ply")


@pytest.mark.parametrize("value", ["300", "-1", "nan"])
def test_ascii_integers_must_fit_their_type(tmp_path, value):
    header = "ply\nformat ascii 1.0\nelement vertex 2\n" + "".join(f"property double {axis}\n" for axis in "xyz")
    (tmp_path / "a.ply").write_text(f"{header}property uchar red\nend_header\n1 2 3 255\n1 2 4 {value}\n")
    with pytest.raises(BadInput, match=r"a\.ply"):
        list(iterate_ply(tmp_path / "a.ply"))
