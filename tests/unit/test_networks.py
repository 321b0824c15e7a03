"""What calibrate_segmenter found, as tables and figures beside the thesis' Tables 2.1 and 2.2."""

import numpy as np
import pandas as pd
import pytest

from streetscan.benchmarks import networks
from streetscan.benchmarks.scores import Evaluation, collect_scores
from streetscan.benchmarks.tables import make_tables

FACTS = {
    "dataset": "city",
    "method": "c2cnn",
    "seed": 1,
    "map": "city",
    "size_m": 0.1,
    "k": 23,
    "is_labelled": False,
    "is_tuned": True,
    "is_refined": False,
    "is_point": True,
}


def scores(f):
    rows = [
        (stage, p, "overall", "calibration_error", gap, "%", 900)
        for stage, gap in (("trained", 9.0), ("calibrated", 2.0))
        for p in ("even", "natural")
    ]
    rows += [("calibrated", "even", "objects", m, f, "%", 700) for m in ("precision", "recall", "f")]
    rows += [("calibrated", "natural", "overall", m, f + 5, "%", 900) for m in ("f", "accuracy")]
    rows += [("calibrated", "natural", "part", "n_voxels", 1e6, "", 50), ("calibrated", "natural", "part", "n_occupied", 5e4, "", 50)]
    rows += [("calibrated", "natural", "overall", "temperature", 1.6, "", 900)]
    return pd.DataFrame(rows, columns=["stage", "protocol", "class", "metric", "value", "unit", "n"])


def reliability():
    bins = {"confidence": [0.25, 0.75], "accuracy": [0.2, 0.6], "n": [10.0, 90.0]}
    return pd.concat([pd.DataFrame(bins).assign(stage=s, protocol=p) for s in ("trained", "calibrated") for p in ("even", "natural")])


@pytest.fixture
def files(tmp_path):
    """Three points of the tables, one of them off both, and a labelled map's network."""
    known = [FACTS, FACTS | {"dataset": "city_20cm", "size_m": 0.2}, FACTS | {"method": "c2cnn_k7", "k": 7}]
    known += [FACTS | {"dataset": "city_20cm", "method": "c2cnn_k7", "size_m": 0.2, "k": 7}]
    known += [
        FACTS | {"method": "c2cnn_local", "is_point": False},
        FACTS | {"method": "og_cnn", "is_labelled": True, "is_tuned": False, "is_point": False},
    ]
    inputs = {"network_scores": [], "network_reliabilities": [], "refinements": []}
    for i, _ in enumerate(known):
        for name, table in (("network_scores", scores(80.0 + i)), ("network_reliabilities", reliability())):
            inputs[name].append(str(tmp_path / f"{name}_{i}.csv"))
            table.to_csv(inputs[name][-1], index=False)
    return inputs, known


def test_points_stand_in_the_tables_they_belong_to(files):
    table = pd.DataFrame(networks.all_scores(*files, []))
    f = table[table["column"].str.endswith(" f")].set_index(["table", "row", "column"])["ours"]
    assert f["nagy_2_1"].to_dict() == {("0.1", "c2cnn f"): 80, ("0.2", "c2cnn f"): 81}
    assert f["nagy_2_2"].to_dict() == {("23", "c2cnn f"): 80, ("7", "c2cnn f"): 82}
    assert f["parameters"].to_dict() == {("0.1", "k_23 f"): 80, ("0.2", "k_23 f"): 81, ("0.1", "k_7 f"): 82, ("0.2", "k_7 f"): 83}
    counts = table[(table["table"] == "nagy_2_1") & (table["row"] == "0.1")].set_index("column")
    assert counts.loc["c2cnn n_voxels", ["ours", "paper"]].tolist() == [1e6, "6500000"]
    assert counts.loc["c2cnn n_occupied", ["ours", "paper"]].tolist() == [5e4, ""]
    assert set(table.loc[table["table"] == "tuning", "row"]) == {
        "city/c2cnn",
        "city_20cm/c2cnn",
        "city/c2cnn_k7",
        "city_20cm/c2cnn_k7",
        "city/c2cnn_local",
    }


def test_confidence_of_networks_and_maps(files):
    found = pd.DataFrame(
        {"protocol": ["even", "natural"], "class": "overall", "metric": "calibration_error", "value": [4.0, 1.0], "unit": "%", "n": 90}
    )
    rows = networks.all_scores(*files, [Evaluation("city", "og_cnn", 1, found, None)])
    table = pd.DataFrame([r for r in rows if r["table"] == "confidence"])
    assert set(table["row"]) == {"city/og_cnn"}
    expected = {"validation_trained": 9.0, "validation_calibrated": 2.0, "test_even": 4.0, "test_natural": 1.0}
    assert table.set_index("column")["ours"].to_dict() == {f"{k} calibration_error": v for k, v in expected.items()}


def test_tables_are_printed_with_the_papers_beside(files):
    printed = {t.name: t for t in make_tables(collect_scores([], {}, networks.all_scores(*files, [])))}
    assert {"nagy_2_1_city", "nagy_2_2_city", "parameters_city", "tuning", "confidence"} == set(printed)
    row = printed["nagy_2_1_city"].rows.index("0.1")
    cells = [printed["nagy_2_1_city"].text(row, j) for j in range(len(printed["nagy_2_1_city"].columns))]
    assert "80.0 / 90.3" in cells


def test_seeds_are_averaged_and_the_counts_of_the_map_are_not(tmp_path):
    known = [FACTS | {"seed": seed, "is_labelled": True} for seed in (1, 2, 3)]
    inputs = {"network_scores": [], "network_reliabilities": [], "refinements": []}
    for i, _ in enumerate(known):
        for name, table in (("network_scores", scores(80.0 + i)), ("network_reliabilities", reliability())):
            inputs[name].append(str(tmp_path / f"{name}_{i}.csv"))
            table.to_csv(inputs[name][-1], index=False)
    table = collect_scores([], {}, networks.all_scores(inputs, known, []))
    found = table[table["method"] == "c2cnn"].set_index(["table", "row", "column"])
    assert found.loc[("nagy_2_1", "0.1", "c2cnn f"), ["ours", "spread", "seed"]].tolist() == [81, 1, "1;2;3"]
    assert found.loc[("tuning", "city/c2cnn", "validation_even f"), ["ours", "spread"]].tolist() == [81, 1]
    assert np.isnan(found.loc[("nagy_2_1", "0.1", "c2cnn n_voxels"), "spread"])
    (section,) = networks.draw_networks(tmp_path / "figures", inputs, known)
    assert len(section.figures) == 1


def test_what_turns_and_smoothing_gain_and_cost(files, tmp_path):
    inputs, known = files
    known = [*known[:-1], known[-1] | {"is_refined": True}]
    rows = [
        (n_turns, is_smoothed, *figure, 9)
        for n_turns in (1, 4)
        for is_smoothed in (False, True)
        for figure in (
            ("even", "objects", "f", 70.0 + n_turns, "%"),
            ("even", "car", "f", 1.0, "%"),
            ("natural", "overall", "accuracy", 80.0 + is_smoothed, "%"),
            ("natural", "part", "time", 10.0 * n_turns, "s"),
        )
    ]
    columns = ["n_turns", "is_smoothed", "protocol", "class", "metric", "value", "unit", "n"]
    pd.DataFrame(rows, columns=columns).to_csv(tmp_path / "refinements.csv", index=False)
    found = pd.DataFrame(networks.all_scores(inputs | {"refinements": [str(tmp_path / "refinements.csv")]}, known, []))
    table = found[found["table"] == "refinement"].set_index(["row", "column"])["ours"]
    assert table["city/og_cnn/turns_4"].to_dict() == {"validation_even f": 74, "validation_natural accuracy": 80, "time": 40}
    assert table["city/og_cnn/turns_1_smoothed", "validation_natural accuracy"] == 81
    assert len(table) == 12


def test_reliability_is_drawn_for_labelled_maps(files, tmp_path):
    (section,) = networks.draw_networks(tmp_path / "figures", *files)
    (picture,) = section.figures
    assert "temperature 1.60" in picture.caption
    assert (tmp_path / "figures" / "reliability_city_og_cnn.pdf").is_file()
    inputs, known = files
    no_map = [k for k in known if not k["is_labelled"]]
    assert networks.draw_networks(tmp_path, {name: paths[: len(no_map)] for name, paths in inputs.items()}, no_map) == []
