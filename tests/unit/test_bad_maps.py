"""What cannot be imported is refused in one sentence that names file, key or class and the remedy; nothing is left half-written."""

import laspy
import numpy as np
import pypcd4
import pytest

from streetscan.clouds import PointCloud
from streetscan.datasets import parse_facts
from streetscan.errors import BadInput
from streetscan.imports import common_crs, import_map
from streetscan.io.foreign import Reader
from streetscan.io.las import open_las_writer, read_las, write_las

TEXT = {
    "format": "text",
    "columns": ["x", "y", "z", "intensity", "r", "g", "b", "kind"],
    "comment": None,
    "delimiter": None,
    "n_header_rows": 0,
}
GOOD_ROW = "1 2 3 100 10 20 30 1\n"


def make_dataset(crs=None, truth="labels", class_map=None, **reader):
    return parse_facts(
        {
            "name": "bad",
            "title": "Bad",
            "source": "import",
            "truth": truth,
            "crs": crs,
            "parts": {"all": {"files": ["a"], "n_tiles": 1}},
            "reader": reader,
            "class_map": class_map or {1: "ground", 2: "car"},
        }
    )


def text_dataset(**changes):
    return make_dataset(**({"label": "kind", "fields": {"intensity": "intensity", "rgb": ["r", "g", "b"]}} | TEXT | changes))


def refusal(tmp_path, dataset, files):
    """The sentence import_map refuses files with, once nothing is left behind."""
    before = set(tmp_path.rglob("*"))
    with pytest.raises(BadInput) as error:
        import_map(dataset, files, tmp_path / "out" / "map.laz", tmp_path / "out" / "truth" / "labels.npy")
    assert not [p for p in set(tmp_path.rglob("*")) - before if p.is_file()]
    assert "\n" not in str(error.value)
    return str(error.value)


def write_text(tmp_path, text, name="a.txt"):
    (tmp_path / name).write_text(text)
    return tmp_path / name


@pytest.mark.parametrize(
    ("text", "found", "remedy"),
    [
        ("1 2 3 100 10 20 30\n", "line 2 holds 7 columns, not the 8 expected", "the columns and the delimiter"),
        ("1 2 3 100 10 20 30 tree\n", "line 2 holds 'tree', which is no number", "mend the line"),
        ("1 2 nan 100 10 20 30 1\n", "NaN or infinite coordinates (first: point 1)", "remove those points"),
        ("1 2 -inf 100 10 20 30 1\n", "NaN or infinite coordinates", "remove those points"),
        ("1 2 3 100 10 20 30 9\n", "class id 9 occurs but is not in the class map", "add it to class_map"),
        ("1 2 3 100 10 20 30 1.5\n", "holds the class id 1.5, which is no integer", "reader.label"),
        ("1 2 3 100 10 20 256 1\n", "holds the colour 256.0, which is no integer in 0..255", "reader.fields"),
        ("1 2 3 0.5 10 20 30 1\n", "holds the intensity 0.5, which is no integer in 0..65535", "give reader.intensity_range"),
        ("1 2 3 70000 10 20 30 1\n", "holds the intensity 70000.0", "give reader.intensity_range"),
    ],
)
def test_bad_rows_of_text(tmp_path, text, found, remedy):
    # The first file is good: nothing of it may stay either.
    good, bad = write_text(tmp_path, GOOD_ROW * 3, "good.txt"), write_text(tmp_path, GOOD_ROW + text)
    message = refusal(tmp_path, text_dataset(), [good, bad])
    assert message.startswith(f"{bad}: ")
    assert found in message
    assert remedy in message


def test_an_empty_file_among_good_ones(tmp_path):
    good, empty = write_text(tmp_path, GOOD_ROW, "good.txt"), write_text(tmp_path, "")
    assert refusal(tmp_path, text_dataset(), [good, empty]).startswith(f"{empty}: holds no point")


@pytest.mark.parametrize("kind", ["text", "ply", "pcd", "las"])
def test_missing_files_of_every_format(tmp_path, kind):
    dataset = make_dataset(truth="none", **(TEXT if kind == "text" else {"format": kind}))
    path = tmp_path / f"missing.{kind}"
    assert refusal(tmp_path, dataset, [path]) == f"{path}: no such file; check the data set's file and data_root."


def test_no_files_at_all(tmp_path):
    assert "the part has no files" in refusal(tmp_path, text_dataset(), [])


@pytest.mark.parametrize("suffix", [".las", ".laz"])
@pytest.mark.parametrize("share", [0.02, 0.1, 0.5, 0.99])
def test_truncated_las(tmp_path, suffix, share):
    las = laspy.create(point_format=7, file_version="1.4")
    las.x, las.y, las.z = np.random.default_rng(0).uniform(0, 100, (3, 500))
    las.write(tmp_path / f"whole{suffix}")
    data = (tmp_path / f"whole{suffix}").read_bytes()
    path = tmp_path / f"cut{suffix}"
    path.write_bytes(data[: int(share * len(data))])
    message = refusal(tmp_path, make_dataset(truth="none", format="las"), [path])
    assert str(path) in message
    assert "copy or export it again" in message


def test_empty_las(tmp_path):
    write_las(tmp_path / "a.laz", PointCloud(np.empty((0, 3))))
    assert "holds no point" in refusal(tmp_path, make_dataset(truth="none", format="las"), [tmp_path / "a.laz"])


def test_pcd_without_the_label_field(tmp_path):
    cloud = pypcd4.PointCloud.from_points([np.zeros(2)] * 4, ("x", "y", "z", "intensity"), (np.float32,) * 4)
    cloud.save(tmp_path / "a.pcd")
    message = refusal(tmp_path, make_dataset(format="pcd", label="class_id"), [tmp_path / "a.pcd"])
    assert "a.pcd: has no field 'class_id' (it has intensity); mend reader.label" in message


def test_a_field_that_is_not_there(tmp_path):
    write_las(tmp_path / "a.laz", PointCloud(np.zeros((2, 3))))
    message = refusal(tmp_path, make_dataset(truth="none", format="las", fields={"rgb": "rgb"}), [tmp_path / "a.laz"])
    assert "a.laz: has no field 'rgb' (it has intensity, " in message


@pytest.mark.parametrize("labels", ["1\n", "1\n1\n1\n"])
def test_labels_of_another_length(tmp_path, labels):
    path = write_text(tmp_path, GOOD_ROW * 2)
    write_text(tmp_path, labels, "a.labels")
    message = refusal(tmp_path, text_dataset(label=None, label_suffix=".labels"), [path])
    assert f"a.labels: holds {len(labels) // 2} labels for" in message
    assert "get the labels file that belongs to the cloud" in message


def test_no_labels_file(tmp_path):
    path = write_text(tmp_path, GOOD_ROW)
    assert "a.labels: no such file; put the labels of a.txt there" in refusal(
        tmp_path, text_dataset(label=None, label_suffix=".labels"), [path]
    )


def test_class_map_with_an_unknown_class():
    with pytest.raises(BadInput, match=r"class_map\.1 is 'road', which is no class; use one of ground, facade"):
        make_dataset(class_map={1: "road"}, label="kind", **TEXT)


def test_files_in_different_reference_systems(tmp_path):
    dataset = make_dataset(truth="none", format="las")
    points = np.array([[650_000.0, 240_000, 100]])
    for name, crs in (("eov", "EPSG:23700"), ("utm", "EPSG:32634"), ("none", None)):
        write_las(tmp_path / f"{name}.laz", PointCloud(points, {}, crs))
    eov, utm, none = (tmp_path / f"{name}.laz" for name in ("eov", "utm", "none"))
    message = refusal(tmp_path, dataset, [eov, utm])
    assert f"{utm}: is in WGS 84 / UTM zone 34N but {eov} is in HD72 / EOV; reproject one of them" in message
    assert "is in no reference system but" in refusal(tmp_path, dataset, [eov, none])
    assert "but the data set declares HD72 / EOV" in refusal(tmp_path, make_dataset("EPSG:23700", truth="none", format="las"), [utm])
    import_map(make_dataset("EPSG:23700", truth="none", format="las"), [eov, none], tmp_path / "map.laz", tmp_path / "labels.npy")
    assert read_las(tmp_path / "map.laz").crs == "EPSG:23700"


def test_a_missing_vertical_reference_is_no_difference():
    assert common_crs("EPSG:7415", "EPSG:28992", "a.laz") == "EPSG:7415"


@pytest.mark.parametrize(
    ("crs", "message"), [("EPSG:4326", "unit is degree"), ("EPSG:2229", "unit is US survey foot"), ("EPSG:1", "pyproj knows")]
)
def test_reference_systems_not_in_metres(crs, message):
    with pytest.raises(BadInput, match=message):
        common_crs(crs, None, "a.laz")


@pytest.mark.parametrize("stray", ["9000000 2 3", "1 2 1000000"])
def test_a_stray_point_far_away(tmp_path, stray):
    path = write_text(tmp_path, GOOD_ROW + f"{stray} 100 10 20 30 1\n")
    message = refusal(tmp_path, text_dataset(), [path])
    assert "a.txt" in message
    assert "lies more than 100 km from the first one" in message


def test_readers_that_contradict_themselves():
    with pytest.raises(BadInput, match="'e57' is no format we read; use one of las, ply, pcd, text"):
        Reader("e57")
    with pytest.raises(BadInput, match="would put the true labels into the map"):
        Reader("text", fields={"rgb": ["r", "g", "kind"]}, label="kind")


def test_what_the_las_writer_refuses(tmp_path):
    for fields, points, message in (
        ({}, [[np.nan, 0, 0]], "NaN or infinite"),
        ({"intensity": np.array([-1.0])}, [[0, 0, 0]], "must lie in 0..65535"),
        ({"intensity": np.array([np.nan])}, [[0, 0, 0]], "must lie in 0..65535"),
    ):
        with pytest.raises(ValueError, match=message):
            write_las(tmp_path / "a.laz", PointCloud(np.array(points), fields))
        assert not list(tmp_path.iterdir())


def test_an_error_inside_the_writing_block_reaches_the_caller(tmp_path):
    def write_and_fail():
        with open_las_writer(tmp_path / "a.laz") as writer:
            writer.write(PointCloud(np.zeros((3, 3))))
            raise KeyError("ours")

    with pytest.raises(KeyError, match="ours"):
        write_and_fail()
    assert not list(tmp_path.iterdir())
