"""Scores of detections in the tidy scores."""

import pandas as pd
import pytest

from streetscan.benchmarks.calibrations import detection_scores
from streetscan.benchmarks.published import caption
from streetscan.errors import BadInput


def test_a_row_for_each_metric(tmp_path):
    folder = tmp_path / "city_main_road"
    folder.mkdir()
    table = pd.DataFrame([
        {"sensor": "image", "class": "car", "metric": "mask_iou", "value": 71.5, "unit": "%", "n": 900},
        {"sensor": "lidar", "class": "dynamic", "metric": "point_recall", "value": 93.0, "unit": "%", "n": 400},
    ])  # fmt: skip
    table.to_csv(folder / "scores.csv", index=False)
    first, second = detection_scores([str(folder / "scores.csv")])
    assert (first["table"], first["row"], first["column"], first["ours"]) == ("detection", "city_main_road/car", "mask_iou", 71.5)
    assert (second["method"], second["unit"], second["dataset"]) == ("lidar", "%", "city_main_road")
    assert caption("detection")["scope"] == "across"


def test_a_table_without_metrics(tmp_path):
    (tmp_path / "scores.csv").write_text("a,b\n1,2\n")
    with pytest.raises(BadInput, match="evaluate_detections"):
        detection_scores([str(tmp_path / "scores.csv")])
