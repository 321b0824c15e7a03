"""The table of speed and memory that `make bench` fills part by part."""

from pathlib import Path

import pandas as pd


def renew_rows(path: str | Path, table: pd.DataFrame) -> pd.DataFrame:
    """The table a file holds, if any, with the rows of benchmarks that were run again replaced: parts of a long list can be run alone."""
    known = pd.read_csv(path, keep_default_na=False) if Path(path).is_file() else table.iloc[:0]
    return pd.concat([known[~known["benchmark"].isin(table["benchmark"])], table], ignore_index=True)
