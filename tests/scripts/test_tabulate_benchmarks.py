"""tabulate_benchmarks on made-up evaluations of two maps and a third without truth."""

import numpy as np
import pandas as pd
import pytest

from scripts import tabulate_benchmarks
from streetscan.benchmarks.localizations import Localization, draw_localizations, localization_scores
from streetscan.benchmarks.scores import read_scores
from streetscan.errors import BadInput
from streetscan.geometry import transform
from streetscan.localization.evaluation import COLUMNS as LOCALIZATION_COLUMNS
from streetscan.registration.evaluation import align_trajectory, evaluate_chain, find_failed_pairs
from streetscan.registration.grid_evaluation import score_grid
from streetscan.registration.odometry import FramePose
from streetscan.segmentation.metrics import evaluate_labels
from streetscan.simulation.layout import GENERATOR_VERSION

CONFIG = {"run": "try", "seed": 1, "labelled_maps": ["city/c2cnn"], "calibrate_keyframe": {"settings": {}}}
TABLES = {"nagy_1_2", "nagy_2_3", "nagy_2_4", "nagy_2_3_natural", "map_cleaning", "jozsa_1", "jozsa_2", "registration", "grid_classes"}
THINNED = {"c2cnn": 1, "c2cnn_seed_2": 2, "c2cnn_local": 1}
TABLES |= {"thinning_validation", "thinning_test"}
TABLES |= {"nagy_3_1", "localization", "localization_verdicts", "confidence"}
REGISTERED = [("my_drive", "ndt_tall"), ("my_drive", "ndt_raw"), ("my_drive", "kiss_icp")]
LOCALIZED = [("city", "my_drive", m, n, "main_road") for m, n in (("raw", "voting_8"), ("c2cnn", "voting_8"), ("c2cnn", "crossmodal"))]
EVALUATED = [("city", "c2cnn", 1), ("city", "c2cnn", 2), ("oakland", "c2cnn_from_city", 1)]
REALISM = {"simulated": ["city"], "compared": ["city", "oakland"], "not_compared": ["amsterdam"], "static_scans": {"city_tls": "city"}}
FACTS = {"city": {"year": 2026, "n_classes": 9}, "oakland": {"sensor": "SICK LMS (MLS)", "n_points": None}}


@pytest.fixture
def inputs(tmp_path):
    rng = np.random.default_rng(0)
    paths = {
        "evaluations": [],
        "confusions": [],
        "histories": [],
        "views": [],
        "registrations": [],
        "trajectories": [],
        "streets": [],
        "frames": [],
        "localizations": [],
        "reconstructions": [],
        "detections": [],
        "models": [],
        "model_summaries": [],
        "calibrations": [],
        "calibration_errors": [],
        "calibration_transforms": [],
        "recalibrations": [],
        "recalibration_figures": [],
        "recalibration_trials": [],
        "calibrated": [],
        "verdicts": [],
        "detected": [],
        "localization_pictures": [],
        "network_scores": [],
        "network_reliabilities": [],
        "refinements": [],
        "thinnings": [],
    }
    for dataset, _, seed in EVALUATED:
        true = rng.integers(0, 9, 3000).astype(np.uint8)
        predicted = np.where(rng.random(3000) < 0.9, true, 0).astype(np.uint8)
        groups = {"Ground": ["ground"], "Pole-like": ["column"]} if dataset == "oakland" else None
        tables = evaluate_labels(true, predicted, np.ones(3000, np.float32), n_per_class=100, rng=rng, groups=groups)
        for kind, table in zip(("evaluations", "confusions"), tables, strict=True):
            path = tmp_path / f"{dataset}_{kind}_{seed}.csv"
            table.assign(labels="map").to_csv(path, index=False)
            paths[kind].append(str(path))
    for part in ("validation", "test"):
        shown = [(share, m, 60 + 20 * share + seed) for share in (1.0, 0.1) for m, seed in THINNED.items()]
        table = pd.DataFrame(shown, columns=["share", "model", "value"])
        table.assign(metric="f", unit="%", n=70, **{"class": "objects"}).to_csv(tmp_path / f"thinning_{part}.csv", index=False)
        paths["thinnings"].append(str(tmp_path / f"thinning_{part}.csv"))
    history = pd.DataFrame({"epoch": [1], "train_loss": [1.0], "validation_accuracy": [0.5], "learning_rate": [0.1]})
    history.to_csv(tmp_path / "history.csv", index=False)
    views = tmp_path / "views"
    views.mkdir()
    (views / "predicted_top.png").write_bytes(b"\x89PNG")
    for _, registrar in REGISTERED:
        for kind, table in zip(("registrations", "trajectories"), chain(0.4 if registrar == "ndt_raw" else 0.02), strict=True):
            path = tmp_path / f"{registrar}_{kind}.csv"
            table.to_csv(path, index=False)
            paths[kind].append(str(path))
    for _, drive, labels, localizer, _ in LOCALIZED:
        path = tmp_path / f"{drive}_{labels}_{localizer}.csv"
        localized(0.8 if labels == "raw" else 0.2).to_csv(path, index=False)
        paths["localizations"].append(str(path))
        (tmp_path / localizer).mkdir(exist_ok=True)
        (tmp_path / localizer / "before.png").write_bytes(b"\x89PNG")
        paths["localization_pictures"].append(str(tmp_path / localizer))
    frames = tmp_path / "my_drive" / "pictures"
    frames.mkdir(parents=True)
    for name in ("classes_000000.png", "density_000000.png"):
        (frames / name).write_bytes(b"\x89PNG")
    (tmp_path / "street.png").write_bytes(b"\x89PNG")
    grid = tmp_path / "my_drive" / "scores.csv"
    score_grid(np.diag([0, 9, 5, 8])).to_csv(grid, index=False)
    paths |= {"grids": [str(grid)], "streets": [str(tmp_path / "street.png")], "frames": [str(frames)]}
    statistics = pd.DataFrame({"statistic": "density_per_m2", "group": "ground", "x": [0.0, 2.0], "value": [900.0, 300.0], "n": 5})
    statistics.to_csv(tmp_path / "realism.csv", index=False)
    pd.concat([statistics.assign(scanner=s) for s in ("static", "mobile")]).to_csv(tmp_path / "density.csv", index=False)
    paths |= {"realism": [str(tmp_path / "realism.csv")] * 2, "densities": [str(tmp_path / "density.csv")]}
    return paths | {"histories": [str(tmp_path / "history.csv")], "views": [str(views)]}


def chain(step_error_m):
    """What evaluate_registration writes of twenty frames, each some way too far."""
    truth = np.tile(np.eye(4), (20, 1, 1))
    truth[:, 0, 3] = np.arange(20)
    poses = [FramePose(i, 0.1 * i, "ok" if i else "start", 0, transform([(1 + step_error_m) * i, 0, 0])) for i in range(20)]
    failed = find_failed_pairs(poses, truth, max_distance_m=0.3)
    return evaluate_chain(poses, truth, np.full(20, step_error_m)), align_trajectory(poses, truth, failed)


def localized(error_m):
    """What evaluate_localization writes of ten frames: one wrong and believed, one not believed."""
    n = 10
    table = pd.DataFrame({name: np.full(n, 0.1) for name in LOCALIZATION_COLUMNS})
    table["frame"], table["source"], table["n_objects"], table["n_good"] = range(n), "objects", 20, 5
    table["status"] = ["ok"] * 9 + ["ambiguous"]
    table["vote_m"] = [error_m] * 9 + [50.0]
    table["found_m"] = [3.0] + [0.05] * 9
    table["phantom_share"] = [0.01] * 5 + [0.1] * 5
    return table


def run(inputs, folder):
    outputs = {name: str(folder / name) for name in ("tables", "figures")} | {
        "scores": str(folder / "scores.csv"),
        "report": str(folder / "report.html"),
    }
    tabulate_benchmarks.main(
        inputs,
        outputs,
        evaluated=EVALUATED,
        trained=[("city", "c2cnn")],
        known=[],
        thinned={"parts": ["city/validation", "city/test"], "names": {m: (m.partition("_seed_")[0], s) for m, s in THINNED.items()}},
        viewed=[["my_street", "c2cnn_shipped"]],
        registered=REGISTERED,
        merged=REGISTERED[:1],
        localized=LOCALIZED,
        facts=FACTS,
        realism=REALISM,
        config=CONFIG,
    )


def test_all_outputs(inputs, tmp_path):
    run(inputs, tmp_path / "out")
    scores = read_scores(tmp_path / "out" / "scores.csv")
    assert set(scores["table"]) == TABLES
    pole = scores[(scores["table"] == "nagy_2_4") & (scores["row"] == "pole_like") & (scores["method"] == "c2cnn_from_city")].iloc[0]
    assert pole["paper"] == "73.3"
    assert 80 < pole["ours"] < 100
    for name in ("nagy_2_3_city", "nagy_2_4_oakland", "map_cleaning", "nagy_1_2"):
        for suffix in ("csv", "md", "tex"):
            assert (tmp_path / "out" / "tables" / f"{name}.{suffix}").stat().st_size > 0
    assert (tmp_path / "out" / "figures" / "confusion_oakland_c2cnn_from_city.svg").is_file()
    html = (tmp_path / "out" / "report.html").read_text()
    for text in ("streetscan: run try", "Map my_street", "without truth nothing can be scored", "labelled_maps:", "Drive My drive"):
        assert text in html
    # The simulated maps beside real ones, what is missing for it, and the yardsticks.
    for text in ("Realism of the simulated maps", "Not compared", "Amsterdam", "Static and mobile scanner", "not in this run"):
        assert text in html
    realism = pd.read_csv(tmp_path / "out" / "tables" / "realism.csv")
    assert realism["map"].tolist() == ["city", "city", "oakland", "oakland"]
    yardsticks = pd.read_csv(tmp_path / "out" / "tables" / "yardsticks.csv", keep_default_na=False)
    assert set(yardsticks["generator_version"]) == {GENERATOR_VERSION}
    assert set(yardsticks["verdict"]) <= {"holds", "fails", ""}
    assert set(pd.read_csv(tmp_path / "out" / "tables" / "density.csv")["scanner"]) == {"static", "mobile"}


def test_a_second_seed_gives_mean_and_spread_and_no_second_picture(inputs, tmp_path):
    run(inputs, tmp_path / "out")
    scores = read_scores(tmp_path / "out" / "scores.csv")
    car = scores[(scores["table"] == "nagy_2_3") & (scores["row"] == "car") & (scores["column"] == "c2cnn f")].iloc[0]
    assert car["seed"] == "1;2"
    assert 0 < car["spread"] < 10
    assert "±" in (tmp_path / "out" / "tables" / "nagy_2_3_city.md").read_text()
    html = (tmp_path / "out" / "report.html").read_text()
    assert html.count("Trained with the seeds 1, 2; what is shown here is of seed 1.") == 1
    assert html.count("<figcaption>Confusion of C²CNN on city ") == 1


def test_fewer_points(inputs, tmp_path):
    run(inputs, tmp_path / "out")
    scores = read_scores(tmp_path / "out" / "scores.csv")
    found = scores[scores["table"] == "thinning_test"].set_index(["row", "column"])
    assert found.loc[("100", "c2cnn f"), ["ours", "seed", "n"]].tolist() == [81.5, "1;2", 70]
    assert found.loc[("10", "c2cnn f"), "spread"] == pytest.approx(0.5**0.5)
    assert found.loc[("10", "c2cnn_local f"), "ours"] == 63
    for name in ("thinning_validation_city", "thinning_test_city"):
        assert (tmp_path / "out" / "figures" / f"{name}.svg").is_file()
        assert (tmp_path / "out" / "tables" / f"{name}.md").is_file()
    assert len(pd.read_csv(tmp_path / "out" / "tables" / "thinning.csv")) == 12
    assert "Fewer points" in (tmp_path / "out" / "report.html").read_text()


def test_registered_drives(inputs, tmp_path):
    run(inputs, tmp_path / "out")
    scores = read_scores(tmp_path / "out" / "scores.csv")
    pairs = scores[(scores["table"] == "jozsa_1") & (scores["row"] == "my_drive")].set_index("column")
    assert pairs.loc["presegmented time", "ours"] == pytest.approx(0.02)
    assert pairs.loc["ratio", "ours"] == pytest.approx(20)
    assert pairs.loc["presegmented time", "n"] == 19
    paper = scores[(scores["table"] == "jozsa_1") & (scores["row"] == "bartok_bela_3") & (scores["column"] == "raw time")].iloc[0]
    assert (paper["paper"], paper["method"]) == ("4.0099*", "")
    outcome = scores[(scores["table"] == "jozsa_2") & (scores["row"] == "my_drive")].set_index("column")["ours"]
    assert outcome["n_scans"] == outcome["presegmented n_registered"] == 20
    peers = scores[scores["table"] == "registration"]
    assert set(peers["row"]) == {f"my_drive/{registrar}" for _, registrar in REGISTERED}
    for name in ("jozsa_1", "jozsa_2", "registration"):
        assert "My drive" in (tmp_path / "out" / "tables" / f"{name}.md").read_text()
    assert (tmp_path / "out" / "figures" / "paths_my_drive.svg").is_file()


def test_localized_drives(inputs, tmp_path):
    run(inputs, tmp_path / "out")
    scores = read_scores(tmp_path / "out" / "scores.csv")
    table = scores[(scores["table"] == "nagy_3_1") & (scores["dataset"] == "city")].set_index(["row", "column"])
    # One of ten frames is not believed and does not enter the mean.
    assert table.loc[("main_roads", "raw translation_error"), "ours"] == pytest.approx(0.8)
    assert table.loc[("main_roads", "c2cnn translation_error"), ["ours", "n", "paper"]].tolist() == [pytest.approx(0.2), 9, "0.37"]
    assert table.loc[("many_phantoms", "c2cnn rotation_error"), "n"] == 4
    assert table.loc[("narrow_roads", "c2cnn translation_error"), "method"] == ""
    rates = scores[scores["table"] == "localization"].set_index(["row", "column"])["ours"]
    assert rates[("my_drive/c2cnn/voting_8", "success")] == 90
    assert rates[("my_drive/c2cnn/voting_8", "ok")] == 90
    assert rates[("my_drive/c2cnn/voting_8", "n_wrong_but_ok")] == 1
    verdicts = scores[scores["table"] == "localization_verdicts"].set_index(["row", "column"])["ours"]
    assert verdicts["my_drive/c2cnn/voting_8"].to_dict() == {"ok right": 8, "ok wrong": 1, "ambiguous right": 1, "ambiguous wrong": 0}
    assert not rates.index.get_level_values("row").str.startswith("all_drives").any()
    assert "The raw map is clearly worse: 4.0 times" in (tmp_path / "out" / "report.html").read_text()
    for name in ("nagy_fig_3_8_my_drive.svg", "localized_my_drive.svg"):
        assert (tmp_path / "out" / "figures" / name).is_file()


def test_several_drives_have_a_row_and_a_text_together_and_an_equal_raw_map_is_explained(tmp_path):
    names = [("city", drive, labels, "voting_8", "main_road") for drive in ("a", "b") for labels in ("raw", "c2cnn", "oracle_truth")]
    on_maps = [Localization(*name, localized(0.1 if name[2] == "oracle_truth" else 0.2)) for name in names]
    rows = {(r["row"], r["column"]): r for r in localization_scores(on_maps)}
    assert rows[("all_drives/c2cnn/voting_8", "success")]["n"] == 20
    assert rows[("all_drives/c2cnn/voting_8", "ok wrong")]["ours"] == 2
    together, *each = draw_localizations(tmp_path, on_maps, [str(tmp_path)] * len(on_maps))
    assert [s.heading for s in (together, *each)] == [f"{name} on the map of city" for name in ("All drives", "A", "B")]
    for section in (together, *each):
        assert "not clearly worse: 1.0 times" in section.text
        assert "50 % and 0 % better" in section.text


def test_figure_3_8_compares_poses_of_25_frames_even_where_a_slow_method_has_no_others(tmp_path):
    slow = localized(0.2).iloc[::3]
    on_maps = [Localization("city", "a", "c2cnn", name, "", localized(0.2)) for name in ("voting_1", "voting_8", "ndt_from_gps")]
    on_maps.append(Localization("city", "a", "c2cnn", "kiss_matcher", "", slow))
    section = draw_localizations(tmp_path, on_maps, [str(tmp_path)] * len(on_maps))[-1]
    assert f"{len(slow)} frames of A" in section.figures[0].caption


def test_the_same_inputs_give_the_same_files(inputs, tmp_path):
    run(inputs, tmp_path / "a")
    run(inputs, tmp_path / "b")
    files = sorted(p.relative_to(tmp_path / "a") for p in (tmp_path / "a").rglob("*") if p.is_file())
    assert len(files) > 20
    for path in files:
        assert (tmp_path / "a" / path).read_bytes() == (tmp_path / "b" / path).read_bytes(), path


def test_a_broken_evaluation_leaves_no_report(inputs, tmp_path):
    (tmp_path / "oakland_evaluations_1.csv").write_text("protocol\n")
    with pytest.raises(BadInput, match=r"oakland_evaluations_1\.csv"):
        run(inputs, tmp_path / "out")
    assert not (tmp_path / "out").exists()
