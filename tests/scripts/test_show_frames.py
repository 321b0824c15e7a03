"""show_frames on a tiny drive: pictures and a video in every mode."""

import cv2
import numpy as np
import pytest

from scripts import show_frames
from streetscan.errors import BadInput


def test_pictures_and_video(registered_drive, tmp_path):
    paths = registered_drive.paths
    modes = ["stream", "classes", "mean_height", "density", "height_range"]
    show_frames.main(**paths, folder=tmp_path, modes=modes, grid={}, first=2, last=3, video_rate_hz=0)
    pictures = [cv2.imread(str(tmp_path / f"{mode}_000002.png")) for mode in modes]
    assert all((p.reshape(-1, 3).max(axis=1) > 0).mean() > 0.01 for p in pictures)
    assert not np.array_equal(pictures[1], pictures[2])
    show_frames.main(**paths, folder=tmp_path, modes=["classes"], grid={}, first=0, last=None, video_rate_hz=5)
    assert cv2.VideoCapture(str(tmp_path / "classes.mp4")).get(cv2.CAP_PROP_FRAME_COUNT) == registered_drive.n_frames
    with pytest.raises(BadInput, match="mode"):
        show_frames.main(**paths, folder=tmp_path, modes=["x"], grid={}, first=2, last=3, video_rate_hz=0)
    with pytest.raises(BadInput, match="no frame"):
        show_frames.main(**paths, folder=tmp_path, modes=["classes"], grid={}, first=90, last=99, video_rate_hz=5)
    assert not (tmp_path / "x.mp4").exists()
