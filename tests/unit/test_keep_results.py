"""What of a run goes into docs/results/."""

import base64
import re

import cv2
import numpy as np
import pandas as pd

from docs.keep_results import WIDTH_PX, keep_benchmarks, shrink_report


def _uri(kind, pixels):
    return f"data:image/{kind};base64,{base64.b64encode(cv2.imencode(f'.{kind}', pixels)[1].tobytes()).decode()}"


def test_pictures_of_a_kept_report_are_small():
    noise = np.random.default_rng(0).integers(0, 255, (900, 1600, 3), np.uint8)
    drawing = "data:image/svg+xml;base64,PHN2Zy8+"
    html = f'<p>Table</p><img src="{_uri("png", noise)}"><img src="{_uri("png", noise[:2, :2])}"><img src="{drawing}">'
    small = shrink_report(html)
    contents = [base64.b64decode(c) for c in re.findall(r"data:image/(?:webp|png);base64,([A-Za-z0-9+/=]+)", small)]
    assert [cv2.imdecode(np.frombuffer(c, np.uint8), 1).shape for c in contents] == [(360, WIDTH_PX, 3), (2, 2, 3)]
    assert len(small) < len(html) / 4
    assert small.startswith("<p>Table</p>")
    assert drawing in small


def test_benchmarks_that_were_not_run_again_stay(tmp_path):
    """And the text says which rows are of which commit."""
    table = pd.DataFrame({"benchmark": ["a", "b"], "value": [1.0, 2.0]})
    table.to_csv(tmp_path / "new.csv", index=False)
    keep_benchmarks(tmp_path / "new.csv", tmp_path, "1234")
    assert (tmp_path / "bench.txt").read_text().startswith("command: python -m benchmarks\ncommit: 1234\n")
    table.tail(1).assign(value=3.0).to_csv(tmp_path / "new.csv", index=False)
    keep_benchmarks(tmp_path / "new.csv", tmp_path, "5678")
    assert pd.read_csv(tmp_path / "bench.csv")["value"].tolist() == [1, 3]
    assert "(rows b)\ncommit: 5678\n" in (tmp_path / "bench.txt").read_text()
    assert "commit: 1234" in (tmp_path / "bench.txt").read_text()
