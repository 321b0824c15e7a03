"""Plain arrays as `.npy` and `.npz`, written whole or not at all, read without pickles."""

import zipfile
import zlib
from pathlib import Path

import numpy as np

from streetscan.errors import BadInput
from streetscan.io.atomic import atomic_path

_READ_ERRORS = (OSError, ValueError, EOFError, zipfile.BadZipFile, zlib.error)


def save_npy(path: str | Path, array: np.ndarray) -> None:
    """Write one array."""
    with atomic_path(path) as partial, open(partial, "wb") as stream:
        np.save(stream, array)


def load_npy(path: str | Path, made_by: str, length: int | None = None) -> np.ndarray:
    """One array, memory-mapped and read-only.

    Args:
        path: the file.
        made_by: the step that writes it, named in errors.
        length: its length along the first axis, checked where given.
    Raises:
        BadInput: the file is something else, or has another length.
    """
    try:
        array = np.load(path, mmap_mode="r")
    except _READ_ERRORS as error:
        raise BadInput(path, f"not an .npy array ({error})", f"delete it and run {made_by} again") from error
    if not isinstance(array, np.ndarray):
        raise BadInput(path, "an .npz archive instead of an .npy array", f"delete it and run {made_by} again")
    if length is not None and array.shape[:1] != (length,):
        raise BadInput(path, f"holds an array of shape {array.shape} instead of {length} values", f"run {made_by} again")
    return array


def save_npz(path: str | Path, is_packed: bool = False, **arrays: np.ndarray) -> None:
    """Write named arrays, compressed where `is_packed`: masks shrink to a hundredth, points hardly at all."""
    with atomic_path(path) as partial, open(partial, "wb") as stream:
        (np.savez_compressed if is_packed else np.savez)(stream, **arrays)


def load_npz(path: str | Path, names: tuple[str, ...], made_by: str) -> tuple[np.ndarray, ...]:
    """The arrays of those names. BadInput naming the step `made_by` when the file is something else or lacks one."""
    try:
        with np.load(path) as data:
            return tuple(data[name] for name in names)
    except (*_READ_ERRORS, KeyError, TypeError, AttributeError) as error:
        raise BadInput(path, f"no .npz file with {', '.join(names)} ({error})", f"delete it and run {made_by} again") from error
