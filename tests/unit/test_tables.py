"""Tables against hand-written Markdown, LaTeX and CSV."""

import math

import pandas as pd
import pytest

from streetscan.benchmarks.scores import SCORE_COLUMNS, add_paper_rows, make_score
from streetscan.benchmarks.tables import (
    escape_latex,
    format_number,
    make_tables,
    pivot,
    split_column,
    to_csv,
    to_latex,
    to_markdown,
    write_tables,
)

NAN = math.nan


def scores(rows):
    return pd.DataFrame(rows, columns=list(SCORE_COLUMNS))


@pytest.fixture
def small():
    """Two methods of ours on two classes; the second has no car; one method of the paper's alone."""
    rows = [
        make_score("nagy_2_3", row, column, metric, ours, "%", 100, "my_street", column, 1)
        for row, column, metric, ours in [
            ("phantom", "c2cnn", "recall", 90.04),
            ("phantom", "c2cnn", "f", 88.0),
            ("car", "c2cnn", "recall", 91.0),
            ("car", "c2cnn", "f", NAN),
            ("phantom", "og_cnn", "f", 50.26),
            ("car", "og_cnn", "f", 60.0),
        ]
    ]
    rows += [
        make_score("nagy_2_3", row, "multi_view", m, NAN, "%", dataset="my_street") for row in ("phantom", "car") for m in ("f", "recall")
    ]
    return scores(rows)


def test_markdown(small):
    assert to_markdown(pivot(small, "nagy_2_3", "my_street")) == (
        "| Class | C²CNN Rc | C²CNN F | OG-CNN F | Multi-view F (paper) |\n"
        "| --- | ---: | ---: | ---: | ---: |\n"
        "| Phantom | 90.0 / 85.9 | **88.0** / 85.1 | 50.3 / 49.3 | 56.9 |\n"
        "| Car | 91.0 / 88.7 | – / 87.5 | 60.0 / 69.2 | 66.1 |\n"
        "\n"
        "*Voxel-level precision, recall and F per class on the class-even test set, in % (Thesis, Table 2.3). Ours: data set "
        "my_street; n = 100. Cells read ours / paper, measured on SZTAKI CityMLS. Overall figures leave ground and facade out, as in "
        "the thesis: the plain mean of the seven classes, and the mean weighted by their occurrence in the test part.*\n"
    )


def test_latex(small):
    lines = to_latex(pivot(small, "nagy_2_3", "my_street")).splitlines()
    assert lines[:3] == ["% needs \\usepackage{booktabs}", "\\begin{table}", "\\centering"]
    assert lines[3].startswith("\\caption{Voxel-level precision, recall and F per class on the class-even test set, in \\% (Thesis")
    assert "my\\_street" in lines[3]
    assert lines[4:] == [
        "\\label{tab:nagy_2_3_my_street}",
        "\\begin{tabular}{lrrrr}",
        "\\toprule",
        " & \\multicolumn{2}{c}{C\\textsuperscript{2}CNN} & \\multicolumn{1}{c}{OG-CNN} & \\multicolumn{1}{c}{Multi-view (paper)} \\\\",
        "\\cmidrule(lr){2-3} \\cmidrule(lr){4-4} \\cmidrule(lr){5-5}",
        "Class & Rc & F & F & F \\\\",
        "\\midrule",
        "Phantom & 90.0 / 85.9 & \\textbf{88.0} / 85.1 & 50.3 / 49.3 & 56.9 \\\\",
        "Car & 91.0 / 88.7 & -- / 87.5 & 60.0 / 69.2 & 66.1 \\\\",
        "\\bottomrule",
        "\\end{tabular}",
        "\\end{table}",
    ]


def test_csv_keeps_ids_and_digits(small):
    assert to_csv(pivot(small, "nagy_2_3", "my_street")) == (
        "row,c2cnn recall,c2cnn recall (paper),c2cnn f,c2cnn f (paper),og_cnn f,og_cnn f (paper),multi_view f (paper),n\n"
        "phantom,90.04,85.9,88,85.1,50.26,49.3,56.9,100\n"
        "car,91,88.7,,87.5,60,69.2,66.1,100\n"
    )


def test_rows_follow_the_paper_and_unequal_n_gets_a_column():
    rows = [
        make_score("nagy_2_3", row, "c2cnn", "f", 80.0, "%", n, "city", "c2cnn", 1)
        for row, n in (("overall", 12345), ("furniture", 20), ("phantom", 1000))
    ]
    table = pivot(scores(rows), "nagy_2_3", "city")
    assert table.rows == ["Phantom", "Furniture", "Overall"]
    assert table.n == ["1000", "20", "12\u202f345"]
    # One metric in all columns: the method alone is the heading.
    assert [c.heading for c in table.columns] == ["C²CNN"]
    assert "| Overall | 80.0 / 90.3 | 12\u202f345 |" in to_markdown(table)


def test_rows_of_one_side_show_one_figure():
    rows = [
        make_score("nagy_1_2", "city", "", "n_points", 21_345_678.0, "", dataset="city", method="data"),
        make_score("nagy_1_2", "city", "", "sensor", "a & b", "", dataset="city", method="data"),
        make_score("nagy_1_2", "oakland", "", "n_points", NAN, ""),
        make_score("nagy_1_2", "oakland", "", "sensor", NAN, ""),
    ]
    table = pivot(scores(rows), "nagy_1_2")
    text = to_markdown(table)
    assert "| Oakland (paper) | 1.6M | SICK LMS (MLS) |" in text
    assert "| City | 21\u202f345\u202f678 | a & b |" in text
    assert "| --- | ---: | --- |" in text
    assert r"a \& b" in to_latex(table)


def test_spread_and_seeds_are_told():
    row = make_score("nagy_2_3", "car", "c2cnn", "f", 80.0, "%", 5, "city", "c2cnn", "1;2;3") | {"spread": 0.44}
    table = pivot(scores([row]), "nagy_2_3", "city")
    assert table.text(0, 0) == "80.0 ± 0.4 / 87.5"
    assert "mean ± standard deviation over the seeds 1, 2, 3" in table.caption
    assert r"80.0 $\pm$ 0.4 / 87.5" in to_latex(table)


def test_units_of_their_own_stand_in_headings():
    rows = [
        make_score("nagy_3_1", "overall", "c2cnn", m, v, u, 60, "city", "c2cnn", 1)
        for m, v, u in (("translation_error", 0.213, "m"), ("rotation_error", 0.6, "deg"))
    ]
    table = pivot(scores(rows), "nagy_3_1", "city")
    assert [c.heading for c in table.columns] == ["s [m]", "rot [°]"]
    assert [table.text(0, j) for j in range(2)] == ["0.21 / 0.37", "0.60 / 1.18"]


def test_best_is_of_ours_and_ties_are_shared_or_silent():
    def cells(a, b, metric="f"):
        rows = [make_score("nagy_2_3", "car", c, metric, v, "%", 1, "city", c, 1) for c, v in (("c2cnn", a), ("og_cnn", b))]
        return [c.is_best for c in pivot(scores(rows), "nagy_2_3", "city").cells[0]]

    assert cells(80.0, 79.9) == [True, False]
    assert cells(80.01, 80.02) == [False, False]
    assert cells(80.0, NAN) == [False, False]
    lower = [make_score("nagy_3_1", "overall", c, "translation_error", v, "m", 1, "d", c, 1) for c, v in (("raw", 1.0), ("c2cnn", 0.2))]
    assert [c.is_best for c in pivot(scores(lower), "nagy_3_1", "d").cells[0]] == [False, True]


@pytest.mark.parametrize(
    ("value", "unit", "text"),
    [
        (NAN, "%", "–"), (None, "m", "–"), ("", "", "–"), ("88.8.1", "", "88.8.1"), ("~7", "m", "≈7"), (90.25, "%", "90.2"),
        (0.98351, "fraction", "0.984"), (6042.0, "", "6042"), (812500.0, "", "812\u202f500"), (2009.0, "year", "2009"),
        (0.32091, "s", "0.321"), (153.4, "s", "153"), (12345.6, "s", "12\u202f346"), (-3.0, "px", "-3.00"),
        (0.0, "", "0"), (14.96, "fps", "15.0"),
    ],
)  # fmt: skip
def test_numbers(value, unit, text):
    assert format_number(value, unit) == text


def test_latex_is_escaped_once():
    assert escape_latex("a_b & 5 % {x} \\ ~ ^ # $") == (r"a\_b \& 5 \% \{x\} \textbackslash{} \textasciitilde{} \textasciicircum{} \# \$")


def test_pipes_do_not_break_markdown():
    row = make_score("nagy_1_2", "city", "", "sensor", "a|b", "", dataset="city", method="data")
    assert "| City | a\\|b |" in to_markdown(pivot(scores([row]), "nagy_1_2"))


def test_columns_split():
    assert split_column("splatnet_xyz f") == ("splatnet_xyz", "f")
    assert split_column("n_scans") == ("", "n_scans")


def test_one_table_per_data_set_but_for_tables_across(small, tmp_path):
    other = small.assign(dataset="b")
    facts = scores([make_score("nagy_1_2", d, "", "year", 2020.0, "year", dataset=d, method="data") for d in ("city", "b")])
    made = make_tables(pd.concat([facts, small, other]))
    assert [t.name for t in made] == ["nagy_1_2", "nagy_2_3_my_street", "nagy_2_3_b"]
    write_tables(tmp_path / "tables", made)
    assert len(list((tmp_path / "tables").iterdir())) == 9


def test_single_figures_are_listed_one_by_one():
    """They share no columns: one line each, ours first, those of the paper alone once."""
    figures = ("b", 0.5, 3), ("a", 2.0, 4)
    ours = [make_score("nagy_text", "sfm_reprojection", "proposed", "error", v, "px", n, d, "sfm") for d, v, n in figures]
    (table,) = make_tables(add_paper_rows(scores(ours)))
    assert [c.heading for c in table.columns] == ["Figure", "Data set", "Value"]
    lines = to_markdown(table).splitlines()
    assert lines[2] == "| Reprojection error of images | Proposed: Error | B | 0.50 px / 1.02 px | 3 |"
    assert lines[3] == "| Reprojection error of images | Proposed: Error | A | 2.00 px / 1.02 px | 4 |"
    assert "| Voxels of a dense grid (paper) | Proposed: voxels | – | 562500 | – |" in lines
    assert sum(row.startswith("Reprojection error") for row in table.rows) == 2
    assert to_csv(table).splitlines()[1] == "sfm_reprojection,proposed error,b,px,0.5,1.02,3"
    assert r"0.50 px / 1.02 px" in to_latex(table)


def test_missing_table_is_said(small):
    with pytest.raises(KeyError, match="jozsa_1"):
        pivot(small, "jozsa_1")
    assert make_tables(scores([])) == []
