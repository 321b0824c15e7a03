"""Networks as the validation part shows them: their confidence before and after calibration, and what voxel and cube size do.

Source: Nagy (2020), 2.5.2, Tables 2.1 and 2.2 (N-031 to N-033). Ours are of validation samples, since what is chosen by them may not be
chosen on the test part.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import pandas as pd

from streetscan.benchmarks.figures import reliability_diagram
from streetscan.benchmarks.published import title
from streetscan.benchmarks.report import Section, save_picture
from streetscan.benchmarks.scores import Evaluation, make_score
from streetscan.io.tables import read_csv

# The thesis' optimum; Table 2.1 keeps its K, Table 2.2 its λ.
_K, _SIZE_M = 23, 0.1
_RATES = ("precision", "recall", "f")
_SCORES = ("stage", "protocol", "class", "metric", "value", "unit", "n")
_REFINEMENTS = ("n_turns", "is_smoothed", "protocol", "class", "metric", "value", "unit", "n")
_BINS = ("stage", "protocol", "confidence", "accuracy", "n")


@dataclass(frozen=True)
class Network:
    """A trained network and what calibrate_segmenter found.

    Attributes:
        dataset, method: whose; the data set may be another's map in voxels of another size.
        seed: of its training.
        map: the data set whose map it is.
        size_m, k: voxel edge and voxels an axis of the cube.
        is_labelled: whether a map is labelled with it.
        is_tuned: whether it is compared with others on the validation part.
        is_refined: whether its labels of the validation part are scored with and without further turns and smoothing.
        is_point: whether it differs from C²CNN in voxel and cube size alone.
        scores, reliability: of calibrate_segmenter.
    """

    dataset: str
    method: str
    seed: int
    map: str
    size_m: float
    k: int
    is_labelled: bool
    is_tuned: bool
    is_refined: bool
    is_point: bool
    scores: pd.DataFrame
    reliability: pd.DataFrame

    def value(self, protocol: str, name: str, metric: str, stage: str = "calibrated") -> tuple[float, float]:
        """One figure and its n."""
        s = self.scores
        (row,) = s[(s["stage"] == stage) & (s["protocol"] == protocol) & (s["class"] == name) & (s["metric"] == metric)].itertuples()
        return row.value, row.n


def read_networks(inputs: Mapping[str, Sequence[str]], known: Sequence[Mapping]) -> list[Network]:
    """The networks of a run.

    Args:
        inputs: `network_scores` and `network_reliabilities`, the files of calibrate_segmenter, one per network.
        known: the other attributes of each.
    """
    made = []
    for of, *paths in zip(known, inputs["network_scores"], inputs["network_reliabilities"], strict=True):
        tables = [read_csv(path, columns, "calibrate_segmenter") for path, columns in zip(paths, (_SCORES, _BINS), strict=True)]
        made.append(Network(**of, scores=tables[0], reliability=tables[1]))
    return made


def all_scores(inputs: Mapping[str, Sequence[str]], known: Sequence[Mapping], evaluations: Sequence[Evaluation]) -> list[dict]:
    """Rows of the tidy scores: calibration errors of networks and labelled maps, what the compared networks reach, Tables 2.1 and 2.2.

    Args:
        inputs, known: as in `read_networks`, and `refinements`, of evaluate_refinements, one per network with `is_refined`.
        evaluations: of labelled maps.
    """
    networks = read_networks(inputs, known)
    rows = _confidence_scores([n for n in networks if n.is_labelled], evaluations)
    tuned = [n for n in networks if n.is_tuned]
    rows += _refinement_scores(inputs["refinements"], [n for n in networks if n.is_refined])
    return rows + _tuning_scores(tuned) + _parameter_scores([n for n in tuned if n.is_point])


def _confidence_scores(networks: Sequence[Network], evaluations: Sequence[Evaluation]) -> list[dict]:
    """The table `confidence`: calibration errors on validation samples before and after, and of labelled test parts."""
    found = []
    for n in networks:
        for stage in ("trained", "calibrated"):
            found.append((n.dataset, n.method, f"validation_{stage}", *n.value("natural", "overall", "calibration_error", stage), n.seed))
    for e in evaluations:
        part = e.scores[e.scores["metric"] == "calibration_error"]
        found += [(e.dataset, e.method, f"test_{r['protocol']}", r["value"], r["n"], e.seed) for r in part.to_dict("records")]
    return [make_score("confidence", f"{d}/{m}", column, "calibration_error", v, "%", n, d, m, seed) for d, m, column, v, n, seed in found]


def _tuning_scores(networks: Sequence[Network]) -> list[dict]:
    """The table `tuning`: F of compared networks on validation samples, the object classes alike, and all classes as they occur."""
    rows = []
    for n in networks:
        for protocol, name, metric in (("even", "objects", "f"), ("natural", "overall", "f"), ("natural", "overall", "accuracy")):
            value, count = n.value(protocol, name, metric)
            column = f"validation_{protocol}"
            rows.append(make_score("tuning", f"{n.dataset}/{n.method}", column, metric, value, "%", count, n.dataset, n.method, n.seed))
    return rows


def _refinement_scores(paths: Sequence[str], networks: Sequence[Network]) -> list[dict]:
    """The table `refinement`: a labelled validation part by turns and smoothing, and what labelling it took."""
    shown = {("natural", "overall", metric) for metric in ("f", "accuracy", "calibration_error")}
    shown |= {("even", "objects", "f"), ("natural", "part", "time")}
    rows = []
    for n, path in zip(networks, paths, strict=True):
        table = read_csv(path, _REFINEMENTS, "evaluate_refinements")
        for r in table.to_dict("records"):
            if (protocol := r["protocol"], r["class"], metric := r["metric"]) in shown:
                row = f"{n.dataset}/{n.method}/turns_{r['n_turns']}{'_smoothed' * r['is_smoothed']}"
                column = "" if metric == "time" else f"validation_{protocol}"
                rows.append(make_score("refinement", row, column, metric, r["value"], r["unit"], r["n"], n.dataset, n.method, n.seed))
    return rows


def _parameter_scores(networks: Sequence[Network]) -> list[dict]:
    """Tables 2.1 and 2.2, and their joint grid `parameters`."""
    rows = []
    for n in networks:
        rates = {m: n.value("even", "objects", m) for m in _RATES}
        size, common = f"{n.size_m:g}", {"dataset": n.map, "method": "c2cnn", "seed": n.seed}
        rows.append(make_score("parameters", size, f"k_{n.k}", "f", *rates["f"][:1], "%", **common))
        for table, row in [("nagy_2_1", size)] * (n.k == _K) + [("nagy_2_2", str(n.k))] * (n.size_m == _SIZE_M):
            rows += [make_score(table, row, "c2cnn", m, value, "%", count, **common) for m, (value, count) in rates.items()]
        if n.k == _K and n is _first_of(networks, n):  # counts are the map's, whatever the seed
            counts = {m: n.value("natural", "part", m)[0] for m in ("n_voxels", "n_occupied")}
            rows += [make_score("nagy_2_1", size, "c2cnn", m, value, "", **common) for m, value in counts.items()]
    return rows


def _first_of(networks: Sequence[Network], like: Network) -> Network:
    """The first of the networks that are this one but for the seed."""
    return next(n for n in networks if (n.dataset, n.method) == (like.dataset, like.method))


def draw_networks(folder: str | Path, inputs: Mapping[str, Sequence[str]], known: Sequence[Mapping]) -> list[Section]:
    """A section with the reliability of each network (of its first seed) before and after calibration, drawn into a folder (SVG, PDF)."""
    networks, pictures = [n for n in read_networks(inputs, known) if n.is_labelled], []
    for n in (n for n in networks if n is _first_of(networks, n)):
        bins = n.reliability[n.reliability["protocol"] == "natural"]
        before, after = (bins[bins["stage"] == stage] for stage in ("trained", "calibrated"))
        temperature = n.value("natural", "overall", "temperature")[0]
        caption = f"{title(n.method)} on validation samples of {n.dataset}, weighing as their classes occur; temperature {temperature:.2f}."
        name = f"reliability_{n.dataset}_{n.method}"
        pictures.append(save_picture(reliability_diagram(after, before), Path(folder), name, caption, is_narrow=True))
    text = (
        "Whether a confidence is the share of right labels. Where it helps, logits are divided by one temperature, fitted on the "
        "validation samples; what that is worth on the test part stands in the table confidence."
    )
    return [Section("confidence", "Confidence", text, pictures)] if pictures else []
