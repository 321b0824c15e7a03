"""Precision and recall of the grid's classes against true labels of a drive's points."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from streetscan.io.files import read_yaml
from streetscan.io.frame_arrays import FrameArrays
from streetscan.io.tables import save_tables
from streetscan.logs import logged
from streetscan.registration.grid_evaluation import count_confusion, find_mapping, score_grid


def main(truth_folder: str | Path, classes_path: str | Path, scores_path: str | Path) -> None:
    """
    Args:
        truth_folder: truth/ of a drive with labels.
        classes_path: of segment_frames.
        scores_path: table to write, `.csv`.
    """
    truth_folder, classes = Path(truth_folder), FrameArrays(classes_path, "segment_frames")
    mapping = find_mapping(read_yaml(truth_folder / "truth.yaml")["labels"]["ids"])

    def frames() -> Iterator[tuple[np.ndarray, np.ndarray]]:
        for path in sorted((truth_folder / "labels").glob("*.npy")):
            ids = np.load(path) & 0xFFFF  # SemanticKITTI keeps the number of the instance above
            yield classes.read(int(path.stem), len(ids)), ids

    save_tables({scores_path: score_grid(count_confusion(frames(), mapping))})


if __name__ == "__main__":
    with logged(snakemake.log[0]):
        main(snakemake.input.truth, snakemake.input.classes, snakemake.output.scores)
