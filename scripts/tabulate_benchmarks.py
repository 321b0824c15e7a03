"""The papers' tables with ours beside theirs, figures, and one report of the run."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import pandas as pd
import yaml

from streetscan.benchmarks import localizations, registrations, report, scores, tables
from streetscan.logs import logged

Pairs = Sequence[tuple[str, str]]


def main(
    inputs: Mapping, outputs: Mapping, evaluated: Pairs, trained: Pairs, viewed: Pairs, registered: Pairs, merged: Pairs,
    localized: Sequence[tuple[str, ...]], facts: Mapping, config: Mapping,
):  # fmt: skip
    """
    Args:
        inputs: of evaluate_labels `evaluations` and `confusions`, one per pair in `evaluated`; of train_segmenter `histories`, per pair
            in `trained`; of evaluate_views `views`, per pair in `viewed`; of evaluate_registration `registrations` and `trajectories`,
            per pair in `registered`; of merge_frames `streets`, per pair in `merged`; of evaluate_frames `grids` and of show_frames
            `frames`, per drive; of evaluate_localization `localizations` and of localize_frames `localization_pictures`, per name in
            `localized`.
        outputs: `scores`, `report` (files), `tables`, `figures` (folders).
        evaluated, trained, viewed: (data set, model) pairs.
        registered, merged: (drive, registrar) pairs.
        localized: (data set, drive, labels, localizer, place).
        facts: data set to its facts for Table 1.2.
        config: the resolved configuration, printed in the report; its `run` and `seed` name it.
    """
    files = zip(inputs["evaluations"], inputs["confusions"], evaluated, strict=True)
    evaluations = [scores.read_evaluation(*paths, *pair, config["seed"]) for *paths, pair in files]
    histories = {tuple(pair): pd.read_csv(path) for pair, path in zip(trained, inputs["histories"], strict=True)}
    views = {tuple(pair): Path(folder) for pair, folder in zip(viewed, inputs["views"], strict=True)}
    drives = registrations.read_registrations(inputs["registrations"], inputs["trajectories"], registered)
    more = registrations.registration_scores(drives) + registrations.grid_scores(inputs["grids"])
    on_maps = localizations.read_localizations(inputs["localizations"], localized)
    more += localizations.localization_scores(on_maps)
    found = scores.collect_scores(evaluations, facts, more)
    printed = tables.make_tables(found)
    sections = report.draw_sections(outputs["figures"], found, evaluations, histories, views)
    streets = dict(zip(map(tuple, merged), inputs["streets"], strict=True))
    sections += registrations.draw_drives(outputs["figures"], drives, streets, inputs["frames"])
    sections += localizations.draw_localizations(outputs["figures"], on_maps, inputs["localization_pictures"])
    labelled = list(dict.fromkeys([*map(tuple, evaluated), *views]))
    html = report.render_report(
        report.describe_run(config["run"], config["seed"], labelled, registered),
        found,
        printed,
        sections,
        yaml.safe_dump(dict(config), sort_keys=False, allow_unicode=True),
        unscored=labelled[len(evaluated) :],
    )
    for folder in (outputs["tables"], outputs["figures"]):  # a run without truth has neither tables nor figures
        Path(folder).mkdir(parents=True, exist_ok=True)
    tables.write_tables(outputs["tables"], printed)
    scores.write_scores(outputs["scores"], found)
    report.write_report(outputs["report"], html)


if __name__ == "__main__":
    with logged(snakemake.log[0]):
        main(dict(snakemake.input.items()), dict(snakemake.output.items()), **snakemake.params)
