"""The papers' tables with ours beside theirs, figures, and one report of the run."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import pandas as pd
import yaml

from streetscan.benchmarks import registrations, report, scores, tables
from streetscan.logs import logged

Pairs = Sequence[tuple[str, str]]


def main(
    inputs: Mapping, outputs: Mapping, evaluated: Pairs, trained: Pairs, viewed: Pairs, registered: Pairs, merged: Pairs,
    facts: Mapping, realism: Mapping, config: Mapping,
):  # fmt: skip
    """
    Args:
        inputs: of evaluate_labels `evaluations` and `confusions`, one per pair in `evaluated`; `histories`, per pair in `trained`; of
            evaluate_views `views`, per pair in `viewed`; of evaluate_registration `registrations` and `trajectories`, per pair in
            `registered`; of merge_frames `streets`, per pair in `merged`; of evaluate_frames `grids` and of show_frames `frames`, per
            drive; `realism` (realism.csv, one per name in `compared`), `densities` (density.csv, one per key of `static_scans`).
        outputs: `scores`, `report` (files), `tables`, `figures` (folders).
        evaluated, trained, viewed: (data set, model) pairs; registered, merged: (drive, registrar) pairs.
        facts: data set to its facts for Table 1.2.
        realism: `simulated` data sets; names `compared` and `not_compared`; `static_scans`, static data set to the mobile one.
        config: the resolved configuration, printed in the report; its `run` and `seed` name it.
    """
    files = zip(inputs["evaluations"], inputs["confusions"], evaluated, strict=True)
    evaluations = [scores.read_evaluation(*paths, *pair, config["seed"]) for *paths, pair in files]
    histories = {tuple(pair): pd.read_csv(path) for pair, path in zip(trained, inputs["histories"], strict=True)}
    views = {tuple(pair): Path(folder) for pair, folder in zip(viewed, inputs["views"], strict=True)}
    drives = registrations.read_registrations(inputs["registrations"], inputs["trajectories"], registered)
    found = scores.collect_scores(evaluations, facts, registrations.registration_scores(drives, inputs["grids"]))
    printed = tables.make_tables(found)
    sheets, densities = (
        scores.read_named(inputs[key], realism[names]) for key, names in (("realism", "compared"), ("densities", "static_scans"))
    )
    sections = report.draw_sections(outputs["figures"], found, evaluations, histories, views)
    sections += report.realism_sections(outputs["figures"], sheets, realism["not_compared"], densities, realism["static_scans"])
    streets = dict(zip(map(tuple, merged), inputs["streets"], strict=True))
    sections += registrations.draw_drives(outputs["figures"], drives, streets, inputs["frames"])
    labelled = list(dict.fromkeys([*map(tuple, evaluated), *views]))
    about = report.describe_run(config["run"], config["seed"], labelled, registered)
    settings = yaml.safe_dump(dict(config), sort_keys=False, allow_unicode=True)
    unscored = labelled[len(evaluated) :]
    html = report.render_report(about, found, printed, sections, settings, unscored, realism["simulated"])
    for folder in (outputs["tables"], outputs["figures"]):  # a run without truth has neither tables nor figures
        Path(folder).mkdir(parents=True, exist_ok=True)
    tables.write_tables(outputs["tables"], printed)
    scores.write_named(outputs["tables"], realism=sheets, density=densities)
    scores.write_scores(outputs["scores"], found)
    report.write_report(outputs["report"], html)


if __name__ == "__main__":
    with logged(snakemake.log[0]):
        main(dict(snakemake.input.items()), dict(snakemake.output.items()), **snakemake.params)
