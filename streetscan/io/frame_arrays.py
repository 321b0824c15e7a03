"""One array per frame in one file, written and read frame by frame: an `.npz` with the entries `000000`, `000001`, ..."""

import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from streetscan.errors import BadInput
from streetscan.io.atomic import atomic_path


class FrameArraysWriter:
    """Appends arrays to an open file; made by `open_frame_arrays_writer`."""

    def __init__(self, archive: zipfile.ZipFile):
        self._archive = archive

    def write(self, index: int, array: np.ndarray) -> None:
        """Append the array of a frame; each index once."""
        with self._archive.open(f"{index:06d}.npy", "w", force_zip64=True) as stream:
            np.lib.format.write_array(stream, np.ascontiguousarray(array), allow_pickle=False)


@contextmanager
def open_frame_arrays_writer(path: str | Path) -> Iterator[FrameArraysWriter]:
    """A writer that streams arrays into a file; the file appears when the block ends without an error."""
    with (
        atomic_path(path) as partial,
        zipfile.ZipFile(partial, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive,
    ):
        yield FrameArraysWriter(archive)


class FrameArrays:
    """Arrays of frames, read one at a time."""

    def __init__(self, path: str | Path, made_by: str):
        """
        Args:
            path: what `open_frame_arrays_writer` wrote.
            made_by: the step that writes it, named in errors.
        Raises:
            BadInput: the file is something else.
        """
        self._path, self._made_by = Path(path), made_by
        try:
            self._archive = np.load(path)
            self._names = set(self._archive.files)
        except (OSError, ValueError, EOFError, AttributeError, zipfile.BadZipFile) as error:
            raise BadInput(path, f"no arrays of frames ({error})", f"delete it and run {made_by} again") from error

    def __contains__(self, index: int) -> bool:
        return f"{index:06d}" in self._names

    def __len__(self) -> int:
        return len(self._names)

    def read(self, index: int, length: int) -> np.ndarray:
        """The array of a frame, its first axis of a given length.

        Raises:
            BadInput: the frame has none, or it has another length.
        """
        if index not in self:
            raise BadInput(self._path, f"holds nothing for frame {index}", f"run {self._made_by} on this drive again")
        array = self._archive[f"{index:06d}"]
        if len(array) != length:
            raise BadInput(
                self._path, f"frame {index} has {len(array)} values for {length} points", f"run {self._made_by} on this drive again"
            )
        return array
