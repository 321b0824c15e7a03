"""Figures: what they show, and that equal numbers give equal files."""

import numpy as np
import pandas as pd
import pytest
from PIL import Image

from streetscan.benchmarks import figures
from streetscan.classes import CLASSES, N_CLASSES, UNLABELLED
from streetscan.segmentation.metrics import calibration_error, reliability_bins

NAMES = [c.title for c in CLASSES]
NAN = float("nan")


def texts(figure):
    figure.canvas.draw()
    return [t.get_text() for axes in figure.axes for t in axes.texts]


def history(n=30):
    epoch = np.arange(1, n + 1)
    accuracy = 0.95 - 0.5 / epoch
    return pd.DataFrame(
        {
            "epoch": epoch,
            "train_loss": 1 / epoch,
            "validation_loss": 1.2 / epoch,
            "train_accuracy": accuracy,
            "validation_accuracy": accuracy - 0.01,
            "learning_rate": np.where(epoch < 20, 0.1, 0.01),
        }
    )


def drawings():
    """One of each kind, with the awkward values in."""
    rng = np.random.default_rng(0)
    counts = rng.integers(0, 500, (9, 9)) + np.diag(np.full(9, 9000))
    counts[3] = 0
    bins = reliability_bins(rng.random(500) < 0.7, rng.random(500))
    image = rng.integers(0, 255, (40, 80, 3)).astype(np.uint8)
    bars = {"ours": [90.0] * 8 + [NAN], "paper": [85.0] * 9, "a third": [70.0] * 9}
    curves = {"ours": [80.0, NAN, 70.0], "paper": [73.5, 90.3, 84.7]}
    return {
        "training": figures.training_curve(history()),
        "confusion": figures.confusion_matrix(counts, NAMES),
        "bars": figures.score_bars(NAMES, bars, references=["paper"]),
        "curve": figures.parameter_curve([0.05, 0.1, 0.2], curves, "λ [m]", references=["paper"]),
        "reliability": figures.reliability_diagram(bins, before=bins),
        "shares": figures.class_shares({"true": [0, 5, 1e6, 1, 2, 3, 4, 5, 6]}),
        "view": figures.map_view(image, figures.legend_entries(np.array([0, 2, 255])), "A map", 0.1, 1.0),
    }


def test_equal_numbers_are_equal_files(tmp_path):
    # Each kind of figure as SVG, and one of them in each format.
    for folder in ("once", "again"):
        for name, figure in drawings().items():
            for suffix in (".svg", ".pdf", ".png") if name == "view" else (".svg",):
                figures.save_figure(figure, tmp_path / folder / f"{name}{suffix}", dpi=60)
    files = sorted(p.name for p in (tmp_path / "once").iterdir())
    assert len(files) == 9
    for name in files:
        content = (tmp_path / "once" / name).read_bytes()
        assert content == (tmp_path / "again" / name).read_bytes(), name
        assert b"Date" not in content


def test_png_has_the_size_asked_for(tmp_path):
    figures.save_figure(drawings()["view"], tmp_path / "view.png", dpi=100)
    image = Image.open(tmp_path / "view.png")
    assert image.mode == "RGB"
    assert image.width == round(100 * figures.WIDTH_IN)


def test_an_unknown_suffix_leaves_nothing(tmp_path):
    with pytest.raises(KeyError):
        figures.save_figure(drawings()["training"], tmp_path / "a.bmp")
    assert list(tmp_path.iterdir()) == []


def test_training_curve_marks_the_best_epoch():
    figure = figures.training_curve(history())
    assert [a.get_title(loc="left") for a in figure.axes] == ["Loss", "Accuracy [%]", "Learning rate"]
    assert texts(figure) == ["92.3 %"]
    only_loss = figures.training_curve(history()[["epoch", "train_loss"]])
    assert len(only_loss.axes) == 1


def test_confusion_shows_shares_and_counts():
    counts = np.zeros((3, 3), int)
    counts[0] = [9994, 6, 0]
    counts[1] = [0, 1, 1]
    shown = texts(figures.confusion_matrix(counts, ["a", "b", "c"]))
    assert shown == ["99.9", "9.99k", "0.1", "6", "50.0", "1", "50.0", "1"]


def test_bars_start_at_zero_and_dash_what_is_undefined():
    figure = figures.score_bars(["a", "b"], {"ours": [90.0, NAN], "paper": [85.1, 70.0]}, references=["paper"])
    assert texts(figure) == ["90.0", "–", "85.1", "70.0"]
    assert figure.axes[0].get_ylim()[0] == 0
    assert [bool(p.get_hatch()) for p in figure.axes[0].patches] == [False, False, True, True]


def test_what_is_worse_afterwards_is_counted():
    before, after = np.array([0.0, 2.0, 3.0, 4.0, 5.0, 6.0]), np.array([0.0, 2.5, 1.0, 2.0, np.inf, NAN])
    figure = figures.before_and_after(before, after, np.array([False, True, True, True, True, True]), "distance [px]")
    assert texts_of_legend(figure) == ["kept (1)", "replaced, better (2)", "replaced, worse (2)", "not known (1)"]
    # What is beyond logarithmic axes lies at their edges.
    assert figure.axes[0].lines[2].get_ydata().tolist() == [2.5, 9.0]
    nothing = np.empty(0)
    assert texts_of_legend(figures.before_and_after(nothing, nothing, nothing.astype(bool), "")) == [
        "kept (0)", "replaced, better (0)", "replaced, worse (0)",
    ]  # fmt: skip


def texts_of_legend(figure):
    return [t.get_text() for t in figure.legends[0].get_texts()]


def test_series_have_colours_of_their_own():
    colours = figures._series_colours(["a", "b", "paper"], ["paper"])
    assert len(set(colours.values())) == 3
    assert colours["paper"] == figures.PAPER


@pytest.mark.parametrize(
    ("n", "text"), [(0, "0"), (950, "950"), (999, "999"), (12345, "12.3k"), (999600, "1M"), (1_750_000, "1.75M"), (4_009_000_000, "4.01G")]
)
def test_short_counts(n, text):
    assert figures.short_count(n) == text


def test_a_reliability_without_samples_says_so():
    empty = reliability_bins(np.empty(0, bool), np.empty(0))
    assert np.isnan(calibration_error(empty))
    assert figures.reliability_diagram(empty).axes[0].get_title(loc="left") == "no labelled voxel"


def test_shares_are_per_cent():
    figure = figures.class_shares({"true": [1] * (N_CLASSES - 1) + [0]})
    assert texts(figure) == ["12.5"] * 8 + ["none"]


def test_legend_names_what_occurs():
    assert [name for name, _ in figures.legend_entries(np.array([5, 2, 2, UNLABELLED], np.uint8))] == ["Phantom", "Car", "Unlabelled"]


@pytest.mark.parametrize(("pixel_m", "bar"), [(0.1, "1 m"), (0.02, "0.2 m"), (1.0, "10 m"), (0.35, "5 m")])
def test_scale_bars_are_round(pixel_m, bar):
    figure = figures.map_view(np.zeros((40, 80, 3), np.uint8), [], "t", pixel_m)
    assert texts(figure) == [bar]
    (line,) = {round(float(np.ptp(line.get_xdata()) * pixel_m), 6) for line in figure.axes[0].lines}
    assert f"{line:g} m" == bar


def test_a_picture_keeps_the_colours_of_the_classes(tmp_path):
    """However many shades the rest of the picture has."""
    noise = np.random.default_rng(0).integers(0, 256, (300, 600, 3)).astype(np.uint8)
    figures.save_figure(figures.map_view(noise, figures.legend_entries(np.arange(N_CLASSES)), "Shades"), tmp_path / "a.png")
    found = {tuple(pixel) for pixel in np.asarray(Image.open(tmp_path / "a.png").convert("RGB")).reshape(-1, 3).tolist()}
    assert {tuple(c.colour) for c in CLASSES} <= found
