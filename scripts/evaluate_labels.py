"""Scores of a label map against the truth."""

from collections.abc import Sequence

import numpy as np
import pandas as pd

from streetscan.io.arrays import load_npy
from streetscan.io.label_tiles import read_label_tiles, read_labels_alone
from streetscan.io.tables import save_tables
from streetscan.logs import logged
from streetscan.segmentation.metrics import evaluate_labels


def main(truth_path: str, prediction_paths: Sequence[str], scores_path: str, confusion_path: str, seed: int, **settings) -> None:
    """
    Args:
        truth_path: the voxels' labels of label_voxels.
        prediction_paths: all parts of the label map, `.npz`.
        scores_path, confusion_path: tables to write, `.csv`; `labels`: the `map`'s and, where those are smoothed, each voxel's `alone`.
        seed: of the even test set.
        settings: of `streetscan.segmentation.metrics.evaluate_labels`.
    """
    truth = load_npy(truth_path, "label_voxels")
    labels, confidence = read_label_tiles(prediction_paths, len(truth))
    alone = read_labels_alone(prediction_paths, len(truth))
    given = {"map": (labels, confidence)} | ({} if alone is None else {"alone": (alone, None)})
    found = {name: evaluate_labels(truth, *of, rng=np.random.default_rng(seed), **settings) for name, of in given.items()}
    tables = (pd.concat({name: tables[i] for name, tables in found.items()}, names=["labels"]).reset_index("labels") for i in (0, 1))
    save_tables(dict(zip((scores_path, confusion_path), tables, strict=True)))


if __name__ == "__main__":
    with logged(snakemake.log[0]):
        main(
            truth_path=snakemake.input.truth,
            prediction_paths=snakemake.input.predictions,
            scores_path=snakemake.output.scores,
            confusion_path=snakemake.output.confusion,
            **snakemake.params,
        )
