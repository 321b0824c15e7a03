"""The papers' figures, as printed, each with the id of its source.

`published.csv` holds every cell of the papers' tables and the single figures of their text: `table, row, column, metric,
value, unit, source_id, note`. Values stand as the paper prints them, misprints included; a note says what is odd.
Table ids are the papers' (`nagy_2_3` is Table 2.3 of the thesis); `<paper>_text` holds figures of the running text.

Source: Nagy (2020), Babahajiani et al. (2017), Józsa and Benedek (2013); ids N-, B-, J-, R- and X- of the inventory.
"""

import functools
import math
import re
from importlib import resources

import pandas as pd

from streetscan.classes import CLASSES
from streetscan.errors import BadInput

PUBLISHED_COLUMNS = ("table", "row", "column", "metric", "value", "unit", "source_id", "note")
_NUMBER = re.compile(r"[<>~]?(\d[\d,]*(?:\.\d+)?)(M?)\*?")


def parse_number(printed: str) -> float:
    """The number in a printed figure: `0.91`, `32,891`, `1.6M`, `>98`, `~7`, `4.0099*`.

    A bound counts as its limit, an asterisk is dropped. Text and misprints such as `88.8.1` are NaN.
    """
    match = _NUMBER.fullmatch(printed)
    if match is None:
        return math.nan
    # Through text, so that 1.6M is exactly 1600000.
    return float(match[1].replace(",", "") + ("e6" if match[2] else ""))


@functools.cache
def _table(name: str) -> pd.DataFrame:
    with (resources.files("streetscan.benchmarks") / f"{name}.csv").open(encoding="utf-8") as stream:
        return pd.read_csv(stream, dtype=str, keep_default_na=False)


def load_published(table: str | None = None) -> pd.DataFrame:
    """The published figures, in the papers' order.

    Args:
        table: one table's id, or None for all.
    Returns:
        one row per figure with the columns of `PUBLISHED_COLUMNS` (text) and `number` (float64, NaN for text and misprints).
    Raises:
        BadInput: no such table.
    """
    content = _table("published")
    if table is not None:
        if table not in set(content["table"]):
            raise BadInput(f"table '{table}'", "no such published table", f"use one of {', '.join(content['table'].unique())}")
        content = content[content["table"] == table]
    return content.assign(number=content["value"].map(parse_number)).reset_index(drop=True)


@functools.cache
def _by_key() -> dict[tuple[str, str, str, str], tuple[str, str]]:
    content = _table("published")
    keys = zip(content["table"], content["row"], content["column"], content["metric"], strict=True)
    return dict(zip(keys, zip(content["value"], content["unit"], strict=True), strict=True))


def find_published(table: str, row: str, column: str, metric: str) -> tuple[str, str] | None:
    """The figure as printed and its unit, or None when the paper has none there."""
    return _by_key().get((table, row, column, metric))


@functools.cache
def _titles() -> dict[str, str]:
    content = _table("titles")
    return {c.name: c.title for c in CLASSES} | dict(zip(content["id"], content["title"], strict=True))


def title(name: str) -> str:
    """How a row, column, method or metric is called in print; an unknown id with its underscores as spaces.

    `city/c2cnn`, a map and a method, is called by both titles.
    """
    if "/" in name:
        return ", ".join(title(part) for part in name.split("/"))
    return _titles().get(name) or (name[:1].upper() + name[1:].replace("_", " "))


def caption(table: str) -> dict[str, str]:
    """What stands over a table: `caption`, `source`, `row_heading`, `reference_metrics`, `scope`.

    `reference_metrics` are those shown of methods only the paper has (all when empty); `scope` is `across` when the rows
    are the data sets themselves, `list` when they are figures that share no columns, and empty when each data set has a table of its own.

    Raises:
        BadInput: no such table.
    """
    content = _table("captions")
    found = content[content["table"] == table]
    if found.empty:
        raise BadInput(f"table '{table}'", "has no caption", f"use one of {', '.join(content['table'])}")
    return found.iloc[0].to_dict()
