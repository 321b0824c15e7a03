"""Config and data set files: complete, described, and refused when misspelt."""

import re
from dataclasses import replace

import pytest
import yaml
from dag import HOME, snakemake

from streetscan.calibration.drive_calibration import DriveCalibrationSettings
from streetscan.calibration.keyframe_calibration import CalibrationSettings
from streetscan.calibration.keyframes import KeyframeSettings
from streetscan.calibration.reconstruction import ReconstructionSettings, make_reconstruction_settings
from streetscan.localization.settings import build
from streetscan.registration.grid_classes import GridSettings
from streetscan.registration.merging import MergeSettings, make_merge_settings
from streetscan.registration.odometry import OdometrySettings, make_settings

SCHEMAS = sorted((HOME / "config").glob("*schema.yaml"))


def objects(schema: dict, path: str = ""):
    """Every object of a schema with its path."""
    if schema.get("type") == "object" or "properties" in schema:
        yield path, schema
    for key in ("properties", "$defs", "patternProperties"):
        for name, child in schema.get(key, {}).items():
            yield from objects(child, f"{path}/{name}")
    for key in ("items", "additionalProperties"):
        if isinstance(schema.get(key), dict):
            yield from objects(schema[key], f"{path}/{key}")


FAR = {"weights": "shipped_far", "initial": None}


@pytest.mark.parametrize("path", SCHEMAS, ids=lambda p: p.stem)
def test_schema_is_closed_and_described(path):
    for place, schema in objects(yaml.safe_load(path.read_text())):
        assert schema.get("additionalProperties") is not None, f"{place} allows unknown keys"
        assert schema["additionalProperties"] is False or isinstance(schema["additionalProperties"], dict), place
        for name, child in schema.get("properties", {}).items():
            assert child.get("description") or "$ref" in child, f"{place}/{name} has no description"
            assert "default" not in child, f"{place}/{name}: values live in default.yaml alone"


# Sections that describe things by name rather than a step.
NAMED = {"first_run", "voxel_variants", "models", "registrars", "localizers", "image_detectors", "lidar_detectors"}


def test_every_section_is_a_step():
    config = yaml.safe_load((HOME / "config" / "default.yaml").read_text())
    rules = set(re.findall(r"^rule (\w+):", "".join(p.read_text() for p in (HOME / "rules").glob("*.smk")), re.MULTILINE))
    sections = {name for name, value in config.items() if isinstance(value, dict)} - NAMED
    assert sections <= rules
    for rule in rules:
        assert (HOME / "scripts" / f"{rule}.py").is_file(), rule
        assert (HOME / "tests" / "scripts" / f"test_{rule}.py").is_file(), rule


def test_settings_of_registration_are_the_library_s():
    """Benchmarks and tests use the library's defaults; the workflow's are written out in the config."""
    config = yaml.safe_load((HOME / "config" / "default.yaml").read_text())
    assert GridSettings(**config["segment_frames"]["grid"]) == GridSettings()
    assert make_settings(config["register_frames"]["settings"]) == OdometrySettings()
    merging = make_merge_settings(config["merge_frames"])
    assert merging == replace(MergeSettings(), classes=merging.classes)


def test_settings_of_keyframes_are_the_library_s():
    config = yaml.safe_load((HOME / "config" / "default.yaml").read_text())
    assert KeyframeSettings(**config["choose_keyframes"]["settings"]) == KeyframeSettings()
    assert make_reconstruction_settings(config["reconstruct_keyframe"]["settings"]) == ReconstructionSettings()
    assert build(CalibrationSettings, config["calibrate_keyframe"]["settings"], "calibrate_keyframe") == CalibrationSettings()
    assert DriveCalibrationSettings(**config["calibrate_drive"]) == DriveCalibrationSettings()


def test_scripts_are_thin():
    for path in (HOME / "scripts").glob("*.py"):
        assert len(path.read_text().splitlines()) <= 60, path.name


@pytest.mark.parametrize(
    ("override", "key"),
    [({"voxelize_map": {"size": 0.1}}, "size"), ({"sed": 2}, "sed"), ({"models": {"c2cnn": {"chanels": []}}}, "chanels")],
)
def test_misspelt_key_is_named(override, key, tmp_path):
    path = tmp_path / "typo.yaml"
    path.write_text(yaml.safe_dump(override))
    result = snakemake("--dry-run", "--configfile", str(path), directory=tmp_path, check=False)
    assert result.returncode != 0
    output = result.stdout + result.stderr
    assert "unknown key" in output
    assert key in output
    assert len(output.splitlines()) < 20


SELF_STARTED = {"channels": ["count"], "weights": "own", "initial": "city_tiny/a", "schedule": {}}


@pytest.mark.parametrize(
    ("override", "named"),
    [
        ({"voxelize_map": {"size_m": 0}}, "voxelize_map.size_m"),
        ({"voxelize_map": {"size_m": -0.1}}, "voxelize_map.size_m"),
        ({"train_segmenter": {"network": {"k": 22}}}, "train_segmenter.network.k"),
        ({"voxelize_map": {"size_m": float("nan")}}, "voxelize_map.size_m"),
        ({"labelled_maps": ["city_tiny/nomodel"]}, "nomodel"),
        ({"labelled_maps": ["own_scan/c2cnn"]}, "own_scan"),
        ({"labelled_maps": ["amsterdam/c2cnn"]}, "amsterdam"),
        ({"labelled_maps": ["city_tiny/a"], "models": {"a": {**SELF_STARTED}}}, "starts from itself"),
        ({"registered_drives": ["nowhere/ndt_tall"]}, "nowhere.yaml"),
        ({"merged_drives": ["kitti_0001/icp"]}, "registrar 'icp'"),
        ({"registrars": {"ndt_tall": {"classes": ["walls"]}}}, "registrars.ndt_tall.classes"),
        ({"register_frames": {"settings": {"ndt": {"n_neighbours": 3}}}}, "register_frames.settings.ndt.n_neighbours"),
        ({"labelled_maps": ["oakland/c2cnn_shipped"], "data_root": "nowhere"}, "nowhere/oakland"),
        ({"voxel_variants": {"city": {"dataset": "city_tiny", "size_m": 0.2}}}, "voxel_variants: 'city'"),
        ({"tuned_models": ["city_tiny/c2cnn_shipped"]}, "no network trained on that data set"),
        ({"tuned_models": ["city_tiny/lightgbm"]}, "no network trained on that data set"),
        ({"refined_models": ["city_tiny/lightgbm"]}, "refined_models: 'city_tiny/lightgbm' is no network trained on that data set"),
        ({"labelled_maps": ["city_tiny/c2cnn_seed_x"]}, "model 'c2cnn_seed_x': what follows _seed_ is no whole number"),
        ({"labelled_maps": ["city_tiny/resnet_seed_2"]}, "model 'resnet' is not in the config"),
        (
            {
                "labelled_maps": ["city_tiny/far"],
                "models": {"far": {"channels": ["count"], "schedule": {}, **FAR}},
            },
            "'far' takes 'shipped_far', which does not come with streetscan; use shipped or shipped_wide.",
        ),
        (
            {"labelled_maps": ["city_tiny/c2cnn_shipped"], "voxelize_map": {"size_m": 0.05}},
            "the network 'shipped' is for voxels of 0.1 m, the map's have 0.05 m; set voxelize_map.size_m",
        ),
        ({"device": "tpu"}, "device"),
        ({"labelled_maps": ["city_tiny/c2cnn_shipped_seed_2"]}, "the shipped network is not trained again; use c2cnn_shipped."),
        ({"labelled_maps": ["city_tiny/c2cnn", "city_tiny/c2cnn_seed_1"]}, "'city_tiny/c2cnn' is named twice with seed 1"),
        ({"tuned_models": ["city_tiny/c2cnn_seed_02", "city_tiny/c2cnn_seed_2"]}, "'city_tiny/c2cnn' is named twice with seed 2"),
        ({"thinned_models": ["city_tiny/lightgbm"]}, "thinned_models: 'city_tiny/lightgbm' is no network"),
        (
            {"thinned_models": ["own_scan/c2cnn_shipped"]},
            "is no network on a data set with labels",
        ),
        ({"models": {"c2cnn_seed_2": {**SELF_STARTED}}}, "c2cnn_seed_2 is not allowed"),
    ],
)
def test_impossible_value_is_named_in_one_sentence(override, named, tmp_path):
    path = tmp_path / "bad.yaml"
    path.write_text(yaml.safe_dump(override))
    result = snakemake("--dry-run", "--configfile", str(path), directory=tmp_path, check=False)
    output = result.stdout + result.stderr
    assert result.returncode != 0
    assert named in output
    assert "Traceback" not in output
    assert len(output.splitlines()) < 25


def test_unknown_data_set_is_named(tmp_path):
    path = tmp_path / "unknown.yaml"
    path.write_text("labelled_maps: [nowhere/c2cnn]\n")
    result = snakemake("--dry-run", "--configfile", str(path), directory=tmp_path, check=False)
    assert result.returncode != 0
    assert "nowhere.yaml" in result.stdout + result.stderr


@pytest.mark.parametrize(
    ("old", "new", "found"),
    [
        ("speed_kmh", "speed_kph", "speed_kmh"),
        ("place: main_road", "place: motorway", "'motorway' is not one of"),
        ("reader: simulate", "reader: [", "is no YAML"),
    ],
)
def test_a_mistake_in_a_drives_file_is_named_before_anything_runs(old, new, found, tmp_path):
    text = (HOME / "config" / "drives" / "city_tiny_main_road.yaml").read_text()
    (tmp_path / "mine.yaml").write_text(text.replace(old, new))
    result = snakemake("-n", "--config", f"drives_folder={tmp_path}", 'drives=["mine"]', directory=tmp_path, check=False)
    output = result.stdout + result.stderr
    assert result.returncode != 0
    assert found in output
    assert "mine.yaml" in output
    assert "Traceback" not in output


def test_a_drive_at_place_mapping_needs_a_street_mapped_from_a_vehicle(tmp_path):
    text = (HOME / "config" / "drives" / "city_mapping.yaml").read_text()
    (tmp_path / "mine.yaml").write_text(text.replace("dataset: city", "dataset: city_tls"))
    result = snakemake("-n", "--config", f"drives_folder={tmp_path}", 'drives=["mine"]', directory=tmp_path, check=False)
    assert "city_tls/test is not mapped from a vehicle" in result.stdout + result.stderr
