import base64
import re
from html.parser import HTMLParser

import cv2
import numpy as np
from toy_recordings import ROOT, SCHEMA, kitti_facts, vlp16_packets, write_facts, write_kitti, write_pcap

from scripts.import_drive import main as import_main
from scripts.inspect_drive import main
from streetscan.inspection import inspect_drive


class Checker(HTMLParser):
    """Collects texts and pictures, and sees that every element is closed."""

    def __init__(self):
        super().__init__()
        self.open, self.texts, self.images = [], [], []

    def handle_starttag(self, tag, attrs):
        if tag == "img":
            self.images.append(dict(attrs)["src"])
        elif tag not in ("br", "meta"):
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.texts.append(data)


def sheet(tmp_path, facts, data_root, name):
    import_main(facts, SCHEMA, data_root, name, tmp_path / "drive.mcap", tmp_path / "frames.csv", tmp_path / "truth")
    main(facts, SCHEMA, tmp_path / "drive.mcap", tmp_path / "frames.csv", tmp_path / "truth", tmp_path / "sheet.html", name, 3)
    text = (tmp_path / "sheet.html").read_text()
    page = Checker()
    page.feed(text)
    assert not page.open
    # Self-contained: nothing is fetched.
    assert not re.search(r"(src|href)=\"(?!data:)", text)
    for image in page.images:
        pixels = cv2.imdecode(np.frombuffer(base64.b64decode(image.split(",", 1)[1]), np.uint8), cv2.IMREAD_COLOR)
        assert pixels.std() > 5
    return page


def test_the_sheet_of_a_toy(tmp_path):
    folder = write_kitti(tmp_path / "drive", 6)
    (folder / "velodyne_points" / "data" / "0000000002.bin").write_bytes(b"123")
    page = sheet(tmp_path, write_facts(tmp_path / "toy.yaml", kitti_facts(description="<toy & co>")), tmp_path, "toy")
    # Tracks, time line, frames, three images.
    assert len(page.images) == 6
    assert {"6 (5 ok, 1 truncated)", "5.0 m, 6 of 6 poses known", "<toy & co>", "truncated"} <= set(page.texts)
    assert any("lidar points in it" in t for t in page.texts)


def test_a_drive_with_nothing_but_points(tmp_path):
    write_kitti(tmp_path / "drive", 2)
    facts = {
        "description": "d",
        "source": "s",
        "reader": "folder",
        "root": "drive",
        "rate_hz": 10,
        "lidar": {"files": "velodyne_points/data/*.bin"},
    }
    page = sheet(tmp_path, write_facts(tmp_path / "toy.yaml", facts), tmp_path, "toy")
    assert {"none: there is no /gps", "none: there is no camera"} <= set(page.texts)
    assert len(page.images) == 2


def test_a_real_drive(tmp_path, shared_data):
    page = sheet(tmp_path, ROOT / "config" / "drives" / "hdl32_capture.yaml", shared_data, "hdl32_capture")
    assert "6 (4 ok, 2 partial)" in page.texts


def test_an_image_of_another_place_is_not_shown(tmp_path):
    """Frame 1 has no image: neither its neighbours', 0.1 s away, nor points drawn into them."""
    folder = write_kitti(tmp_path / "drive", 3)
    (folder / "image_02" / "data" / "0000000001.png").unlink()
    page = sheet(tmp_path, write_facts(tmp_path / "toy.yaml", kitti_facts()), tmp_path, "toy")
    captions = [t for t in page.texts if t.startswith("Image of frame")]
    assert [c.split(" (")[0] for c in captions] == ["Image of frame 0", "Image of frame 2"]
    assert "2 of camera; beside the frames: 2 ok, 1 missing" in page.texts


def test_whole_frames_are_shown_as_wide_as_they_are(tmp_path):
    capture = write_pcap(tmp_path / "a.pcap", vlp16_packets(4.5, first_deg=90, range_m=7.0))
    facts = {"description": "d", "source": "s", "reader": "pcap", "root": capture.name, "rate_hz": 10, "lidar": {"model": "vlp16"}}
    page = sheet(tmp_path, write_facts(tmp_path / "toy.yaml", facts), tmp_path, "toy")
    assert "6 (4 ok, 2 partial)" in page.texts
    assert any("10 m to each side" in t for t in page.texts)
    assert sorted(inspect_drive(tmp_path / "drive.mcap", tmp_path / "frames.csv", tmp_path / "truth").pictured) == [1, 3, 4]
