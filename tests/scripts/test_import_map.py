"""import_map makes a map without labels and the truth beside it, from every format the ready-made data sets use."""

import copy
import importlib.util
from pathlib import Path

import laspy
import numpy as np
import pytest
import yaml

from streetscan.classes import LABELS, UNLABELLED
from streetscan.clouds import PointCloud
from streetscan.datasets import load_dataset
from streetscan.errors import BadInput
from streetscan.io.las import read_las, write_las

ROOT = Path(__file__).resolve().parents[2]


def import_main():
    spec = importlib.util.spec_from_file_location("import_map", ROOT / "scripts" / "import_map.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.main


def ready_facts(name):
    return yaml.safe_load((ROOT / "config" / "datasets" / f"{name}.yaml").read_text())


def run(folder, files, facts):
    """The map and the labels import_map makes of files."""
    map_path, labels_path = folder / "out" / "map.laz", folder / "out" / "truth" / "labels.npy"
    import_main()(files=[str(f) for f in files], map=str(map_path), labels=str(labels_path), facts=copy.deepcopy(facts))
    cloud, labels = read_las(map_path), np.load(labels_path)
    assert labels.dtype == np.uint8
    assert len(labels) == len(cloud)
    assert "label" not in cloud.fields
    assert (cloud.fields["classification"] == 0).all()
    assert sorted(p.name for p in (folder / "out").rglob("*") if p.is_file()) == ["labels.npy", "map.laz"]
    return cloud, labels


def expected_labels(facts, class_ids):
    return np.array([LABELS[facts["class_map"][int(i)]] for i in class_ids], np.uint8)


def every_class_id(facts):
    return np.array(sorted(facts["class_map"]))


def write_ply(path, dtype, values):
    names = {"f4": "float", "f8": "double", "u1": "uchar", "i4": "int", "u4": "uint"}
    n = len(next(iter(values.values())))
    records = np.zeros(n, np.dtype(dtype))
    for name, column in values.items():
        records[name] = column
    properties = "".join(f"property {names[code]} {name}\n" for name, code in dtype)
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {n}\n{properties}end_header\n"
    path.write_bytes(header.encode() + records.astype(records.dtype.newbyteorder("<")).tobytes())
    return path


def random_points(n, seed=0):
    return np.round(np.random.default_rng(seed).uniform(-90, 90, (n, 3)), 3)


def test_city_mls_text(tmp_path):
    facts = ready_facts("city_mls")
    ids = every_class_id(facts)
    points, rgb = random_points(9), np.arange(27).reshape(9, 3) * 9
    np.savetxt(tmp_path / "a.txt", np.c_[points, rgb, ids], fmt="%.3f %.3f %.3f %d %d %d %d")
    cloud, labels = run(tmp_path, [tmp_path / "a.txt"], facts)
    np.testing.assert_allclose(cloud.points, points, atol=1e-9)
    np.testing.assert_array_equal(cloud.fields["rgb"], rgb)
    np.testing.assert_array_equal(labels, np.arange(9))


def test_oakland_text_joins_files_in_order(tmp_path):
    facts = ready_facts("oakland")
    ids = every_class_id(facts)
    points = random_points(len(ids))
    for name, chosen in (("b", slice(0, 20)), ("a", slice(20, None))):
        header = "#File format: x y z label_id confidence \n#  1000 -- to_label \n"
        rows = "".join(f"{x} {y} {z} {i} 2\n" for (x, y, z), i in zip(points[chosen], ids[chosen], strict=True))
        (tmp_path / name).write_text(header + rows)
    cloud, labels = run(tmp_path, [tmp_path / "b", tmp_path / "a"], facts)
    np.testing.assert_allclose(cloud.points, points, atol=1e-9)
    np.testing.assert_array_equal(labels, expected_labels(facts, ids))
    assert cloud.crs is None


def test_paris_rue_madame_ply(tmp_path):
    facts = ready_facts("paris_rue_madame")
    ids = every_class_id(facts)
    points = random_points(len(ids)).astype(np.float32)
    dtype = [("x", "f4"), ("y", "f4"), ("z", "f4"), ("reflectance", "f4"), ("label", "u4"), ("class", "u4")]
    values = dict(zip("xyz", points.T, strict=True)) | {"reflectance": 255.0, "label": np.arange(len(ids)) + 4_000_000_000, "class": ids}
    cloud, labels = run(tmp_path, [write_ply(tmp_path / "a.ply", dtype, values)], facts)
    np.testing.assert_allclose(cloud.points, points, atol=0.0006)
    np.testing.assert_array_equal(labels, expected_labels(facts, ids))
    np.testing.assert_array_equal(cloud.fields["object_id"], np.arange(len(ids)) + 4_000_000_000)
    assert (cloud.fields["intensity"] == 65535).all()


def test_terramobilita_ply_gets_its_offset_and_reference_system(tmp_path):
    facts = ready_facts("terramobilita")
    ids = every_class_id(facts)
    points = random_points(len(ids)).astype(np.float32)
    floats = ["x", "y", "z", "x_origin", "y_origin", "z_origin", "reflectance", "range", "theta"]
    dtype = [
        ("GPS_time", "f8"),
        *((name, "f4") for name in floats),
        ("id", "u4"),
        ("class", "u4"),
        ("num_echo", "u1"),
        ("nb_of_echo", "u1"),
    ]
    values = dict(zip("xyz", points.T, strict=True)) | {"GPS_time": 1.5 + np.arange(len(ids)), "reflectance": -10, "class": ids}
    cloud, labels = run(tmp_path, [write_ply(tmp_path / "a.ply", dtype, values | {"num_echo": 1, "nb_of_echo": 3, "id": 7})], facts)
    np.testing.assert_allclose(cloud.points, points + np.array([649_000, 6_840_000, 0.0]), atol=0.0006)
    np.testing.assert_array_equal(labels, expected_labels(facts, ids))
    np.testing.assert_array_equal(cloud.fields["time_s"], 1.5 + np.arange(len(ids)))
    assert cloud.crs == "EPSG:2154"
    assert (cloud.fields["n_returns"] == 3).all()
    assert (cloud.fields["intensity"] == 32768).all()


def test_paris_lille_3d_ply(tmp_path):
    facts = ready_facts("paris_lille_3d")
    ids = every_class_id(facts)
    dtype = [("x", "f4"), ("y", "f4"), ("z", "f4"), ("x_origin", "f4"), ("y_origin", "f4"), ("z_origin", "f4")]
    dtype += [("GPS_time", "f8"), ("reflectance", "u1"), ("class", "i4")]
    values = dict(zip("xyz", random_points(len(ids)).T, strict=True)) | {"reflectance": 51, "class": ids}
    cloud, labels = run(tmp_path, [write_ply(tmp_path / "a.ply", dtype, values)], facts)
    np.testing.assert_array_equal(labels, expected_labels(facts, ids))
    assert (cloud.fields["intensity"] == 65535 // 5).all()


def test_toronto_3d_ply_keeps_utm_to_the_millimetre(tmp_path):
    facts = ready_facts("toronto_3d")
    ids = every_class_id(facts)
    points = random_points(len(ids)) + np.array([627_285, 4_841_948, 150])
    dtype = [("x", "f8"), ("y", "f8"), ("z", "f8"), ("red", "u1"), ("green", "u1"), ("blue", "u1")]
    dtype += [("scalar_Intensity", "f4"), ("scalar_GPSTime", "f4"), ("scalar_ScanAngleRank", "f4"), ("scalar_Label", "f4")]
    values = dict(zip("xyz", points.T, strict=True)) | {"red": 10, "blue": 255, "scalar_Intensity": 812, "scalar_Label": ids}
    cloud, labels = run(tmp_path, [write_ply(tmp_path / "a.ply", dtype, values)], facts)
    np.testing.assert_allclose(cloud.points, points, atol=1e-8)
    np.testing.assert_array_equal(labels, expected_labels(facts, ids))
    np.testing.assert_array_equal(cloud.fields["rgb"], np.tile([10, 0, 255], (len(ids), 1)))
    assert (cloud.fields["intensity"] == 812).all()
    assert cloud.crs == "EPSG:26917"


def test_semantic3d_text_with_labels_beside_it(tmp_path):
    facts = ready_facts("semantic3d")
    ids = every_class_id(facts)
    points, intensity = random_points(9), np.linspace(-2048, 2047, 9).astype(int)
    np.savetxt(tmp_path / "a.txt", np.c_[points, intensity, np.full((9, 3), 77)], fmt="%.3f %.3f %.3f %d %d %d %d")
    np.savetxt(tmp_path / "a.labels", ids, fmt="%d")
    cloud, labels = run(tmp_path, [tmp_path / "a.txt"], facts)
    np.testing.assert_array_equal(labels, expected_labels(facts, ids))
    assert cloud.fields["intensity"][0] == 0
    assert cloud.fields["intensity"][-1] == 65535


def test_tls_velodyne_scenes_lie_side_by_side(tmp_path):
    facts = ready_facts("tls_velodyne")
    points = random_points(7)
    for name in ("a.txt", "b.txt"):
        np.savetxt(tmp_path / name, np.c_[points, every_class_id(facts)], fmt="%.3f %.3f %.3f %d")
    cloud, labels = run(tmp_path, [tmp_path / "a.txt", tmp_path / "b.txt"], facts)
    np.testing.assert_allclose(cloud.points, np.concatenate([points, points + np.array([200, 0, 0])]), atol=1e-9)
    np.testing.assert_array_equal(labels, np.tile(expected_labels(facts, every_class_id(facts)), 2))


def test_an_own_scan_keeps_its_fields_and_reference_system(tmp_path):
    facts = ready_facts("own_scan")
    facts["reader"]["fields"] |= {"time_s": "time_s", "rgb": "rgb", "width": "width", "normal": "normal"}
    n = 50
    rng = np.random.default_rng(1)
    fields = {
        "intensity": rng.integers(0, 65536, n).astype(np.uint16),
        "time_s": rng.random(n) * 1e6,
        "rgb": rng.integers(0, 256, (n, 3)).astype(np.uint8),
        "width": rng.random(n).astype(np.float32),
        "normal": rng.random((n, 3)).astype(np.float32),
        "label": rng.integers(0, 9, n).astype(np.uint8),
    }
    points = random_points(n) + np.array([650_000, 240_000, 100])
    write_las(tmp_path / "a.laz", PointCloud(points, fields, "EPSG:23700"))
    cloud, labels = run(tmp_path, [tmp_path / "a.laz"], facts)
    np.testing.assert_allclose(cloud.points, points, atol=1e-8)
    assert cloud.crs == "EPSG:23700"
    assert (labels == UNLABELLED).all()
    for name in ("intensity", "time_s", "rgb", "width", "normal"):
        np.testing.assert_array_equal(cloud.fields[name], fields[name])


def test_the_log_says_which_fields_of_a_scan_are_left_out(tmp_path, caplog):
    n = 20
    fields = {"intensity": np.arange(n, dtype=np.uint16), "rgb": np.full((n, 3), 7, np.uint8), "width": np.ones(n, np.float32)}
    write_las(tmp_path / "a.laz", PointCloud(random_points(n), fields))
    with caplog.at_level("INFO"):
        run(tmp_path, [tmp_path / "a.laz"], ready_facts("own_scan"))
    (line,) = [r.getMessage() for r in caplog.records if "leaves out" in r.getMessage()]
    assert "intensity" not in line
    assert all(name in line for name in ("rgb", "width"))


def test_las_classification_may_be_the_truth(tmp_path):
    facts = ready_facts("own_scan") | {"truth": "labels", "class_map": {2: "ground", 6: "facade", 1: "unlabelled"}}
    facts["reader"] |= {"label": "classification", "fields": {}}
    las = laspy.create(point_format=3, file_version="1.2")
    las.header.scales = np.full(3, 0.001)
    las.x, las.y, las.z = random_points(4).T
    las.classification = [2, 6, 1, 2]
    las.write(tmp_path / "a.las")
    _, labels = run(tmp_path, [tmp_path / "a.las"], facts)
    np.testing.assert_array_equal(labels, [0, 1, 255, 0])


def test_one_point_is_no_map(tmp_path):
    (tmp_path / "a.txt").write_text("1 2 3 0 0 0 6\n")
    with pytest.raises(BadInput, match=r"a\.txt: holds a single point"):
        run(tmp_path, [tmp_path / "a.txt"], ready_facts("city_mls"))
    assert not list(tmp_path.glob("**/map.laz"))


@pytest.mark.parametrize("part", ["train", "validation", "test"])
def test_real_oakland(shared_data, tmp_path, part):
    facts = ready_facts("oakland")
    dataset = load_dataset(ROOT / "config" / "datasets" / "oakland.yaml")
    cloud, labels = run(tmp_path, dataset.files(part, shared_data), facts)
    assert len(cloud) == {"train": 599_998, "validation": 200_000, "test": 200_000}[part]
    present = {name for name, label in LABELS.items() if (labels == label).any()}
    assert present >= {"ground", "facade", "vegetation", "column", "car", "furniture"}
    assert 0.6 < (labels == LABELS["ground"]).mean() < 0.8
    assert (labels == UNLABELLED).mean() < 0.01


def test_real_amsterdam(shared_data, tmp_path):
    dataset = load_dataset(ROOT / "config" / "datasets" / "amsterdam.yaml")
    cloud, labels = run(tmp_path, dataset.files("all", shared_data), ready_facts("amsterdam"))
    assert len(cloud) == dataset.published.n_points
    assert cloud.crs == "EPSG:7415"
    assert (labels == UNLABELLED).all()
    np.testing.assert_allclose(cloud.points[:, :2].min(axis=0), [114_650, 484_900], atol=0.01)
    assert cloud.fields["rgb"][-1].any()


def test_parts_of_one_file_are_stretches_of_its_longer_side(tmp_path):
    facts = ready_facts("own_scan")
    points = random_points(200)
    points[:, 0] %= 10
    points[:, 1] = np.linspace(0, 100, 200)
    write_las(tmp_path / "a.laz", PointCloud(points, {"intensity": np.arange(200, dtype=np.uint16)}))
    parts = []
    for i, stretch in enumerate([(0, 0.6), (0.6, 0.75), (0.75, 1)]):
        folder = tmp_path / str(i)
        import_main()([str(tmp_path / "a.laz")], str(folder / "map.laz"), str(folder / "truth" / "labels.npy"), facts, stretch)
        parts.append(read_las(folder / "map.laz").fields["intensity"].tolist())
        assert len(np.load(folder / "truth" / "labels.npy")) == len(parts[-1])
    assert [*parts[0], *parts[1], *parts[2]] == list(range(200))
    assert [len(p) for p in parts] == [120, 30, 50]
    with pytest.raises(BadInput, match="no point in the stretch"):
        import_main()([str(tmp_path / "a.laz")], str(tmp_path / "b.laz"), str(tmp_path / "b.npy"), facts, (0.501, 0.502))


def test_a_map_in_degrees_is_suspected(tmp_path, caplog):
    points = random_points(50) * [1e-6, 1e-6, 1] + [19.05, 47.5, 0]
    write_las(tmp_path / "a.laz", PointCloud(points, {"intensity": np.zeros(50, np.uint16)}))
    run(tmp_path, [tmp_path / "a.laz"], ready_facts("own_scan"))
    assert any("degrees" in r.getMessage() for r in caplog.records)
