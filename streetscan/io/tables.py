"""Tables as CSV."""

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path

import pandas as pd

from streetscan.errors import BadInput
from streetscan.io.atomic import atomic_path


def save_tables(tables: Mapping[str | Path, pd.DataFrame]) -> None:
    """Write each table to its path, all of them or none; numbers in full, undefined ones as empty cells."""
    with ExitStack() as stack:
        for path, table in tables.items():
            table.to_csv(stack.enter_context(atomic_path(path)), index=False)


def read_csv(path: str | Path, columns: Sequence[str], step: str) -> pd.DataFrame:
    """A table that a step of ours wrote.

    Args:
        path: the file.
        columns: those it must have.
        step: named in the error.
    Raises:
        BadInput: no CSV table, or a column is missing.
    """
    try:
        content = pd.read_csv(path)
    except (OSError, ValueError) as error:
        raise BadInput(path, f"not a CSV table ({error})", f"delete it and run {step} again") from error
    if missing := [c for c in columns if c not in content]:
        raise BadInput(path, f"lacks the column '{missing[0]}'", f"delete it and run {step} again")
    return content
