"""The table of `make bench` when a part of it is measured again."""

import pandas as pd

from benchmarks.__main__ import COLUMNS
from streetscan.benchmarks.speed import renew_rows


def _table(*rows):
    return pd.DataFrame([(name, "time", value, "s", "", 1) for name, value in rows], columns=COLUMNS)


def test_rows_of_what_ran_again_are_replaced(tmp_path):
    path = tmp_path / "bench.csv"
    assert renew_rows(path, _table(("a", 1.0)))["value"].tolist() == [1.0]
    _table(("a", 1.0), ("b", 2.0), ("a", 3.0)).to_csv(path, index=False)
    renewed = renew_rows(path, _table(("a", 4.0), ("c", 5.0)))
    assert renewed[["benchmark", "value"]].to_numpy().tolist() == [["b", 2.0], ["a", 4.0], ["c", 5.0]]
