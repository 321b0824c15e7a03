"""What of a run goes into docs/results/."""

import base64
import re

import cv2
import numpy as np
import pandas as pd

from docs.keep_results import WIDTH_PX, hide_folders, is_simulated, keep_benchmarks, shrink_report


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


def test_no_folder_of_this_machine_is_kept():
    html = "<pre>run: paper\ndata_root: /home/someone/data\ndrives_folder: ../own\n</pre>"
    assert hide_folders(html) == "<pre>run: paper\ndata_root: (a folder)\ndrives_folder: ../own\n</pre>"


def test_pictures_of_simulated_things_alone_are_kept(tmp_path):
    for names, run, is_kept in (
        (["city", "city_2cm"], "parameters", True),
        (["city_2cm"], "seeds", False),
        (["city", "oakland"], "oakland", False),
    ):
        pd.DataFrame({"dataset": [*names, None]}).to_csv(tmp_path / "scores.csv", index=False)
        assert is_simulated(tmp_path / "scores.csv", run) == is_kept


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
