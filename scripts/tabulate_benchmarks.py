"""The papers' tables with ours beside theirs, figures, and one report of the run."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import pandas as pd
import yaml

from streetscan.benchmarks import calibrations, localizations, networks, registrations, report, scores, tables, thinning
from streetscan.logs import logged

Pairs = Sequence[tuple[str, str]]


def main(
    inputs: Mapping, outputs: Mapping, evaluated: Sequence[tuple], trained: Pairs, known: Sequence[Mapping], thinned: Mapping,
    viewed: Pairs, registered: Pairs, merged: Pairs, localized: Sequence[tuple], facts: Mapping, realism: Mapping, config: Mapping,
):  # fmt: skip
    """
    Args:
        inputs: of evaluate_labels `evaluations` and `confusions`, one per (data set, model, seed) in `evaluated`; `histories`, per pair in
            `trained`; of calibrate_segmenter `network_scores`, `network_reliabilities`, one per name in `known` (see `networks.Network`);
            `thinnings`, per map in `thinned`; of evaluate_views `views`, per pair in `viewed`; of evaluate_registration `registrations`,
            `trajectories`, per pair in `registered`; of merge_frames `streets`, per pair in `merged`; per drive `grids` of evaluate_frames,
            `frames` of show_frames; per name in `localized` `localizations`, `localization_pictures`; others by name.
        outputs: `scores`, `report` (files), `tables`, `figures` (folders). evaluated ... localized: names, their parts as in the paths, of
            models without seed. thinned: `parts` (`<data set>/<part>`), `names` (model to method and seed).
        facts: of Table 1.2, by data set. realism: `simulated` data sets; `compared`, `not_compared`; `static_scans`: mobile data set.
    """
    evaluations = scores.read_all_evaluations(inputs, evaluated)
    histories = {tuple(pair): pd.read_csv(path) for pair, path in zip(trained, inputs["histories"], strict=True)}
    views = {tuple(pair): Path(folder) for pair, folder in zip(viewed, inputs["views"], strict=True)}
    drives = registrations.read_registrations(inputs["registrations"], inputs["trajectories"], registered)
    on_maps = localizations.read_localizations(inputs["localizations"], localized)
    kinds = ("realism", realism["compared"]), ("densities", realism["static_scans"]), ("thinnings", thinned["parts"])
    sheets, densities, thinnings = (scores.read_named(inputs[kind], names) for kind, names in kinds)
    rows = registrations.registration_scores(drives, inputs["grids"]) + localizations.localization_scores(on_maps)
    rows += networks.all_scores(inputs, known, evaluations) + calibrations.all_scores(inputs, config["calibrate_keyframe"]["settings"])
    found = scores.collect_scores(evaluations, facts, rows + thinning.thinning_scores(thinnings, thinned["names"]))
    printed, figures = tables.make_tables(found), Path(outputs["figures"])
    sections = report.draw_sections(figures, found, evaluations, histories, views)
    sections += networks.draw_networks(figures, inputs, known) + thinning.draw_thinning(figures, found)
    sections += report.realism_sections(figures, sheets, realism["not_compared"], densities, realism["static_scans"])
    sections += registrations.draw_drives(figures, drives, dict(zip(map(tuple, merged), inputs["streets"], strict=True)), inputs["frames"])
    sections += localizations.draw_localizations(figures, on_maps, inputs["localization_pictures"])
    sections += calibrations.draw_keyframes(figures, inputs, config["calibrate_keyframe"]["settings"])
    scored = dict.fromkeys((e.dataset, e.model) for e in evaluations)
    about = report.describe_run(config["run"], config["seed"], [*(scored | views)], registered)
    resolved, unscored = yaml.safe_dump(dict(config), sort_keys=False, allow_unicode=True), [pair for pair in views if pair not in scored]
    html = report.render_report(about, found, printed, sections, resolved, unscored, realism["simulated"])
    tables.write_tables(outputs["tables"], printed)
    held = report.yardstick_tables(found, realism["simulated"])
    scores.write_named(outputs["tables"], realism=sheets, density=densities, thinning=thinnings, yardsticks=held)
    scores.write_scores(outputs["scores"], found)
    report.write_report(outputs["report"], html)


if __name__ == "__main__":
    with logged(snakemake.log[0]):
        main(dict(snakemake.input.items()), dict(snakemake.output.items()), **snakemake.params)
