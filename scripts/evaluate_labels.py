"""Scores of a label map against the truth."""

from collections.abc import Sequence

import numpy as np

from streetscan.io.arrays import load_npy
from streetscan.io.label_tiles import read_label_tiles
from streetscan.io.tables import save_tables
from streetscan.logs import logged
from streetscan.segmentation.metrics import evaluate_labels


def main(truth_path: str, prediction_paths: Sequence[str], scores_path: str, confusion_path: str, seed: int, **settings) -> None:
    """
    Args:
        truth_path: the voxels' labels of label_voxels.
        prediction_paths: all parts of the label map, `.npz`.
        scores_path, confusion_path: tables to write, `.csv`.
        seed: of the even test set.
        settings: of `streetscan.segmentation.metrics.evaluate_labels`.
    """
    truth = load_npy(truth_path, "label_voxels")
    labels, confidence = read_label_tiles(prediction_paths, len(truth))
    scores, confusion = evaluate_labels(truth, labels, confidence, rng=np.random.default_rng(seed), **settings)
    save_tables({scores_path: scores, confusion_path: confusion})


if __name__ == "__main__":
    with logged(snakemake.log[0]):
        main(
            truth_path=snakemake.input.truth,
            prediction_paths=snakemake.input.predictions,
            scores_path=snakemake.output.scores,
            confusion_path=snakemake.output.confusion,
            **snakemake.params,
        )
