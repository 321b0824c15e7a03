"""Tables as CSV."""

from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path

import pandas as pd

from streetscan.io.atomic import atomic_path


def save_tables(tables: Mapping[str | Path, pd.DataFrame]) -> None:
    """Write each table to its path, all of them or none; numbers in full, undefined ones as empty cells."""
    with ExitStack() as stack:
        for path, table in tables.items():
            table.to_csv(stack.enter_context(atomic_path(path)), index=False)
