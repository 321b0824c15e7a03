"""The tidy scores: rows out of evaluations, the paper's figures looked up, seeds averaged, files read back."""

import math

import numpy as np
import pandas as pd
import pytest

from streetscan.benchmarks.published import load_published
from streetscan.benchmarks.scores import (
    SCORE_COLUMNS,
    Evaluation,
    add_paper_rows,
    average_seeds,
    cleaning_scores,
    collect_scores,
    dataset_scores,
    grouped_scores,
    label_scores,
    make_score,
    natural_scores,
    read_confusion,
    read_evaluations,
    read_scores,
    write_scores,
)
from streetscan.classes import NAMES, PHANTOM, UNLABELLED
from streetscan.errors import BadInput
from streetscan.segmentation.metrics import evaluate_labels

GROUPS = {"Vegetation": ["vegetation"], "Pole-like": ["column"], "Vehicle": ["car", "tram_bus"], "Street furniture": ["furniture"]}


def evaluate(dataset="city", method="c2cnn", seed=1, groups=None, true=None, predicted=None):
    rng = np.random.default_rng(seed)
    if true is None:
        true = rng.integers(0, 9, 2000).astype(np.uint8)
        true[:20] = UNLABELLED
        predicted = np.where(rng.random(2000) < 0.8, true % 9, rng.integers(0, 9, 2000)).astype(np.uint8)
    scores, confusion = evaluate_labels(true, predicted, np.full(len(true), 0.9, np.float32), n_per_class=50, rng=rng, groups=groups)
    counts = np.zeros((9, 9), np.int64)
    for r in confusion[confusion["protocol"] == "natural"].itertuples():
        counts[NAMES.index(r.truth), NAMES.index(r.predicted)] = r.n
    return Evaluation(dataset, method, seed, scores, counts), scores, confusion


def found(rows, row, column):
    (match,) = [r for r in rows if (r["row"], r["column"]) == (row, column)]
    return match


def test_table_2_3_has_the_objects_and_both_weightings():
    evaluation, scores, _ = evaluate()
    rows = label_scores(evaluation)
    assert [r["row"] for r in rows if r["column"] == "c2cnn f"] == [*NAMES[2:], "overall", "overall_weighted"]
    even = scores[scores["protocol"] == "even"].set_index(["class", "metric"])["value"]
    for row, name in (("car", "car"), ("overall", "objects"), ("overall_weighted", "objects_weighted")):
        assert found(rows, row, "c2cnn f")["ours"] == even[name, "f"]
    assert found(rows, "car", "c2cnn recall")["paper"] == "88.7"
    assert found(rows, "overall", "c2cnn f")["paper"] == "90.3"
    assert found(rows, "overall_weighted", "c2cnn f")["paper"] == ""
    assert found(rows, "car", "c2cnn f")["n"] == 50
    assert {r["unit"] for r in rows} == {"%"}


def test_all_voxels_have_a_table_of_their_own():
    evaluation, scores, _ = evaluate()
    rows = natural_scores(evaluation)
    natural = scores[scores["protocol"] == "natural"].set_index(["class", "metric"])["value"]
    assert found(rows, "ground", "c2cnn iou")["ours"] == natural["ground", "iou"]
    assert found(rows, "all_classes", "c2cnn iou")["ours"] == natural["overall", "iou"]
    assert all(r["paper"] == "" for r in rows)


def test_groups_stand_beside_the_fine_tuned_network():
    for method, column, paper in (
        ("c2cnn", "c2cnn f", ""),
        ("c2cnn_from_city", "c2cnn_finetuned f", "73.3"),
        ("og_cnn", "og_cnn f", "52.1"),
    ):
        evaluation, scores, _ = evaluate("oakland", method, groups=GROUPS)
        rows = grouped_scores(evaluation)
        assert [r["row"] for r in rows] == ["vegetation", "pole_like", "vehicle", "street_furniture"]
        pole = found(rows, "pole_like", column)
        assert pole["paper"] == paper
        natural = scores[scores["protocol"] == "natural"].set_index(["class", "metric"])["value"]
        assert pole["ours"] == natural["column", "f"]
    assert grouped_scores(evaluate()[0]) == []


def test_cleaning_by_hand():
    """Two phantoms, one seen; a car taken for a phantom; six ground voxels kept."""
    true = np.r_[np.full(2, PHANTOM), 5, np.zeros(6)].astype(np.uint8)
    predicted = np.r_[PHANTOM, 0, PHANTOM, np.zeros(6)].astype(np.uint8)
    rows = cleaning_scores(evaluate(true=true, predicted=predicted)[0])
    assert found(rows, "city/c2cnn", "phantom_out dynamic_removed")["ours"] == pytest.approx(50)
    assert found(rows, "city/c2cnn", "phantom_out static_kept")["ours"] == pytest.approx(100 * 6 / 7)
    assert found(rows, "city/c2cnn", "movable_out dynamic_removed")["ours"] == pytest.approx(100 * 2 / 3)
    assert found(rows, "city/c2cnn", "movable_out geometric_mean")["ours"] == pytest.approx(math.sqrt(100 * 200 / 3))


def test_facts_of_data_sets():
    rows = dataset_scores("oakland", {"year": 2009, "sensor": "x", "n_points": None, "licence": "free"})
    assert [(r["column"], r["ours"], r["paper"]) for r in rows] == [("sensor", "x", "SICK LMS (MLS)"), ("year", 2009, "2009")]


def test_units_must_be_the_papers():
    with pytest.raises(ValueError, match="nagy_3_1"):
        make_score("nagy_3_1", "overall", "c2cnn", "translation_error", 20.0, "cm")


def test_seeds_are_averaged():
    rows = [
        make_score("nagy_2_3", "car", "c2cnn", "f", v, "%", n, "city", "c2cnn", s)
        for s, v, n in ((1, 80.0, 50), (2, 82.0, 48), (3, 84.0, 50))
    ]
    rows.append(make_score("nagy_2_3", "car", "og_cnn", "f", 60.0, "%", 50, "city", "og_cnn", 1))
    averaged = average_seeds(pd.DataFrame(rows, columns=list(SCORE_COLUMNS)))
    assert averaged["ours"].tolist() == [82.0, 60.0]
    assert averaged["spread"].iloc[0] == pytest.approx(2.0)
    assert math.isnan(averaged["spread"].iloc[1])
    assert averaged["seed"].tolist() == ["1;2;3", "1"]
    assert averaged["n"].tolist() == [48, 50]


def test_the_same_seed_twice_is_refused():
    rows = [make_score("nagy_2_3", "car", "c2cnn", "f", 80.0, "%", 5, "city", "c2cnn", 1)] * 2
    with pytest.raises(ValueError, match="two scores"):
        average_seeds(pd.DataFrame(rows, columns=list(SCORE_COLUMNS)))


def test_every_published_cell_of_a_table_is_there_once():
    scores = collect_scores([evaluate()[0]], {"city": {"year": 2026}})
    part = scores[scores["table"] == "nagy_2_3"]
    assert not part.duplicated(["row", "column", "dataset"]).any()
    assert (part["paper"] != "").sum() == len(load_published("nagy_2_3"))
    assert set(part["dataset"]) == {"city"}
    theirs = part[part["method"] == ""]
    assert theirs["ours"].isna().all()
    facts = scores[scores["table"] == "nagy_1_2"]
    assert len(facts) == 1 + len(load_published("nagy_1_2"))


def test_a_run_of_two_maps_has_the_tables_of_both():
    scores = collect_scores([evaluate("city")[0], evaluate("oakland", "c2cnn_from_city", groups=GROUPS)[0]], {})
    by_table = {t: list(dict.fromkeys(p["dataset"])) for t, p in scores.groupby("table", sort=False)}
    assert by_table["nagy_2_3"] == ["city"]
    assert by_table["nagy_2_4"] == ["oakland"]
    assert by_table["nagy_2_3_natural"] == by_table["map_cleaning"] == ["city", "oakland"]


def test_nothing_scored_is_an_empty_table():
    scores = collect_scores([], {})
    assert list(scores.columns) == list(SCORE_COLUMNS)
    assert scores.empty
    assert add_paper_rows(scores).empty


def test_files_are_read_back(tmp_path):
    scores = collect_scores([evaluate()[0]], {"city": {"year": 2026, "sensor": "a, b"}})
    write_scores(tmp_path / "scores.csv", scores)
    back = read_scores(tmp_path / "scores.csv")
    for name in SCORE_COLUMNS:
        for a, b in zip(scores[name], back[name], strict=True):
            if isinstance(a, str):
                assert a == b
            else:
                assert b == pytest.approx(a, rel=1e-9, nan_ok=True)


def test_an_evaluation_is_read_from_its_files(tmp_path):
    evaluation, scores, confusion = evaluate()
    scores.assign(labels="map").to_csv(tmp_path / "scores.csv", index=False)
    confusion.assign(labels="map").to_csv(tmp_path / "confusion.csv", index=False)
    (back,) = read_evaluations(tmp_path / "scores.csv", tmp_path / "confusion.csv", "city", "c2cnn", 1)
    assert (back.method, back.model) == ("c2cnn", "c2cnn")
    assert (back.confusion == evaluation.confusion).all()
    assert back.confusion.sum() == 1980
    pd.testing.assert_frame_equal(pd.DataFrame(label_scores(back)), pd.DataFrame(label_scores(evaluation)))


def test_a_smoothed_map_is_scored_beside_what_its_voxels_are_alone(tmp_path):
    alone, smoothed = evaluate(seed=1), evaluate(seed=2)
    for i, name in ((1, "scores.csv"), (2, "confusion.csv")):
        pd.concat([smoothed[i].assign(labels="map"), alone[i].assign(labels="alone")]).to_csv(tmp_path / name, index=False)
    back = read_evaluations(tmp_path / "scores.csv", tmp_path / "confusion.csv", "city", "c2cnn", 1)
    assert [(e.method, e.model) for e in back] == [("c2cnn", "c2cnn"), ("c2cnn_smoothed", "c2cnn")]
    assert [(e.confusion == of[0].confusion).all() for e, of in zip(back, (alone, smoothed), strict=True)] == [True, True]
    assert found(label_scores(back[1]), "car", "c2cnn_smoothed f")["paper"] == ""


@pytest.mark.parametrize("text", ["", "protocol,class\n", "a,b\n1,2,3\n"])
def test_bad_files_are_named(tmp_path, text):
    path = tmp_path / "broken.csv"
    path.write_text(text)
    with pytest.raises(BadInput, match=r"broken\.csv"):
        read_confusion(path)
    with pytest.raises(BadInput, match=r"gone\.csv"):
        read_scores(tmp_path / "gone.csv")


def test_unknown_classes_are_named(tmp_path):
    path = tmp_path / "confusion.csv"
    path.write_text("labels,protocol,truth,predicted,n\nmap,natural,ground,water,3\n")
    with pytest.raises(BadInput, match="water"):
        read_confusion(path)
