import logging

import pytest

from streetscan.errors import BadInput
from streetscan.logs import logged

logger = logging.getLogger("streetscan.test")


def test_messages_go_to_the_log_and_the_terminal(tmp_path, capsys):
    with logged(tmp_path / "deep" / "step.log"):
        logger.info("%d voxels", 7)
    assert "7 voxels" in (tmp_path / "deep" / "step.log").read_text()
    assert "7 voxels" in capsys.readouterr().err
    assert logging.getLogger("streetscan").handlers == []


def test_bad_input_is_one_sentence_on_the_terminal(tmp_path, capsys):
    with pytest.raises(SystemExit) as stop, logged(tmp_path / "step.log"):
        raise BadInput("map.laz", "holds no point", "give another")
    assert stop.value.code == 1
    assert capsys.readouterr().err == "error: map.laz: holds no point; give another.\n"
    assert "Traceback" in (tmp_path / "step.log").read_text()


def test_other_errors_pass_on_and_are_logged(tmp_path):
    with pytest.raises(ZeroDivisionError), logged(tmp_path / "step.log"):
        print(1 / 0)
    assert "ZeroDivisionError" in (tmp_path / "step.log").read_text()


def test_a_second_run_starts_a_new_log(tmp_path):
    for word in ("first", "second"):
        with logged(tmp_path / "step.log"):
            logger.info(word)
    text = (tmp_path / "step.log").read_text()
    assert "second" in text
    assert "first" not in text
