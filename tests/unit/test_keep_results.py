"""What of a run goes into docs/results/."""

import base64
import re

import cv2
import numpy as np

from docs.keep_results import WIDTH_PX, shrink_report


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
