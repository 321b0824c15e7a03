"""The facts of every data set we come with are sound, and every mistake in such a file is named."""

from pathlib import Path

import pytest
import yaml

from streetscan.classes import LABELS, NAMES
from streetscan.datasets import load_dataset, parse_facts
from streetscan.errors import BadInput

CONFIG = Path(__file__).resolve().parents[2] / "config"
SCHEMA = CONFIG / "dataset.schema.yaml"
READY = ["oakland", "city_mls", "paris_rue_madame", "terramobilita", "paris_lille_3d", "toronto_3d", "semantic3d", "tls_velodyne"]


def oakland_facts():
    return yaml.safe_load((CONFIG / "datasets" / "oakland.yaml").read_text())


def write_facts(folder, facts, name="oakland"):
    path = folder / f"{name}.yaml"
    path.write_text(facts if isinstance(facts, str) else yaml.safe_dump(facts, sort_keys=False))
    return path


def load(folder, facts, name="oakland"):
    return load_dataset(write_facts(folder, facts, name), SCHEMA)


@pytest.mark.parametrize("path", sorted((CONFIG / "datasets").glob("*.yaml")), ids=lambda path: path.stem)
def test_every_file_of_ours_is_sound(path):
    dataset = load_dataset(path)
    assert dataset.name == path.stem
    assert set(dataset.class_map.values()) <= set(LABELS)
    assert (dataset.reader is None) == (dataset.source == "simulate")


@pytest.mark.parametrize("name", READY)
def test_ready_made_sets_have_a_row_of_table_1_2(name):
    published = load_dataset(CONFIG / "datasets" / f"{name}.yaml").published
    assert published.organisation
    assert published.sensor
    assert 2009 <= published.year <= 2020
    assert published.n_points >= 700_000
    assert published.n_classes >= 5
    assert published.citation


def test_oakland_in_detail():
    dataset = load_dataset(CONFIG / "datasets" / "oakland.yaml")
    assert dataset.class_map[1303] == "column"
    assert dataset.class_map[1301] == "ground"
    assert dataset.groups["Vehicle"] == ("car", "tram_bus")
    assert list(dataset.groups) == ["Vegetation", "Ground", "Facade", "Pole-like", "Vehicle", "Street furniture"]
    assert [len(dataset.part(name).files) for name in ("train", "validation", "test")] == [6, 2, 2]


def test_city_mls_has_our_nine_classes():
    dataset = load_dataset(CONFIG / "datasets" / "city_mls.yaml")
    assert tuple(dataset.class_map[i] for i in range(9)) == NAMES


def test_files_are_found_below_data_root(tmp_path):
    dataset = load(tmp_path, oakland_facts())
    with pytest.raises(BadInput, match=r"oakland_part2_ac.*no such file, named in part 'test' of data set 'oakland'; set data_root"):
        dataset.files("test", tmp_path)
    for name in dataset.part("test").files:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    assert dataset.files("test", tmp_path) == [tmp_path / name for name in dataset.part("test").files]
    with pytest.raises(BadInput, match="has no part 'all'; use one of train, validation, test"):
        dataset.part("all")


def set_key(facts, keys, value):
    for key in keys[:-1]:
        facts = facts[key]
    facts[keys[-1]] = value


@pytest.mark.parametrize(
    ("keys", "value", "message"),
    [
        (("colour",), 1, "unknown key 'colour'; use one of name, title"),
        (("reader", "colums"), ["x"], "unknown key 'reader.colums'; did you mean 'columns'"),
        (("parts", "testing"), {"files": ["a"], "n_tiles": 1}, "unknown key 'parts.testing'; did you mean 'test'"),
        (("parts", "test", "tiles"), 3, "unknown key 'parts.test.tiles'; did you mean 'n_tiles'"),
        (("published", "sensors"), "x", "unknown key 'published.sensors'; did you mean 'sensor'"),
        (("truth",), "label", "key 'truth': 'label' is not one of"),
        (("parts", "test", "n_tiles"), "2", "key 'parts.test.n_tiles'"),
        (("parts", "test", "n_tiles"), 0, "key 'parts.test.n_tiles'"),
        (("reader", "format"), "e57", "key 'reader.format': 'e57' is not one of"),
        (("reader", "fields"), {"rgb": ["r", "g"]}, "key 'reader.fields.rgb'"),
        (("class_map", 1400), "house", "key 'class_map.1400': 'house' is not one of"),
        (("class_map", "wall"), "facade", "class_map has the id 'wall'; give class ids as integers"),
        (("name",), "oak", "name is 'oak'; set it to 'oakland'"),
        (("parts", "all"), {"files": ["a"], "n_tiles": 1}, "parts has 'all' beside 'train'"),
        (("parts", "test", "files"), ["oakland/oakland_part2_ad.xyz_label_conf.xz"], "oakland_part2_ad.xyz_label_conf.xz' twice"),
        (("reader", "label"), None, "truth is 'labels' but the reader has none"),
        (("reader", "label_suffix"), ".labels", "names both label and label_suffix"),
        (("truth",), "none", "truth is 'none' but the reader reads labels"),
        (("class_map",), {}, "class_map is empty"),
        (("reader", "fields"), {"kind": "label"}, "reader.fields.kind: would put the true labels into the map"),
        (("reader", "fields"), {"label": "confidence"}, "reader.fields.label: is a name the map keeps for itself"),
        (("reader", "fields"), {"scan_angle": "confidence"}, "reader.fields.scan_angle: is a name the map keeps for itself"),
        (("reader", "fields"), {"a" * 40: "confidence"}, "is a name LAZ cannot hold"),
        (("reader", "intensity_range"), [300, 0], "reader.intensity_range: is [300, 0]"),
        (("reader", "delimiter"), "", "reader.delimiter: is empty"),
        (("reader", "offset_m"), [float("nan"), 0, 0], "key 'reader.offset_m.0' is infinite or not a number"),
        (("groups", "Ground"), ["ground", "facade"], "groups has a class twice"),
    ],
)
def test_mistakes_are_named(tmp_path, keys, value, message):
    facts = oakland_facts()
    set_key(facts, keys, value)
    with pytest.raises(BadInput) as error:
        load(tmp_path, facts)
    assert message in str(error.value)


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        (("title",), "the key 'title' is missing; add it (the name printed in tables and figures)"),
        (("reader",), "the key 'reader' is missing"),
        (("reader", "label"), "the key 'reader.label' is missing"),
        (("reader", "columns"), "the key 'reader.columns' is missing"),
        (("parts", "train", "files"), "the key 'parts.train.files' is missing"),
    ],
)
def test_missing_keys_are_named(tmp_path, keys, message):
    facts = oakland_facts()
    section = facts
    for key in keys[:-1]:
        section = section[key]
    del section[keys[-1]]
    with pytest.raises(BadInput) as error:
        load(tmp_path, facts)
    assert message in str(error.value)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"merge": None}, "'merge' is missing"),
        ({"reader": None}, "'reader' is missing"),
        ({"truth": "labels"}, "truth"),
        ({"merge": {"drive": "kitti_0001"}}, "merge.registrar"),
        ({"parts": {"test": {"n_tiles": 1}}}, "parts"),
    ],
)
def test_a_merged_drive_is_a_map_without_truth(tmp_path, change, message):
    facts = yaml.safe_load((CONFIG / "datasets" / "kitti_0001_street.yaml").read_text())
    assert load(tmp_path, facts, "kitti_0001_street").source == "merge"
    changed = {key: value for key, value in (facts | change).items() if value is not None}
    with pytest.raises(BadInput, match=message):
        load(tmp_path, changed, "kitti_0001_street")


def test_what_is_no_facts_at_all(tmp_path):
    with pytest.raises(BadInput, match=r"no\.yaml: no such file"):
        load_dataset(tmp_path / "no.yaml", SCHEMA)
    with pytest.raises(BadInput, match="not readable as YAML in line 2"):
        load(tmp_path, "name: a\n\ttitle: b\n")
    with pytest.raises(BadInput, match=r"in line 3: the key '1' occurs twice"):
        load(tmp_path, "class_map:\n  1: ground\n  1: facade\n")
    with pytest.raises(BadInput, match="holds no keys"):
        load(tmp_path, "")


def test_parse_facts_checks_what_the_schema_does_not_see():
    facts = oakland_facts()
    facts["class_map"][1400] = "house"
    with pytest.raises(BadInput, match=r"class_map\.1400 is 'house', which is no class; use one of ground"):
        parse_facts(facts)


def test_the_schema_describes_and_closes_every_level():
    def walk(node, place):
        if isinstance(node, dict):
            if "properties" in node and node.get("type") == "object":
                assert node["additionalProperties"] is False, place
                for name, child in node["properties"].items():
                    assert "description" in child, f"{place}.{name}"
            assert "default" not in node, place
            for key, child in node.items():
                walk(child, f"{place}.{key}")
        elif isinstance(node, list):
            for i, child in enumerate(node):
                walk(child, f"{place}[{i}]")

    walk(yaml.safe_load(SCHEMA.read_text()), "schema")


def test_a_static_scan_is_of_the_streets_it_names():
    files = {path.stem: yaml.safe_load(path.read_text()) for path in (CONFIG / "datasets").glob("*.yaml")}
    static = {name: facts for name, facts in files.items() if "static_scanner" in facts.get("simulation", {})}
    assert "city_tls" in static
    for name, facts in static.items():
        mobile = files[facts["same_streets_as"]]
        # Lengths, slopes and seeds shape the streets; any difference would make them others.
        assert {p: v["length_m"] for p, v in facts["parts"].items()} == {p: v["length_m"] for p, v in mobile["parts"].items()}, name
        assert facts["simulation"]["street"] == mobile["simulation"]["street"], name


@pytest.mark.parametrize("missing", ["scanners", "n_rounds", "errors"])
def test_a_simulation_needs_a_mobile_mapper_or_a_static_scanner(missing, tmp_path):
    facts = yaml.safe_load((CONFIG / "datasets" / "city.yaml").read_text())
    del facts["simulation"][missing]
    with pytest.raises(BadInput, match=missing):
        load(tmp_path, facts, "city")
    facts["simulation"]["static_scanner"] = {"spacing_m": 40}
    load(tmp_path, facts, "city")


def test_parts_may_share_a_file_when_their_stretches_do_not_meet(tmp_path):
    facts = oakland_facts()
    facts["parts"] = {
        "train": {"files": ["a"], "n_tiles": 1, "stretch": [0, 0.6]},
        "validation": {"files": ["a"], "n_tiles": 1, "stretch": [0.6, 0.7]},
        "test": {"files": ["a"], "n_tiles": 1, "stretch": [0.7, 1]},
    }
    assert load(tmp_path, facts).part("validation").stretch == (0.6, 0.7)
    for stretch, message in (([0.6, 0.71], "validation and test"), ([0.6, 0.6], "lower and a higher"), ([0.6], "stretch")):
        facts["parts"]["validation"]["stretch"] = stretch
        with pytest.raises(BadInput, match=message):
            load(tmp_path, facts)
    facts["parts"]["validation"] = {"files": ["a", "b"], "n_tiles": 1, "stretch": [0.6, 0.7]}
    with pytest.raises(BadInput, match="no other files"):
        load(tmp_path, facts)


def test_a_folder_is_no_file(tmp_path):
    (tmp_path / "oakland").mkdir()
    facts = oakland_facts()
    facts["parts"]["test"]["files"] = ["oakland"]
    with pytest.raises(BadInput, match="is a folder"):
        load(tmp_path, facts).files("test", tmp_path)
