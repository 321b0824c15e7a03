"""Point clouds as columns of text, through pandas: one line a point, plain or compressed (.xz, .gz, .bz2)."""

import bz2
import gzip
import lzma
import zlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import BinaryIO

import numpy as np
import pandas as pd

from streetscan.clouds import PointCloud, check_points
from streetscan.errors import BadInput

CHUNK_ROWS = 1_000_000
_OPENERS = {".xz": lzma.open, ".gz": gzip.open, ".bz2": bz2.open}
COMPRESSIONS = tuple(_OPENERS)


def iterate_xyz(
    path: str | Path,
    columns: Sequence[str],
    delimiter: str | None = None,
    comment: str | None = None,
    n_header_rows: int = 0,
    chunk_rows: int = CHUNK_ROWS,
) -> Iterator[PointCloud]:
    """A text file as clouds of at most `chunk_rows` points, in file order, in constant memory.

    Args:
        path: the file.
        columns: a name for each column; `x`, `y` and `z` (metres) are among them.
        delimiter: what separates columns; None is any white space.
        comment: what begins a comment, such as `#`; None if nothing does.
        n_header_rows: lines before the data, comments included.
        chunk_rows: points per cloud.
    Yields:
        clouds whose fields are the other columns, float64, an empty value as NaN.
    Raises:
        BadInput: no such file, truncated compression, another number of columns, text that is no number, NaN or infinite
            coordinates, no point at all.
    """
    columns = list(columns)
    if absent := {"x", "y", "z"} - set(columns):
        raise BadInput(path, f"no column is named '{min(absent)}'", "name x, y and z in reader.columns of the data set's file")
    n_points = 0
    for rows in iterate_rows(path, columns, delimiter, comment, n_header_rows, chunk_rows):
        points = rows[:, [columns.index(axis) for axis in "xyz"]]
        check_points(points, path, first=n_points)
        n_points += len(points)
        yield PointCloud(points, {name: rows[:, i] for i, name in enumerate(columns) if name not in ("x", "y", "z")})
    if n_points == 0:
        check_points(np.empty((0, 3)), path)


def iterate_rows(
    path: str | Path,
    columns: Sequence[str],
    delimiter: str | None = None,
    comment: str | None = None,
    n_header_rows: int = 0,
    chunk_rows: int = CHUNK_ROWS,
    n_rows: int | None = None,
) -> Iterator[np.ndarray]:
    """Rows of numbers as (n, len(columns)) float64 arrays; arguments and errors as in `iterate_xyz`.

    Args:
        n_rows: read only so many rows; None reads all.
    """
    path = Path(path)
    if not path.is_file():
        raise BadInput(path, "no such file", "check the data set's file and data_root")
    layout = (columns, delimiter, comment, n_header_rows)
    is_complaint_sought = True
    try:
        with open_bytes(path) as stream:
            frames = pd.read_csv(
                stream,
                sep=r"\s+" if delimiter is None else delimiter,
                comment=comment,
                skiprows=n_header_rows,
                header=None,
                nrows=n_rows,
                chunksize=chunk_rows,
                dtype=np.float64,
                quoting=3,  # a quotation mark is no number
                encoding="latin-1",
            )
            for frame in frames:
                rows = frame.to_numpy()
                # pandas fills rows that are too short with NaN.
                if rows.shape[1] != len(columns) or (is_complaint_sought and np.isnan(rows[:, -1]).any()):
                    _raise_complaint(path, *layout)
                    is_complaint_sought = False
                yield rows
    except pd.errors.EmptyDataError:
        return
    except (EOFError, lzma.LZMAError, zlib.error, gzip.BadGzipFile, OSError) as error:
        raise BadInput(path, f"the compressed file is damaged or truncated ({error})", "copy or download it again") from error
    except ValueError as error:
        _raise_complaint(path, *layout)
        raise BadInput(path, f"not columns of numbers ({error})", "check reader.columns in the data set's file") from error


def open_bytes(path: Path) -> BinaryIO:
    """A file opened for reading bytes, decompressed by its suffix."""
    return _OPENERS.get(path.suffix, open)(path, "rb")


def _raise_complaint(path: Path, columns: Sequence[str], delimiter: str | None, comment: str | None, n_header_rows: int) -> None:
    """Raise BadInput for the first line that is not what it should be; return when all are."""
    with open_bytes(path) as stream:
        for number, raw in enumerate(stream, start=1):
            line = raw.decode("latin-1").rstrip("\r\n")
            if comment is not None:
                line = line.partition(comment)[0]
            if number <= n_header_rows or not line.strip():
                continue
            values = line.split(delimiter)
            if len(values) != len(columns):
                raise BadInput(
                    path,
                    f"line {number} holds {len(values)} columns, not the {len(columns)} expected ({', '.join(columns)})",
                    "mend the line, or the columns and the delimiter in the data set's file",
                )
            for value in values:
                if value.strip() and not _is_number(value):
                    raise BadInput(
                        path,
                        f"line {number} holds '{value.strip()[:40]}', which is no number",
                        "mend the line, or comment and n_header_rows in the data set's file",
                    )


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
