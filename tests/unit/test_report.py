"""The report: self-contained, deterministic, honest about what is missing."""

import math
import re
from html.parser import HTMLParser

import numpy as np
import pandas as pd
import pytest

from streetscan.benchmarks import report
from streetscan.benchmarks.scores import SCORE_COLUMNS, Evaluation, add_paper_rows, make_score
from streetscan.benchmarks.tables import make_tables
from streetscan.errors import BadInput
from streetscan.io.images import encode_png

VOID = {"meta", "img", "input", "br", "link", "hr"}
FACTS = {"Run": "try <1>", "Version": "streetscan 0", "Seed": "1"}


class Page(HTMLParser):
    """Collects tags, checks that they close, and keeps the text."""

    def __init__(self, html):
        super().__init__()
        self.open, self.tags, self.text = [], [], []
        self.feed(html)
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open[-1:] != ["style"]:
            self.text.append(data)

    @property
    def words(self):
        return re.sub(r"\s+", " ", "".join(self.text))


def tidy(values):
    """Scores of Table 2.3 out of (data set, method, row, F)."""
    rows = [make_score("nagy_2_3", row, m, "f", f, "%", 50, d, m, 1) for d, m, row, f in values]
    rows += [make_score("nagy_2_3", row, m, "recall", f, "%", 50, d, m, 1) for d, m, row, f in values if row == "phantom"]
    return add_paper_rows(pd.DataFrame(rows, columns=list(SCORE_COLUMNS)))


@pytest.fixture
def scores():
    return tidy(
        [
            ("city", "c2cnn", "phantom", 90.0), ("city", "c2cnn", "car", 80.0), ("city", "c2cnn", "tram_bus", math.nan),
            ("city", "c2cnn", "overall", 85.0), ("city", "og_cnn", "phantom", 49.3), ("city", "og_cnn", "overall", 80.0),
        ]
    )  # fmt: skip


@pytest.fixture
def sections(scores, tmp_path):
    views = tmp_path / "views"
    views.mkdir()
    for name in ("predicted_top", "predicted_street", "true_top"):
        (views / f"{name}.png").write_bytes(b"\x89PNG")
    (views / "class_shares.svg").write_text("<svg/>")
    counts = np.diag(np.arange(9)) * 100
    history = pd.DataFrame({"epoch": [1, 2], "train_loss": [2.0, 1.0], "validation_accuracy": [0.7, 0.8], "learning_rate": [0.1, 0.1]})
    evaluations = [Evaluation("city", m, 1, pd.DataFrame(), counts) for m in ("c2cnn", "og_cnn")]
    return report.draw_sections(
        tmp_path / "figures",
        scores,
        evaluations,
        {("city", "c2cnn"): history},
        {("city", "c2cnn"): views, ("my_street", "c2cnn_shipped"): views},
    )


def render(scores, sections, **more):
    return report.render_report(FACTS, scores, make_tables(scores), sections, "seed: 1 # <b>", **more)


def test_the_page_needs_nothing_from_outside(scores, sections):
    html = render(scores, sections)
    page = Page(html)
    assert "<script" not in html
    assert "@import" not in html
    assert "url(" not in html
    for tag, attributes in page.tags:
        assert tag not in ("link", "iframe", "object", "script")
        for name in ("src", "href"):
            if name in attributes:
                assert attributes[name].startswith(("data:image/", "#")), attributes[name][:60]


def test_every_entry_of_the_contents_leads_somewhere(scores, sections):
    page = Page(render(scores, sections))
    ids = [a["id"] for _, a in page.tags if "id" in a]
    assert len(ids) == len(set(ids))
    links = [a["href"][1:] for t, a in page.tags if t == "a"]
    assert set(links) <= set(ids)
    assert {"map-city", "map-city-c2cnn", "map-my_street", "table-nagy_2_3_city"} <= set(links)


def test_equal_inputs_are_equal_pages(scores, sections):
    assert render(scores, sections) == render(scores, sections)


def test_names_and_settings_are_escaped(scores, sections):
    html = render(scores, sections)
    assert "try &lt;1&gt;" in html
    assert "seed: 1 # &lt;b&gt;" in html


def test_ours_stands_beside_the_papers(scores, sections):
    words = Page(render(scores, sections)).words
    assert "80.0/87.5" in words
    assert "–/93.0" in words
    assert "Table 2.3" in words


def test_glance(scores):
    first, second = report.glance(scores)
    assert first == {
        "dataset": "city", "method": "C²CNN", "f": "85.0", "paper": "90.3", "difference": "−5.3", "verdict": "worse",
        "phantom_recall": "90.0", "weakest": "Car, 80.0",
    }  # fmt: skip
    assert (second["difference"], second["verdict"]) == ("+4.5", "better")


def test_glance_of_a_map_scored_in_groups():
    rows = [
        make_score("nagy_2_4", r, "c2cnn_finetuned", "f", f, "%", 5, "oakland", "c2cnn_from_city", 1)
        for r, f in (("ground", 99.0), ("vehicle", 71.0))
    ]
    (line,) = report.glance(add_paper_rows(pd.DataFrame(rows, columns=list(SCORE_COLUMNS))))
    assert (line["f"], line["paper"], line["phantom_recall"]) == ("85.0", f"{(98.6 + 74.7) / 2:.1f}", "–")


def test_shortfalls_are_said(scores):
    lines = report.shortfalls(scores, [("my_street", "c2cnn_shipped")])
    assert lines == [
        "C²CNN on city: F below the paper's for Car 80.0 (paper 87.5), Overall 85.0 (paper 90.3).",
        "C²CNN on city: nothing to score for Tram/Bus, since no voxel of the test part truly is one.",
        "C²CNN, shipped on my_street: labelled, but without truth nothing can be scored.",
    ]


def test_a_method_the_paper_lacks_is_held_against_the_papers_own(tmp_path):
    row = make_score("nagy_2_4", "facade", "c2cnn", "f", 82.4, "%", 5, "oakland", "c2cnn", 1)
    scores = add_paper_rows(pd.DataFrame([row], columns=list(SCORE_COLUMNS)))
    assert report.shortfalls(scores) == ["C²CNN on oakland: F below the paper's for Facade 82.4 (paper 97.7)."]
    (line,) = report.glance(scores)
    assert (line["paper"], line["difference"]) == ("97.7", "−15.3")
    (section,) = report.draw_sections(tmp_path, scores, [Evaluation("oakland", "c2cnn", 1, pd.DataFrame(), np.eye(9, dtype=int))], {}, {})
    assert len(section.figures) == 1


def test_notes_on_the_papers_figures(scores):
    lines = report.notes(scores)
    assert any(line.startswith("nagy_2_3: Tram/Bus, C²CNN, F (93.0):") and "93.1" in line for line in lines)
    assert any("and 16 more" in line for line in lines)


def test_parts_say_what_is_missing(sections):
    city, mine = sections
    assert [p.heading for p in city.parts] == ["C²CNN", "OG-CNN"]
    trained, untrained = city.parts
    assert "weights of epoch 2 were kept" in trained.text
    assert [name for name, _ in trained.galleries[1].pictures] == ["Predicted", "True"]
    assert len(trained.figures) == 3
    assert untrained.galleries == []
    assert "Not trained on this map" in untrained.text
    assert mine.text.startswith("This map has no truth")
    assert mine.figures == []
    assert "no confusion matrix" in mine.parts[0].text


def test_a_run_without_anything_is_still_a_page():
    nothing = pd.DataFrame([], columns=list(SCORE_COLUMNS))
    words = Page(render(nothing, [], unscored=[("mine", "c2cnn")])).words
    assert "No labelled map of this run has truth" in words
    assert "C²CNN on mine: labelled, but without truth" in words


def test_parameter_studies_become_curves(tmp_path):
    rows = [make_score("nagy_2_1", size, "c2cnn", "f", f, "%", 9, "city", "c2cnn", 1) for size, f in (("0.1", 93.0), ("0.2", 85.0))]
    scores = add_paper_rows(pd.DataFrame(rows, columns=list(SCORE_COLUMNS)))
    (section,) = report.draw_sections(tmp_path, scores, [], {}, {})
    assert "2 runs of ours" in section.figures[0].caption
    assert (tmp_path / "nagy_2_1_city.pdf").is_file()


def test_missing_pictures_are_named(tmp_path):
    with pytest.raises(BadInput, match=r"gone\.svg"):
        report.embed(tmp_path / "gone.svg", "")


def test_large_pictures_are_embedded_smaller(tmp_path):
    noise = np.random.default_rng(0).integers(0, 256, (300, 400, 3)).astype(np.uint8)
    (tmp_path / "view.png").write_bytes(encode_png(noise))
    (tmp_path / "lines.png").write_bytes(encode_png(np.zeros((300, 400, 3), np.uint8)))
    view, lines = (report.embed(tmp_path / name, "").data for name in ("view.png", "lines.png"))
    assert view.startswith("data:image/webp;base64,")
    assert len(view) < (tmp_path / "view.png").stat().st_size / 2
    assert lines.startswith("data:image/png;base64,")


def test_the_run_is_described():
    facts = report.describe_run("paper", 3, [("city", "c2cnn"), ("city", "og_cnn"), ("oakland", "c2cnn")])
    assert facts["Labelled maps"] == "city by C²CNN, OG-CNN; oakland by C²CNN"
    assert "cores" in facts["Tables made on"]
    assert report.describe_run("paper", 3, [])["Labelled maps"] == "none"


def test_the_file_is_whole(tmp_path, scores, sections):
    report.write_report(tmp_path / "out" / "report.html", render(scores, sections))
    assert (tmp_path / "out" / "report.html").read_text().rstrip().endswith("</html>")


def test_yardsticks_say_what_holds_what_fails_and_what_is_not_known():
    scores = tidy(
        [
            ("city", "c2cnn", "overall", 85.0), ("city", "lightgbm", "overall", 81.0), ("city", "og_cnn", "overall", 80.0),
            ("city", "og_cnn", "phantom", 49.3),
        ]
    )  # fmt: skip
    lines = {(line["dataset"], line["name"]): (line["found"], line["verdict"]) for line in report.yardsticks(scores, ["city"])}
    assert lines["City", "OG-CNN, F overall"] == ("80.0", "holds")
    assert lines["City", "OG-CNN, recall of phantoms"] == ("49.3", "holds")
    assert lines["City", "C²CNN's F above LightGBM's"] == ("4.0", "fails")
    oakland = {found for (dataset, _), found in lines.items() if dataset == "Oakland"}
    assert oakland == {("not in this run", "")}
    assert len(lines) == 7
    # The city's network on Oakland is scored in groups of classes.
    row = make_score("nagy_2_4", "vehicle", "c2cnn_city", "f", 22.3, "%", 50, "oakland", "c2cnn_city", 1)
    scores = pd.concat([scores, pd.DataFrame([row])], ignore_index=True)
    found = [line for line in report.yardsticks(scores, ["city"]) if "Vehicle" in line["name"]]
    assert (found[0]["found"], found[0]["verdict"]) == ("22.3", "holds")
    row = make_score("nagy_2_4", "facade", "c2cnn_city", "f", 49.6, "%", 50, "oakland", "c2cnn_city", 1)
    # A run of Oakland alone is held against them, too; one that has neither is not.
    of_oakland = {line["name"].split()[-1]: line["verdict"] for line in report.yardsticks(pd.DataFrame([row]), [])}
    assert of_oakland == {"Ground": "", "Facade": "fails", "Vegetation": "", "Vehicle": ""}
    assert report.yardsticks(scores[scores["dataset"] != "oakland"], []) == []


def test_the_yardsticks_stand_in_the_page_with_the_generators_version(scores, sections):
    page = Page(render(scores, sections, simulated=["city"]))
    assert f"Generator version {report.GENERATOR_VERSION}" in page.words
    assert "C²CNN's F above LightGBM's" in page.words
    assert "Yardsticks" not in Page(render(scores, sections)).words


def test_the_scan_is_shown_by_class_intensity_and_colour_once_per_map(tmp_path, scores):
    views = tmp_path / "views"
    views.mkdir()
    for name in ("predicted_top.png", "true_top.png", "true_street.png", "intensity_top.jpg", "rgb_top.jpg", "rgb_street.jpg"):
        (views / name).write_bytes(b"\x89PNG")
    (section,) = report.draw_sections(tmp_path / "figures", scores, [], {}, {("city", "c2cnn"): views, ("city", "og_cnn"): views})
    shown = {gallery.anchor: [name for name, _ in gallery.pictures] for gallery in section.galleries}
    assert shown == {"scan-city-street": ["Class", "Colour"], "scan-city-top": ["Class", "Intensity", "Colour"]}
    Page(render(scores, [section]))
    # A map that has neither intensity nor colour is shown by its labels alone.
    for name in ("intensity_top", "rgb_top", "rgb_street"):
        (views / f"{name}.jpg").unlink()
    (section,) = report.draw_sections(tmp_path / "figures", scores, [], {}, {("city", "c2cnn"): views})
    assert section.galleries == []
