"""The time of a keyframe is not taken from one that was refused."""

import pytest
import yaml

from benchmarks.bench_calibration import check_accepted


def test_a_refused_keyframe_gives_no_time(tmp_path):
    path = tmp_path / "calibration.yaml"
    path.write_text(yaml.safe_dump({"status": "ok", "reason": ""}))
    check_accepted(path)
    path.write_text(yaml.safe_dump({"status": "uncertain", "reason": "a deviation of 9.1 px"}))
    with pytest.raises(RuntimeError, match=r"uncertain: a deviation of 9\.1 px"):
        check_accepted(path)
