"""The verdict: each way to be fooled has its answer."""

from dataclasses import replace

import pytest

from streetscan.localization.verdict import VERDICTS, Evidence, judge

GOOD = Evidence(True, n_objects=20, n_inliers=6, consensus=6.0, margin=0.4, fit=0.35)


@pytest.mark.parametrize(
    ("change", "verdict"),
    [
        ({}, "ok"),
        ({"is_on_map": False}, "off_map"),
        ({"fit": 0.2}, "off_map"),
        ({"fit": 0.23}, "off_map"),
        ({"fit": 0.23, "consensus": 9.0}, "ok"),
        ({"fit": 0.23, "consensus": 9.0, "plane_margin": 0.2}, "off_map"),
        ({"fit": 0.2, "consensus": 9.0}, "off_map"),
        ({"fit": float("nan")}, "ok"),
        ({"n_objects": 2}, "too_few_objects"),
        ({"n_inliers": 2}, "ambiguous"),
        ({"consensus": 2.0}, "ambiguous"),
        ({"margin": 0.1}, "ambiguous"),
        ({"margin": -0.2}, "ambiguous"),
        ({"margin": 0.0, "plane_margin": 0.2}, "ok"),
        ({"n_objects": 0, "plane_margin": 0.2}, "ok"),
        ({"n_objects": 0, "plane_margin": 0.02}, "too_few_objects"),
        ({"margin": 0.0, "plane_margin": 0.02}, "ambiguous"),
        ({"plane_margin": 0.2, "fit": 0.1}, "off_map"),
    ],
)
def test_verdicts(change, verdict):
    assert judge(replace(GOOD, **change)) == verdict
    assert verdict in VERDICTS
