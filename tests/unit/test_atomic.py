import os
import subprocess

import pytest

from streetscan.io.atomic import atomic_path


def test_the_file_appears_when_the_block_ends(tmp_path):
    target = tmp_path / "new" / "file.laz"
    with atomic_path(target) as partial:
        assert partial.suffix == ".laz"
        partial.write_text("whole")
        assert not target.exists()
    assert target.read_text() == "whole"
    assert list(target.parent.iterdir()) == [target]


def test_an_error_leaves_the_old_file_and_no_rest(tmp_path):
    target = tmp_path / "file.txt"
    target.write_text("old")
    with pytest.raises(TypeError), atomic_path(target) as partial, open(partial, "w") as stream:
        print("half", file=stream, flush=True) or stream.write(1)
    assert target.read_text() == "old"
    assert list(tmp_path.iterdir()) == [target]


def test_a_block_that_writes_nothing_is_an_error(tmp_path):
    with pytest.raises(FileNotFoundError), atomic_path(tmp_path / "file.txt"):
        pass
    assert list(tmp_path.iterdir()) == []


def test_leftovers_of_killed_processes_go_those_of_living_ones_stay(tmp_path):
    with subprocess.Popen(["true"]) as ended:
        pass
    dead, nested = tmp_path / f".{ended.pid}.file.txt", tmp_path / f".{ended.pid}..{ended.pid}.file.txt"
    living, other = tmp_path / f".{os.getppid()}.file.txt", tmp_path / f".{ended.pid}.other.txt"
    for path in (dead, nested, living, other):
        path.write_text("half")
    with atomic_path(tmp_path / "file.txt") as partial:
        partial.write_text("whole")
    assert set(tmp_path.iterdir()) == {tmp_path / "file.txt", living, other}
