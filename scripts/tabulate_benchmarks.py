"""The papers' tables with ours beside theirs, figures, and one report of the run."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import pandas as pd
import yaml

from streetscan.benchmarks import calibrations, localizations, networks, registrations, report, scores, tables
from streetscan.logs import logged

Pairs = Sequence[tuple[str, str]]


def main(
    inputs: Mapping, outputs: Mapping, evaluated: Pairs, trained: Pairs, known: Sequence[Mapping], viewed: Pairs, registered: Pairs,
    merged: Pairs, localized: Sequence[tuple[str, ...]], facts: Mapping, realism: Mapping, config: Mapping,
):  # fmt: skip
    """
    Args:
        inputs: of evaluate_labels `evaluations` and `confusions`, one per pair in `evaluated`; `histories`, per pair in `trained`; of
            calibrate_segmenter `network_scores`, `network_reliabilities`, one per name in `known` (see `networks.Network`); of
            evaluate_views `views`, per pair in `viewed`; of evaluate_registration `registrations` and `trajectories`, per pair in
            `registered`; of merge_frames `streets`, per pair in `merged`; per drive `grids` of evaluate_frames and `frames` of show_frames;
            per name in `localized` `localizations`, `localization_pictures`; per drive `reconstructions`, `detections`, `calibrations`,
            `recalibrations`, `recalibration_figures`; per keyframe `models`, `model_summaries`, `calibrated`, `verdicts`; others by name.
        outputs: `scores`, `report` (files), `tables`, `figures` (folders). evaluated ... localized: names, their parts as in the paths.
        facts: of Table 1.2, by data set. realism: `simulated` data sets; `compared`, `not_compared`; `static_scans`: mobile data set.
    """
    files = zip(inputs["evaluations"], inputs["confusions"], map(tuple, evaluated), strict=True)
    evaluations = [e for *paths, pair in files for e in scores.read_evaluations(*paths, *pair, config["seed"])]
    histories = {tuple(pair): pd.read_csv(path) for pair, path in zip(trained, inputs["histories"], strict=True)}
    views = {tuple(pair): Path(folder) for pair, folder in zip(viewed, inputs["views"], strict=True)}
    drives = registrations.read_registrations(inputs["registrations"], inputs["trajectories"], registered)
    on_maps = localizations.read_localizations(inputs["localizations"], localized)
    rows = registrations.registration_scores(drives, inputs["grids"]) + localizations.localization_scores(on_maps)
    rows += networks.all_scores(inputs, known, evaluations) + calibrations.all_scores(inputs)
    found = scores.collect_scores(evaluations, facts, rows)
    printed = tables.make_tables(found)
    sheets, densities = (scores.read_named(inputs[k], realism[n]) for k, n in (("realism", "compared"), ("densities", "static_scans")))
    figures = Path(outputs["figures"])
    sections = report.draw_sections(figures, found, evaluations, histories, views) + networks.draw_networks(figures, inputs, known)
    sections += report.realism_sections(figures, sheets, realism["not_compared"], densities, realism["static_scans"])
    sections += registrations.draw_drives(figures, drives, dict(zip(map(tuple, merged), inputs["streets"], strict=True)), inputs["frames"])
    sections += localizations.draw_localizations(figures, on_maps, inputs["localization_pictures"])
    sections += calibrations.draw_keyframes(inputs, config["calibrate_keyframe"]["settings"])
    labelled = list(dict.fromkeys([*map(tuple, evaluated), *views]))
    about = report.describe_run(config["run"], config["seed"], labelled, registered)
    resolved, unscored = yaml.safe_dump(dict(config), sort_keys=False, allow_unicode=True), labelled[len(evaluated) :]
    html = report.render_report(about, found, printed, sections, resolved, unscored, realism["simulated"])
    figures.mkdir(parents=True, exist_ok=True)
    tables.write_tables(outputs["tables"], printed)
    scores.write_named(outputs["tables"], realism=sheets, density=densities)
    scores.write_scores(outputs["scores"], found)
    report.write_report(outputs["report"], html)


if __name__ == "__main__":
    with logged(snakemake.log[0]):
        main(dict(snakemake.input.items()), dict(snakemake.output.items()), **snakemake.params)
