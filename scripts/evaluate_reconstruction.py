"""Errors of a drive's reconstructed keyframes against its truth: scale, turns, dense ranges; shares and medians."""

from collections.abc import Sequence
from pathlib import Path

import pandas as pd

from streetscan.calibration.reconstruction_evaluation import evaluate_keyframe, join_summaries, score_reconstructions
from streetscan.drives import read_drive_facts
from streetscan.io.tables import save_tables
from streetscan.logs import logged
from streetscan.simulation.drives import SimulatedRecording


def main(
    facts_path: str | Path, schema_path: str | Path, truth_folder: str | Path, summary_paths: Sequence[str | Path],
    model_folders: Sequence[str | Path], keyframes_path: str | Path, scores_path: str | Path, drive: str, street: dict | None,
    data_root: str, seed: int, n_threads: int, max_range_m: float,
) -> None:  # fmt: skip
    """
    Args:
        facts_path, schema_path, truth_folder: the drive's file, its schema and its truth/.
        summary_paths, model_folders: of reconstruct_keyframe, one of each per keyframe.
        keyframes_path, scores_path: tables to write: a row per keyframe, and over all.
        drive, street, data_root, seed, n_threads: of `SimulatedRecording`; street is None for a real drive.
        max_range_m: of `evaluate_keyframe`.
    """
    summaries = [pd.read_csv(path, dtype={"keyframe": str}) for path in summary_paths]
    true_surfaces = None
    if street is not None and any(s.n_dense[0] > 0 for s in summaries):
        facts = read_drive_facts(facts_path, schema_path)
        true_surfaces = SimulatedRecording(facts, drive, street, seed, data_root, f"{scores_path}.resume", n_threads).true_surfaces
    errors = [
        evaluate_keyframe(summary.iloc[0], folder, truth_folder, true_surfaces, max_range_m)
        for summary, folder in zip(summaries, model_folders, strict=True)
    ]
    table = join_summaries(summaries, errors)
    save_tables({keyframes_path: table, scores_path: score_reconstructions(table)})


if __name__ == "__main__":
    with logged(snakemake.log[0]):
        i, o = snakemake.input, snakemake.output
        inputs = {"facts_path": i.facts, "schema_path": i.schema, "truth_folder": i.truth}
        models = {"summary_paths": list(i.summaries), "model_folders": list(i.models)}
        main(**inputs, **models, keyframes_path=o.keyframes, scores_path=o.scores, **snakemake.params)
