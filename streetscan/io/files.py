"""Small files, as they are or xz-compressed."""

import lzma
import os
from pathlib import Path
from typing import Any, BinaryIO

import yaml

from streetscan.errors import BadInput


def find_file(path: str | Path) -> Path:
    """The file, or the same name with `.xz` where only that exists. BadInput when neither does."""
    path = Path(path)
    for candidate in (path, path.with_name(path.name + ".xz")):
        if os.path.isfile(candidate):  # unlike pathlib's it does not raise where a folder must not be read
            return candidate
    raise BadInput(path, "no such file", "check the drive's file and data_root")


def check_readable(path: str | Path) -> None:
    """BadInput when a file or folder must not be read."""
    if not os.access(path, os.R_OK | os.X_OK if os.path.isdir(path) else os.R_OK):
        raise BadInput(path, "must not be read by you (permission denied)", "ask its owner, or change its permissions")


def open_binary(path: str | Path) -> BinaryIO:
    """The file opened for reading bytes. BadInput when it is missing, no file, or must not be read."""
    path = Path(path)
    try:
        if path.is_dir():
            raise BadInput(path, "is a folder, not a file", "check root and reader in the drive's file")
        if not path.is_file():
            raise BadInput(path, "no such file", "check the drive's file and data_root")
        return path.open("rb")
    except OSError as error:
        raise BadInput(path, f"cannot be read ({error.strerror or error})", "check who may read it, or copy it again") from error


def read_bytes(path: str | Path) -> bytes:
    """The contents, decompressed when the name ends in `.xz`. BadInput when the file cannot be read or decompressed."""
    path = Path(path)
    try:
        data = path.read_bytes()
        return lzma.decompress(data) if path.suffix == ".xz" else data
    except (OSError, lzma.LZMAError, EOFError) as error:
        raise BadInput(path, f"cannot be read ({error})", "copy it again") from error


def read_text(path: str | Path) -> str:
    """The contents of a UTF-8 text file, found by `find_file`. BadInput when it is missing or no text."""
    path = find_file(path)
    try:
        return read_bytes(path).decode("utf-8-sig")  # some editors begin a file with a mark of its encoding
    except UnicodeDecodeError as error:
        raise BadInput(path, "is no text file", "copy or export it again") from error


def read_yaml(path: str | Path) -> Any:
    """The contents of a YAML file. BadInput when it is missing or no YAML."""
    try:
        return yaml.safe_load(read_text(path))
    except yaml.YAMLError as error:
        raise BadInput(path, f"is no YAML ({' '.join(str(error).split())})", "correct the file") from error
