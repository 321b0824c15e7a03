"""Text columns come back as they were written, and lines that are wrong are named."""

import bz2
import gzip
import lzma

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from streetscan.clouds import concatenate
from streetscan.errors import BadInput
from streetscan.io.labels import LabelsFile, find_labels_file
from streetscan.io.xyz import iterate_rows, iterate_xyz

COORDINATES = st.floats(-6_000_000, 6_000_000, allow_nan=False)
COLUMNS = ["x", "y", "z", "intensity"]


def write_rows(path, rows, delimiter=" "):
    lines = (delimiter.join("" if np.isnan(v) else repr(float(v)) for v in row) + "\n" for row in rows)
    path.write_text("".join(lines))
    return path


def read_all(path, columns=COLUMNS, **layout):
    return concatenate(iterate_xyz(path, columns, **layout))


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(rows=arrays(np.float64, st.tuples(st.integers(1, 30), st.just(4)), elements=COORDINATES), chunk=st.integers(1, 40))
def test_numbers_survive_to_the_last_bit(tmp_path, rows, chunk):
    cloud = read_all(write_rows(tmp_path / "a.txt", rows), chunk_rows=chunk)
    np.testing.assert_array_equal(cloud.points, rows[:, :3])
    np.testing.assert_array_equal(cloud.fields["intensity"], rows[:, 3])


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(values=st.lists(st.one_of(st.none(), COORDINATES), min_size=1, max_size=20))
def test_empty_values_are_nan(tmp_path, values):
    values = np.array([np.nan if v is None else v for v in values])
    rows = np.c_[np.arange(3.0 * len(values)).reshape(-1, 3), values]
    cloud = read_all(write_rows(tmp_path / "a.csv", rows, ","), delimiter=",")
    np.testing.assert_array_equal(cloud.fields["intensity"], values)


@pytest.mark.parametrize(("suffix", "compress"), [("", bytes), (".xz", lzma.compress), (".gz", gzip.compress), (".bz2", bz2.compress)])
def test_compressions_comments_headers_and_line_ends(tmp_path, suffix, compress):
    path = tmp_path / f"a.txt{suffix}"
    path.write_bytes(compress(b"x y z intensity\r\n# a comment, not utf-8: \xe9\r\n\r\n-1  2\t3 4 # behind a point\r\n1e3 0 0 7\r\n"))
    cloud = read_all(path, comment="#", n_header_rows=1)
    np.testing.assert_array_equal(cloud.points, [[-1, 2, 3], [1000, 0, 0]])
    np.testing.assert_array_equal(cloud.fields["intensity"], [4, 7])


def test_columns_may_come_in_any_order_and_bring_no_field(tmp_path):
    path = write_rows(tmp_path / "a.txt", np.array([[1.0, 2.0, 3.0]]))
    cloud = read_all(path, columns=["z", "x", "y"])
    np.testing.assert_array_equal(cloud.points, [[2, 3, 1]])
    assert cloud.fields == {}


def test_only_the_rows_asked_for_are_read(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("1 2\n3 4\n3 0 1 2\n")
    np.testing.assert_array_equal(np.concatenate(list(iterate_rows(path, ["a", "b"], n_rows=2))), [[1, 2], [3, 4]])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1 2 3 4\n1 2 3\n", "line 2 holds 3 columns, not the 4 expected (x, y, z, intensity)"),
        ("1 2 3\n1 2 3 4\n", "line 1 holds 3 columns"),
        ("1 2 3 4\n1 2 3 4 5\n", "line 2 holds 5 columns"),
        ("1 2 3 4 5\n", "line 1 holds 5 columns"),
        ("1 2 3 4\n\n1 2 up 4\n", "line 3 holds 'up', which is no number"),
        ("x y z i\n1 2 3 4\n", "line 1 holds 'x', which is no number"),
        ("1 2 3 4\nnan 2 3 4\n", "1 points have NaN or infinite coordinates (first: point 1)"),
        ("1 2 3 4\n1 2 inf 4\n", "NaN or infinite coordinates"),
        ("", "holds no point"),
        ("# nothing but a comment\n", "holds no point"),
    ],
)
def test_wrong_lines_are_named(tmp_path, text, message):
    path = tmp_path / "a.txt"
    path.write_text(text)
    with pytest.raises(BadInput) as error:
        read_all(path, comment="#", chunk_rows=1)
    assert message in str(error.value)
    assert str(path) in str(error.value)


def test_a_short_line_with_a_delimiter_is_named(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("1,2,3,4\n1,2,3\n")
    with pytest.raises(BadInput, match="line 2 holds 3 columns"):
        read_all(path, delimiter=",")


@pytest.mark.parametrize(("suffix", "compress"), [(".xz", lzma.compress), (".gz", gzip.compress), (".bz2", bz2.compress)])
@pytest.mark.parametrize("share", [0.3, 0.9, 0.999])
def test_truncated_compression_is_named(tmp_path, suffix, compress, share):
    data = compress("".join(f"{x} 2 3 4\n" for x in np.random.default_rng(0).random(2000)).encode())
    path = tmp_path / f"a.txt{suffix}"
    path.write_bytes(data[: int(share * len(data))])
    with pytest.raises(BadInput, match="damaged or truncated"):
        read_all(path)


def test_missing_file_and_missing_axis_are_named(tmp_path):
    with pytest.raises(BadInput, match=r"no_such\.txt: no such file"):
        read_all(tmp_path / "no_such.txt")
    with pytest.raises(BadInput, match="no column is named 'y'"):
        read_all(tmp_path / "no_such.txt", columns=["x", "z"])


def test_labels_beside_a_cloud_are_found_and_taken_in_pieces(tmp_path):
    (tmp_path / "scan.labels.gz").write_bytes(gzip.compress(b"3\n1\n4\n1\n5\n"))
    path = find_labels_file(tmp_path / "scan.txt.xz", ".labels")
    labels = LabelsFile(path)
    np.testing.assert_array_equal(labels.take(2), [3, 1])
    np.testing.assert_array_equal(labels.take(3), [4, 1, 5])
    labels.finish()


def test_too_few_and_too_many_labels_are_named(tmp_path):
    path = tmp_path / "scan.labels"
    path.write_text("1\n2\n3\n")
    with pytest.raises(BadInput, match="holds 3 labels for at least 4 points"):
        LabelsFile(path).take(4)
    labels = LabelsFile(path)
    labels.take(1)
    with pytest.raises(BadInput, match="holds 3 labels for 1 points"):
        labels.finish()


def test_missing_labels_are_named(tmp_path):
    with pytest.raises(BadInput, match=r"scan\.labels: no such file"):
        find_labels_file(tmp_path / "scan.txt", ".labels")
