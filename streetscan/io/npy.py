"""`.npy` files written piece by piece, for arrays longer than memory."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from streetscan.io.atomic import atomic_path


class NpyWriter:
    """Appends one-dimensional pieces to an open `.npy` file; made by `open_npy_writer`."""

    def __init__(self, stream, dtype: np.dtype):
        self._stream, self._dtype, self._n = stream, np.dtype(dtype), 0
        self._write_header()

    def write(self, values: np.ndarray) -> None:
        """Append (n,) values. ValueError when they are not of the file's type."""
        values = np.ascontiguousarray(values)
        if values.dtype != self._dtype or values.ndim != 1:
            raise ValueError(f"a {values.ndim}-dimensional piece of {values.dtype} for a file of {self._dtype}")
        self._stream.write(values.data)
        self._n += len(values)

    def close(self) -> None:
        """Write the final length into the header."""
        self._stream.seek(0)
        self._write_header()

    def _write_header(self) -> None:
        # NumPy pads the header so that the length of the first axis may grow in place.
        header = {"descr": np.lib.format.dtype_to_descr(self._dtype), "fortran_order": False, "shape": (self._n,)}
        np.lib.format.write_array_header_1_0(self._stream, header)


@contextmanager
def open_npy_writer(path: str | Path, dtype: np.dtype) -> Iterator[NpyWriter]:
    """A writer that streams a one-dimensional array into a `.npy` file; the file appears when the block ends without an error."""
    with atomic_path(path) as partial, open(partial, "wb") as stream:
        writer = NpyWriter(stream, dtype)
        yield writer
        writer.close()
