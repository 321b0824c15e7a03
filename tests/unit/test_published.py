"""The published figures: complete, as printed, and as consistent as the papers themselves."""

import math
import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from streetscan.benchmarks.published import caption, find_published, load_published, parse_number, title
from streetscan.errors import BadInput

CELLS = {
    "nagy_1_2": 7 * 7,
    "nagy_2_1": 7 * 4,
    "nagy_2_2": 11 * 3,
    "nagy_2_3": 8 * 6 * 3,
    "nagy_2_4": 6 * 6,
    "nagy_3_1": 6 * 3 * 2,
    "nagy_4_1": 4 * 2 * 4,
    "nagy_4_2": 3 * 4,
    "babahajiani_2": 5 * 3,
    "babahajiani_3": 7 * 2 * 2,
    "babahajiani_4": 7 * 7,
    "babahajiani_5": 2 * 3,
    "babahajiani_6": 8 * 8,
    "jozsa_1": 5 * 3,
    "jozsa_2": 12,
}


def wide(table, metrics=None):
    """number by (row, column, metric)."""
    content = load_published(table)
    return {(r.row, r.column, r.metric): r.number for r in content.itertuples() if metrics is None or r.metric in metrics}


@pytest.mark.parametrize(("table", "n"), CELLS.items())
def test_every_cell_is_there(table, n):
    content = load_published(table)
    assert len(content) == n
    assert not content.duplicated(["row", "column", "metric"]).any()
    assert (content["value"] != "").all()


def test_every_table_has_a_caption_and_a_source():
    content = load_published()
    for table in content["table"].unique():
        assert caption(table)["caption"]
    assert content["source_id"].map(lambda s: bool(re.fullmatch(r"N-\d{3}|B-\d{3}|R-\d{2}|J-\d{2}", s))).all()


def test_known_figures():
    assert find_published("nagy_2_3", "phantom", "c2cnn", "f") == ("85.1", "%")
    assert find_published("nagy_2_3", "phantom", "og_cnn", "recall") == ("34.7", "%")
    assert find_published("nagy_3_1", "overall", "c2cnn", "translation_error") == ("0.37", "m")
    assert find_published("nagy_4_1", "proposed", "fast", "y_mean") == ("3.14", "px")
    assert find_published("jozsa_1", "bartok_bela_3", "presegmented", "time") == ("0.0868", "s")
    assert find_published("babahajiani_5", "with_rules", "", "n_voxels") == ("32,891", "")
    assert find_published("nagy_2_3", "phantom", "ours", "f") is None


def test_misprints_stay_and_are_no_numbers():
    content = load_published("nagy_2_4")
    misprint = content[content["value"] == "88.8.1"].iloc[0]
    assert (misprint["row"], misprint["column"]) == ("ground", "og_cnn")
    assert math.isnan(misprint["number"])
    assert "X-03" in misprint["note"]
    assert load_published("nagy_2_4")["number"].isna().sum() == 1


@pytest.mark.parametrize(
    ("printed", "number"),
    [("0.91", 0.91), ("32,891", 32891), ("1.6M", 1.6e6), (">98", 98), ("<0.0001", 1e-4), ("~7", 7), ("4.0099*", 4.0099)],
)
def test_numbers_as_printed(printed, number):
    assert parse_number(printed) == number


@pytest.mark.parametrize("printed", ["88.8.1", "", "x, y, z", "unknown (TLS)", "-", "1e5"])
def test_text_is_no_number(printed):
    assert math.isnan(parse_number(printed))


@given(st.decimals(0, 10**6, places=3))
def test_plain_decimals_are_read_exactly(value):
    assert parse_number(f"{value:f}") == float(value)


@pytest.mark.parametrize("table", ["nagy_2_1", "nagy_2_2", "nagy_2_3"])
def test_f_is_the_harmonic_mean_of_what_is_printed(table):
    """Precision and recall are printed to 0.05 and may move F by as much; that explains the two cells X-02 names, too."""
    cells = wide(table)
    off = []
    for row, column, metric in cells:
        if metric != "f":
            continue
        p, r, f = (cells[row, column, m] for m in ("precision", "recall", "f"))
        low, high = (2 * (p + d) * (r + d) / (p + r + 2 * d) for d in (-0.05, 0.05))
        if not low - 0.05 <= f <= high + 0.05:
            off.append((row, column))
    assert off == []


def test_overall_rates_are_no_plain_means_of_the_rows():
    """The audit behind the weighting: only SPLATNet's overall rates are the plain mean of the seven rows."""
    cells = wide("nagy_2_3")
    rows = [r for r in dict.fromkeys(r for r, _, _ in cells) if r != "overall"]
    plain = {}
    for column in dict.fromkeys(c for _, c, _ in cells):
        gaps = [np.mean([cells[r, column, m] for r in rows]) - cells["overall", column, m] for m in ("precision", "recall")]
        plain[column] = max(map(abs, gaps)) < 0.06
    assert [c for c, same in plain.items() if same] == ["splatnet_xyz", "splatnet_xyz_rgb"]
    assert np.mean([cells[r, "c2cnn", "precision"] for r in rows]) == pytest.approx(88.4, abs=0.05)


def test_class_means_of_babahajiani_reproduce():
    for table, metrics, digits in (("babahajiani_2", ["accuracy"], 0.00051), ("babahajiani_3", ["precision", "f"], 0.0101)):
        cells = wide(table)
        rows = [r for r in dict.fromkeys(r for r, _, _ in cells) if r != "class_mean"]
        for column in {c for _, c, _ in cells}:
            for metric in metrics:
                mean = np.mean([cells[r, column, metric] for r in rows])
                assert mean == pytest.approx(cells["class_mean", column, metric], abs=digits), (table, column, metric)


def test_confusion_of_points_is_not_row_normalised():
    cells = load_published("babahajiani_4")
    sums = cells.groupby("row", sort=False)["number"].sum()
    assert sums.min() == pytest.approx(0.839, abs=0.001)
    assert sums.max() == pytest.approx(1.083, abs=0.001)
    assert load_published("babahajiani_6").groupby("row")["number"].sum().between(0.998, 1.001).all()


def test_voxel_counts_are_of_the_dense_volume():
    cells = wide("nagy_2_1", {"n_voxels"})
    for (size_m, _, _), n in cells.items():
        assert n == pytest.approx(6500 / float(size_m) ** 3, rel=0.01)


def test_scans_add_up():
    assert load_published("jozsa_2")["number"].sum() == 6042


def test_unknown_tables_are_named():
    with pytest.raises(BadInput, match="nagy_9_9"):
        load_published("nagy_9_9")
    with pytest.raises(BadInput, match="nagy_9_9"):
        caption("nagy_9_9")


def test_titles():
    assert title("c2cnn") == "C²CNN"
    assert title("tram_bus") == "Tram/Bus"
    assert title("city/og_cnn") == "City, OG-CNN"
    assert title("my_street") == "My street"
    assert title("0.1") == "0.1"
