"""Class ids beside a cloud, as text, one a line (Semantic3D's `.labels`)."""

from pathlib import Path

import numpy as np

from streetscan.errors import BadInput
from streetscan.io.xyz import COMPRESSIONS, iterate_rows


def find_labels_file(path: str | Path, suffix: str) -> Path:
    """The labels file of a cloud: the same name with `suffix` for its own, compressed or not.

    Args:
        path: the cloud's file, `scan.txt` or `scan.txt.xz`.
        suffix: such as `.labels`.
    Raises:
        BadInput: there is none.
    """
    path = Path(path)
    bare = path.with_suffix("") if path.suffix in COMPRESSIONS else path
    for end in ("", *COMPRESSIONS):
        candidate = bare.with_suffix(suffix + end)
        if candidate.is_file():
            return candidate
    raise BadInput(
        bare.with_suffix(suffix), "no such file", f"put the labels of {path.name} there, or set truth: none in the data set's file"
    )


class LabelsFile:
    """Class ids as text, one a line, taken in the order of the cloud's chunks."""

    def __init__(self, path: str | Path):
        self._path = Path(path)
        self._chunks = iterate_rows(path, ["class id"])
        self._left = np.empty(0)
        self._n_taken = 0

    def take(self, n: int) -> np.ndarray:
        """The next n class ids, float64. BadInput when fewer are left."""
        parts, n_held = [self._left], len(self._left)
        while n_held < n:
            chunk = next(self._chunks, None)
            if chunk is None:
                raise BadInput(
                    self._path,
                    f"holds {self._n_taken + n_held} labels for at least {self._n_taken + n} points",
                    "get the labels file that belongs to the cloud",
                )
            parts.append(chunk[:, 0])
            n_held += len(chunk)
        held = np.concatenate(parts)
        self._left, self._n_taken = held[n:], self._n_taken + n
        return held[:n]

    def finish(self) -> None:
        """BadInput when class ids are left over."""
        n_left = len(self._left) + sum(len(chunk) for chunk in self._chunks)
        if n_left:
            raise BadInput(
                self._path,
                f"holds {self._n_taken + n_left} labels for {self._n_taken} points",
                "get the labels file that belongs to the cloud",
            )
