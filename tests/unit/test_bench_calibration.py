"""The time of a keyframe is not taken from one that stopped early."""

import pytest
import yaml

from benchmarks.bench_calibration import check_went_through


def test_a_keyframe_that_stopped_early_gives_no_time(tmp_path):
    path = tmp_path / "calibration.yaml"
    for status in ("ok", "uncertain"):
        path.write_text(yaml.safe_dump({"status": status, "reason": ""}))
        check_went_through(path)
    path.write_text(yaml.safe_dump({"status": "no_match", "reason": "an overlap of 0.05"}))
    with pytest.raises(RuntimeError, match=r"no_match: an overlap of 0\.05"):
        check_went_through(path)
